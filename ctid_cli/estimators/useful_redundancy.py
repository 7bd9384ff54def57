r"""Delay and coefficients by useful redundancy: Gauss-Newton paths on a set of low-pass-filtered costs."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import ClassVar, get_args

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError
from ctid_cli.estimation.common import Start, StartFrom, check_iteration, check_structure, initial_delay
from ctid_cli.estimation.delay_grid import scan
from ctid_cli.estimation.delay_search import Descent, Minimum, descend
from ctid_cli.estimation.filtered_costs import Effort, FilteredCost, Search, filtered_costs
from ctid_cli.estimation.redundancy import Path, RedundantMinimum, SearchStatus, Visit, minimise_redundantly
from ctid_cli.estimators.td_srivc import TdSrivc
from ctid_cli.filtering.filter_set import FilterSet
from ctid_cli.inference.answer import output_bandwidth
from ctid_cli.inference.fit import Fit, IterationRecord
from ctid_cli.inference.status import Status
from ctid_cli.signals.checks import require_choice, require_integer, require_positive
from ctid_cli.signals.held import Hold
from ctid_cli.signals.record import Record

#: J0 is evaluated on a lattice of delays of this fraction of the shortest period, so that candidates that agree share
#: it, and so do searches of the same data from different initial delays.
LATTICE = 0.1
#: The shortest Gauss-Newton step of the search, as a fraction of the shortest period.
SMALLEST_STEP = 0.01
#: The longest Gauss-Newton step, as a fraction of the range of the delay: from a fifth to four fifths all serve, with a
#: tenth the paths end in small bumps far from the minimum.
LARGEST_STEP = 1 / 3
#: Where no path leads lower and J0 exceeds this [%], the paths start once more a period of their filter away.
POOR = 25.0
#: Points of the lattice by which one start of the refinement is shorter than the best delay behind the widest band.
SHORTER = 2
#: J0 of a filter in which nothing can be computed [%].
NOTHING = 100.0


@dataclass(frozen=True, eq=False)
class FilterPath:
    """One solver path: Gauss-Newton on the delay with one filter."""

    round: int
    filter: int
    #: Accepted trial delays [s], where it started first: the incumbent, or a period of the filter away from it, shape
    #: (K,).
    delays: Array
    #: ``100 ||y - x|| / ||y - mean y||`` of the filtered data there [%], shape (K,).
    costs: Array
    #: ``(a_1 … a_n, b_0 … b_m)`` there, shape (K, n + m + 1).
    coefficients: Array


@dataclass(frozen=True, eq=False, repr=False)
class RedundantFit(Fit):
    """A fit with the search that led to it.

    Parameters
    ----------
    model, parameter_names, covariance, status, cost, fit_percent, r2, count, iterations, condition_number, history
        As in :class:`~ctid_cli.inference.fit.Fit`.
    search : RedundantMinimum or None
        Incumbents, candidates and switches: points are delays [s], costs are J0 [%].
    filters : FilterSet or None
        The filters of the search.
    paths : tuple of FilterPath
        Every solver path in the order in which they were followed.
    """

    search: RedundantMinimum[float] | None = field(default=None, repr=False)
    filters: FilterSet | None = field(default=None, repr=False)
    paths: tuple[FilterPath, ...] = field(default=(), repr=False)

    @property
    def switches(self) -> tuple[Visit[float], ...]:
        """Where the search went on with another filter."""
        return () if self.search is None else self.search.switches


@dataclass(frozen=True)
class UsefulRedundancy:
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
    search : {"time", "spectral"}, default "time"
        Whether the search runs on samples of the filtered signals or on their spectra. The final estimate always
        comes from the unfiltered samples.
    max_iterations : int, default 10
        Largest number of Gauss-Newton iterations on each path.
    tolerance : float, default 1e-3
        A path stops when its cost falls by less than this fraction, and the search when an incumbent moves by less
        than this fraction of its delay, or of the shortest period if that is longer [-].
    max_rounds : int, default 20
        Largest number of rounds over all filters.
    hold_output : {"foh", "zoh"}, default "foh"
        Interpolation of the measured output between samples; changes the path, not the converged estimate.

    Raises
    ------
    ValueError
        If an option is out of range.

    Notes
    -----
    Algorithm IV of the reference. In each round, for every filter, Gauss-Newton on the delay runs from the incumbent to
    a minimum of the filtered cost; the candidate of least J0 becomes the incumbent, itself a candidate. J0 is the mean
    over the filters of ``100 ||y_k - x_k|| / ||y_k - mean y_k||``, each with its own coefficients at that delay (45).
    Those come from the filter next to it, first from the widest band to the narrowest and then back, the cheaper kept;
    the filter of widest band starts from least squares. A path starts from these coefficients, and a second time from
    least squares. Gauss-Newton steps are no longer than a third of the range of the delay; the publication limits
    them, but not by how much. One that leaves the range is mirrored at its end. Where every path fails and J0 is still
    above 25 %, each filter's path starts once more one of its periods to either side. Estimates end on the unfiltered
    data: Gauss-Newton on the delay, then on all parameters together, from the minimum of J0, from that of the filter
    of widest band within half the shortest period of it, and from a fifth of a period less, the lowest cost kept.

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
    search: Search = "time"
    max_iterations: int = 10
    tolerance: float = 1e-3
    max_rounds: int = 20
    hold_output: Hold = "foh"

    def __post_init__(self) -> None:
        check_structure(self.poles, self.zeros)
        require_choice("search", self.search, get_args(Search))
        check_iteration(self.max_iterations, self.tolerance)
        require_integer("max_rounds", self.max_rounds, 1)
        if self.svf_cutoff is not None:
            require_positive("svf_cutoff", self.svf_cutoff, "rad/s")
        require_integer("filters", self.filters, 2)
        require_integer("order", self.order, 1, 20)
        FilterSet(self.bandwidth or 1.0, self.filters, self.beta, self.order)
        if self.bandwidth is not None:
            require_positive("bandwidth", self.bandwidth, "rad/s")
        object.__setattr__(self, "delay_bounds", self.refinement.delay_bounds)

    @property
    def refinement(self) -> TdSrivc:
        """The estimator that ends the estimation on unfiltered data."""
        return TdSrivc(self.poles, self.zeros, self.delay_bounds, hold_output=self.hold_output)

    def prepare(self, record: Record) -> PreparedUsefulRedundancy:
        """Check a record, lay it out and filter it, once for any number of starts.

        Parameters
        ----------
        record : Record
            The record.

        Returns
        -------
        PreparedUsefulRedundancy
            Ready to fit from any start.

        Raises
        ------
        DataError
            If nothing can be estimated from the record.
        """
        return PreparedUsefulRedundancy(self, record)

    def fit(self, record: Record, start: Start | None = None) -> RedundantFit:
        """Estimate coefficients and delay.

        Parameters
        ----------
        record : Record
            The record.
        start : Start, optional
            Initial delay; the middle of the bounds by default.

        Returns
        -------
        RedundantFit
            The estimate.

        Raises
        ------
        DataError
            If nothing can be estimated from the record, or the start lies outside the bounds.
        """
        return self.prepare(record).fit(start)


class PreparedUsefulRedundancy:
    """A record checked, laid out and filtered for :class:`UsefulRedundancy`."""

    def __init__(self, options: UsefulRedundancy, record: Record) -> None:
        self.options = options
        self.refinement = options.refinement.prepare(record)
        bandwidth = options.bandwidth or output_bandwidth(record)
        self.filters = FilterSet(bandwidth, options.filters, options.beta, options.order)
        self.period = float(self.filters.periods[-1])
        costs = filtered_costs(
            record,
            self.filters.lowpasses,
            self.refinement.structure,
            options.delay_bounds,
            search=options.search,
            start=options.delay_bounds[1],
            svf_cutoff=options.svf_cutoff or bandwidth,
            hold_output=options.hold_output,
            effort=Effort(max_iterations=6, halvings=2, gauss_newton=options.search == "spectral"),
        )
        self.costs: list[FilteredCost] = [cost for cost in costs if cost is not None]
        if len(self.costs) < len(costs):
            raise DataError(
                f"{record.name + ': ' if record.name else ''}after the greatest delay, {options.delay_bounds[1]:g} s, "
                f"the record is too short for {len(costs) - len(self.costs)} of {len(costs)} filters, whose periods "
                f"reach {self.filters.periods[0]:.3g} s; take a smaller beta, a larger bandwidth, a smaller greatest "
                "delay or a longer record"
            )
        self._known: dict[int, tuple[float, list[Minimum | None]]] = {}

    def member_costs(self, delay: float) -> Array:
        """Costs of all filters at a delay, each with its own coefficients."""
        return np.array([self._percent(k, minimum) for k, minimum in enumerate(self._minima(delay))])

    def reference_cost(self, delay: float) -> float:
        """J0 at the nearest point of a lattice of a tenth of the shortest period: the mean of all members' costs."""
        return self._at(delay)[0]

    def fit(self, start: Start | None = None) -> RedundantFit:
        """Estimate coefficients and delay from one start."""
        options = self.options
        delay = initial_delay(start, options.delay_bounds)
        paths: list[FilterPath] = []
        search = self._search(delay, paths)
        fit = self._refine(search, self._history(search, paths))
        return RedundantFit(
            **{item.name: getattr(fit, item.name) for item in fields(Fit)},
            search=search,
            filters=self.filters,
            paths=tuple(paths),
        )

    def _search(self, delay: float, paths: list[FilterPath]) -> RedundantMinimum[float]:
        """Rounds over all filters, and a look at the next valleys before a poor incumbent is settled for."""
        options = self.options

        def rounds_from(delay: float, done: int, hop: bool) -> RedundantMinimum[float]:
            return minimise_redundantly(
                delay,
                self.reference_cost,
                [self._path(k, paths, done, hop) for k in range(len(self.costs))],
                choice="best",
                settled=lambda before, now: abs(now - before) <= options.tolerance * max(abs(now), self.period),
                max_rounds=1 if hop else options.max_rounds - done,
            )

        found = rounds_from(delay, 0, False)
        while found.status is SearchStatus.EXHAUSTED and found.cost > POOR and found.rounds < options.max_rounds - 1:
            beyond = rounds_from(found.point, found.rounds, True)
            improved = len(beyond.trajectory) > 1
            found = _joined(found, beyond)
            if not improved:
                break
            found = _joined(found, rounds_from(found.point, found.rounds, False))
        return found

    def _history(self, search: RedundantMinimum[float], paths: list[FilterPath]) -> list[IterationRecord]:
        """The steps of the paths that led from incumbent to incumbent."""
        n = self.options.poles
        history: list[IterationRecord] = []
        for visit in search.trajectory[1:]:
            path = next(
                p for p in paths if (p.round, p.filter) == (visit.round, visit.path) and p.delays[-1] == visit.point
            )
            cost = self.costs[path.filter]
            squares = (path.costs / 100.0) ** 2 * cost.spread * cost.mean_factor
            stage = f"filter {path.filter + 1}"
            for i, (delay, square, theta) in enumerate(zip(path.delays, squares, path.coefficients, strict=True)):
                history.append(
                    IterationRecord(
                        stage, i, float(delay), float(square), (1.0, *theta[:n].tolist()), tuple(theta[n:].tolist())
                    )
                )
        return history

    def _refine(self, search: RedundantMinimum[float], history: list[IterationRecord]) -> Fit:
        """Go on from the minimum of J0, and from where the filter of widest band fits best within half a period."""
        low, high = self.options.delay_bounds
        # J0 is flat around its minimum where noise, or a model with too long a delay, weighs on the narrow filters.
        nearby = np.clip(search.point + self.period * np.linspace(-0.5, 0.5, 1 + round(1 / LATTICE)), low, high)
        found = [minimum for minimum in scan(self.costs[-1], np.unique(nearby)) if minimum is not None]
        widest = self._at(search.point)[1][-1]
        starts = [] if widest is None else [replace(widest, delay=search.point)]
        if found:
            least = int(np.argmin([minimum.squared_error for minimum in found]))
            # Where the delay is too long a pole makes up for it by running to infinity, and does not come back.
            starts += [found[least], found[max(least - SHORTER, 0)]]
        best: Fit | None = None
        for start in starts:
            fit = self.refinement.refine(Descent(start, Status.CONVERGED, search.rounds), list(history))
            if best is None or fit.cost < best.cost:
                best = fit
        if best is None:
            raise DataError(Status.SINGULAR.value)
        return best

    def _path(self, k: int, paths: list[FilterPath], done: int, hop: bool) -> Path[float]:
        """Solver path of one filter after a number of rounds; what it does goes to ``paths``."""
        cost = self.costs[k]
        low, high = self.options.delay_bounds
        period = float(self.filters.periods[k])
        rounds = done

        def follow(delay: float) -> list[float]:
            nonlocal rounds
            rounds += 1
            starts: list[tuple[float, Array | None]]
            if hop:
                starts = [(start, None) for start in (delay - period, delay + period) if low <= start <= high]
            else:
                # From the coefficients of J0 and from least squares: where one is trapped the other often is not.
                here = self._at(delay)[1][k]
                starts = [(delay, theta) for theta in ((None,) if here is None else (here.theta, None))]
            ends: list[float] = []
            for start, theta in starts:
                steps: list[Minimum] = []
                found = descend(
                    cost,
                    start,
                    theta,
                    (low, high),
                    max_iterations=self.options.max_iterations,
                    tolerance=self.options.tolerance,
                    smallest_step=SMALLEST_STEP * self.period,
                    largest_step=LARGEST_STEP * (high - low),
                    reflect=True,
                    on_step=steps.append,
                )
                if found is not None:
                    costs = np.array([self._percent(k, step) for step in steps])
                    delays = np.array([step.delay for step in steps])
                    paths.append(FilterPath(rounds, k, delays, costs, np.array([step.theta for step in steps])))
                    ends.append(float(found.minimum.delay))
            return ends

        return follow

    def _at(self, delay: float) -> tuple[float, list[Minimum | None]]:
        """J0 and the minima of all filters at the lattice point next to a delay."""
        place = round(delay / (LATTICE * self.period))
        if place not in self._known:
            low, high = self.options.delay_bounds
            minima = self._minima(min(max(place * LATTICE * self.period, low), high))
            mean = float(np.mean([self._percent(k, minimum) for k, minimum in enumerate(minima)]))
            self._known[place] = mean, minima
        return self._known[place]

    def _percent(self, k: int, minimum: Minimum | None) -> float:
        return NOTHING if minimum is None else 100.0 * float(np.sqrt(minimum.squared_error / self.costs[k].spread))

    def _minima(self, delay: float) -> list[Minimum | None]:
        """Coefficients of every filter at a delay: good ones are handed from filter to filter, down and up again."""
        minima: list[Minimum | None] = [None] * len(self.costs)
        neighbour: Array | None = None
        for k in reversed(range(len(self.costs))):
            # Least squares on a narrow band is hopeless in noise: the next wider band knows the system better.
            found = minima[k] = self.costs[k].minimise(delay, neighbour)
            neighbour = neighbour if found is None else found.theta
        for k in range(1, len(self.costs)):
            below, here = minima[k - 1], minima[k]
            if below is not None:
                found = self.costs[k].minimise_from(delay, [below.theta])
                if found is not None and (here is None or found.squared_error < here.squared_error):
                    minima[k] = found
        return minima


def _joined(first: RedundantMinimum[float], then: RedundantMinimum[float]) -> RedundantMinimum[float]:
    """A search and the one that went on from its end as one."""
    later = tuple(replace(visit, round=visit.round + first.rounds) for visit in then.visits[1:])
    return replace(then, rounds=first.rounds + then.rounds, visits=first.visits + later)


__all__ = ["FilterPath", "PreparedUsefulRedundancy", "RedundantFit", "UsefulRedundancy"]
