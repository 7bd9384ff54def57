"""The two compiled passes in chain form, for any poles: over a regular clock, and over an irregular one.

Each pass advances the state z of a filter driven by the delayed held input and the state w of a filter driven by the
measured output, reads both at the sampling instants, and forms the *internal row*
``[z(t_k - tau), input terms, w(t_k), y_k - x_k]``. Everything that an estimator needs is a linear map of these rows.
The filter of the output is the head of the filter of the input, its first ``order`` states.

The input state is advanced on the input's own breaks and only *read out* at ``t_k - tau``. The recursion therefore does
not depend on the delay, and on a regular clock the read-out is one constant map that need not be applied per sample.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from ctid_cli.arrays import Array, IntArray
from ctid_cli.filtering.exponential import HeldStep, exponential_minus_identity, multiply, place, row_norm
from ctid_cli.filtering.filter_data import FilterData, clock_slack
from ctid_cli.filtering.row_sink import BLOCK, RowSink, emit, finish

#: Digits per level and Taylor degree of the transitions on an irregular clock.
BASE = 16
TAYLOR_DEGREE = 6
QUANTUM_NORM = 2.0**-7


@njit(cache=True, nogil=True)
def _advance(step: HeldStep, value: float, change: float, state: Array, following: Array) -> None:
    """One held step of the first states of a chain, whose transition is zero above the first superdiagonal."""
    size = state.size
    for i in range(size):
        total = step.from_value[i] * value + step.from_change[i] * change
        for m in range(min(i + 2, size)):
            total += step.transition[i, m] * state[m]
        following[i] = total


@njit(cache=True, nogil=True)
def regular_chain_pass(step: HeldStep, output_map: Array, shift: int, data: FilterData, sink: RowSink) -> None:
    """Pass over a regular clock: rows ``[z, u, change of u, w, y - x]`` at the breaks, ``shift`` samples late.

    The fraction of an interval that the delay leaves is in the caller's maps of z, u and its change.
    """
    u, y, use, block, output = data.u, data.y, data.use, sink.block, sink.output
    # The width of the rows tells how many of them are filters of the output: none where no row is wanted.
    nz = step.from_value.size
    ny = max(block.shape[0] - nz - 3, 0)
    last = u.size - 1
    z, z_next = np.zeros(nz), np.zeros(nz)
    w, w_next = np.zeros(ny), np.zeros(ny)
    filled, written = 0, 0
    keep_rows = sink.gram.size > 0 or sink.rows.size > 0
    # Two arrays for each state, exchanged after a step: the sum for one entry needs all old ones.
    for k in range(y.size):
        # The input that arrives now left at sample j; before the first one the filter is at rest.
        j = k - shift
        x, value, change = 0.0, 0.0, 0.0
        if j >= 0:
            value = u[j]
            if data.input_foh and j < last:
                change = u[j + 1] - value
            # x at the instant that arrives, by the caller's read-out map of the states and the held input.
            x = output_map[nz] * value + output_map[nz + 1] * change
            for i in range(nz):
                x += output_map[i] * z[i]
        if keep_rows and use[k]:
            for i in range(nz):
                block[i, filled] = z[i]
            block[nz, filled] = value
            block[nz + 1, filled] = change
            for i in range(ny):
                block[nz + 2 + i, filled] = w[i]
            block[nz + 2 + ny, filled] = y[k] - x
            filled += 1
            if filled == BLOCK:
                written = emit(sink, filled, written)
                filled = 0
        if output.size:
            output[k] = x
        # Read first, then step on: row k holds the states at sample k.
        if j >= 0:
            _advance(step, value, change, z, z_next)
            z, z_next = z_next, z
        if ny > 0 and k + 1 < y.size:
            _advance(step, y[k], y[k + 1] - y[k] if data.y_foh else 0.0, w, w_next)
            w, w_next = w_next, w
    finish(sink, filled, written)


class _Transitions(NamedTuple):
    """Transitions of ``[z, v, v']`` over any step: digits of its whole quanta in base 16, then a Taylor polynomial."""

    #: exp(M digit BASE^level quantum), shape (levels, BASE, n + 2, n + 2).
    powers: Array
    quantum: float
    #: Entries that are not zero of M, the dynamics with the held signal and its slope as states, row by row: where each
    #: row begins, the columns, and the values.
    starts: IntArray
    columns: IntArray
    values: Array


@njit(cache=True, nogil=True)
def _transitions(dynamics: Array, gain: Array, longest: float) -> _Transitions:
    """Table for all steps up to the longest."""
    # [z, v, v']' = M [z, v, v'] with v' constant over a step: no separate integrals of the input are needed.
    n = gain.size
    augmented = np.zeros((n + 2, n + 2))
    place(augmented, 0, 0, dynamics)
    for i in range(n):
        augmented[i, n] = gain[i]
    augmented[n, n + 1] = 1.0
    starts = np.zeros(n + 3, dtype=np.int64)
    columns, values = np.zeros((n + 2) * (n + 2), dtype=np.int64), np.zeros((n + 2) * (n + 2))
    for i in range(n + 2):
        starts[i + 1] = starts[i]
        for j in range(n + 2):
            if augmented[i, j] != 0.0:
                columns[starts[i + 1]], values[starts[i + 1]] = j, augmented[i, j]
                starts[i + 1] += 1
    # Within a quantum the Taylor remainder, (2^-7)^7/7!, is below rounding.
    quantum = QUANTUM_NORM / row_norm(augmented)
    levels = 1
    while quantum * float(BASE) ** levels <= longest and levels < 40:
        levels += 1
    powers, product = np.zeros((levels, BASE, n + 2, n + 2)), np.empty((n + 2, n + 2))
    for level in range(levels):
        first = exponential_minus_identity(augmented * (quantum * float(BASE) ** level))
        power = np.zeros((n + 2, n + 2))
        for digit in range(BASE):
            place(powers[level, digit], 0, 0, power)
            for i in range(n + 2):
                powers[level, digit, i, i] += 1.0
            # (I + X)(I + Y) - I = X + Y + X Y, which keeps the digits of slow modes beside a fast one.
            multiply(power, first, product)
            for i in range(n + 2):
                for j in range(n + 2):
                    power[i, j] += first[i, j] + product[i, j]
    return _Transitions(powers, quantum, starts, columns, values)


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _step(table: _Transitions, step: float, state: Array, work: Array) -> None:
    """Advance ``state = [z, v, v']`` of a chain by ``step``, in place."""
    powers = table.powers
    # Digits from the lowest up; the transitions commute. The table ends at the longest step, so that only rounding can
    # ask its last level for more than one digit.
    size = state.size
    n = size - 2
    whole = np.floor(step / table.quantum)
    rest = step - whole * table.quantum
    level = 0
    while whole > 0.0 and level < powers.shape[0]:
        shifted = np.floor(whole / BASE)
        digit = int(whole - shifted * BASE)
        if level == powers.shape[0] - 1:
            digit = min(int(whole), BASE - 1)
        if digit > 0:
            power = powers[level, digit]
            # Zero above the first superdiagonal, but for the two columns of the signal.
            for i in range(n):
                total = power[i, n] * state[n] + power[i, n + 1] * state[n + 1]
                for m in range(min(i + 2, n)):
                    total += power[i, m] * state[m]
                work[0, i] = total
            state[n] += power[n, n + 1] * state[n + 1]
            for i in range(n):
                state[i] = work[0, i]
        whole = shifted
        level += 1
    # What is left of a quantum: sum of (M rest)^d/d! applied to the state, term from term; M is nearly empty.
    if rest > 0.0:
        starts, columns, values = table.starts, table.columns, table.values
        term, following = work[0], work[1]
        for i in range(size):
            term[i] = state[i]
        for degree in range(1, TAYLOR_DEGREE + 1):
            for i in range(size):
                total = 0.0
                for k in range(starts[i], starts[i + 1]):
                    total += values[k] * term[columns[k]]
                following[i] = total * rest / degree
            for i in range(size):
                state[i] += following[i]
            term, following = following, term


@njit(cache=True, nogil=True)
def _longest_step(t: Array, tu: Array, delay: float) -> float:
    """Longest step that a pass takes, on either clock or from the last break to the last sample."""
    longest = 0.0
    for k in range(t.size - 1):
        longest = max(longest, t[k + 1] - t[k])
    for k in range(tu.size - 1):
        longest = max(longest, tu[k + 1] - tu[k])
    return float(max(longest, t[-1] - delay - tu[-1]))


@njit(cache=True, nogil=True)
def irregular_chain_pass(
    dynamics: Array, gain: Array, output_map: Array, delay: float, data: FilterData, sink: RowSink
) -> None:
    """Pass over an irregular clock: rows ``[z, u, w, y - x]``; clocks and delay in the time unit of the dynamics."""
    tu, u, t, y, use = data.tu, data.u, data.t, data.y, data.use
    block, output = sink.block, sink.output
    nz = gain.size
    ny = max(block.shape[0] - nz - 2, 0)
    longest = _longest_step(t, tu, delay)
    table = _transitions(dynamics, gain, longest)
    output_table = table
    if ny > 0:
        output_table = _transitions(dynamics[:ny, :ny].copy(), gain[:ny].copy(), longest)
    # z at the last break, and at the instant read; both with the input and its slope behind them, as w with y.
    base, now, work = np.zeros(nz + 2), np.zeros(nz + 2), np.zeros((2, nz + 2))
    filtered = np.zeros(ny + 2)
    slack = clock_slack(data)
    filled, written = 0, 0
    keep_rows = sink.gram.size > 0 or sink.rows.size > 0
    j = -1  # the last break that has been reached
    for k in range(t.size):
        # Breaks up to the instant whose input arrives now; one that is later by rounding only is taken with them.
        instant = t[k] - delay
        while j + 1 < tu.size and tu[j + 1] <= instant + slack:
            if j >= 0:
                _step(table, tu[j + 1] - tu[j], base, work)
            j += 1
            base[nz] = u[j]
            base[nz + 1] = 0.0
            if data.input_foh and j + 1 < tu.size:
                base[nz + 1] = (u[j + 1] - u[j]) / (tu[j + 1] - tu[j])
        used = keep_rows and use[k]
        x = 0.0
        if j >= 0 and (used or output.size):
            # Read out on a copy, so that the recursion does not depend on the delay.
            for i in range(nz + 2):
                now[i] = base[i]
            _step(table, max(0.0, instant - tu[j]), now, work)
            for i in range(nz):
                x += output_map[i] * now[i]
        if used:
            for i in range(nz + 1):
                block[i, filled] = now[i]
            for i in range(ny):
                block[nz + 1 + i, filled] = filtered[i]
            block[nz + 1 + ny, filled] = y[k] - x
            filled += 1
            if filled == BLOCK:
                written = emit(sink, filled, written)
                filled = 0
        if output.size:
            output[k] = x
        # w, driven by the samples themselves: held, or joined by straight lines.
        if ny > 0 and k + 1 < t.size:
            filtered[ny] = y[k]
            filtered[ny + 1] = (y[k + 1] - y[k]) / (t[k + 1] - t[k]) if data.y_foh else 0.0
            _step(output_table, t[k + 1] - t[k], filtered, work)
    finish(sink, filled, written)
