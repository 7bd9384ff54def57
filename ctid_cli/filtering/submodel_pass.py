"""One compiled pass over a regular record for a sum of submodels, in open or closed loop.

All submodels are driven by one held input, so their modes are *pooled*: for each pole p of any submodel the pass
advances ``z = 1/(s - p) v`` and ``w = 1/(s - p)^2 v`` of the instrument source v, and ``e = 1/(s - p)`` of what the
other submodels leave of the output, ``y - sum of the other x_l``. In open loop v is the input u. In closed loop v is
the input of the noise-free loop of the *model* with the controller, driven by the reference; the loop is simulated
within the pass, and a further ``z_u = 1/(s - p) u`` of the measured input makes the model outputs.

Everything is done block by block, mode by mode: recursions run along contiguous memory with their state in registers.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from ctid_cli.arrays import Array, BoolArray, ComplexArray, IntArray
from ctid_cli.filtering.modal_pass import step_weights
from ctid_cli.filtering.row_sink import BLOCK, accumulate


@njit(cache=True, nogil=True)
def _row_of_mode(poles: ComplexArray) -> IntArray:
    """First row of each mode: a real pole has one, a pair two."""
    places = np.zeros(poles.size + 1, np.int64)
    for i in range(poles.size):
        places[i + 1] = places[i] + (2 if poles[i].imag != 0.0 else 1)
    return places


@njit(cache=True, nogil=True)
def _mode_block(
    weights: ComplexArray,
    part: ComplexArray,
    fraction: float,
    u: Array,
    first: int,
    skip: int,
    count: int,
    input_foh: bool,
    double: bool,
    state: ComplexArray,
    single_row: int,
    double_row: int,
    paired: bool,
    block: Array,
) -> None:
    """Advance one mode, and its square, over a block; ``block[:, k]`` receives the read-out at sample k."""
    last = u.size - 1
    z_re, z_im = state[0].real, state[0].imag
    w_re, w_im = state[1].real, state[1].imag
    d_re, d_im = weights[0].real, weights[0].imag
    m_re, m_im = weights[1].real, weights[1].imag
    b_re, b_im = weights[2].real, weights[2].imag
    c_re, c_im = weights[3].real, weights[3].imag
    f_re, f_im = weights[4].real, weights[4].imag
    g_re, g_im = weights[5].real, weights[5].imag
    for k in range(skip):
        block[single_row, k] = 0.0
        if paired:
            block[single_row + 1, k] = 0.0
        if double:
            block[double_row, k] = 0.0
            if paired:
                block[double_row + 1, k] = 0.0
    for k in range(skip, count):
        j = first + k
        value = u[j]
        change = u[j + 1] - value if input_foh and j < last else 0.0
        if fraction > 0.0:
            z, w, rise = complex(z_re, z_im), complex(w_re, w_im), fraction * change
            z_now = part[0] * z + (part[2] * value + part[3] * rise)
            block[single_row, k] = z_now.real
            if paired:
                block[single_row + 1, k] = z_now.imag
            if double:
                w_now = (part[0] * w + part[1] * z) + (part[4] * value + part[5] * rise)
                block[double_row, k] = w_now.real
                if paired:
                    block[double_row + 1, k] = w_now.imag
        else:
            block[single_row, k] = z_re
            if paired:
                block[single_row + 1, k] = z_im
            if double:
                block[double_row, k] = w_re
                if paired:
                    block[double_row + 1, k] = w_im
        if double:
            new_re = (d_re * w_re - d_im * w_im) + (m_re * z_re - m_im * z_im) + (f_re * value + g_re * change)
            w_im = (d_re * w_im + d_im * w_re) + (m_re * z_im + m_im * z_re) + (f_im * value + g_im * change)
            w_re = new_re
        new_re = (d_re * z_re - d_im * z_im) + (b_re * value + c_re * change)
        z_im = (d_re * z_im + d_im * z_re) + (b_im * value + c_im * change)
        z_re = new_re
    state[0] = complex(z_re, z_im)
    state[1] = complex(w_re, w_im)


@njit(cache=True, nogil=True)
def _output_block(
    weights: ComplexArray,
    values: Array,
    before: float,
    begun: bool,
    count: int,
    foh: bool,
    state: ComplexArray,
    row: int,
    paired: bool,
    block: Array,
) -> None:
    """Advance one mode driven by samples that are joined by straight lines, or held; read it at the samples."""
    e_re, e_im = state[2].real, state[2].imag
    d_re, d_im = weights[0].real, weights[0].imag
    b_re, b_im = weights[2].real, weights[2].imag
    c_re, c_im = weights[3].real, weights[3].imag
    for k in range(count):
        if begun:
            change = values[k] - before if foh else 0.0
            new_re = (d_re * e_re - d_im * e_im) + (b_re * before + c_re * change)
            e_im = (d_re * e_im + d_im * e_re) + (b_im * before + c_im * change)
            e_re = new_re
        begun = True
        before = values[k]
        block[row, k] = e_re
        if paired:
            block[row + 1, k] = e_im
    state[2] = complex(e_re, e_im)


@njit(cache=True, nogil=True)
def _integrate(states: Array, interval: float, value: float, change: float) -> None:
    """Advance ``1/p v, 1/p^2 v, …`` over an interval, in place."""
    for m in range(states.size - 1, -1, -1):
        total = states[m]
        factor = 1.0
        for q in range(1, m + 1):
            factor *= interval / q
            total += factor * states[m - q]
        factor *= interval / (m + 1)
        states[m] = total + factor * (value + change / (m + 2))


@njit(cache=True, nogil=True)
def _integrator_block(
    interval: float,
    fraction: float,
    u: Array,
    first: int,
    skip: int,
    count: int,
    input_foh: bool,
    states: Array,
    row: int,
    block: Array,
) -> None:
    """Advance the integrals of the input over a block; read them at the samples."""
    last = u.size - 1
    now = np.zeros(states.size)
    for k in range(count):
        if k < skip:
            for m in range(states.size):
                block[row + m, k] = 0.0
            continue
        j = first + k
        value = u[j]
        change = u[j + 1] - value if input_foh and j < last else 0.0
        for m in range(states.size):
            now[m] = states[m]
        if fraction > 0.0:
            _integrate(now, fraction * interval, value, fraction * change)
        for m in range(states.size):
            block[row + m, k] = now[m]
        _integrate(states, interval, value, change)


@njit(cache=True, nogil=True, error_model="numpy")
def _loop_block(
    weights: ComplexArray,
    part: ComplexArray,
    residues: ComplexArray,
    origin: Array,
    direct: float,
    interval: float,
    fraction: float,
    shift: int,
    start: int,
    count: int,
    reference: Array,
    numerator: Array,
    denominator: Array,
    at_controller: bool,
    state: ComplexArray,
    integrals: Array,
    memory: Array,
    v: Array,
) -> None:
    """Input of the noise-free loop over a block; the states of the model are left as they are for the caller's pass."""
    modes = residues.size
    order = memory.size
    z_re, z_im = state[:, 0].real.copy(), state[:, 0].imag.copy()
    r_re, r_im = residues.real.copy(), residues.imag.copy()
    d_re, d_im = weights[:, 0].real.copy(), weights[:, 0].imag.copy()
    b_re, b_im = weights[:, 2].real.copy(), weights[:, 2].imag.copy()
    s = integrals.copy()
    now = np.zeros(s.size)
    # The controller's direct part and, if the model has one without delay, the model's close an algebraic loop.
    own = direct if shift == 0 else 0.0
    first = numerator[0]
    closing = 1.0 / (1.0 + first * own)
    for k in range(start, start + count):
        j = k - shift
        x = 0.0
        before = v[j] if 0 <= j < k else 0.0
        if j >= 0:
            if fraction > 0.0:
                for i in range(modes):
                    z_now = part[i, 0] * complex(z_re[i], z_im[i]) + part[i, 2] * before
                    x += r_re[i] * z_now.real - r_im[i] * z_now.imag
                for m in range(s.size):
                    now[m] = s[m]
                _integrate(now, fraction * interval, before, 0.0)
                for m in range(s.size):
                    x += origin[m] * now[m]
            else:
                for i in range(modes):
                    x += r_re[i] * z_re[i] - r_im[i] * z_im[i]
                for m in range(s.size):
                    x += origin[m] * s[m]
            if j < k:
                x += direct * before
        held = memory[0] if order else 0.0
        if at_controller:
            error = reference[k] - x
            value = (held + first * error) * closing
        else:
            error = -x
            value = (held + first * error + reference[k]) * closing
        v[k] = value
        if j >= 0:
            driven = value if j == k else before
            for i in range(modes):
                re = z_re[i]
                z_re[i] = (d_re[i] * re - d_im[i] * z_im[i]) + b_re[i] * driven
                z_im[i] = (d_re[i] * z_im[i] + d_im[i] * re) + b_im[i] * driven
            _integrate(s, interval, driven, 0.0)
        error -= own * value
        response = held + first * error
        for m in range(order):
            following = memory[m + 1] if m + 1 < order else 0.0
            memory[m] = numerator[m + 1] * error - denominator[m + 1] * response + following


@njit(cache=True, nogil=True)
def submodel_pass(
    poles: ComplexArray,
    owner: IntArray,
    residues: ComplexArray,
    origin: Array,
    origin_owner: int,
    direct: float,
    direct_owner: int,
    submodels: int,
    interval: float,
    shift: int,
    fraction: float,
    u: Array,
    input_foh: bool,
    y: Array,
    y_foh: bool,
    use: BoolArray,
    reference: Array,
    numerator: Array,
    denominator: Array,
    at_controller: bool,
    state: ComplexArray,
    integrals: Array,
    rows: Array,
    gram: Array,
) -> None:
    """Pass over a regular record for a sum of submodels with simple poles."""
    modes = poles.size
    places = _row_of_mode(poles)
    n = places[modes]
    order_at_origin = origin.size
    closed = reference.size > 0
    value_row = 2 * n + order_at_origin
    error_row = 3 * n + order_at_origin + 1
    extra = error_row + 1
    q = extra + (n + order_at_origin + 1 if closed else 0)
    u_modes = extra if closed else 0
    u_integrals = extra + n if closed else 2 * n
    u_value = extra + n + order_at_origin if closed else value_row
    n_samples = y.size
    whole, part = np.zeros((modes, 6), np.complex128), np.zeros((modes, 6), np.complex128)
    for i in range(modes):
        for m, weight in enumerate(step_weights(poles[i], interval)):
            whole[i, m] = weight
        if fraction > 0.0:
            for m, weight in enumerate(step_weights(poles[i], interval * fraction)):
                part[i, m] = weight
    block = np.zeros((q, BLOCK))
    outputs = np.zeros((submodels, BLOCK))
    before = np.zeros(submodels)
    v = np.zeros(n_samples if closed else 0)
    memory = np.zeros(numerator.size - 1 if closed else 0)
    u_state = np.zeros((modes, 2), np.complex128)
    written = 0
    for start in range(0, n_samples, BLOCK):
        count = min(BLOCK, n_samples - start)
        first = start - shift
        skip = min(max(-first, 0), count)
        if closed:
            _loop_block(
                whole,
                part,
                residues,
                origin,
                direct,
                interval,
                fraction,
                shift,
                start,
                count,
                reference,
                numerator,
                denominator,
                at_controller,
                state,
                integrals[0],
                memory,
                v,
            )
        for i in range(modes):
            paired = poles[i].imag != 0.0
            _mode_block(
                whole[i],
                part[i],
                fraction,
                v if closed else u,
                first,
                skip,
                count,
                input_foh,
                True,
                state[i],
                places[i],
                n + places[i],
                paired,
                block,
            )
            if closed:
                u_state[i, 0] = state[i, 3]
                _mode_block(
                    whole[i],
                    part[i],
                    fraction,
                    u,
                    first,
                    skip,
                    count,
                    False,
                    False,
                    u_state[i],
                    u_modes + places[i],
                    0,
                    paired,
                    block,
                )
                state[i, 3] = u_state[i, 0]
        if order_at_origin:
            _integrator_block(
                interval, fraction, v if closed else u, first, skip, count, input_foh, integrals[0], 2 * n, block
            )
            if closed:
                _integrator_block(interval, fraction, u, first, skip, count, False, integrals[1], u_integrals, block)
        for k in range(count):
            j = first + k
            if j < 0:
                block[value_row, k] = 0.0
                block[u_value, k] = 0.0
                continue
            change = fraction * (u[j + 1] - u[j]) if input_foh and j < u.size - 1 else 0.0
            block[u_value, k] = u[j] + change
            if closed:
                block[value_row, k] = v[j]
        for i in range(submodels):
            for k in range(count):
                outputs[i, k] = 0.0
        for i in range(modes):
            source, target = u_modes + places[i], owner[i]
            re, im = residues[i].real, residues[i].imag
            if poles[i].imag != 0.0:
                for k in range(count):
                    outputs[target, k] += re * block[source, k] - im * block[source + 1, k]
            else:
                for k in range(count):
                    outputs[target, k] += re * block[source, k]
        for m in range(order_at_origin):
            for k in range(count):
                outputs[origin_owner, k] += origin[m] * block[u_integrals + m, k]
        if direct != 0.0:
            for k in range(count):
                outputs[direct_owner, k] += direct * block[u_value, k]
        for k in range(count):
            total = y[start + k]
            for i in range(submodels):
                total -= outputs[i, k]
            block[error_row, k] = total
        # What the other submodels leave of the output.
        for i in range(submodels):
            for k in range(count):
                outputs[i, k] += block[error_row, k]
        for i in range(modes):
            _output_block(
                whole[i],
                outputs[owner[i]],
                before[owner[i]],
                start > 0,
                count,
                y_foh,
                state[i],
                value_row + 1 + places[i],
                poles[i].imag != 0.0,
                block,
            )
        for i in range(submodels):
            before[i] = outputs[i, count - 1]
        kept = 0
        for k in range(count):
            if use[start + k]:
                if kept < k:
                    for i in range(q):
                        block[i, kept] = block[i, k]
                kept += 1
        if gram.size:
            accumulate(block, kept, gram)
        if rows.size:
            for k in range(kept):
                for i in range(q):
                    rows[written + k, i] = block[i, k]
        written += kept
    for i in range(gram.shape[0]):
        for m in range(i):
            gram[i, m] = gram[m, i]
