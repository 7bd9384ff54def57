"""One mode of a pass over a block of samples: what a held input makes of it, read at the samples.

Recursions run along contiguous memory with their state in registers.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from ctid_cli.arrays import Array, BoolArray, ComplexArray, IntArray

#: Below this |pole * step| the functions of a held step are summed as series, 1/(k + 2)! for k = 0 … 10; above it the
#: closed forms lose less than 1/SMALL_STEP^3 of the rounding error.
SMALL_STEP = 0.15
INVERSE_FACTORIALS = tuple(1.0 / math.factorial(k + 2) for k in range(11))


class StepWeights(NamedTuple):
    """What ``z = 1/(s - p) v`` and ``w = 1/(s - p)^2 v`` become over a step with v linear.

    ``z+ = decay z + z_start v + z_change (change of v)``, and
    ``w+ = decay w + mixed z + w_start v + w_change (change of v)``.
    """

    decay: complex
    mixed: complex
    z_start: complex
    z_change: complex
    w_start: complex
    w_change: complex


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
def step_weights(pole: complex, step: float) -> StepWeights:
    """Weights of one mode over a step."""
    x = pole * step
    decay, value, slope = _step_functions(x)
    square = step * step
    return StepWeights(
        decay,
        step * decay,
        step * (1.0 + x * value),
        step * value,
        square * (value + x * slope),
        square * slope,
    )


@njit(cache=True, nogil=True)
def all_weights(poles: ComplexArray, step: float) -> ComplexArray:
    """Weights of all modes over a step, shape (modes, 6)."""
    weights = np.zeros((poles.size, 6), np.complex128)
    for i in range(poles.size):
        for k, weight in enumerate(step_weights(poles[i], step)):
            weights[i, k] = weight
    return weights


@njit(cache=True, nogil=True)
def first_rows(poles: ComplexArray) -> IntArray:
    """First row of each mode, and the number of rows: a real pole has one, a pair two."""
    first = np.zeros(poles.size + 1, np.int64)
    for i in range(poles.size):
        first[i + 1] = first[i] + (2 if poles[i].imag != 0.0 else 1)
    return first


@njit(cache=True, nogil=True)
def put(block: Array, row: int, column: int, value: complex, paired: bool) -> int:
    """Write the state of a mode, that of a pair with its imaginary part below the real one; returns the next row."""
    block[row, column] = value.real
    if not paired:
        return row + 1
    block[row + 1, column] = value.imag
    return row + 2


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
def mode_block(
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
def value_block(clock: Clock, source: Source, span: Span, block: Array) -> None:
    """Write the input over a block as it arrives at the samples."""
    u, last = source.values, source.values.size - 1
    for k in range(span.length):
        j = span.first + k
        change = clock.fraction * (u[j + 1] - u[j]) if source.foh and 0 <= j < last else 0.0
        block[source.value, k] = u[j] + change if j >= 0 else 0.0


@njit(cache=True, nogil=True)
def keep_used(use: BoolArray, start: int, count: int, block: Array) -> int:
    """Move the columns of the used samples to the front of a block; returns their number."""
    kept = 0
    for k in range(count):
        if use[start + k]:
            if kept < k:
                for i in range(block.shape[0]):
                    block[i, kept] = block[i, k]
            kept += 1
    return kept
