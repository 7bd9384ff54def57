"""What a run reports while it goes on; whoever started it decides how to show it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ctid_cli.running.cell_precision import CellPrecision

#: One estimate as plain data, with the keys documented in `ctid_cli.storage.manifest`.
Row = Mapping[str, Any]


@dataclass(frozen=True)
class PlanReady:
    """The run is about to start."""

    experiment: str
    folder: Path
    data_sets: int
    estimates: int
    reused: int
    left_aside: int
    #: Most data sets of a data cell, where it gets as many as a precision needs.
    at_most: int | None = None
    #: Estimates among those to compute that are stored as failures, and are to be tried again.
    again: int = 0


@dataclass(frozen=True)
class KernelsCompiling:
    """The compiled kernels are being made, or loaded from the cache on disk; the first time takes a while."""


@dataclass(frozen=True)
class KernelsCompiled:
    """The compiled kernels are ready."""

    #: How long that took [s].
    seconds: float


@dataclass(frozen=True)
class Warned:
    """Something about components of one's own that is to be known, and that does not stop the run."""

    text: str


@dataclass(frozen=True)
class EstimatesDone:
    """Estimates of one data set are safely stored: some of them, or the last ones."""

    done: int
    total: int
    rows: tuple[Row, ...]


@dataclass(frozen=True)
class BlockDone:
    """A block of data sets is stored, and some data cells need more of them."""

    #: Data sets to compute so far, those of the next block among them.
    total: int
    precision: tuple[CellPrecision, ...]


@dataclass(frozen=True)
class WorkerDied:
    """A worker process died; the estimates that it was at are computed once more, one by one."""

    estimates: int
    reason: str


@dataclass(frozen=True)
class GivenUp:
    """Estimates that the machine did not let finish, twice; they are not stored."""

    #: Estimator and replicate of each.
    names: tuple[str, ...]
    reason: str

    @property
    def estimates(self) -> int:
        """How many there are."""
        return len(self.names)


@dataclass(frozen=True)
class Slow:
    """An estimate has been at work for long."""

    id: str
    estimator: str
    replicate: int
    #: So far [s].
    seconds: float


@dataclass(frozen=True)
class Stopping:
    """The run was asked to stop; what is finished is being stored."""

    reason: str


@dataclass(frozen=True)
class Sealed:
    """The estimates were written to one file, which was read back and compared."""

    file: Path
    estimates: int
    checksum: str


Event = (
    PlanReady
    | KernelsCompiling
    | KernelsCompiled
    | Warned
    | EstimatesDone
    | BlockDone
    | WorkerDied
    | GivenUp
    | Slow
    | Stopping
    | Sealed
)
OnEvent = Callable[[Event], None]


def ignore(event: Event) -> None:
    """Take no notice of an event."""
