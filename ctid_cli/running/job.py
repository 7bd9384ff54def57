"""One data set and the estimates that are wanted of it, computed: everything from a plan to the stored numbers.

Nothing here raises. Whatever goes wrong with an estimate becomes its result, with status ``FAILED``.
"""

from __future__ import annotations

import os
import re
import time
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.canonical import plain
from ctid_cli.storage.columns import failed, no_result
from ctid_cli.storage.manifest import Key, Outcome

if TYPE_CHECKING:
    from ctid_cli.models.additive import Term
    from ctid_cli.running.cells import DataCell, EstimatorCell
    from ctid_cli.specification.start_points import StartPoint

#: Frames of a traceback that are kept, the innermost ones.
TRACEBACK_FRAMES = 6


@dataclass(frozen=True, eq=False)
class Job:
    """One data set and the estimates wanted of it: what is sent to a worker."""

    cell: DataCell
    replicate: int
    seed: int | None
    wanted: tuple[tuple[Key, EstimatorCell, StartPoint], ...]
    terms: tuple[Term, ...] | None = None


def run_job(job: Job) -> list[Outcome]:
    """Compute the wanted estimates of one data set."""
    try:
        data = job.cell.dataset(job.replicate)
    except BaseException as error:
        result = failure(error)
        return [Outcome(key, result, None) for key, _, _ in job.wanted]
    outcomes = []
    prepared: Any = None
    preparing = np.zeros(2)
    current: EstimatorCell | None = None
    for key, cell, start in job.wanted:
        try:
            if cell is not current:
                current, prepared = None, None
                begun = _clocks()
                prepared = cell.estimator.prepare(data.record)
                preparing = _clocks() - begun
                current = cell
            begun = _clocks()
            drawn = start.draw(job.seed, job.replicate, data.true_model)
            fit = prepared.fit(drawn)
            seconds, cpu_seconds = (preparing + _clocks() - begun).tolist()
            result = no_result() | plain(data.result_of(fit, drawn, job.terms))
        except BaseException as error:
            result, seconds, cpu_seconds = failure(error), None, None
        outcomes.append(Outcome(key, result, seconds, cpu_seconds))
    return outcomes


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
    text = "\n".join([f"{type(error).__name__}: {error}", *places])
    return failed(re.sub(r"\b0x[0-9a-fA-F]+", "0x…", text), "FAILED")
