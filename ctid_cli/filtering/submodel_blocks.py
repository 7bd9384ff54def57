"""Parts of the pass over a sum of submodels: a block of modes and integrals, and the input of the noise-free loop."""

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


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def loop_input(modes: PooledModes, clock: Clock, loop: LoopData) -> Array:
    """Input of the noise-free loop of the model, at rest before the first sample; nothing in open loop, shape (N,)."""
    shift, order = clock.shift, loop.numerator.size - 1
    reference, numerator, denominator, at_controller = loop
    v = np.zeros(reference.size)
    z_re, z_im = np.zeros(modes.poles.size), np.zeros(modes.poles.size)
    integrals = np.zeros(modes.origin.size)
    d_re, d_im = clock.whole[:, 0].real.copy(), clock.whole[:, 0].imag.copy()
    b_re, b_im = clock.whole[:, 2].real.copy(), clock.whole[:, 2].imag.copy()
    # x is read a fraction of an interval after the break: its weights there, and what the held input has added by then.
    late = modes.residues * clock.part[:, 0]
    gain = (modes.residues * clock.part[:, 2]).real.sum() + modes.direct
    origin = np.zeros(integrals.size)
    for m in range(integrals.size + 1):
        # What becomes of one in an integral, or in the input.
        unit = np.zeros(integrals.size)
        unit[m : m + 1] = 1.0
        _integrate(unit, clock.fraction * clock.interval, 1.0 if m == unit.size else 0.0, 0.0)
        if m < unit.size:
            origin[m] = modes.origin @ unit
        else:
            gain += modes.origin @ unit
    # What the states make of the next output need not wait for the input of this sample, which then adds to it.
    ahead = late * clock.whole[:, 0]
    r_re, r_im = ahead.real.copy(), ahead.imag.copy()
    free, last, kick = 0.0, 0.0, (late * clock.whole[:, 2]).real.sum()
    # The controller in its transposed direct form II, with a zero behind its states. Its direct part and, if the model
    # has one without delay, the model's close an algebraic loop.
    memory = np.zeros(order + 1)
    own = modes.direct if shift == 0 else 0.0
    first = numerator[0]
    closing = 1.0 / (1.0 + first * own)
    for k in range(v.size):
        # x_k as far as the inputs before sample k make it.
        arrived = v[k - shift] if 0 < shift <= k else 0.0
        x = (free + gain * arrived) + kick * last
        for m in range(integrals.size):
            x += origin[m] * integrals[m]
        # v_k = C (r - x), or r - C x: solved for v_k where it acts on x_k itself.
        error = reference[k] - x if at_controller else -x
        value = memory[0] + first * error
        if not at_controller:
            value += reference[k]
        value *= closing
        v[k] = value
        # The model over a whole interval, driven by the input that arrives.
        last = value if shift == 0 else arrived
        free = 0.0
        for i in range(z_re.size):
            re, im = z_re[i], z_im[i]
            free += r_re[i] * re - r_im[i] * im
            z_re[i] = (d_re[i] * re - d_im[i] * im) + b_re[i] * last
            z_im[i] = (d_re[i] * im + d_im[i] * re) + b_im[i] * last
        if integrals.size:
            _integrate(integrals, clock.interval, last, 0.0)
        # The controller's state sees the whole error, with what v_k itself has added to x_k.
        error -= own * value
        response = memory[0] + first * error
        for m in range(order):
            memory[m] = numerator[m + 1] * error - denominator[m + 1] * response + memory[m + 1]
    return v
