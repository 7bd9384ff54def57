"""Workers of a dask scheduler, on one or several machines.

Jobs are submitted by `distributed.Client.get_executor`. A worker must have one thread, and the same code, packages and
arithmetic as this process, which it checks before its first job. When a worker dies, dask moves its job to others, and
gives up if these die too; such a job is a suspect, and is computed again in a separate process started by a worker.
"""

from __future__ import annotations

import platform
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import suppress
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from ctid_cli.errors import DataError, MachineError, RefusedError, UsageError
from ctid_cli.running.job import Begun, Job
from ctid_cli.running.limits import Limits, StopRequest
from ctid_cli.running.plan import Plan, computing_parts
from ctid_cli.running.workers import Ending, Results, Task, compute, compute_alone, in_parallel, packed, unpacked
from ctid_cli.signals.files import COPIES
from ctid_cli.storage.identity import Origin, origin_differences, origin_of

#: Longest time without any worker [s], and interval between checks.
PATIENCE = 120.0
LOOK = 1.0


class DaskWorkers:
    """Workers of a dask scheduler."""

    _client: Any

    def __init__(self, address: str, plan: Plan, origin: Origin, limits: Limits) -> None:
        try:
            from distributed import Client
        except ImportError:
            raise UsageError("--dask needs dask.distributed; install it with: pip install 'ctid[dask]'") from None
        self._address, self._limits = address, limits
        contents = _contents(plan)
        try:
            self._client = Client(address, timeout=10, set_as_default=False)  # type: ignore[no-untyped-call]
        except (OSError, ValueError, TimeoutError) as error:
            advice = "start one with: dask scheduler"
            raise UsageError(f"there is no dask scheduler at {address} ({error}); {advice}") from None
        self._expected = packed(origin, computing_parts(plan))
        # Submitted as a task, because data scattered to workers are lost with them.
        self._files = self._client.submit(dict, contents, pure=False)
        self._executor = self._client.get_executor(pure=False)
        self.count, self.ended_by = 1, ""
        self._looked, self._present = float("-inf"), time.monotonic()
        self._look()

    def _look(self) -> int:
        """Return the number of workers, checked at intervals; raise an error after a long time without any."""
        now = time.monotonic()
        if now - self._looked >= LOOK:
            self._looked = now
            try:
                self.count = len(self._client.nthreads())
            except Exception as error:
                raise MachineError(f"{self._address} is no longer reachable ({error})") from error
            self._present = now if self.count else self._present
            if now - self._present > PATIENCE:
                start = f"start some with: dask worker {self._address} --nthreads 1"
                raise MachineError(f"{self._address} has no worker; {start}. What was finished is stored")
        return max(self.count, 1)

    def results(self, jobs: Iterator[Job], stopping: StopRequest) -> Results:
        """Compute jobs and yield their results in any order; None after a while without results."""
        return self._computed(jobs, compute_there, self._look, stopping)

    def alone(self, jobs: Iterator[Job], at_once: int, stopping: StopRequest) -> Results:
        """Compute each job in a separate process, several at a time."""
        return self._computed(jobs, compute_alone, lambda: min(at_once, self._look()), stopping)

    def _computed(
        self,
        jobs: Iterator[Job],
        function: Callable[..., Ending],
        at_once: Callable[[], int],
        stopping: StopRequest,
    ) -> Results:
        def submit(job: Job, task: Task) -> Future[Ending]:
            future: Future[Ending] = self._executor.submit(
                on_worker, function, task, self._limits, self._expected, self._files
            )
            return future

        for over in in_parallel(jobs, submit, at_once, _died):
            if over is None:
                if stopping.overdue:
                    return
                self._look()
            yield over

    def close(self) -> None:
        """Leave the scheduler, which forgets what was in work."""
        with suppress(Exception):
            self._client.close()


def _died(job: Job, error: Exception) -> Ending:
    """Return the ending of a job whose workers died: all estimates are suspects, since the worker's record is lost."""
    if isinstance(error, RefusedError):
        raise error
    return Ending([Begun(job.keys)], f"{type(error).__name__}: the workers that had it died or were lost")


def _contents(plan: Plan) -> dict[str, bytes]:
    """Return the content of each file used for data sets, by its SHA-256."""
    contents = {}
    for path, sha256 in plan.files:
        try:
            contents[sha256] = Path(path).read_bytes()
        except OSError as error:
            raise DataError(f"{path}: the file cannot be read: {error.strerror}") from error
    return contents


# ----------------------------------------------------------------------------------------------------------------------
# On a worker


def on_worker(
    function: Callable[..., Ending], task: Task, limits: Limits, expected: bytes, files: dict[str, bytes]
) -> Ending:
    """Compute a job on a worker after checking that it has the same origin as the process of the run."""
    _require_same(expected)
    for sha256 in files.keys() - COPIES.keys():
        copy = Path(_kept().name) / sha256
        copy.write_bytes(files[sha256])
        COPIES[sha256] = str(copy)
    with TemporaryDirectory(prefix="ctid-", ignore_cleanup_errors=True) as folder:
        return function(task, limits, Path(folder))


def compute_there(task: Task, limits: Limits, folder: Path) -> Ending:
    """Compute a job in the process of the worker."""
    return Ending(compute(task, folder / "record", limits))


@cache
def _kept() -> TemporaryDirectory[str]:
    """Return the folder of the transferred files, which exists as long as this worker."""
    return TemporaryDirectory(prefix="ctid-", ignore_cleanup_errors=True)


@cache
def _require_same(expected: bytes) -> None:
    """Refuse to compute with several threads, or with another origin."""
    from distributed import get_worker

    ours, parts = unpacked(expected)
    worker = get_worker()
    who = f"worker {worker.address} on {platform.node()}"
    if worker.state.nthreads != 1:
        raise RefusedError(f"{who} has {worker.state.nthreads} threads; start it with --nthreads 1")
    if differences := origin_differences(ours, origin_of(*parts), "here", "there"):
        raise RefusedError(f"{who} is of other code or arithmetic ({differences})")
