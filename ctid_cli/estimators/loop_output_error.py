"""Estimation of a transfer function, also an unstable one, in a simulated loop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError, OptionError
from ctid_cli.estimation.common import (
    Estimator,
    Fixed,
    Start,
    check_greatest_delay,
    check_record,
    checked_bounds,
    quality,
)
from ctid_cli.estimation.loop_columns import Columns, LoopPart
from ctid_cli.estimation.loop_problem import LoopEstimate, LoopProblem
from ctid_cli.estimation.measured_records import AppliedModel
from ctid_cli.estimation.noise_search import joint_near
from ctid_cli.estimation.record_preparation import without_means
from ctid_cli.estimation.unknown_controller import UnknownController
from ctid_cli.estimators.measured_fit import FittedSamples, MeasuredFit, Starts, beside_output_error
from ctid_cli.filtering.bank import Equations
from ctid_cli.filtering.filter_data import filter_data
from ctid_cli.filtering.loop import NO_DELAY
from ctid_cli.filtering.loop_response import LoopResponse
from ctid_cli.inference.fit import Status
from ctid_cli.inference.loop_noise import SensitivityFunction
from ctid_cli.inference.noise_estimate import orders_of
from ctid_cli.inference.sensitivities import Structure
from ctid_cli.inference.uncertainty import DRAW, DRAWS, Covariance, Progress, Uncertainty, estimate_uncertainty
from ctid_cli.models.controller import ContinuousController, DiscreteController
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.progress import calling
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Loop, Record, as_records, named
from ctid_cli.signals.treatment import LossKind

#: Options of the initial state and of the offset of a loop.
LoopState = Literal["rest", "estimate"]
LoopOffset = Literal["none", "remove", "estimate"]
#: Polynomials of a controller.
SIDES = "numerator", "denominator"
#: Status values with standard errors.
DETERMINED = (Status.CONVERGED, Status.DELAY_AT_BOUND)


@dataclass(frozen=True, eq=False, repr=False)
class LoopFit(MeasuredFit):
    """Fit to a record in closed loop.

    Parameters
    ----------
    model, parameter_names, covariance, status, cost, fit_percent, r2, count, iterations, condition_number
        As in :class:`~ctid_cli.estimators.measured_fit.MeasuredFit`.
    history, theta, initial_states, offsets, input_offsets, residuals, sensitivities, used, starts
        As in :class:`~ctid_cli.estimators.measured_fit.MeasuredFit`.
    law, in_ignored_loop, poles_at_infinity, box, weighting, held_poles, tangent, known, noise, bounds_met
        As in :class:`~ctid_cli.estimators.measured_fit.MeasuredFit`.
    equivalents, undetermined, intervals, other_minima, rounding, change, assumed_hold
        As in :class:`~ctid_cli.estimators.measured_fit.MeasuredFit`.
    loop_radius : float
        Largest magnitude of the poles of the loop with the controller over one sampling interval [-].
    sensitivity : SensitivityFunction or None
        Filter from the output noise to the output error; None if unknown, on an irregular clock, or with more than 500
        missing samples.
    """

    loop_radius: float = float("nan")
    sensitivity: SensitivityFunction | None = None

    def uncertainty(
        self, kind: Covariance = "auto", draws: int = DRAWS, progress: Progress | None = None
    ) -> Uncertainty:
        """Return standard errors and intervals for a kind of noise.

        ``auto`` is ``robust``, since the loop colours the noise; for innovations, which are white, as in
        :class:`~ctid_cli.estimators.measured_fit.MeasuredFit`. There are none if no minimum was reached.
        """
        if self.in_ignored_loop:
            found = MeasuredFit.uncertainty(self, kind, draws, progress)
            return found if self.status in DETERMINED else found.undefined
        psi, errors, loop = self.sensitivities, self.residuals, self.sensitivity
        if loop is not None:
            each = zip(psi, errors, self.used, strict=True)
            psi, errors = zip(*(loop.completed(*one) for one in each), strict=True)
        kind = "robust" if kind == "auto" else kind
        with calling(progress, DRAW):
            found = estimate_uncertainty(psi, errors, kind, draws, tangent=self.tangent, loop=loop)
        return found if self.status in DETERMINED else found.undefined


@dataclass(frozen=True, eq=False)
class LaidOutLoop:
    """Records in closed loop, prepared for estimation."""

    #: Records without the subtracted means, and these means.
    records: list[Record]
    problem: LoopProblem | UnknownController
    input_offsets: tuple[float, ...]
    offsets: tuple[float, ...]

    def around(self, theta: Array) -> LoopProblem:
        """Return the problem near parameters."""
        problem = self.problem
        if isinstance(problem, LoopProblem):
            low, high = problem.delays
            return replace(problem, cell=problem.cell_of(theta[-1])) if low < high else problem
        found = problem.around(theta)
        if found is None:
            raise DataError(
                "no stable controller is found that stabilises this model; use other poles and zeros, or another delay"
            )
        return found


@dataclass(frozen=True)
class LoopOutputError(Estimator[LaidOutLoop, LoopFit]):
    """Output-error estimate in a simulated loop; the plant may be unstable.

    Parameters
    ----------
    poles : int
        Degree of the denominator, 1 to 12.
    zeros : int
        Degree of the numerator, below ``poles``; equal to ``poles`` only for a known delay.
    delay_bounds : tuple of float, default (0.0, 0.0)
        Least and greatest delay [s]; equal values fix the delay. With a continuous-time controller it must be
        known to be zero.
    initial_state : {"rest", "estimate"}, default "rest"
        State of plant and controller, including delayed inputs, at the first sample.
    offset : {"none", "remove", "estimate"}, default "none"
        Offset of the output: none, means of output, input and reference subtracted first, or a constant estimated with
        the model.
    integrators : int, default 0
        Poles at the origin in addition to ``poles``, which may then be 0.
    covariance : {"auto", "white", "robust", "bootstrap"}, default "auto"
        Noise assumed for the standard errors. ``auto`` is ``robust``, since the loop colours the noise: on a
        regular clock it is an autoregression filtered by the sensitivity function of the loop.
    bootstrap_draws : int, default 500
        Number of simulated noise sequences of a bootstrap [-].
    noise_model : str, default "white"
        ``white``, ``arma:P,Q``, or ``auto`` for the orders up to 3 of least BIC; only for records without reference and
        controller, where the estimate depends on it.

    Raises
    ------
    ValueError
        If an option is out of range.

    Notes
    -----
    With a known controller the cost is ``sum (y - T(theta) r)^2``, with T the simulated loop. The reference is
    independent of the noise, so that the estimate is consistent for noise of any colour; with white output noise,
    instruments (CLSRIVC) or the direct method also use the input and are more accurate with strong feedback. Starts are
    two-stage least squares with filtered references as instruments. The estimate is invalid if the given controller is
    not that of the record.

    For a record without reference and controller, one that stabilises the model is designed, and the loop that it makes
    of the measured signals is simulated, see :mod:`ctid_cli.estimation.unknown_controller`. The cost is that of the
    innovations (direct method): the estimate is efficient if the noise model is that of the output noise and there is a
    sample of delay in the loop, and biased otherwise. The delay must be known, and the clock regular without missing
    samples.

    Examples
    --------
    >>> import numpy as np
    >>> from ctid_cli import DiscreteController, HeldSignal, Loop, LoopOutputError, Record, TransferFunction
    >>> from ctid_cli import simulate_loop
    >>> rng, law = np.random.default_rng(0), DiscreteController([11.0, -10.0], [1.0, 0.0])
    >>> r, v, t = rng.standard_normal(2000), 0.02 * rng.standard_normal(2000), 0.05 * np.arange(2000)
    >>> u, x = simulate_loop(TransferFunction([4.0], [1.0, 0.0, -1.0]), law, r, v, 0.05)
    >>> record = Record(t, x + v, HeldSignal(t, u), loop=Loop(r, law))
    >>> fit = LoopOutputError(poles=2, zeros=0).fit(record)
    >>> fit.status.name, fit.model.poles.real.round(1)
    ('CONVERGED', array([ 1., -1.]))
    """

    kind: ClassVar[str] = "loop_output_error"
    loss: ClassVar[LossKind] = "squares"
    #: Common interface of estimators of records in loops.
    instruments: ClassVar[str] = "closed_loop"
    fixed: ClassVar[tuple[Fixed, ...] | None] = None

    poles: int
    zeros: int
    delay_bounds: tuple[float, float] = (0.0, 0.0)
    initial_state: LoopState = "rest"
    offset: LoopOffset = "none"
    integrators: int = 0
    covariance: Covariance = "auto"
    bootstrap_draws: int = DRAWS
    noise_model: str = "white"

    def __post_init__(self) -> None:
        super().__post_init__()
        low, high = bounds = checked_bounds(self.delay_bounds, known_allowed=True)
        object.__setattr__(self, "delay_bounds", bounds)
        allowed = self.order - (low < high)
        if self.zeros > allowed:
            reason = "" if low == high else " while the delay is estimated"
            given = f"got {self.zeros} zeros and {self.order} poles, integrators included"
            raise OptionError("zeros", f"zeros must be at most {allowed}{reason}: {given}")

    @property
    def order(self) -> int:
        """Number of poles, including integrators."""
        return self.poles + self.integrators

    @property
    def searched(self) -> bool:
        """Whether the delay is a free parameter."""
        return self.delay_bounds[0] < self.delay_bounds[1]

    def _lay_out(self, records: Record | Sequence[Record]) -> LaidOutLoop:
        several = as_records(records)
        if self.offset == "remove":
            centred = [without_means(record) for record in several]
        else:
            centred = [(record, [0.0], 0.0) for record in several]
        own = [record for record, _, _ in centred]
        known = self._controller_of(own)
        for record in own:
            if self.delay_bounds[1] > 0:
                check_greatest_delay(record, self.delay_bounds[1])
            check_record(record, filter_data(self._acting(record)), self.poles + self.zeros + 2)
        problem = self._unknown(own) if known is None else self._known(own, known)
        return LaidOutLoop(own, problem, tuple(u0[0] for _, u0, _ in centred), tuple(y0 for _, _, y0 in centred))

    def _controller_of(self, records: Sequence[Record]) -> DiscreteController | ContinuousController | None:
        """Return the controller of all records; None if it is unknown."""
        first = records[0].loop
        for record in records[1:]:
            if not _same_loop(first, record.loop) or record.interval != records[0].interval:
                raise DataError(
                    f"{named(record)}several records in a loop need the same controller and sampling interval, and "
                    f"those of {records[0].name or 'the first one'} differ; fit them one by one"
                )
        if first is None or first.controller is None:
            return None
        if first.continuous and self.delay_bounds[1] > 0:
            raise DataError(f"{named(records[0])}{NO_DELAY}")
        if self.noise_model != "white":
            text = "noise_model is for records without controller and reference; use white"
            raise OptionError("noise_model", text)
        kind = ContinuousController if first.continuous else DiscreteController
        return kind(first.controller.numerator, first.controller.denominator)

    @property
    def _structure(self) -> tuple[int, int, int]:
        return self.poles, self.zeros, self.integrators

    def _known(self, records: Sequence[Record], controller: DiscreteController | ContinuousController) -> LoopProblem:
        parts = []
        for record in records:
            assert record.loop is not None
            driven, at_controller = filter_data(self._acting(record)), record.loop.enters == "controller"
            response = LoopResponse(driven, controller, at_controller, *self._structure)
            parts.append(LoopPart(filter_data(record), response))
        return LoopProblem(tuple(parts), self.offset == "estimate", self.initial_state == "estimate", self.delay_bounds)

    def _unknown(self, records: Sequence[Record]) -> UnknownController:
        for record in records:
            if record.loop is not None:
                wrong = "a reference without its controller is not used for a plant that may be unstable"
                raise DataError(f"{named(record)}{wrong}; give the controller too, or leave the reference out")
            wanted = "an unknown controller of an unstable plant needs"
            if not (record.input_on_grid and record.input.hold == "zoh"):
                held = "an input that is held from sample to sample of a regular clock"
                raise DataError(f"{named(record)}{wanted} {held}; give the controller (--loop FILE)")
            if not record.valid.all():
                complete = "a record without missing samples"
                raise DataError(
                    f"{named(record)}{wanted} {complete}; give the controller (--loop FILE), or cut them off"
                )
        if self.searched:
            raise OptionError(
                "delay_bounds", "delay_bounds must be one known value without the controller, not a range"
            )
        offset, free = self.offset == "estimate", self.initial_state == "estimate"
        return UnknownController(tuple(records), self._structure, self.delay_bounds[0], offset, free)

    def _estimate(self, laid_out: LaidOutLoop, start: Start | None) -> LoopFit:
        problem = laid_out.problem
        found = problem.best(laid_out.records[0])
        if found is None:
            instrument = "input" if isinstance(problem, UnknownController) else "reference"
            what = f"no model that the {instrument} as an instrument leads to makes a loop whose output is finite"
            cure = "use other poles and zeros, another delay, or a longer record"
            raise DataError(f"{named(laid_out.records[0])}{what}; {cure}")
        fit = self._described(laid_out, found)
        if self.noise_model != "white" and isinstance(problem, UnknownController):
            joint = joint_near(problem, found, orders_of(self.noise_model))
            other = self._described(laid_out, joint.found._replace(tried=found.tried, agree=found.agree))
            shared = self.order + self.zeros + 1
            fit = beside_output_error(other, joint.noise, fit, shared, chosen=self.noise_model == "auto")
        return fit._with_uncertainty(self.covariance, self.bootstrap_draws)

    def _described(self, laid_out: LaidOutLoop, found: LoopEstimate) -> LoopFit:
        """Return the fit without its covariance."""
        problem, theta, count = found.problem, found.result.theta, len(laid_out.records)
        unknown = isinstance(laid_out.problem, UnknownController)
        own = np.reshape(self._columns(problem, theta, 0).own, (count, -1))
        states = own.shape[1] - int(problem.offset)
        names = Structure(self.order, self.zeros, self.searched).names
        for k in range(count):
            tail = f"_{k + 1}" if count > 1 else ""
            names += tuple(f"x{i}{tail}" for i in range(1, states + 1)) + (f"offset{tail}",) * problem.offset
        a, b, delay = problem.split(theta)
        whole = np.concatenate((a[1:], b, [delay][: int(self.searched)], own.ravel()))
        held = [name for k, name in enumerate(names) if self.poles <= k < self.order]
        model = TransferFunction(b, a, delay)
        fit = LoopFit(
            model=model,
            parameter_names=names,
            covariance=np.full((whole.size, whole.size), np.nan),
            status=found.status,
            iterations=found.iterations,
            theta=whole,
            initial_states=tuple(own[:, :states]),
            offsets=tuple(own[:, -1].tolist()) if problem.offset else laid_out.offsets,
            input_offsets=laid_out.input_offsets,
            starts=Starts(found.tried, found.agree),
            known=tuple(held),
            loop_radius=np.nan if unknown else found.radius,
            sensitivity=None if unknown else found.sensitivity,
            in_ignored_loop=problem.innovations,
            cost=np.nan,
            fit_percent=np.nan,
            r2=np.nan,
            condition_number=np.nan,
            count=problem.samples,
        )
        samples, tangent = self._signals(fit, replace(problem, noise=None))
        psi, eps = np.concatenate(samples.sensitivities) @ tangent, np.concatenate(samples.residuals)
        moments = Equations(psi.T @ psi, psi.T @ eps, psi.T @ psi, float(eps @ eps), 0.0)
        outputs = [data.y_used for data, _ in problem.parts]
        fitness = quality(moments, sum(float(np.sum((y - y.mean()) ** 2)) for y in outputs), eps.size)
        return replace(fit, **samples._asdict(), tangent=tangent, **fitness)

    def _columns(self, problem: LoopProblem, theta: Array, count: int | None = None) -> Columns:
        """Return the signals of given parameters."""
        columns = problem.columns(theta, count)
        if columns is None:
            raise DataError("the loop of this model with the controller has no finite output on this record")
        return columns

    def _theta(self, fit: MeasuredFit) -> Array:
        """Return the parameters of the problem."""
        b = fit.model.numerator
        b = np.concatenate((np.zeros(self.zeros + 1 - b.size), b))
        return np.concatenate((fit.model.denominator[1 : self.poles + 1], b, [fit.model.delay]))

    def _signals(self, fit: MeasuredFit, problem: LoopProblem) -> tuple[FittedSamples, Array]:
        """Return the signals of a fit at each used sample, and the free directions of its parameters."""
        theta = self._theta(fit)
        columns = self._columns(problem, theta)
        own, size = fit.theta[fit.theta.size - columns.linear.shape[1] :], fit.theta.size
        first, last = self.poles, size - own.size
        psi = np.zeros((problem.samples, size))
        places = [k for k in range(last) if not first <= k < self.order]
        psi[:, places], psi[:, last:] = columns.slopes, columns.linear
        if fit.status is Status.DELAY_AT_BOUND:
            places = places[:-1]
        Q, combined = columns.basis
        tangent = np.zeros((size, len(places) + Q.shape[1]))
        tangent[places, range(len(places))], tangent[last:, len(places) :] = 1.0, combined
        ends = np.cumsum([data.count for data, _ in problem.parts])[:-1]
        residuals = tuple(np.split(columns.left - columns.linear @ own, ends))
        used = tuple(data.use for data, _ in problem.parts)
        return FittedSamples(residuals, tuple(np.split(psi, ends)), used, None), tangent

    # --- diagnostics of a fit --------------------------------------------------------------------------

    def _acting(self, record: Record) -> Record:
        """Return the record with the reference as input, if known, since noise affects the measured input."""
        if record.loop is None:
            return record
        reference = HeldSignal(record.t, record.loop.reference, record.loop.hold)
        return Record(record.t, record.y, reference, name=record.name)

    def _samples(self, fit: MeasuredFit, laid_out: Any) -> FittedSamples:
        """Return the signals of a fit at each used sample, from its parameters."""
        return self._signals(fit, laid_out.around(self._theta(fit)))[0]

    def _applied(self, fit: MeasuredFit, laid_out: Any) -> AppliedModel:
        """Return the model in the loop of another record, with the best state and offset for it."""
        theta = self._theta(fit)
        problem = laid_out.around(theta)
        own = self._columns(problem, theta, 0).own
        states = own.size - int(problem.offset)
        shared = self.order + self.zeros + 1 + int(self.searched)
        moved = replace(fit, theta=np.concatenate((fit.theta[:shared], own)))
        samples = self._signals(moved, problem)[0]
        offset = float(own[-1]) if problem.offset else laid_out.offsets[0]
        return AppliedModel(samples.residuals, samples.used, (own[:states],), (offset,), samples.sensitivities)


def _same_loop(one: Loop | None, other: Loop | None) -> bool:
    """Return whether two records have the same controller, or the same unknown one."""
    if one is None or other is None or one.controller is None or other.controller is None:
        return (one is None) == (other is None) and (one and one.controller) is (other and other.controller)
    sides = [np.array_equal(getattr(one.controller, side), getattr(other.controller, side)) for side in SIDES]
    return all(sides) and one.continuous == other.continuous and one.enters == other.enters
