"""Fits to measured records: results, and their assembly from an optimum."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, ClassVar, NamedTuple, Self, TypeVar

import numpy as np

from ctid_cli.arrays import Array, BoolArray
from ctid_cli.errors import DataError, UsageError
from ctid_cli.estimation.common import quality
from ctid_cli.estimation.measured_records import MeasuredRecords
from ctid_cli.estimation.noise_search import joint_optimum
from ctid_cli.estimation.optimum.best_model import Begin, Optimum
from ctid_cli.estimation.optimum.box import Box
from ctid_cli.estimation.optimum.chain import block_diagonal
from ctid_cli.estimation.optimum.known import null_space
from ctid_cli.estimation.output_sensitivities import sensitivities
from ctid_cli.estimation.parameter_layout import Degrees, Layout
from ctid_cli.estimation.robust_fit import RobustFit
from ctid_cli.filtering.bank import Equations
from ctid_cli.inference.covariance import Rounding
from ctid_cli.inference.criteria import HOLD_REJECTED, percent_from_r_squared, squared_innovations
from ctid_cli.inference.fit import DeferredFields, Fit, InputFit, Status
from ctid_cli.inference.innovations import NoiseFit, restricted_dispersion, steps_of
from ctid_cli.inference.model_responses import Estimated
from ctid_cli.inference.noise_estimate import NoiseEstimate, hausman, noise_covariance, orders_of
from ctid_cli.inference.noise_model import fit_noise_model
from ctid_cli.inference.parameter_change import ParameterChange, Quantity, parameter_change
from ctid_cli.inference.repetition import Equivalent
from ctid_cli.inference.robust_loss import Loss, Weighting, weighted
from ctid_cli.inference.sensitivities import Parametric
from ctid_cli.inference.uncertainty import DRAW, DRAWS, Covariance, Progress, Uncertainty, estimate_uncertainty
from ctid_cli.models.factoring import section_basis, section_slopes
from ctid_cli.models.several_inputs import AnyModel, MultiInputModel, delays_of, is_delay
from ctid_cli.progress import calling
from ctid_cli.signals.noise import ArmaNoise
from ctid_cli.text import listed


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
    model, parameter_names, covariance, status, r2, count, condition_number, law, in_ignored_loop, assumed_hold
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
    equivalents : tuple of Equivalent
        Models with other delays that a repeating input cannot tell from this one.
    undetermined : mapping of str to str
        Parameters that the records do not determine, with the reason; they have no standard error.
    intervals : mapping of str to tuple of tuple of float
        95 % intervals of parameters that do not follow from the covariance.
    other_minima : tuple of Begin
        Starts of further minima of the search that are nearly as low.
    rounding : tuple of Rounding or None
        Step and fitted output of each record whose output is coarsely rounded, else None.
    change : ParameterChange or None
        Different parameters of the halves of a record, or of several records; None if equal ones are not rejected.
    """

    deferred: ClassVar[tuple[str, ...]] = ("residuals", "sensitivities", "used", "rounding")
    #: Fields in files of earlier versions.
    former: ClassVar[tuple[str, ...]] = ("profile",)

    theta: Array = field(default_factory=lambda: np.zeros(0))
    initial_states: tuple[Array, ...] = ()
    offsets: tuple[float, ...] = ()
    input_offsets: tuple[float, ...] = ()
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
    equivalents: tuple[Equivalent, ...] = ()
    undetermined: Mapping[str, str] = field(default_factory=dict)
    intervals: Mapping[str, tuple[tuple[float, float], ...]] = field(default_factory=dict)
    other_minima: tuple[Begin, ...] = ()
    rounding: tuple[Rounding | None, ...] = field(default_factory=tuple)
    change: ParameterChange | None = None

    @property
    def standard_errors(self) -> dict[str, float]:
        """Standard errors by name; NaN where they are not defined, or the records do not determine the parameter."""
        found, reach = super().standard_errors, self.quantiles if self.intervals else {}
        for name, pieces in self.intervals.items():
            (low, high), *more = pieces
            found[name] = np.nan if more else 0.5 * (high - low) / reach[name]
        return found | dict.fromkeys(self.undetermined, np.nan)

    def marks(self, time_unit: str = "s") -> list[str]:
        """Return what the records do not determine or do not agree on, and what a repeating input cannot tell apart.

        Parameters
        ----------
        time_unit : str, default "s"
            Unit of time of the records.

        Returns
        -------
        list of str
            One sentence for each; empty if there is nothing to say.
        """
        found = super().marks(time_unit) + self._repeating(time_unit)
        if self.undetermined:
            found.append(f"Not determined: {listed(self.undetermined)}.")
        each = ((name, pieces) for name, pieces in self.intervals.items() if len(pieces) > 1)
        found += [several_intervals(name, pieces) for name, pieces in each]
        return found + ([] if self.change is None else [f"{self.change.sentence}."])

    def _repeating(self, time_unit: str) -> list[str]:
        """Return the models that a repeating input cannot tell apart, in sentences."""
        found = []
        for one in self.equivalents:
            model = self.model.parts[one.input] if isinstance(self.model, MultiInputModel) else self.model
            gain = one.sign * model.dc_gain
            what = f"gain {gain:.5g}" if np.isfinite(gain) else "the opposite sign" if one.sign < 0 else "the same sign"
            of, name = (f" of {one.input}", f" {one.input}") if one.input else ("", "")
            found.append(f"Or {what} with delay{of} {one.delay:.5g} {time_unit}: the input{name} repeats.")
        return found

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
        with calling(progress, DRAW):
            found = estimate_uncertainty(
                linear.sensitivities,
                linear.residuals,
                kind,
                draws,
                tangent=self.tangent,
                rounding=() if self.noise or self.weighting else self.rounding,
            )
        if self.noise is not None and found.kind == "white" and found.defined:
            psi, steps = [block @ found.tangent for block in self.sensitivities], [*map(steps_of, self.used)]
            restricted = restricted_dispersion(self.noise.noise, psi, self.residuals, steps)
            law = Uncertainty.of("white", found.tangent, restricted)
            found = replace(law, null=found.null, passed=found.passed)
        return found.in_ignored_loop if self.in_ignored_loop and kind == "auto" else found

    def _with_uncertainty(self, kind: Covariance, draws: int) -> Self:
        """Return the fit with errors for a kind of noise."""
        return self._with_law(self.uncertainty(kind, draws))

    def _with_law(self, law: Uncertainty) -> Self:
        """Return the fit with its uncertainty; singular if it converged but has no covariance."""
        undefined = law.kind != "biased" and law.singular
        singular = self.status is Status.CONVERGED and undefined
        status, change = Status.SINGULAR if singular else self.status, None if law.kind == "biased" else self._change()
        return replace(self, covariance=law.covariance, law=law, status=status, change=change)

    @property
    def _misfit(self) -> float:
        """Mean loss, or with a noise model the geometric mean of the variance of its innovations."""
        return self.cost if self.noise is None else float(np.exp(self.noise.deviance / self.count))

    def _is_likely_as(self, best: Self) -> bool:
        """Return whether the data do not reject this fit against a better one, in noise of its colour."""
        linear = self.linear, best.linear
        noise = fit_noise_model(linear[1].residuals, penalty=float(np.log(best.count)))
        own, least = (
            squared_innovations(each.residuals, [psi @ each.tangent for psi in each.sensitivities], noise)
            for each in linear
        )
        return best.count * np.log(own / least) <= HOLD_REJECTED if least > 0.0 else False

    def _joined(self, others: Sequence[Self]) -> Self:
        """Return the fit with intervals of the delays that contain those of other fits."""
        found = dict(self.intervals)
        for name in delay_names(self):
            pieces = [pair for fit in (self, *others) for pair in fit._intervals_of(name)]
            if pieces and np.isfinite(pieces).all():
                found[name] = ((max(min(low for low, _ in pieces), 0.0), max(high for _, high in pieces)),)
        return replace(self, intervals=found)

    def _intervals_of(self, name: str) -> tuple[tuple[float, float], ...]:
        """Return the 95 % intervals of a parameter; none if it is not estimated."""
        if name not in self.parameter_names or name in self.intervals:
            return self.intervals.get(name, ())
        value, reach = self.parameters[name], self.quantiles[name] * self.standard_errors[name]
        return ((value - reach, value + reach),) if np.isfinite(reach) else ((value, value),)

    def _change(self) -> ParameterChange | None:
        """Return a change of the parameters between the halves of a record, or between records."""
        linear, tangent = self.linear, self.tangent
        shared = np.array([re.fullmatch(r"(.+_)?([ab]\d+|delay)", name) is not None for name in self.parameter_names])
        slopes = [psi @ tangent for psi in linear.sensitivities]
        return parameter_change(slopes, linear.residuals, tangent[shared].any(axis=0), self._quantities)

    def _quantities(self) -> list[Quantity]:
        """Return the static gains and the common parameters with their derivatives along the free directions."""
        parts = self.model.parts if isinstance(self.model, MultiInputModel) else {"": self.parametrised}
        found = []
        for name, part in parts.items():
            own = (each.removeprefix(f"{name}_") if name else each for each in self.parameter_names)
            bare = tuple(each if re.fullmatch(r"(g\d+_)?[ab]\d+|delay", each) else f"other {each}" for each in own)
            gain, slopes = float(part.dc_gain), Parametric(part, bare)
            if np.isfinite(gain):
                by_theta = slopes.frequency_slopes(np.zeros(1))[0].real
                found.append(Quantity(f"{name} static gain".lstrip(), gain, by_theta @ self.tangent, True))
        each = zip(self.parameter_names, self.theta.tolist(), self.tangent, strict=True)
        return found + [Quantity(*one, is_delay(one[0])) for one in each]

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
    in_ignored_loop, theta, initial_states, offsets, input_offsets, residuals, sensitivities, used, starts
        As in :class:`MeasuredFit`; ``input_offsets`` has those of all inputs, record by record.
    poles_at_infinity, box, weighting, held_poles, tangent, known, noise, bounds_met, equivalents, undetermined
        As in :class:`MeasuredFit`.
    intervals, other_minima, rounding, change, assumed_hold
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


def several_intervals(name: str, pieces: Sequence[tuple[float, float]]) -> str:
    """Return a sentence on a quantity with separate intervals."""
    return f"{name}: {' or '.join(f'{low:.5g} to {high:.5g}' for low, high in pieces)}, since other minima fit as well."


def delay_names(fit: MeasuredFit) -> list[str]:
    """Return the names of the delays of all inputs."""
    return [f"{name}_delay" for name in fit.model.parts] if isinstance(fit, MultiInputFit) else ["delay"]


AnyMeasuredFit = TypeVar("AnyMeasuredFit", bound=MeasuredFit)


class FittedSamples(NamedTuple):
    """Signals of a fit at each used sample of each record."""

    residuals: tuple[Array, ...]
    sensitivities: tuple[Array, ...]
    used: tuple[BoolArray, ...]
    weighting: Weighting | None
    rounding: tuple[Rounding | None, ...] = ()

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


def fitted(
    measured: MeasuredRecords,
    found: Optimum,
    robust: RobustFit | None,
) -> MeasuredFit:
    """Return the result of a refinement, without its covariance."""
    layout, theta = measured.parameters(found)
    model = measured.model(found)
    samples = samples_at(measured, model, theta, None if robust is None else robust.losses)
    residuals, law = samples.residuals, samples.linear
    given = _given(layout, measured)
    tangent = _tangent(layout, found, given)
    hessian = tangent.T @ np.sum([psi.T @ psi for psi in law.sensitivities], axis=0) @ tangent
    each = zip(law.sensitivities, law.residuals, strict=True)
    gradient = tangent.T @ np.sum([psi.T @ eps for psi, eps in each], axis=0)
    equations = Equations(hessian, gradient, hessian, sum(float(eps @ eps) for eps in residuals), 0.0)
    count = sum(eps.size for eps in residuals)
    values = quality(equations, measured.spread, count)
    if robust is not None:
        values["cost"] = robust.cost(robust.losses) / count
    states, offsets = measured.own(layout, theta)
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
        residuals=residuals,
        sensitivities=samples.sensitivities,
        used=samples.used,
        rounding=samples.rounding,
        starts=Starts(found.tried, found.agree),
        poles_at_infinity=found.poles_at_infinity,
        box=found.box,
        weighting=samples.weighting,
        held_poles=tuple(found.held_poles.tolist()),
        tangent=tangent,
        known=tuple(np.array(layout.names)[given].tolist()),
        other_minima=tuple(each.start for each in found.others),
        **values,
    )
    return fit


def with_noise(
    measured: MeasuredRecords,
    output_error: MeasuredFit,
    found: Optimum,
    noise_model: str,
    starts: Sequence[Begin],
) -> MeasuredFit:
    """Return the maximum-likelihood fit of plant and noise, with an output-error fit for comparison."""
    joint = joint_optimum(measured, found, orders_of(noise_model), starts)
    fit = fitted(measured, replace(joint.found, tried=found.tried, agree=found.agree), None)
    shared = measured.layout_of(fit.model).degrees.size
    return beside_output_error(fit, joint.noise, output_error, shared, chosen=noise_model == "auto")


def beside_output_error(
    fit: AnyMeasuredFit, noise: NoiseFit, output_error: MeasuredFit, shared: int, *, chosen: bool
) -> AnyMeasuredFit:
    """Return a fit with its noise, compared with an output-error fit by the leading, shared parameters."""
    law = output_error.uncertainty("robust")
    robust = law.covariance
    with np.errstate(invalid="ignore"):
        errors = np.sqrt(np.diag(robust))
    estimate = NoiseEstimate(
        noise=noise.noise,
        covariance=noise_covariance(noise, fit.residuals, fit.used),
        deviance=noise.deviance,
        chosen=chosen,
        output_error=output_error.theta,
        output_error_errors=errors,
        output_error_fit=output_error.fit_percent,
    )
    fit = replace(fit, noise=estimate)
    efficient = fit.uncertainty("white").covariance
    own = (np.arange(fit.theta.size) < shared) & (errors > 0) & (np.diag(efficient) > 0)
    pair = robust[np.ix_(own, own)], efficient[np.ix_(own, own)]
    test = hausman((output_error.theta - fit.theta)[own], *pair, law.degrees_of_freedom)
    return replace(fit, noise=replace(estimate, test=test))


def samples_at(
    measured: MeasuredRecords, model: AnyModel, theta: Array, losses: Sequence[Loss] | None
) -> FittedSamples:
    """Return the signals of an estimate at the used samples; the default loss is that of squares."""
    layout = measured.layout_of(model)
    psi, errors = zip(*sensitivities(measured.problem, layout, theta, delays_of(model)), strict=True)
    used = measured.used()
    if losses is None:
        return FittedSamples(errors, psi, used, None, measured.rounding(errors))
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


def _tangent(layout: Layout, optimum: Optimum, known: BoolArray) -> Array:
    """Return the directions that preserve known parameters and keep poles and delays in the admissible set.

    Columns are changes by the logarithms of the coefficients of sections, and for numerators and initial states the
    products of sections: directions along coefficients may be nearly parallel.
    """
    degrees, fixed = layout.degrees, known.copy()
    for k in optimum.delays_at_bound:
        fixed[degrees.delay(k)] = True
    slopes = optimum.pole_slopes
    if not optimum.held_poles.size:
        if not isinstance(degrees, Degrees):
            return np.eye(layout.size)[:, ~fixed]
        slopes = block_diagonal([section_slopes(each) for each in optimum.denominators])
        slopes = slopes @ null_space(slopes[known[degrees.denominators]])
    fixed[degrees.denominators] = True
    moving = np.zeros((layout.size, slopes.shape[1]))
    moving[degrees.denominators] = slopes
    columns = [moving]
    if isinstance(degrees, Degrees):
        each = optimum.denominators
        blocks = [(own, each[0 if degrees.common else k]) for k, own in enumerate(degrees.b)]
        if layout.initial_state:
            ends = np.cumsum([0, *degrees.orders])
            for first in map(layout.first, range(layout.experiments)):
                states = (slice(first + low, first + high) for low, high in pairwise(ends.tolist()))
                blocks += zip(states, each, strict=True)
        for own, denominator in blocks:
            given, basis = np.flatnonzero(fixed[own]), section_basis(denominator, own.stop - own.start)
            directions = np.zeros((layout.size, own.stop - own.start - given.size))
            directions[own] = basis @ null_space(basis[given]) if given.size else basis
            columns.append(directions)
            fixed[own] = True
    found = np.column_stack((*columns, np.eye(layout.size)[:, ~fixed]))
    found[known] = 0.0  # without rounding errors
    return found
