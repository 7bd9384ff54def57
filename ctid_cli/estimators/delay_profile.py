"""Global estimation from measured records: one-dimensional search over the delay, then output-error minimisation."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np

from ctid_cli.arrays import Array, BoolArray
from ctid_cli.errors import DataError, OptionError, UsageError
from ctid_cli.estimation.common import Bound, Estimator, Fixed, Start, checked_bounds, places_of, quality
from ctid_cli.estimation.measured_records import AppliedModel, MeasuredRecords, Treatment, sensitivities
from ctid_cli.estimation.noise_search import joint_optimum
from ctid_cli.estimation.optimum.best_model import Begin, Optimum
from ctid_cli.estimation.optimum.box import Box
from ctid_cli.estimation.optimum.known import NOTHING, KnownCoefficients
from ctid_cli.estimation.parameter_bounds import BoundedSearch, Quantity, quantities_of
from ctid_cli.estimation.parameter_layout import Degrees, Layout
from ctid_cli.estimation.profile_search import Profile, search_delay
from ctid_cli.estimation.robust_fit import RobustFit, robust_fit, robust_local
from ctid_cli.filtering.bank import Equations
from ctid_cli.inference.criteria import percent_from_r_squared
from ctid_cli.inference.fit import DeferredFields, Fit, InputFit, Status
from ctid_cli.inference.model_responses import Estimated
from ctid_cli.inference.noise_estimate import NoiseEstimate, hausman, noise_covariance, orders_of
from ctid_cli.inference.robust_loss import Loss, Weighting, weighted
from ctid_cli.inference.uncertainty import DRAWS, Covariance, Progress, Uncertainty, estimate_uncertainty
from ctid_cli.models.several_inputs import AnyModel, MultiInputModel, delays_of, is_delay
from ctid_cli.signals.noise import ArmaNoise
from ctid_cli.signals.record import Record, as_records, named
from ctid_cli.signals.treatment import InitialState, InputBefore, LossKind, Offset, OutputHold


class Starts(NamedTuple):
    """Number of local searches, and number that agree with the best of them."""

    tried: int
    agree: int


class Met(NamedTuple):
    """Parameter at a given bound."""

    name: str
    end: float


@dataclass(frozen=True, eq=False, repr=False)
class MeasuredFit(DeferredFields, Fit):
    """Fit with data of its records.

    Parameters
    ----------
    model, parameter_names, covariance, status, r2, count, condition_number, law, in_ignored_loop
        As in :class:`~ctid_cli.inference.fit.Fit`.
    cost : float
        Mean squared output error over the used samples, or twice the mean of another loss [output unit^2].
    fit_percent : float
        ``100 (1 - ||y - x|| / ||y - mean y||)`` over the used samples of all experiments, means by experiment [%].
    iterations : int
        Evaluations of the cost and of its gradient in the refinement.
    history : tuple of IterationRecord
        Empty.
    theta : ndarray, shape (p,)
        All free parameters, in the order of ``parameter_names``.
    initial_states : tuple of ndarray
        Coefficients of C for each experiment; empty arrays if the state was not estimated.
    offsets : tuple of float
        Output offset of each experiment [output unit]; the subtracted mean if means were removed.
    input_offsets : tuple of float
        Subtracted mean of the input [input unit]; 0 without.
    profile : Profile or None
        Search over the delay; None for a known delay.
    residuals : tuple of ndarray
        Output errors at the used samples of each experiment [output unit].
    sensitivities : tuple of ndarray
        psi at the used samples of each experiment, shape (count, p).
    used : tuple of ndarray of bool
        Mask of the used samples of each record, shape (N,).
    starts : Starts or None
        Number of local searches, and number that reached the estimate.
    poles_at_infinity : int
        Number of requested poles at infinity, by which the model has fewer poles.
    box : Box or None
        Set of admissible models.
    weighting : Weighting or None
        Weights of the samples, if the loss is not that of squares.
    held_poles : tuple of complex
        Poles at a bound of that set [rad/s], treated as known in the standard errors.
    tangent : ndarray, shape (p, f)
        Free directions of the parameters: columns of the identity unless poles or the delay are at a bound.
    known : tuple of str
        Names of the fixed parameters.
    noise : NoiseEstimate or None
        Noise model estimated with the plant; None for an output-error fit.
    bounds_met : tuple of Met
        Parameters at a given bound, and these bounds.
    """

    deferred: ClassVar[tuple[str, ...]] = ("residuals", "sensitivities", "used")

    theta: Array = field(default_factory=lambda: np.zeros(0))
    initial_states: tuple[Array, ...] = ()
    offsets: tuple[float, ...] = ()
    input_offsets: tuple[float, ...] = ()
    profile: Profile | None = None
    residuals: tuple[Array, ...] = field(default_factory=tuple)
    sensitivities: tuple[Array, ...] = field(default_factory=tuple)
    used: tuple[BoolArray, ...] = field(default_factory=tuple)
    starts: Starts | None = None
    poles_at_infinity: int = 0
    box: Box | None = None
    weighting: Weighting | None = None
    held_poles: tuple[complex, ...] = ()
    tangent: Array = field(default_factory=lambda: np.zeros((0, 0)))
    known: tuple[str, ...] = ()
    noise: NoiseEstimate | None = None
    bounds_met: tuple[Met, ...] = ()

    def uncertainty(
        self, kind: Covariance = "auto", draws: int = DRAWS, progress: Progress | None = None
    ) -> Uncertainty:
        """Return standard errors and intervals for a kind of noise.

        Parameters
        ----------
        kind : {"auto", "white", "robust", "bootstrap"}, default "auto"
            Assumed noise; ``auto`` is white unless the residuals are not.
        draws : int, default 500
            Number of simulated noise sequences of a bootstrap [-].
        progress : callable, optional
            Called after each sequence with the numbers of completed and of all sequences.

        Returns
        -------
        Uncertainty
            Covariance, and quantiles of the intervals.
        """
        linear = self.linear
        found = estimate_uncertainty(
            linear.sensitivities, linear.residuals, kind, draws, tangent=self.tangent, progress=progress
        )
        return found.in_ignored_loop if self.in_ignored_loop and kind == "auto" else found

    def _with_uncertainty(self, kind: Covariance, draws: int) -> Self:
        """Return the fit with errors for a kind of noise; singular if it converged but has no covariance."""
        law = self.uncertainty(kind, draws)
        singular = self.status is Status.CONVERGED and not np.isfinite(law.free_covariance).all()
        return replace(self, covariance=law.covariance, law=law, status=Status.SINGULAR if singular else self.status)

    @property
    def signs_known(self) -> bool:
        """Whether no coefficient of the denominator can be zero, which is true for stable plants."""
        return not (self.model.poles.real > 0).any()

    @property
    def linear(self) -> "MeasuredFit":
        """Least-squares fit with the same distribution: itself, or with pseudo-errors of its loss, or innovations."""
        if self.noise is not None:
            return self._of_innovations
        if self.weighting is None:
            return self
        law = FittedSamples(self.residuals, self.sensitivities, self.used, self.weighting).linear
        count = sum(eps.size for eps in law.residuals)
        cost = sum(float(eps @ eps) for eps in law.residuals) / count
        return replace(self, **law._asdict(), count=count, cost=cost)

    @property
    def arma(self) -> ArmaNoise | None:
        """Noise model estimated with the plant."""
        return None if self.noise is None else self.noise.noise

    @cached_property
    def _of_innovations(self) -> "MeasuredFit":
        assert self.noise is not None
        psi, innovations = self.noise.whitened(self.sensitivities, self.residuals, self.used)
        cost = sum(float(e @ e) for e in innovations) / self.count
        return replace(self, sensitivities=psi, residuals=innovations, cost=cost, noise=None)

    @property
    def left_over(self) -> str:
        """Name of the tested sequence."""
        return "residuals" if self.noise is None else "innovations"

    def prediction_fit(self, ahead: int) -> float:
        """Return the fit of predictions of the outputs; without a noise model that of simulated outputs.

        Parameters
        ----------
        ahead : int
            Prediction horizon in samples [-].

        Returns
        -------
        float
            ``100 (1 - ||y - p|| / ||y - mean y||)`` of the predictions p [%].
        """
        if self.noise is None:
            return self.fit_percent
        errors = self.noise.prediction_errors(self.residuals, self.used, ahead)
        mean_square = sum(float(e @ e) for e in errors) / self.count
        simulated = sum(float(e @ e) for e in self.residuals) / self.count
        return percent_from_r_squared(1.0 - (1.0 - self.r2) * mean_square / simulated)

    @property
    def parameters(self) -> dict[str, float]:
        """Free parameters by name."""
        return dict(zip(self.parameter_names, self.theta.tolist(), strict=True))


@dataclass(frozen=True, eq=False, repr=False)
class MultiInputFit(MeasuredFit):
    """Fit to records with several inputs, with one transfer function for each.

    Parameters
    ----------
    model : MultiInputModel
        Transfer functions of the inputs.
    parameter_names, covariance, status, cost, fit_percent, r2, count, iterations, condition_number, history, law
        As in :class:`MeasuredFit`.
    in_ignored_loop, theta, initial_states, offsets, input_offsets, profile, residuals, sensitivities, used, starts
        As in :class:`MeasuredFit`; ``input_offsets`` has those of all inputs, record by record.
    poles_at_infinity, box, weighting, held_poles, tangent, known, noise, bounds_met
        As in :class:`MeasuredFit`.
    """

    model: MultiInputModel  # type: ignore[assignment]  # callers that need one transfer function use that of an input

    @property
    def coefficients(self) -> dict[str, float]:
        """Coefficients and delays by name, including known delays."""
        known = {f"{name}_delay": part.delay for name, part in self.model.parts.items()}
        return {n: v for n, v in self.parameters.items() if re.fullmatch(r"(.+_)?[ab]\d+", n)} | {
            n: self.parameters.get(n, v) for n, v in known.items()
        }

    def of_input(self, name: str) -> InputFit:
        """Return the transfer function of an input, with its responses.

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
            If the input does not exist.
        """
        if name not in self.model.parts:
            raise DataError(f"there is no input {name!r}; there are {', '.join(self.model.parts)}")
        law = self.law or Uncertainty.known(self.covariance)
        return InputFit.of(name, self.model.parts[name], self.parameter_names, law)

    def _estimated(self) -> Estimated:
        """Raise an error, since there is no single transfer function."""
        inputs = ", ".join(self.model.parts)
        raise UsageError(f"the model has the inputs {inputs}; take one of them, such as fit.of_input(NAME)")


def _within(bounds: tuple[float, float] | None, delays: tuple[float, float]) -> tuple[float, float]:
    """Return the range of a delay restricted to optional bounds."""
    if bounds is None:
        return delays
    low, high = max(bounds[0], delays[0]), min(bounds[1], delays[1])
    if low > high:
        given = f"{bounds[0]:g} to {bounds[1]:g} s and delay_bounds {delays[0]:g} to {delays[1]:g} s"
        raise OptionError("bounds", f"no delay is within its bounds, {given}; give one of them")
    return low, high


class FittedSamples(NamedTuple):
    """Signals of a fit at each used sample of each record."""

    residuals: tuple[Array, ...]
    sensitivities: tuple[Array, ...]
    used: tuple[BoolArray, ...]
    weighting: Weighting | None

    @property
    def linear(self) -> "FittedSamples":
        """Least squares with the same distribution: pseudo-errors, with samples of zero weight as missing."""
        if self.weighting is None:
            return self
        kept = [weights > 0.0 for weights in self.weighting.weights]
        left = [use.copy() for use in self.used]
        for use, keep in zip(left, kept, strict=True):
            use[use] = keep
        errors = tuple(e[keep] for e, keep in zip(self.weighting.pseudo_errors, kept, strict=True))
        slopes = tuple(psi[keep] for psi, keep in zip(self.sensitivities, kept, strict=True))
        return FittedSamples(errors, slopes, tuple(left), None)


class RecordsEstimator(Estimator[MeasuredRecords, MeasuredFit]):
    """Base class of the estimators of records in open loop."""

    initial_state: InitialState
    offset: Offset
    loss: LossKind
    input_before: InputBefore
    noise_model: str
    integrators: int

    def _least(
        self,
        measured: MeasuredRecords,
        starts: Sequence[Begin],
        profile: Profile | None = None,
        *,
        nested: bool = False,
    ) -> MeasuredFit:
        """Return the optimum from starts for the given loss and noise model, without a covariance."""
        if self.loss != "squares":
            robust = robust_fit(measured, self.loss, starts, nested)
            return fitted(measured, robust.found, profile, robust)
        found = measured.best(starts, nested)
        fit = fitted(measured, found, profile, None)
        if self.noise_model == "white":
            return fit
        return with_noise(measured, fit, found, self.noise_model, starts, nested=nested)

    def _simulated(self, fit: MeasuredFit, measured: MeasuredRecords) -> list[Array]:
        """Return the outputs of a fit, without removed means, at the used samples of prepared records."""
        parts = sensitivities(measured.problem, measured.layout_of(fit.model), fit.theta, delays_of(fit.model))
        return [data.y_used - eps for data, (_, eps) in zip(measured.problem.records, parts, strict=True)]

    # --- diagnostics of a fit --------------------------------------------------------------------------

    def _acting(self, record: Record) -> Record:
        """Return the record with its exogenous signal as input."""
        return record

    def _samples(self, fit: MeasuredFit, measured: Any) -> FittedSamples:
        """Return the signals of a fit at each used sample, from its parameters."""
        return samples_at(measured, fit.model, fit.theta, None if fit.weighting is None else fit.weighting.losses)

    def _applied(self, fit: MeasuredFit, measured: Any) -> AppliedModel:
        """Return the model applied to another record."""
        inputs = list(fit.model.parts) if isinstance(fit, MultiInputFit) else [""]
        if list(measured.degrees.inputs) != inputs:
            given = ", ".join(filter(None, measured.degrees.inputs)) or "one input"
            wanted = ", ".join(filter(None, inputs)) or "one input"
            raise DataError(f"{named(measured.records[0])}the record has {given}, and the model has {wanted}")
        weighed = measured if fit.arma is None else measured.whitened_by(fit.arma)
        found: AppliedModel = weighed.errors_of(fit.parametrised)
        return found


@dataclass(frozen=True)
class InputModel:
    """Options of one of several inputs; None takes the option of the estimator.

    Parameters
    ----------
    name : str
        Name of the input.
    poles : int, optional
        Number of poles of a separate denominator; if any input has one, all denominators are separate.
    zeros : int, optional
        Degree of the numerator.
    delay_bounds : tuple of float, optional
        Least and greatest delay [s]; equal values fix the delay.
    integrators : int, optional
        Poles at the origin of a separate denominator.
    """

    name: str
    poles: int | None = None
    zeros: int | None = None
    delay_bounds: tuple[float, float] | None = None
    integrators: int | None = None


@dataclass(frozen=True)
class DelayProfile(RecordsEstimator):
    """Global search over the delay, refined by output-error minimisation with initial state and offset.

    Parameters
    ----------
    poles : int
        Degree of the denominator, 1 to 12.
    zeros : int
        Degree of the numerator, below ``poles``; equal to ``poles`` only for a known delay.
    delay_bounds : tuple of float
        Least and greatest delay [s]; equal values fix the delay.
    initial_state : {"rest", "estimate", "periodic"}, default "rest"
        State before the record: at rest (zero input before the first sample), estimated with the model, or the steady
        state of a periodic input whose period is the record.
    offset : {"none", "remove", "estimate", "drift"}, default "none"
        Offset of the output: none, means of input and output subtracted first, or a constant estimated with the model;
        ``drift`` also estimates a slope [output unit/s], with the offset at the first instant.
    loss : {"squares", "huber", "tukey"}, default "squares"
        Loss function of the output errors: squares; quadratic up to 1.345 standard deviations and linear beyond
        (Huber); or constant beyond 4.685 standard deviations (Tukey's biweight), for records with outliers.
    svf_cutoff : float, optional
        Cut-off of the state-variable filter of the starts [rad/s]; by default from the bandwidth of the output.
    nested : bool, default False
        Whether nested smaller models are fitted too, and random starts used: slower, but the cost then never increases
        with the number of poles or zeros. Otherwise only the minima of the profile are refined.
    hold_output : {"foh", "zoh"}, default "foh"
        Interpolation of the measured output between samples; does not affect the estimate.
    covariance : {"auto", "white", "robust", "bootstrap"}, default "auto"
        Noise assumed for the standard errors: white, or coloured with an autocorrelation estimated from the residuals
        (``robust``); ``bootstrap`` adds bootstrap-t intervals. ``auto`` is white if the residuals pass the Ljung-Box
        test at the 5 % level, else robust, or none if the record is from a loop that the estimator ignores.
        ``sandwich`` is an earlier name of ``robust``.
    bootstrap_draws : int, default 500
        Number of simulated noise sequences of a bootstrap [-].
    fixed : tuple of Fixed, optional
        Known parameters, by their names ``a1 ... an, b0 ... bm``. The estimate has the least output error of the
        admissible models with these values. A known delay is given in ``delay_bounds``.
    integrators : int, default 0
        Poles at the origin in addition to ``poles``, which may then be 0: the model is ``B/(p^l A)``, and the last l
        coefficients of its denominator are zero. An estimated offset then includes that of the input: powers of time up
        to l, of which an estimated initial state contains all except the last.
    input_before : float or "first", optional
        Constant input before the first sample [input unit], with which the system is at rest, or "first" for the first
        value of each record; None is zero. It is subtracted from the input.
    noise_model : str, default "white"
        ``arma:P,Q``, or ``auto`` for the orders up to 3 of least BIC, estimates the output noise ``C(q)/D(q) e`` with
        P coefficients of D and Q of C together with the plant, by maximum likelihood; it is common to all records.
    inputs : tuple of InputModel, optional
        Separate options of inputs of records with several. Without poles here, all inputs have a common denominator;
        other options apply to all inputs unless given here. Parameters are named ``u1_b0``, ``u1_delay`` and, for
        separate denominators, ``u1_a1``, for an input u1.
    bounds : tuple of Bound, optional
        Bounds of coefficients, and of the gain, time constant or damping of a small model. If the least cost violates
        one, the estimate is the least with the parameter at the bound, with a corresponding status and without a
        standard error of the parameter.

    Raises
    ------
    ValueError
        If an option is out of range.

    Notes
    -----
    The cost, minimised over all parameters except the delay, is computed on a grid with a spacing of a quarter period
    of the highest significant frequency of the output (95 % of its power), so that no basin is missed. If possible,
    long grids are searched from coarse to fine: a low-pass filter with a third of that bandwidth needs a third of the
    delays, and the next level searches only around the best of them. The best local minima are refined jointly in all
    parameters on all samples, and the lowest is kept: no start is required.

    Without bounds the least cost need not exist: with an undamped pole a free initial state can fit noise without
    limit. With an estimated state, poles have magnitudes of at least the reciprocal of the record's length, and pairs a
    damping of at least .001; at rest these bounds are 1e-4 of that and 1e-5, with a periodic input 1e-2 of that and
    1e-5. No pole is faster than ten over the sampling interval. The status shows an estimate at such a bound, and
    ``box`` contains the bounds.

    Least squares is sensitive to outliers. Both other losses are 95 % efficient for normal noise without outliers.
    Huber's loss bounds the influence of outliers, Tukey's rejects gross ones, so that one-sided outliers cause no bias;
    it starts from Huber's estimate. The standard deviation is from the median absolute error of each record. With
    ``offset`` "remove" the means exclude samples far from their neighbours; "estimate" applies the loss to the offset
    too.
    """

    kind: ClassVar[str] = "delay_profile"

    poles: int
    zeros: int
    delay_bounds: tuple[float, float]
    initial_state: InitialState = "rest"
    offset: Offset = "none"
    loss: LossKind = "squares"
    svf_cutoff: float | None = None
    nested: bool = False
    hold_output: OutputHold = "foh"
    covariance: Covariance = "auto"
    bootstrap_draws: int = DRAWS
    fixed: tuple[Fixed, ...] | None = None
    integrators: int = 0
    input_before: InputBefore = None
    noise_model: str = "white"
    inputs: tuple[InputModel, ...] | None = None
    bounds: tuple[Bound, ...] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check_treatment(self)
        own = {one.name: (one.low, one.high) for one in self.bounds or () if is_delay(one.name)}
        low, high = bounds = _within(own.get("delay"), checked_bounds(self.delay_bounds, known_allowed=True))
        object.__setattr__(self, "delay_bounds", bounds)
        if self.inputs and own:
            bounded = [
                replace(one, delay_bounds=_within(own.get(f"{one.name}_delay"), one.delay_bounds or bounds))
                for one in self.inputs
            ]
            object.__setattr__(self, "inputs", tuple(bounded))
        names = [one.name for one in self.inputs or ()]
        if len(set(names)) < len(names):
            raise OptionError("inputs", f"each input must be given once; got {', '.join(names)}")
        for one in self.inputs or ():
            # Check the options of each input as those of a single input.
            self._alone(one)
        if not self.inputs:
            self._check_zeros(self.zeros, self.order, low == high)
        # Parameter names require valid degrees; with several inputs, also the names of the inputs.
        if self.fixed and not self.inputs and not any("_" in one.name for one in self.fixed):
            self._known(("",))
        if self.bounds and (self.loss != "squares" or self.noise_model != "white"):
            raise OptionError("bounds", "parameters are bounded with loss squares and white noise only; drop one")
        if self.bounds and not self.inputs and not any("_" in one.name.removeprefix("time_") for one in self.bounds):
            self._quantities(("",))

    def _quantities(self, names: tuple[str, ...]) -> list[Quantity]:
        """Return the bounded quantities for given input names."""
        bounds = [one for one in self.bounds or () if not is_delay(one.name)]
        found = quantities_of(bounds, self._degrees(names, free=False))
        integrating = self.integrators or any(one.integrators for one in self.inputs or ())
        for one in found:
            if one.kind != "coefficient" and integrating:
                raise OptionError("bounds", f"{one.bound.name} has no bounds with integrators; bound the coefficients")
            if any(fixed.name in one.names for fixed in self.fixed or ()):
                raise OptionError("bounds", f"{one.bound.name} is bounded, and of its coefficients one is fixed")
        return found

    def _alone(self, one: InputModel) -> "DelayProfile":
        """Return the single-input estimator for the options of one input."""
        own = {name: value for name, value in vars(one).items() if name != "name" and value is not None}
        try:
            return replace(self, inputs=None, fixed=None, bounds=None, **own)
        except OptionError as error:
            raise OptionError(error.field, f"input {one.name}: {error}") from None

    def _check_zeros(self, zeros: int, order: int, known: bool) -> None:
        """Raise OptionError for a numerator degree that is too high."""
        allowed = order if known else order - 1
        if zeros > allowed:
            reason = "" if known else " while the delay is estimated"
            given = f"got {zeros} zeros and {order} poles" + ", integrators included" * (self.integrators > 0)
            raise OptionError("zeros", f"zeros must be at most {allowed}{reason}: {given}")

    def _each(self, names: Sequence[str]) -> list["DelayProfile"]:
        """Return the single-input estimator of each input."""
        unknown = [one.name for one in self.inputs or () if one.name not in names]
        if unknown:
            raise OptionError(
                "inputs",
                f"there is no input {unknown[0]!r}; the record has {', '.join(names) if any(names) else 'one'}",
            )
        return [self.of_input(name) for name in names]

    def of_input(self, name: str) -> "DelayProfile":
        """Return the single-input estimator of one of several inputs.

        Parameters
        ----------
        name : str
            Name of the input.

        Returns
        -------
        DelayProfile
            Its options, without fixed or bounded parameters.
        """
        return self._alone(next((one for one in self.inputs or () if one.name == name), InputModel(name)))

    def _known(self, names: tuple[str, ...]) -> dict[int, float]:
        """Return the values of the fixed parameters by their indices, for given input names."""
        degrees = self._degrees(names, free=False)
        known = places_of(self.fixed, degrees.names)
        check_stable(known, degrees)
        return known

    @property
    def common(self) -> bool:
        """Whether several inputs have a common denominator."""
        return all(one.poles is None and one.integrators is None for one in self.inputs or ())

    def _degrees(self, names: tuple[str, ...], *, free: bool = True) -> Degrees:
        """Return the degrees for given input names; if not ``free``, without integrators and delays."""
        each = self._each(names)
        blocks = each[:1] if self.common else each
        return Degrees(
            tuple(one.order if free else one.poles for one in blocks),
            tuple(one.zeros for one in each),
            tuple(free and one.delay_bounds[0] < one.delay_bounds[1] for one in each),
            names,
            tuple(one.integrators for one in blocks),
        )

    @property
    def order(self) -> int:
        """Number of poles, including integrators."""
        return self.poles + self.integrators

    def _lay_out(self, records: Record | Sequence[Record]) -> MeasuredRecords:
        several = as_records(records)
        if self.noise_model != "white":
            check_clocks(several)
        names = tuple(several[0].held) if several and several[0].several else ("",)
        coefficients, known = self._degrees(names, free=False), self._known(names)
        degrees, bounds = self._degrees(names), tuple(one.delay_bounds for one in self._each(names))
        orders = coefficients.orders if not coefficients.common else ()
        return MeasuredRecords(
            several,
            degrees,
            Treatment(
                bounds,
                self.initial_state,
                self.offset,
                self.hold_output,
                bridge=self.loss != "squares",
                integrators=degrees.integrators,
                input_before=self.input_before,
            ),
            KnownCoefficients.of(coefficients.poles, coefficients.numerators - 1, known, orders) if known else NOTHING,
        )

    def _estimate(self, measured: MeasuredRecords, start: Start | None) -> MeasuredFit:
        if self.bounds:
            return self._within_bounds(measured)._with_uncertainty(self.covariance, self.bootstrap_draws)
        if measured.degrees.several:
            # Each of several inputs is searched separately first.
            fit = self._least(measured, [], nested=True)
            return fit._with_uncertainty(self.covariance, self.bootstrap_draws)
        for minima, profile in search_delay(measured, self.svf_cutoff, self.nested):
            if minima:
                a = [np.concatenate(([1.0], minimum.theta[: self.poles])) for minimum in minima]
                starts = [(each, minimum.delay) for each, minimum in zip(a, minima, strict=True)]
                fit = self._least(measured, starts, profile, nested=self.nested)
                return fit._with_uncertainty(self.covariance, self.bootstrap_draws)
        raise DataError(Status.SINGULAR.value)

    def _within_bounds(self, measured: MeasuredRecords) -> MeasuredFit:
        """Return the least output error within the bounds of parameters, without a covariance."""
        names = measured.degrees.inputs
        known, degrees = self._known(names) if self.fixed else {}, self._degrees(names, free=False)
        search = BoundedSearch(measured, self._quantities(names), degrees, known)
        found, ends = search.within(measured.best([], nested=True))
        fit = fitted(measured, found, None, None)
        if not ends:
            return fit
        layout = measured.layout_of(fit.model)
        tangent = search.tangent(layout, fit.theta, ends, fit.tangent)
        met = tuple(Met(one.bound.name, end) for one, end in ends.items())
        status = Status.AT_BOUND if found.ending.optimal else fit.status
        return replace(fit, tangent=tangent, status=status, bounds_met=met)

    def _refine(self, records: Sequence[Record], *near: Begin) -> MeasuredFit:
        """Return the optimum in the basins of denominators, without their integrators, and delays.

        The result has no covariance.
        """
        measured = self._lay_out(records)
        found = measured.local(*near)
        if self.loss == "squares":
            return fitted(measured, found, None, None)
        robust = robust_local(measured, self.loss, found)
        return fitted(measured, robust.found, None, robust)


def fitted(
    measured: MeasuredRecords,
    found: Optimum,
    profile: Profile | None,
    robust: RobustFit | None,
) -> MeasuredFit:
    """Return the result of a refinement, without its covariance."""
    layout, theta = measured.parameters(found)
    model = measured.model(found)
    samples = samples_at(measured, model, theta, None if robust is None else robust.losses)
    residuals, law = samples.residuals, samples.linear
    hessian = np.sum([psi.T @ psi for psi in law.sensitivities], axis=0)
    each = zip(law.sensitivities, law.residuals, strict=True)
    gradient = np.sum([psi.T @ eps for psi, eps in each], axis=0)
    equations = Equations(hessian, gradient, hessian, sum(float(eps @ eps) for eps in residuals), 0.0)
    count = sum(eps.size for eps in residuals)
    values = quality(equations, measured.spread, count)
    if robust is not None:
        values["cost"] = robust.cost(robust.losses) / count
    states, offsets = measured.own(layout, theta)
    given = _given(layout, measured)
    kind: Any = MultiInputFit if isinstance(model, MultiInputModel) else MeasuredFit
    fit: MeasuredFit = kind(
        model=model,
        parameter_names=layout.names,
        covariance=np.full((layout.size, layout.size), np.nan),
        status=Status.DELAY_AT_BOUND if found.delays_at_bound else Status[found.ending.name],
        iterations=found.evaluations,
        theta=theta,
        initial_states=states,
        offsets=offsets,
        input_offsets=tuple(measured.input_offsets),
        profile=profile,
        residuals=residuals,
        sensitivities=samples.sensitivities,
        used=samples.used,
        starts=Starts(found.tried, found.agree),
        poles_at_infinity=found.poles_at_infinity,
        box=found.box,
        weighting=samples.weighting,
        held_poles=tuple(found.held_poles.tolist()),
        tangent=_tangent(layout, found, given),
        known=tuple(np.array(layout.names)[given].tolist()),
        **values,
    )
    return fit


def with_noise(
    measured: MeasuredRecords,
    beside: MeasuredFit,
    found: Optimum,
    noise_model: str,
    starts: Sequence[Begin],
    *,
    nested: bool = False,
) -> MeasuredFit:
    """Return the maximum-likelihood fit of plant and noise, with an output-error fit for comparison."""
    joint = joint_optimum(measured, found, orders_of(noise_model), starts, nested=nested)
    fit = fitted(measured, replace(joint.found, tried=found.tried, agree=found.agree), beside.profile, None)
    law = beside.uncertainty("robust")
    robust = law.covariance
    with np.errstate(invalid="ignore"):
        errors = np.sqrt(np.diag(robust))
    estimate = NoiseEstimate(
        noise=joint.noise.noise,
        covariance=noise_covariance(joint.noise, fit.residuals, fit.used),
        deviance=joint.noise.deviance,
        chosen=noise_model == "auto",
        output_error=beside.theta,
        output_error_errors=errors,
        output_error_fit=beside.fit_percent,
    )
    fit = replace(fit, noise=estimate)
    efficient = fit.uncertainty("white").covariance
    shared = measured.layout_of(fit.model).degrees.size
    own = (np.arange(fit.theta.size) < shared) & (errors > 0) & (np.diag(efficient) > 0)
    pair = robust[np.ix_(own, own)], efficient[np.ix_(own, own)]
    test = hausman((beside.theta - fit.theta)[own], *pair, law.degrees_of_freedom)
    return replace(fit, noise=replace(estimate, test=test))


def samples_at(
    measured: MeasuredRecords, model: AnyModel, theta: Array, losses: Sequence[Loss] | None
) -> FittedSamples:
    """Return the signals of an estimate at the used samples; the default loss is that of squares."""
    layout = measured.layout_of(model)
    psi, errors = zip(*sensitivities(measured.problem, layout, theta, delays_of(model)), strict=True)
    used = measured.used()
    if losses is None:
        return FittedSamples(errors, psi, used, None)
    # Sensitivities are computed with interpolated outliers; the errors here are from measured outputs.
    each = zip(measured.outputs, measured.problem.records, errors, strict=True)
    errors = tuple(y - (data.y_used - eps) for y, data, eps in each)
    return FittedSamples(errors, psi, used, weighted(losses, errors, layout.size))


def _given(layout: Layout, measured: MeasuredRecords) -> BoolArray:
    """Return the mask of known parameters."""
    fixed = np.zeros(layout.size, dtype=bool)
    # Poles at infinity are missing among the first coefficients.
    given = measured.given[measured.degrees.poles - layout.degrees.poles :]
    fixed[: given.size] = given
    return fixed


def _tangent(layout: Layout, found: Optimum, fixed: BoolArray) -> Array:
    """Return the directions that preserve known parameters and keep poles and delays in the admissible set."""
    degrees, fixed = layout.degrees, fixed.copy()
    for k in found.delays_at_bound:
        fixed[degrees.delay(k)] = True
    if not found.held_poles.size:
        return np.eye(layout.size)[:, ~fixed]
    moving = np.zeros((layout.size, found.pole_slopes.shape[1]))
    moving[degrees.denominators] = found.pole_slopes
    fixed[degrees.denominators] = True
    return np.column_stack((moving, np.eye(layout.size)[:, ~fixed]))


def check_treatment(options: RecordsEstimator) -> None:
    """Raise OptionError for incompatible options of the treatment of records."""
    if options.noise_model != "white" and options.loss != "squares":
        raise OptionError(
            "noise_model", f"noise_model goes with loss squares, not {options.loss}: outliers have no ARMA model"
        )
    if options.integrators and options.offset == "remove":
        raise OptionError(
            "offset", "offset remove subtracts means, which an integrating output does not have; use estimate"
        )
    if options.integrators and options.offset == "drift":
        raise OptionError(
            "offset", "offset drift goes without integrators, whose estimated offset is a drift; use estimate"
        )
    if not (options.input_before in (None, "first") or np.isfinite(options.input_before)):
        raise OptionError(
            "input_before", f"input_before must be a finite number or first; got {options.input_before!r}"
        )
    if options.input_before is not None and (options.initial_state != "rest" or options.offset == "remove"):
        given = f"got initial_state {options.initial_state} and offset {options.offset}"
        raise OptionError("input_before", f"input_before goes with initial_state rest and no removed means; {given}")
    if options.integrators and options.initial_state == "periodic":
        raise OptionError(
            "initial_state", "initial_state periodic cannot be: no integrating system has a period; use estimate"
        )


def check_clocks(records: Sequence[Record]) -> None:
    """Refuse irregular clocks, on which an ARMA noise is undefined."""
    for record in records:
        if record.interval is None:
            raise DataError(
                f"{named(record)}the clock is irregular, and a noise model from sample to sample needs a regular one; "
                "take noise_model white (--noise white), or resample the record"
            )


def check_positive(name: str, value: float) -> None:
    """Refuse a denominator coefficient that is impossible for stable models."""
    if not value > 0:
        raise OptionError("fixed", f"fixed {name} must be above zero, as in every stable model; got {value:g}")


def check_stable(known: Mapping[int, float], degrees: Degrees) -> None:
    """Refuse unstable denominators."""
    for place, value in known.items():
        if place < degrees.poles:
            check_positive(degrees.names[place], value)
    for block in degrees.a:
        places = range(block.start, block.stop)
        if set(places) <= set(known):
            roots = np.roots([1.0, *(known[place] for place in places)])
            unstable = [f"{root:.4g}" for root in roots.tolist() if root.real >= 0]
            if unstable:
                where = f"has poles at {', '.join(unstable)} rad/s"
                raise OptionError("fixed", f"fixed denominator is not stable: it {where}")
