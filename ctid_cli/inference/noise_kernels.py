"""Compiled recursions of noise models: autoregressions, and innovations of ARMA models."""

import numpy as np
from numba import njit

from ctid_cli.arrays import Array, IntArray


@njit(cache=True, nogil=True)
def autoregress(columns: Array, coefficients: Array) -> None:
    """Filter columns by ``1/c(q)`` in place; the first r rows are outputs already."""
    r = coefficients.size - 1
    for t in range(r, columns.shape[0]):
        # Row by row, for contiguous memory access.
        for i in range(1, r + 1):
            for j in range(columns.shape[1]):
                columns[t, j] -= coefficients[i] * columns[t - i, j]


@njit(cache=True, nogil=True)
def filter_innovations(
    rows: Array, steps: IntArray, denominator: Array, gain: Array, states: Array, covariance: Array, after: Array
) -> float:
    """Replace rows by their innovations over standard deviations, and update states and covariance, in place.

    ``steps`` are the intervals of the clock from the previous sample to each sample, 0 or 1 at the first one. F is a
    shift matrix with the negative denominator ``d_1 ... d_r`` in its first column. Returns the sum of the logarithms of
    the variances; ``after``, unless empty, gets the predicted states of the first row.
    """
    r, logarithms, known = gain.size, 0.0, False
    # A column and a row of zeros avoid branches at the ends.
    moved, feedback, old = np.zeros((r + 1, r + 1)), gain.copy(), np.zeros(r + 1)
    for t in range(steps.size):
        # Intervals without a sample, then one with it, which ends with the prediction of the next.
        for left in range(max(steps[t], 1) - 1, -1, -1):
            variance = 1.0
            if not known or left:
                if r:
                    variance += covariance[0, 0]
                for i in range(r):
                    for j in range(r):
                        moved[i, j] = covariance[i, j]
                for i in range(r):
                    feedback[i] = (moved[i + 1, 0] - denominator[i] * moved[0, 0] + gain[i]) / variance
                largest = 0.0
                for i in range(r):
                    for j in range(r):
                        value = (
                            moved[i + 1, j + 1] - denominator[j] * moved[i + 1, 0] - denominator[i] * moved[0, j + 1]
                        )
                        value += denominator[i] * denominator[j] * moved[0, 0] + gain[i] * gain[j]
                        if not left:
                            value -= variance * feedback[i] * feedback[j]
                        covariance[i, j] = value
                        largest = max(largest, abs(value))
                # A known state stays known until a sample is missing.
                known = not left and largest < 1e-14
            for k in range(rows.shape[0]):
                for i in range(r):
                    old[i] = states[i, k]
                innovation = 0.0 if left else rows[k, t] - old[0]
                for i in range(r):
                    states[i, k] = old[i + 1] - denominator[i] * old[0] + feedback[i] * innovation
                if not left:
                    rows[k, t] = innovation / variance**0.5
        logarithms += np.log(variance)
        for i in range(after.shape[1] if after.size else 0):
            after[t, i] = states[i, 0]
    return logarithms
