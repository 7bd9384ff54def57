"""A pool of worker processes that survives the death of any of them.

Only separate processes can be lost without losing the run, so that one is used for one job at a time as well. On Linux
they are forked from this process, which has imported and compiled everything that they need.

The estimates of a job whose worker died are repeated one by one when nothing else is running; those whose worker dies
again are ``CRASHED``.
"""

import multiprocessing
import os
import signal
import sys
import time
import warnings
from collections import deque
from collections.abc import Callable, Generator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import groupby
from multiprocessing.connection import Connection, wait

from ctid_cli.running.job import Job, run_job
from ctid_cli.running.worker import initialise
from ctid_cli.storage.columns import failed
from ctid_cli.storage.manifest import Outcome

#: How often the caller gets a chance to do something else while nothing is finished [s].
TICK = 0.05
#: How long running jobs may go on after a request to stop [s].
DRAIN = 1.0

#: Nothing that is open or locked here is used in a forked process, and its threads are not needed there.
_CONTEXT = multiprocessing.get_context("fork") if sys.platform == "linux" else multiprocessing.get_context("spawn")


@dataclass(frozen=True)
class Died:
    """A worker process died at a job."""

    job: Job
    reason: str


@dataclass(frozen=True)
class Finished:
    """A job is finished, or as much of it as was split off."""

    job: Job
    outcomes: list[Outcome]


class Queue:
    """Jobs in the order of the plan, but the longest of a replicate first, so that at the end no worker waits long.

    Replicates stay in order: a run that is stopped has as many data sets of one cell as of another. What an estimate
    takes is known from those of the same cell and estimator; unknown ones come first. The last replicate is split into
    estimators, which are spread more evenly than whole data sets.
    """

    def __init__(self, jobs: Sequence[Job]) -> None:
        self._rounds = deque(list(group) for _, group in groupby(jobs, key=lambda job: job.replicate))
        self._seconds: dict[tuple[str, str], float] = {}
        self._split_last()

    def __bool__(self) -> bool:
        return bool(self._rounds)

    def pop(self) -> Job:
        """The next job."""
        first = self._rounds[0]
        job = max(first, key=self._expected)
        first.remove(job)
        if not first:
            self._rounds.popleft()
            self._split_last()
        return job

    def learn(self, outcomes: Sequence[Outcome]) -> None:
        """Note how long estimates took."""
        for key, _, seconds, _ in outcomes:
            self._seconds[key.data_hash, key.estimator_hash] = seconds or 0.0

    def _expected(self, job: Job) -> float:
        return sum(self._seconds.get((key.data_hash, key.estimator_hash), float("inf")) for key, _, _ in job.wanted)

    def _split_last(self) -> None:
        if len(self._rounds) == 1:
            self._rounds[0] = [
                replace(job, wanted=tuple(wanted))
                for job in self._rounds[0]
                for _, wanted in groupby(job.wanted, key=lambda one: one[0].estimator_hash)
            ]


class _Worker:
    """A process that runs the jobs it is sent, one at a time."""

    def __init__(self) -> None:
        self.job: Job | None = None
        self.pipe, theirs = _CONTEXT.Pipe()
        self._process = _CONTEXT.Process(target=_serve, args=(theirs, os.getpid()), daemon=True)
        with warnings.catch_warnings():
            # Newer versions of Python warn of forking beside threads: here those of BLAS and of the progress bar.
            warnings.simplefilter("ignore", DeprecationWarning)
            self._process.start()
        theirs.close()

    def begin(self, job: Job) -> None:
        """Send the process a job."""
        self.job = job
        # Where it has died while it waited, the end of its pipe is read later, as that of any other.
        with suppress(OSError):
            self.pipe.send(job)

    def result(self) -> Finished | Died:
        """What became of the job."""
        job, self.job = self.job, None
        assert job is not None
        try:
            return Finished(job, self.pipe.recv())
        except (EOFError, OSError):
            return Died(job, self.end())

    def end(self) -> str:
        """End the process at once, finished or not; how it ended."""
        self._process.kill()
        self._process.join()
        self.pipe.close()
        code = self._process.exitcode or 0
        return signal.Signals(-code).name if code < 0 else f"EXIT({code})"


def _serve(pipe: Connection, parent: int) -> None:
    initialise(parent)
    with suppress(EOFError, OSError):
        while True:
            pipe.send(run_job(pipe.recv()))


def run_jobs(
    jobs: Sequence[Job], workers: int, stopping: Callable[[], bool]
) -> Generator[Finished | Died | None, None, None]:
    """Run jobs in worker processes, which end with the iterator."""
    lost: list[Job] = []
    for item in _run(Queue(jobs), workers, stopping):
        if isinstance(item, Died):
            lost.append(item.job)
        yield item
    for job in lost:
        for one in job.wanted:
            for item in _run(Queue([replace(job, wanted=(one,))]), 1, stopping):
                yield _crashed(item) if isinstance(item, Died) else item


def _crashed(death: Died) -> Finished:
    message = f"the worker process died each time this was computed, the last time alone ({death.reason})"
    outcomes = [Outcome(key, failed(message, "CRASHED"), None) for key, _, _ in death.job.wanted]
    return Finished(death.job, outcomes)


def _run(queue: Queue, workers: int, stopping: Callable[[], bool]) -> Generator[Finished | Died | None, None, None]:
    """Run jobs until all are finished or a worker died at them, or little longer than until a stop is asked for."""
    pool: list[_Worker] = []
    items: list[Finished | Died] = []
    deadline: float | None = None
    try:
        while True:
            if stopping():
                deadline = deadline or time.monotonic() + DRAIN
            else:
                # Before the caller stores what has been finished: workers need not wait for that.
                idle = [worker for worker in pool if worker.job is None]
                while queue and (idle or len(pool) < workers):
                    if not idle:
                        idle.append(_Worker())
                        pool += idle
                    idle.pop().begin(queue.pop())
            yield from items
            if not items:
                yield None
            busy = [worker for worker in pool if worker.job is not None]
            if not busy or (deadline is not None and time.monotonic() > deadline):
                return
            ready = wait([worker.pipe for worker in busy], TICK)
            items = []
            for worker in busy:
                if worker.pipe in ready:
                    item = worker.result()
                    items.append(item)
                    if isinstance(item, Died):
                        pool.remove(worker)
                    else:
                        queue.learn(item.outcomes)
    finally:
        for worker in pool:
            worker.end()
