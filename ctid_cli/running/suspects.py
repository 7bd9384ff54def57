"""From jobs to estimates, whatever happens to the processes that compute them.

What was in work when a process died is a suspect: one of them killed its process, the others were in work beside it.
Each is computed again alone. What exceeds a limit there, or ends a process that has computed nothing else, is a failure
of its estimator. What the machine did (out of memory, no more descriptors, a process killed from outside) is never a
result, and a process that was stopped for a while is not guilty of the time: such estimates are computed once more, one
at a time. What the machine does not let finish then is given up, and missing.
"""

from __future__ import annotations

import itertools
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing
from typing import TYPE_CHECKING, NamedTuple

from ctid_cli.running.job import Job, Short
from ctid_cli.running.limits import Limits
from ctid_cli.running.workers import Ending
from ctid_cli.storage.columns import failed
from ctid_cli.storage.manifest import Key, Outcome

if TYPE_CHECKING:
    from ctid_cli.running.dask_cluster import DaskWorkers
    from ctid_cli.running.workers import LocalWorkers

#: After this number of rounds without a finished estimate the run ends; before each next round it waits in proportion
#: to their number [s]. A round ends early when the machine was short of something this often.
PATIENCE, PAUSE = 4, 0.3
SHORTAGES = 8
#: An estimate that takes so long is mentioned, and again after twice the time [s].
SLOW = 600.0
#: Share of a limit of wall time that a process must have had the processor for, to be guilty of it [-].
AT_WORK = 0.5
#: Signals that no estimate sends itself by mistake: something else ended its process.
_FROM_OUTSIDE = {"SIGKILL", "SIGTERM", "SIGINT", "SIGHUP", "SIGQUIT", "SIGXCPU", "SIGXFSZ"}


class Suspected(NamedTuple):
    """Estimates that were in work when a process died, and are computed again."""

    keys: Sequence[Key]


class GivenUp(NamedTuple):
    """Estimates that the machine did not let finish; without any, it is fit for none."""

    keys: Sequence[Key]
    reason: str


class Slow(NamedTuple):
    """An estimate that has been in work for long [s]."""

    key: Key
    seconds: float


Event = list[Outcome] | Suspected | GivenUp | Slow | None


class Course:
    """Jobs on their way to estimates."""

    def __init__(
        self, jobs: Iterator[Job], workers: LocalWorkers | DaskWorkers, limits: Limits, stopping: Callable[[], bool]
    ) -> None:
        self._jobs, self._workers, self._limits, self._stopping = jobs, workers, limits, stopping
        #: What is left of jobs whose process died, and is not suspect.
        self._again: deque[Job] = deque()
        self._suspects: list[Job] = []
        #: What is computed once more, one at a time.
        self._undecided: list[Job] = []
        self._exhausted = False
        #: Since the last finished estimate: how often the machine was short of something, and of what.
        self._short = 0
        self._reason = ""
        self._mentioned: dict[Key, float] = {}

    def events(self) -> Generator[Event]:
        """Yield finished estimates and what else happens; None now and then."""
        vain = 0
        while not self._stopping() and not (self._exhausted and not self._again):
            finished = False
            for event in self._round():
                finished |= isinstance(event, list)
                yield event
            vain = 0 if finished else vain + 1
            if vain >= PATIENCE and not self._exhausted:
                yield GivenUp((), self._reason or self._workers.trouble)
                return
            time.sleep(PAUSE * vain)

    def _round(self) -> Generator[Event]:
        """Compute until all is done or a process dies; then each of the suspects alone."""
        with closing(self._workers.results(self._handed_out(), self._stopping)) as results:
            for result in results:
                yield from self._slow() if result is None else self._settle(*result)
        while (self._suspects or self._undecided) and not self._stopping():
            if self._suspects:
                suspects, self._suspects = self._suspects, []
                yield Suspected([key for job in suspects for key in job.keys])
                yield from self._alone(suspects, self._workers.count, tries=1)
            else:
                undecided, self._undecided = self._undecided, []
                yield from self._alone(undecided, 1, tries=2)
        self._short = 0

    def _handed_out(self) -> Iterator[Job]:
        while not self._stopping() and self._short < SHORTAGES:
            job = self._again.popleft() if self._again else next(self._jobs, None)
            if job is None:
                self._exhausted = True
                return
            yield job

    def _alone(self, jobs: list[Job], at_once: int, tries: int) -> Generator[Event]:
        wanted = itertools.takewhile(lambda _: not self._stopping(), jobs)
        with closing(self._workers.alone(wanted, at_once)) as endings:
            for ending in endings:
                yield from self._slow() if ending is None else self._settle(*ending, tries)

    def _slow(self) -> Generator[Event]:
        yield None
        for key, seconds in self._workers.slow(SLOW):
            if seconds > self._mentioned.get(key, SLOW):
                self._mentioned[key] = 2 * seconds
                yield Slow(key, seconds)

    def _settle(self, job: Job, ending: Ending, tries: int = 0) -> Generator[Event]:
        """Decide on a job that ended, in the pool at first, then alone, then alone on the machine."""
        outcomes = [entry for entry in ending.entries if isinstance(entry, Outcome)]
        left = [key for key in job.keys if key not in {outcome.key for outcome in outcomes}]
        if outcomes:
            self._short = 0
            yield outcomes
        for entry in ending.entries:
            if isinstance(entry, Short):
                left = [key for key in left if key not in entry.keys]
                self._short += 1
                yield from self._hindered(job.only(entry.keys), entry.reason, tries)
        self._reason = ending.how or self._reason
        in_work = [key for key in ending.begun if key in left] if ending.how else []
        if tries and ending.how and not in_work:
            # It died before it began.
            in_work = left
        if in_work and (tries == 0 or outcomes):
            self._suspects.append(job.only(in_work))
        elif in_work:
            yield from self._decided(job.only(in_work), ending, tries)
        rest = [key for key in left if key not in in_work]
        if rest:
            self._again.append(job.only(rest))

    def _decided(self, job: Job, ending: Ending, tries: int) -> Generator[Event]:
        """Decide on estimates that ended a process which had computed nothing else."""
        limits = self._limits
        if ending.late and limits.wall_seconds is not None:
            if tries == 1 and ending.processor < AT_WORK * limits.wall_seconds:
                # It may have slept, or its process was stopped.
                self._undecided.append(job)
                return
            status, reason = "TIMEOUT", limits.too_late(wall=True)
        elif ending.how == "SIGPROF" and limits.cpu_seconds is not None:
            status, reason = "TIMEOUT", limits.too_late(wall=False)
        elif ending.how.startswith(("SIG", "exit code")) and ending.how not in _FROM_OUTSIDE:
            status = "CRASHED"
            reason = f"the worker process died each time this was computed, the last time alone ({ending.how})"
        else:
            yield from self._hindered(job, ending.how, tries)
            return
        yield [Outcome(key, failed(reason, status), None) for key in job.keys]

    def _hindered(self, job: Job, reason: str, tries: int) -> Generator[Event]:
        """Give up what the machine did not let finish, or compute it once more."""
        self._reason = reason
        if tries < 2:
            self._undecided.append(job)
        else:
            yield GivenUp(job.keys, reason)
