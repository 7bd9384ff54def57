"""Merging: shards in any order equal one run; conflicts are named, and then nothing is written."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Iterable
from pathlib import Path

import pytest

from ctid_cli.errors import DamageError, RefusedError, UsageError
from ctid_cli.reporting.status_result import Overview, StatusResult
from ctid_cli.storage.columns import failed
from ctid_cli.storage.estimates import read_estimates
from ctid_cli.storage.journal import open_journal, read_journal
from ctid_cli.storage.manifest import Manifest, Shard
from ctid_cli.storage.merge import find_sources, merge, merge_all
from ctid_cli.storage.status import experiment_status
from tests.storage.made_results import ORIGIN, outcomes_of, plan_of, run_folder

PLAN = plan_of(6)


def shard(number: int) -> Manifest:
    return PLAN.part(Shard(number, 3)).manifest()


def files(place: Path) -> dict[str, str]:
    return {str(p): hashlib.sha256(p.read_bytes()).hexdigest() for p in sorted(place.rglob("*")) if p.is_file()}


def joined(places: Iterable[Path], target: Path, **options: bool) -> bytes:
    merge(places, target, **options)
    return (target / "runs.h5").read_bytes()


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run_folder(PLAN.manifest(), tmp_path_factory.mktemp("whole") / "toys")


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    place = tmp_path_factory.mktemp("parts")
    return [run_folder(shard(k), place / f"toys.shard-{k}-of-3") for k in (1, 2, 3)]


def test_shards_merged_in_any_order_are_one_run(whole: Path, parts: list[Path], tmp_path: Path) -> None:
    before = files(parts[0].parent)
    merged = [joined(order, tmp_path / str(k)) for k, order in enumerate(itertools.permutations(parts))]
    assert set(merged) == {(whole / "runs.h5").read_bytes()}
    assert files(parts[0].parent) == before
    assert joined([*parts, whole], tmp_path / "twice") == merged[0]
    with read_journal(tmp_path / "3" / "journal.sqlite") as log:
        assert log is not None
        sessions = [(session.started, session.stopped, session.reason) for session in log.sessions()]
        assert sessions == [(f"began {part.name}", "ended", "finished") for part in parts]
        assert sum(log.counts().values()) == 36
        assert {session for session, _ in log.counts()} == {session.id for session in log.sessions()}
        assert {row.seconds for row in log.rows()} == {0.25}
    assert (tmp_path / "3" / "spec.yaml").read_text() == "# toys\n"


def test_a_shard_counts_its_own_estimates(parts: list[Path]) -> None:
    status = experiment_status(parts[1])
    assert (status.planned, status.done, status.left_aside) == (12, 12, 0)
    result = StatusResult(status, parts[1].parent)
    assert "shard 2/3 of toys" in Overview([result], parts[1].parent).summary()
    assert result.summary().startswith(f"shard 2/3 of toys in {parts[1]}: 12 of 12")
    assert len(read_estimates(parts[1])) == 12


def test_what_is_missing_is_named_and_can_be_left_out(parts: list[Path], whole: Path, tmp_path: Path) -> None:
    target = tmp_path / "toys"
    with pytest.raises(RefusedError, match="toys: 24 estimates of shards 1,3 of 3 are missing: give their folders too"):
        merge([parts[1]], target)
    assert not target.exists()
    merge([parts[1]], target, partial=True)
    assert experiment_status(target).done == 12
    before = files(target)
    with pytest.raises(RefusedError, match="12 estimates of shard 3 of 3 are missing"):
        merge([parts[0]], target)
    assert files(target) == before
    # The rest is added by a later merge, or by a run.
    assert joined([parts[0], parts[2]], target) == (whole / "runs.h5").read_bytes()
    unfinished = run_folder(shard(1), tmp_path / "unfinished", outcomes_of(shard(1))[3:])
    with pytest.raises(RefusedError, match="3 estimates of shard 1 of 3 are missing"):
        merge([*parts[1:], unfinished], tmp_path / "other")


def test_a_result_is_better_than_a_limit_and_a_high_limit_better_than_a_low_one(
    parts: list[Path], whole: Path, tmp_path: Path
) -> None:
    def limited(name: str, **limits: float) -> Path:
        first, *others = outcomes_of(shard(1))
        stopped = first._replace(result=failed(f"under {limits['wall_seconds']} s", "TIMEOUT"))
        return run_folder(shard(1), tmp_path / name, [stopped, *others], limits=limits)

    low, high = limited("low", wall_seconds=1, cpu_seconds=9), limited("high", wall_seconds=2, cpu_seconds=1)
    for number, order in enumerate(itertools.permutations([low, parts[0], high])):
        assert joined([*order, *parts[1:]], tmp_path / f"{number}") == (whole / "runs.h5").read_bytes()
    for number, order in enumerate([[low, high], [high, low]]):
        merge([*order, *parts[1:]], tmp_path / "limited" / f"{number}")
        assert "under 2 s" in set(read_estimates(tmp_path / "limited" / f"{number}")["message"])
    # Existing estimates are replaced too.
    again = merge([parts[0]], tmp_path / "limited" / "0")
    assert (again.new, again.missing) == (1, "")
    assert (tmp_path / "limited" / "0" / "runs.h5").read_bytes() == (whole / "runs.h5").read_bytes()


def test_two_results_of_one_estimate_are_named_and_nothing_is_written(parts: list[Path], tmp_path: Path) -> None:
    *others, one, two = outcomes_of(shard(1))
    changed = [outcome._replace(result=outcome.result | {"delay": 1.0}) for outcome in (one, two)]
    copy = run_folder(shard(1), tmp_path / "copy", [*others, *changed])
    target = run_folder(shard(2) | {"shard": [2, 3]}, tmp_path / "toys")
    before = files(target)
    with pytest.raises(RefusedError, match=r"differs between .* and .*; 1 more differ too") as refused:
        merge([*parts, copy], target)
    assert all(outcome.key.id in str(refused.value) for outcome in changed)
    assert files(target) == before


def test_what_does_not_belong_together_is_refused(parts: list[Path], tmp_path: Path) -> None:
    target = tmp_path / "toys"
    other = run_folder(plan_of(7).part(Shard(2, 3)).manifest(), tmp_path / "other")
    with pytest.raises(RefusedError, match=r"of different specifications \(monte_carlo differ\)"):
        merge([parts[0], other], target)
    abacus = run_folder(shard(3), tmp_path / "abacus", origin=ORIGIN._replace(platform="abacus"))
    with pytest.raises(RefusedError, match=r"other code or arithmetic \(numeric platform .* 'abacus' here\)"):
        merge([*parts[:2], abacus], target)
    assert not target.exists()
    assert merge([*parts[:2], abacus], target, allow_mixed=True).mixed
    another = run_folder(plan_of(6, experiment="another").manifest(), tmp_path / "another")
    with pytest.raises(RefusedError, match="holds the experiment 'another'"):
        merge(parts, another)


def test_folders_are_found_below_others(parts: list[Path], tmp_path: Path) -> None:
    assert find_sources([parts[0].parent, parts[1]]) == parts
    with pytest.raises(UsageError, match="no results of shards in"):
        find_sources([tmp_path])
    (merged,) = merge_all(parts, tmp_path)
    assert (merged.folder, merged.stored, merged.new) == (tmp_path / "toys", 36, 36)
    with pytest.raises(UsageError, match="nothing to merge"):
        merge([merged.folder], merged.folder)


def test_a_name_cannot_lead_out_of_the_results_folder(tmp_path: Path) -> None:
    place = tmp_path / "in"
    place.mkdir()
    log = open_journal(place / "journal.sqlite")
    log.begin(PLAN.manifest() | {"experiment": "../evil"}, ORIGIN, "now", {})
    log.close()
    with pytest.raises(DamageError, match="a name that none may have"):
        list(merge_all([place], tmp_path))
