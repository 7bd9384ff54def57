"""What every estimator of a single transfer function checks and reports in the same way."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError, OptionError
from ctid_cli.estimation.problems import CoefficientProblem
from ctid_cli.filtering.filter_data import FilterData
from ctid_cli.inference.covariance import condition_number, white_noise_covariance
from ctid_cli.inference.diagnostics import percent_from_r_squared
from ctid_cli.inference.fit import Fit, IterationRecord
from ctid_cli.inference.sensitivity import Structure
from ctid_cli.inference.status import Status
from ctid_cli.models.additive import AdditiveModel
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.checks import require_integer
from ctid_cli.signals.record import Record

#: What an estimator takes from a start: an initial delay, or initial parameters.
StartFrom = Literal["delay", "parameters"]


@dataclass(frozen=True)
class Start:
    """Where an estimator starts.

    Parameters
    ----------
    delay : float, optional
        Initial delay [s]; None leaves the choice to the estimator.
    model : AdditiveModel, optional
        Initial parameters, as a sum of submodels; None leaves them to the estimator.
    """

    delay: float | None = None
    model: AdditiveModel | None = None


def initial_delay(start: Start | None, bounds: tuple[float, float]) -> float:
    """Delay from which a search starts."""
    low, high = bounds
    delay = 0.5 * (low + high) if start is None or start.delay is None else start.delay
    if not low <= delay <= high:
        raise DataError(f"the initial delay, {delay:g} s, lies outside the bounds {low:g} to {high:g} s")
    return delay


def check_structure(poles: int, zeros: int) -> None:
    """Check the degrees of a strictly proper model."""
    require_integer("poles", poles, 1, 12)
    require_integer("zeros", zeros, 0)
    if zeros >= poles:
        raise OptionError(
            "zeros", f"zeros must be fewer than poles (a strictly proper model): got {zeros} zeros and {poles} poles"
        )


def check_iteration(max_iterations: int, tolerance: float) -> None:
    """Check the stopping rule of an iteration."""
    require_integer("max_iterations", max_iterations, 1)
    if not 0 < tolerance < 1:
        raise OptionError("tolerance", f"tolerance must lie between 0 and 1, not {tolerance}")


def check_record(record: Record, data: FilterData, parameters: int) -> None:
    """Refuse records from which nothing can be estimated."""
    where = f"{record.name}: " if record.name else ""
    if data.count <= parameters:
        raise DataError(
            f"{where}{data.count} usable samples for {parameters} parameters; "
            "take a longer record, a smaller model, or a smaller largest delay"
        )
    if np.ptp(record.input.values) == 0.0:
        raise DataError(f"{where}the input is constant ({record.input.values[0]:g}); it excites nothing to identify")
    if np.ptp(data.y_used) == 0.0:
        raise DataError(f"{where}the output is constant ({data.y_used[0]:g}) over the samples that can be used")


class Splits(Protocol):
    """An estimation problem, as far as its history needs to know it."""

    def split(self, theta: Array) -> tuple[Array, Array, float]:
        """Denominator, numerator and delay of a parameter vector."""


def history_entry(stage: str, iteration: int, problem: Splits, theta: Array, cost: float) -> IterationRecord:
    """Describe one accepted iteration."""
    a, b, delay = problem.split(theta)
    return IterationRecord(stage, iteration, delay, cost, tuple(a.tolist()), tuple(b.tolist()))


def finish(
    problem: CoefficientProblem,
    theta: Array,
    status: Status,
    iterations: int,
    history: list[IterationRecord],
    accurate: bool = True,
) -> Fit:
    """Assemble the result of an estimation."""
    structure: Structure = problem.structure
    a, b, delay = problem.split(theta)
    model = TransferFunction(b, a, delay)
    count = problem.data.count
    moments = problem.moments(theta)
    undefined = np.full((structure.size, structure.size), np.nan)
    if moments is None:
        nan = float("nan")
        return Fit(
            model, structure.names, undefined, Status.DIVERGED, nan, nan, nan, count, iterations, nan, tuple(history)
        )
    hessian = structure.hessian(moments)
    free = structure.size - int(status is Status.DELAY_AT_BOUND)
    covariance = undefined
    if accurate:
        # A delay at its bound is no minimum: it has no standard error, and the others hold for that delay.
        covariance[:free, :free] = white_noise_covariance(
            hessian[:free, :free], structure.squared_error(moments), count
        )
        if status is Status.CONVERGED and np.isnan(covariance[:free, :free]).any():
            status = Status.SINGULAR
    squared_error = structure.squared_error(moments)
    y = problem.data.y_used
    r2 = 1.0 - squared_error / float(np.sum((y - y.mean()) ** 2))
    return Fit(
        model=model,
        parameter_names=structure.names,
        covariance=covariance,
        status=status,
        cost=squared_error / count,
        fit_percent=percent_from_r_squared(r2),
        r2=r2,
        count=count,
        iterations=iterations,
        condition_number=condition_number(hessian),
        history=tuple(history),
    )
