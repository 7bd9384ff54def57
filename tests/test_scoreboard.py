"""The scoreboard page equals the output of its script, as far as it is read from committed results."""

from pathlib import Path

import pytest

from benchmarks import scoreboard

PAGE = (Path(__file__).resolve().parents[1] / "docs" / "scoreboard.md").read_text(encoding="utf-8")


def test_rows_of_published_studies_are_current():
    for row in scoreboard.useful_redundancy() + scoreboard.studies():
        assert "| " + " | ".join(row) + " |\n" in PAGE


@pytest.mark.parametrize("section", [scoreboard.dryer, scoreboard.silverbox])
def test_records_that_are_missing_or_changed_are_not_run(section, tmp_path, monkeypatch):
    monkeypatch.delenv("CTID_DATA", raising=False)
    [missing] = scoreboard.rows_of(section)
    assert missing.ctid.startswith("not run: no ")
    monkeypatch.setenv("CTID_DATA", str(tmp_path))
    for name in scoreboard.RECORDS:
        (tmp_path / name).write_text("t,u,y\n0,1,2\n")
    [changed] = scoreboard.rows_of(section)
    assert changed.ctid.endswith("has another SHA-256")


def test_every_comparison_names_its_source():
    rows = [line.strip("| ").split(" | ") for line in PAGE.splitlines() if line.startswith("| ")]
    assert len(rows) > 20
    assert all(len(row) == 5 and all(row) for row in rows)
