"""What computes jobs: the interface between a run, which decides and stores, and the processes that do the work.

An executor takes jobs as long as it has room, and tells what became of them:

    executor.submit(job)                     while executor.room
    for message in executor.collect(0.05):   Begun, Computed, Hindered, Done or Lost
    executor.stop()                          abandons what is in work; its processes are gone when this returns
    executor.close()                         no further jobs come; idle processes may be kept for another run

Estimates are handed over one by one, as they are finished: what a job lost later does not take them back. Every job
ends with one `Done` or one `Lost`. The executor watches the limits of its jobs and says which estimates were in work
when one was exceeded or a process died; it never decides what that means. `ctid_cli.running.dispatch` does: repeats,
statuses, and when to give up are the same for every executor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

from ctid_cli.running.job import Job
from ctid_cli.storage.manifest import Key, Outcome

#: Why a job was lost: an estimate exceeded a limit of time or memory, its process ended by itself, the machine was
#: short of something, or nothing that concerns the estimates, which are simply to be computed again.
Cause = Literal["time", "memory", "crash", "machine", "chance"]


@dataclass(frozen=True)
class Begun:
    """A job that may have been kept ready is in work now."""

    job: Job


@dataclass(frozen=True)
class Computed:
    """Finished estimates of a job; others may follow."""

    job: Job
    outcomes: Sequence[Outcome]


@dataclass(frozen=True)
class Hindered:
    """Estimates that the machine did not let finish (memory, descriptors, disk); the job itself goes on."""

    job: Job
    keys: Sequence[Key]
    reason: str


@dataclass(frozen=True)
class Done:
    """A job is over."""

    job: Job


@dataclass(frozen=True)
class Lost:
    """A job ended before all of its estimates were handed over."""

    job: Job
    cause: Cause
    reason: str
    #: The estimates that were in work: several while they share something, none where nobody knows.
    keys: Sequence[Key] = ()


Message = Begun | Computed | Hindered | Done | Lost


class Executor(Protocol):
    """Computes jobs in processes that can be lost without losing the run."""

    @property
    def room(self) -> int:
        """How many further jobs it would begin, or keep ready, now."""

    def submit(self, job: Job, *, alone: bool = False) -> None:
        """Take a job; with `alone` for a process that has computed nothing before. What fails comes as a message."""

    def collect(self, seconds: float) -> list[Message]:
        """What has happened since the last call; waits at most so long for something to happen."""

    def stop(self) -> None:
        """Abandon what is in work at once."""

    def close(self) -> None:
        """Take note that no further jobs come."""
