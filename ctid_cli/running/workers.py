"""Worker processes of joblib's loky, and separate processes for the jobs of dead workers.

loky gives up all workers when one of them dies. Each worker keeps a record of its job, a file with the begun and
finished estimates, so that no results are lost and the suspects are known: one for each worker. Every suspect is
computed again in a separate process, whose exit code decides.
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
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, ThreadPoolExecutor, wait
from contextlib import suppress
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from ctid_cli import custom_code
from ctid_cli.running.job import Begun, Entry, Job, ended, run_job
from ctid_cli.running.limits import Limits, StopRequest
from ctid_cli.signals.files import COPIES
from ctid_cli.storage.manifest import Key, Outcome

#: Longest wait for a finished job before the caller regains control [s].
TICK = 0.1
#: Time beyond one and a half times its limit after which a process is killed that its own watchdog has not ended [s].
GRACE = 3.0
#: Lifetime of idle workers [s].
IDLE = 300.0
#: File next to the folders of jobs; while it exists, workers begin no further jobs.
_STOP = "stop"
_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_LIBRARIES = ("OMP", "OPENBLAS", "MKL", "BLIS", "VECLIB_MAXIMUM", "NUMBA", "NUMEXPR")
#: With more threads, the last bits of linear algebra differ.
_ONE_THREAD = {f"{name}_NUM_THREADS": "1" for name in _LIBRARIES}
_PR_SET_PDEATHSIG = 1


class Task(NamedTuple):
    """A job in the form sent to another process."""

    keys: tuple[Key, ...]
    content: bytes


class Ending(NamedTuple):
    """Results of a job, and how its process ended."""

    #: Begun and finished estimates, in order.
    entries: list[Entry]
    #: Empty if the job is complete; otherwise a signal, an exit code, or the reason why there is neither.
    how: str = ""
    #: Whether the wall time limit ended it, and its processor time since the last beginning [s].
    late: bool = False
    processor: float = 0.0

    @property
    def begun(self) -> tuple[Key, ...]:
        """The estimates that were last in progress."""
        return next((entry.keys for entry in reversed(self.entries) if isinstance(entry, Begun)), ())


#: Finished jobs in any order; None after a while without one.
Results = Generator[tuple[Job, Ending] | None]


# ----------------------------------------------------------------------------------------------------------------------
# In a worker


def initialise(parent: int) -> None:
    """Set up a new worker process: it ignores signals, which its parent handles, and ends with its parent.

    On Linux the kernel ends it; elsewhere a thread polls.
    """
    for number in _SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    # Output of custom estimators must not mix with that of the command.
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
    """Compute the estimates of a job under limits, and keep a record of those begun and finished."""
    found: list[Entry] = []
    in_work = task.keys
    # The traceback of a process that dies would garble the terminal; loky enables it.
    faulthandler.disable()
    try:
        record.parent.mkdir(exist_ok=True)
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


def compute_unless_stopped(task: Task, limits: Limits, folder: Path) -> Ending:
    """Compute a job unless the run is to stop."""
    return Ending([] if folder.with_name(_STOP).exists() else compute(task, folder / "record", limits))


def main() -> None:
    """Call a function read from a file, and write its result to another: the main program of a separate process."""
    folder, parent = Path(sys.argv[1]), int(sys.argv[2])
    initialise(parent)
    function, given = unpacked((folder / "call").read_bytes())
    (folder / "returned").write_bytes(pickle.dumps(function(*given)))


# ----------------------------------------------------------------------------------------------------------------------
# In the process of the run


def packed(*content: Any) -> bytes:
    """Return content for another process, preceded by the custom code and files needed to read it."""
    return pickle.dumps((custom_code.served(), COPIES, pickle.dumps(content)))


def unpacked(data: bytes) -> list[Any]:
    """Return content from another process."""
    sources, copies, content = pickle.loads(data)
    custom_code.serve(sources)
    COPIES.update(copies)
    return list(pickle.loads(content))


def call_alone(folder: Path, function: Callable[..., Any], *given: Any) -> tuple[Any, str, float]:
    """Call a function in a separate process, by files in a folder, and wait for it.

    Returns the result, or how the process ended without one, and the processor time [s].
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
    """Compute a job in a separate process; return its results and how the process ended."""
    record = folder / "record"
    try:
        found, how, used = call_alone(folder, compute, task, record, limits)
    except OSError as error:
        return Ending([], f"no process could be started ({error.strerror or error})")
    return _remains(record, how, used) if how else Ending(found)


def _remains(record: Path, how: str, used: float = 0.0) -> Ending:
    """Return the content of the record of a dead process."""
    entries, late = _read(record)[1:], _late(record)
    since = next((entry.since for entry in reversed(entries) if isinstance(entry, Begun)), 0.0)
    return Ending(entries, how, late.exists() and late.stat().st_size > 0, used - since)


def _late(record: Path) -> Path:
    """Return the file that is not empty if a job has exceeded its wall time."""
    return record.with_suffix(".late")


def _read(record: Path) -> list[Any]:
    entries = []
    # A worker may have died while writing an entry, or before the first.
    with suppress(OSError, EOFError, pickle.UnpicklingError), record.open("rb") as file:
        while True:
            entries.append(pickle.load(file))
    return entries


def in_parallel(
    jobs: Iterator[Job],
    submit: Callable[[Job, Task], Future[Ending]],
    at_once: Callable[[], int],
    died: Callable[[Job, Exception], Ending],
) -> Results:
    """Keep a number of jobs in progress, and yield each with its result; None after a while without one."""
    in_work: dict[Future[Ending], Job] = {}
    while True:
        while len(in_work) < at_once() and (job := next(jobs, None)) is not None:
            task = task_of(job)
            if isinstance(task, Ending):
                yield job, task
            else:
                in_work[submit(job, task)] = job
        if not in_work:
            return
        done, _ = wait(in_work, TICK, FIRST_COMPLETED)
        for future in done:
            job = in_work.pop(future)
            try:
                ending = future.result()
            except Exception as error:
                ending = died(job, error)
            yield job, ending
        if not done:
            yield None


def task_of(job: Job) -> Task | Ending:
    """Return a job in the form to send, or its ending if it cannot be sent."""
    try:
        return Task(job.keys, packed(job))
    except Exception as error:
        return Ending(list(ended(job.keys, error, Limits())))


@cache
def _loky_thread(process: int) -> ThreadPoolExecutor:
    """Return the one thread of this process that starts workers, for as long as the process lives.

    Workers end with the thread that started them, and inherit that it leaves signals to others.
    """
    return ThreadPoolExecutor(1, "loky", lambda: signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS))


def _submit_to_loky(count: int, *call: Any) -> Future[Ending]:
    """Submit a call to the workers of this process, which are started if necessary."""
    from joblib.externals.loky import get_reusable_executor

    start = {"initializer": initialise, "initargs": (os.getpid(),), "env": _ONE_THREAD}
    future: Future[Ending] = get_reusable_executor(count, timeout=IDLE, **start).submit(*call)
    return future


class LocalWorkers:
    """Worker processes on this machine, which loky keeps for the next run."""

    def __init__(self, count: int, limits: Limits) -> None:
        self.count, self._limits = count, limits
        #: Why the last workers ended early.
        self.ended_by = ""
        self._made = TemporaryDirectory(prefix="ctid-", ignore_cleanup_errors=True)
        self._folder = Path(self._made.name)
        self._numbers = itertools.count()
        #: Records and futures of the jobs in progress.
        self._at_work: dict[Job, tuple[Path, Future[Ending]]] = {}

    def results(self, jobs: Iterator[Job], stopping: StopRequest) -> Results:
        """Compute jobs and yield their endings in any order; None after a while without one.

        If a worker dies, the jobs in progress are yielded last, with their records, and no further jobs are taken. One
        job more than there are workers is submitted, so that no worker waits for this process; after a stop it is not
        computed.
        """
        stop = self._folder / _STOP
        stop.unlink(missing_ok=True)
        self.ended_by = ""

        def submit(*call: Any) -> Future[Ending]:
            try:
                return _loky_thread(os.getpid()).submit(_submit_to_loky, self.count, *call).result()
            except Exception as error:
                failed: Future[Ending] = Future()
                # The frames of its traceback would keep descriptors open.
                failed.set_exception(error.with_traceback(None))
                return failed

        def died(job: Job, error: Exception) -> Ending:
            if not isinstance(error, BrokenExecutor | OSError | MemoryError):
                raise error
            self.ended_by = str(error).strip().partition("\n")[0] or type(error).__name__
            return _remains(self._at_work[job][0], self.ended_by)

        def at_once() -> int:
            if stopping():
                stop.touch()
            return 0 if self.ended_by else self.count + 1

        yield from self._computed(jobs, compute_unless_stopped, submit, at_once, died, stopping)

    def alone(self, jobs: Iterator[Job], at_once: int, stopping: StopRequest) -> Results:
        """Compute each job in a separate process, several at a time."""

        def died(job: Job, error: Exception) -> Ending:
            raise error

        with ThreadPoolExecutor(at_once) as threads:
            yield from self._computed(jobs, compute_alone, threads.submit, lambda: at_once, died, stopping)

    def _computed(
        self,
        jobs: Iterator[Job],
        function: Callable[..., Ending],
        submit: Callable[..., Future[Ending]],
        at_once: Callable[[], int],
        died: Callable[[Job, Exception], Ending],
        stopping: StopRequest,
    ) -> Results:
        """Compute jobs, each with a folder for its record, and end what exceeds its time."""

        def begin(job: Job, task: Task) -> Future[Ending]:
            folder = self._folder / str(next(self._numbers))
            future = submit(function, task, self._limits, folder)
            self._at_work[job] = folder / "record", future
            return future

        try:
            for over in in_parallel(jobs, begin, at_once, died):
                if over is None:
                    self._watch(stopping)
                elif over[0] in self._at_work:
                    record, _ = self._at_work.pop(over[0])
                    shutil.rmtree(record.parent, ignore_errors=True)
                yield over
        finally:
            # Jobs in progress would delay the end.
            while not all(future.done() for _, future in self._at_work.values()):
                for record, _ in self._at_work.values():
                    _kill(record)
                time.sleep(TICK)
            self._at_work.clear()

    def _watch(self, stopping: StopRequest) -> None:
        """Kill jobs that continue after a stop, or that their own watchdog should have ended at their wall time.

        A process that is stopped (SIGSTOP) has no watchdog.
        """
        limit = self._limits.wall_seconds
        for record, _ in self._at_work.values():
            if stopping.overdue:
                _kill(record)
            if limit is None:
                continue
            with suppress(OSError):
                seconds = time.time() - record.stat().st_mtime
                # The time of imports before the first estimate does not count.
                if seconds > limit * 1.5 + GRACE and _remains(record, "").begun:
                    _late(record).write_bytes(b"killed")
                    _kill(record)

    def close(self) -> None:
        """Remove the records."""
        self._made.cleanup()


def _kill(record: Path) -> None:
    """Kill the process that keeps a record."""
    for process in _read(record)[:1]:
        with suppress(OSError):
            os.kill(process, signal.SIGKILL)
