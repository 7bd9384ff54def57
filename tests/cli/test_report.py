"""``ctid report``, and ``ctid figure`` of experiments: files, where they go, and what is refused."""

import numpy as np
import pytest

from ctid_cli import HeldSignal, TransferFunction, simulate


def test_the_figure_of_an_experiment_goes_to_its_folder(ctid, done):
    shown = ctid("figure", "tiny", "--out", done).stdout.strip()
    assert shown == str(done / "tiny" / "figures" / "measure.svg")
    shown = ctid("figure", "tiny", "--measure", "rmse:delay", "--format", "pdf", "--out", done)
    assert shown.stdout.strip().endswith("figures/measure_rmse-delay.pdf")


def test_the_suffix_of_a_file_is_its_format(ctid, done, tmp_path):
    ctid("figure", "tiny", "--kind", "box", "--file", tmp_path / "new" / "box.png", "--out", done)
    assert (tmp_path / "new" / "box.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("measured-tiny",), "one measured record, so that there is nothing to draw over data sets; ctid fit"),
        (("tiny", "--kind", "cloud"), "no kind of figure 'cloud'"),
        (("tiny", "--measure", "rsme"), "no measure 'rsme'; did you mean 'rmse'"),
        (("tinny",), "nor an experiment with results in"),
        (("1", "--format", "png"), "figures of studies are SVG files as published"),
        (("tiny", "1", "--file", "a.svg"), "--file takes one figure, not 2"),
    ],
)
def test_what_cannot_be_drawn_is_refused(ctid, done, arguments, message):
    assert message in ctid("figure", *arguments, "--out", done, code=2).stderr


@pytest.mark.parametrize("name", ["tiny", "measured-tiny"])
def test_a_page_is_written_beside_the_results(ctid, done, name):
    path = done / name / "report.html"
    assert ctid("report", name, "--out", done).stdout == f"{path}\n"
    text = path.read_text(encoding="utf-8")
    assert text.startswith("<!DOCTYPE html>")
    assert len(text) < 2_000_000
    assert ("One measured record, the same for all estimators." in text) == (name == "measured-tiny")
    assert "seed None" not in text


def test_the_page_of_a_study_has_its_tables_and_figures(ctid, tmp_path):
    path = tmp_path / "page.html"
    assert ctid("report", "useful-redundancy", "--out", tmp_path / "none", "--file", path).stdout == f"{path}\n"
    text = path.read_text(encoding="utf-8")
    assert text.count("<svg ") == 7
    assert "Table 4." in text
    assert "arXiv:1703.09344" in text
    assert not (tmp_path / "none").exists()


def test_an_unknown_name_is_refused(ctid, done):
    stderr = ctid("report", "tinny", "--out", done, code=2).stderr
    assert "'tinny' is neither an experiment with results in" in stderr
    assert "did you mean 'tiny'? Known: measured-tiny, tiny, additive" in stderr


@pytest.fixture
def fitted(ctid, tmp_path):
    """A folder with a record, its fit and the fit's page."""
    t = 0.1 * np.arange(200)
    u = np.repeat(np.random.default_rng(0).choice([-1.0, 1.0], 40), 5)
    y = simulate(TransferFunction([2.0], [1.0, 1.0], 0.3), HeldSignal(t, u), t) + 0.05 * np.cos(37.0 * t)
    rows = ["t,u,y", *(",".join(map(repr, row)) for row in np.column_stack((t, u, y)).tolist())]
    (tmp_path / "record.csv").write_text("\n".join(rows), encoding="utf-8")
    shown = ctid("fit", tmp_path / "record.csv", "--poles", 1, "--delay", 0.3, "--report", "--out", tmp_path).stdout
    assert f"Written: {tmp_path / 'fit.json'}, {tmp_path / 'fit.svg'}, {tmp_path / 'fit.html'}" in shown
    return tmp_path


def test_the_page_of_a_fit_is_that_of_its_file(ctid, fitted):
    first = (fitted / "fit.html").read_bytes()
    assert b"--delay 0.3 --poles 1" in first
    assert b"<h1>Fit of " in first
    (fitted / "record.csv").rename(fitted / "moved.csv")
    stderr = ctid("report", fitted / "fit.json", code=2).stderr
    assert "record.csv does not exist; say where it is now: --record FILE" in stderr
    page = fitted / "new" / "page.html"
    shown = ctid("report", fitted / "fit.json", "--record", fitted / "moved.csv", "--file", page).stdout
    assert shown == f"{page}\n"
    assert page.read_bytes() == first


def test_what_is_no_fit_has_no_page(ctid, fitted):
    before = sorted(fitted.iterdir())
    (fitted / "track.json").write_text('{"kind": "ctid track"}', encoding="utf-8")
    (fitted / "frf.json").write_text('{"kind": "ctid frf"}', encoding="utf-8")
    cases = {
        (fitted / "track.json",): "ctid track writes such a file",
        (fitted / "frf.json",): "is no fit but of kind 'ctid frf'",
        (fitted / "none.json",): "none.json: does not exist",
        (fitted / "record.csv",): "is neither a fit nor a track",
        (fitted / "fit.json", "--record", fitted / "fit.json"): "is not the file that the fit is of",
        (fitted / "fit.json", "--validate", fitted / "record.csv"): "has no validation record",
        ("quickstart", "--record", fitted / "record.csv"): "--record and --validate go with a file",
    }
    for arguments, sentence in cases.items():
        stderr = ctid("report", *arguments, code=2).stderr
        assert sentence in stderr
        assert stderr.count("\n") == 1
    assert sorted(path for path in fitted.iterdir() if path.stem not in ("track", "frf")) == before
