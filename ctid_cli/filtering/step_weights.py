"""What a held input makes of a mode over a step: for one step, and for a block of different ones.

All weights follow from ``f(x) = (exp(x) - 1 - x)/x^2`` and its derivative at x = pole * step: with
``g = (exp(x) - 1)/x = 1 + x f`` and ``g' = f + x f'``, the decay is ``exp(x) = 1 + x g``.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from ctid_cli.arrays import Array, ComplexArray
from ctid_cli.filtering.row_sink import BLOCK

#: 1/(k + 4)!, k = 0 … 14, of the series for |x| <= 1: what is left out is below rounding.
SERIES = tuple(1.0 / math.factorial(k + 4) for k in range(15))
#: Up to |x| = 2^this a block is summed as series of halved steps, and doubled; beyond, exponentials are faster.
MOST_DOUBLINGS = 5
#: A block of steps lies in one array of these parts: a compiler that knows where they lie need not ask whether they
#: overlap, and handles several steps at once.
GAP, VALUE, CHANGE, DECAY_RE, DECAY_IM, SINGLE_RE, SINGLE_IM, DOUBLE_RE, DOUBLE_IM, STEPS = range(0, 10 * BLOCK, BLOCK)


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


@njit(cache=True, nogil=True, fastmath={"contract"}, forceinline=True)
def _series(re: float, im: float) -> tuple[float, float, float, float]:
    """Real and imaginary part of f and of f' at |x| <= 1, without cancellation however slow the pole is."""
    # Of a real polynomial at x only the remainder by t^2 - 2 re t + |x|^2, which is zero at x, is complex: two products
    # for each coefficient where complex ones take four. last is the quotient's constant term at the end.
    twice, square = re + re, re * re + im * im
    before, last = 0.0, SERIES[-1]
    for k in range(len(SERIES) - 2, 0, -1):
        before, last = last, (SERIES[k] - square * before) + twice * last
    tail_re, tail_im = SERIES[0] - square * before + re * last, im * last
    # With tail = 1/4! + x/5! + …: f = 1/2 + x (1/6 + x tail), f' = 1/6 + x (1/6 + (x - 2) tail).
    inner_re, inner_im = 1.0 / 6.0 + re * tail_re - im * tail_im, re * tail_im + im * tail_re
    slope_re, slope_im = inner_re - 2.0 * tail_re, inner_im - 2.0 * tail_im
    return (
        0.5 + re * inner_re - im * inner_im,
        re * inner_im + im * inner_re,
        1.0 / 6.0 + re * slope_re - im * slope_im,
        re * slope_im + im * slope_re,
    )


@njit(cache=True, nogil=True)
def step_weights(pole: complex, step: float) -> StepWeights:
    """Weights of one mode over a step."""
    x = pole * step
    if x.real * x.real + x.imag * x.imag <= 1.0:
        f_re, f_im, slope_re, slope_im = _series(x.real, x.imag)
        f, slope = complex(f_re, f_im), complex(slope_re, slope_im)
        g, g_slope = 1.0 + x * f, f + x * slope
        decay = 1.0 + x * g
    else:
        # Divided by x throughout: 1 + x f would cancel where the step is long.
        over = 1.0 / x
        decay = np.exp(x)
        g = (decay - 1.0) * over
        f, g_slope = (g - 1.0) * over, (decay - g) * over
        slope = (g - 2.0 * f) * over
    square = step * step
    return StepWeights(decay, step * decay, step * g, step * f, square * g_slope, square * slope)


@njit(cache=True, nogil=True)
def all_weights(poles: ComplexArray, step: float) -> ComplexArray:
    """Weights of all modes over a step, shape (modes, 6)."""
    weights = np.zeros((poles.size, 6), np.complex128)
    for i in range(poles.size):
        for k, weight in enumerate(step_weights(poles[i], step)):
            weights[i, k] = weight
    return weights


@njit(cache=True, nogil=True, fastmath={"contract"})
def held_steps(pole: complex, longest: float, count: int, steps: Array) -> None:
    """Write the decay of a mode over each gap of a block, and what the held input adds to the mode and to its square.

    No gap is longer than ``longest``; ``steps`` has the parts named above, shape (STEPS,).
    """
    size = abs(pole) * longest
    doublings = max(0, int(np.ceil(np.log2(size)))) if 0.0 < size < np.inf else 0
    if doublings > MOST_DOUBLINGS:
        _exponential_steps(pole, count, steps)
        return
    scale = 0.5**doublings
    re, im = scale * pole.real, scale * pole.imag
    # f and f' stand where the weights made of them will.
    for k in range(count):
        value_re, value_im, slope_re, slope_im = _series(re * steps[GAP + k], im * steps[GAP + k])
        steps[SINGLE_RE + k], steps[SINGLE_IM + k] = value_re, value_im
        steps[DOUBLE_RE + k], steps[DOUBLE_IM + k] = slope_re, slope_im
    for _ in range(doublings):
        # f(2 x) = (g^2 + 2 f)/4, hence f'(2 x) = (g g' + f')/4. All double equally often: the loop has no branch.
        for k in range(count):
            x_re, x_im = re * steps[GAP + k], im * steps[GAP + k]
            f_re, f_im = steps[SINGLE_RE + k], steps[SINGLE_IM + k]
            slope_re, slope_im = steps[DOUBLE_RE + k], steps[DOUBLE_IM + k]
            g_re, g_im = 1.0 + x_re * f_re - x_im * f_im, x_re * f_im + x_im * f_re
            g_slope_re = f_re + x_re * slope_re - x_im * slope_im
            g_slope_im = f_im + x_re * slope_im + x_im * slope_re
            steps[SINGLE_RE + k] = 0.25 * (g_re * g_re - g_im * g_im) + 0.5 * f_re
            steps[SINGLE_IM + k] = 0.5 * (g_re * g_im + f_im)
            steps[DOUBLE_RE + k] = 0.25 * (g_re * g_slope_re - g_im * g_slope_im + slope_re)
            steps[DOUBLE_IM + k] = 0.25 * (g_re * g_slope_im + g_im * g_slope_re + slope_im)
        re, im = 2.0 * re, 2.0 * im
    for k in range(count):
        gap, value, change = steps[GAP + k], steps[VALUE + k], steps[CHANGE + k]
        x_re, x_im = pole.real * gap, pole.imag * gap
        f_re, f_im = steps[SINGLE_RE + k], steps[SINGLE_IM + k]
        slope_re, slope_im = steps[DOUBLE_RE + k], steps[DOUBLE_IM + k]
        g_re, g_im = 1.0 + x_re * f_re - x_im * f_im, x_re * f_im + x_im * f_re
        steps[DECAY_RE + k], steps[DECAY_IM + k] = 1.0 + x_re * g_re - x_im * g_im, x_re * g_im + x_im * g_re
        steps[SINGLE_RE + k] = gap * (g_re * value + f_re * change)
        steps[SINGLE_IM + k] = gap * (g_im * value + f_im * change)
        g_slope_re = f_re + x_re * slope_re - x_im * slope_im
        g_slope_im = f_im + x_re * slope_im + x_im * slope_re
        steps[DOUBLE_RE + k] = gap * gap * (g_slope_re * value + slope_re * change)
        steps[DOUBLE_IM + k] = gap * gap * (g_slope_im * value + slope_im * change)


@njit(cache=True, nogil=True)
def _exponential_steps(pole: complex, count: int, steps: Array) -> None:
    """The same for a block with a step far longer than the mode remembers."""
    for k in range(count):
        weights = step_weights(pole, steps[GAP + k])
        value, change = steps[VALUE + k], steps[CHANGE + k]
        single = weights.z_start * value + weights.z_change * change
        double = weights.w_start * value + weights.w_change * change
        steps[DECAY_RE + k], steps[DECAY_IM + k] = weights.decay.real, weights.decay.imag
        steps[SINGLE_RE + k], steps[SINGLE_IM + k] = single.real, single.imag
        steps[DOUBLE_RE + k], steps[DOUBLE_IM + k] = double.real, double.imag
