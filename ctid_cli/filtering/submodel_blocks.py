"""One block of the pass over a sum of submodels: modes, integrals, and the noise-free loop.

Recursions run along contiguous memory with their state in registers.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from ctid_cli.arrays import Array, ComplexArray, IntArray
from ctid_cli.filtering.modal_pass import put
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


class Clock(NamedTuple):
    """A regular clock, and the weights of each mode over an interval and over the part of it that the delay leaves."""

    interval: float
    #: The delay is ``(shift - fraction) interval``.
    shift: int
    fraction: float
    #: In the order of :class:`StepWeights`, shape (modes, 6).
    whole: ComplexArray
    part: ComplexArray


class Source(NamedTuple):
    """An input, held or joined by straight lines, and the rows of its block that it fills."""

    values: Array
    foh: bool
    #: First of the rows of the modes, of their squares (-1: none), of the integrals, and of the input itself.
    single: int
    double: int
    integrals: int
    value: int


class Span(NamedTuple):
    """A block: sample k of ``length`` sees the input from break ``first + k`` on, the first ``skip`` none."""

    first: int
    skip: int
    length: int


@njit(cache=True, nogil=True)
def _mode_block(
    clock: Clock, mode: int, source: Source, span: Span, state: ComplexArray, row: int, paired: bool, block: Array
) -> None:
    """Advance one mode, and its square, over a block; column k receives the read-out at sample k.

    In real arithmetic, so that the state stays in registers: decay d, mixed m, and as weights of the value and of its
    change b and c of the mode, f and g of its square. ``row`` is the mode's among those of all modes.
    """
    weights, part, fraction, u = clock.whole[mode], clock.part[mode], clock.fraction, source.values
    foh, last = source.foh, u.size - 1
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
    # Nothing has arrived yet.
    for k in range(span.skip):
        put(block, single_row, k, 0.0j, paired)
        if double:
            put(block, double_row, k, 0.0j, paired)
    for k in range(span.skip, span.length):
        j = span.first + k
        value = u[j]
        change = u[j + 1] - value if foh and j < last else 0.0
        # Read out a fraction of an interval after the break, then advance from the break itself.
        z_now, w_now = complex(z_re, z_im), complex(w_re, w_im)
        if fraction > 0.0:
            rise = fraction * change
            if double:
                w_now = (part[0] * w_now + part[1] * z_now) + (part[4] * value + part[5] * rise)
            z_now = part[0] * z_now + (part[2] * value + part[3] * rise)
        put(block, single_row, k, z_now, paired)
        if double:
            put(block, double_row, k, w_now, paired)
        # The square first: it is driven by the mode before its step.
        if double:
            new_re = (d_re * w_re - d_im * w_im) + (m_re * z_re - m_im * z_im) + (f_re * value + g_re * change)
            w_im = (d_re * w_im + d_im * w_re) + (m_re * z_im + m_im * z_re) + (f_im * value + g_im * change)
            w_re = new_re
        # z+ = d z + b value + c change.
        new_re = (d_re * z_re - d_im * z_im) + (b_re * value + c_re * change)
        z_im = (d_re * z_im + d_im * z_re) + (b_im * value + c_im * change)
        z_re = new_re
    state[0] = complex(z_re, z_im)
    if double:
        state[1] = complex(w_re, w_im)


@njit(cache=True, nogil=True)
def output_block(
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
    # Decay d and the weights b of the earlier sample, c of the change to this one; rows of the state are read after it.
    for k in range(count):
        if begun:
            change = values[k] - before if foh else 0.0
            new_re = (d_re * e_re - d_im * e_im) + (b_re * before + c_re * change)
            e_im = (d_re * e_im + d_im * e_re) + (b_im * before + c_im * change)
            e_re = new_re
        begun = True
        before = values[k]
        put(block, row, k, complex(e_re, e_im), paired)
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
def _integrator_block(clock: Clock, source: Source, span: Span, integrals: Array, block: Array) -> None:
    """Advance the integrals of the input over a block; read them at the samples, as the modes."""
    u, fraction, row = source.values, clock.fraction, source.integrals
    now = np.zeros(integrals.size)
    for k in range(span.length):
        if k < span.skip:
            for m in range(now.size):
                block[row + m, k] = 0.0
            continue
        j = span.first + k
        value = u[j]
        change = u[j + 1] - value if source.foh and j < u.size - 1 else 0.0
        # Read on a copy, a fraction of an interval further on; then advance from the break itself.
        for m in range(now.size):
            now[m] = integrals[m]
        if fraction > 0.0:
            _integrate(now, fraction * clock.interval, value, fraction * change)
        for m in range(now.size):
            block[row + m, k] = now[m]
        _integrate(integrals, clock.interval, value, change)


@njit(cache=True, nogil=True)
def input_block(
    modes: PooledModes,
    first: IntArray,
    clock: Clock,
    source: Source,
    span: Span,
    states: ComplexArray,
    integrals: Array,
    block: Array,
) -> None:
    """Advance all modes and integrals of an input over a block, and write it at the samples too."""
    u, last = source.values, source.values.size - 1
    for i in range(first.size - 1):
        _mode_block(clock, i, source, span, states[i], first[i], modes.poles[i].imag != 0.0, block)
    if integrals.size:
        _integrator_block(clock, source, span, integrals, block)
    # The input as it arrives at the samples.
    for k in range(span.length):
        j = span.first + k
        change = clock.fraction * (u[j + 1] - u[j]) if source.foh and 0 <= j < last else 0.0
        block[source.value, k] = u[j] + change if j >= 0 else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def loop_block(
    modes: PooledModes,
    clock: Clock,
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
    part, fraction, shift, order = clock.part, clock.fraction, clock.shift, memory.size
    reference, numerator, denominator, at_controller = loop
    origin, direct = modes.origin, modes.direct
    z_re, z_im = states[:, 0].real.copy(), states[:, 0].imag.copy()
    r_re, r_im = modes.residues.real.copy(), modes.residues.imag.copy()
    d_re, d_im = clock.whole[:, 0].real.copy(), clock.whole[:, 0].imag.copy()
    b_re, b_im = clock.whole[:, 2].real.copy(), clock.whole[:, 2].imag.copy()
    s = integrals.copy()
    now = np.zeros(s.size)
    # The controller's direct part and, if the model has one without delay, the model's close an algebraic loop.
    own = direct if shift == 0 else 0.0
    first = numerator[0]
    closing = 1.0 / (1.0 + first * own)
    for k in range(start, start + count):
        # x_k as far as the inputs before sample k make it.
        j = k - shift
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
                x += origin[m] * now[m]
            if j < k:
                x += direct * before
        # v_k = C (r - x), or r - C x: solved for v_k where it acts on x_k itself.
        held = memory[0] if order else 0.0
        if at_controller:
            error = reference[k] - x
            value = (held + first * error) * closing
        else:
            error = -x
            value = (held + first * error + reference[k]) * closing
        v[k] = value
        # Whole intervals of the model on copies of its states, driven by the input that arrives.
        if j >= 0:
            driven = value if j == k else before
            for i in range(z_re.size):
                re = z_re[i]
                z_re[i] = (d_re[i] * re - d_im[i] * z_im[i]) + b_re[i] * driven
                z_im[i] = (d_re[i] * z_im[i] + d_im[i] * re) + b_im[i] * driven
            _integrate(s, clock.interval, driven, 0.0)
        # The controller's state sees the whole error, with what v_k itself has added to x_k.
        error -= own * value
        response = held + first * error
        for m in range(order):
            following = memory[m + 1] if m + 1 < order else 0.0
            memory[m] = numerator[m + 1] * error - denominator[m + 1] * response + following
