"""A fit to measured records with everything that tells whether to believe it."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ctid_cli.arrays import Array, IndexArray
from ctid_cli.errors import DataError
from ctid_cli.estimators.delay_profile import AppliedModel, DelayProfile, MeasuredFit, PreparedProfile
from ctid_cli.inference.conditioning import (
    CLOSE_TO_ONE,
    LARGE_STANDARD_ERROR,
    NEARLY_SINGULAR,
    describe_conditioning,
)
from ctid_cli.inference.covariance import condition_number
from ctid_cli.inference.criteria import (
    InformationCriteria,
    information_criteria,
    r_t_squared,
    young_information_criterion,
)
from ctid_cli.inference.delay_interval import DelayInterval, profile_likelihood_interval, quadratic_is_doubtful
from ctid_cli.inference.derived import DerivedParameter, derived_parameters
from ctid_cli.inference.diagnostics import fit_percent, r_squared
from ctid_cli.inference.quantile import normal_quantile
from ctid_cli.inference.residuals import ResidualTests, residual_tests
from ctid_cli.inference.robust import sandwich_covariance
from ctid_cli.inference.status import Status
from ctid_cli.signals.record import Record

#: Confidence level of intervals and tests.
LEVEL = 0.95
#: Fewer residuals than this are not tested.
FEWEST_TESTED = 20
#: A clock of which 95 % of the intervals are this close to their median counts as regular for the noise.
NEARLY_REGULAR = 0.05
#: An initial state or offset is asked for where it lowers the cost by this fraction, and Schwarz's criterion by ten.
WORTHWHILE = 0.02
DECISIVE = 10.0


@dataclass(frozen=True)
class Estimate:
    """One parameter of the model, or of an experiment."""

    name: str
    value: float
    standard_error: float
    low: float
    high: float
    status: str


@dataclass(frozen=True, eq=False)
class Validation:
    """The model on a record that it was not estimated from."""

    name: str
    applied: AppliedModel = field(repr=False)
    #: ``100 (1 - ||y - x|| / ||y - mean y||)`` [%].
    fit_percent: float
    #: ``1 - ||y - x||^2 / ||y - mean y||^2`` [-].
    r2: float
    count: int


@dataclass(frozen=True, eq=False)
class Identification:
    """A fit, its uncertainty, and its diagnostics.

    Parameters
    ----------
    options : DelayProfile
        What was asked for.
    fit : MeasuredFit
        The estimate.
    covariance : ndarray, shape (p, p)
        Covariance that the standard errors are from; NaN where it is not defined.
    robust : bool
        Whether it is the sandwich for coloured residuals, and not that for white ones.
    estimates : tuple of Estimate
        The parameters with their uncertainty.
    delay_interval : DelayInterval or None
        Profile-likelihood interval of the delay, where the quadratic one is doubtful.
    derived : tuple of DerivedParameter
        Poles, time constants, frequencies, damping, static gain.
    tests : tuple of ResidualTests
        One for each experiment with enough samples.
    criteria : InformationCriteria
        AIC, AICc, BIC, FPE.
    yic, r_t_squared : float
        Young's criterion and coefficient of determination [-].
    warnings : tuple of str
        What the user should know before using the model, one sentence or more each.
    validation : Validation or None
        The model on another record.
    """

    options: DelayProfile
    fit: MeasuredFit
    covariance: Array = field(repr=False)
    robust: bool
    estimates: tuple[Estimate, ...]
    delay_interval: DelayInterval | None
    derived: tuple[DerivedParameter, ...]
    tests: tuple[ResidualTests, ...]
    criteria: InformationCriteria
    yic: float
    r_t_squared: float
    warnings: tuple[str, ...]
    validation: Validation | None = None


def identify(options: DelayProfile, records: Sequence[Record], validation: Record | None = None) -> Identification:
    """Fit one model to the records and judge it.

    Parameters
    ----------
    options : DelayProfile
        The estimator.
    records : sequence of Record
        One for each experiment.
    validation : Record, optional
        Another record of the same system; its initial state and offset are treated as those of the others, with the
        model fixed.

    Returns
    -------
    Identification
        The model and everything about it.

    Raises
    ------
    DataError
        If a record cannot be used.

    Notes
    -----
    Standard errors are those for white residuals if no experiment's residuals fail the test of whiteness, and the
    sandwich's otherwise. The delay has a profile-likelihood interval where the quadratic one is doubtful.
    """
    checked = None if validation is None else _prepared_validation(options, validation)
    prepared = options.prepare(records)
    fit = prepared.fit()
    outputs = [record.y[use] for record, use in zip(records, fit.used, strict=True)]
    tests = _tests(fit, records)
    robust = any(not test.white for test in tests)
    covariance = _sandwich(fit, records) if robust else fit.covariance
    unclear = _undetermined(fit, covariance)
    words = _status_words(fit)
    words += _conditioning(fit, covariance)
    interval = None
    if prepared.structure.delay and "delay" not in unclear:
        interval = _delay_interval(prepared, fit, covariance)
    words += _interval_words(interval, options)
    words += _test_words(tests, len(records))
    words += _treatment_words(prepared, fit)
    size = prepared.structure.size - int(prepared.structure.delay)
    coefficients = covariance[:size, :size]
    free, hessian = _free_block(fit)
    if not condition_number(hessian) <= NEARLY_SINGULAR:
        coefficients = np.full_like(coefficients, np.nan)
    judged = None
    if checked is not None and validation is not None:
        judged = _validate(checked, fit, validation)
        if judged.r2 < 0.5 < fit.r2:
            words.append(
                f"The model explains {100 * fit.r2:.0f} % of the variance of the record it was estimated from, but "
                f"only {100 * max(judged.r2, 0.0):.0f} % of the validation record's: it does not carry over."
            )
    residuals = np.concatenate(fit.residuals)
    return Identification(
        options=options,
        fit=fit,
        covariance=covariance,
        robust=robust,
        estimates=_estimates(fit, covariance, unclear, interval),
        delay_interval=interval,
        derived=derived_parameters(fit.model, coefficients, level=LEVEL),
        tests=tests,
        criteria=information_criteria(float(residuals @ residuals), fit.count, fit.theta.size),
        yic=young_information_criterion(
            residuals, np.concatenate(outputs), fit.theta[free], covariance[np.ix_(free, free)]
        ),
        r_t_squared=r_t_squared(residuals, np.concatenate(outputs)),
        warnings=tuple(words),
        validation=judged,
    )


def _status_words(fit: MeasuredFit) -> list[str]:
    if fit.status is Status.DELAY_AT_BOUND and fit.model.delay == 0.0:
        return ["The delay stopped at zero: this model needs none; take it as known (--delay 0), or use fewer poles."]
    return [] if fit.status.succeeded else [fit.status.value]


# --- residuals and covariance ----------------------------------------------------------------------


def _tests(fit: MeasuredFit, records: Sequence[Record]) -> tuple[ResidualTests, ...]:
    """Tests of each experiment, at levels that make a false alarm as likely as with one."""
    level = 1.0 - (1.0 - LEVEL) / len(records)
    found = []
    for record, eps, psi, use in zip(records, fit.residuals, fit.sensitivities, fit.used, strict=True):
        if eps.size >= FEWEST_TESTED:
            delayed = record.input.at(record.t[use] - fit.model.delay)
            found.append(residual_tests(eps, delayed, level=level, sensitivities=psi))
    return tuple(found)


def _sandwich(fit: MeasuredFit, records: Sequence[Record]) -> Array:
    """Covariance for coloured residuals; a delay at its bound is taken as known, as in the white one."""
    free = np.isfinite(np.diag(fit.covariance))
    covariance = np.full_like(fit.covariance, np.nan)
    if not free.any():
        return covariance
    regular = all(_nearly_regular(record) for record in records)
    psi = [block[:, free] for block in fit.sensitivities]
    covariance[np.ix_(free, free)] = sandwich_covariance(psi, fit.residuals, regular=regular)
    return covariance


def _nearly_regular(record: Record) -> bool:
    """Whether lags counted in samples are lags in time, up to jitter."""
    intervals = np.diff(record.t)
    middle = float(np.median(intervals))
    return bool(np.mean(np.abs(intervals - middle) <= NEARLY_REGULAR * middle) >= 0.95)


def _undetermined(fit: MeasuredFit, covariance: Array) -> set[str]:
    """Parameters of which the data tell next to nothing, so that no tidy number may stand beside them.

    A coefficient or delay with ten times its own size for a standard error, and whatever moves along with it.
    """
    names, errors = fit.parameter_names, np.sqrt(np.diag(covariance))
    at_bound = fit.status is Status.DELAY_AT_BOUND
    free, hessian = _free_block(fit)
    if not condition_number(hessian) <= NEARLY_SINGULAR:
        return {names[k] for k in free}
    unclear = {
        k
        for k, name in enumerate(names)
        if not (at_bound and name == "delay")
        and (
            not np.isfinite(errors[k])
            or (
                re.fullmatch(r"[ab]\d+|delay", name) is not None
                and errors[k] > LARGE_STANDARD_ERROR * abs(fit.theta[k])
            )
        )
    }
    with np.errstate(invalid="ignore", divide="ignore"):
        correlation = np.abs(covariance / np.outer(errors, errors))
    moving = {j for k in unclear for j in range(len(names)) if correlation[k, j] > CLOSE_TO_ONE}
    return {names[k] for k in unclear | moving}


def _conditioning(fit: MeasuredFit, covariance: Array) -> list[str]:
    """Sentences on what the data do not determine; a delay at its bound is taken as known."""
    free, hessian = _free_block(fit)
    words = []
    if fit.status is Status.DELAY_AT_BOUND:
        words.append(
            "The delay has no standard error, because it stopped at a bound; those of the other parameters take it "
            "as known and are too small if it is not."
        )
    names = [fit.parameter_names[k] for k in free]
    block = covariance[np.ix_(free, free)]
    return [*words, *describe_conditioning(block, fit.theta[free], names, condition_number(hessian), hessian=hessian)]


def _free_block(fit: MeasuredFit) -> tuple[IndexArray, Array]:
    """Indices of the parameters that are not at a bound, and their part of ``sum psi psi'``."""
    held = fit.status is Status.DELAY_AT_BOUND
    free = np.array([k for k, name in enumerate(fit.parameter_names) if not (held and name == "delay")])
    hessian = sum((psi.T @ psi for psi in fit.sensitivities), np.zeros((fit.theta.size, fit.theta.size)))
    return free, hessian[np.ix_(free, free)]


# --- the delay -------------------------------------------------------------------------------------


def _delay_interval(prepared: PreparedProfile, fit: MeasuredFit, covariance: Array) -> DelayInterval | None:
    """Profile-likelihood interval of a free delay, None where estimate plus or minus two errors is as good."""
    place = prepared.structure.size - 1
    variance, white = float(covariance[place, place]), float(fit.covariance[place, place])
    if fit.status is Status.DELAY_AT_BOUND:
        variance = white = 1.0  # no standard error to inflate by
    squared_error = fit.cost * fit.count
    delay = float(fit.theta[place])
    inflation = max(variance / white, np.finfo(float).tiny)
    known: dict[float, float] = {}

    def squared_error_at(trial: float) -> float:
        if trial not in known:
            known[trial] = prepared.squared_error_at(fit.theta, trial)
        return known[trial]

    common = (squared_error, fit.count, fit.theta.size, prepared.options.delay_bounds)
    error = float("nan") if fit.status is Status.DELAY_AT_BOUND else float(np.sqrt(variance))
    if not quadratic_is_doubtful(squared_error_at, delay, error, *common, inflation=inflation):
        return None
    return profile_likelihood_interval(squared_error_at, delay, *common, level=LEVEL, inflation=inflation)


def _interval_words(interval: DelayInterval | None, options: DelayProfile) -> list[str]:
    if interval is None:
        return []
    low, high = options.delay_bounds
    # Below zero there is nothing left to search.
    ends = [f"{low:g}"] * (interval.open_low and low > 0) + [f"{high:g}"] * interval.open_high
    if not ends:
        return []
    return [
        f"The interval of the delay reaches the end of its search range ({' and '.join(ends)}): delays beyond may fit "
        "as well; widen --delay."
    ]


# --- what else should be estimated -----------------------------------------------------------------


def _treatment_words(prepared: PreparedProfile, fit: MeasuredFit) -> list[str]:
    """Whether an initial state or an offset, taken as zero, is visible in the record."""
    options, squared_error = prepared.options, fit.cost * fit.count
    n, experiments = options.poles, len(fit.residuals)

    def gain(added: int, *, initial_state: bool = False, offset: bool = False) -> float:
        lowered = prepared.squared_error_with(fit, initial_state=initial_state, offset=offset)
        share = 1.0 - lowered / squared_error if squared_error > 0 else 0.0
        if not share > 0:
            return 0.0
        evidence = -fit.count * np.log(max(1.0 - share, 1e-300)) - added * experiments * np.log(fit.count)
        return share if share > WORTHWHILE and evidence > DECISIVE else 0.0

    words = []
    if options.initial_state == "rest" and (share := gain(n, initial_state=True)):
        words.append(
            f"The record does not start at rest: estimating the initial state would lower the cost by "
            f"{100 * share:.2g} %; use --initial-state estimate (or periodic, if the input repeats the record)."
        )
    if options.offset == "none" and (share := gain(1, offset=True)):
        words.append(
            f"The output has an offset: estimating it would lower the cost by {100 * share:.2g} %; "
            "use --offset estimate (or remove, to subtract the means of input and output)."
        )
    return words


def _test_words(tests: Sequence[ResidualTests], experiments: int) -> list[str]:
    words = []
    for k, test in enumerate(tests, start=1):
        if not (test.white and test.uncorrelated):
            words.append((f"Experiment {k}: " if experiments > 1 else "") + test.sentence)
    if len(tests) < experiments:
        words.append(f"Fewer than {FEWEST_TESTED} residuals are too few to test; standard errors take them as white.")
    return words


# --- results ---------------------------------------------------------------------------------------


def _estimates(
    fit: MeasuredFit, covariance: Array, unclear: set[str], interval: DelayInterval | None
) -> tuple[Estimate, ...]:
    """Parameters, numerator first, then denominator, delay, and what belongs to the experiments."""
    nan = float("nan")
    quantile = normal_quantile(LEVEL)
    found: dict[str, Estimate] = {}
    for name, value, variance in zip(fit.parameter_names, fit.theta.tolist(), np.diag(covariance), strict=True):
        if name in unclear:
            found[name] = Estimate(name, value, nan, nan, nan, "undetermined")
            continue
        error = float(np.sqrt(variance))
        low, high = value - quantile * error, value + quantile * error
        status = "free"
        if name == "delay":
            if interval is not None:
                low, high = interval.low, interval.high
            if fit.status is Status.DELAY_AT_BOUND:
                status, error = "at bound", nan
        found[name] = Estimate(name, value, error, low, high, status)
    found.setdefault("delay", Estimate("delay", fit.model.delay, nan, nan, nan, "fixed"))
    order = {"b": 0, "a": 1, "delay": 2}

    def place(estimate: Estimate) -> int:
        return order.get("delay" if estimate.name == "delay" else estimate.name[0], 3)

    return tuple(sorted(found.values(), key=place))


def _prepared_validation(options: DelayProfile, record: Record) -> PreparedProfile:
    """Check the validation record before the fit takes its time."""
    try:
        return options.prepare(record)
    except DataError as error:
        raise DataError(f"validation record: {error}") from None


def _validate(prepared: PreparedProfile, fit: MeasuredFit, record: Record) -> Validation:
    applied = prepared.errors_of(fit.model)
    y = record.y[applied.used[0]]
    simulated = y - applied.residuals[0]
    return Validation(record.name, applied, fit_percent(y, simulated), r_squared(y, simulated), y.size)
