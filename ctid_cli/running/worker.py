"""What a worker process does: make one data set and compute the estimates that are wanted of it.

A worker never raises. Whatever goes wrong with an estimate becomes its result, with status ``FAILED``.
"""

from __future__ import annotations

import ctypes
import faulthandler
import os
import re
import signal
import sys
import threading
import time
import traceback
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ctid_cli.canonical import plain
from ctid_cli.storage.manifest import RESULT_FIELDS, Key, Outcome

if TYPE_CHECKING:
    from ctid_cli.models.additive import Term
    from ctid_cli.running.plan import DataCell, EstimatorCell
    from ctid_cli.simulation.dataset import DataSet
    from ctid_cli.simulation.frequency_runs import SignalDataSet
    from ctid_cli.specification.start_points import AnyStart

#: Frames of a traceback that are kept, the innermost ones.
TRACEBACK_FRAMES = 6

_PR_SET_PDEATHSIG = 1


@dataclass(frozen=True, eq=False)
class Job:
    """One data set and the estimates wanted of it: what is sent to a worker."""

    cell: DataCell
    replicate: int
    seed: int | None
    wanted: tuple[tuple[Key, EstimatorCell, AnyStart], ...]
    terms: tuple[Term, ...] | None = None


def initialise(parent: int) -> None:
    """Set up a new worker process.

    The parent alone decides what an interrupt means, so the worker ignores it. A worker must not outlive its parent,
    however the parent died: Linux can be asked to see to that, elsewhere a thread looks now and then.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    # Estimators report through their status; warnings of several workers at once would only garble the terminal.
    warnings.simplefilter("ignore")
    faulthandler.disable()
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:
            os._exit(1)
    else:
        threading.Thread(target=_watch, args=(parent,), daemon=True).start()


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(1.0)
    os._exit(1)


def run_job(job: Job) -> list[Outcome]:
    """Compute the wanted estimates of one data set."""
    try:
        data = job.cell.dataset(job.replicate)
    except BaseException as error:
        result = failure(error)
        return [Outcome(key, result, None) for key, _, _ in job.wanted]
    outcomes = []
    prepared: Any = None
    preparing = 0.0
    current: EstimatorCell | None = None
    for key, cell, start in job.wanted:
        try:
            if cell is not current:
                current, prepared = None, None
                begun = time.perf_counter()
                prepared = cell.estimator.prepare(data.record)
                preparing = time.perf_counter() - begun
                current = cell
            begun = time.perf_counter()
            drawn = start.draw(job.seed, job.replicate, data.true_model)
            fit = prepared.fit(drawn)
            seconds: float | None = preparing + time.perf_counter() - begun
            result = _result(fit, data, None if drawn is None else drawn.delay, job.terms)
        except BaseException as error:
            result, seconds = failure(error), None
        outcomes.append(Outcome(key, result, seconds))
    return outcomes


def failure(error: BaseException, status: str = "FAILED") -> dict[str, Any]:
    """The result of an estimate that an exception ended.

    The message is part of the stored results, which must not differ between two runs. Hence file names without their
    folders, and no memory addresses.
    """
    frames = traceback.extract_tb(error.__traceback__)[-TRACEBACK_FRAMES:]
    places = [f"  {Path(frame.filename).name}:{frame.lineno} in {frame.name}" for frame in frames]
    text = "\n".join([f"{type(error).__name__}: {error}", *places])
    return failed(re.sub(r"\b0x[0-9a-fA-F]+", "0x…", text), status)


def failed(message: str, status: str) -> dict[str, Any]:
    """The result of an estimate that does not exist."""
    return dict.fromkeys(RESULT_FIELDS) | {"status": status, "message": message}


def _result(
    fit: Any, data: DataSet | SignalDataSet, start_delay: float | None, terms: tuple[Term, ...] | None
) -> dict[str, Any]:
    from ctid_cli.simulation.additive_parameters import additive_parameters
    from ctid_cli.simulation.frequency_runs import FrequencyFit, SignalDataSet

    if isinstance(fit, FrequencyFit) and isinstance(data, SignalDataSet):
        return dict.fromkeys(RESULT_FIELDS) | fit.result(data)
    assert not isinstance(data, SignalDataSet)  # only estimators of frequencies take one
    model = fit.model
    parameters, errors = additive_parameters(fit, terms)
    result = {
        "status": fit.status.name,
        "message": str(fit.status.value),
        "start_delay": start_delay,
        "delay": model.delay,
        "numerator": model.numerator,
        "denominator": model.denominator,
        "parameters": parameters,
        "standard_errors": fit.standard_errors | errors,
        "cost": fit.cost,
        "fit_percent": fit.fit_percent,
        "validation_fit_percent": _validation_fit_percent(model, data),
        "iterations": int(fit.iterations),
        "condition_number": fit.condition_number,
    }
    return {name: plain(value) for name, value in result.items()}


def _validation_fit_percent(model: Any, data: DataSet) -> float | None:
    record = data.validation
    if record is None:
        return None
    from ctid_cli.filtering.simulate import simulate
    from ctid_cli.inference.diagnostics import fit_percent

    simulated = simulate(model, record.input, record.t)
    return float(fit_percent(record.y[record.valid], simulated[record.valid]))
