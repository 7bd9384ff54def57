"""A pool of worker processes that survives the death of any of them.

The executor of loky, which comes with joblib, does the work. It is used for one job at a time as well, because only
separate processes can be lost without losing the run, and only they can be given one BLAS thread: with more, results
have other last bits.

When a worker dies, the executor drops every unfinished job and does not say which one did it. So each of them is
repeated alone; a job that kills its worker again is split into single estimates, and those that still do are
``CRASHED``.
"""

from __future__ import annotations

import os
import re
import time
import warnings
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

from ctid_cli.running.job import Job, run_job
from ctid_cli.running.worker import initialise
from ctid_cli.storage.columns import failed
from ctid_cli.storage.manifest import Outcome

#: How often the caller gets a chance to do something else while nothing is finished [s].
TICK = 0.05
#: Environment of workers.
_ONE_THREAD = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL", "BLIS", "NUMBA", "NUMEXPR")}
_ONE_THREAD["VECLIB_MAXIMUM_THREADS"] = "1"
#: How long running jobs may go on after a request to stop [s].
DRAIN = 1.0


@dataclass(frozen=True)
class Died:
    """A worker process died."""

    jobs: int
    reason: str


@dataclass(frozen=True)
class Finished:
    """A job is finished, or as much of it as was split off."""

    job: Job
    outcomes: list[Outcome]


def run_jobs(jobs: Sequence[Job], workers: int, stopping: Callable[[], bool]) -> Iterator[Finished | Died | None]:
    """Run jobs in worker processes."""
    waiting = deque(jobs)
    while waiting and not stopping():
        lost, reason = yield from _round(waiting, workers, stopping)
        if lost and not stopping():
            yield Died(len(lost), reason)
            for job in lost:
                yield from _alone(job, stopping)


def _alone(job: Job, stopping: Callable[[], bool]) -> Iterator[Finished | Died | None]:
    lost, reason = yield from _round(deque([job]), 1, stopping)
    if not lost or stopping():
        return
    parts = [replace(job, wanted=(one,)) for one in job.wanted]
    for part in parts:
        lost, reason = yield from _round(deque([part]), 1, stopping)
        if lost and not stopping():
            message = f"the worker process died each time this was computed, the last time alone ({reason})"
            yield Finished(part, [Outcome(key, failed(message, "CRASHED"), None) for key, _, _ in part.wanted])


def _round(
    waiting: deque[Job], workers: int, stopping: Callable[[], bool]
) -> Generator[Finished | None, None, tuple[list[Job], str]]:
    """Run jobs until all are finished or a worker dies; return the jobs that were lost, and why."""
    from concurrent.futures import FIRST_COMPLETED, Future, wait

    from joblib.externals.loky import get_reusable_executor

    running: dict[Future[list[Outcome]], Job] = {}
    starting: list[Job] = []
    # A worker that has waited in vain for so long ends [s].
    settings = {"timeout": 300, "initializer": initialise, "initargs": (os.getpid(),), "env": _ONE_THREAD}
    try:
        executor = get_reusable_executor(workers, **settings)
        deadline: float | None = None
        while running or (waiting and not stopping()):
            # One job each in advance, so that no worker waits; a job that is run alone is lost alone.
            while waiting and not stopping() and len(running) < (2 * workers if workers > 1 else 1):
                # Workers die with the thread that started them, which is this one.
                starting.append(waiting.popleft())
                future = executor.submit(run_job, starting[0])
                running[future] = starting.pop()
            if deadline is None and stopping():
                deadline = time.monotonic() + DRAIN
            done, _ = wait(running, timeout=TICK, return_when=FIRST_COMPLETED)
            if not done and deadline is not None and time.monotonic() > deadline:
                kill_workers()
                break
            if not done:
                yield None
            # What was finished before a worker died is not lost with it.
            for future in sorted(done, key=lambda future: future.exception() is not None):
                outcomes = future.result()
                yield Finished(running.pop(future), outcomes)
    except Exception as error:
        kill_workers()
        return [*running.values(), *starting], _reason(error)
    return list(running.values()), ""


def _reason(error: BaseException) -> str:
    # loky names how its workers ended somewhere in a long explanation; how many did so is a matter of chance.
    endings = sorted(set(re.findall(r"SIG[A-Z0-9]+|EXIT\(\d+\)", str(error))))
    if endings:
        return " ".join(endings)
    first = str(error).strip().partition("\n")[0]
    return f"{type(error).__name__}: {first}"


def kill_workers() -> None:
    """End the pool's processes at once, finished or not."""
    from joblib.externals.loky import get_reusable_executor

    with suppress(Exception), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        get_reusable_executor(reuse=True).shutdown(wait=True, kill_workers=True)
