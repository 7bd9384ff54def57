"""Fit to measured records with its uncertainty and diagnostics."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np

from ctid_cli.arrays import Array, BoolArray
from ctid_cli.errors import DataError
from ctid_cli.estimation.common import assumed_holds, of_best_hold
from ctid_cli.estimation.delay_search import quarter_periods
from ctid_cli.estimation.measured_records import AppliedModel, MeasuredRecords
from ctid_cli.estimation.optimum.best_model import part_of
from ctid_cli.estimation.optimum.box import each_bounds
from ctid_cli.estimation.optimum.search import local_minimum
from ctid_cli.estimators.additive_output_error import AdditiveOutputError
from ctid_cli.estimators.delay_profile import DelayProfile, RecordsEstimator
from ctid_cli.estimators.determination import LEVEL, cost_of_delay
from ctid_cli.estimators.frequency_domain import (
    FrequencyDomain,
    FrequencyDomainFit,
    FrequencyDomainSum,
    FrequencyDomainSumFit,
)
from ctid_cli.estimators.loop_output_error import LaidOutLoop, LoopFit, LoopOutputError
from ctid_cli.estimators.measured_fit import MeasuredFit, MultiInputFit, several_intervals
from ctid_cli.estimators.measured_submodels import LaidOutSubmodels, MeasuredSubmodels, SubmodelsFit
from ctid_cli.estimators.reported_parameters import (
    determined,
    free_directions,
    reported_parameters,
    uncertainty_of_data,
)
from ctid_cli.estimators.rivc import Rivc
from ctid_cli.inference import criteria as criteria_of
from ctid_cli.inference.criteria import fit_percent, r_squared
from ctid_cli.inference.fit import DeferredFields, Fit, InputFit
from ctid_cli.inference.fitted_model import FittedModel
from ctid_cli.inference.innovations import sampled
from ctid_cli.inference.input_response import output_bandwidth
from ctid_cli.inference.intervals import BIASED, NOT_DETERMINED, DelayInterval, UncertainValue
from ctid_cli.inference.model_responses import Estimated
from ctid_cli.inference.noise_estimate import NoiseEstimate
from ctid_cli.inference.residual_tests import FEWEST_TESTED, ResidualTests, residual_tests
from ctid_cli.inference.response_test import ResponseTest, response_test
from ctid_cli.inference.sensitivities import Parametric
from ctid_cli.inference.uncertainty import DRAWS, UNSAFE, Covariance, Progress, Uncertainty, shifts_of_ends
from ctid_cli.models.several_inputs import delays_of
from ctid_cli.processors import one_thread
from ctid_cli.progress import reported
from ctid_cli.signals.checks import require_integer
from ctid_cli.signals.record import Record, common_samples, with_hold
from ctid_cli.text import Shown, listed

#: Estimators of measured records, and their prepared records.
Options = (
    DelayProfile
    | Rivc
    | AdditiveOutputError
    | MeasuredSubmodels
    | LoopOutputError
    | FrequencyDomain
    | FrequencyDomainSum
)
LaidOut = MeasuredRecords | LaidOutSubmodels | LaidOutLoop
#: Profile of the cost over the range of the delay: largest number of delays, and predicted relative decrease and number
#: of steps that end the descent at each of them.
MOST_DELAYS, ROUGH = 200, (3e-3, 10)
#: Plot of the cost: number of delays about the estimate, and half-range in half-widths of the interval.
DRAWN_DELAYS, DRAWN_INTERVALS = 24, 2.5


@dataclass(frozen=True, eq=False)
class Validation(DeferredFields):
    """Result of a model on another record."""

    deferred: ClassVar[tuple[str, ...]] = ("record", "applied")

    name: str
    record: Record = field(repr=False)
    applied: AppliedModel = field(repr=False)
    #: ``100 (1 - ||y - x|| / ||y - mean y||)`` [%].
    fit_percent: float
    #: ``1 - ||y - x||^2 / ||y - mean y||^2`` [-].
    r2: float
    count: int
    #: Treatment of state and offset, if it was chosen for this record.
    options: DelayProfile | AdditiveOutputError | None = None

    def prediction_fit(self, noise: NoiseEstimate, ahead: int) -> float:
        """Return ``100 (1 - ||y - p|| / ||y - mean y||)`` of predictions p with horizon ``ahead`` [samples]."""
        y = self.record.y[self.applied.used[0]]
        (errors,) = noise.prediction_errors(self.applied.residuals, self.applied.used, ahead)
        return fit_percent(y, y - errors)


@dataclass(frozen=True, eq=False)
class Identification(DeferredFields, FittedModel, Shown):
    """A fit, its uncertainty, and its diagnostics.

    Parameters
    ----------
    options : Options
        Estimator, such as a DelayProfile, an AdditiveOutputError or a FrequencyDomainSum.
    fit : MeasuredFit, MultiInputFit, SubmodelsFit, LoopFit, FrequencyDomainFit or FrequencyDomainSumFit
        Estimate.
    answer : ResponseTest
        Test of the response of the outputs to the inputs; without a response no parameter has a standard error.
    estimates : tuple of UncertainValue
        Parameters with their uncertainty.
    delay_interval : DelayInterval or None
        Profile-likelihood interval of the delay, if the quadratic one is doubtful.
    derived : tuple of UncertainValue
        Poles, time constants, frequencies, damping, static gain.
    tests : tuple of ResidualTests
        One for each experiment with enough samples.
    criteria : InformationCriteria
        AIC, AICc, BIC, FPE.
    yic, r_t_squared : float
        Young's criterion and coefficient of determination [-].
    warnings : tuple of str
        Limitations of the model, one or more sentences each.
    validation : Validation or None
        Result on another record.
    records : tuple of Record
        Records of the estimation.
    choices : tuple of str
        Automatic choices and their reasons, one sentence each.
    """

    deferred: ClassVar[tuple[str, ...]] = ("records",)

    options: Options
    fit: MeasuredFit | MultiInputFit | SubmodelsFit | LoopFit | FrequencyDomainFit | FrequencyDomainSumFit
    answer: ResponseTest
    estimates: tuple[UncertainValue, ...]
    delay_interval: DelayInterval | None
    derived: tuple[UncertainValue, ...]
    tests: tuple[ResidualTests, ...]
    criteria: criteria_of.InformationCriteria
    yic: float
    r_t_squared: float
    warnings: tuple[str, ...]
    validation: Validation | None = None
    records: tuple[Record, ...] = field(default_factory=tuple)
    choices: tuple[str, ...] = ()

    def __repr__(self) -> str:
        return f"Identification: {self.uncertainty.kind} covariance, {len(self.warnings)} warnings\n{self.fit!r}"

    def marks(self, time_unit: str = "s") -> list[str]:
        """Return what the records do not determine, and what a repeating input cannot tell apart, in sentences.

        Parameters
        ----------
        time_unit : str, default "s"
            Unit of time of the records.

        Returns
        -------
        list of str
            One sentence for each; empty if there is nothing to say.
        """
        items = (*self.estimates, *self.derived)
        found = self.fit._repeating(time_unit) if self.answer.seen else []
        reasons: dict[str, list[str]] = {}
        for item in items:
            if item.is_undetermined:
                values = " or ".join(f"{value:.5g}" for value in item.alternatives)
                name = f"{item.name} ({values})" if values else item.name
                reasons.setdefault(item.reason.removeprefix(NOT_DETERMINED).lstrip(":. "), []).append(name)
            elif item.intervals:
                found.append(several_intervals(item.name, item.intervals))
        found += [f"{NOT_DETERMINED}: {listed(names)}{f': {why}' if why else '.'}" for why, names in reasons.items()]
        return found

    @property
    def fit_percent(self) -> float:
        """``100 (1 - ||y - x|| / ||y - mean y||)`` of the records [%]."""
        return self.fit.fit_percent

    @property
    def parameters(self) -> dict[str, float]:
        """Values of the parameters by name, including known ones."""
        return {item.name: item.estimate for item in self.estimates}

    @property
    def standard_errors(self) -> dict[str, float]:
        """Standard errors of the parameters by name; NaN without one."""
        return {item.name: item.standard_error for item in self.estimates}

    def validate(self, record: Record) -> Validation:
        """Validate the model on another record of the same system.

        Parameters
        ----------
        record : Record
            Record that was not used for the estimation.

        Returns
        -------
        Validation
            Fit of the model, with the treatment of state and offset of the estimation.

        Raises
        ------
        DataError
            If the record cannot be used.
        """
        record = self._as_held(record)
        return validated(self.options._applied(self.fit, laid_out_validation(self.options, record)), record)

    def _as_held(self, record: Record) -> Record:
        """Return another record with the hold of those of the estimation, unless its own is given."""
        return with_hold(record, self.records[0].hold) if record.hold_assumed else record

    @property
    def uncertainty(self) -> Uncertainty:
        """Covariance of the standard errors, and quantiles of the intervals."""
        assert self.fit.law is not None
        return self.fit.law

    @property
    def seen_in_validation(self) -> int:
        """Number of samples of the validation record that were used for the estimation."""
        return 0 if self.validation is None else common_samples(self.validation.record, self.records)

    @property
    def errors_sentence(self) -> str:
        """Assumptions of the standard errors, and construction of the intervals, as a sentence."""
        found, what = self.uncertainty, self.fit.left_over
        if not self.answer.seen:
            return "There are no standard errors, as no answer to the input is seen."
        if found.kind == "biased":
            return BIASED
        if not np.isfinite(np.diag(found.covariance)).any():
            return "There are no standard errors."
        passed = all(test.white for test in self.tests)
        if found.kind == "white":
            text = f"Standard errors are those for white {what}"
            text += f", as the {what} pass the test" * bool(self.tests and passed)
        else:
            why = "" if passed else f", because the {what} are not white"
            noise = ["coloured noise" + why] * found.coloured + ["noise of changing variance"] * found.changing
            noise += ["the rounding of the output"] * found.rounded
            text = f"Standard errors allow for {listed(noise or ['coloured noise' + why])}"
        if found.bootstrap is None:
            reach, freedom = found.spans()
            text += f"; intervals are estimate -+ {reach} of them (t, {freedom} degrees of freedom)"
        else:
            draws = f"95 % of {len(found.bootstrap.errors)} estimates from simulated noise"
            text += f"; intervals are estimate -+ as many of them as {draws} keep within (bootstrap-t)"
        if self.delay_interval is not None:
            text += ", that of the delay from the profile of the cost, which is not quadratic there"
        return f"{text}."

    @property
    def driver(self) -> str:
        """Signal against which residuals are tested: the input, or the reference of a loop."""
        return "reference" if any(test.driver == "reference" for test in self.tests) else "input"

    def predict(self, record: Record, ahead: int = 1) -> Array:
        """Predict the output of a record from its input and past outputs.

        Parameters
        ----------
        record : Record
            Record of the same system, on a regular clock if the fit has a noise model.
        ahead : int, default 1
            Prediction horizon in samples [-].

        Returns
        -------
        ndarray, shape (N,)
            Predictions [output unit]; NaN at unused samples. They are the simulated output, with the initial state and
            the offset that fit this record best, plus the prediction of the noise, which is zero without a noise model
            and decreases with the horizon.

        Raises
        ------
        DataError
            If the record cannot be used.
        OptionError
            If ``ahead`` is not a positive integer.
        """
        require_integer("ahead", ahead, 1)
        if ahead > 1 and isinstance(self.fit, LoopFit) and self.fit.in_ignored_loop:
            raise DataError("a plant that may be unstable is predicted one sample ahead only")
        applied = self.options._applied(self.fit, self.options.prepare(self._as_held(record)).laid_out)
        (use,), errors, found = applied.used, applied.residuals, np.full(record.n_samples, np.nan)
        left = errors if self.fit.noise is None else self.fit.noise.prediction_errors(errors, applied.used, ahead)
        found[use] = record.y[use] - left[0]
        return found

    def _estimated(self) -> Estimated:
        """Return the model with the source of its reported errors and intervals."""
        if isinstance(self.fit, MultiInputFit):
            return self.fit._estimated()
        law = self.uncertainty if self._determined else self.uncertainty.undefined
        return Estimated(Parametric(self.fit.parametrised, self.fit.parameter_names), law)

    def of_input(self, name: str) -> InputFit:
        """Return the transfer function of one of several inputs, with its responses.

        Parameters
        ----------
        name : str
            Name of the input.

        Returns
        -------
        InputFit
            The model from this input to the output.

        Raises
        ------
        DataError
            If the input does not exist, or the model has only one input.
        """
        if not isinstance(self.fit, MultiInputFit):
            raise DataError("the model has one input; its responses are those of the fit")
        found = self.fit.of_input(name)
        return found if self._determined else replace(found, law=self.uncertainty.undefined)

    @cached_property
    def profile(self) -> "Profile | None":
        """Cost over the range of the delay; None if the delay is known, or one of several."""
        return profile_of_delay(self)

    @property
    def _determined(self) -> bool:
        """Whether the record contains information on the parameters."""
        return self.answer.seen and any(item.status == "free" for item in self.estimates)


@one_thread
@reported("fitting the model")
def identify(
    options: Options,
    records: Sequence[Record],
    validation: Record | None = None,
    covariance: Covariance = "auto",
    bootstrap_draws: int = DRAWS,
    progress: Progress | None = None,
) -> Identification:
    """Fit one model to the records and compute its diagnostics, without warnings.

    Standard errors are those for white residuals if no experiment's residuals fail the test of whiteness, and those for
    coloured noise otherwise. The response is tested against noise with the spectrum of the outputs, with allowance for
    the search over poles and delays.
    """
    # Check the validation record before the fit, which takes longer.
    checked = None if validation is None else laid_out_validation(options, validation)
    # Errors for coloured noise are computed once, below, where a bootstrap can report its progress.
    versions: dict[Any, Sequence[Record]] = assumed_holds(records)
    each = {hold: replace(options, covariance="white").prepare(one) for hold, one in versions.items()}
    fit: MeasuredFit | SubmodelsFit | LoopFit = of_best_hold({hold: one.minimum() for hold, one in each.items()})
    hold = fit.assumed_hold and fit.assumed_hold.hold
    prepared, records = each[hold], [with_hold(one, one.hold) for one in versions[hold]]
    if validation is not None and validation.hold_assumed:
        validation = with_hold(validation, records[0].hold)
        checked = laid_out_validation(options, validation)
    uncertainty = fit.uncertainty(covariance, bootstrap_draws, progress)
    fit = fit._with_law(uncertainty)
    measured: Any = prepared.laid_out
    inside = options._inside(fit, measured) if isinstance(options, RecordsEstimator) else []
    fit, found = determined(fit, measured, inside)
    # Equivalent least-squares problem near the estimate, with pseudo-errors for another loss.
    linear, laid_out = fit.linear, prepared.laid_out
    if isinstance(laid_out, MeasuredRecords):
        laid_out = laid_out.near(fit.residuals, fit.weighting, fit.arma)
    residuals = np.concatenate(fit.residuals)
    output = np.concatenate([record.y[use] for record, use in zip(records, fit.used, strict=True)])
    answering = [options._acting(record) for record in prepared.laid_out.records]
    answer = answer_of(options, answering, fit.used)
    squared_error = float(residuals @ residuals) if fit.weighting is None else fit.cost * fit.count
    size = fit.theta.size - len(fit.known)
    if fit.noise is not None:
        squared_error, size = fit.count * np.exp(fit.noise.deviance / fit.count), size + sum(fit.noise.orders)
    tests = tests_of(options, linear, records)
    reported = reported_parameters(fit, uncertainty, answer.seen, laid_out, found)
    free, matrix = free_directions(linear)[0], uncertainty_of_data(fit, uncertainty).covariance
    validated_on = None
    if checked is not None and validation is not None:
        validated_on = validated(options._applied(fit, checked), validation)
    return Identification(
        options=replace(options, covariance=covariance, bootstrap_draws=bootstrap_draws),
        fit=fit,
        answer=answer,
        **reported._asdict(),
        tests=tests,
        criteria=criteria_of.information_criteria(squared_error, fit.count, size),
        yic=criteria_of.young_information_criterion(residuals, output, fit.theta[free], matrix[np.ix_(free, free)]),
        r_t_squared=criteria_of.r_t_squared(residuals, output),
        warnings=(),
        validation=validated_on,
        records=tuple(records),
        choices=tuple(Fit.marks(fit)),
    )


@reported("tests of the residuals")
def tests_of(options: Options, fit: MeasuredFit, records: Sequence[Record]) -> tuple[ResidualTests, ...]:
    """Return the tests of each experiment, at levels with the false-alarm probability of a single one.

    With several inputs each has a separate test.
    """
    found, delays = [], delays_of(fit.model)
    level = 1.0 - (1.0 - LEVEL) / (len(records) * len(delays))
    for record, eps, psi, use in zip(records, fit.residuals, fit.sensitivities, fit.used, strict=True):
        if eps.size >= FEWEST_TESTED:
            acting = options._acting(record)
            role = "input" if acting is record else "reference"
            for (name, signal), delay in zip(acting.held.items(), delays, strict=True):
                tests = residual_tests(eps, signal.at(record.t[use] - delay), level=level, sensitivities=psi)
                found.append(replace(tests, driver=f"{role} {name}" if acting.several else role))
    return tuple(found)


def answer_of(options: Options, records: Sequence[Record], used: Sequence[BoolArray]) -> ResponseTest:
    """Test the response of the output to its input; for several inputs by the least of their p-values."""
    names = list(records[0].held)
    if len(names) == 1:
        return response_test(records, used, options.delay_bounds, options.initial_state)
    assert isinstance(options, DelayProfile)
    each = zip(names, options._each(names), strict=True)
    tests = [
        response_test([record.of_input(name) for record in records], used, own.delay_bounds, own.initial_state)
        for name, own in each
    ]
    best = min(tests, key=lambda test: test.p_value)
    return replace(best, p_value=min(1.0, len(names) * best.p_value))


def unsafe_intervals(found: Identification) -> list[str]:
    """Return the parameters with intervals beyond the range in which the output is linear in them."""
    fit, options = found.fit, found.options
    shown = [item.name for item in found.estimates if np.isfinite(item.standard_error)]
    if not shown or getattr(options, "instruments", "open_loop") != "open_loop" or isinstance(fit, MultiInputFit):
        return []
    records = [options._acting(record) for record in options.prepare(found.records).laid_out.records]
    model, linear = Parametric(fit.parametrised, fit.parameter_names), fit.linear
    noises = () if fit.arma is None else sampled(fit.arma, fit.used)
    shifts = shifts_of_ends(model, found.uncertainty, records, linear.used, linear.sensitivities, noises)
    return [name for name, shift in zip(fit.parameter_names, shifts, strict=True) if name in shown and shift > UNSAFE]


class DelayCosts(NamedTuple):
    """Cost about the estimated delay, minimised over all other parameters."""

    #: Delays [s] and costs [output unit^2], each of shape (K,).
    delays: Array
    costs: Array
    least: float
    #: Largest cost of delays that the data do not reject.
    allowed: float

    def percent_above(self, costs: Any) -> Any:
        """Return costs relative to the least, minus one [%]."""
        return 100.0 * (costs / self.least - 1.0)


class Profile(NamedTuple):
    """Cost over the whole range of the delay, minimised over all other parameters from the estimate."""

    #: Delays [s], shape (K,).
    delays: Array
    #: Mean squared output error [output unit^2], shape (K,).
    costs: Array
    #: Number of used samples, which of long records are the most active part.
    samples: int


def profile_of_delay(result: Identification) -> Profile | None:
    """Return the cost over the range of the delay; None if it is known, and for several inputs, sums, loops, spectra.

    The spacing is a quarter period of the bandwidth of the output, unless these are too many delays. At each one the
    descent starts from the poles at the next one, towards that of the estimate.
    """
    if isinstance(result.fit, MultiInputFit) or not result.records:
        return None
    laid_out = result.options.prepare(result.records).laid_out
    if not isinstance(laid_out, MeasuredRecords) or laid_out.problem.terms or "delay" not in result.fit.parameter_names:
        return None
    ((low, high),) = each_bounds(laid_out.treatment.delay_bounds)
    problem = part_of(laid_out.problem, high) or laid_out.problem
    bandwidth = max(output_bandwidth(record) for record in laid_out.records)
    delays = quarter_periods(low, high, bandwidth, MOST_DELAYS)
    costs, count = np.zeros(delays.size), sum(data.y_used.size for data in problem.records)
    start, first = laid_out.free_poles(result.fit.model), int(np.searchsorted(delays, delays_of(result.fit.model)[0]))
    for places in (range(first, delays.size), range(first - 1, -1, -1)):
        poles = start
        for k in places:
            delay = float(delays[k])
            found = local_minimum(problem, poles, delay, (delay, delay), *ROUGH, known=laid_out.known)
            poles, costs[k] = found.point.poles, found.squared_error / count
    return Profile(delays, costs, count)


def costs_about_delay(result: Identification) -> DelayCosts | None:
    """Return the cost around its minimum at the estimated delay; None without an interval of the delay."""
    fit = result.fit.linear
    item = next(item for item in result.estimates if item.name == "delay")
    if "delay" not in fit.parameter_names or not (np.isfinite([item.low, item.high]).all() and fit.cost > 0):
        return None
    laid_out = result.options.prepare(result.records).laid_out
    if not isinstance(laid_out, MeasuredRecords):
        return None
    profile, reach, _ = cost_of_delay(
        laid_out.near(result.fit.residuals, result.fit.weighting, result.fit.arma),
        fit,
        result.uncertainty,
    )
    half = DRAWN_INTERVALS * max(item.high - item.estimate, item.estimate - item.low)
    low, high = max(item.estimate - half, profile.bounds[0]), min(item.estimate + half, profile.bounds[1])
    delays = np.unique([*np.linspace(low, high, DRAWN_DELAYS), item.estimate])
    costs = np.array([profile.squared_error_at(float(delay)) for delay in delays]) / fit.count
    return DelayCosts(delays, costs, fit.cost, fit.cost * (1.0 + profile.allowed(reach)))


def laid_out_validation(options: Options, validation: Record) -> LaidOut:
    """Return a prepared validation record."""
    try:
        return options.prepare(validation).laid_out
    except DataError as error:
        raise DataError(f"validation record: {error}") from None


def models_of(found: Identification) -> dict[str, FittedModel]:
    """Return the model with its responses, or the models of several inputs by name."""
    if isinstance(found.fit, MultiInputFit):
        return {name: found.of_input(name) for name in found.fit.model.parts}
    return {"": found}


def validated(applied: AppliedModel, record: Record) -> Validation:
    """Return the measures of a model on another record."""
    y = record.y[applied.used[0]]
    simulated = y - applied.residuals[0]
    return Validation(record.name, record, applied, fit_percent(y, simulated), r_squared(y, simulated), y.size)
