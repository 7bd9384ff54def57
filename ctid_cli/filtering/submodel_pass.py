"""One compiled pass over a regular record for a sum of submodels, in open or closed loop.

All submodels are driven by one held input, so their modes are *pooled*: for each pole p of any submodel the pass
advances ``z = 1/(s - p) v`` and ``w = 1/(s - p)^2 v`` of the instrument source v, and ``e = 1/(s - p)`` of what the
other submodels leave of the output, ``y - sum of the other x_l``. In open loop v is the input u. In closed loop v is
the input of the noise-free loop of the *model* with the controller, driven by the reference; the loop is simulated
within the pass, and a further ``z_u = 1/(s - p) u`` of the measured input makes the model outputs.

Everything is done block by block, mode by mode: recursions run along contiguous memory with their state in registers.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from ctid_cli.arrays import Array, BoolArray, ComplexArray, IntArray
from ctid_cli.filtering.filter_data import FilterData
from ctid_cli.filtering.modal_pass import all_weights, first_rows
from ctid_cli.filtering.row_sink import BLOCK, RowSink, emit, finish
from ctid_cli.filtering.submodel_map import PooledModes


class LoopData(NamedTuple):
    """The feedback around a record, laid out for the compiled pass."""

    #: Reference at the sampling instants; empty in open loop, shape (N,).
    reference: Array
    #: Controller in descending powers of q, monic, both of one length, shape (nc + 1,).
    numerator: Array
    denominator: Array
    at_controller: bool

    @property
    def closed(self) -> bool:
        """Whether there is feedback."""
        return self.reference.size > 0


class _Clock(NamedTuple):
    """A regular clock, and the weights of each mode over an interval and over the part of it that the delay leaves."""

    interval: float
    #: The delay is ``(shift - fraction) interval``.
    shift: int
    fraction: float
    #: In the order of :class:`StepWeights`, shape (modes, 6).
    whole: ComplexArray
    part: ComplexArray


class _Source(NamedTuple):
    """An input, held or joined by straight lines, and the rows of its block that it fills."""

    values: Array
    foh: bool
    #: First of the rows of the modes, of their squares (-1: none), of the integrals, and of the input itself.
    single: int
    double: int
    integrals: int
    value: int


class _Span(NamedTuple):
    """A block: sample k of ``length`` sees the input from break ``first + k`` on, the first ``skip`` none."""

    first: int
    skip: int
    length: int


@njit(cache=True, nogil=True)
def _mode_block(
    clock: _Clock, mode: int, source: _Source, span: _Span, state: ComplexArray, row: int, paired: bool, block: Array
) -> None:
    """Advance one mode, and its square, over a block; column k receives the read-out at sample k.

    In real arithmetic, so that the state stays in registers: decay d, mixed m, and as weights of the value and of its
    change b and c of the mode, f and g of its square. ``row`` is the mode's among those of all modes.
    """
    weights, part, fraction, u = clock.whole[mode], clock.part[mode], clock.fraction, source.values
    last = u.size - 1
    double = source.double >= 0
    single_row, double_row = source.single + row, source.double + row
    z_re, z_im = state[0].real, state[0].imag
    w_re, w_im = 0.0, 0.0
    if double:
        w_re, w_im = state[1].real, state[1].imag
    d_re, d_im = weights[0].real, weights[0].imag
    m_re, m_im = weights[1].real, weights[1].imag
    b_re, b_im = weights[2].real, weights[2].imag
    c_re, c_im = weights[3].real, weights[3].imag
    f_re, f_im = weights[4].real, weights[4].imag
    g_re, g_im = weights[5].real, weights[5].imag
    for k in range(span.skip):
        block[single_row, k] = 0.0
        if paired:
            block[single_row + 1, k] = 0.0
        if double:
            block[double_row, k] = 0.0
            if paired:
                block[double_row + 1, k] = 0.0
    for k in range(span.skip, span.length):
        j = span.first + k
        value = u[j]
        change = u[j + 1] - value if source.foh and j < last else 0.0
        # Read out a fraction of an interval after the break, then advance from the break itself.
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
        # The square first: it is driven by the mode before its step.
        if double:
            new_re = (d_re * w_re - d_im * w_im) + (m_re * z_re - m_im * z_im) + (f_re * value + g_re * change)
            w_im = (d_re * w_im + d_im * w_re) + (m_re * z_im + m_im * z_re) + (f_im * value + g_im * change)
            w_re = new_re
        new_re = (d_re * z_re - d_im * z_im) + (b_re * value + c_re * change)
        z_im = (d_re * z_im + d_im * z_re) + (b_im * value + c_im * change)
        z_re = new_re
    state[0] = complex(z_re, z_im)
    if double:
        state[1] = complex(w_re, w_im)


@njit(cache=True, nogil=True)
def _output_block(
    weights: ComplexArray,
    values: Array,
    before: float,
    begun: bool,
    foh: bool,
    state: ComplexArray,
    row: int,
    paired: bool,
    count: int,
    block: Array,
) -> None:
    """Advance the mode ``e``, driven by samples that are joined by straight lines, or held; read it at the samples.

    The step up to a sample needs the sample before it: of the last block, and of none at the very first.
    """
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
    # 1/p^(m + 1) v gains (step)^q/q! of each integral below it and the integral of the line; the highest first, from
    # the lower ones before the step.
    for m in range(states.size - 1, -1, -1):
        total = states[m]
        factor = 1.0
        for q in range(1, m + 1):
            factor *= interval / q
            total += factor * states[m - q]
        factor *= interval / (m + 1)
        states[m] = total + factor * (value + change / (m + 2))


@njit(cache=True, nogil=True)
def _input_block(
    modes: PooledModes,
    first: IntArray,
    clock: _Clock,
    source: _Source,
    span: _Span,
    states: ComplexArray,
    integrals: Array,
    block: Array,
) -> None:
    """Advance all modes and integrals of an input over a block, and write it at the samples too."""
    u, fraction, row = source.values, clock.fraction, source.integrals
    for i in range(first.size - 1):
        _mode_block(clock, i, source, span, states[i], first[i], modes.poles[i].imag != 0.0, block)
    now = np.zeros(integrals.size)
    for k in range(span.length):
        if k < span.skip:
            for m in range(now.size):
                block[row + m, k] = 0.0
            block[source.value, k] = 0.0
            continue
        j = span.first + k
        value = u[j]
        change = u[j + 1] - value if source.foh and j < u.size - 1 else 0.0
        block[source.value, k] = value + fraction * change
        for m in range(now.size):
            now[m] = integrals[m]
        if fraction > 0.0:
            _integrate(now, fraction * clock.interval, value, fraction * change)
        for m in range(now.size):
            block[row + m, k] = now[m]
        _integrate(integrals, clock.interval, value, change)


@njit(cache=True, nogil=True, error_model="numpy")
def _loop_block(
    modes: PooledModes,
    clock: _Clock,
    loop: LoopData,
    start: int,
    count: int,
    states: ComplexArray,
    integrals: Array,
    memory: Array,
    v: Array,
) -> None:
    """Input of the noise-free loop over a block; the states of the model are left as they are for the caller's pass.

    ``memory`` is the state of the controller in its transposed direct form II.
    """
    part, fraction, order = clock.part, clock.fraction, memory.size
    z_re, z_im = states[:, 0].real.copy(), states[:, 0].imag.copy()
    r_re, r_im = modes.residues.real.copy(), modes.residues.imag.copy()
    d_re, d_im = clock.whole[:, 0].real.copy(), clock.whole[:, 0].imag.copy()
    b_re, b_im = clock.whole[:, 2].real.copy(), clock.whole[:, 2].imag.copy()
    s = integrals.copy()
    now = np.zeros(s.size)
    # The controller's direct part and, if the model has one without delay, the model's close an algebraic loop.
    own = modes.direct if clock.shift == 0 else 0.0
    first = loop.numerator[0]
    closing = 1.0 / (1.0 + first * own)
    for k in range(start, start + count):
        # x_k as far as the inputs before sample k make it.
        j = k - clock.shift
        x = 0.0
        before = v[j] if 0 <= j < k else 0.0
        if j >= 0:
            for m in range(s.size):
                now[m] = s[m]
            if fraction > 0.0:
                for i in range(z_re.size):
                    z_now = part[i, 0] * complex(z_re[i], z_im[i]) + part[i, 2] * before
                    x += r_re[i] * z_now.real - r_im[i] * z_now.imag
                _integrate(now, fraction * clock.interval, before, 0.0)
            else:
                for i in range(z_re.size):
                    x += r_re[i] * z_re[i] - r_im[i] * z_im[i]
            for m in range(s.size):
                x += modes.origin[m] * now[m]
            if j < k:
                x += modes.direct * before
        # v_k = C (r - x), or r - C x: solved for v_k where it acts on x_k itself.
        held = memory[0] if order else 0.0
        if loop.at_controller:
            error = loop.reference[k] - x
            value = (held + first * error) * closing
        else:
            error = -x
            value = (held + first * error + loop.reference[k]) * closing
        v[k] = value
        if j >= 0:
            driven = value if j == k else before
            for i in range(z_re.size):
                re = z_re[i]
                z_re[i] = (d_re[i] * re - d_im[i] * z_im[i]) + b_re[i] * driven
                z_im[i] = (d_re[i] * z_im[i] + d_im[i] * re) + b_im[i] * driven
            _integrate(s, clock.interval, driven, 0.0)
        error -= own * value
        response = held + first * error
        for m in range(order):
            following = memory[m + 1] if m + 1 < order else 0.0
            memory[m] = loop.numerator[m + 1] * error - loop.denominator[m + 1] * response + following


@njit(cache=True, nogil=True)
def _model_outputs(modes: PooledModes, first: IntArray, count: int, block: Array, outputs: Array) -> None:
    """Outputs of the submodels over a block, from the rows driven by the measured input, shape (submodels, BLOCK)."""
    layout = modes.layout
    for i in range(outputs.shape[0]):
        for k in range(count):
            outputs[i, k] = 0.0
    for i in range(modes.poles.size):
        source, target = layout.u_modes + first[i], modes.owner[i]
        re, im = modes.residues[i].real, modes.residues[i].imag
        if modes.poles[i].imag != 0.0:
            for k in range(count):
                outputs[target, k] += re * block[source, k] - im * block[source + 1, k]
        else:
            for k in range(count):
                outputs[target, k] += re * block[source, k]
    for m in range(layout.integrals):
        for k in range(count):
            outputs[modes.origin_owner, k] += modes.origin[m] * block[layout.u_integrals + m, k]
    if modes.direct != 0.0:
        for k in range(count):
            outputs[modes.direct_owner, k] += modes.direct * block[layout.u_value, k]


@njit(cache=True, nogil=True)
def _keep_used(use: BoolArray, start: int, count: int, block: Array) -> int:
    """Move the columns of the used samples to the front of a block; returns their number."""
    kept = 0
    for k in range(count):
        if use[start + k]:
            if kept < k:
                for i in range(block.shape[0]):
                    block[i, kept] = block[i, k]
            kept += 1
    return kept


@njit(cache=True, nogil=True)
def submodel_pass(
    modes: PooledModes,
    submodels: int,
    loop: LoopData,
    shift: int,
    fraction: float,
    data: FilterData,
    states: ComplexArray,
    sink: RowSink,
) -> None:
    """Pass over a regular record, with the delay ``(shift - fraction) interval``.

    ``states`` holds z, w, e and z_u of each mode, and is left as it is after the last sample, shape (modes, 4).
    """
    poles, layout, block = modes.poles, modes.layout, sink.block
    first = first_rows(poles)
    closed = loop.reference.size > 0
    clock = _Clock(
        data.interval,
        shift,
        fraction,
        all_weights(poles, data.interval),
        all_weights(poles, data.interval * fraction),
    )
    v = np.zeros(data.y.size if closed else 0)
    # The rows of psi, driven by v, and those of phi and the model output, driven by u: in open loop the same.
    foh = data.input_foh and not closed
    instruments = _Source(v if closed else data.u, foh, 0, layout.modes, 2 * layout.modes, layout.value)
    measured = _Source(data.u, foh, layout.u_modes, -1, layout.u_integrals, layout.u_value)
    integrals, memory = np.zeros((2, layout.integrals)), np.zeros(loop.numerator.size - 1)
    outputs, before = np.zeros((submodels, BLOCK)), np.zeros(submodels)
    written = 0
    for start in range(0, data.y.size, BLOCK):
        count = min(BLOCK, data.y.size - start)
        span = _Span(start - shift, min(max(shift - start, 0), count), count)
        if closed:
            # From the states at the start of the block, which the next call advances.
            _loop_block(modes, clock, loop, start, count, states, integrals[0], memory, v)
        _input_block(modes, first, clock, instruments, span, states, integrals[0], block)
        if closed:
            _input_block(modes, first, clock, measured, span, states[:, 3:], integrals[1], block)
        _model_outputs(modes, first, count, block, outputs)
        for k in range(count):
            total = data.y[start + k]
            for i in range(submodels):
                total -= outputs[i, k]
            block[layout.error, k] = total
        # What the other submodels leave of the output drives e.
        for i in range(submodels):
            for k in range(count):
                outputs[i, k] += block[layout.error, k]
        for i in range(poles.size):
            row, paired, left = layout.value + 1 + first[i], poles[i].imag != 0.0, outputs[modes.owner[i]]
            last = before[modes.owner[i]]
            _output_block(clock.whole[i], left, last, start > 0, data.y_foh, states[i], row, paired, count, block)
        for i in range(submodels):
            before[i] = outputs[i, count - 1]
        written = emit(sink, _keep_used(data.use, start, count, block), written)
    finish(sink, 0, written)
