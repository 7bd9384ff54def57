"""Output-error estimation of a transfer function in a simulated loop with a known controller."""

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
from ctid_cli.estimation.loop_problem import Columns, LoopEstimate, LoopProblem
from ctid_cli.estimation.measured_records import AppliedModel
from ctid_cli.estimation.record_preparation import without_means
from ctid_cli.estimators.measured_fit import FittedSamples, MeasuredFit, Starts
from ctid_cli.filtering.bank import Equations
from ctid_cli.filtering.filter_data import filter_data
from ctid_cli.filtering.loop import NO_DELAY
from ctid_cli.filtering.loop_response import LoopResponse
from ctid_cli.inference.fit import Status
from ctid_cli.inference.loop_noise import SensitivityFunction
from ctid_cli.inference.sensitivities import Structure
from ctid_cli.inference.uncertainty import DRAWS, Covariance, Progress, Uncertainty, estimate_uncertainty
from ctid_cli.models.controller import ContinuousController, DiscreteController
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record, as_records, named
from ctid_cli.signals.treatment import LossKind

#: Options of the initial state and of the offset of a loop.
LoopState = Literal["rest", "estimate"]
LoopOffset = Literal["none", "remove", "estimate"]
#: Status values with standard errors.
DETERMINED = (Status.CONVERGED, Status.DELAY_AT_BOUND)


@dataclass(frozen=True, eq=False, repr=False)
class LoopFit(MeasuredFit):
    """Fit to a record in closed loop.

    Parameters
    ----------
    model, parameter_names, covariance, status, cost, fit_percent, r2, count, iterations, condition_number
        As in :class:`~ctid_cli.estimators.measured_fit.MeasuredFit`.
    history, theta, initial_states, offsets, input_offsets, profile, residuals, sensitivities, used, starts
        As in :class:`~ctid_cli.estimators.measured_fit.MeasuredFit`.
    law, in_ignored_loop, poles_at_infinity, box, weighting, held_poles, tangent, known, noise, bounds_met
        As in :class:`~ctid_cli.estimators.measured_fit.MeasuredFit`.
    loop_radius : float
        Largest magnitude of the poles of the loop with the controller over one sampling interval [-].
    sensitivity : SensitivityFunction or None
        Filter from the output noise to the output error; None with a controller in continuous time or missing samples.
    """

    loop_radius: float = float("nan")
    sensitivity: SensitivityFunction | None = None

    def uncertainty(
        self, kind: Covariance = "auto", draws: int = DRAWS, progress: Progress | None = None
    ) -> Uncertainty:
        """Return standard errors and intervals for a kind of noise.

        ``auto`` is ``robust``, since the loop colours the noise. There are none if no minimum was reached.
        """
        found = estimate_uncertainty(
            self.sensitivities,
            self.residuals,
            "robust" if kind == "auto" else kind,
            draws,
            tangent=self.tangent,
            loop=self.sensitivity,
            progress=progress,
        )
        return found if self.status in DETERMINED else found.undefined


@dataclass(frozen=True, eq=False)
class LaidOutLoop:
    """Record in closed loop, prepared for estimation."""

    record: Record
    problem: LoopProblem
    #: Subtracted means.
    input_offset: float
    offset: float

    @property
    def records(self) -> list[Record]:
        """Record without the subtracted means."""
        return [self.record]


@dataclass(frozen=True)
class LoopOutputError(Estimator[LaidOutLoop, LoopFit]):
    """Output-error estimate in a simulated loop with known reference and controller; the plant may be unstable.

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
        Noise assumed for the standard errors. ``auto`` is ``robust``, since the loop colours the noise: with a discrete
        controller and no missing samples it is an autoregression filtered by the sensitivity function of the loop.
    bootstrap_draws : int, default 500
        Number of simulated noise sequences of a bootstrap [-].

    Raises
    ------
    ValueError
        If an option is out of range.

    Notes
    -----
    The cost is ``sum (y - T(theta) r)^2``, with T the simulated loop. The reference is independent of the noise, so
    that the estimate is consistent for noise of any colour; with white output noise, instruments (CLSRIVC) or the
    direct method also use the input and are more accurate with strong feedback. Starts are two-stage least squares with
    filtered references as instruments. The estimate is invalid if the given controller is not that of the record.

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
        if len(several) != 1:
            raise DataError("a loop is fitted to one record; give one file")
        loop, where = several[0].loop, named(several[0])
        if loop is None or loop.controller is None:
            missing = "neither" if loop is None else "no controller"
            raise DataError(f"{where}the loop needs the reference and the controller, and this record has {missing}")
        record, u0, y0 = without_means(several[0]) if self.offset == "remove" else (several[0], [0.0], 0.0)
        assert record.loop is not None
        if loop.continuous and self.delay_bounds[1] > 0:
            raise DataError(f"{where}{NO_DELAY}")
        if self.delay_bounds[1] > 0:
            check_greatest_delay(record, self.delay_bounds[1])
        data = filter_data(record)
        driven = filter_data(self._acting(record))
        kind = ContinuousController if loop.continuous else DiscreteController
        controller = kind(loop.controller.numerator, loop.controller.denominator)
        at_controller, free = loop.enters == "controller", self.initial_state == "estimate"
        structure = self.poles, self.zeros, self.integrators
        response = LoopResponse(driven, controller, at_controller, *structure)
        check_record(record, driven, self.poles + self.zeros + 2)
        problem = LoopProblem(data, response, self.offset == "estimate", free, self.delay_bounds)
        return LaidOutLoop(record, problem, u0[0], y0)

    def _estimate(self, laid_out: LaidOutLoop, start: Start | None) -> LoopFit:
        found = laid_out.problem.best(laid_out.record)
        if found is None:
            raise DataError(
                f"{named(laid_out.record)}no model that the reference as an instrument leads to makes a loop whose "
                "output is finite; use other poles and zeros, another delay, or a longer record"
            )
        return self._described(laid_out, found)._with_uncertainty(self.covariance, self.bootstrap_draws)

    def _described(self, laid_out: LaidOutLoop, found: LoopEstimate) -> LoopFit:
        """Return the fit without its covariance."""
        problem, theta = found.problem, found.result.theta
        own = self._columns(problem, theta, 0).own
        names = Structure(self.order, self.zeros, self.searched).names
        states = own.size - int(problem.offset)
        names += tuple(f"x{k}" for k in range(1, states + 1)) + ("offset",) * problem.offset
        a, b, delay = problem.split(theta)
        whole = np.concatenate((a[1:], b, [delay][: int(self.searched)], own))
        held = [name for k, name in enumerate(names) if self.poles <= k < self.order]
        model = TransferFunction(b, a, delay)
        fit = LoopFit(
            model=model,
            parameter_names=names,
            covariance=np.full((whole.size, whole.size), np.nan),
            status=found.status,
            iterations=found.iterations,
            theta=whole,
            initial_states=(own[:states],),
            offsets=(float(own[-1]) if problem.offset else laid_out.offset,),
            input_offsets=(laid_out.input_offset,),
            starts=Starts(found.tried, found.agree),
            known=tuple(held),
            loop_radius=found.radius,
            sensitivity=found.sensitivity,
            cost=np.nan,
            fit_percent=np.nan,
            r2=np.nan,
            condition_number=np.nan,
            count=problem.samples,
        )
        samples, tangent = self._signals(fit, problem)
        psi, eps, y = samples.sensitivities[0] @ tangent, samples.residuals[0], problem.data.y_used
        moments = Equations(psi.T @ psi, psi.T @ eps, psi.T @ psi, float(eps @ eps), 0.0)
        fitness = quality(moments, float(np.sum((y - y.mean()) ** 2)), y.size)
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
        if self.searched and problem.cell is None:
            problem = replace(problem, cell=problem.cell_of(theta[-1]))
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
        samples = FittedSamples((columns.left - columns.linear @ own,), (psi,), (problem.data.use,), None)
        return samples, tangent

    # --- diagnostics of a fit --------------------------------------------------------------------------

    def _acting(self, record: Record) -> Record:
        """Return the record with the reference as input, since noise affects the measured input."""
        assert record.loop is not None
        reference = HeldSignal(record.t, record.loop.reference, record.loop.hold)
        return Record(record.t, record.y, reference, name=record.name)

    def _samples(self, fit: MeasuredFit, laid_out: Any) -> FittedSamples:
        """Return the signals of a fit at each used sample, from its parameters."""
        return self._signals(fit, laid_out.problem)[0]

    def _applied(self, fit: MeasuredFit, laid_out: Any) -> AppliedModel:
        """Return the model in the loop of another record, with the best state and offset for it."""
        problem = laid_out.problem
        own = self._columns(problem, self._theta(fit), 0).own
        states = own.size - int(problem.offset)
        moved = replace(fit, theta=np.concatenate((fit.theta[: fit.theta.size - own.size], own)))
        samples = self._signals(moved, problem)[0]
        offset = float(own[-1]) if problem.offset else laid_out.offset
        return AppliedModel(samples.residuals, samples.used, (own[:states],), (offset,), samples.sensitivities)
