"""Printed status of stored results: progress, precision, failures."""

from pathlib import Path

import pytest

from ctid_cli.inference.monte_carlo import CellPrecision, Widest
from ctid_cli.reporting.status_result import (
    MergeResult,
    Overview,
    StatusResult,
    VerificationResult,
    block_sentence,
    precision_sentence,
)
from ctid_cli.storage.merge import Merged
from ctid_cli.storage.status import ExperimentStatus, Finding, GroupStatus, Verification

RMSE = Widest("search", {"order": 2}, "3", "rmse", "delay", 0.0812, 0.05)


def percentage(half_width):
    return Widest("search", {}, "none", "percent", None, half_width, 1.0)


def cell(state="enough", level=5.0, needed=613, widest=None):
    return CellPrecision("c", {"snr_db": level}, state, needed if state != "open" else 490, needed, widest)


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


def test_the_status_of_an_experiment(make_results, estimate, snapshot):
    found = [estimate(0, "FAILED")] * 11 + [estimate(8.0)]
    results = make_results({(5.0, "0.0"): found})
    for data_cell in results.manifest["data_cells"]:
        data_cell["replicates"] = 12
    cells = [cell(widest=percentage(0.9)), cell("open", 15.0), cell("at_most", 20.0, widest=RMSE)]
    result = StatusResult(progress(), Path("other"), results.stored, cells)
    assert result.summary() == snapshot
    content = result.content()
    assert [(one["status"], one["reason"], one["estimates"]) for one in content["outcomes"]] == [
        ("FAILED", "ValueError: singular", 11),
        ("CONVERGED", "", 1),
    ]
    assert (content["todo"], content["precision"][1]["needed"]) == (18, 613)


def test_the_overview_of_all_experiments(snapshot):
    running = {"pid": 7, "host": "h", "done": 3, "total": 10}
    found = [
        progress(experiment="unfinished", left_aside=None, mixed=False),
        progress(experiment="running", running=running, mixed=False),
        progress(experiment="mixed", done=30),
        progress(experiment="part", shard=(2, 3), running={"pid": None}),
    ]
    text = Overview([StatusResult(one, Path("out")) for one in found], Path("out")).summary()
    assert [text, Overview([], Path("out")).summary()] == snapshot


@pytest.mark.parametrize("intact", [True, False])
def test_a_verification_names_every_file(intact, snapshot):
    findings = (Finding("journal.sqlite", "intact", "12 of 12 estimates"), Finding("runs.h5", "damaged", "it is not"))
    result = VerificationResult(Verification(Path("out/a/e"), findings[: 2 - intact]), Path("out"))
    assert [result.summary(), result.content()] == snapshot


def test_a_merge_says_what_is_missing(snapshot):
    merged = Merged("e", Path("out/e"), 3, 12, 10, 4, True, "abc", "shard 3 of 3 is missing")
    assert MergeResult(merged, Path("out")).summary() == snapshot


def test_what_a_block_and_a_run_have_brought():
    open_, missed = cell("open", 20.0, widest=RMSE), cell("at_most", 15.0, 5000, percentage(1.1))
    assert block_sentence([cell(), open_]) == "1 of 2 data cells need more data sets, up to 613"
    assert precision_sentence([]) == precision_sentence([cell(), open_]) == ""
    narrow = "200 to 613 data sets in each data cell: all intervals are as narrow as requested"
    assert precision_sentence([cell(needed=200), cell()]) == narrow
    assert precision_sentence([cell(), missed]).startswith("1 of 2 data cells ended at 5000 data sets with wider")
