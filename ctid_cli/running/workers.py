"""Worker processes: jobs go through loky, and what a process died of is computed again, alone in a process.

loky gives up a whole set of workers when one of them dies. Each worker keeps a record of its job, a file that says
which estimates it has begun and finished, so that nothing is lost with it and the suspects are known: one for each
worker. Every suspect is computed again in a process of its own, whose exit code decides.
"""

from __future__ import annotations

import ctypes
import faulthandler
import itertools
import os
import pickle
import shutil
import signal
import subprocess
import sys
import threading
import time
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, ThreadPoolExecutor, wait
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from ctid_cli import custom_code
from ctid_cli.running.job import Begun, Entry, Job, ended, run_job
from ctid_cli.running.limits import Limits
from ctid_cli.signals.files import COPIES
from ctid_cli.storage.manifest import Key, Outcome
from ctid_cli.temporary import TemporaryFolder

#: How often the caller gets a chance to do something else while nothing is finished [s].
TICK = 0.1
#: Time beyond one and a half times its limit after which a process is killed that its own watchdog has not ended [s].
GRACE = 3.0
#: How long an idle worker waits for the next run [s].
IDLE = 300.0
#: A file that tells workers to begin nothing more.
_STOP = "stop"
#: In the folder of a job, the record of what its process has begun and finished.
_RECORD = "record"
_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_LIBRARIES = ("OMP", "OPENBLAS", "MKL", "BLIS", "VECLIB_MAXIMUM", "NUMBA", "NUMEXPR")
#: With more threads, linear algebra has other last bits.
_ONE_THREAD = {f"{name}_NUM_THREADS": "1" for name in _LIBRARIES}
_PR_SET_PDEATHSIG = 1


class Task(NamedTuple):
    """A job on its way to another process."""

    keys: tuple[Key, ...]
    content: bytes


class Ending(NamedTuple):
    """What came of a job, and how its process ended."""

    #: What was begun and finished, in this order.
    entries: list[Entry]
    #: Empty where the job is over; else a signal, an exit code, or why there is neither.
    how: str = ""
    #: Whether the limit of wall time ended it, and the processor time that it had since the last beginning [s].
    late: bool = False
    processor: float = 0.0

    @property
    def begun(self) -> tuple[Key, ...]:
        """The estimates that were in work last."""
        return next((entry.keys for entry in reversed(self.entries) if isinstance(entry, Begun)), ())


#: Jobs that are over, in any order; None where nothing has come for a while.
Results = Generator[tuple[Job, Ending] | None]


# ----------------------------------------------------------------------------------------------------------------------
# In a worker


def initialise(parent: int) -> None:
    """Set up a new worker process: it leaves signals to its parent, and must not outlive it.

    Linux can be asked to see to that, elsewhere a thread looks now and then.
    """
    for number in _SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    # What a custom estimator prints must not stand between the lines of a table.
    sys.stdout = sys.stderr
    # Estimators report through their status; warnings of several workers at once would only garble the terminal.
    warnings.simplefilter("ignore")
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:
            os._exit(1)
    else:
        threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(1.0)
    os._exit(1)


def compute(task: Task, record: Path, limits: Limits) -> list[Entry]:
    """Compute the estimates of a job under limits, and keep a record of what is begun and finished."""
    found: list[Entry] = []
    in_work = task.keys
    # The traceback of a process that dies would garble the terminal; loky has asked for it.
    faulthandler.disable()
    try:
        with record.open("wb", buffering=0) as file, _late(record).open("wb") as late:
            file.write(pickle.dumps(os.getpid()))
            # The code of custom components is imported here.
            for entry in run_job(unpacked(task.content)[0], limits):
                if isinstance(entry, Begun):
                    in_work = entry.keys
                    file.write(pickle.dumps(entry._replace(since=time.process_time())))
                    limits.begin(late, entry.spent)
                else:
                    file.write(pickle.dumps(entry))
                    found.append(entry)
    except BaseException as error:
        limits.end()
        finished = {entry.key for entry in found if isinstance(entry, Outcome)}
        found += ended([key for key in in_work if key not in finished], error, limits)
    finally:
        limits.end()
    return found


def _compute_unless_stopped(task: Task, limits: Limits, folder: Path) -> Ending:
    """Compute a job unless the run is to stop."""
    stopped = (folder.parent / _STOP).exists()
    return Ending([] if stopped else compute(task, folder / _RECORD, limits))


def main() -> None:
    """Call the function that a file holds, and write what it returns to another: a process of its own does this."""
    folder, parent = Path(sys.argv[1]), int(sys.argv[2])
    initialise(parent)
    function, given = unpacked((folder / "call").read_bytes())
    (folder / "returned").write_bytes(pickle.dumps(function(*given)))


# ----------------------------------------------------------------------------------------------------------------------
# In the process of the run


def packed(*content: Any) -> bytes:
    """Return content for another process, after the custom code that it needs to read it and the files it was sent."""
    return pickle.dumps((custom_code.served(), COPIES, *content))


def unpacked(data: bytes) -> list[Any]:
    """Return content from another process."""
    content: list[Any]
    _, copies, *content = pickle.loads(data)
    COPIES.update(copies)
    return content


def call_alone(folder: Path, function: Callable[..., Any], *given: Any) -> tuple[Any, str, float]:
    """Call a function in a process of its own, through files in a folder; waits for it.

    Returns what it returned, or how the process ended before that, and the processor time [s].
    """
    folder.mkdir(exist_ok=True)
    (folder / "call").write_bytes(packed(function, given))
    program = "from ctid_cli.running.workers import main; main()"
    process = subprocess.Popen(
        [sys.executable, "-c", program, str(folder), str(os.getpid())],
        env=os.environ | _ONE_THREAD | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        stdin=subprocess.DEVNULL,
        stdout=2,
        # A terminal's Ctrl-C does not reach it there.
        start_new_session=True,
    )
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = code = os.waitstatus_to_exitcode(status)
    processor = used.ru_utime + used.ru_stime
    try:
        return pickle.loads((folder / "returned").read_bytes()), "", processor
    except (OSError, EOFError, pickle.UnpicklingError):
        return None, signal.Signals(-code).name if code < 0 else f"exit code {code}", processor


def compute_alone(task: Task, limits: Limits, folder: Path) -> Ending:
    """Compute a job in a process of its own, which is told how it ended."""
    record = folder / _RECORD
    try:
        found, how, used = call_alone(folder, compute, task, record, limits)
    except OSError as error:
        return Ending([], f"no process could be started ({error.strerror or error})")
    return _remains(record, how, used) if how else Ending(found)


def _remains(record: Path, how: str, used: float = 0.0) -> Ending:
    """Return what the record of a dead process says."""
    entries, late = _read(record)[1:], _late(record)
    since = next((entry.since for entry in reversed(entries) if isinstance(entry, Begun)), 0.0)
    return Ending(entries, how, late.exists() and late.stat().st_size > 0, used - since)


def _late(record: Path) -> Path:
    """Return the file that is not empty where a job has exceeded its wall time."""
    return record.with_suffix(".late")


def _read(record: Path) -> list[Any]:
    entries = []
    # A worker may have died in the midst of an entry, or before the first.
    with suppress(OSError, EOFError, pickle.UnpicklingError), record.open("rb") as file:
        while True:
            entries.append(pickle.load(file))
    return entries


class Workers(ABC):
    """Processes that compute jobs, on this machine or on others."""

    #: How many jobs they compute at the same time.
    count: int

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        #: Why the last workers ended before all was done.
        self.trouble = ""
        self._at_work: dict[Job, Future[Ending]] = {}

    @abstractmethod
    def results(self, jobs: Iterator[Job], stopping: Callable[[], bool]) -> Results:
        """Compute jobs and yield what comes of them, in any order; None where nothing has come for a while."""

    @abstractmethod
    def alone(self, jobs: Iterator[Job], at_once: int) -> Results:
        """Compute jobs each in a process of its own, some at the same time."""

    @abstractmethod
    def slow(self, least: float) -> Iterator[tuple[Job, tuple[Key, ...], float]]:
        """Yield the jobs whose estimates in work have been so for longer than this, these, and for how long [s]."""

    @abstractmethod
    def close(self) -> None:
        """Let go of what is kept for jobs."""

    @abstractmethod
    def _died(self, job: Job, error: Exception) -> Ending:
        """Return what is known of a job whose worker died."""

    @abstractmethod
    def _watch(self) -> None:
        """Look after what is in work, now and then."""

    def _abandon(self) -> None:
        """Forget what is in work."""
        self._at_work.clear()

    def _computed(
        self, jobs: Iterator[Job], start: Callable[[Job, Task], Future[Ending]], at_once: Callable[[], int]
    ) -> Results:
        """Keep a number of jobs in work, and yield each with what came of it."""
        try:
            yield from self._kept_in_work(jobs, start, at_once)
        finally:
            self._abandon()

    def _kept_in_work(
        self, jobs: Iterator[Job], start: Callable[[Job, Task], Future[Ending]], at_once: Callable[[], int]
    ) -> Results:
        while True:
            while len(self._at_work) < at_once() and (job := next(jobs, None)) is not None:
                try:
                    task = Task(job.keys, packed(job))
                except Exception as error:
                    yield job, Ending(list(ended(job.keys, error, Limits())))
                else:
                    self._at_work[job] = start(job, task)
            if not self._at_work:
                return
            done = wait(self._at_work.values(), TICK, FIRST_COMPLETED).done
            for job in [job for job, future in self._at_work.items() if future in done]:
                try:
                    ending = self._at_work[job].result()
                except Exception as error:
                    ending = self._died(job, error)
                del self._at_work[job]
                yield job, ending
            if not done:
                self._watch()
                yield None


@cache
def _starting_thread(process: int) -> ThreadPoolExecutor:
    """Return the one thread of this process that starts workers, for as long as the process lives.

    Workers end with the thread that started them, and inherit that it leaves signals to others.
    """
    return ThreadPoolExecutor(1, "workers", lambda: signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS))


class LocalWorkers(Workers):
    """Worker processes on this machine; loky keeps them for the next run."""

    def __init__(self, count: int, limits: Limits) -> None:
        super().__init__(limits)
        self.count = count
        self._folder = TemporaryFolder()
        self._stop = self._folder.path / _STOP
        #: A folder of each job, with the record of what its process has begun and finished.
        self._places: dict[Job, Path] = {}
        self._numbers = itertools.count()

    def results(self, jobs: Iterator[Job], stopping: Callable[[], bool]) -> Results:
        """Compute jobs and yield what comes of them, in any order; None where nothing has come for a while.

        If a worker dies, what was in work is yielded last, with what is known of it, and no further jobs are taken.
        Jobs that wait for the next free worker, so that none waits for this process, are not computed after a stop.
        """
        from joblib.externals.loky import get_reusable_executor

        thread, executor = _starting_thread(os.getpid()), None
        self._stop.unlink(missing_ok=True)
        self.trouble = ""
        settings = {"timeout": IDLE, "initializer": initialise, "initargs": (os.getpid(),), "env": _ONE_THREAD}

        def submitted(task: Task, place: Path) -> Future[Ending]:
            nonlocal executor
            executor = get_reusable_executor(self.count, **settings)
            future: Future[Ending] = executor.submit(_compute_unless_stopped, task, self._limits, place)
            return future

        def start(job: Job, task: Task) -> Future[Ending]:
            try:
                return thread.submit(submitted, task, self._new_place(job)).result()
            except (BrokenExecutor, OSError, MemoryError) as error:
                # What has been started keeps files open.
                if executor is not None:
                    executor.shutdown(kill_workers=True)
                future: Future[Ending] = Future()
                future.set_result(Ending([], self._note(error)))
                return future

        def at_once() -> int:
            if stopping():
                self._begin_nothing_more()
            return 0 if self.trouble else 2 * self.count + 1

        return self._computed(jobs, start, at_once)

    def alone(self, jobs: Iterator[Job], at_once: int) -> Results:
        """Compute jobs each in a process of its own, some at the same time."""
        threads = ThreadPoolExecutor(at_once)

        def start(job: Job, task: Task) -> Future[Ending]:
            return threads.submit(compute_alone, task, self._limits, self._new_place(job))

        try:
            yield from self._computed(jobs, start, lambda: at_once)
        finally:
            threads.shutdown()

    def _new_place(self, job: Job) -> Path:
        """Return a new folder for a job, in place of that of one which is over."""
        for over in self._places.keys() - self._at_work.keys():
            shutil.rmtree(self._places.pop(over), ignore_errors=True)
        self._places[job] = place = self._folder.path / str(next(self._numbers))
        place.mkdir()
        return place

    def _died(self, job: Job, error: Exception) -> Ending:
        """Return what is known of a job whose worker died."""
        if not isinstance(error, BrokenExecutor | OSError | MemoryError):
            raise error
        return _remains(self._places[job] / _RECORD, self._note(error))

    def _note(self, error: BaseException) -> str:
        """Note why the workers ended, and return it."""
        self.trouble = str(error).strip().partition("\n")[0] or type(error).__name__
        return self.trouble

    def _abandon(self) -> None:
        """Kill what is in work, which would be waited for otherwise, until all has ended."""
        self._begin_nothing_more()
        while not all(future.done() for future in self._at_work.values()):
            for job in self._at_work:
                _kill(self._places[job] / _RECORD)
            time.sleep(TICK)
        super()._abandon()

    def _begin_nothing_more(self) -> None:
        # Without the file workers begin what waits for them, which is slower and no worse.
        with suppress(OSError):
            self._stop.touch()

    def _seconds(self) -> Iterator[tuple[Job, Path, float]]:
        """Yield each job in work, its record, and for how long its estimate has been in work [s]."""
        for job in self._at_work:
            record = self._places[job] / _RECORD
            with suppress(OSError):
                yield job, record, time.time() - record.stat().st_mtime

    def _watch(self) -> None:
        """Kill what its own watchdog should have ended long ago: a process that is stopped has none."""
        if self._limits.wall_seconds is not None:
            for _, record, seconds in self._seconds():
                # What it imports before its first estimate counts for none.
                if seconds > self._limits.wall_seconds * 1.5 + GRACE and _remains(record, "").begun:
                    _late(record).write_bytes(b"killed")
                    _kill(record)

    def slow(self, least: float) -> Iterator[tuple[Job, tuple[Key, ...], float]]:
        """Yield the jobs whose estimates in work have been so for longer than this, these, and for how long [s]."""
        for job, record, seconds in self._seconds():
            if seconds > least:
                yield job, _remains(record, "").begun or job.keys, seconds

    def close(self) -> None:
        """Remove the records."""
        self._folder.close()


def _kill(record: Path) -> None:
    """Kill the process that keeps a record."""
    for process in _read(record)[:1]:
        with suppress(OSError):
            os.kill(process, signal.SIGKILL)
