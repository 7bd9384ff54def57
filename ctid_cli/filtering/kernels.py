"""The three compiled passes over a record: modal form on any clock, chain form on a regular and on an irregular clock.

Each pass advances the state z of a filter driven by the delayed held input and the state of a filter driven by the
measured output, reads both at the sampling instants, and forms the *internal row*
``[z(t_k - tau), input terms, filtered output, y_k - x_k]``. Rows are accumulated into their second-moment (Gram)
matrix, written out, or both. Everything that an estimator needs is a linear map of these rows.

The input state is advanced on the input's own breaks and only *read out* at ``t_k - tau``. The recursion therefore does
not depend on the delay, and on a regular clock the read-out is one constant map that need not be applied per sample.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from ctid_cli.arrays import Array, BoolArray, ComplexArray
from ctid_cli.filtering.exponential import exponential_minus_identity, place

#: Rows are collected in blocks of this many samples, so that the products run along contiguous memory.
BLOCK = 128
#: Instants closer than this fraction of the shortest interval are one instant, written with different rounding.
ROUNDING_GAP = 1e-9
#: Digits per level and Taylor degree of the chain-form transition on an irregular clock.
BASE = 16
TAYLOR_DEGREE = 5
QUANTUM_NORM = 2.0**-9
#: Below this |pole * step| the functions of a held step are summed as series, 1/(k + 2)! for k = 0 … 10; above it the
#: closed forms lose less than 1/SMALL_STEP^3 of the rounding error.
SMALL_STEP = 0.15
INVERSE_FACTORIALS = tuple(1.0 / math.factorial(k + 2) for k in range(11))


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def accumulate(block: Array, count: int, gram: Array) -> None:
    """Add the products of buffered rows to the upper triangle of a Gram matrix.

    Two rows with two others at a time: each number that is loaded enters two products, which halves the time.
    """
    q = block.shape[0]
    for i in range(0, q - 1, 2):
        left, left_next = block[i], block[i + 1]
        for j in range(i, q - 1, 2):
            right, right_next = block[j], block[j + 1]
            total, total_right, total_left, total_both = 0.0, 0.0, 0.0, 0.0
            for k in range(count):
                total += left[k] * right[k]
                total_right += left[k] * right_next[k]
                total_left += left_next[k] * right[k]
                total_both += left_next[k] * right_next[k]
            gram[i, j] += total
            gram[i, j + 1] += total_right
            gram[i + 1, j] += total_left
            gram[i + 1, j + 1] += total_both
    if q % 2 == 1:
        right = block[q - 1]
        for i in range(q):
            left = block[i]
            total = 0.0
            for k in range(count):
                total += left[k] * right[k]
            gram[i, q - 1] += total


@njit(cache=True, nogil=True)
def _emit(block: Array, filled: int, written: int, rows: Array, gram: Array) -> int:
    """Pass a block on to whatever the caller asked for; returns the number of rows written so far."""
    if gram.size:
        accumulate(block, filled, gram)
    if rows.size:
        for k in range(filled):
            for i in range(block.shape[0]):
                rows[written + k, i] = block[i, k]
    return written + filled


@njit(cache=True, nogil=True)
def _mirror(gram: Array) -> None:
    for i in range(gram.shape[0]):
        for j in range(i):
            gram[i, j] = gram[j, i]


@njit(cache=True, nogil=True)
def regular_chain_pass(
    transition: Array,
    from_value: Array,
    from_change: Array,
    output_map: Array,
    u: Array,
    input_foh: bool,
    shift: int,
    y_transition: Array,
    y_from_value: Array,
    y_from_change: Array,
    y: Array,
    y_foh: bool,
    use: BoolArray,
    output: Array,
    rows: Array,
    gram: Array,
) -> None:
    """Pass over a regular clock in chain form: any poles, repeated ones included."""
    nz, ny = from_value.size, y_from_value.size
    q = nz + 3 + ny
    n_samples = y.size
    last = u.size - 1
    block = np.zeros((q, BLOCK))
    z, z_next = np.zeros(nz), np.zeros(nz)
    w, w_next = np.zeros(ny), np.zeros(ny)
    filled, written = 0, 0
    keep_rows = gram.size > 0 or rows.size > 0
    for k in range(n_samples):
        j = k - shift
        x = 0.0
        value, change = 0.0, 0.0
        if j >= 0:
            value = u[j]
            if input_foh and j < last:
                change = u[j + 1] - value
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
                written = _emit(block, filled, written, rows, gram)
                filled = 0
        if output.size:
            output[k] = x
        if j >= 0:
            for i in range(nz):
                total = from_value[i] * value + from_change[i] * change
                for m in range(min(i + 2, nz)):
                    total += transition[i, m] * z[m]
                z_next[i] = total
            z, z_next = z_next, z
        if ny > 0 and k + 1 < n_samples:
            change = y[k + 1] - y[k] if y_foh else 0.0
            for i in range(ny):
                total = y_from_value[i] * y[k] + y_from_change[i] * change
                for m in range(min(i + 2, ny)):
                    total += y_transition[i, m] * w[m]
                w_next[i] = total
            w, w_next = w_next, w
    _emit(block, filled, written, rows, gram)
    _mirror(gram)


@njit(cache=True, nogil=True)
def shortest_gap(t: Array, tu: Array) -> float:
    """Shortest interval between neighbouring instants of either clock."""
    gap = np.inf
    for k in range(t.size - 1):
        gap = min(gap, t[k + 1] - t[k])
    for k in range(tu.size - 1):
        gap = min(gap, tu[k + 1] - tu[k])
    return gap if gap < np.inf else 0.0


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
def step_weights(pole: complex, step: float) -> tuple[complex, complex, complex, complex, complex, complex]:
    """Weights with which a mode and its square move over a step."""
    x = pole * step
    decay, value, slope = _step_functions(x)
    square = step * step
    return (
        decay,
        step * decay,
        step * (1.0 + x * value),
        step * value,
        square * (value + x * slope),
        square * slope,
    )


@njit(cache=True, nogil=True)
def _weights(stored: ComplexArray) -> tuple[complex, complex, complex, complex, complex, complex]:
    """Stored weights as the tuple that :func:`_modal_step` takes."""
    return stored[0], stored[1], stored[2], stored[3], stored[4], stored[5]


@njit(cache=True, nogil=True)
def _modal_step(
    weights: tuple[complex, complex, complex, complex, complex, complex],
    z: complex,
    w: complex,
    start: float,
    change: float,
) -> tuple[complex, complex]:
    """Advance ``z = 1/(s - p) v`` and ``w = 1/(s - p)^2 v`` over a step with v linear from start to start + change."""
    decay, mixed, z_start, z_change, w_start, w_change = weights
    return (
        decay * z + (z_start * start + z_change * change),
        (decay * w + mixed * z) + (w_start * start + w_change * change),
    )


@njit(cache=True, nogil=True)
def modal_pass(
    poles: ComplexArray,
    output_map: ComplexArray,
    interval: float,
    shift: int,
    fraction: float,
    tu: Array,
    u: Array,
    input_foh: bool,
    delay: float,
    t: Array,
    y: Array,
    y_foh: bool,
    common_clock: bool,
    use: BoolArray,
    output: Array,
    rows: Array,
    gram: Array,
) -> None:
    """Pass in modal form, for simple poles, on any clock."""
    modes = poles.size
    n = 0
    for i in range(modes):
        n += 2 if poles[i].imag != 0.0 else 1
    q = 3 * n + 2
    n_samples, n_breaks = t.size, tu.size
    regular = interval > 0.0
    block = np.zeros((q, BLOCK))
    z, w, zy = np.zeros(modes, np.complex128), np.zeros(modes, np.complex128), np.zeros(modes, np.complex128)
    # On a regular clock the weights are constants of the pass.
    at_break, at_sample = np.zeros((modes, 6), np.complex128), np.zeros((modes, 6), np.complex128)
    if regular:
        for i in range(modes):
            for k, weight in enumerate(step_weights(poles[i], interval)):
                at_break[i, k] = weight
            for k, weight in enumerate(step_weights(poles[i], interval * fraction)):
                at_sample[i, k] = weight
    share = common_clock and not regular
    # Instants that differ by rounding only are one instant.
    slack = ROUNDING_GAP * shortest_gap(t, tu)
    # Weights of the output's steps serve the input when it gets there: a ring that spans the delay, not the record.
    ring = 1 + _longest_lag(t, delay, slack) if share else 0
    memory = np.zeros((ring, modes, 6), np.complex128)
    filled, written = 0, 0
    keep_rows = gram.size > 0 or rows.size > 0
    j = -1  # the last break that has been reached
    for k in range(n_samples):
        instant = t[k] - delay
        while j + 1 < n_breaks and (j + 1 <= k - shift if regular else tu[j + 1] <= instant + slack):
            if j >= 0:
                change = u[j + 1] - u[j] if input_foh else 0.0
                for i in range(modes):
                    if regular:
                        weights = _weights(at_break[i])
                    elif share:
                        weights = _weights(memory[j % ring, i])
                    else:
                        weights = step_weights(poles[i], tu[j + 1] - tu[j])
                    z[i], w[i] = _modal_step(weights, z[i], w[i], u[j], change)
            j += 1
        used = keep_rows and use[k]
        x, value = 0.0, 0.0
        if j >= 0 and (used or output.size):
            step = fraction * interval if regular else max(0.0, instant - tu[j])
            change = 0.0
            if input_foh and j + 1 < n_breaks:
                change = (u[j + 1] - u[j]) * (fraction if regular else step / (tu[j + 1] - tu[j]))
            value = u[j] + change
            place = 0
            for i in range(modes):
                z_now, w_now = z[i], w[i]
                if step > 0.0:
                    weights = _weights(at_sample[i]) if regular else step_weights(poles[i], step)
                    z_now, w_now = _modal_step(weights, z_now, w_now, u[j], change)
                x += output_map[i].real * z_now.real - output_map[i].imag * z_now.imag
                if used:
                    block[place, filled] = z_now.real
                    block[n + place, filled] = w_now.real
                    place += 1
                    if poles[i].imag != 0.0:
                        block[place, filled] = z_now.imag
                        block[n + place, filled] = w_now.imag
                        place += 1
        elif used:
            for i in range(2 * n):
                block[i, filled] = 0.0
        if used:
            block[2 * n, filled] = value
            place = 2 * n + 1
            for i in range(modes):
                block[place, filled] = zy[i].real
                place += 1
                if poles[i].imag != 0.0:
                    block[place, filled] = zy[i].imag
                    place += 1
            block[place, filled] = y[k] - x
            filled += 1
            if filled == BLOCK:
                written = _emit(block, filled, written, rows, gram)
                filled = 0
        if output.size:
            output[k] = x
        if k + 1 < n_samples and (keep_rows or share):
            change = y[k + 1] - y[k] if y_foh else 0.0
            for i in range(modes):
                weights = _weights(at_break[i]) if regular else step_weights(poles[i], t[k + 1] - t[k])
                if share:
                    for m, weight in enumerate(weights):
                        memory[k % ring, i, m] = weight
                zy[i] = weights[0] * zy[i] + (weights[2] * y[k] + weights[3] * change)
    _emit(block, filled, written, rows, gram)
    _mirror(gram)


@njit(cache=True, nogil=True)
def transition_table(dynamics: Array, gain: Array, longest: float) -> tuple[Array, float, Array]:
    r"""Transitions over the multiples of a small quantum, digit by digit."""
    n = gain.size
    augmented = np.zeros((n + 2, n + 2))
    place(augmented, 0, 0, dynamics)
    for i in range(n):
        augmented[i, n] = gain[i]
    augmented[n, n + 1] = 1.0
    norm = 0.0
    for i in range(n + 2):
        total = 0.0
        for j in range(n + 2):
            total += abs(augmented[i, j])
        norm = max(norm, total)
    quantum = QUANTUM_NORM / norm
    levels = 1
    while quantum * float(BASE) ** levels <= longest and levels < 40:
        levels += 1
    table = np.zeros((levels, BASE, n + 2, n + 2))
    for level in range(levels):
        for digit in range(BASE):
            power = exponential_minus_identity(augmented * (digit * quantum * float(BASE) ** level))
            place(table[level, digit], 0, 0, power)
            for i in range(n + 2):
                table[level, digit, i, i] += 1.0
    return table, quantum, augmented


@njit(cache=True, nogil=True)
def _table_step(table: Array, quantum: float, augmented: Array, step: float, state: Array, work: Array) -> None:
    """Advance ``state = [z, v, v']`` by ``step``, in place."""
    size = state.size
    whole = np.floor(step / quantum)
    rest = step - whole * quantum
    level = 0
    while whole > 0.0 and level < table.shape[0]:
        shifted = np.floor(whole / BASE)
        digit = int(whole - shifted * BASE)
        if level == table.shape[0] - 1:
            digit = min(int(whole), BASE - 1)
        if digit > 0:
            for i in range(size):
                total = 0.0
                for m in range(size):
                    total += table[level, digit, i, m] * state[m]
                work[i] = total
            for i in range(size):
                state[i] = work[i]
        whole = shifted
        level += 1
    if rest > 0.0:
        term = state.copy()
        for degree in range(1, TAYLOR_DEGREE + 1):
            for i in range(size):
                total = 0.0
                for m in range(size):
                    total += augmented[i, m] * term[m]
                work[i] = total * rest / degree
            for i in range(size):
                term[i] = work[i]
                state[i] += work[i]


@njit(cache=True, nogil=True)
def irregular_chain_pass(
    dynamics: Array,
    gain: Array,
    output_map: Array,
    tu: Array,
    u: Array,
    input_foh: bool,
    delay: float,
    y_dynamics: Array,
    y_gain: Array,
    t: Array,
    y: Array,
    y_foh: bool,
    use: BoolArray,
    output: Array,
    rows: Array,
    gram: Array,
) -> None:
    """Pass over an irregular clock in chain form: any poles, repeated ones included."""
    nz, ny = gain.size, y_gain.size
    q = nz + 2 + ny
    n_samples, n_breaks = t.size, tu.size
    longest = t[-1] - t[0]
    if tu[0] < t[0]:
        longest = t[-1] - tu[0]
    if n_samples > 1:
        longest = 0.0
        for k in range(n_samples - 1):
            longest = max(longest, t[k + 1] - t[k])
        for k in range(n_breaks - 1):
            longest = max(longest, tu[k + 1] - tu[k])
        longest = max(longest, t[-1] - delay - tu[-1])
    table, quantum, augmented = transition_table(dynamics, gain, longest)
    y_table, y_quantum, y_augmented = table, quantum, augmented
    if ny > 0:
        y_table, y_quantum, y_augmented = transition_table(y_dynamics, y_gain, longest)
    block = np.zeros((q, BLOCK))
    base, now, work = np.zeros(nz + 2), np.zeros(nz + 2), np.zeros(max(nz, ny) + 2)
    filtered = np.zeros(ny + 2)
    slack = ROUNDING_GAP * shortest_gap(t, tu)
    filled, written = 0, 0
    keep_rows = gram.size > 0 or rows.size > 0
    j = -1
    for k in range(n_samples):
        instant = t[k] - delay
        while j + 1 < n_breaks and tu[j + 1] <= instant + slack:
            if j >= 0:
                _table_step(table, quantum, augmented, tu[j + 1] - tu[j], base, work)
            j += 1
            base[nz] = u[j]
            base[nz + 1] = 0.0
            if input_foh and j + 1 < n_breaks:
                base[nz + 1] = (u[j + 1] - u[j]) / (tu[j + 1] - tu[j])
        used = keep_rows and use[k]
        x = 0.0
        if j >= 0 and (used or output.size):
            for i in range(nz + 2):
                now[i] = base[i]
            _table_step(table, quantum, augmented, max(0.0, instant - tu[j]), now, work)
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
                written = _emit(block, filled, written, rows, gram)
                filled = 0
        if output.size:
            output[k] = x
        if ny > 0 and k + 1 < n_samples:
            filtered[ny] = y[k]
            filtered[ny + 1] = (y[k + 1] - y[k]) / (t[k + 1] - t[k]) if y_foh else 0.0
            _table_step(y_table, y_quantum, y_augmented, t[k + 1] - t[k], filtered, work)
    _emit(block, filled, written, rows, gram)
    _mirror(gram)
