"""Runs with data sets until the measures are precise enough."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from ctid_cli.inference import monte_carlo
from ctid_cli.inference.monte_carlo import wilson_interval
from ctid_cli.running import engine
from ctid_cli.running.engine import Progress, RunSummary, preview
from ctid_cli.running.limits import StopRequest
from ctid_cli.running.plan import Plan
from ctid_cli.running.states import cell_precisions
from ctid_cli.storage.estimates import read_stored
from tests.running.fakes import exported, run, toy_plan

UNTIL = {"until": {"percent_half_width": 13.0}, "at_most": 60}
#: First block of the runs below; short runs suffice for interruptions.
FEW = 20


@pytest.fixture(scope="module")
def small_blocks() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(monte_carlo, "AT_LEAST", FEW)
        yield


def plan(**options: Any) -> Plan:
    return toy_plan(levels=(1, 15.5), **({"precision": UNTIL} | options))


def sizes(place: Path) -> list[int]:
    return [cell["replicates"] for cell in read_stored(place).manifest["data_cells"]]


@pytest.fixture(scope="module")
def undisturbed(small_blocks: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("undisturbed") / "toys"
    summary = run(plan(), place, jobs=1)
    assert summary.exit_code == summary.missing == 0
    return place


def test_every_cell_gets_the_data_sets_it_needs(undisturbed: Path) -> None:
    stored = read_stored(undisturbed)
    first, second = cell_precisions(stored.manifest, stored.results)
    assert (first.state, second.state) == ("enough", "enough")
    assert sizes(undisturbed) == [first.needed, second.needed]
    assert first.needed > second.needed
    assert len(stored.results) == 3 * (first.needed + second.needed)
    # The interval used for the decision is that of the tables.
    rows = [row for row in stored.rows() if row["cell"] == first.cell]
    assert first.widest is not None
    hits = [row["converged"] for row in rows if (row["estimator"], row["start"]) == ("toy0", first.widest.start)]
    low, high = wilson_interval(sum(hits), len(hits))
    assert first.widest.half_width == 50 * (high - low) <= 13.0


def test_neither_workers_nor_interruptions_change_a_byte(
    tmp_path: Path, undisturbed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(engine, "COMMIT_SECONDS", 0.0)
    place = tmp_path / "toys"

    def interrupted(jobs: int, commits: int) -> RunSummary:
        request, seen = StopRequest(), 0

        def listen(progress: Progress) -> None:
            nonlocal seen
            seen += bool(progress.stored)
            if seen >= commits:
                request.request("stop")

        return run(plan(), place, jobs=jobs, stop=request, progress=listen)

    assert interrupted(jobs=1, commits=1).computed > 0
    # The next runs continue wherever the first run stopped.
    assert interrupted(jobs=2, commits=1).reused > 0
    interrupted(jobs=1, commits=20)
    summary = run(plan(), place)
    assert (summary.exit_code, summary.missing) == (0, 0)
    assert exported(place) == exported(undisturbed)
    # A further run has nothing to do.
    assert preview(plan(), place).estimates == 0
    assert run(plan(), place).computed == 0
    assert exported(place) == exported(undisturbed)


def test_a_cell_that_stays_imprecise_is_reported(small_blocks: None, tmp_path: Path) -> None:
    told: list[Progress] = []
    asked = plan(precision={"until": {"percent_half_width": 13.0, "rmse_relative": 0.04}, "at_most": 26})
    summary = run(asked, tmp_path, progress=told.append)
    assert summary.exit_code == 0
    assert [cell.state for cell in summary.precision] == ["at_most", "at_most"]
    assert sizes(tmp_path) == [26, 26]
    widest = [cell.widest for cell in summary.precision if cell.widest is not None]
    assert {(one.estimator, one.measure, one.parameter) for one in widest} == {("toy0", "rmse", "delay")}
    assert all(one.half_width is not None and one.half_width > 0.04 for one in widest)
    blocks = [each for each in told if each.precision]
    assert [[cell.needed for cell in each.precision] for each in blocks] == [[25, 25], [26, 26]]
    assert blocks[-1].total == 2 * 26
