"""``ctid table --measure`` and ``--compare``."""

import csv
import io
import json


def rows(ctid, done, *arguments):
    return json.loads(ctid("table", "tiny", *arguments, "--format", "json", "--out", done).stdout)


def test_measures_in_every_form(ctid, done):
    found = rows(ctid, done, "--measure", "bias,rmse,coverage,percent")
    # Two noise levels and three of estimators and starts; `known` does not estimate the delay.
    assert len(found) == 2 * ((3 + 3 + 2) * 3 + 3)
    assert {row["parameter"] for row in found if row["method"] == "known"} == {"a1", "b0", None}
    printed = ctid("table", "tiny", "--measure", "rmse", "--format", "csv", "--out", done).stdout
    values = [row["value"] for row in found if row["measure"] == "rmse"]
    assert [float(row["value"]) for row in csv.DictReader(io.StringIO(printed))] == values
    for style, beginning in {"text": "tiny\n", "md": "### tiny\n", "latex": "% tiny\n"}.items():
        shown = ctid(*["table", "tiny", "--measure", "rmse,cpu", "--format"], style, "--out", done).stdout
        assert shown.startswith(beginning)
        assert shown.count("coverage") == 0
    assert shown.count(r"\toprule") == shown.count(r"\end{tabular}") == 2
    assert r"20 dB & 0.3 s & search & a1 &" in shown
    assert r" $\pm$ " in shown


def test_processor_times_are_stored_and_shown(ctid, done):
    for row in rows(ctid, done):
        assert 0 < row["median_cpu_seconds"] < 60
    for row in rows(ctid, done, "--measure", "cpu"):
        assert row["value"] > 0


def test_what_cannot_be_answered_is_said(ctid, done):
    def error(*arguments):
        return ctid(*arguments, "--out", done, code=2).stderr

    assert "did you mean 'coverage'?" in error("table", "tiny", "--measure", "coverge")
    assert "--measure needs the name of an experiment" in error("table", "--measure", "bias")
    assert "no results of 'tinny'" in error("table", "tinny", "--compare", "search,known")
    assert "fewer than 5 data sets in common" in error("table", "tiny", "--compare", "search,known")
    assert "exclude each other" in error("table", "tiny", "--compare", "search,known", "--measure", "bias")
