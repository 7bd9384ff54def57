"""``ctid report``, and ``ctid figure`` of experiments: files, where they go, and what is refused."""

import pytest


def test_the_figure_of_an_experiment_goes_to_its_folder(ctid, done):
    shown = ctid("figure", "tiny", "--out", done).stdout.strip()
    assert shown == str(done / "tiny" / "figures" / "measure.svg")
    shown = ctid("figure", "tiny", "--kind", "convergence", "--measure", "rmse:delay", "--format", "pdf", "--out", done)
    assert shown.stdout.strip().endswith("figures/convergence_rmse-delay.pdf")


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
