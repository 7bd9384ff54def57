"""The compiled pass in modal form, for simple poles: over any clock, each mode by itself.

The standard rows are sums of partial fractions: the pass advances, for one pole p of each pair,
``z = 1/(s - p) u``, ``w = 1/(s - p)^2 u`` and ``e = 1/(s - p) y``, and forms the internal rows
``[z(t_k - tau), w(t_k - tau), u(t_k - tau), e(t_k), y_k - x_k]``, real and imaginary part of a mode as two rows.
"""

import numpy as np
from numba import njit

from ctid_cli.arrays import Array, ComplexArray
from ctid_cli.filtering.filter_data import FilterData, clock_slack, split_delay
from ctid_cli.filtering.mode_blocks import (
    Clock,
    Source,
    StepWeights,
    all_weights,
    first_rows,
    held_block,
    keep_used,
    mode_block,
    output_block,
    step_weights,
    value_block,
)
from ctid_cli.filtering.row_sink import BLOCK, RowSink, emit, finish


@njit(cache=True, nogil=True)
def regular_modal_pass(
    poles: ComplexArray, residues: ComplexArray, delay: float, data: FilterData, sink: RowSink
) -> None:
    """Pass over a regular clock, block by block and mode by mode; ``x = sum Re(residue z)`` is the model output."""
    first = first_rows(poles)
    n = first[poles.size]
    y, block, errors = data.y, sink.block, sink.block[3 * n + 1]
    shift, fraction = split_delay(delay, data.interval)
    whole, part = all_weights(poles, data.interval), all_weights(poles, data.interval * fraction)
    clock = Clock(data.interval, shift, fraction, whole, part)
    source = Source(data.u, data.input_foh, 0, n, -1, 2 * n)
    states = np.zeros((poles.size, 3), np.complex128)
    written = 0
    for start in range(0, y.size, BLOCK):
        count = min(BLOCK, y.size - start)
        held = held_block(source, start - shift, count)
        outputs, before = y[start : start + count], y[max(start - 1, 0)]
        value_block(clock, source, held, count, block)
        for k in range(count):
            errors[k] = outputs[k]
        for i in range(poles.size):
            row, paired, re, im = first[i], poles[i].imag != 0.0, residues[i].real, residues[i].imag
            mode_block(clock, i, source, held, count, states[i], row, paired, block)
            output_block(
                whole[i], outputs, before, start > 0, data.y_foh, states[i], 2 * n + 1 + row, paired, count, block
            )
            rows_re, rows_im = block[row], block[row + 1]
            if not paired:
                im = 0.0
            for k in range(count):
                errors[k] -= re * rows_re[k] - im * rows_im[k]
        written = emit(sink, keep_used(data.use, start, count, block), written)
    finish(sink, 0, written)


@njit(cache=True, nogil=True)
def _stored(weights: ComplexArray) -> StepWeights:
    """Weights of one mode as they were written."""
    return StepWeights(weights[0], weights[1], weights[2], weights[3], weights[4], weights[5])


@njit(cache=True, nogil=True)
def _advance(weights: StepWeights, z: complex, w: complex, start: float, change: float) -> tuple[complex, complex]:
    """Z and w after a step with the input linear from start to start + change."""
    return (
        weights.decay * z + (weights.z_start * start + weights.z_change * change),
        (weights.decay * w + weights.mixed * z) + (weights.w_start * start + weights.w_change * change),
    )


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
def _put(block: Array, row: int, column: int, value: complex, paired: bool) -> int:
    """Write the state of a mode, that of a pair with its imaginary part below the real one; returns the next row."""
    block[row, column] = value.real
    if not paired:
        return row + 1
    block[row + 1, column] = value.imag
    return row + 2


@njit(cache=True, nogil=True)
def irregular_modal_pass(
    poles: ComplexArray, residues: ComplexArray, delay: float, data: FilterData, sink: RowSink
) -> None:
    """Pass over an irregular clock; ``x = sum Re(residue z)`` is the model output."""
    modes = poles.size
    n = first_rows(poles)[modes]
    tu, u, t, y, use = data.tu, data.u, data.t, data.y, data.use
    input_foh, y_foh = data.input_foh, data.y_foh
    block = sink.block
    z, w, e = np.zeros(modes, np.complex128), np.zeros(modes, np.complex128), np.zeros(modes, np.complex128)
    slack = clock_slack(data)
    # Where input and output share a clock, the weights of the output's steps serve the input when it gets there: a
    # ring that spans the delay, not the record.
    share = data.common_clock
    ring = 1 + _longest_lag(t, delay, slack) if share else 0
    memory = np.zeros((ring, modes, 6), np.complex128)
    filled, written = 0, 0
    j = -1  # the last break that has been reached
    for k in range(t.size):
        # The input's states up to the last break not after t_k - tau.
        instant = t[k] - delay
        while j + 1 < tu.size and tu[j + 1] <= instant + slack:
            if j >= 0:
                change = u[j + 1] - u[j] if input_foh else 0.0
                for i in range(modes):
                    weights = _stored(memory[j % ring, i]) if share else step_weights(poles[i], tu[j + 1] - tu[j])
                    z[i], w[i] = _advance(weights, z[i], w[i], u[j], change)
            j += 1
        if use[k]:
            x, value = 0.0, 0.0
            if j >= 0:
                # Read out on the way to the next break; the states stay at this one.
                step = max(0.0, instant - tu[j])
                change = 0.0
                if input_foh and j + 1 < tu.size:
                    change = (u[j + 1] - u[j]) * (step / (tu[j + 1] - tu[j]))
                value = u[j] + change
                row = 0
                for i in range(modes):
                    z_now, w_now = z[i], w[i]
                    if step > 0.0:
                        z_now, w_now = _advance(step_weights(poles[i], step), z_now, w_now, u[j], change)
                    x += residues[i].real * z_now.real - residues[i].imag * z_now.imag
                    paired = poles[i].imag != 0.0
                    _put(block, n + row, filled, w_now, paired)
                    row = _put(block, row, filled, z_now, paired)
            else:
                for i in range(2 * n):
                    block[i, filled] = 0.0
            block[2 * n, filled] = value
            row = 2 * n + 1
            for i in range(modes):
                row = _put(block, row, filled, e[i], poles[i].imag != 0.0)
            block[row, filled] = y[k] - x
            filled += 1
            if filled == BLOCK:
                written = emit(sink, filled, written)
                filled = 0
        if k + 1 < t.size:
            change = y[k + 1] - y[k] if y_foh else 0.0
            for i in range(modes):
                weights = step_weights(poles[i], t[k + 1] - t[k])
                if share:
                    for m, weight in enumerate(weights):
                        memory[k % ring, i, m] = weight
                e[i] = weights.decay * e[i] + (weights.z_start * y[k] + weights.z_change * change)
    finish(sink, filled, written)
