"""From jobs to results, whatever happens to the processes that compute them.

Whose fault a loss is decides what becomes of it. What exceeded a limit is its estimator's failure. So is the death of a
process, where it dies again of the same estimate alone, as the first one may have died of what was computed in it
before. What the machine did (out of memory, no more descriptors, a process killed from outside) is never a result: such
estimates are computed once more when all others are done, each with the machine to itself, and are then given up.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

from ctid_cli.running.events import WorkerDied
from ctid_cli.running.executor import Begun, Computed, Done, Executor, Hindered, Lost, Message
from ctid_cli.running.job import Job
from ctid_cli.running.job_order import JobQueue
from ctid_cli.storage.columns import failed
from ctid_cli.storage.manifest import Key, Outcome

#: How often the caller gets a chance to do something else while nothing is finished [s].
TICK = 0.05
#: How long running jobs may go on after a request to stop [s].
DRAIN = 1.0
#: After so many misfortunes for each job at work, without a single finished estimate in between, the machine is not
#: fit to go on; with nothing at work, the next attempt waits the longer the more there were, up to a limit [s].
PATIENCE = 4
PAUSE, LONGEST_PAUSE = 0.2, 1.0
#: An estimate that takes so long is mentioned, and again after twice the time [s].
SLOW = 600.0


@dataclass(frozen=True)
class GivenUp:
    """Estimates that the machine did not let finish twice."""

    keys: Sequence[Key]
    reason: str


@dataclass(frozen=True)
class Slow:
    """An estimate that has been at work for long."""

    key: Key
    seconds: float


@dataclass(frozen=True)
class Unable:
    """Nothing can be computed here any more."""

    reason: str


Event = Computed | WorkerDied | GivenUp | Slow | Unable | None


def run_jobs(jobs: Iterable[Job], executor: Executor, stopping: Callable[[], bool]) -> Iterator[Event]:
    """Run jobs; None comes now and then."""
    return _Dispatch(jobs, executor, stopping).run()


@dataclass
class _Work:
    """A job in work, or kept ready."""

    job: Job
    #: Its estimates that are still to come, in their order.
    left: list[Key]
    #: Since when the first of them has been in work [s], and how often that was mentioned.
    since: float = math.inf
    mentioned: int = 0

    def take_off(self, keys: Iterable[Key]) -> None:
        """Note that the next estimate is in work, and that some need not be waited for any more."""
        gone = set(keys)
        self.left = [key for key in self.left if key not in gone]
        self.since, self.mentioned = time.monotonic(), 0


class _Dispatch:
    def __init__(self, jobs: Iterable[Job], executor: Executor, stopping: Callable[[], bool]) -> None:
        self._executor, self._stopping = executor, stopping
        self._waiting = JobQueue(jobs)
        #: What is left of lost jobs; single estimates to be tried alone, and when all else is done.
        self._again: deque[Job] = deque()
        self._alone: deque[Job] = deque()
        self._last: deque[Job] = deque()
        self._running: dict[int, _Work] = {}
        self._most = 1
        self._suspected: set[Key] = set()
        self._hindered: set[Key] = set()
        self._misfortunes = 0

    def run(self) -> Iterator[Event]:
        while not self._stopping() and self._misfortunes < PATIENCE * self._most:
            if not self._running:
                time.sleep(min(PAUSE * self._misfortunes, LONGEST_PAUSE))
            self._submit()
            if not self._running:
                return
            yield None
            for message in self._executor.collect(TICK):
                yield from self._take(message)
            yield from self._slow()
        if self._misfortunes >= PATIENCE * self._most:
            yield Unable(self._reason)
        deadline = time.monotonic() + DRAIN
        while self._running and time.monotonic() < deadline:
            for message in self._executor.collect(TICK):
                yield from self._take(message)
            yield None
        if self._running:
            self._executor.stop()

    def _submit(self) -> None:
        while self._executor.room:
            alone = bool(self._alone)
            if alone:
                job = self._alone.popleft()
            elif self._again:
                job = self._again.popleft()
            elif self._waiting:
                job = self._waiting.pop()
            elif self._last and not self._running:
                job = self._last.popleft()
            else:
                return
            self._running[id(job)] = _Work(job, list(job.keys))
            self._most = max(self._most, len(self._running))
            self._executor.submit(job, alone=alone)

    def _slow(self) -> Iterator[Slow]:
        now = time.monotonic()
        for work in self._running.values():
            if work.left and now - work.since > SLOW * 2**work.mentioned:
                work.mentioned += 1
                yield Slow(work.left[0], now - work.since)

    def _take(self, message: Message) -> Iterator[Event]:
        work = self._running[id(message.job)]
        job = work.job
        match message:
            case Begun():
                work.take_off(())
            case Computed():
                self._misfortunes = 0
                work.take_off(outcome.key for outcome in message.outcomes)
                self._waiting.learn(message.outcomes)
                yield message
            case Hindered():
                work.take_off(message.keys)
                yield from self._hinder(job, message.keys, message.reason)
            case Done():
                del self._running[id(job)]
            case Lost():
                del self._running[id(job)]
                blamed = [key for key in message.keys if key in work.left] or work.left
                others = [key for key in work.left if key not in blamed]
                yield from self._lose(job, message, blamed, others)

    def _lose(self, job: Job, lost: Lost, blamed: Sequence[Key], others: Sequence[Key]) -> Iterator[Event]:
        if lost.cause == "chance":
            others = [*others, *blamed]
        elif lost.cause == "machine":
            yield WorkerDied(len(blamed), lost.reason)
            yield from self._hinder(job, blamed, lost.reason)
        elif lost.cause == "crash":
            yield from self._suspect(job, blamed, lost.reason)
        else:
            status = "TIMEOUT" if lost.cause == "time" else "MEMORY"
            yield Computed(job, [Outcome(key, failed(lost.reason, status), None) for key in blamed])
        if others:
            self._again.append(_part(job, others))

    def _suspect(self, job: Job, blamed: Sequence[Key], reason: str) -> Iterator[Event]:
        convicted = [key for key in blamed if key in self._suspected]
        message = f"the worker process died each time this was computed, the last time alone ({reason})"
        if convicted:
            yield Computed(job, [Outcome(key, failed(message, "CRASHED"), None) for key in convicted])
        suspects = [key for key in blamed if key not in self._suspected]
        if suspects:
            yield WorkerDied(len(suspects), reason)
        self._suspected.update(suspects)
        self._alone.extend(_part(job, [key]) for key in suspects)

    def _hinder(self, job: Job, keys: Iterable[Key], reason: str) -> Iterator[Event]:
        self._misfortunes += 1
        self._reason = reason
        hopeless = [key for key in keys if key in self._hindered]
        if hopeless:
            yield GivenUp(hopeless, reason)
        others = [key for key in keys if key not in self._hindered]
        self._hindered.update(others)
        self._last.extend(_part(job, [key]) for key in others)


def _part(job: Job, keys: Sequence[Key]) -> Job:
    """A job of some of the estimates of another, in their order."""
    return replace(job, wanted=tuple(one for one in job.wanted if one[0] in keys))
