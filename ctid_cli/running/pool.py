"""A pool of worker processes that survives the death of any of them.

joblib's loky backend does the work. It is used for one job at a time as well, because only separate processes can be
lost without losing the run, and only they can be given one BLAS thread: with more, results have other last bits.

When a worker dies, the backend drops every unfinished job and does not say which one did it. So their estimates are
repeated one by one, and those whose worker dies again are ``CRASHED``.
"""

import logging
import os
import queue
import re
import threading
import time
import warnings
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

from ctid_cli import own_code
from ctid_cli.running.job import Job, run_job
from ctid_cli.running.job_order import JobQueue
from ctid_cli.running.worker import initialise
from ctid_cli.storage.columns import failed
from ctid_cli.storage.manifest import Outcome

#: How often the caller gets a chance to do something else while nothing is finished [s].
TICK = 0.05
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
    waiting = JobQueue(jobs)
    while waiting and not stopping():
        lost, reason = yield from _round(waiting, workers, stopping)
        if lost and not stopping():
            yield Died(len(lost), reason)
            for job in lost:
                yield from _alone(job, stopping)


def _alone(job: Job, stopping: Callable[[], bool]) -> Iterator[Finished | Died | None]:
    for one in job.wanted:
        part = replace(job, wanted=(one,))
        lost, reason = yield from _round(JobQueue([part]), 1, stopping)
        if lost and not stopping():
            message = f"the worker process died each time this was computed, the last time alone ({reason})"
            yield Finished(part, [Outcome(key, failed(message, "CRASHED"), None) for key, _, _ in part.wanted])


def _round(
    waiting: JobQueue, workers: int, stopping: Callable[[], bool]
) -> Generator[Finished | None, None, tuple[list[Job], str]]:
    """Run jobs until all are finished or a worker dies; return the jobs that were lost, and why."""
    import joblib

    logging.getLogger("concurrent.futures").addFilter(_no_failed_callback)
    running: dict[int, Job] = {}

    def calls() -> Iterator[Any]:
        # joblib asks for the next job from a thread of its own whenever one is finished.
        while waiting and not stopping():
            job = waiting.pop()
            running[id(job)] = job
            yield joblib.delayed(_numbered)(own_code.served(), id(job), job)

    with _workers(workers):
        parallel = joblib.Parallel(
            return_as="generator_unordered", batch_size=1, pre_dispatch="2*n_jobs" if workers > 1 else 1
        )
    try:
        results = parallel(calls())
    except Exception as error:
        # The pool can break while the first jobs are handed to it.
        return list(running.values()), _reason(error)
    inbox: queue.SimpleQueue[tuple[int, list[Outcome]] | BaseException | None] = queue.SimpleQueue()
    # The pool itself was started above, by the calling thread: workers die with the thread that started them.
    threading.Thread(target=_collect, args=(results, inbox), name="ctid-collect", daemon=True).start()
    deadline: float | None = None
    reason = ""
    while True:
        if deadline is None and stopping():
            deadline = time.monotonic() + DRAIN
        try:
            item = inbox.get(timeout=TICK)
        except queue.Empty:
            if deadline is not None and time.monotonic() > deadline:
                kill_workers()
                break
            yield None
            continue
        if item is None:
            break
        if isinstance(item, BaseException):
            reason = _reason(item)
            break
        number, outcomes = item
        waiting.learn(outcomes)
        yield Finished(running.pop(number), outcomes)
    return list(running.values()), reason


def in_worker(call: Callable[..., Any], *given: Any) -> Any:
    """What a call answers in a worker process; None if the process died of it."""
    import joblib

    with _workers(2):
        parallel = joblib.Parallel(return_as="list")
    try:
        return parallel([joblib.delayed(_called)(own_code.served(), call, given)])[0]
    except KeyboardInterrupt:
        kill_workers()
        raise
    except Exception:
        return None


def _workers(count: int) -> Any:
    import joblib

    # joblib would run a single job at a time in this very process; two workers, one of them idle, keep it out.
    return joblib.parallel_config(
        backend="loky", n_jobs=max(count, 2), inner_max_num_threads=1, initializer=initialise, initargs=(os.getpid(),)
    )


def _called(own: own_code.Served, call: Callable[..., Any], given: tuple[Any, ...]) -> Any:
    return call(*given)


def _no_failed_callback(record: logging.LogRecord) -> bool:
    """Whether a log record is anything but a callback that met a pool being torn down.

    joblib starts the next job from such a callback. When a run ends early the pool may be gone by then; the backend
    logs a traceback, although nothing is wrong and the outcome of every job reaches us as a result.
    """
    return not str(record.msg).startswith("exception calling callback")


def _numbered(own: own_code.Served, number: int, job: Job) -> tuple[int, list[Outcome]]:
    return number, run_job(job)


def _collect(results: Iterator[Any], inbox: queue.SimpleQueue[Any]) -> None:
    try:
        for result in results:
            inbox.put(result)
    except BaseException as error:
        inbox.put(error)
    else:
        inbox.put(None)


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
