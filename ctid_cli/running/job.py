"""Jobs: one data set and its requested estimates, computed to storable numbers.

Nothing here raises. Any error of an estimate becomes its result, with status ``FAILED``; only if a resource of the
machine is exhausted (memory, descriptors, disk space) is there no result.
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

#: Number of innermost traceback frames stored, and of characters of a message.
TRACEBACK_FRAMES = 6
MESSAGE_LENGTH = 2000


@dataclass(frozen=True, eq=False)
class DataCell:
    """One combination of system, excitation or loop, sampling, noise and seed, or one measured record."""

    content: dict[str, Any]
    hash: str
    swept: dict[str, Any]
    source: Source | SignalSource
    #: Custom measures of its estimates, by name.
    measures: tuple[tuple[str, Measure], ...] = ()

    def dataset(self, replicate: int) -> Any:
        """Return one data set."""
        return self.source.dataset(replicate)


@dataclass(frozen=True, eq=False)
class EstimatorCell:
    """One estimator with one combination of swept options."""

    name: str
    kind: str
    estimator: Any
    content: dict[str, Any]
    hash: str
    swept: dict[str, Any]


Wanted = tuple[Key, EstimatorCell, "StartPoint"]


@dataclass(frozen=True, eq=False)
class Job:
    """One data set and its requested estimates, sent to a worker."""

    cell: DataCell
    replicate: int
    seed: int | None
    wanted: tuple[Wanted, ...]
    terms: tuple[Term, ...] | None = None

    @property
    def keys(self) -> tuple[Key, ...]:
        """Keys of the requested estimates."""
        return tuple(key for key, _, _ in self.wanted)

    def names(self, keys: Collection[Key]) -> list[str]:
        """Return the names of some estimates for messages."""
        return [f"{cell.name} on replicate {key.replicate}" for key, cell, _ in self.wanted if key in keys]

    def only(self, keys: Collection[Key]) -> Job:
        """Return the job restricted to some estimates."""
        return replace(self, wanted=tuple(one for one in self.wanted if one[0] in keys))


class Begun(NamedTuple):
    """Estimates in progress: one, or several during their shared computation."""

    keys: tuple[Key, ...]
    #: Wall and processor time already charged to them [s].
    spent: tuple[float, float] = (0.0, 0.0)
    #: Processor time of their process before they began [s].
    since: float = 0.0


class Short(NamedTuple):
    """Estimates that could not be computed because of an exhausted resource."""

    keys: tuple[Key, ...]
    reason: str


Entry = Begun | Outcome | Short


def run_job(job: Job, limits: Limits | None = None) -> Iterator[Entry]:
    """Compute the estimates of one data set, and yield which one begins, so that the caller can set its limits."""
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
    """Compute the estimates of one estimator, which share the preprocessing of the record."""
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
            # Results that cannot be stored are failures.
            canonical_json(result).encode()
        except BaseException as error:
            yield from ended((key,), error, limits)
        else:
            yield Outcome(key, result, *clocks)


def measured(
    measures: Iterable[tuple[str, Measure]], fit: Any, data: Any, limits: Limits
) -> tuple[dict[str, Any], dict[str, str]]:
    """Return values of custom measures by name, and the reasons for missing values by name."""
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
    """Yield the results of estimates ended by an exception; under a memory limit, lack of memory is their failure."""
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
    """Return wall time and processor time, including finished child processes [s]."""
    times = os.times()
    # The clock of the process has a finer resolution than `os.times`.
    processor = time.process_time() + times.children_user + times.children_system
    return np.array([time.perf_counter(), processor])


def failure(error: BaseException) -> dict[str, Any]:
    """Return the result of an estimate ended by an exception.

    The message is part of the stored results, which must be identical in two runs. Hence file names are without
    folders, and memory addresses are removed.
    """
    frames = traceback.extract_tb(error.__traceback__)[-TRACEBACK_FRAMES:]
    places = [f"  {Path(frame.filename).name}:{frame.lineno} in {frame.name}" for frame in frames]
    said = _repeatable(_said(error))
    return failed("\n".join([f"{type(error).__name__}: {said}", *map(_readable, places)]), "FAILED")


def _repeatable(text: str) -> str:
    """Remove memory addresses, which differ in every run."""
    return re.sub(r"\b0x[0-9a-fA-F]+", "0x…", text)


def _said(error: BaseException) -> str:
    try:
        text = str(error)
    except Exception:
        text = "(its text cannot be made)"
    return _readable(text if len(text) <= MESSAGE_LENGTH else f"{text[:MESSAGE_LENGTH]}…")


def _readable(text: str) -> str:
    """Escape characters that files, tables and terminals cannot hold: surrogates and control characters."""
    return "".join(c if c.isprintable() or c in "\n\t" else c.encode("unicode_escape").decode() for c in text)
