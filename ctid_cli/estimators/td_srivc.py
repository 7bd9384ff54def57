"""SRIVC with an estimated time delay: Gauss-Newton on the delay around SRIVC for the coefficients."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np

from ctid_cli.errors import DataError
from ctid_cli.estimation.common import (
    Estimator,
    Start,
    StartFrom,
    check_greatest_delay,
    check_proper,
    check_record,
    checked_bounds,
    finish,
    history_of,
    initial_delay,
)
from ctid_cli.estimation.delay_search import (
    SMALLEST_STEP,
    Descent,
    Limits,
    SampledCost,
    bound_in_the_way,
    descend,
    lower_elsewhere,
)
from ctid_cli.estimation.iteration import GUARDED, Steps, Variant, iterate
from ctid_cli.estimation.sampled_problem import SampledProblem, cutoffs_around
from ctid_cli.filtering.filter_data import filter_data
from ctid_cli.filtering.lowpass import Lowpass
from ctid_cli.inference.fit import Fit, IterationRecord, Status
from ctid_cli.inference.input_response import output_bandwidth
from ctid_cli.inference.uncertainty import DRAWS, Covariance
from ctid_cli.signals.record import Record
from ctid_cli.signals.treatment import OutputHold

#: SRIVC iterations at each trial delay of the search.
INNER_ITERATIONS = 20
#: Tolerance of the guarded variant during the search.
SEARCH_TOLERANCE = 1e-3


@dataclass(frozen=True)
class TdSrivc(Estimator["Searches", Fit]):
    """Coefficients and delay by separable least squares: SRIVC for the coefficients, Gauss-Newton for the delay.

    Parameters
    ----------
    poles : int
        Degree of the denominator, 1 to 12.
    zeros : int
        Degree of the numerator, below ``poles``.
    delay_bounds : tuple of float
        Least and greatest delay [s]. Samples earlier than the greatest delay after the first input are not used.
    lowpass : Lowpass, optional
        Search on low-pass-filtered data first, which widens the region of convergence; then refine on the unfiltered
        data. None searches on the unfiltered data.
    svf_cutoff : float, optional
        Cut-off of the state-variable filter of the start [rad/s], near the bandwidth of the system. By default four
        multiples of the output's bandwidth, from .04 to 5, are tried at the initial delay.
    max_iterations : int, default 50
        Largest number of Gauss-Newton iterations on the delay, in each of search and refinement.
    tolerance : float, default 1e-6
        Stop when the cost decreases by less than this fraction; also the tolerance of SRIVC at each trial delay [-].
    variant : {"guarded", "plain"}, default "guarded"
        ``plain`` is the published algorithm. ``guarded`` never increases the cost inside SRIVC and ends with joint
        iterations on coefficients and delay.
    hold_output : {"foh", "zoh"}, default "foh"
        Interpolation of the measured output between samples; affects the iterations, not the converged estimate.
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
    The cost as a function of the delay has many local minima, roughly one for each half period of the system's
    dominant frequency. The search finds the minimum of its initial basin; a low-pass filter merges basins. With
    ``eps = y - B/A u(t - tau)``, ``d eps/d tau = p B/A u(t - tau)`` and psi the sensitivities to the coefficients,

    ``H = eps_tau' eps_tau - eps_tau' psi (psi' psi)^-1 psi' eps_tau``, step ``-(eps_tau' eps)/H``,

    halved while it leaves the bounds or the cost does not decrease. After convergence, ``guarded`` tries all delays
    within the bounds with the estimated denominator: if the cost is lower elsewhere, the status is ``LOCAL``.

    References
    ----------
    F. Chen, H. Garnier and M. Gilson, "Robust identification of continuous-time models with arbitrary time-delay from
    irregularly sampled data", *J. Process Control* 25 (2015) 19-27. doi:10.1016/j.jprocont.2014.10.003
    """

    kind: ClassVar[str] = "td_srivc"
    start_from: ClassVar[StartFrom | None] = "delay"

    poles: int
    zeros: int
    delay_bounds: tuple[float, float]
    lowpass: Lowpass | None = None
    svf_cutoff: float | None = None
    max_iterations: int = 50
    tolerance: float = 1e-6
    variant: Variant = "guarded"
    hold_output: OutputHold = "foh"
    covariance: Covariance = "auto"
    bootstrap_draws: int = DRAWS

    def __post_init__(self) -> None:
        super().__post_init__()
        check_proper(self.poles, self.zeros)
        object.__setattr__(self, "delay_bounds", checked_bounds(self.delay_bounds))

    def check_start(self, start: Start) -> None:
        """Raise DataError for an initial delay outside the bounds."""
        initial_delay(start, self.delay_bounds)

    def _lay_out(self, record: Record) -> Searches:
        check_greatest_delay(record, self.delay_bounds[1])
        problem = self._problem(record)
        check_record(record, problem.data, problem.free)
        if self.lowpass is None:
            return Searches(problem, problem, record)
        try:
            filtered = self.lowpass.apply(record)
        except ValueError as error:
            raise DataError(str(error)) from error
        return Searches(self._problem(filtered), problem, record)

    def _problem(self, record: Record) -> SampledProblem:
        """Return the joint problem of coefficients and delay."""
        data = filter_data(record, self.delay_bounds[1], self.hold_output)
        return SampledProblem(data, self.poles, self.zeros, True, *self.delay_bounds)

    def _estimate(self, searches: Searches, start: Start | None) -> Fit:
        delay = initial_delay(start, self.delay_bounds)
        cutoffs = cutoffs_around(searches.bandwidth) if self.svf_cutoff is None else (self.svf_cutoff,)
        cost = self._cost(searches.first, cutoffs)
        found = descend(cost, delay, np.empty((0, cost.size)), self._limits)
        if found.end is None:
            raise DataError(Status.SINGULAR.value)
        history = history_of("search", searches.first, found.path)
        end = self._finish if self.lowpass is None else self._refine
        fit = end(searches.last, found, history)
        if self.variant == "plain" or fit.status in (Status.DELAY_AT_BOUND, Status.SINGULAR):
            return fit
        local = lower_elsewhere(searches.last, fit, searches.bandwidth)
        return replace(fit, status=Status.LOCAL) if local else fit

    def _cost(self, problem: SampledProblem, svf_cutoffs: tuple[float, ...] = ()) -> SampledCost:
        """Return the cost as a function of the delay; SRIVC estimates the coefficients."""
        steps = Steps(INNER_ITERATIONS, self._limits.tolerance, self.variant)
        return SampledCost(problem._replace(free_delay=False), steps, svf_cutoffs)

    @property
    def _limits(self) -> Limits:
        """Limits of the search."""
        low, high = self.delay_bounds
        # The guarded variant ends with joint iterations, so that its search only needs to find the basin.
        tolerance = self.tolerance if self.variant == "plain" else max(self.tolerance, SEARCH_TOLERANCE)
        return Limits(low, high, self.max_iterations, tolerance, SMALLEST_STEP * (high - low))

    def _refine(self, problem: SampledProblem, found: Descent, history: list[IterationRecord]) -> Fit:
        """Continue from the delay and coefficients of a search on filtered data."""
        refined = descend(self._cost(problem), found.minimum.delay, found.minimum.theta[None], self._limits)
        history += history_of("refine", problem, refined.path)
        if refined.end is not None:
            found = refined._replace(iterations=found.iterations + refined.iterations)
        return self._finish(problem, found, history)

    def _finish(self, problem: SampledProblem, found: Descent, history: list[IterationRecord]) -> Fit:
        """Return the fit after joint iterations on coefficients and delay, with a check of the bounds."""
        theta, status, iterations = found.minimum.theta, found.end or Status.DIVERGED, found.iterations
        guarded, steps = self.variant == "guarded", Steps(self.max_iterations, self.tolerance, GUARDED)
        polished = iterate(problem, theta, steps) if guarded else None
        if polished is not None:
            # In the right basin they converge in a few steps.
            history += history_of("joint", problem, polished.path)
            theta, iterations, status = polished.theta, iterations + polished.iterations, polished.status
        # The delay is at a bound if the cost decreases beyond it.
        here = problem.equations(theta)
        bound = bound_in_the_way(here, float(theta[-1]), self.delay_bounds)
        if bound is not None:
            there = iterate(problem._replace(free_delay=False), np.append(theta[:-1], bound), steps)
            if there is not None and there.equations.squared_error <= here.squared_error:
                status = Status.DELAY_AT_BOUND
                if guarded:
                    theta = there.theta
                    history += history_of("bound", problem, there.path[-1:])
        return finish(problem, theta, status, iterations, history, self.covariance, self.bootstrap_draws)


@dataclass(frozen=True, eq=False)
class Searches:
    """Problems of the search, on filtered samples if a filter is given, and of the refinement."""

    first: SampledProblem
    last: SampledProblem
    record: Record

    @cached_property
    def bandwidth(self) -> float:
        """Bandwidth of the record [rad/s], computed once for all starts."""
        return output_bandwidth(self.record)
