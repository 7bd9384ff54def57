"""Global output-error minimisation for measured records, with the delay."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError, OptionError
from ctid_cli.estimation.common import Bound, Estimator, Fixed, Start, checked_bounds, places_of
from ctid_cli.estimation.measured_records import AppliedModel, MeasuredRecords, Treatment
from ctid_cli.estimation.optimum.best_model import Begin, Optimum
from ctid_cli.estimation.optimum.known import NOTHING, KnownCoefficients
from ctid_cli.estimation.output_sensitivities import sensitivities
from ctid_cli.estimation.parameter_bounds import BoundedSearch, Quantity, quantities_of
from ctid_cli.estimation.parameter_layout import Degrees
from ctid_cli.estimation.robust_fit import robust_fit, robust_local
from ctid_cli.estimators.measured_fit import (
    FittedSamples,
    MeasuredFit,
    Met,
    MultiInputFit,
    fitted,
    samples_at,
    with_noise,
)
from ctid_cli.estimators.reported_parameters import determined
from ctid_cli.inference.fit import Status
from ctid_cli.inference.uncertainty import DRAWS, Covariance
from ctid_cli.models.several_inputs import delays_of, is_delay
from ctid_cli.signals.record import Record, as_records, named
from ctid_cli.signals.treatment import InitialState, InputBefore, LossKind, Offset, OutputHold


def _within(bounds: tuple[float, float] | None, delays: tuple[float, float]) -> tuple[float, float]:
    """Return the range of a delay restricted to optional bounds."""
    if bounds is None:
        return delays
    low, high = max(bounds[0], delays[0]), min(bounds[1], delays[1])
    if low > high:
        given = f"{bounds[0]:g} to {bounds[1]:g} s and delay_bounds {delays[0]:g} to {delays[1]:g} s"
        raise OptionError("bounds", f"no delay is within its bounds, {given}; give one of them")
    return low, high


class RecordsEstimator(Estimator[MeasuredRecords, MeasuredFit]):
    """Base class of the estimators of records in open loop."""

    initial_state: InitialState
    offset: Offset
    loss: LossKind
    input_before: InputBefore
    noise_model: str
    integrators: int
    covariance: Covariance
    bootstrap_draws: int

    def _least(self, measured: MeasuredRecords, starts: Sequence[Begin] = ()) -> MeasuredFit:
        """Return the optimum for the given loss and noise model, without a covariance."""
        if self.loss != "squares":
            robust = robust_fit(measured, self.loss, starts)
            return fitted(measured, robust.found, robust)
        found = measured.best(starts)
        fit = fitted(measured, found, None)
        if self.noise_model == "white":
            return fit
        return with_noise(measured, fit, found, self.noise_model, starts)

    def _estimate(self, measured: MeasuredRecords, start: Start | None) -> MeasuredFit:
        return self._with_errors(self._minimum(measured, start), measured)

    def _with_errors(self, fit: MeasuredFit, measured: MeasuredRecords) -> MeasuredFit:
        """Return a minimum with its standard errors, as far as the records determine it."""
        law = fit.uncertainty(self.covariance, self.bootstrap_draws)
        return determined(fit._with_law(law), measured, self._inside(fit, measured))[0]

    def _inside(self, fit: MeasuredFit, measured: MeasuredRecords) -> list[Iterator[Optimum]]:
        """Return minima ever farther inside each given bound that a parameter is at."""
        return []

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
    """Global output-error minimisation over poles, zeros and delay, with initial state and offset.

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
    hold_output : {"foh", "zoh"}, default "foh"
        Interpolation of the measured output between samples; does not affect the estimate.
    covariance : {"auto", "white", "robust", "bootstrap"}, default "auto"
        Noise assumed for the standard errors: white, or coloured with an autocorrelation estimated from the residuals
        (``robust``), which also allows for a changing variance and for a coarsely rounded output; ``bootstrap`` adds
        bootstrap-t intervals. ``auto`` is robust, and white if it finds white noise of constant variance; there are no
        errors if the residuals do not pass the Ljung-Box test at the 5 % level and the record is from a loop that the
        estimator ignores.
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
    No start is required. The cost, minimised over the numerator, the initial state and the offset, is a function of
    poles and delay. All smaller models that the structure contains are fitted first: their lowest minima, with further
    poles at the best of many frequencies and dampings, are starts, and so are minima along the whole range of the
    delay and a few random points. The lowest minimum is kept. The cost never increases with the number of poles or
    zeros: if a smaller model fits as well, the result has fewer poles.

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
    #: Types and defaults of options of earlier versions, which have no effect.
    former: ClassVar[Mapping[str, tuple[Any, Any]]] = {"svf_cutoff": (float | None, None), "nested": (bool, False)}

    poles: int
    zeros: int
    delay_bounds: tuple[float, float]
    initial_state: InitialState = "rest"
    offset: Offset = "none"
    loss: LossKind = "squares"
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

    def _minimum(self, measured: MeasuredRecords, start: Start | None) -> MeasuredFit:
        if self.bounds:
            return self._within_bounds(measured)
        return self._least(measured)

    def _within_bounds(self, measured: MeasuredRecords) -> MeasuredFit:
        """Return the least output error within the bounds of parameters, without a covariance."""
        names = measured.degrees.inputs
        known, degrees = self._known(names) if self.fixed else {}, self._degrees(names, free=False)
        search = BoundedSearch(measured, self._quantities(names), degrees, known)
        found, ends = search.within(measured.best())
        fit = replace(fitted(measured, found, None), other_minima=())
        if not ends:
            return fit
        layout = measured.layout_of(fit.model)
        tangent = search.tangent(layout, fit.theta, ends, fit.tangent)
        met = tuple(Met(one.bound.name, end) for one, end in ends.items())
        status = Status.AT_BOUND if found.ending.optimal else fit.status
        return replace(fit, tangent=tangent, status=status, bounds_met=met)

    def _inside(self, fit: MeasuredFit, measured: MeasuredRecords) -> list[Iterator[Optimum]]:
        """Return minima ever farther inside each given bound that a parameter is at."""
        if not fit.bounds_met:
            return []
        names = measured.degrees.inputs
        known, degrees = self._known(names) if self.fixed else {}, self._degrees(names, free=False)
        search = BoundedSearch(measured, self._quantities(names), degrees, known)
        begin, ends = measured.begin(fit.parametrised), {one.name: one.end for one in fit.bounds_met}
        return [search.inside(begin, ends, name) for name in ends]

    def _refine(self, records: Sequence[Record], *near: Begin) -> MeasuredFit:
        """Return the optimum in the basins of denominators, without their integrators, and delays.

        The result has no covariance.
        """
        measured = self._lay_out(records)
        found = measured.local(*near)
        if self.loss == "squares":
            return fitted(measured, found, None)
        robust = robust_local(measured, self.loss, found)
        return fitted(measured, robust.found, robust)


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
