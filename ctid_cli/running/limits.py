"""What one estimate may take of the machine, and how much a process has taken so far."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Self

#: Whether the processor time and memory of another process can be read here.
WATCHES_PROCESSES = sys.platform == "linux"
_MEGABYTE = 1e6


@dataclass(frozen=True)
class Limits:
    """Limits of a single estimate; None where there is none."""

    #: Processor time, and time [s].
    cpu_seconds: float | None = None
    wall_seconds: float | None = None
    #: Memory beyond what the process held before [MB].
    memory_mb: float | None = None

    @classmethod
    def of(cls, content: Mapping[str, Any]) -> Self:
        """The limits in the canonical form of a specification, or in what is known of a run."""
        return cls(**(content.get("limits") or {}))

    def __bool__(self) -> bool:
        return self != Limits()

    def rose_since(self, other: Limits, status: str) -> bool:
        """Whether an estimate that ended with a status under other limits may take more now."""
        names = {"TIMEOUT": ("cpu_seconds", "wall_seconds"), "MEMORY": ("memory_mb",)}.get(status, ())
        pairs = [(getattr(other, name), getattr(self, name)) for name in names]
        return any(old is not None and (new is None or new > old) for old, new in pairs)

    def allows(self, size: float) -> bool:
        """Whether so much memory may be asked for [bytes]."""
        return self.memory_mb is None or size <= self.memory_mb * _MEGABYTE

    @property
    def of_processes(self) -> bool:
        """Whether the processor or the memory is limited."""
        return self.cpu_seconds is not None or self.memory_mb is not None

    def exceeded(self, wall: float, cpu: float, memory: float) -> tuple[Literal["time", "memory"], str] | None:
        """The limit that was exceeded, ``time`` or ``memory``, and a sentence; memory in bytes."""
        if self.wall_seconds is not None and wall > self.wall_seconds:
            return "time", f"not finished after {self.wall_seconds:g} s (limits.wall_seconds)"
        if self.cpu_seconds is not None and cpu > self.cpu_seconds:
            return "time", f"not finished after {self.cpu_seconds:g} s of processor time (limits.cpu_seconds)"
        return None if self.allows(memory) else ("memory", self.too_much())

    def too_much(self) -> str:
        """What is said of an estimate that needs more memory than it may have."""
        return f"needed more than {self.memory_mb:g} MB (limits.memory_mb)"


@dataclass(frozen=True)
class Usage:
    """What a process has used of its own since it began."""

    #: Processor time, that of finished child processes included [s].
    cpu: float
    #: Memory that is not shared with files [bytes].
    memory: float

    def __sub__(self, other: Usage) -> Usage:
        return Usage(self.cpu - other.cpu, self.memory - other.memory)


def usage(process: int | str) -> Usage | None:
    """What a process uses, by its number or ``self``; None if that cannot be known, or if it is gone."""
    if not WATCHES_PROCESSES:
        return None
    place = Path("/proc") / str(process)
    try:
        # The name of the program, in brackets, may hold anything.
        times = (place / "stat").read_bytes().rpartition(b")")[2].split()[11:15]
        lines = dict(line.split(b":", 1) for line in (place / "status").read_bytes().splitlines())
    except (OSError, ValueError):
        return None
    kilobytes = sum(int(lines[name].split()[0]) for name in (b"RssAnon", b"RssShmem", b"VmSwap") if name in lines)
    return Usage(sum(map(int, times)) / os.sysconf("SC_CLK_TCK"), 1024.0 * kilobytes)
