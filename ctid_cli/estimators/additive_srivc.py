"""Refined instrumental variables for a sum of submodels, in open and closed loop."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from itertools import islice, permutations
from typing import ClassVar

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError, OptionError
from ctid_cli.estimation.additive_problem import (
    AdditiveProblem,
    Instruments,
    SubmodelEstimate,
    check_closed_loop,
    estimate_submodels,
    loop_data,
)
from ctid_cli.estimation.common import Estimator, Fixed, Start, StartFrom, check_record, places_of
from ctid_cli.estimation.iteration import StepRule, Steps
from ctid_cli.estimation.sum_start import automatic_start
from ctid_cli.filtering.filter_data import filter_data
from ctid_cli.filtering.submodels import InitialState
from ctid_cli.inference.derived import derived_parameters
from ctid_cli.inference.fit import Fit
from ctid_cli.inference.intervals import UncertainValue
from ctid_cli.inference.uncertainty import DRAWS, Covariance, Uncertainty
from ctid_cli.models.additive import AdditiveModel, Term, names_of
from ctid_cli.models.factoring import unfactored
from ctid_cli.signals.record import Record
from ctid_cli.signals.treatment import OutputHold

#: Largest number of orders of the submodels that are tried to match known parameters.
MOST_ORDERS = 5040
#: Origin of an automatic start.
FOUND = "Submodels were found one after the other, by output errors, or by innovations if those are coloured."
TINY = float(np.finfo(float).tiny)


@dataclass(frozen=True, eq=False, repr=False)
class AdditiveFit(Fit):
    """Fit of a sum of submodels.

    Parameters
    ----------
    model, parameter_names, covariance, status, cost, fit_percent, r2, count, iterations, condition_number, history
        As in :class:`~ctid_cli.inference.fit.Fit`.
    law, in_ignored_loop, assumed_hold
        As in :class:`~ctid_cli.inference.fit.Fit`.
    additive : AdditiveModel
        Estimated sum, sorted by natural frequency. ``model`` is the equivalent single transfer function, and
        ``covariance`` that of the parameters of this sum.
    start : AdditiveModel
        Start of the iterations.
    start_method : str
        Origin of the start, as a sentence.
    loop_radius : float
        Largest magnitude of the poles of the sampled loop of the estimate with the controller [-]; NaN in open loop.
    """

    additive: AdditiveModel = field(kw_only=True)
    start: AdditiveModel = field(kw_only=True)
    start_method: str = field(kw_only=True)
    loop_radius: float = field(kw_only=True)

    @property
    def parametrised(self) -> AdditiveModel:
        """Model in its parametrised form."""
        return self.additive

    def derived(self, level: float = 0.95) -> tuple[UncertainValue, ...]:
        """Return poles, natural frequencies, damping and static gains of the submodels.

        Parameters
        ----------
        level : float, default 0.95
            Confidence level of the intervals [-].

        Returns
        -------
        tuple of UncertainValue
            With standard errors by the delta method, see
            :func:`~ctid_cli.inference.derived.derived_parameters`.
        """
        return derived_parameters(self.additive, self.law or Uncertainty.known(self.covariance), level=level)


@dataclass(frozen=True)
class AdditiveSrivc(Estimator["Submodels", AdditiveFit]):
    r"""Refined instrumental variables for a sum of submodels ``B_i / (p^l A_i)``.

    Parameters
    ----------
    terms : tuple of Term
        Degrees of the submodels; at most one of them may have integrators.
    delay : float, default 0.0
        Known delay [s].
    instruments : {"open_loop", "closed_loop", "reference"}, default "open_loop"
        ``closed_loop`` simulates the instruments in the noise-free loop of the model with the record's controller and
        reference: needed for unbiased estimates if feedback brings coloured noise into the input. ``reference`` uses
        the part of the input that is predicted from the reference, for an unknown controller.
    initial_state : {"rest", "estimated"}, default "rest"
        State at the first sample: at rest, or free responses to be estimated.
    covariance : {"auto", "white", "robust", "bootstrap"}, default "auto"
        Noise assumed for the standard errors: white, or coloured with an autocorrelation estimated from the residuals
        (``robust``), which also allows for a changing variance; ``bootstrap`` adds bootstrap-t intervals. ``auto`` is
        robust, and white if it finds white noise of constant variance; there are no errors if the residuals do not pass
        the Ljung-Box test at the 5 % level and the record is from a loop that the estimator ignores.
        ``sandwich`` is an earlier name of ``robust``.
    max_iterations : int, default 100
        Largest number of iterations.
    tolerance : float, default 1e-8
        Stop when a step changes the simulated output by less than this fraction of its rms value [-].
    variant : {"relaxed", "plain", "guarded"}, default "relaxed"
        ``plain`` takes full steps; ``relaxed`` shortens them if they do not converge; ``guarded``, in open loop only,
        never increases the output-error cost.
    hold_output : {"foh", "zoh"}, default "foh"
        Interpolation of the output minus the other submodels; affects the iterations, not the converged estimate. If
        the iteration does not converge, it is repeated with the other interpolation.
    bootstrap_draws : int, default 500
        Number of simulated noise sequences of a bootstrap [-].
    fixed : tuple of Fixed, optional
        Known parameters, by their names, which are removed from the equations. Submodels then keep the order of
        ``terms``.

    Raises
    ------
    ValueError
        If an option is out of range.

    Notes
    -----
    ``beta+ = beta + [sum psi phi']^-1 sum psi eps`` with psi and phi as in :mod:`ctid_cli.filtering.submodels`. It is
    equivalent to the published iteration, where every submodel has a separate right-hand side ``sum psi y_f,i`` and
    only the diagonal blocks of the solution are kept: ``y_f,i - phi_i' theta_i`` is the output error for every i, so
    that all submodels change by the same vector. With one submodel it is SRIVC, in closed loop CLSRIVC.

    In closed loop its solution is a root of ``sum psi eps``, not a minimum of the output-error cost.

    It fails from a start far from the solution: with errors of natural frequencies above about 50 %.

    References
    ----------
    R. A. González, K. Classens, C. R. Rojas, J. S. Welsh and T. Oomen, "Identification of additive continuous-time
    systems in open and closed loop", *Automatica* (2025), arXiv:2401.01263.

    Examples
    --------
    >>> import numpy as np
    >>> from ctid_cli import HeldSignal, Record
    >>> from ctid_cli.filtering.simulate import simulate_additive
    >>> from ctid_cli.models.additive import AdditiveModel, Submodel, Term
    >>> system = AdditiveModel([Submodel([3.0], [0.25, 0.25, 1.0]), Submodel([1.0], [0.025, 0.01, 1.0])])
    >>> rng = np.random.default_rng(1)
    >>> t = 0.05 * np.arange(4000)
    >>> u = HeldSignal(t, rng.standard_normal(4000))
    >>> y = simulate_additive(system, u, t) + 0.1 * rng.standard_normal(4000)
    >>> fit = AdditiveSrivc(terms=(Term(2, 0), Term(2, 0))).fit(Record(t, y, u))
    >>> for name in ("g1_b0", "g2_b0"):
    ...     print(f"{name} = {fit.parameters[name]:.3f} +- {fit.standard_errors[name]:.3f}")
    g1_b0 = 3.017 +- 0.007
    g2_b0 = 0.999 +- 0.001
    """

    kind: ClassVar[str] = "additive_srivc"
    start_from: ClassVar[StartFrom | None] = "parameters"

    terms: tuple[Term, ...]
    delay: float = 0.0
    instruments: Instruments = "open_loop"
    initial_state: InitialState = "rest"
    covariance: Covariance = "auto"
    max_iterations: int = 100
    tolerance: float = 1e-8
    variant: StepRule = "relaxed"
    hold_output: OutputHold = "foh"
    bootstrap_draws: int = DRAWS
    fixed: tuple[Fixed, ...] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check_terms(self.terms)
        places_of(self.fixed, names_of(self.terms))
        check_closed_loop(self.instruments, self.variant)

    def check_start(self, start: Start) -> None:
        """Raise DataError for a model with other submodels."""
        if start.model is not None:
            check_submodels(start.model, self.terms)

    def _lay_out(self, record: Record) -> Submodels:
        loop = loop_data(record, self.instruments)
        data = filter_data(record, self.delay, self.hold_output)
        fixed = places_of(self.fixed, names_of(self.terms))
        problem = AdditiveProblem(data, self.terms, self.delay, loop, self.initial_state, fixed)
        check_record(record, data, problem.free)
        return Submodels(record, problem)

    def _estimate(self, laid_out: Submodels, start: Start | None) -> AdditiveFit:
        start_model, method = laid_out.started(start)
        estimate = self._iterate(laid_out.problem, start_model)
        problem, model = estimate.problem, estimate.model
        order = estimate.order[: problem.size]
        return AdditiveFit(
            model=unfactored(model),
            parameter_names=model.names,
            additive=model,
            start=start_model,
            start_method=method,
            loop_radius=problem.loop_radius(model),
            **estimate.described(self.covariance, self.bootstrap_draws, np.eye(problem.size)[order]),
        )

    def _iterate(self, problem: AdditiveProblem, start: AdditiveModel) -> SubmodelEstimate:
        """Estimate from a start."""
        steps = Steps(self.max_iterations, self.tolerance, self.variant)
        if not problem.fixed:
            return estimate_submodels(replace(problem, terms=start.terms), start.theta, steps)
        # From the start, and from the estimate without fixed parameters.
        free = estimate_submodels(replace(problem, fixed={}), start.theta, steps).theta[: problem.size]
        near = [_nearest(theta, self.terms, problem.fixed) for theta in (free, start.theta)]
        found = [estimate_submodels(problem, theta, steps) for theta in near]
        return min(found, key=lambda one: one.equations.squared_error)


@dataclass(frozen=True, eq=False)
class Submodels:
    """Record prepared for a sum of submodels, and its automatic start."""

    record: Record
    problem: AdditiveProblem

    @cached_property
    def start(self) -> AdditiveModel:
        """Automatic start, computed once from the record."""
        return automatic_start(self.record, self.problem)

    def started(self, given: Start | None) -> tuple[AdditiveModel, str]:
        """Return the given or the automatic start, and its origin as a sentence.

        Its submodels are sorted by natural frequency, so that rounding does not depend on their order, unless
        parameters are fixed by name.
        """
        chosen = None if given is None else given.model
        model, origin = (self.start, FOUND) if chosen is None else (chosen, "The start was given.")
        check_submodels(model, self.problem.terms)
        return model if self.problem.fixed else model.sorted(), origin


def check_terms(terms: tuple[Term, ...]) -> None:
    """Check that a sum has terms and that its parameters are identifiable."""
    if not terms:
        raise OptionError("terms", "terms must list at least one submodel, for example {poles: 2, zeros: 0}")
    if sum(term.integrators > 0 for term in terms) > 1:
        raise OptionError("terms", "terms may have integrators in one submodel only: others could not be told apart")
    if sum(term.zeros == term.order for term in terms) > 1:
        raise OptionError("terms", "terms may have as many zeros as poles in one submodel only")
    order = sum(term.order for term in terms)
    if order > 40:
        raise OptionError("terms", f"terms have {order} poles together; at most 40 are supported")


def check_submodels(start: AdditiveModel, terms: tuple[Term, ...]) -> None:
    """Raise DataError unless a start has the submodels of an estimator."""
    if start.terms != terms:
        wanted = f"not, in this order, {_terms_text(terms)}"
        raise DataError(f"the start has the submodels {_terms_text(start.terms)}, {wanted}")


def _terms_text(terms: Sequence[Term]) -> str:
    """Return the degrees of submodels in the form of a specification."""
    parts = [{name: value for name, value in asdict(term).items() if value or name != "integrators"} for term in terms]
    return ", ".join(str(part).replace("'", "") for part in parts)


def _nearest(theta: Array, terms: tuple[Term, ...], fixed: Mapping[int, float]) -> Array:
    """Return parameters with submodels of equal structure permuted so that fixed ones are nearest to their values."""
    parts = np.split(theta, np.cumsum([term.size for term in terms])[:-1])
    best, least = theta, np.inf
    for order in islice(permutations(range(len(terms))), MOST_ORDERS):
        if any(terms[k] != term for k, term in zip(order, terms, strict=True)):
            continue
        trial = np.concatenate([parts[k] for k in order])
        away = sum(
            abs(trial[place] - value) / (abs(trial[place]) + abs(value) + TINY) for place, value in fixed.items()
        )
        if away < least:
            best, least = trial, away
    return best
