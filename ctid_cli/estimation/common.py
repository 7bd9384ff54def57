"""Checks, data preparation and results common to all estimators of systems."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from typing import Any, ClassVar, Generic, Literal, TypeVar, get_args, get_origin, get_type_hints

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError, OptionError
from ctid_cli.estimation.iteration import Problem
from ctid_cli.estimation.sampled_problem import SampledProblem
from ctid_cli.filtering.bank import Equations
from ctid_cli.filtering.filter_data import FilterData
from ctid_cli.inference.covariance import condition_number, white_noise_dispersion
from ctid_cli.inference.criteria import percent_from_r_squared
from ctid_cli.inference.fit import AssumedHold, Fit, IterationRecord, Status
from ctid_cli.inference.noise_estimate import orders_of
from ctid_cli.inference.signal_features import input_moves
from ctid_cli.inference.uncertainty import DRAWS, Covariance, Uncertainty, estimate_uncertainty
from ctid_cli.models.additive import AdditiveModel
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.processors import one_thread
from ctid_cli.signals.checks import (
    require_choice,
    require_finite,
    require_integer,
    require_not_negative,
    require_positive,
)
from ctid_cli.signals.record import Record, as_records, named, with_hold
from ctid_cli.signals.treatment import Hold, Holds
from ctid_cli.text import listed


@dataclass(frozen=True)
class Fixed:
    """A parameter that is known.

    Parameters
    ----------
    name : str
        Name in the table of parameters, for example a1 or g1_b0.
    value : float
        Value in the unit of that table.

    Raises
    ------
    ValueError
        If the value is not a finite number.
    """

    name: str
    value: float

    def __post_init__(self) -> None:
        require_finite("value", self.value, "unit of the parameter", label=f"the value of {self.name}")


@dataclass(frozen=True)
class Bound:
    """Bounds of a parameter.

    Parameters
    ----------
    name : str
        Name of a coefficient in the table of parameters, for example a1 or u1_b0; delay; gain of a model with one or
        two poles, time_constant with one, damping with two; with several inputs u1_gain.
    low, high : float
        Lower and upper bound, in the unit of the tables.

    Raises
    ------
    ValueError
        Unless both are finite and ``low`` is below ``high``.
    """

    name: str
    low: float
    high: float

    def __post_init__(self) -> None:
        if not -np.inf < self.low < self.high < np.inf:
            numbers = f"two numbers, the smaller first: got {self.low:g} and {self.high:g}"
            raise OptionError("bounds", f"the bounds of {self.name} must be {numbers}")

    @property
    def scale(self) -> float:
        """Larger magnitude of both bounds."""
        return max(abs(self.low), abs(self.high))


def places_of(fixed: Iterable[Fixed] | None, names: Sequence[str]) -> dict[int, float]:
    """Return values of known parameters by their index in ``names``; refuse unknown and repeated names."""
    found: dict[int, float] = {}
    for one in fixed or ():
        if one.name == "delay":
            raise OptionError("fixed", "the delay is no parameter to fix: a known delay is given as such")
        if one.name not in names:
            raise OptionError("fixed", f"there is no parameter {one.name!r} to fix; there are {listed(names)}")
        place = names.index(one.name)
        if place in found:
            raise OptionError("fixed", f"parameter {one.name} is fixed twice")
        found[place] = float(one.value)
    if len(found) == len(names):
        raise OptionError("fixed", "every parameter is fixed, so that there is nothing to estimate")
    return found


#: Largest number of integrators that records can distinguish.
MOST_INTEGRATORS = 3
#: Fewest draws for a 95 % quantile of a bootstrap.
LEAST_DRAWS = 40
#: Part of a start that an estimator uses: the initial delay, or initial parameters.
StartFrom = Literal["delay", "parameters"]
#: Prepared form of a record, before a start is known, and result of an estimator.
LaidOut = TypeVar("LaidOut")
AnyFit = TypeVar("AnyFit", bound=Fit)


@dataclass(frozen=True)
class Start:
    """Start of an estimator.

    Parameters
    ----------
    delay : float, optional
        Initial delay [s]; None leaves the choice to the estimator.
    model : AdditiveModel, optional
        Initial parameters, as a sum of submodels; None leaves them to the estimator.
    """

    delay: float | None = None
    model: AdditiveModel | None = None


class Estimator(Generic[LaidOut, AnyFit]):
    """Estimator of a system: a frozen dataclass of options, checked on creation."""

    kind: ClassVar[str]
    start_from: ClassVar[StartFrom | None] = None

    def __post_init__(self) -> None:
        check_options(self)

    def _lay_out(self, record: Any) -> LaidOut:
        """Check and prepare a record before a start is known."""
        raise NotImplementedError

    def _estimate(self, laid_out: LaidOut, start: Start | None) -> AnyFit:
        raise NotImplementedError

    def _minimum(self, laid_out: LaidOut, start: Start | None) -> AnyFit:
        """Return the estimate without its uncertainty, if it can be separated."""
        return self._estimate(laid_out, start)

    def check_start(self, start: Start) -> None:
        """Raise DataError for a start that the options exclude, without a record.

        Most estimators choose their starts and accept any.
        """

    @one_thread
    def prepare(self, record: Any) -> Prepared[LaidOut, AnyFit]:
        """Check a record, or several if allowed, and prepare it once for any number of starts.

        A DataError states why estimation is impossible.
        """
        records = as_records(record)
        for one in records if not hasattr(self, "inputs") else ():
            one.require_one_input()
        in_loop = any(one.in_loop for one in records) and getattr(self, "instruments", "open_loop") == "open_loop"
        return Prepared(self, self._lay_out(record), in_loop)

    def fit(self, record: Any, start: Start | None = None) -> AnyFit:
        """Estimate from a record, or several if allowed, and from a start if the estimator uses one.

        A DataError states why estimation is impossible. A smooth input whose hold is not given has the one that
        fits best.
        """
        tried = {hold: self.prepare(one).fit(start) for hold, one in assumed_holds(record).items()}
        if None in tried:
            return tried[None]
        found = of_best_hold(tried)
        return found._joined([tried[hold] for hold in found.assumed_hold.others]) if found.assumed_hold else found


def assumed_holds(record: Any) -> dict[Holds | None, Any]:
    """Return a record, or several, with each hold that smooth inputs without a given hold may have.

    The only key is None if all holds are given, all such inputs change in steps, or the record is from a loop.
    """
    several = [record] if isinstance(record, Record) else as_records(record) if isinstance(record, Sequence) else []
    if not any(one.hold_assumed for one in several) or any(one.in_loop for one in several):
        return {None: record}
    names = [
        name
        for name, signal in several[0].held.items()
        if signal.assumed and all(input_moves(one.of_input(name)).kind == "continuous" for one in several)
    ]
    found: dict[Holds | None, Any] = {}
    regular = all(one.interval is not None for one in several)
    for hold in get_args(Hold) if names else ():
        if hold == "band-limited" and not regular:
            continue
        each = tuple(hold if name in names else signal.hold for name, signal in several[0].held.items())
        own: Holds = hold if len(set(each)) == 1 else each
        versions = [with_hold(one, own) for one in several]
        found[own] = versions[0] if isinstance(record, Record) else versions
    return found or {None: record}


def of_best_hold(tried: Mapping[Holds | None, AnyFit]) -> AnyFit:
    """Return the fit with the least error, and holds of the input that fit as well."""
    if None in tried:
        return tried[None]
    named = {hold: fit for hold, fit in tried.items() if hold is not None}
    finite = {hold: fit for hold, fit in named.items() if np.isfinite(fit._misfit)} or named
    best, fit = min(finite.items(), key=lambda each: each[1]._misfit)
    likely = tuple(hold for hold, other in finite.items() if hold != best and other._is_likely_as(fit))
    return replace(fit, assumed_hold=AssumedHold(best, likely))


@dataclass(frozen=True, eq=False)
class Prepared(Generic[LaidOut, AnyFit]):
    """Record prepared for an estimator, ready to fit from any start."""

    estimator: Estimator[LaidOut, AnyFit]
    laid_out: LaidOut
    #: Whether the record is from a feedback loop that the estimator ignores.
    in_ignored_loop: bool = False

    @one_thread
    def minimum(self, start: Start | None = None) -> AnyFit:
        """Estimate from one start, without the uncertainty if it can be separated."""
        return self._of(self.estimator._minimum(self.laid_out, start))

    @one_thread
    def fit(self, start: Start | None = None) -> AnyFit:
        """Estimate from one start."""
        if not isinstance(start, Start | None):
            raise TypeError(f"start must be a Start, such as Start(delay=0.5), not {type(start).__name__}")
        return self._of(self.estimator._estimate(self.laid_out, start))

    def _of(self, fit: AnyFit) -> AnyFit:
        """Return a fit that knows whether it ignores the loop of its record."""
        if not self.in_ignored_loop:
            return fit
        if fit.law is not None and getattr(self.estimator, "covariance", "") == "auto":
            # If the covariance is undefined in one form of the parameters, it is undefined in all.
            law = fit.law.in_ignored_loop
            covariance = fit.covariance if law is fit.law else np.full_like(fit.covariance, np.nan)
            fit = replace(fit, law=law, covariance=covariance)
        fit = replace(fit, in_ignored_loop=True)
        none: dict[str, Any] = {"intervals": {}, "undetermined": {}} if hasattr(fit, "intervals") else {}
        return replace(fit, **none)


# --- options ---------------------------------------------------------------------------------------


def _require_fraction(name: str, value: float) -> None:
    if not 0 < value < 1:
        raise OptionError(name, f"{name} must lie between 0 and 1, not {value}")


#: Checks of options common to several estimators, by name; None means that an option was not given.
CHECKS: Mapping[str, Callable[[str, Any], object]] = {
    "integrators": lambda name, value: require_integer(name, value, 0, MOST_INTEGRATORS),
    "zeros": lambda name, value: require_integer(name, value, 0),
    "delay": lambda name, value: require_not_negative(name, value, "s"),
    "svf_cutoff": lambda name, value: require_positive(name, value, "rad/s"),
    "bandwidth": lambda name, value: require_positive(name, value, "rad/s"),
    "max_delay_step": lambda name, value: require_positive(name, value, "s"),
    "max_iterations": lambda name, value: require_integer(name, value, 1),
    "max_rounds": lambda name, value: require_integer(name, value, 1),
    "filters": lambda name, value: require_integer(name, value, 2),
    "order": lambda name, value: require_integer(name, value, 1, 20),
    "tolerance": _require_fraction,
    "noise_model": lambda _, value: orders_of(value),
    "bootstrap_draws": lambda name, value: require_integer(name, value, LEAST_DRAWS),
}


@lru_cache
def _choices(options: type) -> dict[str, tuple[str, ...]]:
    """Return the allowed values of each option of a Literal type."""
    return {name: get_args(hint) for name, hint in get_type_hints(options).items() if get_origin(hint) is Literal}


def check_options(options: Any) -> None:
    """Check every option separately."""
    choices = _choices(options.__class__)
    for item in fields(options):
        name, value = item.name, getattr(options, item.name)
        if name == "poles":
            # A system may consist of integrators only.
            require_integer(name, value, int(not getattr(options, "integrators", 0)), 12)
        elif name in choices:
            require_choice(name, value, choices[name])
        elif name in CHECKS and not (value is None and item.default is None):
            CHECKS[name](name, value)


def check_proper(poles: int, zeros: int) -> None:
    """Check the degrees of a strictly proper model."""
    if zeros >= poles:
        given = f"got {zeros} zeros and {poles} poles"
        raise OptionError("zeros", f"zeros must be fewer than poles (a strictly proper model): {given}")


def checked_bounds(bounds: tuple[float, float], known_allowed: bool = False) -> tuple[float, float]:
    """Return the bounds of the delay as floats; equal bounds are a known delay."""
    try:
        low, high = (float(bound) for bound in bounds)
    except (TypeError, ValueError):
        low, high = np.nan, np.nan
    if not 0 <= low <= high < np.inf or (low == high and not known_allowed):
        wanted = "two delays in seconds, the smaller (0 or more) first"
        raise OptionError("delay_bounds", f"delay_bounds must be {wanted}: got {bounds!r}")
    return low, high


# --- records ---------------------------------------------------------------------------------------


def check_record(record: Record, data: FilterData, parameters: int, free_response: bool = False) -> None:
    """Refuse records without the data for an estimate; a free response does not require a varying input."""
    if data.count <= parameters:
        what = f"{named(record)}{data.count} usable samples are too few for {parameters} parameters"
        raise DataError(f"{what}; take a longer record, a smaller model, or a smaller largest delay")
    signals = record.held.values()
    if not any(np.ptp(signal.values) for signal in signals):
        if free_response:
            return
        first = next(iter(signals)).values[0]
        raise DataError(f"{named(record)}the input is constant ({first:g}): it excites nothing")
    if np.ptp(data.y_used) == 0.0:
        raise DataError(f"{named(record)}the output is constant ({data.y_used[0]:g}) over the usable samples")


def check_greatest_delay(record: Record, greatest: float) -> None:
    """Refuse a greatest delay as long as the record."""
    duration = record.t[-1] - max(signal.t[0] for signal in record.held.values())
    if greatest >= duration:
        delay = f"{named(record)}the greatest delay, {greatest:g} s,"
        raise DataError(f"{delay} is not shorter than the record, {duration:g} s")


def initial_delay(start: Start | None, bounds: tuple[float, float]) -> float:
    """Return the delay from which a search starts."""
    low, high = bounds
    delay = 0.5 * (low + high) if start is None or start.delay is None else start.delay
    if not low <= delay <= high:
        raise DataError(f"the initial delay, {delay:g} s, lies outside the delay bounds, {low:g} to {high:g} s")
    return delay


# --- results ---------------------------------------------------------------------------------------


def history_entry(stage: str, iteration: int, problem: Problem, row: Array) -> IterationRecord:
    """Describe one accepted iteration by its parameters, followed by their squared error."""
    a, b, delay = problem.split(row[:-1])
    cost = float(row[-1]) / problem.samples
    return IterationRecord(stage, iteration, delay, cost, tuple(a.tolist()), tuple(b.tolist()))


def history_of(stage: str, problem: Problem, path: Array) -> list[IterationRecord]:
    """Describe the start and the accepted steps of an iteration, the rows of its path."""
    return [history_entry(stage, k, problem, row) for k, row in enumerate(path)]


def quality(equations: Equations, spread: float, count: int) -> dict[str, Any]:
    """Return cost, fit and conditioning as fields of `Fit`; ``spread`` is ``sum (y - mean y)^2``."""
    r2 = 1.0 - equations.squared_error / spread
    return {
        "cost": equations.squared_error / count,
        "fit_percent": percent_from_r_squared(r2),
        "r2": r2,
        "count": count,
        "condition_number": condition_number(equations.hessian),
    }


def assessed(
    problem: Problem,
    theta: Array,
    equations: Equations,
    status: Status,
    kind: Covariance,
    draws: int,
    tangent: Array,
) -> dict[str, Any]:
    """Return uncertainty, status, cost and fit as fields of `Fit`; the columns of ``tangent`` are free directions."""
    y, nothing = problem.data.y_used, np.full((len(tangent),) * 2, np.nan)
    if not np.isfinite(equations.squared_error):
        unknown = dict.fromkeys(("cost", "fit_percent", "r2", "condition_number"), float("nan"))
        return {"covariance": nothing, "status": Status.DIVERGED, "count": y.size, **unknown}
    law: Uncertainty | None = None
    rows = problem.rows(theta) if tangent.shape[1] and kind != "white" else None
    if rows is not None:
        psi, error = rows
        law = estimate_uncertainty([psi], [error], kind, draws, tangent=tangent)
    elif tangent.shape[1] and kind == "white":
        hessian = tangent.T @ equations.hessian @ tangent
        found = white_noise_dispersion(hessian, equations.squared_error, problem.samples)
        law = Uncertainty.of("white", tangent, found)
    if status is Status.CONVERGED and law is not None and law.singular:
        status = Status.SINGULAR
    covariance = nothing if law is None else law.covariance
    spread = float(np.sum((y - y.mean()) ** 2))
    return {"covariance": covariance, "law": law, "status": status, **quality(equations, spread, y.size)}


def finish(
    problem: SampledProblem,
    theta: Array,
    status: Status,
    iterations: int,
    history: list[IterationRecord],
    kind: Covariance = "white",
    draws: int = DRAWS,
) -> Fit:
    """Assemble the result of an estimation, with standard errors for a kind of noise."""
    a, b, delay = problem.split(theta)
    size = problem.free
    # A fixed delay is not a parameter of the result. A delay at its bound is not a minimum and has no standard error;
    # the other standard errors are valid for that delay.
    accurate = 0 if status is Status.LEAST_SQUARES else size - int(status is Status.DELAY_AT_BOUND)
    found = problem.equations(theta)
    found = found._replace(hessian=found.hessian[:size, :size])
    return Fit(
        model=TransferFunction(b, a, delay),
        parameter_names=problem.structure.names,
        iterations=iterations,
        history=tuple(history),
        **assessed(problem, theta, found, status, kind, draws, np.eye(size)[:, :accurate]),
    )
