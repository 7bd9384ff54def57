"""From jobs to estimates, including recovery from dead worker processes.

Jobs in progress when a process dies are suspects: one of them killed its process, the others were running at the same
time. Each is computed again alone. An estimate that exceeds a limit there, or ends a process that has computed nothing
else, is a failure of its estimator. A cause in the machine (out of memory or descriptors, a process killed from
outside) is never a result, and a process that was stopped for a while is not charged with that time: such estimates are
computed once more, one at a time. If they fail again for such a cause they are given up, and missing.
"""

from __future__ import annotations

import itertools
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from typing import TYPE_CHECKING

from ctid_cli.running.job import Job, Short
from ctid_cli.running.limits import Limits, StopRequest
from ctid_cli.running.workers import Ending
from ctid_cli.storage.columns import failed
from ctid_cli.storage.manifest import Outcome
from ctid_cli.text import count

if TYPE_CHECKING:
    from ctid_cli.running.dask_cluster import DaskWorkers
    from ctid_cli.running.workers import LocalWorkers

#: After this number of rounds without a finished estimate the run ends; the pause before each further round is
#: proportional to the round number [s]. A round ends early after this number of exhausted resources.
PATIENCE, PAUSE = 4, 0.3
SHORTAGES = 8
#: Minimum share of processor time in an exceeded wall time limit for which a process is charged with exceeding it [-].
AT_WORK = 0.5
#: Number of given-up estimates named in a message.
NAMED = 3
#: Signals that no estimate sends to itself by mistake, so that another program ended its process.
_FROM_OUTSIDE = {"SIGKILL", "SIGTERM", "SIGINT", "SIGHUP", "SIGQUIT", "SIGXCPU", "SIGXFSZ"}


class JobQueue:
    """Jobs in progress, from submission to estimates."""

    def __init__(
        self,
        jobs: Iterator[Job],
        workers: LocalWorkers | DaskWorkers,
        limits: Limits,
        stopping: StopRequest,
        report: Callable[[str], object],
    ) -> None:
        self._jobs, self._workers, self._limits, self._stopping, self._report = jobs, workers, limits, stopping, report
        #: Estimates that could not be finished for lack of resources, by name, and the cause.
        self.given_up: list[str] = []
        self.cause = ""
        #: Whether the machine cannot finish any estimate.
        self.is_stuck = False
        #: Remaining jobs of dead processes that are not suspects.
        self._again: deque[Job] = deque()
        self._suspects: list[Job] = []
        #: Jobs computed once more, one at a time.
        self._undecided: list[Job] = []
        self._exhausted = False
        #: Since the last finished estimate: number of exhausted resources, and of rounds.
        self._short = self._idle_rounds = 0
        #: Cause of death of the last process, or exhausted resource.
        self._reason = ""

    def outcomes(self) -> Generator[list[Outcome]]:
        """Yield finished estimates; an empty list at intervals."""
        while not self._stopping() and not (self._exhausted and not self._again):
            self._idle_rounds += 1
            yield from self._round()
            if self._idle_rounds >= PATIENCE and (self._again or not self._exhausted):
                self.is_stuck = True
                self.cause = self._reason or self._workers.ended_by
                return
            time.sleep(PAUSE * self._idle_rounds)

    def _round(self) -> Generator[list[Outcome]]:
        """Compute until all jobs are done or a process dies; then compute each suspect alone."""
        with closing(self._workers.results(self._handed_out(), self._stopping)) as results:
            yield from self._settled(results, tries=0)
        while (self._suspects or self._undecided) and not self._stopping():
            if self._suspects:
                jobs, at_once, tries = self._suspects, self._workers.count, 1
                self._suspects = []
                estimates = count(sum(len(job.wanted) for job in jobs), "estimate")
                self._report(f"a worker process died; computing {estimates} again, each in a process of its own")
            else:
                jobs, at_once, tries = self._undecided, 1, 2
                self._undecided = []
            wanted = itertools.takewhile(lambda _: not self._stopping(), jobs)
            with closing(self._workers.alone(wanted, at_once, self._stopping)) as results:
                yield from self._settled(results, tries)
        self._short = 0

    def _handed_out(self) -> Iterator[Job]:
        while not self._stopping() and self._short < SHORTAGES:
            job = self._again.popleft() if self._again else next(self._jobs, None)
            if job is None:
                self._exhausted = True
                return
            yield job

    def _settled(self, results: Iterator[tuple[Job, Ending] | None], tries: int) -> Generator[list[Outcome]]:
        """Process the endings of jobs: first in the pool, then alone, then as the only job on the machine."""
        for result in results:
            yield [] if result is None else self._settle(*result, tries)

    def _settle(self, job: Job, ending: Ending, tries: int) -> list[Outcome]:
        """Return the finished estimates of a job, and process the rest of it."""
        outcomes = [entry for entry in ending.entries if isinstance(entry, Outcome)]
        left = [key for key in job.keys if key not in {outcome.key for outcome in outcomes}]
        if outcomes:
            self._short = self._idle_rounds = 0
        for entry in ending.entries:
            if isinstance(entry, Short):
                left = [key for key in left if key not in entry.keys]
                self._short += 1
                self._try_again_or_give_up(job.only(entry.keys), entry.reason, tries)
        self._reason = ending.how or self._reason
        in_work = [key for key in ending.begun if key in left] if ending.how else []
        if tries and ending.how and not in_work:
            # The process died before the first estimate.
            in_work = left
        rest = [key for key in left if key not in in_work]
        if rest:
            self._again.append(job.only(rest))
        if in_work and (tries == 0 or outcomes):
            self._suspects.append(job.only(in_work))
        elif in_work and not self._stopping.overdue:
            outcomes += self._decided(job.only(in_work), ending, tries)
        return outcomes

    def _decided(self, job: Job, ending: Ending, tries: int) -> Iterator[Outcome]:
        """Process estimates that ended a process which had computed nothing else."""
        limits = self._limits
        if ending.late and limits.wall_seconds is not None:
            if tries == 1 and ending.processor < AT_WORK * limits.wall_seconds:
                # The estimate may have slept, or its process was stopped.
                self._undecided.append(job)
                return
            status, reason = "TIMEOUT", limits.too_late(wall=True)
        elif ending.how == "SIGPROF" and limits.cpu_seconds is not None:
            status, reason = "TIMEOUT", limits.too_late(wall=False)
        elif ending.how.startswith(("SIG", "exit code")) and ending.how not in _FROM_OUTSIDE:
            status = "CRASHED"
            reason = f"the worker process died each time this was computed, the last time alone ({ending.how})"
        else:
            self._try_again_or_give_up(job, ending.how, tries)
            return
        self._idle_rounds = 0
        yield from (Outcome(key, failed(reason, status), None) for key in job.keys)

    def _try_again_or_give_up(self, job: Job, reason: str, tries: int) -> None:
        """Give up the estimates of a job, or compute it once more."""
        self._reason = reason
        if tries < 2:
            self._undecided.append(job)
            return
        self.cause = reason
        names = job.names(job.keys)
        self.given_up += names
        self._report(f"{count(len(names), 'estimate')} given up, not stored ({', '.join(names[:NAMED])}): {reason}")
