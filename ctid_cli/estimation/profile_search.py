"""Search over the delay of measured records: on low-pass filtered records from coarse to fine, or on all samples."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.estimation.delay_search import Minimum, lowest_minima, quarter_periods, scan, search_levels
from ctid_cli.estimation.filtered_costs import HIGHEST, filtered_costs
from ctid_cli.estimation.iteration import GUARDED, Steps
from ctid_cli.estimation.measured_records import MeasuredRecords
from ctid_cli.estimation.optimum.box import each_bounds
from ctid_cli.estimation.optimum.search import local_minimum
from ctid_cli.estimation.sampled_problem import CUTOFFS, least_squares_starts
from ctid_cli.filtering.lowpass import Lowpass
from ctid_cli.inference.sensitivities import Structure

#: Number of local minima of the profile that are refined.
MINIMA = 3
#: Descent at each delay of the grid: predicted relative decrease of the cost that ends it, and largest number of steps.
ROUGH = 3e-3, 10
#: Largest number of delays on the grid, for any bandwidth.
MOST_DELAYS = 2000
#: Largest number of subdivisions of a grid step around its minima.
FINEST = 32
#: Search on filtered records: ratio of the cut-off frequencies of its levels, largest number of delays on the first
#: level, above which a coarser one is added, largest number of levels, and order and steps of each.
LEVEL_RATIO = 3.0
MOST_FIRST_DELAYS = 30
MOST_LEVELS = 4
LEVEL_ORDER = 10
#: Real equations in the pass band of a level per parameter, including those of the transient.
EQUATIONS_PER_PARAMETER = 4
LEVEL_EFFORT = Steps(max_iterations=6, tolerance=2e-2, rule=GUARDED, halvings=3)


@dataclass(frozen=True, eq=False)
class Profile:
    """Cost over a grid of delays, minimised over all other parameters."""

    #: Grid [s], shape (K,).
    delays: Array
    #: Mean squared output error [output unit^2]; infinite for singular equations, shape (K,).
    costs: Array
    #: Frequency below which the output has 95 % of its power [rad/s]; the spacing is at most a quarter of its period.
    bandwidth: float
    #: Number of samples of the search, which is a part of long records.
    samples: int
    #: Cut-off frequency [rad/s] of the low-pass filter of the record, from which the costs are computed; the spacing is
    #: then a quarter of its period. None if all samples were searched.
    cutoff: float | None = None


#: Minima to be refined, empty if none can be computed, and the profile; None for a known delay.
Found = tuple[list[Minimum], Profile | None]


class RecordsCost:
    """Cost of all samples of the records as a function of the delay."""

    def __init__(self, measured: MeasuredRecords, bandwidth: float, cutoffs: Sequence[float]) -> None:
        self.measured = measured
        self.bandwidth = bandwidth
        self.cutoffs = cutoffs
        self.integrators = measured.treatment.integrators[0]
        self.coefficients = Structure(measured.structure.poles - self.integrators, measured.structure.zeros)

    def starts(self, delay: float) -> list[Array]:
        """Return denominators of least-squares starts; the mean of the output is part of the offset."""
        n, m = self.coefficients.poles, self.coefficients.zeros
        cutoffs, found = [cutoff * self.bandwidth for cutoff in self.cutoffs], []
        if not self.integrators:
            strictly_proper = Structure(n, min(m, n - 1))
            thetas = least_squares_starts(self.measured.centred, strictly_proper, delay, cutoffs)
            found = [theta[:n] for theta in thetas]
        # Without any, a system with the bandwidth of the output is the start for Gauss-Newton.
        found = found or [np.atleast_1d(np.poly(np.full(n, -0.5 * self.bandwidth)))[1:]]
        return [np.concatenate((a, np.zeros(m + 1), [delay])) for a in found]

    @property
    def size(self) -> int:
        """Number of parameters, including the delay."""
        return self.coefficients.size + 1

    def minimise(self, delay: float, starts: Array, own: bool) -> Minimum:
        """Return the least cost at a delay over the denominators of several starts."""
        measured, n = self.measured, self.coefficients.poles
        tried = np.vstack((starts, *(self.starts(delay) if own else ())))
        best = Minimum(np.zeros(self.size), np.inf)
        for start in tried:
            poles = np.roots(np.concatenate(([1.0], start[:n]))).astype(complex)
            found = local_minimum(measured.problem, poles, delay, (delay, delay), *ROUGH)
            if found.squared_error < best.squared_error:
                theta = np.concatenate((found.point.denominator[1:], start[n:-1], [delay]))
                best = Minimum(theta, found.squared_error)
        return best


def search_delay(records: MeasuredRecords, svf_cutoff: float | None, nested: bool) -> Iterator[Found]:
    """Yield searches of the delay; later ones are used if refining the earlier ones fails.

    With ``nested``, the profile of a part of long records suffices, since smaller models lead to the optimum.
    """
    part = records.part() if nested else None
    measured = part or records
    bandwidth = svf_cutoff or measured.bandwidth
    cost = RecordsCost(measured, bandwidth, (1.0,) if measured.structure.delay else CUTOFFS)
    treatment = measured.treatment
    # Filters require the response to the input only, or to an input that is known from the start of the window.
    at_rest = (treatment.initial_state == "rest" or part is not None) and treatment.offset not in ("estimate", "drift")
    # With integrators the filtered costs omit the mean, and a state of rest is not required.
    if (
        (at_rest or (any(treatment.integrators) and not any(measured.layout.trend)))
        and len(measured.records) == 1
        and measured.structure.delay
    ):
        yield _search_levels(cost)
    yield _search_samples(cost)


def _search_levels(cost: RecordsCost) -> Found:
    """Search on low-pass filtered records."""
    measured, bandwidth = cost.measured, cost.bandwidth
    (bounds,) = each_bounds(measured.treatment.delay_bounds)
    record, cutoffs = measured.records[0], _cutoffs(bounds, bandwidth)
    present = record.t[record.valid]
    # Two real equations per frequency in the pass band.
    equations = cutoffs * (present[-1] - max(present[0], record.input.t[0])) / np.pi
    cutoffs = cutoffs[equations >= EQUATIONS_PER_PARAMETER * (cost.size + measured.structure.poles)]
    # Near the Nyquist frequency linear interpolation does not represent the output.
    if not cutoffs.size or HIGHEST * bandwidth * float(np.median(np.diff(present))) > np.pi:
        return [], None
    costs = filtered_costs(
        record,
        [Lowpass(cutoff, LEVEL_ORDER) for cutoff in cutoffs.tolist()],
        cost.coefficients,
        bounds[1],
        start=0.0 if measured.plain else bounds[1],
        svf_cutoffs=cutoffs.tolist(),
        steps=LEVEL_EFFORT,
        integrators=cost.integrators,
    )
    delays, found, minima = search_levels(costs, (0.5 * np.pi / cutoffs).tolist(), bounds)
    profile = Profile(delays, found, bandwidth, record.n_samples, float(cutoffs[0]))
    interval = measured.data[0].interval
    if interval > 0.0 and measured.plain:
        # On a regular clock the cost has a kink at every interval, and local minima between them, which are deep for
        # underparametrised models: all samples are used within an eighth of a period of the filtered minima.
        reach = max(interval, 0.25 * np.pi / bandwidth)
        parts = min(int(np.ceil(2.0 * reach / interval)), FINEST)
        minima = [finer for centre in minima for finer in _local_grid(cost, [centre], reach, parts, 1)]
    return minima, profile


def _cutoffs(bounds: tuple[float, float], bandwidth: float) -> Array:
    """Return the cut-off frequencies of the levels of a search [rad/s], lowest first."""
    cutoffs = [bandwidth]
    while (bounds[1] - bounds[0]) * cutoffs[0] / (0.5 * np.pi) > MOST_FIRST_DELAYS and len(cutoffs) < MOST_LEVELS:
        cutoffs.insert(0, cutoffs[0] / LEVEL_RATIO)
    return np.array(cutoffs)


def _search_samples(cost: RecordsCost) -> Found:
    """Search on all samples."""
    measured = cost.measured
    ((low, high),) = each_bounds(measured.treatment.delay_bounds)
    delays = quarter_periods(low, high, cost.bandwidth, MOST_DELAYS) if low < high else np.array([low])
    found = scan([cost] * delays.size, delays.tolist())
    count = sum(data.count for data in measured.data)
    chosen = found.lowest(MINIMA)
    if not chosen or delays.size == 1:
        return chosen, None
    # With held inputs that change on the sampling clock the cost has a kink at every sampling interval, and local
    # minima between the kinks: a fine grid around the coarse minima resolves a quarter of an interval.
    spacing = float(delays[1] - delays[0])
    interval = min(float(np.median(np.diff(record.t))) for record in measured.records)
    parts = int(np.clip(np.ceil(4.0 * spacing / interval), 4, FINEST))
    profile = Profile(delays, found.squared_errors / count, cost.bandwidth, count)
    return _local_grid(cost, chosen, spacing, parts, MINIMA) or chosen, profile


def _local_grid(cost: RecordsCost, centres: Sequence[Minimum], reach: float, parts: int, most: int) -> list[Minimum]:
    """Return the lowest minima on fine grids around given ones, with all samples."""
    ((low, high),) = each_bounds(cost.measured.treatment.delay_bounds)
    fine: list[Minimum] = []
    for centre in centres:
        for side in (-1, 1):
            start = centre.theta[None]
            for part in range(0 if side > 0 else 1, parts + 1):
                delay = centre.delay + side * part * reach / parts
                if low <= delay <= high:
                    found = cost.minimise(delay, start, False)
                    start = start if np.isinf(found.squared_error) else found.theta[None]
                    fine.append(found._replace(theta=np.append(found.theta[:-1], delay)))
    fine.sort(key=lambda minimum: minimum.delay)
    return [fine[k] for k in lowest_minima(np.array([minimum.squared_error for minimum in fine]), most)]
