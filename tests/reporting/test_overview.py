from pathlib import Path

from ctid_cli.reporting.overview import overview_text, status_text
from ctid_cli.storage.status import ExperimentStatus, GroupStatus


def progress(**changes):
    values = {
        "experiment": "e",
        "folder": Path("results/e"),
        "planned": 30,
        "done": 12,
        "failed": 11,
        "left_aside": 5,
        "mixed": True,
        "running": None,
        "groups": (GroupStatus(30, 12, 11, "existing", "c", {"snr_db": 5.0}),),
    }
    return ExperimentStatus(**(values | changes))


def test_failures_are_listed_with_their_reason_but_not_without_end(estimate):
    rows = [{"id": f"{k:012d}", "estimator": "existing", "replicate": k, "start": "0.0"} for k in range(12)]
    estimates = [row | estimate(0, "FAILED") for row in rows[:11]] + [rows[11] | estimate(8.0)]
    text = status_text(progress(), estimates, Path("other"))
    assert "12 of 30 estimates done (unfinished; mixes code versions or processors)" in text
    assert "000000000003  existing, replicate 3, start 0.0: ValueError: singular" in text
    assert "svf.py" not in text
    assert "and 1 more" in text
    assert "11 FAILED" in text
    assert "1 CONVERGED: converged" in text
    assert "5 stored estimates are set aside" in text
    assert "ctid table e --out other" in text


def test_a_run_that_goes_on_is_not_called_unfinished():
    running = {"pid": 7, "host": "h", "done": 3, "total": 10}
    text = overview_text([progress(running=running, mixed=False)])
    assert "running now: process 7 on h, 3 of 10 data sets" in text
    assert "unfinished" not in text


def test_counts_stand_under_their_titles():
    header, _, row = overview_text([progress(left_aside=None, mixed=False)]).splitlines()
    assert header.split() == ["experiment", "done", "planned", "failed", "set", "aside"]
    assert row.split() == ["e", "12", "30", "11", "-", "unfinished"]
