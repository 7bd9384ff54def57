"""Output-error costs of a record behind low-pass filters as functions of the delay: compiled, on spectra."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit

from ctid_cli.arrays import Array, ComplexArray, IntArray
from ctid_cli.estimation.delay_search import Minimum, best_of, minimise
from ctid_cli.estimation.iteration import Steps, calls
from ctid_cli.estimation.spectral_problem import SpectralProblem, spectral_least_squares_start
from ctid_cli.filtering.lowpass import Lowpass
from ctid_cli.filtering.spectra import HeldSpectrum, lowpass_weight, record_spectra, window_spectrum
from ctid_cli.inference.sensitivities import Structure
from ctid_cli.signals.record import Record

#: Highest frequency, as a multiple of the highest cut-off: a filter of order 10 passes 3e-4 of the power there.
HIGHEST = 1.5
#: Frequencies above the last one whose weight exceeds this fraction of the greatest are left out.
NEGLIGIBLE_WEIGHT = 1e-6


class FilteredCosts(NamedTuple):
    """What compiled searches need of a record behind filters, the spectra of which they share."""

    #: Frequencies [rad/s], shape (K,).
    frequencies: Array
    outputs: ComplexArray
    input: HeldSpectrum
    #: ``|L|^2`` of each filter, shape (filters, K), and at how many frequencies it matters, shape (filters,).
    weights: Array
    reach: IntArray
    #: Cut-off of the state-variable filter of the least-squares start [rad/s], shape (filters,).
    svf_cutoffs: Array
    #: Mean square of the filtered output less its mean [output unit^2], shape (filters,).
    spreads: Array
    poles: int
    zeros: int
    #: How hard to work at each delay.
    steps: Steps

    @property
    def size(self) -> int:
        """Number of parameters, the delay included."""
        return self.poles + self.zeros + 2

    def behind(self, k: int) -> "FilteredCost":
        """The cost of one filter."""
        return FilteredCost(self, k)


class FilteredCost(NamedTuple):
    """The cost behind one filter of several."""

    costs: FilteredCosts
    filter: int

    @property
    def size(self) -> int:
        """Number of parameters, the delay included."""
        return self.costs.size

    def minimise(self, delay: float, starts: Array, own: bool) -> Minimum:
        """Least cost at a delay over starts of any delay and, if asked for, from least squares."""
        found: Minimum = _minimise(self, delay, starts, own)
        return found


def percents(squared_errors: Array, spreads: Array | float) -> Array:
    """``100 ||y - x|| / ||y - mean y||`` of filtered data [%]; 100 where nothing could be computed."""
    return np.where(np.isfinite(squared_errors), 100.0 * np.sqrt(squared_errors / spreads), 100.0)


def filtered_costs(
    record: Record,
    lowpasses: Sequence[Lowpass],
    structure: Structure,
    greatest_delay: float,
    *,
    start: float,
    svf_cutoffs: Array,
    steps: Steps,
) -> FilteredCosts:
    """Costs of one record behind filters; samples earlier than ``start`` after the first input are not used."""
    highest = HIGHEST * max(lowpass.cutoff for lowpass in lowpasses)
    spectra = record_spectra(record, start, highest, greatest_delay)
    w = spectra.frequencies
    weights = np.array([lowpass_weight(w, lowpass) for lowpass in lowpasses])
    reach = (weights >= NEGLIGIBLE_WEIGHT * weights.max(axis=1, keepdims=True)).sum(axis=1)
    spreads = weights @ (np.where(w > 0.0, 2.0, 0.0) * np.abs(spectra.outputs) ** 2)
    sizes = structure.poles, structure.zeros
    return FilteredCosts(w, spectra.outputs, spectra.input, weights, reach, svf_cutoffs, spreads, *sizes, steps)


@njit(cache=True, nogil=True, inline="always")
def _least(costs: FilteredCosts, k: int, inputs: ComplexArray, delay: float, starts: Array, own: bool) -> Minimum:
    """Least cost of one filter over the denominators of starts, with the spectrum of the delayed input."""
    reach = costs.reach[k]
    problem = SpectralProblem(
        costs.frequencies[:reach],
        costs.outputs[:reach],
        inputs[:reach],
        costs.weights[k, :reach],
        costs.poles,
        costs.zeros,
    )
    count = starts.shape[0]
    tried = np.empty((count + 1, starts.shape[1]))
    tried[:count] = starts
    if own:
        solved, tried[count] = spectral_least_squares_start(problem, costs.svf_cutoffs[k])
        count += solved
    tried[:, -1] = delay
    return best_of(problem, tried[:count], costs.poles, costs.steps)


@njit(cache=True, nogil=True)
def _minimise(cost: FilteredCost, delay: float, starts: Array, own: bool) -> Minimum:
    """See `FilteredCost.minimise`."""
    costs, k = cost.costs, cost.filter
    inputs = window_spectrum(costs.input, delay, np.ones(costs.reach[k] - 1))
    return _least(costs, k, inputs, delay, starts, own)


calls(minimise, FilteredCost, _minimise)


@njit(cache=True, nogil=True)
def minima_behind_all(costs: FilteredCosts, delay: float) -> tuple[Array, Array]:
    """Coefficients and squared error behind every filter, the narrowest band first.

    Good coefficients are handed from filter to filter, down to the narrowest band and up again.
    """
    many = costs.reach.size
    thetas, squared_errors = np.zeros((many, costs.poles + costs.zeros + 2)), np.full(many, np.inf)
    inputs = window_spectrum(costs.input, delay, np.ones(costs.reach.max() - 1))
    for k in range(many - 1, -1, -1):
        # Least squares on a narrow band is hopeless in noise: the next wider band knows the system better.
        known = k + 1 < many and np.isfinite(squared_errors[k + 1])
        found = _least(costs, k, inputs, delay, thetas[k + 1 : k + 1 + known], not known)
        thetas[k], squared_errors[k] = found.theta, found.squared_error
    for k in range(1, many):
        if np.isfinite(squared_errors[k - 1]):
            found = _least(costs, k, inputs, delay, thetas[k - 1 : k], False)
            if found.squared_error < squared_errors[k]:
                thetas[k], squared_errors[k] = found.theta, found.squared_error
    return thetas, squared_errors
