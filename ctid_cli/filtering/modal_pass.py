"""The compiled pass in modal form, for simple poles: over any clock, each mode by itself.

The standard rows are sums of partial fractions: the pass advances, for one pole p of each pair,
``z = 1/(s - p) u``, ``w = 1/(s - p)^2 u`` and ``e = 1/(s - p) y``, and forms the internal rows
``[z(t_k - tau), w(t_k - tau), u(t_k - tau), e(t_k), y_k - x_k]``, real and imaginary part of a mode as two rows.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from ctid_cli.arrays import Array, ComplexArray, IntArray
from ctid_cli.filtering.filter_data import FilterData, clock_slack, split_delay
from ctid_cli.filtering.row_sink import BLOCK, RowSink, emit, finish

#: Below this |pole * step| the functions of a held step are summed as series, 1/(k + 2)! for k = 0 … 10; above it the
#: closed forms lose less than 1/SMALL_STEP^3 of the rounding error.
SMALL_STEP = 0.15
INVERSE_FACTORIALS = tuple(1.0 / math.factorial(k + 2) for k in range(11))


class StepWeights(NamedTuple):
    """What ``z = 1/(s - p) v`` and ``w = 1/(s - p)^2 v`` become over a step with v linear.

    ``z+ = decay z + z_start v + z_change (change of v)``, and
    ``w+ = decay w + mixed z + w_start v + w_change (change of v)``.
    """

    decay: complex
    mixed: complex
    z_start: complex
    z_change: complex
    w_start: complex
    w_change: complex


@njit(cache=True, nogil=True)
def _step_functions(x: complex) -> tuple[complex, complex, complex]:
    """``exp(x)``, ``f(x) = (exp(x) - 1 - x)/x^2`` and ``f'(x)``.

    The other functions of a held step follow: ``(exp(x) - 1)/x = 1 + x f``, with the derivative ``f + x f'``.
    """
    if x.real * x.real + x.imag * x.imag < SMALL_STEP * SMALL_STEP:
        # No cancellation, however slow the pole is against the step; and faster than an exponential.
        value, slope = complex(INVERSE_FACTORIALS[-1], 0.0), 0.0j
        for k in range(len(INVERSE_FACTORIALS) - 2, -1, -1):
            slope = slope * x + value
            value = value * x + INVERSE_FACTORIALS[k]
        return 1.0 + x * (1.0 + x * value), value, slope
    over = 1.0 / x
    decay = np.exp(x)
    value = ((decay - 1.0) * over - 1.0) * over
    return decay, value, ((decay - 1.0) * over - 2.0 * value) * over


@njit(cache=True, nogil=True)
def step_weights(pole: complex, step: float) -> StepWeights:
    """Weights of one mode over a step."""
    x = pole * step
    decay, value, slope = _step_functions(x)
    square = step * step
    return StepWeights(
        decay,
        step * decay,
        step * (1.0 + x * value),
        step * value,
        square * (value + x * slope),
        square * slope,
    )


@njit(cache=True, nogil=True)
def _stored(weights: ComplexArray) -> StepWeights:
    """Weights of one mode as they were written."""
    return StepWeights(weights[0], weights[1], weights[2], weights[3], weights[4], weights[5])


@njit(cache=True, nogil=True)
def all_weights(poles: ComplexArray, step: float) -> ComplexArray:
    """Weights of all modes over a step, shape (modes, 6)."""
    weights = np.zeros((poles.size, 6), np.complex128)
    for i in range(poles.size):
        for k, weight in enumerate(step_weights(poles[i], step)):
            weights[i, k] = weight
    return weights


@njit(cache=True, nogil=True)
def _advance(weights: StepWeights, z: complex, w: complex, start: float, change: float) -> tuple[complex, complex]:
    """Z and w after a step with the input linear from start to start + change."""
    return (
        weights.decay * z + (weights.z_start * start + weights.z_change * change),
        (weights.decay * w + weights.mixed * z) + (weights.w_start * start + weights.w_change * change),
    )


@njit(cache=True, nogil=True)
def first_rows(poles: ComplexArray) -> IntArray:
    """First row of each mode, and the number of rows: a real pole has one, a pair two."""
    first = np.zeros(poles.size + 1, np.int64)
    for i in range(poles.size):
        first[i + 1] = first[i] + (2 if poles[i].imag != 0.0 else 1)
    return first


@njit(cache=True, nogil=True)
def put(block: Array, row: int, column: int, value: complex, paired: bool) -> int:
    """Write the state of a mode, that of a pair with its imaginary part below the real one; returns the next row."""
    block[row, column] = value.real
    if not paired:
        return row + 1
    block[row + 1, column] = value.imag
    return row + 2


@njit(cache=True, nogil=True)
def _longest_lag(t: Array, delay: float, slack: float) -> int:
    """Most samples by which the delayed input is behind the output when it takes a step."""
    lag, j = 1, 0
    for k in range(t.size):
        while j + 1 < t.size and t[j + 1] <= t[k] - delay + slack:
            lag = max(lag, k - j)
            j += 1
    return lag


@njit(cache=True, nogil=True)
def modal_pass(poles: ComplexArray, residues: ComplexArray, delay: float, data: FilterData, sink: RowSink) -> None:
    """Pass over a record; ``x = sum Re(residue z)`` is the model output."""
    modes = poles.size
    n = first_rows(poles)[modes]
    interval, tu, u, t, y, use = data.interval, data.tu, data.u, data.t, data.y, data.use
    input_foh, y_foh = data.input_foh, data.y_foh
    block = sink.block
    z, w, e = np.zeros(modes, np.complex128), np.zeros(modes, np.complex128), np.zeros(modes, np.complex128)
    regular = interval > 0.0
    share = data.common_clock and not regular
    shift, fraction, slack = 0, 0.0, 0.0
    if regular:
        shift, fraction = split_delay(delay, interval)
    else:
        slack = clock_slack(data)
    # On a regular clock the weights of whole and of part steps are constants of the pass. Where input and output share
    # an irregular clock, those of the output's steps serve the input when it gets there: a ring that spans the delay,
    # not the record.
    whole, part = all_weights(poles, interval), all_weights(poles, interval * fraction)
    ring = 1 + _longest_lag(t, delay, slack) if share else 0
    memory = np.zeros((ring, modes, 6), np.complex128)
    filled, written = 0, 0
    j = -1  # the last break that has been reached
    for k in range(t.size):
        # The input's states up to the last break not after t_k - tau.
        instant = t[k] - delay
        while j + 1 < tu.size and (j + 1 <= k - shift if regular else tu[j + 1] <= instant + slack):
            if j >= 0:
                change = u[j + 1] - u[j] if input_foh else 0.0
                for i in range(modes):
                    if share:
                        weights = _stored(memory[j % ring, i])
                    else:
                        weights = _stored(whole[i]) if regular else step_weights(poles[i], tu[j + 1] - tu[j])
                    z[i], w[i] = _advance(weights, z[i], w[i], u[j], change)
            j += 1
        if use[k]:
            x, value = 0.0, 0.0
            if j >= 0:
                # Read out on the way to the next break; the states stay at this one.
                step = fraction * interval if regular else max(0.0, instant - tu[j])
                change = 0.0
                if input_foh and j + 1 < tu.size:
                    change = (u[j + 1] - u[j]) * (fraction if regular else step / (tu[j + 1] - tu[j]))
                value = u[j] + change
                row = 0
                for i in range(modes):
                    z_now, w_now = z[i], w[i]
                    if step > 0.0:
                        weights = _stored(part[i]) if regular else step_weights(poles[i], step)
                        z_now, w_now = _advance(weights, z_now, w_now, u[j], change)
                    x += residues[i].real * z_now.real - residues[i].imag * z_now.imag
                    paired = poles[i].imag != 0.0
                    put(block, n + row, filled, w_now, paired)
                    row = put(block, row, filled, z_now, paired)
            else:
                for i in range(2 * n):
                    block[i, filled] = 0.0
            block[2 * n, filled] = value
            row = 2 * n + 1
            for i in range(modes):
                row = put(block, row, filled, e[i], poles[i].imag != 0.0)
            block[row, filled] = y[k] - x
            filled += 1
            if filled == BLOCK:
                written = emit(sink, filled, written)
                filled = 0
        if k + 1 < t.size:
            change = y[k + 1] - y[k] if y_foh else 0.0
            for i in range(modes):
                weights = _stored(whole[i]) if regular else step_weights(poles[i], t[k + 1] - t[k])
                if share:
                    for m, weight in enumerate(weights):
                        memory[k % ring, i, m] = weight
                e[i] = weights.decay * e[i] + (weights.z_start * y[k] + weights.z_change * change)
    finish(sink, filled, written)
