"""Worker processes on this machine: joblib's loky, one executor for each, so that the death of one hurts no other.

Separate processes are used for one job at a time as well, because only they can be lost without losing the run, and
only they can be given one BLAS thread: with more, results have other last bits.
"""

from __future__ import annotations

import atexit
import itertools
import os
import queue
import re
import signal
import threading
import time
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import BrokenExecutor
from contextlib import suppress
from typing import Any

from ctid_cli import custom_code
from ctid_cli.running.executor import Begun, Cause, Computed, Done, Hindered, Lost, Message
from ctid_cli.running.job import Job, Short, shortage
from ctid_cli.running.limits import Limits, Usage, usage
from ctid_cli.running.progress import ProgressReader
from ctid_cli.running.worker import Mark, Received, call, compute, initialise
from ctid_cli.storage.manifest import Key, Outcome
from ctid_cli.temporary import TemporaryFolder

#: Jobs that a worker has ready, beside the one it is at: it never waits for what is to be stored first.
AHEAD = 1
#: How often running jobs are looked at [s].
TICK = 0.05
#: The most that counts between two looks [s]: this process may have been stopped meanwhile, and its workers too.
LONGEST_LOOK = 1.0
#: How long a process that is dying may take [s].
LAST_BREATH = 10.0
#: Idle workers end after this time [s].
IDLE = 300.0
_LIBRARIES = ("OMP", "OPENBLAS", "MKL", "BLIS", "VECLIB_MAXIMUM", "NUMBA", "NUMEXPR")
_ONE_THREAD = {f"{name}_NUM_THREADS": "1" for name in _LIBRARIES}
#: Signals that no estimate sends itself by mistake: something else ended its process.
_FROM_OUTSIDE = {"SIGKILL", "SIGTERM", "SIGINT", "SIGHUP", "SIGQUIT", "SIGXCPU", "SIGXFSZ"}


class LokyPool:
    """An executor of worker processes on this machine; they are kept for the next one."""

    def __init__(self, workers: int, limits: Limits | None = None) -> None:
        self._limits = limits or Limits()
        _make_room(64 + 8 * workers)
        self._workers = [_idle.pop() if _idle else _Worker() for _ in range(workers)]
        end_idle_workers()
        self._folder = TemporaryFolder()
        self._numbers = itertools.count()
        self._over: queue.SimpleQueue[tuple[_Worker, _Turn]] = queue.SimpleQueue()
        self._messages: list[Message] = []
        #: Jobs that no process could take yet, and whether they are to be alone.
        self._held: list[tuple[Job, bool]] = []
        #: Time that was watched [s].
        self._clock, self._looked = 0.0, time.monotonic()

    @property
    def room(self) -> int:
        """How many further jobs it would begin, or keep ready, now."""
        if self._messages or any(alone for _, alone in self._held):
            # A process could not be started, or some worker is to become idle.
            return 0
        return max(sum(1 + AHEAD - len(worker.turns) for worker in self._workers) - len(self._held), 0)

    def submit(self, job: Job, *, alone: bool = False) -> None:
        """Take a job."""
        # What is to be alone gets a new process, other jobs one that is there.
        worker = min(self._workers, key=lambda one: (len(one.turns), one.used == alone))
        if len(worker.turns) > (0 if alone else AHEAD):
            self._held.append((job, alone))
            return
        try:
            content = packed(job, self._limits)
        except Exception as error:
            self._messages.append(Lost(job, "crash", _in_one_line(error)))
            return
        if alone:
            worker.end()
        turn = _Turn(job, alone, ProgressReader(self._folder.path / str(next(self._numbers))))
        worker.turns.append(turn)
        try:
            turn.future = worker.start(compute, str(turn.reader.path), content)
        except Exception as error:
            if len(worker.turns) == 1:
                self._not_begun(worker, _in_one_line(error))
            else:
                # Its process has died, of which the job before this one will tell.
                self._held.append((worker.turns.pop().job, alone))
            return
        turn.future.add_done_callback(lambda _: self._over.put((worker, turn)))

    def _not_begun(self, worker: _Worker, reason: str) -> None:
        """A process could not be started, or ended before it had its job: there may be room for fewer."""
        was_used, turns = worker.used, worker.leave()
        worker.end()
        if not was_used:
            if not any(other.turns for other in self._workers):
                said = f"no worker process could be started ({reason})"
                self._messages += [Lost(turn.job, "machine", said) for turn in turns]
                return
            self._workers.remove(worker)
        # Otherwise it ended while it was idle.
        self._held += [(turn.job, turn.alone) for turn in turns]

    def collect(self, seconds: float) -> list[Message]:
        """What has happened since the last call."""
        self._spread()
        if not self._messages:
            with suppress(queue.Empty):
                self._finish(*self._over.get(timeout=seconds))
        with suppress(queue.Empty):
            while True:
                self._finish(*self._over.get_nowait())
        if time.monotonic() - self._looked >= TICK:
            self._look()
        held, self._held = self._held, []
        for job, alone in held:
            self.submit(job, alone=alone)
        messages, self._messages = self._messages, []
        return messages

    def _spread(self) -> None:
        """Give an idle worker, for which there was no other job, what a busy one was to do next."""
        idle = [worker for worker in self._workers if not worker.turns]
        busy = [worker for worker in self._workers if len(worker.turns) > 1]
        for _, worker in zip(idle, busy, strict=False):
            if (job := worker.take_back()) is not None:
                self.submit(job)

    def _finish(self, worker: _Worker, turn: _Turn) -> None:
        """A worker is through with a job, or its process has died."""
        if turn not in worker.turns:
            return
        error = turn.future.exception()
        if error is None:
            self._read(turn)
            worker.used = True
            worker.drop(turn)
            self._messages.append(Done(turn.job))
            return
        if isinstance(error, BrokenExecutor):
            for one in worker.turns:
                self._read(one)
            # The process works on one after the other: it was at the last that it has begun.
            if worker.at_work is None:
                self._not_begun(worker, _ending(error)[1])
                return
            turn = worker.at_work
        self._lose(worker, turn)
        self._messages.append(Lost(turn.job, *cause_of(error, worker.exit_code), turn.keys))

    def _lose(self, worker: _Worker, culprit: _Turn) -> None:
        """End the process of a worker because of one of its jobs; no other is to blame."""
        _end([worker])
        for turn in worker.leave():
            self._read(turn)
            if turn is culprit:
                continue
            if turn.process:
                self._messages.append(Lost(turn.job, "chance", "its process was ended because of another job"))
            else:
                self._held.append((turn.job, turn.alone))

    def _read(self, turn: _Turn) -> None:
        """What the progress of a job says that is new."""
        outcomes = []
        for entry in turn.reader.news():
            match entry:
                case Received():
                    turn.process = entry.process
                    self._messages.append(Begun(turn.job))
                case Mark():
                    turn.keys, turn.mark, turn.since = entry.began.keys, entry, self._clock
                case Outcome():
                    outcomes.append(entry)
                    turn.keys = tuple(key for key in turn.keys if key != entry.key)
                case Short():
                    self._messages.append(Hindered(turn.job, entry.keys, entry.reason))
                    turn.keys = tuple(key for key in turn.keys if key not in entry.keys)
        if outcomes:
            self._messages.append(Computed(turn.job, outcomes))

    def _look(self) -> None:
        """Read what all workers have written, and end those that exceed a limit."""
        now = time.monotonic()
        self._clock += min(now - self._looked, LONGEST_LOOK)
        self._looked = now
        for worker in self._workers:
            for turn in worker.turns:
                self._read(turn)
            if self._limits and worker.at_work is not None:
                self._watch(worker, worker.at_work)

    def _watch(self, worker: _Worker, turn: _Turn) -> None:
        """End a process whose estimate exceeds a limit."""
        blamed, exceeded = turn.keys, self._exceeded(turn)
        if not blamed or exceeded is None:
            return
        self._lose(worker, turn)
        # It may have been finished just before.
        left = tuple(key for key in turn.keys if key in blamed)
        self._messages.append(
            Lost(turn.job, *exceeded, left) if left else Lost(turn.job, "chance", "another was at work")
        )

    def _exceeded(self, turn: _Turn) -> tuple[Cause, str] | None:
        mark = turn.mark
        if mark is None:
            return None
        wall, cpu = mark.began.spent
        now = usage(turn.process) if mark.used is not None and self._limits.of_processes else None
        grown = Usage(0.0, 0.0) if now is None or mark.used is None else now - mark.used
        return self._limits.exceeded(wall + self._clock - turn.since, cpu + grown.cpu, grown.memory)

    def stop(self) -> None:
        """Abandon what is in work at once."""
        _end(self._workers)
        for worker in self._workers:
            worker.leave()
        self._held.clear()

    def close(self) -> None:
        """Keep idle processes for another run."""
        if any(worker.turns for worker in self._workers):
            self.stop()
        _idle.extend(worker for worker in self._workers if worker.used)
        self._workers = []
        self._folder.close()


class _Turn:
    """A job that a worker is at, or will be at next, and how far it is."""

    def __init__(self, job: Job, alone: bool, reader: ProgressReader) -> None:
        self.job, self.alone, self.reader = job, alone, reader
        self.future: Any = None
        #: Number of the process, once it has the job; what it is at, and since when.
        self.process = 0
        self.keys: tuple[Key, ...] = ()
        self.mark: Mark | None = None
        self.since = 0.0


class _Worker:
    """One process at a time, and the jobs that it has."""

    def __init__(self) -> None:
        self._executor: Any = None
        self._process: Any = None
        #: Whether the process has done something.
        self.used = False
        self.turns: list[_Turn] = []

    @property
    def at_work(self) -> _Turn | None:
        """The job that the process is at, as far as is known."""
        return next((turn for turn in reversed(self.turns) if turn.process), None)

    def drop(self, turn: _Turn) -> None:
        """Forget a job that is over."""
        self.turns.remove(turn)
        with suppress(OSError):
            turn.reader.path.unlink(missing_ok=True)

    def leave(self) -> list[_Turn]:
        """Forget all jobs, finished or not."""
        turns, self.turns = self.turns, []
        return turns

    def take_back(self) -> Job | None:
        """The last job, unless the process has begun it: whoever makes the file of its progress has it."""
        turn = self.turns[-1]
        try:
            turn.reader.path.touch(exist_ok=False)
        except OSError:
            return None
        return self.turns.pop().job

    def start(self, function: Callable[..., Any], path: str, packed: bytes) -> Any:
        """Have a function called in the process."""
        if self._executor is None:
            self._executor = _executor()
        future = self._executor.submit(function, path, packed)
        self._process = next(iter(list(self._executor._processes.values())), None)
        return future

    def exit_code(self) -> int | None:
        """How the process ended, once it has; None if that is not known."""
        if self._process is None:
            return None
        self._process.join(LAST_BREATH)
        code: int | None = self._process.exitcode
        return code

    def usage(self) -> Usage | None:
        """What the process uses."""
        return next((usage(number) for number in list(self._executor._processes)), None)

    def end(self) -> threading.Thread | None:
        """End the process, and what it has started; the thread that sees to it is over when they are gone."""
        executor, self._executor, self.used = self._executor, None, False
        if executor is None:
            return None
        thread: threading.Thread | None = executor._executor_manager_thread
        with suppress(Exception), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            # Otherwise what is on its way to a process that is gone would be waited for.
            executor._call_queue._reader.close()
            executor.shutdown(wait=False, kill_workers=True)
        return thread


def _executor() -> Any:
    from joblib.externals.loky import ProcessPoolExecutor

    # Executors that are left when Python takes its modules apart complain of that.
    atexit.unregister(end_idle_workers)
    atexit.register(end_idle_workers)
    return ProcessPoolExecutor(1, timeout=IDLE, initializer=initialise, initargs=(os.getpid(),), env=_ONE_THREAD)


#: Workers that another run has left behind.
_idle: list[_Worker] = []
#: Those of a parent: kept, since what ends with them would wait for threads that are not here.
_not_ours: list[_Worker] = []


def _end(workers: Sequence[_Worker]) -> None:
    """End processes, and wait until they are gone."""
    for thread in [worker.end() for worker in workers]:
        if thread is not None:
            thread.join()


def _leave_to_parent() -> None:
    """Forget the processes of the one that this was forked from: their threads are not here."""
    _not_ours.extend(_idle)
    _idle.clear()


os.register_at_fork(after_in_child=_leave_to_parent)


def end_idle_workers() -> None:
    """End the processes that are kept for another run."""
    workers = list(_idle)
    _idle.clear()
    _end(workers)


def in_worker(
    function: Callable[..., Any], *given: Any, limits: Limits, stopping: Callable[[], bool] = lambda: False
) -> Any:
    """What a function answers in a worker process; None if the process died of it, or took more than is allowed."""
    worker = _idle.pop() if _idle else _Worker()
    try:
        future = worker.start(call, "", packed(function, given))
        begun, before = time.monotonic(), worker.usage()
        while not stopping():
            took, now = time.monotonic() - begun, worker.usage()
            if limits.exceeded(took, took, 0.0 if now is None or before is None else (now - before).memory):
                break
            with suppress(TimeoutError):
                answer = future.result(timeout=TICK)
                worker.used = True
                _idle.append(worker)
                return answer
    except Exception:
        pass
    finally:
        if worker not in _idle:
            _end([worker])
    return None


def _make_room(files: int) -> None:
    """Allow this process so many open files, as far as it may."""
    with suppress(ImportError, ValueError, OSError):
        import resource

        soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        if soft < files and soft != resource.RLIM_INFINITY:
            most = files if hard == resource.RLIM_INFINITY else min(files, hard)
            resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))


def packed(*content: Any) -> bytes:
    """Content for a worker, after the code of one's own that it needs to read it."""
    from joblib.externals.loky.backend.reduction import dumps

    return bytes(dumps((custom_code.served(), *content)))


def _in_one_line(error: BaseException) -> str:
    first = str(error).strip().partition("\n")[0]
    return f"{type(error).__name__}: {first}"


def cause_of(error: BaseException, exit_code: Callable[[], int | None] = lambda: None) -> tuple[Cause, str]:
    """Why a job was lost; the exit code of its process is asked for where the error does not tell it."""
    if isinstance(error, BrokenExecutor):
        return _ending(error, exit_code)
    short = shortage(error)
    return ("machine", short) if short else ("crash", _in_one_line(error))


def _ending(error: BaseException, exit_code: Callable[[], int | None] = lambda: None) -> tuple[Cause, str]:
    """How a process ended, in the words of loky's long explanation."""
    found = re.search(r"(SIG[A-Z0-9]+|EXIT|UNKNOWN)\((-?\d+)\)", str(error))
    if found is not None:
        name, number = found.groups()
    else:
        # loky waits a quarter of a second for it, which a process with much memory may exceed.
        code = exit_code()
        if code is None:
            return "machine", _in_one_line(error)
        name, number = (signal.Signals(-code).name if code < 0 else "EXIT"), str(code)
    how = name if name.startswith("SIG") else f"exit code {number}"
    return ("machine" if name in _FROM_OUTSIDE else "crash"), how
