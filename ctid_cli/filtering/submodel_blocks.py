"""One block of the pass over a sum of submodels: modes, integrals, and the noise-free loop."""

from typing import NamedTuple

import numpy as np
from numba import njit

from ctid_cli.arrays import Array, ComplexArray, IntArray
from ctid_cli.filtering.mode_blocks import Clock, Source, held_block, mode_block, value_block
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
def _integrator_block(clock: Clock, source: Source, held: Array, count: int, integrals: Array, block: Array) -> None:
    """Advance the integrals of the input over a block; read them at the samples, as the modes."""
    fraction, row = clock.fraction, source.integrals
    now = np.zeros(integrals.size)
    for k in range(count):
        # Read on a copy, a fraction of an interval further on; then advance from the break itself.
        for m in range(now.size):
            now[m] = integrals[m]
        if fraction > 0.0:
            _integrate(now, fraction * clock.interval, held[0, k], fraction * held[1, k])
        for m in range(now.size):
            block[row + m, k] = now[m]
        _integrate(integrals, clock.interval, held[0, k], held[1, k])


@njit(cache=True, nogil=True)
def input_block(
    modes: PooledModes,
    first: IntArray,
    clock: Clock,
    source: Source,
    arrived: int,
    count: int,
    states: ComplexArray,
    integrals: Array,
    block: Array,
) -> None:
    """Advance all modes and integrals of an input over a block, and write it at the samples too.

    ``arrived`` is the break whose input the first sample sees.
    """
    held = held_block(source, arrived, count)
    for i in range(first.size - 1):
        mode_block(clock, i, source, held, count, states[i], first[i], modes.poles[i].imag != 0.0, block)
    if integrals.size:
        _integrator_block(clock, source, held, count, integrals, block)
    value_block(clock, source, held, count, block)


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
