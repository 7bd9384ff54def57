"""``ctid figure`` and ``ctid report``: their files; the content is tested elsewhere."""

from pathlib import Path
from xml.etree import ElementTree

import pytest

from ctid_cli.reporting.study import find_study


@pytest.mark.parametrize(
    ("command", "files"),
    [
        (
            "figure useful-redundancy/1 2",
            ["useful_redundancy_figures/figure_1.svg", "useful_redundancy_figures/figure_2.svg"],
        ),
        ("figure additive/2", ["additive_figures/figure_2.svg"]),
        ("figure 1 --file {out}/some/cost.svg", ["some/cost.svg"]),
    ],
)
def test_figures_of_studies(ctid, tmp_path, command, files):
    done = ctid(command.format(out=tmp_path), "--out", tmp_path)
    assert done.stdout.split() == [str(tmp_path / file) for file in files]
    assert sorted(path for path in tmp_path.rglob("*.*")) == [tmp_path / file for file in files]
    for file in files:
        assert ElementTree.parse(tmp_path / file).getroot().tag.endswith("svg")


def test_a_study_means_all_of_its_figures(ctid, tmp_path, monkeypatch):
    module = find_study("useful-redundancy").module("figures")
    for number in range(1, 8):
        monkeypatch.setattr(module, f"figure_{number}", lambda number=number: f"<svg>{number}</svg>".encode())
    done = ctid("figure useful-redundancy --out", tmp_path)
    assert [Path(file).read_text() for file in done.stdout.split()] == [f"<svg>{k}</svg>" for k in range(1, 8)]
    assert ctid("figure --out", tmp_path).stdout == done.stdout


def test_the_suffix_of_a_file_is_its_format(ctid, home, tmp_path):
    ctid("figure tiny --kind box --parameters a1,delay --file", tmp_path / "new" / "box.png")
    assert (tmp_path / "new" / "box.png").read_bytes().startswith(b"\x89PNG")


def test_the_page_of_a_study_has_its_tables_and_figures(ctid, tmp_path):
    path = tmp_path / "page.html"
    assert ctid("report useful-redundancy --out", tmp_path / "none", "--file", path).stdout == f"{path}\n"
    text = path.read_text(encoding="utf-8")
    assert text.count("<svg ") == 7
    assert "Table 4." in text
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize(
    ("command", "name"),
    [
        ("fit record.csv --poles 2 --zeros 0 --integrators 0 --delay 0.73 --report", "fit"),
        ("track tones.csv --tones 2", "track"),
    ],
)
def test_the_page_of_a_file_is_the_same_when_its_record_has_moved(ctid, home, tmp_path, command, name):
    record = tmp_path / command.split()[1]
    record.write_bytes(Path(record.name).read_bytes())
    ctid(command.replace(record.name, str(record)), "--out", tmp_path)
    page, stored = tmp_path / f"{name}.html", tmp_path / f"{name}.json"
    if name == "track":
        assert ctid("report", stored).stdout == f"{page}\n"
    first = page.read_text(encoding="utf-8")
    # Paths are relative to the folder of the file.
    assert f"ctid {name} {record.name}" in first
    record.rename(tmp_path / "moved.csv")
    said = ctid("report", stored, code=2).stderr
    assert f"{record.name} does not exist; say where it is now: --record FILE" in said
    ctid("report", stored, "--record", tmp_path / "moved.csv", "--file", tmp_path / "new" / "page.html")
    assert (tmp_path / "new" / "page.html").read_text(encoding="utf-8") == first
