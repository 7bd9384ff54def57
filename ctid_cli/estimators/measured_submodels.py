"""Sum of submodels, or one transfer function in a loop, from a measured record, with diagnostics."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError, OptionError
from ctid_cli.estimation.additive_problem import Instruments, predicted_from
from ctid_cli.estimation.common import Estimator, Fixed, Start, quality
from ctid_cli.estimation.measured_records import AppliedModel
from ctid_cli.estimation.record_preparation import without_means
from ctid_cli.estimators.additive_srivc import AdditiveSrivc, Submodels
from ctid_cli.estimators.measured_fit import FittedSamples, MeasuredFit
from ctid_cli.filtering.filter_data import used_samples
from ctid_cli.filtering.submodels import OPEN_LOOP
from ctid_cli.inference.sensitivities import Structure
from ctid_cli.inference.uncertainty import DRAWS, Covariance, Progress, Uncertainty
from ctid_cli.models.additive import AdditiveModel, Submodel, Term, degrees_of
from ctid_cli.models.factoring import unfactored, unfactored_jacobian
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record, as_records, named
from ctid_cli.signals.treatment import LossKind, Offset


@dataclass(frozen=True, eq=False, repr=False)
class SubmodelsFit(MeasuredFit):
    """Fit of submodels to a measured record.

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
    additive : AdditiveModel or None
        Submodels; None for a single transfer function.
    start_method : str
        Origin of the start, as a sentence.
    loop_radius : float
        Largest magnitude of the poles of the sampled loop with the controller [-]; NaN in open loop.
    in_loop : bool
        Whether instruments come from the loop; an unconverged estimate then has no standard errors.
    consistency : float
        Margin of the condition for consistent estimates, right side over left side [-]; NaN if undefined.
    sampling : float
        Sampling frequency over twice the greatest imaginary part of a pole [-]; NaN on an irregular clock.
    two_stage : float
        For instruments from the reference, the largest difference from the two-stage estimate, in standard errors of
        the latter [-]; NaN otherwise.
    """

    additive: AdditiveModel | None = None
    start_method: str = ""
    loop_radius: float = float("nan")

    in_loop: bool = False
    consistency: float = float("nan")
    sampling: float = float("nan")
    two_stage: float = float("nan")

    @property
    def conditions(self) -> Iterator[tuple[str, str]]:
        """Yield the conditions for consistency (González et al. 2025) at a converged estimate, as sentences."""
        if not self.status.succeeded:
            return
        lines = (
            (
                f"condition ({37 if self.in_loop else 36})",
                self.consistency,
                "right side over left side, for consistency",
            ),
            ("assumption 4", self.sampling, "sampling frequency over twice the greatest imaginary part of a pole"),
        )
        for label, margin, text in lines:
            if not np.isnan(margin):
                yield label, f"{'holds' if margin > 1.0 else 'is violated'} with the margin {margin:.3g} = {text}"
        if not np.isnan(self.two_stage):
            how = "input simulated from the reference, then a fit in open loop"
            yield "two-stage", f"parameters differ by at most {self.two_stage:.2g} of its standard errors ({how})"

    def uncertainty(
        self, kind: Covariance = "auto", draws: int = DRAWS, progress: Progress | None = None
    ) -> Uncertainty:
        """Return standard errors and intervals for a kind of noise."""
        found = MeasuredFit.uncertainty(self, kind, draws, progress)
        return found.undefined if self.in_loop and not self.status.succeeded else found

    @property
    def parametrised(self) -> TransferFunction | AdditiveModel:
        """Model in its parametrised form."""
        return self.model if self.additive is None else self.additive


@dataclass(frozen=True, eq=False)
class LaidOutSubmodels(Submodels):
    """Measured record prepared for submodels."""

    #: Subtracted means.
    input_offset: float
    offset: float

    @property
    def records(self) -> list[Record]:
        """Record without the subtracted means."""
        return [self.record]


@dataclass(frozen=True)
class MeasuredSubmodels(Estimator[LaidOutSubmodels, SubmodelsFit]):
    """Refined instrumental variables for a sum of submodels, as :class:`AdditiveSrivc`, for measured records.

    Parameters
    ----------
    terms : tuple of Term
        Degrees of the submodels.
    delay : float, default 0.0
        Known delay [s].
    instruments : {"open_loop", "closed_loop", "reference"}, default "open_loop"
        ``closed_loop`` for a record with its loop, ``reference`` for an unknown controller.
    initial_state : {"rest", "estimate"}, default "rest"
        State before the record.
    offset : {"none", "remove"}, default "none"
        Whether the means of input and output are subtracted first.
    factored : bool, default True
        Whether parameters are those of the submodels, or those of the monic transfer function of the only term.
    fixed : tuple of Fixed, optional
        Known parameters of the submodels.
    covariance : {"auto", "white", "robust", "bootstrap"}, default "auto"
        As in :class:`AdditiveSrivc`.
    bootstrap_draws : int, default 500
        Number of simulated noise sequences of a bootstrap [-].

    Raises
    ------
    ValueError
        If an option is out of range.
    """

    kind: ClassVar[str] = AdditiveSrivc.kind
    loss: ClassVar[LossKind] = "squares"

    terms: tuple[Term, ...]
    delay: float = 0.0
    instruments: Instruments = "open_loop"
    initial_state: Literal["rest", "estimate"] = "rest"
    offset: Offset = "none"
    factored: bool = True
    fixed: tuple[Fixed, ...] | None = None
    covariance: Covariance = "auto"
    bootstrap_draws: int = DRAWS

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.offset in ("estimate", "drift"):
            raise OptionError("offset", "submodels have no offset to estimate; use remove, or none")
        if not self.factored and (len(self.terms) > 1 or self.fixed or self.terms[0].integrators):
            raise OptionError("factored", "only one term without integrators and known parameters is one fraction")
        self.estimator  # noqa: B018 - checks the options that both have

    @property
    def estimator(self) -> AdditiveSrivc:
        """Estimator of the iteration."""
        return AdditiveSrivc(
            self.terms,
            self.delay,
            self.instruments,
            "estimated" if self.initial_state == "estimate" else self.initial_state,
            fixed=self.fixed,
        )

    @property
    def poles(self) -> int:
        """Number of poles, including integrators."""
        return degrees_of(self.terms)[0]

    @property
    def zeros(self) -> int:
        """Degree of the numerator of the sum."""
        return degrees_of(self.terms)[1]

    @property
    def delay_bounds(self) -> tuple[float, float]:
        """Known delay as equal bounds."""
        return self.delay, self.delay

    @property
    def closed(self) -> bool:
        """Whether instruments come from the loop."""
        return self.instruments != "open_loop"

    def _lay_out(self, records: Record | Sequence[Record]) -> LaidOutSubmodels:
        several = as_records(records)
        if len(several) != 1:
            raise DataError("submodels are estimated from one record; give one file")
        record, u0, y0 = without_means(several[0]) if self.offset == "remove" else (several[0], [0.0], 0.0)
        return LaidOutSubmodels(record, self.estimator._lay_out(record).problem, u0[0], y0)

    def _estimate(self, laid_out: LaidOutSubmodels, start: Start | None) -> SubmodelsFit:
        model, method = laid_out.started(start)
        found = self.estimator._iterate(laid_out.problem, model)
        problem = found.problem
        y, equations = problem.data.y_used, found.equations
        if not np.isfinite(equations.squared_error):
            raise DataError(
                f"{named(laid_out.record)}the iterations for these terms diverged; use fewer or other terms, another "
                "delay, or a longer record"
            )
        theta, ordered = found.theta[found.order], found.model
        names = (*ordered.names, *(f"x{k}" for k in range(1, problem.filter.free + 1)))
        if not self.factored:
            size, structure = problem.size, Structure(self.poles, self.zeros)
            whole = unfactored(ordered)
            theta = np.concatenate((whole.denominator[1:], _padded(whole.numerator, self.zeros + 1), theta[size:]))
            names = (*structure.names, *names[size:])
        fit = SubmodelsFit(
            model=unfactored(ordered),
            parameter_names=names,
            covariance=np.full((theta.size, theta.size), np.nan),
            status=found.status,
            iterations=found.history.steps,
            theta=theta,
            initial_states=(theta[problem.size :],),
            offsets=(laid_out.offset,),
            input_offsets=(laid_out.input_offset,),
            tangent=problem.tangent,
            known=tuple(names[k] for k in problem.fixed),
            additive=ordered if self.factored else None,
            start_method=method,
            loop_radius=problem.loop_radius(ordered),
            in_loop=self.closed,
            consistency=problem.consistency_margin(found.theta),
            sampling=sampling_margin(ordered, problem.data.interval),
            **quality(equations, float(np.sum((y - y.mean()) ** 2)), y.size),
        )
        samples = self._samples(fit, laid_out)
        fit = replace(fit, residuals=samples.residuals, sensitivities=samples.sensitivities, used=samples.used)
        fit = fit._with_uncertainty(self.covariance, self.bootstrap_draws)
        return replace(fit, two_stage=self._two_stage_difference(fit, laid_out.record))

    def _two_stage_difference(self, fit: SubmodelsFit, record: Record) -> float:
        """Return the largest difference of a parameter from the two-stage method, in standard errors, or NaN.

        That method estimates the plant as in open loop from the part of the input predicted from the reference
        (P. M. J. Van den Hof and R. J. P. Schrama, *An indirect method for transfer function estimation from closed
        loop data*, Automatica 29(6), 1993, https://doi.org/10.1016/0005-1098(93)90015-L).
        """
        if self.instruments != "reference" or not fit.status.succeeded:
            return float("nan")
        other = replace(self, instruments="open_loop", offset="none").fit(without_feedback(record))
        own, errors = fit.parameters, other.standard_errors
        found = [abs(other.parameters[name] - own[name]) / errors[name] for name in own if errors.get(name, 0.0) > 0.0]
        return max(found) if other.status.succeeded and found else float("nan")

    # --- diagnostics of a fit --------------------------------------------------------------------------

    def _factors(self, fit: MeasuredFit) -> AdditiveModel:
        """Return the submodels of an estimate, a single one for a transfer function."""
        if isinstance(fit, SubmodelsFit) and fit.additive is not None:
            return fit.additive
        numerator = _padded(fit.model.numerator, self.zeros + 1)
        return AdditiveModel([Submodel(numerator, fit.model.denominator)], self.delay)

    def _acting(self, record: Record) -> Record:
        """Return the record with its exogenous input: in a loop the reference, since noise affects the input."""
        if record.loop is None or not self.closed:
            return record
        return Record(record.t, record.y, HeldSignal(record.t, record.loop.reference), name=record.name)

    def _rows(
        self, fit: MeasuredFit, laid_out: LaidOutSubmodels, state: Array | None = None, **changes: Any
    ) -> tuple[Array, Array, Array]:
        """Return sensitivities, free responses and output errors of a changed problem, by default at rest.

        Closed-loop instruments replace sensitivities.
        """
        model = self._factors(fit)
        problem = replace(laid_out.problem, terms=model.terms, **changes)
        state = np.zeros(problem.filter.free) if state is None else state
        rows = problem.rows(np.concatenate((model.theta, state)))
        if rows is None:
            raise DataError(f"{named(laid_out.record)}the response of the model is not finite on this record")
        return rows[0][:, : problem.size], rows[0][:, problem.size :], rows[1]

    def _samples(self, fit: MeasuredFit, laid_out: Any) -> FittedSamples:
        """Return the signals of a fit at each used sample; for a monic fraction by its coefficients."""
        psi, free, error = self._rows(fit, laid_out, fit.initial_states[0])
        if not self.factored:
            psi = psi @ np.linalg.inv(unfactored_jacobian(self._factors(fit), self.zeros))
        used = used_samples(laid_out.problem.data, laid_out.record)
        return FittedSamples((error,), (np.column_stack((psi, free)),), (used,), None)

    def _applied(self, fit: MeasuredFit, laid_out: Any) -> AppliedModel:
        """Return the model on another record, with the best initial state for it if that is estimated."""
        psi, free, error = self._rows(fit, laid_out, loop=OPEN_LOOP)
        state: Array = np.asarray(np.linalg.lstsq(free, error)[0], dtype=float)
        used = used_samples(laid_out.problem.data, laid_out.record)
        sensitivities = np.column_stack((psi, free))
        return AppliedModel((error - free @ state,), (used,), (state,), (laid_out.offset,), (sensitivities,))


def without_feedback(record: Record) -> Record:
    """Return an open-loop record with the part of the input that is predicted from the reference of the loop."""
    assert record.loop is not None
    u = record.input.mean + predicted_from(record.loop.reference, record.input.values)
    return Record(record.t, record.y, HeldSignal(record.t, u, record.input.hold), name=record.name)


def sampling_margin(model: AdditiveModel, interval: float) -> float:
    """Return the sampling frequency over twice the greatest imaginary part of a pole; NaN on an irregular clock."""
    fastest = float(np.abs(model.poles.imag).max(initial=0.0))
    if not interval > 0.0:
        return float("nan")
    return np.pi / (interval * fastest) if fastest > 0.0 else float("inf")


def _padded(b: Array, size: int) -> Array:
    """Return the numerator padded to its declared length."""
    return np.concatenate((np.zeros(size - b.size), b))
