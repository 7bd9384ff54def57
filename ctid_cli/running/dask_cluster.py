"""The workers of a dask scheduler, on this machine or on many.

Jobs go through `distributed.Client.get_executor`. A worker must have one thread, and the same code, packages and
arithmetic as this process: it compares them before its first job. When a worker dies dask gives the job to others, and
gives it up when these die too; such a job is a suspect, and is computed again in a process of its own below a worker.
"""

from __future__ import annotations

import dataclasses
import hashlib
import pickle
import platform
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from concurrent.futures import Future
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

from ctid_cli.errors import DataError, MachineError, RefusedError, UsageError
from ctid_cli.running.job import Begun, Entry, Job
from ctid_cli.running.limits import Limits
from ctid_cli.running.plan import Plan, computing_parts
from ctid_cli.running.workers import Ending, Results, compute, compute_alone, in_parallel, packed, task_of
from ctid_cli.storage.identity import Origin, origin_differences, origin_of
from ctid_cli.storage.manifest import Key
from ctid_cli.temporary import TemporaryFolder

#: How long a worker is waited for where there is none [s], and how often that is looked at.
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
        try:
            self._client = Client(address, timeout=10, set_as_default=False)  # type: ignore[no-untyped-call]
        except (OSError, ValueError, TimeoutError) as error:
            advice = "start one with: dask scheduler"
            raise UsageError(f"no scheduler of dask answers at {address} ({error}); {advice}") from None
        self._expected = packed(origin, computing_parts(plan))
        # A task, because what is scattered to workers is lost with them.
        self._files = self._client.submit(dict, _contents(plan), pure=False)
        self._executor = self._client.get_executor(pure=False)
        #: What is in work, and since when [s].
        self._at_work: dict[Job, float] = {}
        self.count, self.trouble = 1, ""
        self._looked, self._present = float("-inf"), time.monotonic()
        self._look()

    def _look(self) -> int:
        """Count the workers now and then; a run that is without any for long ends."""
        now = time.monotonic()
        if now - self._looked >= LOOK:
            self._looked = now
            try:
                self.count = len(self._client.nthreads())
            except Exception as error:
                raise MachineError(f"{self._address} does not answer any more ({error})") from error
            self._present = now if self.count else self._present
            if now - self._present > PATIENCE:
                start = f"start some with: dask worker {self._address} --nthreads 1"
                raise MachineError(f"{self._address} has no worker; {start}. What was finished is stored")
        return max(self.count, 1)

    def results(self, jobs: Iterator[Job], stopping: Callable[[], bool]) -> Results:
        """Compute jobs and yield what comes of them, in any order; None where nothing has come for a while."""
        return self._computed(jobs, compute_there, self._look)

    def alone(self, jobs: Iterator[Job], at_once: int) -> Results:
        """Compute jobs each in a process of its own, some at the same time."""
        return self._computed(jobs, compute_alone, lambda: min(at_once, self._look()))

    def _computed(self, jobs: Iterator[Job], function: Callable[..., Any], at_once: Callable[[], int]) -> Results:
        def submit(job: Job) -> Future[Any] | list[Entry]:
            task = task_of(job)
            if isinstance(task, list):
                return task
            self._at_work[job] = time.monotonic()
            given = (*task, self._limits, self._expected, self._files)
            future: Future[Any] = self._executor.submit(on_worker, function, *given)
            return future

        try:
            for over in in_parallel(jobs, submit, at_once):
                if over is None:
                    self._look()
                    yield None
                    continue
                job, came = over
                self._at_work.pop(job, None)
                yield job, came if isinstance(came, Ending) else _ending(job, came)
        finally:
            self._at_work.clear()

    def slow(self, least: float) -> Iterator[tuple[Key, float]]:
        """Yield an estimate of each job that a worker has had for longer than this, and for how long [s]."""
        times = [(job.keys[0], time.monotonic() - since) for job, since in self._at_work.items()]
        yield from (one for one in times if one[1] > least)

    def close(self) -> None:
        """Leave the scheduler, which forgets what was in work."""
        with suppress(Exception):
            self._client.close()


def _ending(job: Job, future: Future[Any]) -> Ending:
    """Return what came of a job, or that its workers died."""
    try:
        ending: Ending = future.result()
    except RefusedError:
        raise
    except Exception as error:
        # All of its estimates are suspect: what a worker knows is lost with it.
        return Ending([Begun(job.keys)], f"{type(error).__name__}: the workers that had it died or were lost")
    return ending


def _contents(plan: Plan) -> dict[str, bytes]:
    """Return the files that data sets are made from, by hash."""
    found: dict[str, str] = {}
    for cell in plan.data_cells:
        found |= files_of(cell.source)
    try:
        return {sha256: Path(path).read_bytes() for sha256, path in found.items()}
    except OSError as error:
        raise DataError(f"{error.filename}: the file cannot be read: {error.strerror}") from error


def files_of(source: Any) -> dict[str, str]:
    """Return the files that a source is made from: hash of the content to path."""
    found: dict[str, str] = {}
    if dataclasses.is_dataclass(source):
        if getattr(source, "file", None) and getattr(source, "sha256", None):
            found[str(source.sha256)] = str(source.file)  # type: ignore[union-attr, unused-ignore]
        for part in dataclasses.fields(source):
            found |= files_of(getattr(source, part.name))
    return found


# ----------------------------------------------------------------------------------------------------------------------
# On a worker


def on_worker(
    function: Callable[..., Ending],
    keys: Collection[Key],
    content: bytes,
    limits: Limits,
    expected: bytes,
    files: Mapping[str, bytes],
) -> Ending:
    """Compute a job on a worker that is as the process of the run."""
    _require_same(expected)
    if files:
        _, job = pickle.loads(content)
        cell = dataclasses.replace(job.cell, source=located(job.cell.source, files))
        content = packed(dataclasses.replace(job, cell=cell))
    with TemporaryFolder() as folder:
        return function(keys, content, limits, folder)


def compute_there(keys: Collection[Key], content: bytes, limits: Limits, folder: Path) -> Ending:
    """Compute a job in the process of the worker."""
    return Ending(compute(keys, content, str(folder / "record"), limits))


@cache
def _require_same(expected: bytes) -> None:
    """Refuse to compute with several threads, or where estimates would come from another origin."""
    from distributed import get_worker

    _, ours, parts = pickle.loads(expected)
    worker = get_worker()
    who = f"worker {worker.address} on {platform.node()}"
    if worker.state.nthreads != 1:
        raise RefusedError(f"{who} has {worker.state.nthreads} threads; start it with --nthreads 1")
    pairs = origin_differences(ours, origin_of(*parts))
    if pairs:
        differences = "; ".join(f"{name} {here} here, {there} there" for name, here, there in pairs)
        raise RefusedError(f"{who} is of other code or arithmetic ({differences})")


#: Folder of the files that were sent along, named by the hash of their content.
_kept: list[TemporaryFolder] = []


def located(source: Any, files: Mapping[str, bytes]) -> Any:
    """Return a source whose files are read from where they are on this machine."""
    if not dataclasses.is_dataclass(source) or isinstance(source, type):
        return source
    values = {part.name: getattr(source, part.name) for part in dataclasses.fields(source)}
    changes = {name: found for name, value in values.items() if (found := located(value, files)) is not value}
    sha256 = getattr(source, "sha256", None)
    if sha256 in files and not _holds(Path(source.file), str(sha256)):  # type: ignore[attr-defined]
        if not _kept:
            _kept.append(TemporaryFolder())
        path = _kept[0].path / str(sha256)
        if not path.exists():
            path.write_bytes(files[str(sha256)])
        changes["file"] = str(path)
    return dataclasses.replace(source, **changes) if changes else source


def _holds(path: Path, sha256: str) -> bool:
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest() == sha256
    except OSError:
        return False
