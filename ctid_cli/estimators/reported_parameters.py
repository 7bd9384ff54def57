"""Reported parameters: standard errors, intervals, and quantities derived from a fit."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from ctid_cli.arrays import Array, IndexArray
from ctid_cli.estimation.measured_records import MeasuredRecords
from ctid_cli.estimation.optimum.best_model import Optimum
from ctid_cli.estimators.determination import LEVEL, Accepted, Determination, cost_of_delay, determination_of
from ctid_cli.estimators.measured_fit import MeasuredFit, MultiInputFit, delay_names
from ctid_cli.estimators.measured_submodels import SubmodelsFit
from ctid_cli.inference.covariance import LARGE_STANDARD_ERROR
from ctid_cli.inference.derived import derived_parameters
from ctid_cli.inference.intervals import BIASED, DelayInterval, UncertainValue
from ctid_cli.inference.sensitivities import parts_of
from ctid_cli.inference.uncertainty import Uncertainty
from ctid_cli.models.several_inputs import MultiInputModel, delays_of


class ReportedParameters(NamedTuple):
    """Reported parameters."""

    estimates: tuple[UncertainValue, ...]
    delay_interval: DelayInterval | None
    derived: tuple[UncertainValue, ...]


def determined(
    fit: MeasuredFit, measured: Any, inside: Sequence[Iterator[Optimum]] = ()
) -> tuple[MeasuredFit, Determination]:
    """Return a fit with its undetermined parameters and equivalents, and the models that its records do not reject."""
    assert fit.law is not None
    found = determination_of(fit, fit.law, measured, inside)
    items = [] if found.trivial else found.reported(lambda each, law: _estimates(each, law, set(), {}))
    intervals = {item.name: item.intervals or ((item.low, item.high),) for item in items if item.status == "free"}
    fit = replace(
        fit,
        other_minima=(),
        equivalents=measured.equivalents(fit.parametrised) if isinstance(measured, MeasuredRecords) else (),
        undetermined={item.name: item.reason for item in items if item.is_undetermined},
        intervals={name: pieces for name, pieces in intervals.items() if np.isfinite(pieces).all()},
    )
    return fit, found


def reported_parameters(
    fit: MeasuredFit, uncertainty: Uncertainty, seen: bool, laid_out: Any, found: Determination | None = None
) -> ReportedParameters:
    """Return parameters and derived quantities, with their uncertainty if it exists and a response is detected."""
    found = found or Determination(((Accepted(fit, uncertainty, 0.0),),))
    biased, linear = uncertainty.kind == "biased", fit.linear
    unclear = {fit.parameter_names[k] for k in _undetermined(fit, uncertainty_of_data(fit, uncertainty))}
    if not seen:
        unclear |= {name for name in fit.parameter_names if not name.startswith("offset")}
    intervals: dict[str, DelayInterval] = {}
    for name in delay_names(fit):
        if isinstance(laid_out, MeasuredRecords) and not biased and name in {*fit.parameter_names} - unclear:
            interval = _delay_interval(laid_out, linear, uncertainty, name)
            intervals |= {} if interval is None else {name: interval}

    def estimates(each: MeasuredFit, law: Uncertainty) -> tuple[UncertainValue, ...]:
        return _estimates(each, law, unclear, intervals if each.theta is fit.theta else {})

    return ReportedParameters(
        tuple(found.reported(estimates)),
        next(iter(intervals.values()), None),
        tuple(found.reported(lambda each, law: _derived(each, law, seen))),
    )


def uncertainty_of_data(fit: MeasuredFit, uncertainty: Uncertainty) -> Uncertainty:
    """Return the uncertainty due to the data, which exists even without standard errors."""
    return fit.uncertainty("white") if uncertainty.kind == "biased" else uncertainty


def _undetermined(fit: MeasuredFit, law: Uncertainty) -> set[int]:
    """Return the coefficients with a standard error above ten times their size, for which none is reported."""
    names, errors = fit.parameter_names, law.errors(np.eye(fit.theta.size))
    looked_at = np.array([re.fullmatch(r"(.*_)?[ab]\d+", name) is not None for name in names])
    if not fit.signs_known:
        looked_at &= np.array(["a" not in name for name in names])
    unclear = ~np.isfinite(errors) | (looked_at & (errors > LARGE_STANDARD_ERROR * np.abs(fit.theta)))
    unclear[~fit.tangent.any(axis=1)] = False
    return set(np.flatnonzero(unclear).tolist())


def free_directions(fit: MeasuredFit) -> tuple[IndexArray, Array]:
    """Return the indices of the parameters that are not at a bound, and ``sum psi psi'`` along the free directions."""
    hessian = sum((psi.T @ psi for psi in fit.sensitivities), np.zeros((fit.theta.size, fit.theta.size)))
    return np.flatnonzero(fit.tangent.any(axis=1)), fit.tangent.T @ hessian @ fit.tangent


def direction_names(fit: MeasuredFit) -> list[str]:
    """Return names of the free directions: numbers of poles as in the list of derived quantities, and parameters."""
    found = []
    for column in fit.tangent.T:
        own = re.fullmatch(r"((?:.+_)?)a\d+", fit.parameter_names[int(np.argmax(np.abs(column)))])
        if own is None or isinstance(fit, SubmodelsFit):
            found.append(fit.parameter_names[int(np.flatnonzero(column)[0])])
        else:
            prefix, parts = own[1], fit.model.parts if isinstance(fit.model, MultiInputModel) else {"": fit.model}
            model = parts.get(prefix[:-1]) or next(iter(parts.values()))
            poles = parts_of(model)[0].pole_slopes()[0]
            change = column[[fit.parameter_names.index(f"{prefix}a{k}") for k in range(1, model.order + 1)]]
            with np.errstate(divide="ignore", invalid="ignore"):
                moved = np.abs(np.polyval(change, poles) / np.polyval(np.polyder(model.denominator), poles) / poles)
            upper = [k for k, pole in enumerate(poles) if pole.imag >= 0]
            nearest = max(range(len(upper)), key=lambda k: np.nan_to_num(moved[upper[k]]))
            found.append(f"{prefix}pole {nearest + 1}")
    return found


def _delay_interval(
    measured: MeasuredRecords, fit: MeasuredFit, uncertainty: Uncertainty, name: str
) -> DelayInterval | None:
    """Return the profile-likelihood interval of a free delay; None if the quadratic interval is adequate."""
    profile, reach, error = cost_of_delay(measured, fit, uncertainty, name)
    return profile.interval(reach) if profile.quadratic_is_doubtful(error) else None


def _estimates(
    fit: MeasuredFit, uncertainty: Uncertainty, unclear: set[str], intervals: Mapping[str, DelayInterval]
) -> tuple[UncertainValue, ...]:
    """Return the parameters: numerator, denominator, delay, then those of the experiments."""
    found: dict[str, UncertainValue] = {}
    errors, reach = uncertainty.errors(np.eye(fit.theta.size)), uncertainty.quantiles(LEVEL)
    free = set(free_directions(fit)[0].tolist())
    for k, (name, value) in enumerate(zip(fit.parameter_names, fit.theta.tolist(), strict=True)):
        if name in unclear:
            found[name] = UncertainValue(name, value, status="undetermined")
        elif k in free:
            reason = BIASED if uncertainty.kind == "biased" else ""
            own = float(errors[k]), float(reach[k])
            found[name] = UncertainValue.symmetric(name, value, own[0], quantile=own[1], reason=reason)
        else:
            found[name] = UncertainValue(name, value, status="fixed" if name in fit.known else "at bound")
        if name in intervals:
            found[name] = replace(found[name], low=intervals[name].low, high=intervals[name].high)
    for name, delay in zip(delay_names(fit), delays_of(fit.model), strict=True):
        found.setdefault(name, UncertainValue(name, delay, status="fixed"))
    order = {"b": 0, "a": 1, "g": 1, "d": 2}
    inputs = list(fit.model.parts) if isinstance(fit, MultiInputFit) else []

    def place(item: UncertainValue) -> tuple[int, int]:
        # Parameters are grouped by input, followed by common ones.
        own = next((k for k, name in enumerate(inputs) if item.name.startswith(f"{name}_")), len(inputs))
        kind = item.name.removeprefix(f"{inputs[own]}_") if own < len(inputs) else item.name
        return own, order.get(kind[0], 3)

    return tuple(sorted(found.values(), key=place))


def _derived(fit: MeasuredFit, uncertainty: Uncertainty, seen: bool) -> tuple[UncertainValue, ...]:
    """Return poles, time constants, frequencies, damping and gain; without errors if no response is detected."""
    law = uncertainty if seen else uncertainty.undefined
    held = bool(fit.held_poles or fit.bounds_met)
    if isinstance(fit, SubmodelsFit) and fit.additive is not None:
        return derived_parameters(fit.additive, law)
    if isinstance(fit, MultiInputFit):
        return _derived_of_inputs(fit, law, held)
    size = fit.model.denominator.size + sum(name.startswith("b") for name in fit.parameter_names) - 1
    return derived_parameters(fit.model, law.transformed(np.eye(size, len(law.tangent))), held=held)


def _derived_of_inputs(fit: MultiInputFit, law: Uncertainty, held: bool) -> tuple[UncertainValue, ...]:
    """Return derived quantities of the transfer function of each input; those of a common denominator once."""
    found: list[UncertainValue] = []
    for k, (name, model) in enumerate(fit.model.parts.items()):
        names = fit.of_input(name).parameter_names
        own = [i for kind in "ab" for i, each in enumerate(names) if each.startswith(kind)]
        values = derived_parameters(model, law.transformed(np.eye(len(names))[own]), held=held)
        shared = [] if not fit.model.common else [item for item in values if item.name != "static_gain"]
        found += shared if k == 0 else []
        found += [replace(item, name=f"{name}_{item.name}") for item in values if item not in shared]
    return tuple(found)
