"""Simplified refined instrumental variables for continuous-time models (SRIVC) at a known delay."""

from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError
from ctid_cli.estimation.additive_problem import (
    AdditiveProblem,
    Instruments,
    check_closed_loop,
    estimate_submodels,
    loop_data,
)
from ctid_cli.estimation.common import Estimator, Start, StartFrom, check_proper, check_record, finish, history_of
from ctid_cli.estimation.iteration import StepRule, Steps, iterate
from ctid_cli.estimation.sampled_problem import (
    SampledProblem,
    at_known_delay,
    cutoffs_of,
    least_squares_starts,
    with_stable_denominator,
)
from ctid_cli.filtering.filter_data import filter_data
from ctid_cli.inference.fit import Fit, Status
from ctid_cli.inference.sensitivities import Structure
from ctid_cli.inference.uncertainty import DRAWS, Covariance
from ctid_cli.models.additive import AdditiveModel, Submodel, Term
from ctid_cli.models.factoring import unfactored, unfactored_jacobian
from ctid_cli.signals.record import Record
from ctid_cli.signals.treatment import OutputHold

#: Step rules; ``auto`` depends on the instruments.
SrivcVariant = Literal["auto", "guarded", "plain", "relaxed"]


@dataclass(frozen=True)
class Srivc(Estimator["tuple[SampledProblem | AdditiveProblem, Record]", Fit]):
    """SRIVC: optimal instrumental variables for a transfer function with white output noise.

    Parameters
    ----------
    poles : int
        Degree of the denominator, 1 to 12.
    zeros : int
        Degree of the numerator, below ``poles``.
    delay : float, default 0.0
        Known delay [s]; any real number of sampling intervals.
    svf_cutoff : float, optional
        Cut-off of the state-variable filter of the start [rad/s], near the bandwidth of the system. By default four
        multiples of the output's bandwidth, from .04 to 5, are tried, and the estimate with the least cost is returned.
    max_iterations : int, default 50
        Largest number of iterations.
    tolerance : float, default 1e-6
        Stop when a step changes the simulated output by less than this fraction of its rms value [-].
    variant : {"auto", "guarded", "plain", "relaxed"}, default "auto"
        ``plain`` is the published iteration; ``guarded`` never increases the output-error cost; ``relaxed`` shortens
        steps that do not converge. ``auto`` is ``guarded`` in open loop and ``relaxed`` in closed loop, where the
        solution is not the minimum of that cost.
    hold_output : {"foh", "zoh"}, default "foh"
        Interpolation of the measured output between samples; affects the iterations, not the converged estimate.
    instruments : {"open_loop", "closed_loop", "reference"}, default "open_loop"
        ``closed_loop`` (CLSRIVC) simulates the instruments in the noise-free loop of the model with the record's
        controller and reference: needed if feedback brings coloured noise into the input. ``reference`` uses the part
        of the input that is predicted from the reference, for an unknown controller.
    covariance : {"auto", "white", "robust", "bootstrap"}, default "auto"
        Noise assumed for the standard errors: white, or coloured with an autocorrelation estimated from the residuals
        (``robust``), which also allows for a changing variance; ``bootstrap`` adds bootstrap-t intervals. ``auto`` is
        robust, and white if it finds white noise of constant variance; there are no errors if the residuals do not pass
        the Ljung-Box test at the 5 % level and the record is from a loop that the estimator ignores.
        ``sandwich`` is an earlier name of ``robust``.
    bootstrap_draws : int, default 500
        Number of simulated noise sequences of a bootstrap [-].

    Raises
    ------
    ValueError
        If an option is out of range.

    Notes
    -----
    ``theta+ = theta + [sum psi phi']^-1 sum psi eps`` from the least-squares start of
    :class:`~ctid_cli.estimators.svf.Svf`. The converged estimate is a stationary point of the output-error cost, hence
    asymptotically efficient for white output noise. It fails with a poor start: strong noise with a ``svf_cutoff`` far
    from the bandwidth, or a wrong delay.

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
    svf_cutoff: float | None = None
    max_iterations: int = 50
    tolerance: float = 1e-6
    variant: SrivcVariant = "auto"
    hold_output: OutputHold = "foh"
    instruments: Instruments = "open_loop"
    covariance: Covariance = "auto"
    bootstrap_draws: int = DRAWS

    def __post_init__(self) -> None:
        super().__post_init__()
        check_proper(self.poles, self.zeros)
        check_closed_loop(self.instruments, self.variant)

    @property
    def step_rule(self) -> StepRule:
        """Step rule, with ``auto`` resolved."""
        if self.variant == "auto":
            return "guarded" if self.instruments == "open_loop" else "relaxed"
        return self.variant

    def check_start(self, start: Start) -> None:
        """Raise DataError for a model of another structure."""
        if start.model is not None:
            given_coefficients(start.model, Structure(self.poles, self.zeros), self.delay)

    def _lay_out(self, record: Record) -> tuple[SampledProblem | AdditiveProblem, Record]:
        loop = loop_data(record, self.instruments)
        data = filter_data(record, self.delay, self.hold_output)
        structure = Structure(self.poles, self.zeros)
        check_record(record, data, structure.size)
        if self.step_rule == "relaxed" or self.instruments != "open_loop":
            # In closed loop (CLSRIVC) and with relaxed steps it is additive SRIVC with a single submodel.
            terms = (Term(self.poles, self.zeros),)
            return AdditiveProblem(data, terms, self.delay, loop), record
        return at_known_delay(data, structure), record

    def _estimate(self, laid_out: tuple[SampledProblem | AdditiveProblem, Record], start: Start | None) -> Fit:
        problem, record = laid_out
        structure = Structure(self.poles, self.zeros)
        if start is not None and start.model is not None:
            return self._from(problem, given_coefficients(start.model, structure, self.delay), self.covariance)
        refit = self.step_rule != "plain" or isinstance(problem, AdditiveProblem)
        cutoffs = cutoffs_of(record, self.svf_cutoff)
        starts = least_squares_starts(problem.data, structure, self.delay, cutoffs, refit)
        fits = [self._from(problem, theta, "white") for theta in starts]
        if not fits:
            raise DataError(Status.SINGULAR.value)
        ranks = [(not fit.status.succeeded, np.nan_to_num(fit.cost, nan=np.inf)) for fit in fits]
        best = ranks.index(min(ranks))
        # Errors for coloured noise take as long as a fit, and only those of the best fit are needed.
        return fits[best] if self.covariance == "white" else self._from(problem, starts[best], self.covariance)

    def _from(self, problem: SampledProblem | AdditiveProblem, theta: Array, covariance: Covariance) -> Fit:
        """Iterate from one start."""
        steps = Steps(self.max_iterations, self.tolerance, self.step_rule)
        noise = covariance, self.bootstrap_draws
        if isinstance(problem, AdditiveProblem):
            # Coefficients and covariance of a sum of one submodel are converted to the monic form.
            single = Submodel(theta[self.poles : -1], np.concatenate(([1.0], theta[: self.poles])))
            estimate = estimate_submodels(problem, AdditiveModel([single]).theta, steps)
            additive, names = problem.model(estimate.theta), Structure(self.poles, self.zeros).names
            values = estimate.described(*noise, unfactored_jacobian(additive, self.zeros))
            return Fit(model=unfactored(additive), parameter_names=names, **values)
        result = iterate(problem, theta, steps)
        if result is None:
            return finish(problem, theta, Status.DIVERGED, 0, [])
        history = history_of("refine", problem, result.path)
        return finish(problem, result.theta, result.status, result.iterations, history, *noise)


def given_coefficients(model: AdditiveModel, structure: Structure, delay: float) -> Array:
    """Return initial parameters from a sum of submodels."""
    whole = unfactored(model)
    if whole.order != structure.poles or whole.numerator.size > structure.zeros + 1:
        given = f"{whole.order} poles and {whole.numerator.size - 1} zeros"
        wanted = f"{structure.poles} poles and {structure.zeros} zeros"
        raise DataError(f"the start has {given} as one fraction, not {wanted}")
    padded = np.concatenate((np.zeros(structure.zeros + 1 - whole.numerator.size), whole.numerator))
    stable: Array = with_stable_denominator(np.concatenate((whole.denominator[1:], padded, [delay])), structure.poles)
    return stable
