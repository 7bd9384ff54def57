r"""Estimation of delay and coefficients by useful redundancy: Gauss-Newton paths on low-pass-filtered costs."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import ClassVar

import numpy as np

from ctid_cli.errors import DataError
from ctid_cli.estimation.common import Estimator, Start, StartFrom, check_proper, initial_delay
from ctid_cli.estimation.delay_search import Descent, Limits, Minimum, scan
from ctid_cli.estimation.filtered_costs import (
    LARGEST_STEP,
    LATTICE,
    FilterPath,
    FilterSearch,
    filtered_costs,
    path_history,
)
from ctid_cli.estimation.iteration import GUARDED, Steps, Variant
from ctid_cli.estimation.redundancy import RedundantMinimum, Visit
from ctid_cli.estimation.sampled_problem import SampledProblem
from ctid_cli.estimators.printed_redundancy import PrintedSearch, printed_search
from ctid_cli.estimators.td_srivc import TdSrivc
from ctid_cli.filtering.filter_set import FilterSet
from ctid_cli.inference.fit import Fit, Status
from ctid_cli.inference.input_response import output_bandwidth
from ctid_cli.inference.sensitivities import Structure
from ctid_cli.inference.uncertainty import DRAWS, Covariance
from ctid_cli.signals.record import Record, named
from ctid_cli.signals.treatment import OutputHold

#: Steps at each trial delay.
EFFORT = Steps(6, 1e-2, GUARDED, 2)
#: Lattice points by which one start of the refinement precedes the best delay of the filter of widest band.
SHORTER = 2


@dataclass(frozen=True, eq=False, repr=False)
class RedundantFit(Fit):
    """Fit with its search.

    Parameters
    ----------
    model, parameter_names, covariance, status, cost, fit_percent, r2, count, iterations, condition_number, history
        As in :class:`~ctid_cli.inference.fit.Fit`.
    law, in_ignored_loop, assumed_hold
        As in :class:`~ctid_cli.inference.fit.Fit`.
    search : RedundantMinimum or None
        Incumbents, candidates and switches: points are delays [s], costs are J0 [%].
    filters : FilterSet or None
        Filters of the search.
    paths : tuple of FilterPath
        All solver paths in the order of the search.
    """

    search: RedundantMinimum[float] | None = None
    filters: FilterSet | None = None
    paths: tuple[FilterPath, ...] = ()

    @property
    def switches(self) -> tuple[Visit[float], ...]:
        """Incumbents at which the search changed to another filter."""
        return () if self.search is None else self.search.switches


@dataclass(frozen=True)
class UsefulRedundancy(Estimator["RedundantSearch | PrintedSearch", RedundantFit]):
    """Delay and coefficients by useful redundancy over a set of low-pass filters.

    Parameters
    ----------
    poles : int
        Degree of the denominator, 1 to 12.
    zeros : int
        Degree of the numerator, below ``poles``.
    delay_bounds : tuple of float
        Least and greatest delay [s]. Samples earlier than the greatest delay after the first input are not used.
    bandwidth : float, optional
        Bandwidth of the system [rad/s], its last -3 dB crossing; estimated from the record by default.
    filters : int, default 10
        Number of filters.
    beta : float, default 10.0
        Ratio of the longest to the shortest period of the filters [-].
    order : int, default 10
        Order of the Butterworth filters.
    svf_cutoff : float, optional
        Cut-off of the state-variable filter of the starts [rad/s]; by default the bandwidth.
    max_iterations : int, default 10
        Largest number of Gauss-Newton iterations on each path.
    tolerance : float, default 1e-3
        A path stops when its cost decreases by less than this fraction, and the search when an incumbent changes by
        less than this fraction of its delay, or of the shortest period if that is longer [-].
    max_rounds : int, default 20
        Largest number of rounds over all filters.
    hold_output : {"foh", "zoh"}, default "foh"
        Interpolation of the measured output between samples; affects the iterations, not the converged estimate.
    variant : {"guarded", "plain"}, default "guarded"
        ``plain`` is the published algorithm, which is slower and converges less reliably.
    covariance : {"auto", "white", "robust", "bootstrap"}, default "auto"
        Noise assumed for the standard errors: white, or coloured with an autocorrelation estimated from the residuals
        (``robust``), which also allows for a changing variance; ``bootstrap`` adds bootstrap-t intervals. ``auto`` is
        robust, and white if it finds white noise of constant variance; there are no errors if the residuals do not pass
        the Ljung-Box test at the 5 % level and the record is from a loop that the estimator ignores.
        ``sandwich`` is an earlier name of ``robust``.
    bootstrap_draws : int, default 500
        Number of simulated noise sequences of a bootstrap [-].
    max_delay_step : float, optional
        Longest Gauss-Newton step of the delay [s]. By default a third of the range of the delay, in ``plain`` half the
        shortest period: the publication has such a limit without its value.

    Raises
    ------
    ValueError
        If an option is out of range.

    Notes
    -----
    Algorithm IV of the reference. In each round, for every filter, Gauss-Newton on the delay runs from the incumbent to
    a minimum of the filtered cost; the candidate of least J0 becomes the incumbent. J0 is the mean over the filters of
    ``100 ||y_k - x_k|| / ||y_k - mean y_k||``, each with its own coefficients at that delay (45).

    ``guarded``: the incumbent is also a candidate. Coefficients start from those of the adjacent filter, first from the
    widest band to the narrowest and then back, and the lower cost is kept; the filter of widest band starts from least
    squares. A path starts from these coefficients, and again from least squares. A step out of the range is reflected
    at its end. If every path fails and J0 is still above 25 %, each filter's path restarts one of its periods to either
    side. Estimates are refined on the unfiltered data: Gauss-Newton on the delay, then on all parameters jointly, from
    the minimum of J0, from that of the filter of widest band within half the shortest period of it, and from a fifth of
    a period less, with the lowest cost kept.

    ``plain``: exactly as published. Each filter has one path per round and SRIVC, from least squares, for its
    coefficients. A step is halved while it leaves the bounds or the cost of its filter does not decrease. The end of
    least J0 is the next incumbent, even if J0 was lower before, until its relative change is below ``tolerance``; then
    this is repeated without a filter. There are three differences from the reference: footnote 6 limits only increments
    of the delay, here decrements too; Algorithm II stops at an absolute change of its cost, which depends on the unit
    of the output, here at a relative one; and cyclic incumbents never end the published rounds, here the rounds end
    when an incumbent recurs, or after ``max_rounds``.

    The search fails if no filter's path leads to a lower J0; :func:`~ctid_cli.filtering.check_filters` computes the
    initial errors for which a set of filters is reliable.

    References
    ----------
    H. Ha, J. S. Welsh and M. Alamir, "Useful redundancy in parameter and time delay estimation for continuous-time
    models", arXiv:1703.09344 (2017). doi:10.48550/arXiv.1703.09344

    Examples
    --------
    >>> import numpy as np
    >>> from ctid_cli import HeldSignal, Record, TransferFunction, UsefulRedundancy, simulate
    >>> from ctid_cli.estimation.common import Start
    >>> t = 0.05 * np.arange(2000)
    >>> u = HeldSignal(t, np.random.default_rng(0).choice([-1.0, 1.0], t.size))
    >>> y = simulate(TransferFunction([2], [0.25, 0.7, 1], delay=8), u, t)
    >>> y += 0.1 * np.random.default_rng(1).standard_normal(t.size)
    >>> fit = UsefulRedundancy(2, 0, delay_bounds=(0, 15), bandwidth=2.0).fit(Record(t, y, u), Start(delay=0.0))
    >>> round(fit.model.delay, 2)
    8.0
    """

    kind: ClassVar[str] = "useful_redundancy"
    start_from: ClassVar[StartFrom | None] = "delay"

    poles: int
    zeros: int
    delay_bounds: tuple[float, float]
    bandwidth: float | None = None
    filters: int = 10
    beta: float = 10.0
    order: int = 10
    svf_cutoff: float | None = None
    max_iterations: int = 10
    tolerance: float = 1e-3
    max_rounds: int = 20
    hold_output: OutputHold = "foh"
    covariance: Covariance = "auto"
    bootstrap_draws: int = DRAWS
    variant: Variant = "guarded"
    max_delay_step: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check_proper(self.poles, self.zeros)
        FilterSet(self.bandwidth or 1.0, self.filters, self.beta, self.order)
        object.__setattr__(self, "delay_bounds", self.refinement.delay_bounds)

    @property
    def refinement(self) -> TdSrivc:
        """Estimator of the final refinement on unfiltered data."""
        return TdSrivc(
            self.poles,
            self.zeros,
            self.delay_bounds,
            hold_output=self.hold_output,
            covariance=self.covariance,
            bootstrap_draws=self.bootstrap_draws,
        )

    def check_start(self, start: Start) -> None:
        """Raise DataError for an initial delay outside the bounds."""
        initial_delay(start, self.delay_bounds)

    def _lay_out(self, record: Record) -> RedundantSearch | PrintedSearch:
        unfiltered = self.refinement._lay_out(record).last
        bandwidth = self.bandwidth or output_bandwidth(record)
        filters = FilterSet(bandwidth, self.filters, self.beta, self.order)
        if self.variant == "plain":
            srivc = replace(
                self.refinement,
                svf_cutoff=self.svf_cutoff or bandwidth,
                max_iterations=self.max_iterations,
                tolerance=self.tolerance,
                variant="plain",
            )
            longest = self.max_delay_step or 0.5 * float(filters.periods[-1])
            return printed_search(srivc, record, filters, longest, self.max_rounds)
        costs = filtered_costs(
            record,
            filters.lowpasses,
            Structure(self.poles, self.zeros),
            self.delay_bounds[1],
            start=self.delay_bounds[1],
            svf_cutoffs=[self.svf_cutoff or bandwidth] * self.filters,
            steps=EFFORT,
        )
        passed = int((costs[0].spectra.frequencies <= bandwidth).sum())
        if 2 * passed - 1 <= costs[0].size + self.poles:
            raise DataError(
                f"{named(record)}fewer than {passed} periods of the bandwidth, {bandwidth:.3g} rad/s, are left after "
                f"the greatest delay, {self.delay_bounds[1]:g} s: too few to estimate from; take a smaller greatest "
                "delay, a larger bandwidth or a longer record"
            )
        longest = self.max_delay_step or LARGEST_STEP * (self.delay_bounds[1] - self.delay_bounds[0])
        limits = Limits(*self.delay_bounds, self.max_iterations, self.tolerance, 0.0, longest)
        search = FilterSearch(costs, filters, limits)
        return RedundantSearch(filters, search, self.max_rounds, self.refinement, unfiltered)

    def _estimate(self, laid_out: RedundantSearch | PrintedSearch, start: Start | None) -> RedundantFit:
        fit, found, paths = laid_out.run(initial_delay(start, self.delay_bounds))
        values = {item.name: getattr(fit, item.name) for item in fields(Fit)}
        return RedundantFit(**values, search=found, filters=laid_out.filters, paths=tuple(paths))


@dataclass(frozen=True, eq=False)
class RedundantSearch:
    """Search on one filtered record and refinement on unfiltered data, for any number of initial delays."""

    filters: FilterSet
    filtered: FilterSearch
    max_rounds: int
    refinement: TdSrivc
    unfiltered: SampledProblem
    #: Refined fits by the minimum of J0 [s].
    refined: dict[float, Fit] = field(default_factory=dict)

    def run(self, delay: float) -> tuple[Fit, RedundantMinimum[float], list[FilterPath]]:
        """Search from an initial delay and refine the result."""
        found, paths = self.filtered.run(delay, self.max_rounds)
        if found.point not in self.refined:
            self.refined[found.point] = self._refine(found.point)
        fit = self.refined[found.point]
        history = (*path_history("filter {}", found, paths, self.refinement.poles), *fit.history)
        return replace(fit, iterations=found.rounds + fit.iterations, history=history), found, paths

    def _refine(self, point: float) -> Fit:
        """Refine from the minimum of J0, and from that of the filter of widest band within half a period."""
        search = self.filtered
        # J0 is flat around its minimum if noise, or too long a delay, dominates the costs of the narrow filters.
        nearby = point + search.period * np.linspace(-0.5, 0.5, 1 + round(1 / LATTICE))
        delays = np.unique(np.clip(nearby, *self.refinement.delay_bounds)).tolist()
        found = scan([search.costs[-1]] * len(delays), delays)
        least = int(np.argmin(found.squared_errors))
        # With too long a delay a pole compensates by moving to infinity, and does not return.
        starts = found.thetas[[least, max(least - SHORTER, 0)]]
        here = search.at(point)
        if np.isfinite(here.squared_errors[-1]):
            starts = np.vstack((here.thetas[-1:], starts))
        if not np.isfinite(found.squared_errors[least]):
            raise DataError(Status.SINGULAR.value)
        ends = [Descent(Minimum(theta, np.nan), np.empty((0, 1)), Status.CONVERGED, 0) for theta in starts]
        return min((self.refinement._refine(self.unfiltered, end, []) for end in ends), key=lambda fit: fit.cost)
