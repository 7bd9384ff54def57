"""Shards: what several runs compute that know nothing of each other, merged, is what one run computes."""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from ctid_cli.errors import DamageError, RefusedError, UsageError
from ctid_cli.reporting.overview import overview_text, status_text
from ctid_cli.running.engine import preview, run_experiment
from ctid_cli.running.plan import build_plan
from ctid_cli.specification.load import load_spec
from ctid_cli.storage.columns import failed
from ctid_cli.storage.journal_reader import read_journal
from ctid_cli.storage.manifest import slots
from ctid_cli.storage.merge import Source, find_sources, merge, merge_all, read_source
from ctid_cli.storage.shards import Shard
from ctid_cli.storage.store import experiment_status, load_estimates
from tests.running.fakes import FakePlan
from tests.running.run_toys import plan

ROOT = Path(__file__).resolve().parents[2]
SPEC = """\
experiment: sharded
system:      {numerator: [2], denominator: [1, 2]}
excitation:  {kind: prbs, stages: 6, clock_period: 0.2, amplitude: 1.0}
sampling:    {kind: regular, interval: 0.1, samples: 200}
noise:       {kind: white, snr_db: [5, 15]}
estimators:  {svf: {kind: svf, poles: 1, zeros: 0}}
monte_carlo: {runs: 5, seed: 1}
"""


def run(toys: FakePlan, place: Path) -> Path:
    run_experiment(toys, place, jobs=1, warm=lambda plan: None)  # type: ignore[arg-type]
    return place


def files(place: Path) -> dict[str, str]:
    return {str(p): hashlib.sha256(p.read_bytes()).hexdigest() for p in sorted(place.rglob("*")) if p.is_file()}


def joined(places: list[Path], target: Path, **options: bool) -> bytes:
    merge(map(read_source, places), target, **options)
    return (target / "runs.h5").read_bytes()


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run(FakePlan(), tmp_path_factory.mktemp("whole") / "toys")


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    place = tmp_path_factory.mktemp("parts")
    return [run(FakePlan().part(k, 3), place / f"toys.shard-{k}-of-3") for k in (1, 2, 3)]


def test_shards_merged_in_any_order_are_one_run(whole: Path, parts: list[Path], tmp_path: Path) -> None:
    before = files(parts[0].parent)
    merged = [joined(list(order), tmp_path / str(k)) for k, order in enumerate(itertools.permutations(parts))]
    assert set(merged) == {(whole / "runs.h5").read_bytes()}
    assert files(parts[0].parent) == before
    again = run_experiment(FakePlan(), tmp_path / "0", jobs=1)  # type: ignore[arg-type]
    assert (again.reused, again.computed) == (36, 0)


def test_rows_keep_their_times_and_the_runs_they_come_from(parts: list[Path], tmp_path: Path) -> None:
    joined(parts[::-1], tmp_path / "toys")
    with read_journal(tmp_path / "toys" / "journal.sqlite") as log:
        assert log is not None
        merged, sessions, origins = log.entries(), log.sessions(), log.known_origins()
    for number, part in enumerate(parts, start=1):
        source = read_source(part)
        for key, entry in source.entries.items():
            assert (merged[key].result, merged[key].seconds) == (entry.result, entry.seconds)
            assert (merged[key].session, origins[merged[key].origin]) == (number, source.origin_of(entry))
    assert [session["session"] for session in sessions] == [1, 2, 3]
    notes = [json.loads(file.read_text()) for file in sorted((tmp_path / "toys" / "provenance").iterdir())]
    assert [(note["session"], note["computed"]) for note in notes] == [(1, 12), (2, 12), (3, 12)]
    assert (tmp_path / "toys" / "spec.yaml").read_text() == "# toys\n"


def test_a_shard_counts_its_own_estimates(parts: list[Path]) -> None:
    status = experiment_status(parts[1])
    assert (status.planned, status.done, status.left_aside) == (12, 12, 0)
    assert "shard 2/3 of toys" in overview_text([status])
    assert status_text(status, [], parts[1].parent).startswith(f"shard 2/3 of toys in {parts[1]}: 12 of 12")
    assert "ctid table toys.shard-2-of-3 " in status_text(status, [], parts[1].parent)
    assert len(load_estimates(parts[1])) == 12


def test_what_is_missing_is_named_and_can_be_left_out(parts: list[Path], whole: Path, tmp_path: Path) -> None:
    target = tmp_path / "toys"
    with pytest.raises(RefusedError, match=r"toys: shards 1,3 of 3 are not among the folders \(24 estimates\)"):
        joined([parts[1]], target)
    assert not target.exists()
    joined([parts[1]], target, partial=True)
    assert experiment_status(target).done == 12
    # The rest comes by a later merge, or by a run.
    assert joined([parts[0], parts[2]], target) == (whole / "runs.h5").read_bytes()


def test_an_unfinished_shard_is_named(parts: list[Path], tmp_path: Path) -> None:
    one, *others = (read_source(part) for part in parts)
    some = dict(list(one.entries.items())[3:])
    with pytest.raises(RefusedError, match="shard 1 of 3 lacks 3 estimates, which the same 'ctid run' again"):
        merge([*others, replace(one, entries=some)], tmp_path / "toys")


def test_shards_without_data_sets_are_not_missed(tmp_path: Path) -> None:
    toys = FakePlan(runs=1, levels=(5,))
    assert preview(toys.part(3, 3), tmp_path / "3").estimates == 0  # type: ignore[arg-type]
    empty = run(toys.part(3, 3), tmp_path / "3")
    one = run(toys.part(1, 3), tmp_path / "1")
    alone = run(toys, tmp_path / "whole")
    assert joined([empty, one], tmp_path / "toys") == (alone / "runs.h5").read_bytes()


def test_the_same_estimate_twice_counts_once(parts: list[Path], whole: Path, tmp_path: Path) -> None:
    assert joined([*parts, whole], tmp_path / "toys") == (whole / "runs.h5").read_bytes()


def limited(source: Source, status: str, **limits: float) -> Source:
    """The same shard, as if its first estimate had exceeded one of these limits."""
    (key, entry), *_ = source.entries.items()
    result = failed(f"under {sorted(limits.items())}", status)
    sessions = [{**session, "limits": limits} for session in source.sessions]
    return replace(
        source, entries={**source.entries, key: entry._replace(result=json.dumps(result))}, sessions=sessions
    )


def test_a_result_is_better_than_a_limit_and_a_high_limit_better_than_a_low_one(
    parts: list[Path], whole: Path, tmp_path: Path
) -> None:
    one, *others = (read_source(part) for part in parts)
    low = limited(one, "TIMEOUT", wall_seconds=1, cpu_seconds=9)
    high = limited(one, "TIMEOUT", wall_seconds=2, cpu_seconds=1)
    for number, order in enumerate(itertools.permutations([low, one, high])):
        merge([*order, *others], tmp_path / f"{number}")
        assert (tmp_path / f"{number}" / "runs.h5").read_bytes() == (whole / "runs.h5").read_bytes()
    for number, order in enumerate([[low, high], [high, low]]):
        merge([*order, *others], tmp_path / "limited" / f"{number}")
        assert set(load_estimates(tmp_path / "limited" / f"{number}")["message"]) > {
            "under [('cpu_seconds', 1), ('wall_seconds', 2)]"
        }
    # What is there already is replaced too.
    again = merge([one], tmp_path / "limited" / "0")
    assert (again.new, again.missing) == (1, ())
    assert (tmp_path / "limited" / "0" / "runs.h5").read_bytes() == (whole / "runs.h5").read_bytes()


def test_two_results_of_one_estimate_are_refused(parts: list[Path], tmp_path: Path) -> None:
    sources = [read_source(part) for part in parts]
    copy = read_source(parts[0])
    (key, entry), *_ = copy.entries.items()
    entries = {**copy.entries, key: entry._replace(result=json.dumps(entry.content | {"delay": 1.0}))}
    copy = replace(copy, entries=entries)
    with pytest.raises(RefusedError, match=f"estimate {key.id} is one thing in .* and another in"):
        merge([*sources, copy], tmp_path / "toys")
    assert not (tmp_path / "toys").exists()


def test_other_specifications_are_refused(parts: list[Path], tmp_path: Path) -> None:
    other = run(FakePlan(runs=7).part(2, 3), tmp_path / "other")
    with pytest.raises(RefusedError, match=r"of different specifications \(monte_carlo differ\)"):
        joined([parts[0], other], tmp_path / "toys")


def test_other_code_or_processors_are_refused_unless_they_may_be_mixed(
    tmp_path: Path, parts: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ctid_cli.storage.identity.numeric_platform", lambda: "abacus")
    other = run(FakePlan().part(3, 3), tmp_path / "other")
    with pytest.raises(RefusedError, match=r"other code or arithmetic \(numeric platform .* and 'abacus'\)"):
        joined([*parts[:2], other], tmp_path / "toys")
    assert not (tmp_path / "toys").exists()
    assert merge(map(read_source, [*parts[:2], other]), tmp_path / "toys", allow_mixed=True).mixed


def test_a_folder_of_another_experiment_is_refused(parts: list[Path], tmp_path: Path) -> None:
    other = run(FakePlan(experiment="other"), tmp_path / "toys")
    with pytest.raises(RefusedError, match="holds the experiment 'other', not 'toys'"):
        joined(parts, other)


def test_folders_are_found_below_others(parts: list[Path], tmp_path: Path) -> None:
    assert find_sources([parts[0].parent, parts[1]]) == parts
    with pytest.raises(UsageError, match="no results of shards in"):
        find_sources([tmp_path])
    (merged,) = merge_all(parts, tmp_path)
    assert (merged.folder, merged.stored, merged.new) == (tmp_path / "toys", 36, 36)


def test_a_name_cannot_lead_out_of_the_results_folder(tmp_path: Path) -> None:
    with pytest.raises(DamageError, match="a name that none may have"):
        run(FakePlan(experiment="../evil"), tmp_path / "in" / "shard")
    with pytest.raises(DamageError, match="a name that none may have"):
        list(merge_all([tmp_path / "in" / "shard"], tmp_path / "in"))


def test_a_killed_shard_goes_on_and_merges(tmp_path: Path) -> None:
    def start(number: int) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "tests.running.run_toys", str(tmp_path / f"{number}"), "1"]
        more = [f"--shard={number}/3", "--runs=6"]
        return subprocess.Popen([*command, *more], cwd=ROOT, stdout=subprocess.PIPE, text=True, start_new_session=True)

    shards = {number: start(number) for number in (1, 2, 3)}
    first = shards[2].stdout
    assert first is not None
    assert first.readline() == "ready\n"
    assert first.readline()
    os.killpg(shards[2].pid, signal.SIGKILL)
    shards[2].communicate()
    shards[2] = start(2)
    for process in shards.values():
        process.communicate(timeout=300)
        assert process.returncode == 0
    alone = run(plan(runs=6), tmp_path / "alone")
    assert joined([tmp_path / "3", tmp_path / "1", tmp_path / "2"], tmp_path / "all") == (
        (alone / "runs.h5").read_bytes()
    )


# Real plans


def test_shards_of_a_plan_are_its_data_sets(tmp_path: Path) -> None:
    (tmp_path / "spec.yaml").write_text(SPEC, encoding="utf-8")
    full = build_plan(load_spec(tmp_path / "spec.yaml"))
    shards = [full.part(Shard(number, 3)) for number in (1, 2, 3)]
    dealt = [{key for task in shard.tasks() for key, _, _ in shard.keys(task)} for shard in shards]
    assert [{slot.key for slot in slots(shard.manifest())} for shard in shards] == dealt
    assert set().union(*dealt) == {slot.key for slot in slots(full.manifest())}
    assert sum(map(len, dealt)) == 10


def test_a_precision_cannot_be_reached_by_shards(tmp_path: Path) -> None:
    text = SPEC.replace("runs: 5", "until: {rmse_relative: 0.1}, at_most: 400")
    (tmp_path / "spec.yaml").write_text(text, encoding="utf-8")
    spec = load_spec(tmp_path / "spec.yaml")
    with pytest.raises(UsageError, match=r"decides on all data sets together.* --runs 400"):
        build_plan(spec).part(Shard(1, 3))
    assert len(build_plan(spec, runs=6).part(Shard(1, 3)).tasks()) == 4
