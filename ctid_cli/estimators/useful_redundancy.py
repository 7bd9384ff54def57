r"""Delay and coefficients by useful redundancy: Gauss-Newton paths on a set of low-pass-filtered costs."""

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

#: How hard to work at each trial delay.
EFFORT = Steps(6, 1e-2, GUARDED, 2)
#: Points of the lattice by which one start of the refinement is shorter than the best delay behind the widest band.
SHORTER = 2


@dataclass(frozen=True, eq=False, repr=False)
class RedundantFit(Fit):
    """A fit with the search that led to it.

    Parameters
    ----------
    model, parameter_names, covariance, status, cost, fit_percent, r2, count, iterations, condition_number, history
        As in :class:`~ctid_cli.inference.fit.Fit`.
    law, in_ignored_loop
        As in :class:`~ctid_cli.inference.fit.Fit`.
    search : RedundantMinimum or None
        Incumbents, candidates and switches: points are delays [s], costs are J0 [%].
    filters : FilterSet or None
        The filters of the search.
    paths : tuple of FilterPath
        Every solver path in the order in which they were followed.
    """

    search: RedundantMinimum[float] | None = None
    filters: FilterSet | None = None
    paths: tuple[FilterPath, ...] = ()

    @property
    def switches(self) -> tuple[Visit[float], ...]:
        """Where the search went on with another filter."""
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
        Bandwidth of the system [rad/s], its last -3 dB crossing; by default estimated from the record.
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
        A path stops when its cost falls by less than this fraction, and the search when an incumbent moves by less
        than this fraction of its delay, or of the shortest period if that is longer [-].
    max_rounds : int, default 20
        Largest number of rounds over all filters.
    hold_output : {"foh", "zoh"}, default "foh"
        Interpolation of the measured output between samples; changes the path, not the converged estimate.
    variant : {"guarded", "plain"}, default "guarded"
        ``plain`` is the published algorithm, slower and less certain to converge.
    covariance : {"auto", "white", "robust", "bootstrap"}, default "auto"
        Noise that the standard errors hold for: white, or coloured with an autocorrelation estimated from the
        residuals (``robust``), whose intervals ``bootstrap`` takes from a bootstrap-t. ``auto`` is white where the
        residuals pass Ljung and Box's test at the level of 5 %, else robust; and gives none where they do not in a
        loop that the estimator ignores. ``sandwich`` is an earlier name of ``robust``.
    bootstrap_draws : int, default 500
        Simulated noise sequences of a bootstrap [-].
    max_delay_step : float, optional
        Longest Gauss-Newton step of the delay [s]. By default a third of the range of the delay, in ``plain`` half the
        shortest period: the publication has such a limit, but does not print it.

    Raises
    ------
    ValueError
        If an option is out of range.

    Notes
    -----
    Algorithm IV of the reference. In each round, for every filter, Gauss-Newton on the delay runs from the incumbent to
    a minimum of the filtered cost; the candidate of least J0 becomes the incumbent. J0 is the mean over the filters of
    ``100 ||y_k - x_k|| / ||y_k - mean y_k||``, each with its own coefficients at that delay (45).

    ``guarded``: the incumbent is itself a candidate. Coefficients come from the filter next to it, first from the
    widest band to the narrowest and then back, the cheaper kept; that of widest band starts from least squares. A path
    starts from these coefficients, and a second time from least squares. A step that leaves the range is mirrored at
    its end. Where every path fails and J0 is still above 25 %, each filter's path starts once more one of its periods
    to either side. Estimates end on the unfiltered data: Gauss-Newton on the delay, then on all parameters together,
    from the minimum of J0, from that of the filter of widest band within half the shortest period of it, and from a
    fifth of a period less, the lowest cost kept.

    ``plain``: to the letter. Each filter has one path a round and SRIVC, from least squares, for its coefficients. A
    step is halved while it leaves the bounds or the cost of its filter does not fall. The end of least J0 is the next
    incumbent, even where J0 was lower before, until it moves by less than ``tolerance`` of itself; then the same is
    done once more without a filter. Three sentences of the reference are not taken at their word: footnote 6 limits
    only increments of the delay, here decrements too; Algorithm II stops at an absolute change of its cost, which
    depends on the unit of the output, here at a relative one; and where incumbents come back in turn the rounds have no
    end, here they end where one does, or after ``max_rounds``.

    The search fails where no filter's path leads to a lower J0; :func:`~ctid_cli.filtering.check_filters` says for
    which initial errors a set of filters can be trusted.

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
        """The estimator that ends the estimation on unfiltered data."""
        return TdSrivc(
            self.poles,
            self.zeros,
            self.delay_bounds,
            hold_output=self.hold_output,
            covariance=self.covariance,
            bootstrap_draws=self.bootstrap_draws,
        )

    def check_start(self, start: Start) -> None:
        """Refuse an initial delay outside the bounds."""
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
    """The search behind filters on one record and its end on unfiltered data, for any number of initial delays."""

    filters: FilterSet
    filtered: FilterSearch
    max_rounds: int
    refinement: TdSrivc
    unfiltered: SampledProblem
    #: What was refined from which minimum of J0 [s].
    refined: dict[float, Fit] = field(default_factory=dict)

    def run(self, delay: float) -> tuple[Fit, RedundantMinimum[float], list[FilterPath]]:
        """Search from an initial delay and refine what was found."""
        found, paths = self.filtered.run(delay, self.max_rounds)
        if found.point not in self.refined:
            self.refined[found.point] = self._refine(found.point)
        fit = self.refined[found.point]
        history = (*path_history("filter {}", found, paths, self.refinement.poles), *fit.history)
        return replace(fit, iterations=found.rounds + fit.iterations, history=history), found, paths

    def _refine(self, point: float) -> Fit:
        """Go on from the minimum of J0, and from where the filter of widest band fits best within half a period."""
        search = self.filtered
        # J0 is flat around its minimum where noise, or a model with too long a delay, weighs on the narrow filters.
        nearby = point + search.period * np.linspace(-0.5, 0.5, 1 + round(1 / LATTICE))
        delays = np.unique(np.clip(nearby, *self.refinement.delay_bounds)).tolist()
        found = scan([search.costs[-1]] * len(delays), delays)
        least = int(np.argmin(found.squared_errors))
        # Where the delay is too long a pole makes up for it by running to infinity, and does not come back.
        starts = found.thetas[[least, max(least - SHORTER, 0)]]
        here = search.at(point)
        if np.isfinite(here.squared_errors[-1]):
            starts = np.vstack((here.thetas[-1:], starts))
        if not np.isfinite(found.squared_errors[least]):
            raise DataError(Status.SINGULAR.value)
        ends = [Descent(Minimum(theta, np.nan), np.empty((0, 1)), Status.CONVERGED, 0) for theta in starts]
        return min((self.refinement._refine(self.unfiltered, end, []) for end in ends), key=lambda fit: fit.cost)
