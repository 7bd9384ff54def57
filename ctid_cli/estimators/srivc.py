"""Simplified refined instrumental variables for continuous-time models (SRIVC) at a known delay."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal, get_args

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError
from ctid_cli.estimation.additive_estimate import Covariance, estimate_submodels
from ctid_cli.estimation.additive_problem import AdditiveProblem, Instruments, check_closed_loop, loop_data
from ctid_cli.estimation.common import (
    Start,
    StartFrom,
    check_iteration,
    check_record,
    check_structure,
    finish,
    history_entry,
)
from ctid_cli.estimation.problems import (
    CoefficientProblem,
    least_squares_start,
    refit_numerator,
    with_stable_denominator,
)
from ctid_cli.estimation.refined_iv import Equations, Iterated, StepRule, iterate
from ctid_cli.filtering.bank import standard_rows
from ctid_cli.filtering.filter_data import FilterData, filter_data
from ctid_cli.inference.diagnostics import percent_from_r_squared
from ctid_cli.inference.fit import Fit, IterationRecord
from ctid_cli.inference.robust import sandwich_covariance
from ctid_cli.inference.sensitivity import Structure
from ctid_cli.inference.status import Status
from ctid_cli.models.additive import AdditiveModel, Submodel, Term
from ctid_cli.models.factoring import unfactored, unfactored_jacobian
from ctid_cli.signals.checks import require_choice, require_not_negative, require_positive
from ctid_cli.signals.held import Hold
from ctid_cli.signals.record import Record

#: How steps are accepted; ``auto`` depends on the instruments.
SrivcVariant = Literal["auto", "guarded", "plain", "relaxed"]


@dataclass(frozen=True)
class Srivc:
    """SRIVC: optimal instrumental variables for a transfer function with white output noise.

    Parameters
    ----------
    poles : int
        Degree of the denominator, 1 to 12.
    zeros : int
        Degree of the numerator, below ``poles``.
    delay : float, default 0.0
        Known delay [s]; any real number of sampling intervals.
    svf_cutoff : float, default 1.0
        Cut-off of the state-variable filter of the start [rad/s], near the bandwidth of the system.
    max_iterations : int, default 50
        Largest number of iterations.
    tolerance : float, default 1e-6
        Stop when a step changes the simulated output by less than this fraction of its rms value [-].
    variant : {"auto", "guarded", "plain", "relaxed"}, default "auto"
        ``plain`` is the published iteration; ``guarded`` never lets the output-error cost rise; ``relaxed`` shortens
        steps that do not settle. ``auto`` is ``guarded`` in open loop and ``relaxed`` in closed loop, where the
        solution is not the minimum of that cost.
    hold_output : {"foh", "zoh"}, default "foh"
        Interpolation of the measured output between samples; changes the path, not the converged estimate.
    instruments : {"open_loop", "closed_loop"}, default "open_loop"
        ``closed_loop`` (CLSRIVC) simulates the instruments in the noise-free loop of the model with the record's
        controller and reference: needed where feedback brings coloured noise into the input.
    covariance : {"white", "sandwich"}, default "white"
        Noise that the standard errors hold for: white, or coloured with an autocorrelation estimated from the
        residuals.

    Raises
    ------
    ValueError
        If an option is out of range.

    Notes
    -----
    ``theta+ = theta + [sum psi phi']^-1 sum psi eps`` from the least-squares start of
    :class:`~ctid_cli.estimators.svf.Svf`. The converged estimate is a stationary point of the output-error cost, hence
    asymptotically efficient for white output noise. It fails where the start is useless: heavy noise with a
    ``svf_cutoff`` far from the bandwidth, or a wrong delay.

    References
    ----------
    P. C. Young and A. Jakeman, "Refined instrumental variable methods of recursive time-series analysis, Part III",
    *Int. J. Control* 31 (1980) 741-764. doi:10.1080/00207178008961080

    Examples
    --------
    >>> import numpy as np
    >>> from ctid_cli import HeldSignal, Record, Srivc, TransferFunction, simulate
    >>> t = 0.1 * np.arange(500)
    >>> u = HeldSignal(t, np.sign(np.sin(t) + np.sin(2.3 * t)))
    >>> y = simulate(TransferFunction([3], [1, 2]), u, t) + 0.1 * np.random.default_rng(0).standard_normal(500)
    >>> fit = Srivc(poles=1, zeros=0).fit(Record(t, y, u))
    >>> {name: f"{value:.2f} +- {fit.standard_errors[name]:.2f}" for name, value in fit.parameters.items()}
    {'a1': '2.03 +- 0.02', 'b0': '3.02 +- 0.02'}
    """

    kind: ClassVar[str] = "srivc"
    start_from: ClassVar[StartFrom | None] = "parameters"

    poles: int
    zeros: int
    delay: float = 0.0
    svf_cutoff: float = 1.0
    max_iterations: int = 50
    tolerance: float = 1e-6
    variant: SrivcVariant = "auto"
    hold_output: Hold = "foh"
    instruments: Instruments = field(default="open_loop", metadata={"added_later": True})
    covariance: Covariance = field(default="white", metadata={"added_later": True})

    def __post_init__(self) -> None:
        check_structure(self.poles, self.zeros)
        require_choice("hold_output", self.hold_output, get_args(Hold))
        require_choice("variant", self.variant, get_args(SrivcVariant))
        require_choice("instruments", self.instruments, get_args(Instruments))
        require_choice("covariance", self.covariance, get_args(Covariance))
        check_closed_loop(self.instruments, self.variant)
        require_positive("svf_cutoff", self.svf_cutoff, "rad/s")
        check_iteration(self.max_iterations, self.tolerance)
        require_not_negative("delay", self.delay, "s")

    @property
    def step_rule(self) -> StepRule:
        """How steps are accepted, ``auto`` resolved."""
        if self.variant == "auto":
            return "guarded" if self.instruments == "open_loop" else "relaxed"
        return self.variant

    def prepare(self, record: Record) -> PreparedSrivc | PreparedSubmodelSrivc:
        """Check a record and lay it out.

        Parameters
        ----------
        record : Record
            The record.

        Returns
        -------
        PreparedSrivc or PreparedSubmodelSrivc
            Ready to fit.

        Raises
        ------
        DataError
            If nothing can be estimated from the record, or it lacks the loop that the instruments need.
        """
        if self.step_rule == "relaxed" or self.instruments == "closed_loop":
            return PreparedSubmodelSrivc(self, record)
        return PreparedSrivc(self, record)

    def fit(self, record: Record, start: Start | None = None) -> Fit:
        """Estimate the coefficients.

        Parameters
        ----------
        record : Record
            The record.
        start : Start, optional
            Initial parameters, as the sum of submodels that they make; by least squares without them.

        Returns
        -------
        Fit
            The estimate.

        Raises
        ------
        DataError
            If nothing can be estimated from the record or from that start.
        """
        return self.prepare(record).fit(start)


class PreparedSrivc:
    """A record checked and laid out for :class:`Srivc`."""

    def __init__(self, options: Srivc, record: Record) -> None:
        self.options = options
        self.data = filter_data(record, options.delay, options.hold_output)
        self.structure = Structure(options.poles, options.zeros)
        check_record(record, self.data, self.structure.size)

    def fit(self, start: Start | None = None) -> Fit:
        """Estimate the coefficients."""
        options = self.options
        problem = CoefficientProblem(self.data, self.structure, options.delay)
        if start is not None and start.model is not None:
            theta: Array | None = given_coefficients(start.model, self.structure)
        else:
            theta = initial_coefficients(problem, options.svf_cutoff, options.step_rule)
        if theta is None:
            raise DataError(Status.SINGULAR.value)
        history: list[IterationRecord] = []

        def record_step(theta: Array, equations: Equations) -> None:
            cost = equations.squared_error / self.data.count
            history.append(history_entry("refine", len(history), problem, theta, cost))

        result = iterate(
            problem,
            theta,
            max_iterations=options.max_iterations,
            tolerance=options.tolerance,
            variant=options.step_rule,
            on_step=record_step,
        )
        if result is None:
            return finish(problem, theta, Status.DIVERGED, 0, history)
        fit = finish(problem, result.theta, result.status, result.iterations, history)
        return fit if options.covariance == "white" else self._with_sandwich(problem, result.theta, fit)

    def _with_sandwich(self, problem: CoefficientProblem, theta: Array, fit: Fit) -> Fit:
        a, b, delay = problem.split(theta)
        rows = standard_rows(problem.data, a, b, delay)
        structure = problem.structure
        psi = rows[:, structure.sensitivity_rows] * structure.signs
        covariance = sandwich_covariance(psi, rows[:, structure.error_row], regular=problem.data.interval > 0.0)
        return replace(fit, covariance=covariance)


class PreparedSubmodelSrivc:
    """A record checked and laid out for :class:`Srivc` as additive SRIVC with a single submodel.

    This is how it runs in closed loop (CLSRIVC), and in open loop where steps are relaxed.
    """

    def __init__(self, options: Srivc, record: Record) -> None:
        self.options = options
        loop = loop_data(record, options.instruments)
        data = filter_data(record, options.delay, options.hold_output)
        self.structure = Structure(options.poles, options.zeros)
        check_record(record, data, self.structure.size)
        self.problem = AdditiveProblem(data, (Term(options.poles, options.zeros),), options.delay, loop)

    def fit(self, start: Start | None = None) -> Fit:
        """Estimate the coefficients.

        It is additive SRIVC with a single submodel; coefficients and covariance are converted to the monic form.
        """
        options, problem, structure = self.options, self.problem, self.structure
        if start is not None and start.model is not None:
            theta: Array | None = given_coefficients(start.model, structure)
        else:
            direct = CoefficientProblem(problem.data, structure, options.delay)
            theta = initial_coefficients(direct, options.svf_cutoff, "guarded")
        if theta is None:
            raise DataError(Status.SINGULAR.value)
        single = Submodel(theta[structure.poles :], np.concatenate(([1.0], theta[: structure.poles])))
        estimate = estimate_submodels(
            problem,
            AdditiveModel([single]).theta,
            max_iterations=options.max_iterations,
            tolerance=options.tolerance,
            variant=options.step_rule,
            covariance=options.covariance,
        )
        additive = problem.model(estimate.theta)
        jacobian = unfactored_jacobian(additive)
        # The numerator has all its powers there, and the highest of them are zero.
        kept = [*range(structure.poles), *range(jacobian.shape[0] - structure.zeros - 1, jacobian.shape[0])]
        return Fit(
            model=unfactored(additive),
            parameter_names=structure.names,
            covariance=jacobian[kept] @ estimate.covariance @ jacobian[kept].T,
            status=estimate.status,
            cost=estimate.squared_error / problem.data.count,
            fit_percent=percent_from_r_squared(estimate.r2),
            r2=estimate.r2,
            count=problem.data.count,
            iterations=estimate.iterations,
            condition_number=estimate.condition_number,
            history=estimate.history,
        )


def given_coefficients(model: AdditiveModel, structure: Structure) -> Array:
    """Initial coefficients from a sum of submodels."""
    whole = unfactored(model)
    if whole.order != structure.poles or whole.numerator.size > structure.zeros + 1:
        raise DataError(
            f"the start has {whole.order} poles and {whole.numerator.size - 1} zeros, and the estimator "
            f"{structure.poles} and {structure.zeros}"
        )
    padded = np.concatenate((np.zeros(structure.zeros + 1 - whole.numerator.size), whole.numerator))
    return with_stable_denominator(np.concatenate((whole.denominator[1:], padded)), structure.poles)


def initial_coefficients(problem: CoefficientProblem, svf_cutoff: float, variant: StepRule) -> Array | None:
    """Least-squares start; the guarded variant re-fits the numerator to the output error."""
    data: FilterData = problem.data
    theta = least_squares_start(data, problem.structure, problem.delay, svf_cutoff)
    if theta is not None and variant == "guarded":
        theta = refit_numerator(data, problem.structure, theta, problem.delay)
    return theta


__all__ = ["Iterated", "PreparedSrivc", "Srivc", "initial_coefficients"]
