"""What becomes of losses, with an executor that is told what happens to which estimate."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Callable
from typing import Any

import pytest

from ctid_cli.running import dispatch
from ctid_cli.running.dispatch import GivenUp, Slow, Unable, run_jobs
from ctid_cli.running.events import WorkerDied
from ctid_cli.running.executor import Begun, Computed, Done, Hindered, Lost, Message
from ctid_cli.running.job import Job
from ctid_cli.running.retry import Stock
from ctid_cli.running.todo import Todo
from ctid_cli.storage.columns import no_result
from ctid_cli.storage.manifest import Key, Outcome
from tests.running.fakes import FakePlan


class Scripted:
    """Computes the estimates of a job in their order, but for those to which something happens."""

    def __init__(self, room: int, **fates: list[Any]) -> None:
        self._size = room
        #: What happens to estimates by replicate and start, one after the other.
        self.fates = defaultdict(deque[Any], {name: deque(fate) for name, fate in fates.items()})
        self.jobs: list[Job] = []
        #: Starts of each job that was taken, whether it was to be alone, and how many others were at work.
        self.taken: list[tuple[list[str], bool, int]] = []
        self.stopped = False

    @property
    def room(self) -> int:
        return self._size - len(self.jobs)

    def submit(self, job: Job, *, alone: bool = False) -> None:
        self.taken.append(([name(key) for key in job.keys], alone, len(self.jobs)))
        self.jobs.append(job)

    def collect(self, seconds: float) -> list[Message]:
        return list(self._all()) if self.jobs else []

    def _all(self) -> Any:
        job = self.jobs.pop(0)
        for key in job.keys:
            fate = self.fates[name(key)].popleft() if self.fates[name(key)] else None
            if isinstance(fate, Lost):
                yield Lost(job, fate.cause, fate.reason, [key])
                return
            yield Hindered(job, [key], fate) if fate else Computed(job, [Outcome(key, no_result(), 0.1)])
        yield Done(job)

    def stop(self) -> None:
        self.stopped = True

    def close(self) -> None:
        """Nothing is kept."""


def name(key: Key) -> str:
    return f"r{key.replicate}_{key.start[:1]}"


def lost(cause: Any, reason: str = "why") -> Lost:
    return Lost(None, cause, reason)  # type: ignore[arg-type]


def run(executor: Any, runs: int = 3, stopping: Callable[[], bool] = lambda: False) -> tuple[dict[str, Any], list[Any]]:
    """Status of every estimate that became a result, and other events."""
    plan: Any = FakePlan(levels=(5,), runs=runs)
    found, others = {}, []
    for event in run_jobs(Todo(plan, Stock()).jobs(), executor, stopping):
        if isinstance(event, Computed):
            for outcome in event.outcomes:
                assert name(outcome.key) not in found, "every estimate is handed over once"
                found[name(outcome.key)] = outcome.result["status"]
        elif event is not None:
            others.append(event)
    return found, others


EVERY = {f"r{replicate}_{start}" for replicate in range(3) for start in "3un"}


@pytest.mark.parametrize("room", [1, 2, 5])
def test_what_exceeds_a_limit_is_stored_and_the_rest_goes_on(room: int) -> None:
    found, others = run(Scripted(room, r0_u=[lost("time")], r1_3=[lost("memory")]))
    assert found.keys() == EVERY
    assert {key: status for key, status in found.items() if status} == {"r0_u": "TIMEOUT", "r1_3": "MEMORY"}
    assert others == []


def test_a_death_counts_when_it_comes_again_alone() -> None:
    executor = Scripted(2, r0_u=[lost("crash"), lost("crash", "SIGSEGV")], r1_3=[lost("crash")])
    found, others = run(executor)
    assert found.keys() == EVERY
    assert {key for key, status in found.items() if status} == {"r0_u"}
    assert others == [WorkerDied(1, "why")] * 2
    assert (["r0_u"], True) in [(starts, alone) for starts, alone, _ in executor.taken]
    assert all(len(starts) == 1 for starts, alone, _ in executor.taken if alone)


def test_what_the_machine_does_is_tried_last_with_the_machine_to_itself() -> None:
    executor = Scripted(3, r0_u=[lost("machine")], r0_n=["no memory", "no memory"], r2_3=[lost("chance")])
    found, others = run(executor)
    assert found.keys() == EVERY - {"r0_n"}
    assert not any(found.values())
    assert [event.keys[0].start for event in others if isinstance(event, GivenUp)] == ["none"]
    assert [starts for starts, _, _ in executor.taken[-2:]] == [["r0_n"], ["r0_u"]] or [
        starts for starts, _, _ in executor.taken[-2:]
    ] == [["r0_u"], ["r0_n"]]
    assert [others_at_work for _, _, others_at_work in executor.taken[-2:]] == [0, 0]


@pytest.mark.parametrize("what", [lost("machine", "no files"), "no files"])
def test_where_nothing_succeeds_the_run_ends(what: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dispatch, "PAUSE", 0.0)
    executor = Scripted(1, **{key: [what] * 9 for key in (f"r{k}_{start}" for k in range(30) for start in "3un")})
    found, others = run(executor, runs=30)
    assert found == {}
    assert others[-1] == Unable("no files")
    assert len(executor.taken) <= 2 * dispatch.PATIENCE


def test_a_stop_abandons_what_takes_long(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dispatch, "DRAIN", 0.02)
    monkeypatch.setattr(dispatch, "SLOW", 0.01)

    class Stuck(Scripted):
        """Begins the first job, and keeps the second one ready."""

        def collect(self, seconds: float) -> list[Message]:
            dispatch.time.sleep(0.005)
            begun, self.fates = self.fates, None
            return [] if begun is None else [Begun(self.jobs[0])]

    executor, asked = Stuck(2), iter([False] * 12)
    found, others = run(executor, stopping=lambda: next(asked, True))
    assert executor.stopped
    assert found == {}
    assert {type(event) for event in others} == {Slow}
    assert {event.key.replicate for event in others} == {0}, "nobody waits for what is only kept ready"
