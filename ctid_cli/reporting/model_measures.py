"""Estimated models beside the system that they are of: poles, and distances between responses."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from ctid_cli.arrays import Array, ComplexArray
from ctid_cli.errors import UsageError
from ctid_cli.models.additive import AdditiveModel, Submodel
from ctid_cli.models.distances import h2_distance, hinf_distance, response_distance
from ctid_cli.models.factoring import unfactored
from ctid_cli.models.transfer_function import TransferFunction, sorted_roots
from ctid_cli.reporting.parameter_errors import ParameterEstimates
from ctid_cli.storage.estimates import Estimates

Distance = Callable[[TransferFunction, TransferFunction], float]


def system_of(cell: Mapping[str, Any], name: str) -> TransferFunction:
    """The system that a data cell simulates, as one fraction, for a measure that needs it."""
    system = cell["content"].get("system") or {}
    if "additive" in system:
        parts = [Submodel(**item) for item in system["additive"]]
        model = unfactored(AdditiveModel(parts, float(system.get("delay") or 0.0)))
    elif "denominator" in system:
        model = TransferFunction(system["numerator"], system["denominator"], float(system.get("delay") or 0.0))
    else:
        raise UsageError(f"{name} needs a linear system of poles and zeros that is simulated, and there is none here")
    if name in ("h2", "hinf") and not model.is_stable:
        raise UsageError(f"{name} is infinite for a system that integrates; use response:FREQUENCY")
    return model


def distance_of(name: str, argument: str) -> Distance:
    """The distance that a measure is about."""
    if name == "response":
        return partial(response_distance, frequency=float(argument))
    return {"h2": h2_distance, "hinf": hinf_distance}[name]


def distances(system: TransferFunction, rows: Estimates, distance: Distance) -> Array:
    """Distances of the estimates [%]; where there is no model, it is infinitely far."""
    models = rows.rows("numerator", "denominator", "delay")
    return np.array([100.0 * distance(system, _model(row)) if row["denominator"] else np.inf for row in models])


def _model(row: Mapping[str, Any]) -> TransferFunction:
    return TransferFunction(row["numerator"], row["denominator"], max(row["delay"] or 0.0, 0.0))


def pole_estimates(estimates: ParameterEstimates, system: TransferFunction, rows: Estimates) -> ParameterEstimates:
    """Poles in the place of parameters, each with the true one that it goes with [rad/s].

    ``pole_1`` ..., fastest first; of two complex ones ``pole_1_real`` and ``pole_1_imag``. Of a model with another
    number of poles there are none.
    """
    true = system.poles
    upper = [k for k, pole in enumerate(true) if pole.imag >= 0]
    names: list[str] = []
    for number, k in enumerate(upper, start=1):
        names += [f"pole_{number}_real", f"pole_{number}_imag"] if true[k].imag else [f"pole_{number}"]
    values = np.array([_numbers(_matched(true, a), true, upper) for a in rows.values("denominator")])
    nothing = np.full((len(rows), len(names)), np.nan)
    return replace(
        estimates,
        names=tuple(names),
        truth=np.array(_numbers(true, true, upper)),
        values=values.reshape(len(rows), len(names)),
        standard_errors=nothing,
        quantiles=nothing,
    )


def _matched(true: ComplexArray, denominator: Sequence[float] | None) -> ComplexArray:
    """Estimated poles in the order of the true ones, so that all distances together are least."""
    from scipy.optimize import linear_sum_assignment

    if denominator is None or len(denominator) != true.size + 1:
        return np.full(true.size, complex(np.nan, np.nan))
    found = sorted_roots(np.array(denominator))
    order = linear_sum_assignment(np.abs(true[:, None] - found))[1]
    return np.asarray(found[order])


def _numbers(poles: ComplexArray, true: ComplexArray, upper: Sequence[int]) -> list[float]:
    """Real parts, and imaginary parts where the true pole has one."""
    parts: list[float] = []
    for k in upper:
        parts += [poles[k].real, poles[k].imag] if true[k].imag else [poles[k].real]
    return parts
