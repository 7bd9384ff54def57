"""One mode of a pass over a block of samples on any clock: steps of different lengths, read at the samples.

Steps are laid out as :mod:`ctid_cli.filtering.step_weights` has them.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from ctid_cli.arrays import Array, ComplexArray, IntArray
from ctid_cli.filtering.filter_data import FilterData
from ctid_cli.filtering.row_sink import BLOCK
from ctid_cli.filtering.step_weights import (
    CHANGE,
    DECAY_IM,
    DECAY_RE,
    DOUBLE_IM,
    DOUBLE_RE,
    GAP,
    SINGLE_IM,
    SINGLE_RE,
    STEPS,
    VALUE,
    held_steps,
)

#: States of a mode and of its square at the breaks, parts of one array as those of the steps.
Z_RE, Z_IM, W_RE, W_IM, STATES = range(0, 5 * (BLOCK + 1), BLOCK + 1)


class ClockBlock(NamedTuple):
    """The steps that a block of samples takes on both clocks."""

    #: From break to break of the input, shape (STEPS,).
    breaks: Array
    #: From the last break before a delayed sample to this sample.
    late: Array
    #: From sample to sample of the output.
    outputs: Array
    #: How many breaks of the block lie before each sample, shape (BLOCK,).
    passed: IntArray


@njit(cache=True, nogil=True)
def clock_block() -> ClockBlock:
    """An empty block."""
    return ClockBlock(np.zeros(STEPS), np.zeros(STEPS), np.zeros(STEPS), np.zeros(BLOCK, np.int64))


@njit(cache=True, nogil=True)
def next_block(
    data: FilterData, delay: float, slack: float, start: int, last: int, block: ClockBlock
) -> tuple[int, int, float]:
    """Lay out the steps to the samples from ``start`` on, the break ``last`` being reached (-1: none yet).

    Returns the number of samples, of breaks passed, and the longest step. A block ends when either fills it: where the
    input has far more breaks than the output samples, some blocks hold no sample.
    """
    t, y, tu = data.t, data.y, data.tu
    breaks, late, outputs, passed = block
    samples, reached, longest = min(BLOCK, t.size - start), 0, 0.0
    # Before the first break the states are zero, and stay so: a step of length zero that nothing drives.
    gap, value, change = 0.0, 0.0, 0.0
    if last >= 0:
        gap, value, change = _held(data, last)
    for k in range(samples):
        instant = t[start + k] - delay
        # The states up to the last break not after t_k - tau.
        while last + 1 < tu.size and tu[last + 1] <= instant + slack:
            if reached == BLOCK:
                return k, reached, longest
            breaks[GAP + reached], breaks[VALUE + reached], breaks[CHANGE + reached] = gap, value, change
            longest = max(longest, gap)
            reached, last = reached + 1, last + 1
            gap, value, change = _held(data, last)
        # Read out on the way to the next break; the states stay at this one.
        step = max(0.0, instant - tu[last]) if last >= 0 else 0.0
        passed[k] = reached
        late[GAP + k], late[VALUE + k] = step, value
        late[CHANGE + k] = change * (step / gap) if change != 0.0 else 0.0
        before = max(start + k - 1, 0)
        outputs[GAP + k], outputs[VALUE + k] = t[start + k] - t[before], y[before]
        outputs[CHANGE + k] = y[start + k] - y[before] if data.y_foh else 0.0
        longest = max(longest, step, outputs[GAP + k])
    return samples, reached, longest


@njit(cache=True, nogil=True, forceinline=True)
def _held(data: FilterData, at: int) -> tuple[float, float, float]:
    """Length of the step from a break, the input at its start, and the change over it."""
    tu, u = data.tu, data.u
    if at + 1 == tu.size:
        return 0.0, u[at], 0.0
    return tu[at + 1] - tu[at], u[at], u[at + 1] - u[at] if data.input_foh else 0.0


@njit(cache=True, nogil=True, fastmath={"contract"})
def input_mode(
    pole: complex, longest: float, clock: ClockBlock, reached: int, state: ComplexArray, states: Array
) -> None:
    """Advance a mode and its square over the breaks of a block, and write its ``states`` at all of them."""
    breaks = clock.breaks
    held_steps(pole, longest, reached, breaks)
    z_re, z_im, w_re, w_im = state[0].real, state[0].imag, state[1].real, state[1].imag
    for k in range(reached):
        states[Z_RE + k], states[Z_IM + k], states[W_RE + k], states[W_IM + k] = z_re, z_im, w_re, w_im
        d_re, d_im, gap = breaks[DECAY_RE + k], breaks[DECAY_IM + k], breaks[GAP + k]
        # w+ = d (w + gap z) + …, from z before its step.
        driven_re, driven_im = w_re + gap * z_re, w_im + gap * z_im
        w_re = d_re * driven_re + (breaks[DOUBLE_RE + k] - d_im * driven_im)
        w_im = d_re * driven_im + (breaks[DOUBLE_IM + k] + d_im * driven_re)
        new_re = d_re * z_re + (breaks[SINGLE_RE + k] - d_im * z_im)
        z_im = d_re * z_im + (breaks[SINGLE_IM + k] + d_im * z_re)
        z_re = new_re
    states[Z_RE + reached], states[Z_IM + reached] = z_re, z_im
    states[W_RE + reached], states[W_IM + reached] = w_re, w_im
    state[0], state[1] = complex(z_re, z_im), complex(w_re, w_im)


@njit(cache=True, nogil=True, fastmath={"contract"})
def read_mode(
    pole: complex, longest: float, clock: ClockBlock, count: int, states: Array, rows: Array, squares: Array
) -> None:
    """Read a mode and its square at the samples of a block, from their states at the breaks."""
    late = clock.late
    held_steps(pole, longest, count, late)
    paired = rows.shape[0] > 1
    for k in range(count):
        at, gap, d_re, d_im = clock.passed[k], late[GAP + k], late[DECAY_RE + k], late[DECAY_IM + k]
        z_re, z_im = states[Z_RE + at], states[Z_IM + at]
        driven_re, driven_im = states[W_RE + at] + gap * z_re, states[W_IM + at] + gap * z_im
        rows[0, k] = late[SINGLE_RE + k] + d_re * z_re - d_im * z_im
        squares[0, k] = late[DOUBLE_RE + k] + d_re * driven_re - d_im * driven_im
        if paired:
            rows[1, k] = late[SINGLE_IM + k] + d_re * z_im + d_im * z_re
            squares[1, k] = late[DOUBLE_IM + k] + d_re * driven_im + d_im * driven_re


@njit(cache=True, nogil=True, fastmath={"contract"})
def output_mode(pole: complex, longest: float, clock: ClockBlock, count: int, state: ComplexArray, rows: Array) -> None:
    """Advance the mode of the output over a block, read at each sample after the step to it."""
    steps = clock.outputs
    held_steps(pole, longest, count, steps)
    paired = rows.shape[0] > 1
    e_re, e_im = state[2].real, state[2].imag
    for k in range(count):
        new_re = steps[DECAY_RE + k] * e_re + (steps[SINGLE_RE + k] - steps[DECAY_IM + k] * e_im)
        e_im = steps[DECAY_RE + k] * e_im + (steps[SINGLE_IM + k] + steps[DECAY_IM + k] * e_re)
        e_re = new_re
        rows[0, k] = e_re
        if paired:
            rows[1, k] = e_im
    state[2] = complex(e_re, e_im)
