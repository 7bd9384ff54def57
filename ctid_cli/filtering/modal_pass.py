"""The compiled pass in modal form, for simple poles: over any clock, each mode by itself.

The standard rows are sums of partial fractions: the pass advances, for one pole p of each pair,
``z = 1/(s - p) u``, ``w = 1/(s - p)^2 u`` and ``e = 1/(s - p) y``, and forms the internal rows
``[z(t_k - tau), w(t_k - tau), u(t_k - tau), e(t_k), y_k - x_k]``, real and imaginary part of a mode as two rows.
"""

import numpy as np
from numba import njit

from ctid_cli.arrays import Array, ComplexArray
from ctid_cli.filtering.filter_data import FilterData, clock_slack, split_delay
from ctid_cli.filtering.irregular_blocks import STATES, clock_block, input_mode, next_block, output_mode, read_mode
from ctid_cli.filtering.mode_blocks import (
    Clock,
    Source,
    first_rows,
    held_block,
    keep_used,
    mode_block,
    output_block,
    value_block,
)
from ctid_cli.filtering.row_sink import BLOCK, RowSink, emit, finish
from ctid_cli.filtering.step_weights import CHANGE, VALUE, all_weights


@njit(cache=True, nogil=True)
def _subtract_output(residue: complex, rows: Array, count: int, errors: Array) -> None:
    """Take what a mode makes of the input, ``Re(residue z)``, from the output."""
    real, re, im = rows[0], residue.real, residue.imag
    imaginary = rows[-1]
    if rows.shape[0] == 1:
        im = 0.0
    for k in range(count):
        errors[k] -= re * real[k] - im * imaginary[k]


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
            row, paired = first[i], poles[i].imag != 0.0
            mode_block(clock, i, source, held, count, states[i], row, paired, block)
            output_block(
                whole[i], outputs, before, start > 0, data.y_foh, states[i], 2 * n + 1 + row, paired, count, block
            )
            _subtract_output(residues[i], block[row : first[i + 1]], count, errors)
        written = emit(sink, keep_used(data.use, start, count, block), written)
    finish(sink, 0, written)


@njit(cache=True, nogil=True)
def irregular_modal_pass(
    poles: ComplexArray, residues: ComplexArray, delay: float, data: FilterData, sink: RowSink
) -> None:
    """Pass over an irregular clock; ``x = sum Re(residue z)`` is the model output."""
    first = first_rows(poles)
    n = first[poles.size]
    block, errors, value = sink.block, sink.block[3 * n + 1], sink.block[2 * n]
    slack = clock_slack(data)
    clock, at_breaks = clock_block(), np.zeros(STATES)
    states = np.zeros((poles.size, 3), np.complex128)
    start, last, written = 0, -1, 0
    while start < data.y.size:
        count, reached, longest = next_block(data, delay, slack, start, last, clock)
        for k in range(count):
            value[k] = clock.late[VALUE + k] + clock.late[CHANGE + k]
            errors[k] = data.y[start + k]
        for i in range(poles.size):
            pole, row, end = poles[i], first[i], first[i + 1]
            rows = block[row:end]
            input_mode(pole, longest, clock, reached, states[i], at_breaks)
            read_mode(pole, longest, clock, count, at_breaks, rows, block[n + row : n + end])
            output_mode(pole, longest, clock, count, states[i], block[2 * n + 1 + row : 2 * n + 1 + end])
            _subtract_output(residues[i], rows, count, errors)
        written = emit(sink, keep_used(data.use, start, count, block), written)
        start, last = start + count, last + reached
    finish(sink, 0, written)
