"""One mode of a pass over a block of samples: what a held input makes of it, read at the samples.

Recursions run along contiguous memory with their state in registers.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from ctid_cli.arrays import Array, BoolArray, ComplexArray, IntArray
from ctid_cli.filtering.row_sink import BLOCK


@njit(cache=True, nogil=True)
def first_rows(poles: ComplexArray) -> IntArray:
    """First row of each mode, and the number of rows: a real pole has one, a pair two."""
    first = np.zeros(poles.size + 1, np.int64)
    for i in range(poles.size):
        first[i + 1] = first[i] + (2 if poles[i].imag != 0.0 else 1)
    return first


class Clock(NamedTuple):
    """A regular clock, and the weights of each mode over an interval and over the part of it that the delay leaves."""

    interval: float
    #: The delay is ``(shift - fraction) interval``.
    shift: int
    fraction: float
    #: In the order of :class:`~ctid_cli.filtering.step_weights.StepWeights`, shape (modes, 6).
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


@njit(cache=True, nogil=True)
def held_block(source: Source, first: int, count: int) -> Array:
    """Input at the break before each sample of a block, and its change up to the next one, shape (2, BLOCK).

    Sample k sees the input from break ``first + k`` on: none where that is negative, and the states are still zero.
    """
    held = np.zeros((2, BLOCK))
    late = min(max(-first, 0), count)
    arrived = source.values[first + late : first + count]
    value, change = held[0, late:], held[1, late:]
    for k in range(arrived.size):
        value[k] = arrived[k]
    if source.foh:
        following = source.values[first + late + 1 : first + count + 1]
        for k in range(following.size):
            change[k] = following[k] - arrived[k]
    return held


@njit(cache=True, nogil=True)
def value_block(clock: Clock, source: Source, held: Array, count: int, block: Array) -> None:
    """Write the input over a block as it arrives at the samples."""
    row, value, change = block[source.value], held[0], held[1]
    for k in range(count):
        row[k] = value[k] + clock.fraction * change[k]


@njit(cache=True, nogil=True, fastmath={"contract"})
def mode_block(
    clock: Clock,
    mode: int,
    source: Source,
    held: Array,
    count: int,
    state: ComplexArray,
    row: int,
    paired: bool,
    block: Array,
) -> None:
    """Advance one mode, and its square, over a block; column k receives the read-out at sample k.

    In real arithmetic, so that the state stays in registers: decay d, mixed m, and as weights of the value and of its
    change b and c of the mode, f and g of its square. ``row`` is the mode's among those of all modes.
    """
    weights, value, change = clock.whole[mode], held[0], held[1]
    double = source.double >= 0
    # The imaginary part of a real mode is zero, and written nowhere that is read.
    unread = np.empty(BLOCK)
    rows_re, rows_im = block[source.single + row], block[source.single + row + 1] if paired else unread
    squares_re, squares_im = unread, unread
    if double:
        squares_re = block[source.double + row]
        if paired:
            squares_im = block[source.double + row + 1]
    z_re, z_im = state[0].real, state[0].imag
    d_re, d_im = weights[0].real, weights[0].imag
    m_re, m_im = weights[1].real, weights[1].imag
    b_re, b_im = weights[2].real, weights[2].imag
    c_re, c_im = weights[3].real, weights[3].imag
    f_re, f_im = weights[4].real, weights[4].imag
    g_re, g_im = weights[5].real, weights[5].imag
    if double:
        w_re, w_im = state[1].real, state[1].imag
        for k in range(count):
            rows_re[k], rows_im[k], squares_re[k], squares_im[k] = z_re, z_im, w_re, w_im
            # w+ = d w + m z + f value + g change, from z before its step. Summed so that only two of the products wait
            # for the step before.
            driven_re = m_re * z_re - m_im * z_im + (f_re * value[k] + g_re * change[k])
            driven_im = m_re * z_im + m_im * z_re + (f_im * value[k] + g_im * change[k])
            new_re = d_re * w_re + (driven_re - d_im * w_im)
            w_im = d_re * w_im + (driven_im + d_im * w_re)
            w_re = new_re
            # z+ = d z + b value + c change.
            new_re = d_re * z_re + (b_re * value[k] + c_re * change[k] - d_im * z_im)
            z_im = d_re * z_im + (b_im * value[k] + c_im * change[k] + d_im * z_re)
            z_re = new_re
        state[1] = complex(w_re, w_im)
    else:
        for k in range(count):
            rows_re[k], rows_im[k] = z_re, z_im
            new_re = d_re * z_re + (b_re * value[k] + c_re * change[k] - d_im * z_im)
            z_im = d_re * z_im + (b_im * value[k] + c_im * change[k] + d_im * z_re)
            z_re = new_re
    state[0] = complex(z_re, z_im)
    if clock.fraction > 0.0:
        _read_late(clock, mode, held, count, rows_re, rows_im, squares_re, squares_im, double)


@njit(cache=True, nogil=True, fastmath={"contract"})
def _read_late(
    clock: Clock,
    mode: int,
    held: Array,
    count: int,
    rows_re: Array,
    rows_im: Array,
    squares_re: Array,
    squares_im: Array,
    double: bool,
) -> None:
    """Move the states of a mode from the breaks to where they are read, a fraction of an interval later."""
    part, fraction, value, change = clock.part[mode], clock.fraction, held[0], held[1]
    d_re, d_im = part[0].real, part[0].imag
    m_re, m_im = part[1].real, part[1].imag
    b_re, b_im = part[2].real, part[2].imag
    c_re, c_im = fraction * part[3].real, fraction * part[3].imag
    f_re, f_im = part[4].real, part[4].imag
    g_re, g_im = fraction * part[5].real, fraction * part[5].imag
    if double:
        for k in range(count):
            w_re, w_im = squares_re[k], squares_im[k]
            mixed_re = m_re * rows_re[k] - m_im * rows_im[k] + f_re * value[k] + g_re * change[k]
            mixed_im = m_re * rows_im[k] + m_im * rows_re[k] + f_im * value[k] + g_im * change[k]
            squares_re[k] = d_re * w_re - d_im * w_im + mixed_re
            squares_im[k] = d_re * w_im + d_im * w_re + mixed_im
    for k in range(count):
        z_re, z_im = rows_re[k], rows_im[k]
        rows_re[k] = d_re * z_re - d_im * z_im + b_re * value[k] + c_re * change[k]
        rows_im[k] = d_re * z_im + d_im * z_re + b_im * value[k] + c_im * change[k]


@njit(cache=True, nogil=True, fastmath={"contract"})
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
    # Decay d; b weights the earlier sample and c the one that is reached: the change to it is their difference.
    c_re, c_im = (weights[3].real, weights[3].imag) if foh else (0.0, 0.0)
    b_re, b_im = weights[2].real - c_re, weights[2].imag - c_im
    rows_re = block[row]
    rows_im = block[row + 1] if paired else np.empty(BLOCK)
    if not begun:
        rows_re[0], rows_im[0] = e_re, e_im
        before = values[0]
    for k in range(0 if begun else 1, count):
        new_re = d_re * e_re + (b_re * before + c_re * values[k] - d_im * e_im)
        e_im = d_re * e_im + (b_im * before + c_im * values[k] + d_im * e_re)
        e_re = new_re
        before = values[k]
        rows_re[k], rows_im[k] = e_re, e_im
    state[2] = complex(e_re, e_im)


@njit(cache=True, nogil=True)
def keep_used(use: BoolArray, start: int, count: int, block: Array) -> int:
    """Move the columns of the used samples to the front of a block; returns their number."""
    if use[start : start + count].all():
        return count
    kept = 0
    for k in range(count):
        if use[start + k]:
            if kept < k:
                for i in range(block.shape[0]):
                    block[i, kept] = block[i, k]
            kept += 1
    return kept
