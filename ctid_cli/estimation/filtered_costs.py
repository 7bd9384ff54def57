"""Output-error costs of a record behind low-pass filters as functions of the delay, on spectra."""

from collections.abc import Iterable, Sequence
from math import comb
from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array, ComplexArray, IntArray
from ctid_cli.estimation.delay_search import Minimum
from ctid_cli.estimation.iteration import Steps, solve_scaled
from ctid_cli.estimation.sampled_problem import reflect_unstable
from ctid_cli.filtering.lowpass import Lowpass
from ctid_cli.filtering.spectra import HeldSpectrum, lowpass_weight, record_spectra
from ctid_cli.filtering.spectral_kernels import least_cost, projected_moments
from ctid_cli.inference.sensitivities import Structure
from ctid_cli.signals.record import Record

#: Highest frequency, as a multiple of the highest cut-off: a filter of order 10 passes 3e-4 of the power there.
HIGHEST = 1.5
#: Frequencies above the last one whose weight exceeds this fraction of the greatest are left out.
NEGLIGIBLE_WEIGHT = 1e-6


class FilteredCosts(NamedTuple):
    """What searches need of a record behind filters, the spectra of which they share."""

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
    #: Poles at the origin besides; with any the mean is left out.
    integrators: int
    #: How hard to work at each delay.
    steps: Steps

    @property
    def size(self) -> int:
        """Number of parameters, the delay included."""
        return self.poles + self.zeros + 2

    def behind(self, k: int) -> "FilteredCost":
        """The cost of one filter."""
        return FilteredCost(self, k)

    def minima_behind_all(self, delay: float) -> tuple[Array, Array]:
        """Coefficients and squared error behind every filter, the narrowest band first.

        Good coefficients are handed from filter to filter, down to the narrowest band and up again.
        """
        many = self.reach.size
        inputs = self.inputs(delay, int(self.reach.max()))
        thetas, squared_errors = np.zeros((many, self.size)), np.full(many, np.inf)
        for k in range(many - 1, -1, -1):
            # Least squares on a narrow band is hopeless in noise: the next wider band knows the system better.
            known = k + 1 < many and bool(np.isfinite(squared_errors[k + 1]))
            found = self.least(k, inputs, delay, thetas[k + 1 : k + 1 + known], not known)
            thetas[k], squared_errors[k] = found.theta, found.squared_error
        for k in range(1, many):
            if np.isfinite(squared_errors[k - 1]):
                found = self.least(k, inputs, delay, thetas[k - 1 : k], False)
                if found.squared_error < squared_errors[k]:
                    thetas[k], squared_errors[k] = found.theta, found.squared_error
        return thetas, squared_errors

    def inputs(self, delay: float, reach: int) -> ComplexArray:
        """Spectrum of the delayed input at the first frequencies."""
        if self.integrators:
            return self.input.at(delay, np.ones(reach))[1:]
        return self.input.at(delay, np.ones(reach - 1))

    def least(self, k: int, inputs: ComplexArray, delay: float, starts: Iterable[Array], own: bool) -> Minimum:
        """Least cost of one filter over starts and, if asked for, from least squares."""
        reach = self.reach[k]
        data = self.frequencies[:reach], self.outputs[:reach], inputs[:reach], self.weights[k, :reach]
        tried = [start[:-1] for start in starts]
        if own:
            start = self._least_squares(data, self.svf_cutoffs[k])
            tried += [] if start is None else [start]
        best = Minimum(np.zeros(self.size), np.inf)
        for start in tried:
            theta, squared_error, step = least_cost(*data, start, self.poles, self.integrators, *self.effort)
            if squared_error < best.squared_error:
                best = Minimum(np.append(theta, delay), squared_error, step)
        return best

    def _least_squares(self, data: tuple[Array, ComplexArray, ComplexArray, Array], cutoff: float) -> Array | None:
        """Least-squares estimate of the coefficients with the state-variable filter ``1/(p + w)^n``.

        ``A Y = B U + T`` divided by the filter F reads ``Y = -sum (a_i - f_i) (jw)^(n-i)/F Y + B/F U + T/F``.
        """
        svf = np.array([comb(self.poles, k) * cutoff**k for k in range(self.poles + 1)])
        gram, _ = projected_moments(*data, svf, np.zeros(self.zeros + 1), self.integrators)
        lengths = np.diag(gram)
        solved, theta = solve_scaled(gram, gram[:, -1], lengths, lengths, self.size - 1)
        if not solved:
            return None
        return np.concatenate((reflect_unstable(svf + np.append(0.0, theta[: self.poles]))[1:], theta[self.poles : -2]))

    @property
    def effort(self) -> tuple[int, float, int]:
        """Most iterations, tolerance and most halvings."""
        return self.steps.max_iterations, self.steps.tolerance, self.steps.halvings


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
        inputs = self.costs.inputs(delay, int(self.costs.reach[self.filter]))
        return self.costs.least(self.filter, inputs, delay, starts, own)


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
    integrators: int = 0,
) -> FilteredCosts:
    """Costs of one record behind filters; samples earlier than ``start`` after the first input are not used."""
    highest = HIGHEST * max(lowpass.cutoff for lowpass in lowpasses)
    spectra = record_spectra(record, start, highest, greatest_delay, keep_mean=integrators == 0)
    w = spectra.frequencies
    weights = np.array([lowpass_weight(w, lowpass) for lowpass in lowpasses])
    reach = (weights >= NEGLIGIBLE_WEIGHT * weights.max(axis=1, keepdims=True)).sum(axis=1)
    spreads = weights @ (np.where(w > 0.0, 2.0, 0.0) * np.abs(spectra.outputs) ** 2)
    sizes = structure.poles, structure.zeros, integrators
    return FilteredCosts(w, spectra.outputs, spectra.input, weights, reach, svf_cutoffs, spreads, *sizes, steps)
