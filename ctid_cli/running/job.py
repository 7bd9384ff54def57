"""One data set and the estimates that are wanted of it, computed: everything from a plan to the stored numbers.

Nothing here raises. Whatever goes wrong with an estimate becomes its result, with status ``FAILED``; only where the
machine was short of something (memory, descriptors, room on a disk) there is no result at all.
"""

from __future__ import annotations

import errno
import os
import re
import time
import traceback
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.canonical import canonical_json, plain
from ctid_cli.running.limits import Limits
from ctid_cli.storage.columns import failed, no_result
from ctid_cli.storage.manifest import Key, Outcome

if TYPE_CHECKING:
    from ctid_cli.models.additive import Term
    from ctid_cli.running.cells import DataCell, EstimatorCell
    from ctid_cli.simulation.dataset import StartPoint

#: Frames of a traceback that are kept, the innermost ones, and characters of a message.
TRACEBACK_FRAMES = 6
MESSAGE_LENGTH = 2000
#: Errors of the operating system that another machine, or another moment, would not have.
SHORTAGES = frozenset(
    getattr(errno, name)
    for name in ("EMFILE", "ENFILE", "ENOMEM", "EAGAIN", "ENOSPC", "EDQUOT", "EIO", "ENOLCK", "ESTALE", "ENOBUFS")
    if hasattr(errno, name)
)


@dataclass(frozen=True, eq=False)
class Job:
    """One data set and the estimates wanted of it: what is sent to a worker."""

    cell: DataCell
    replicate: int
    seed: int | None
    wanted: tuple[tuple[Key, EstimatorCell, StartPoint], ...]
    terms: tuple[Term, ...] | None = None

    @property
    def keys(self) -> tuple[Key, ...]:
        """The estimates wanted."""
        return tuple(key for key, _, _ in self.wanted)


@dataclass(frozen=True)
class Began:
    """Work begins on estimates: on one, or on what several of them share."""

    keys: tuple[Key, ...]
    #: Time and processor time that count as theirs already [s].
    spent: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Short:
    """Estimates that the machine was short of something for."""

    keys: tuple[Key, ...]
    reason: str
    #: Memory that was asked for in vain [bytes], as far as is known.
    asked: float = 0.0


def run_job(job: Job, limits: Limits | None = None) -> Iterator[Began | Outcome | Short]:
    """Compute the wanted estimates of one data set, and say which is begun.

    Whoever runs this watches the limits; here it is only seen who asks for more memory than there may be.
    """
    for entry in _estimates(job):
        if isinstance(entry, Short) and limits is not None and not limits.allows(entry.asked):
            result = failed(limits.too_much(), "MEMORY")
            yield from (Outcome(key, result, None) for key in entry.keys)
        else:
            yield entry


def _estimates(job: Job) -> Iterator[Began | Outcome | Short]:
    yield Began(job.keys)
    try:
        data = job.cell.dataset(job.replicate)
    except BaseException as error:
        yield from _ended(job.keys, error)
        return
    for _, group in groupby(job.wanted, key=lambda one: id(one[1])):
        yield from _of_one_estimator(job, data, list(group))


def _of_one_estimator(
    job: Job, data: Any, wanted: Sequence[tuple[Key, EstimatorCell, StartPoint]]
) -> Iterator[Began | Outcome | Short]:
    """The estimates of one estimator, which share the preparation of the record."""
    keys, estimator = tuple(key for key, _, _ in wanted), wanted[0][1].estimator
    yield Began(keys)
    begun = _clocks()
    try:
        prepared = estimator.prepare(data.record)
    except BaseException as error:
        yield from _ended(keys, error)
        return
    preparing = _clocks() - begun
    for key, _, start in wanted:
        if len(wanted) > 1:
            yield Began((key,), tuple(preparing.tolist()))
        begun = _clocks()
        try:
            drawn = start.draw(job.seed, job.replicate, data.true_model)
            fit = prepared.fit(drawn)
            clocks = (preparing + _clocks() - begun).tolist()
            result = no_result() | plain(data.result_of(fit, drawn, job.terms))
            # What cannot be stored is not a result.
            canonical_json(result).encode()
        except BaseException as error:
            yield from _ended((key,), error)
        else:
            yield Outcome(key, result, *clocks)


def _ended(keys: tuple[Key, ...], error: BaseException) -> Iterator[Outcome | Short]:
    """What becomes of estimates that an exception ended."""
    short = shortage(error)
    if short:
        yield Short(keys, short, float(getattr(error, "_total_size", 0.0)))
        return
    result = failure(error)
    yield from (Outcome(key, result, None) for key in keys)


def shortage(error: BaseException) -> str:
    """What the machine was short of when it ended an estimate; empty if the estimator itself is to blame."""
    seen: BaseException | None = error
    while seen is not None:
        if isinstance(seen, MemoryError):
            return f"out of memory: {_said(seen)}"
        if isinstance(seen, OSError) and seen.errno in SHORTAGES:
            return _said(seen)
        seen = seen.__cause__ or seen.__context__
    return ""


def _clocks() -> Array:
    """Wall time and processor time, that of finished child processes too [s]."""
    times = os.times()
    # The clock of the process itself ticks faster than that of `os.times`.
    processor = time.process_time() + times.children_user + times.children_system
    return np.array([time.perf_counter(), processor])


def failure(error: BaseException) -> dict[str, Any]:
    """The result of an estimate that an exception ended.

    The message is part of the stored results, which must not differ between two runs. Hence file names without their
    folders, and no memory addresses.
    """
    frames = traceback.extract_tb(error.__traceback__)[-TRACEBACK_FRAMES:]
    places = [f"  {Path(frame.filename).name}:{frame.lineno} in {frame.name}" for frame in frames]
    said = re.sub(r"\b0x[0-9a-fA-F]+", "0x…", _said(error))
    return failed("\n".join([f"{type(error).__name__}: {said}", *map(_readable, places)]), "FAILED")


def _said(error: BaseException) -> str:
    try:
        text = str(error)
    except Exception:
        text = "(its text cannot be made)"
    return _readable(text if len(text) <= MESSAGE_LENGTH else f"{text[:MESSAGE_LENGTH]}…")


def _readable(text: str) -> str:
    """A text that files, tables and terminals can hold: no halves of characters, and no control characters."""
    return "".join(c if c.isprintable() or c in "\n\t" else c.encode("unicode_escape").decode() for c in text)
