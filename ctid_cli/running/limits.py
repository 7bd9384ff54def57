"""Limits of one estimate, exhausted resources of the machine, and requests to stop a run.

The operating system enforces the limits in Python and in C code: a timer of processor time, a watchdog that ends the
process after a wall time, and a memory limit that makes allocations fail.
"""

from __future__ import annotations

import errno
import faulthandler
import math
import os
import re
import resource
import signal
import sys
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any, BinaryIO, Self

from ctid_cli.errors import UsageError

_MEGABYTE = 1e6
#: Shortest timer interval [s]: zero would mean no limit.
_LEAST = 1e-3
#: Operating system errors that depend on the machine and the moment.
SHORTAGES = frozenset(
    getattr(errno, name)
    for name in ("EMFILE", "ENFILE", "ENOMEM", "EAGAIN", "ENOSPC", "EDQUOT", "EIO", "ENOLCK", "ESTALE", "ENOBUFS")
    if hasattr(errno, name)
)


@dataclass(frozen=True)
class Limits:
    """Limits of a single estimate; None for no limit."""

    #: Processor time, and wall time [s].
    cpu_seconds: float | None = None
    wall_seconds: float | None = None
    #: Memory beyond that of the process before the estimate [MB].
    memory_mb: float | None = None

    @classmethod
    def of(cls, content: Mapping[str, Any]) -> Self:
        """Read the limits from the canonical form of a specification, or from the data of a run."""
        return cls(**(content.get("limits") or {}))

    def require_support(self) -> None:
        """Refuse limits that this operating system does not support."""
        if sys.platform != "linux" and (self.cpu_seconds or self.memory_mb):
            raise UsageError(
                "limits.cpu_seconds and limits.memory_mb need Linux; use wall_seconds, which works everywhere"
            )

    def rose_since(self, other: Limits, status: str) -> bool:
        """Return whether the limit that ended an estimate with a status under other limits is now higher."""
        names = {"TIMEOUT": ("cpu_seconds", "wall_seconds"), "MEMORY": ("memory_mb",)}.get(status, ())
        pairs = [(getattr(other, name), getattr(self, name)) for name in names]
        return any(old is not None and (new is None or new > old) for old, new in pairs)

    def begin(self, watched: BinaryIO, spent: tuple[float, float] = (0.0, 0.0)) -> None:
        """Set the limits of the next estimate in this process; exceeding the wall time writes to a file."""
        if self.wall_seconds is not None:
            faulthandler.dump_traceback_later(max(self.wall_seconds - spent[0], _LEAST), exit=True, file=watched)
        if self.cpu_seconds is not None:
            # Unlike RLIMIT_CPU it counts from now, in fractions of a second, and is independent of batch systems.
            signal.setitimer(signal.ITIMER_PROF, max(self.cpu_seconds - spent[1], _LEAST))
        if self.memory_mb is not None:
            _limit_memory(_data_bytes() + int(self.memory_mb * _MEGABYTE))

    def end(self) -> None:
        """Remove the limits."""
        if self.wall_seconds is not None:
            faulthandler.cancel_dump_traceback_later()
        if self.cpu_seconds is not None:
            signal.setitimer(signal.ITIMER_PROF, 0.0)
        if self.memory_mb is not None:
            _limit_memory(None)

    def too_late(self, *, wall: bool) -> str:
        """Return the message of an estimate that exceeded a time limit."""
        if wall:
            return f"not finished after {self.wall_seconds:g} s (limits.wall_seconds)"
        return f"not finished after {self.cpu_seconds:g} s of processor time (limits.cpu_seconds)"


def _data_bytes() -> int:
    """Return the private memory of this process as counted by RLIMIT_DATA, without the code of libraries."""
    return int(Path("/proc/self/statm").read_bytes().split()[5]) * os.sysconf("SC_PAGE_SIZE")


@cache
def _given_memory() -> tuple[int, int]:
    """Return the initial memory limit of this process, and its allowed maximum."""
    return resource.getrlimit(resource.RLIMIT_DATA)


def _limit_memory(size: int | None) -> None:
    given, hard = _given_memory()
    within = given if size is None else size if given == resource.RLIM_INFINITY else min(size, given)
    resource.setrlimit(resource.RLIMIT_DATA, (within, hard))


def shortage(error: BaseException) -> BaseException | None:
    """Return the exception that names an exhausted resource; None if an error has another cause."""
    seen: BaseException | None = error
    while seen is not None:
        if isinstance(seen, MemoryError) or (isinstance(seen, OSError) and seen.errno in SHORTAGES):
            return seen
        seen = seen.__cause__ or seen.__context__
    return None


_FEWER = "use fewer worker processes (--jobs)"
#: Words in a reason, and the advice for them.
_ADVICE = (
    (
        r"SIGKILL|[Oo]ut of memory|Cannot allocate",
        f"the machine was probably out of memory: {_FEWER}, close other programs, or give limits: {{memory_mb: …}} in "
        "the specification, so that what needs more is a failure of its estimator",
    ),
    (r"Too many open files", f"raise the number of open files ('ulimit -n 4096'), or {_FEWER}"),
    (r"Resource temporarily unavailable|can't start new thread", f"raise the number of processes, or {_FEWER}"),
    (r"No space left|[Dd]isk quota", "free space on the disk, also on that of temporary files (TMPDIR)"),
    (r"SIGXCPU", "raise the limit of processor time of this shell or batch job ('ulimit -t')"),
)
_ANY = f"look whether something ends processes here, {_FEWER}, or try another machine"


def advice(reason: str) -> str:
    """Return the advice for an exhausted resource."""
    return next((text for pattern, text in _ADVICE if re.search(pattern, reason)), _ANY)


# --- requests to stop a run -------------------------------------------------------------------------------------------

_SIGNALS = (signal.SIGINT, signal.SIGTERM)

#: Time for running jobs to finish after a request to stop [s].
PATIENCE = 5.0
#: Reasons that are no signals.
TIME_BUDGET, TOO_MANY_FAILURES, MACHINE = "time budget", "failures", "machine"


class StopRequest:
    """A request to stop a run, by a signal, a time budget or a number of failures.

    After the first signal, running jobs have a few seconds to finish and be stored. The second one ends the process at
    once, as without a handler; the workers end with it, and committed estimates are safe.
    """

    def __init__(self, *, failures: int | None = None, seconds: float | None = None) -> None:
        """Stop after failed estimates of this run, or after some time [s]."""
        self.failures = failures
        self._deadline = None if seconds is None else time.monotonic() + seconds
        self._reason: str | None = None
        self._since = math.inf
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Self:
        # Python delivers signals to the main thread only.
        if threading.current_thread() is threading.main_thread():
            for number in _SIGNALS:
                self._before[number] = signal.signal(number, self._note)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.request(signal.Signals(number).name)
        for each in _SIGNALS:
            signal.signal(each, signal.SIG_DFL)

    def request(self, reason: str) -> None:
        """Request a stop; the first reason is kept."""
        if self._reason is None:
            self._reason, self._since = reason, time.monotonic()

    def __call__(self) -> bool:
        """Return whether a stop was requested."""
        return self.reason is not None

    @property
    def overdue(self) -> bool:
        """Whether the time to finish running jobs after the request is over."""
        return time.monotonic() > self._since + PATIENCE

    @property
    def reason(self) -> str | None:
        """Name of the signal, another reason, or None."""
        if self._deadline is not None and time.monotonic() > self._deadline:
            self.request(TIME_BUDGET)
        return self._reason
