"""Jobs: one data set and the estimates wanted of it, computed to numbers that can be stored.

Nothing here raises. Whatever goes wrong with an estimate becomes its result, with status ``FAILED``; only where the
machine was short of something (memory, descriptors, space on a disk) there is no result at all.
"""

from __future__ import annotations

import os
import re
import time
import traceback
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.canonical import canonical_json, plain
from ctid_cli.custom_code import reason
from ctid_cli.running.limits import Limits, shortage
from ctid_cli.storage.columns import failed, no_result
from ctid_cli.storage.manifest import Key, Outcome

if TYPE_CHECKING:
    from ctid_cli.models.additive import Term
    from ctid_cli.simulation.components import Measure
    from ctid_cli.simulation.dataset import Source
    from ctid_cli.simulation.frequency_measures import SignalSource
    from ctid_cli.simulation.start_points import StartPoint

#: Frames of a traceback that are kept, the innermost ones, and characters of a message.
TRACEBACK_FRAMES = 6
MESSAGE_LENGTH = 2000


@dataclass(frozen=True, eq=False)
class DataCell:
    """One combination of system, excitation or loop, sampling, noise and seed, or one measured record."""

    content: dict[str, Any]
    hash: str
    swept: dict[str, Any]
    source: Source | SignalSource
    #: Custom measures of its estimates, with their names.
    measures: tuple[tuple[str, Measure], ...] = ()

    def dataset(self, replicate: int) -> Any:
        """Return one data set."""
        return self.source.dataset(replicate)


@dataclass(frozen=True, eq=False)
class EstimatorCell:
    """One estimator with one combination of its swept options."""

    name: str
    kind: str
    estimator: Any
    content: dict[str, Any]
    hash: str
    swept: dict[str, Any]


Wanted = tuple[Key, EstimatorCell, "StartPoint"]


@dataclass(frozen=True, eq=False)
class Job:
    """One data set and the estimates wanted of it: what is sent to a worker."""

    cell: DataCell
    replicate: int
    seed: int | None
    wanted: tuple[Wanted, ...]
    terms: tuple[Term, ...] | None = None

    @property
    def keys(self) -> tuple[Key, ...]:
        """The estimates wanted."""
        return tuple(key for key, _, _ in self.wanted)

    def names(self, keys: Collection[Key]) -> list[str]:
        """Return what some of the estimates are called in messages."""
        return [f"{cell.name} on replicate {key.replicate}" for key, cell, _ in self.wanted if key in keys]

    def only(self, keys: Collection[Key]) -> Job:
        """Return the job of some of the estimates."""
        return replace(self, wanted=tuple(one for one in self.wanted if one[0] in keys))


class Begun(NamedTuple):
    """Estimates that are in work: one, or several of them with what they share."""

    keys: tuple[Key, ...]
    #: Time and processor time that count as theirs already [s].
    spent: tuple[float, float] = (0.0, 0.0)
    #: Processor time that their process had used before [s].
    since: float = 0.0


class Short(NamedTuple):
    """Estimates that the machine was short of something for."""

    keys: tuple[Key, ...]
    reason: str


Entry = Begun | Outcome | Short


def run_job(job: Job, limits: Limits | None = None) -> Iterator[Entry]:
    """Compute the wanted estimates of one data set, and say which is begun, so that the caller can set its limits."""
    limits = limits or Limits()
    yield Begun(job.keys)
    try:
        data = job.cell.dataset(job.replicate)
    except BaseException as error:
        yield from ended(job.keys, error, limits)
        return
    for _, group in groupby(job.wanted, key=lambda one: id(one[1])):
        yield from _of_one_estimator(job, data, list(group), limits)


def _of_one_estimator(job: Job, data: Any, wanted: Sequence[Wanted], limits: Limits) -> Iterator[Entry]:
    """Compute the estimates of one estimator, which share the preparation of the record."""
    keys, estimator = tuple(key for key, _, _ in wanted), wanted[0][1].estimator
    yield Begun(keys)
    begun = _clocks()
    try:
        prepared = estimator.prepare(data.record)
    except BaseException as error:
        yield from ended(keys, error, limits)
        return
    preparing = _clocks() - begun
    for key, _, start in wanted:
        if len(wanted) > 1:
            yield Begun((key,), tuple(preparing.tolist()))
        begun = _clocks()
        try:
            drawn = start.draw(job.seed, job.replicate, data.true_model)
            fit = prepared.fit(drawn)
            clocks = (preparing + _clocks() - begun).tolist()
            result = no_result() | plain(data.result_of(fit, drawn, job.terms))
            values, reasons = measured(job.cell.measures, fit, data, limits)
            lines = [result["message"], *(f"Measure {name}: {why}" for name, why in reasons.items())]
            result |= {"custom_measures": values or None, "message": "\n".join(lines)}
            # What cannot be stored is not a result.
            canonical_json(result).encode()
        except BaseException as error:
            yield from ended((key,), error, limits)
        else:
            yield Outcome(key, result, *clocks)


def measured(
    measures: Iterable[tuple[str, Measure]], fit: Any, data: Any, limits: Limits
) -> tuple[dict[str, Any], dict[str, str]]:
    """Return values of custom measures, and why some have none, by their names."""
    from ctid_cli.simulation.components import value_of

    values: dict[str, Any] = {}
    reasons: dict[str, str] = {}
    for name, measure in measures:
        try:
            values[name] = plain(value_of(measure, fit, data))
        except BaseException as error:
            lacking = shortage(error)
            if lacking is not None and not (isinstance(lacking, MemoryError) and limits.memory_mb is not None):
                raise
            values[name] = None
            reasons[name] = _repeatable(_readable(reason(error)))
    return values, reasons


def ended(keys: Collection[Key], error: BaseException, limits: Limits) -> Iterator[Outcome | Short]:
    """Tell what becomes of estimates that an exception ended; under a limit of memory, lacking it is their failure."""
    lacking = shortage(error)
    if lacking is None:
        result = failure(error)
    elif isinstance(lacking, MemoryError) and limits.memory_mb is not None:
        result = failed(f"needed more than {limits.memory_mb:g} MB (limits.memory_mb)", "MEMORY")
    else:
        said = _said(lacking)
        yield Short(tuple(keys), f"out of memory: {said}" if isinstance(lacking, MemoryError) else said)
        return
    yield from (Outcome(key, result, None) for key in keys)


def _clocks() -> Array:
    """Return wall time and processor time, that of finished child processes too [s]."""
    times = os.times()
    # The clock of the process itself ticks faster than that of `os.times`.
    processor = time.process_time() + times.children_user + times.children_system
    return np.array([time.perf_counter(), processor])


def failure(error: BaseException) -> dict[str, Any]:
    """Return the result of an estimate that an exception ended.

    The message is part of the stored results, which must not differ between two runs. Hence file names without their
    folders, and no memory addresses.
    """
    frames = traceback.extract_tb(error.__traceback__)[-TRACEBACK_FRAMES:]
    places = [f"  {Path(frame.filename).name}:{frame.lineno} in {frame.name}" for frame in frames]
    said = _repeatable(_said(error))
    return failed("\n".join([f"{type(error).__name__}: {said}", *map(_readable, places)]), "FAILED")


def _repeatable(text: str) -> str:
    """Leave out memory addresses, which are others in every run."""
    return re.sub(r"\b0x[0-9a-fA-F]+", "0x…", text)


def _said(error: BaseException) -> str:
    try:
        text = str(error)
    except Exception:
        text = "(its text cannot be made)"
    return _readable(text if len(text) <= MESSAGE_LENGTH else f"{text[:MESSAGE_LENGTH]}…")


def _readable(text: str) -> str:
    """Escape what files, tables and terminals cannot hold: halves of characters, and control characters."""
    return "".join(c if c.isprintable() or c in "\n\t" else c.encode("unicode_escape").decode() for c in text)
