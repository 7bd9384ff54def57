r"""Compiled loops over the samples of linear systems.

Kernels use only functions, constants and types of this file: Numba's disk cache checks only the file of a function, so
that it is never stale. Preparation and evaluation are in NumPy (:mod:`~ctid_cli.filtering.bank`,
:mod:`~ctid_cli.filtering.submodels`, :mod:`~ctid_cli.filtering.simulate`).

A filter has two forms. The *modal* form, for simple poles, is a sum of partial fractions: for one pole p of each
conjugate pair a pass advances ``z = 1/(s - p) u``, ``w = 1/(s - p)^2 u`` and ``e = 1/(s - p) y``, real and imaginary
part as two rows, block by block and mode by mode, with the state in registers. The *chain* form, for repeated poles,
advances a state space by exact transitions.

Helpers that are only called from kernels are inlined (``inline="always"``): compiling them separately and again in
each caller would take most of the time to the first estimate.
"""

import math

import numpy as np
from numba import njit

from ctid_cli.arrays import Array, BoolArray, ComplexArray, IntArray

#: Rows are computed in blocks of this number of samples, which fit into the L1 cache.
BLOCK = 128
#: Length of the rows of a block: one more state than samples, padded so that rows are aligned to cache lines.
WIDTH = BLOCK + 8
#: 1/(k + 4)!, k = 0 … 14, of the series for |x| <= 1: the remainder is below rounding.
SERIES = tuple(1.0 / math.factorial(k + 4) for k in range(15))
#: Up to |x| = 2^MOST_DOUBLINGS weights are series at halved steps, then doubled; beyond, exponentials are faster.
MOST_DOUBLINGS = 5
#: Indices of the parts of a block of steps, see `_weigh`.
GAP, VALUE, CHANGE, DECAY_RE, DECAY_IM, SINGLE_RE, SINGLE_IM, DOUBLE_RE, DOUBLE_IM, PARTS = range(10)
#: Digits per level, and Taylor degree, of the transitions of a chain over any step.
BASE = 16
TAYLOR_DEGREE = 6


# --- roots and partial fractions ----------------------------------------------------------------------------------


@njit(cache=True, nogil=True, error_model="numpy")
def polish_roots(coefficients: Array, roots: ComplexArray) -> None:
    """Improve the roots of a monic real polynomial by Newton steps, in place; the roots of a pair are adjacent."""
    # Removes rounding errors, which are relative to the *largest* root. Only if the step is small compared with the
    # distance to the next root: errors of the roots of a cluster cancel in their product, and moving single roots would
    # destroy that.
    for i in range(roots.size):
        gap = np.inf
        for j in range(roots.size):
            if j != i:
                gap = min(gap, abs(roots[j] - roots[i]))
        for _ in range(3):
            value, slope = complex(1.0, 0.0), complex(0.0, 0.0)
            for k in range(1, coefficients.size):
                slope = slope * roots[i] + value
                value = value * roots[i] + coefficients[k]
            if not abs(value) < 1e-3 * gap * abs(slope):
                break
            roots[i] -= value / slope
        if roots[i].imag < 0.0:
            roots[i] = roots[i - 1].conjugate()


@njit(cache=True, nogil=True, inline="always")
def _add_mode(mapping: Array, row: int, column: int, paired: bool, weight: complex) -> None:
    """Add ``Re(weight z)`` of a mode, twice for a pair, to a row of a map."""
    if paired:
        mapping[row, column] += 2.0 * weight.real
        mapping[row, column + 1] -= 2.0 * weight.imag
    else:
        mapping[row, column] += weight.real


@njit(cache=True, nogil=True, error_model="numpy")
def modal_form(
    a: Array, b: Array, integrators: int, roots: ComplexArray
) -> tuple[float, ComplexArray, ComplexArray, Array]:
    r"""Return partial fractions of the standard rows of ``B/(p^l A)``, with A monic of degree n and l up to 2.

    Returns the amplification of rounding, infinite if poles coincide; the poles, one of each pair, and 0 last if there
    are integrators; the weights of z and w in the output x, shape (modes, 2); and the map to the standard rows of
    :mod:`~ctid_cli.filtering.bank` from the rows of a pass: z and w of each mode, v, ``y - x``, and e of each mode.
    """
    n, origin = a.size - 1, integrators
    modes, width = 0, n + (1 if origin > 0 else 0)
    for i in range(n):
        if roots[i].imag >= 0.0:
            modes += 1
    poles = np.zeros(modes + (1 if origin > 0 else 0), np.complex128)
    residues = np.zeros((poles.size, 2), np.complex128)
    mapping = np.zeros((3 * n + origin + 3, 3 * width + 2))
    slopes, curvatures = np.ones(n, np.complex128), np.zeros(n, np.complex128)
    for i in range(n):
        # A'(pole) as a product, which avoids cancellation; and A''/A' = 2 sum 1/(pole - other).
        for j in range(n):
            if roots[j] != roots[i]:
                slopes[i] *= roots[i] - roots[j]
                curvatures[i] += 2.0 / (roots[i] - roots[j])
            elif j != i:
                return np.inf, poles, residues, mapping
        # Poles at the origin are in `integrators`; a slope that underflows when squared belongs to a double pole.
        if slopes[i] * slopes[i] == 0.0 or roots[i] == 0.0:
            return np.inf, poles, residues, mapping
    # Rounding is compared with the largest gain of p^k/A^2, which lies near the frequency of some pole, or at zero.
    condition = 1.0
    peaks, spreads = np.zeros(n), np.zeros(n)
    for at in range(n + 1 if n > 1 else 0):
        frequency, gain = abs(roots[at - 1]) if at > 0 else 0.0, 1.0
        totals = np.zeros(n)
        for i in range(n):
            distance, size = abs(complex(0.0, frequency) - roots[i]), abs(roots[i])
            gain /= distance * distance
            scale = 1.0 / (abs(slopes[i] * slopes[i]) * distance)
            for k in range(n):
                # p^k/A^2 near a double pole of A^2: one term for 1/(s - p)^2, one for 1/(s - p).
                totals[k] += scale * (1.0 / distance + abs(k / roots[i] - curvatures[i]))
                scale *= size
        for k in range(n):
            peaks[k], spreads[k] = max(peaks[k], gain), max(spreads[k], totals[k])
            gain *= frequency
    for k in range(n if n > 1 else 0):
        if not 0.0 < peaks[k] < np.inf:
            return np.inf, poles, residues, mapping
        condition = max(condition, spreads[k] / peaks[k])
    first_x, first_y, first_e = n + origin + 1, 2 * n + origin + 1, 2 * width + 2
    row, mode = 0, 0
    for i in range(n):
        pole, slope = roots[i], slopes[i]
        if pole.imag < 0.0:
            continue
        paired = pole.imag > 0.0
        poles[mode] = pole
        value, first = complex(0.0, 0.0), complex(0.0, 0.0)  # B and B' at the pole
        for k in range(b.size):
            first = first * pole + value
            value = value * pole + b[k]
        reciprocal = complex(1.0, 0.0)  # p^-l
        for _ in range(origin):
            reciprocal /= pole
        residues[mode, 0] = (2.0 if paired else 1.0) * value * reciprocal / slope
        power = reciprocal
        for k in range(n + origin):
            _add_mode(mapping, k, row, paired, power / slope)
            if k < n:
                # p^k B/(p^l A^2), a double pole: with f = p^(k-l) B it is f/A'^2 of w and (f' - f A''/A')/A'^2
                # of z.
                f = power * value
                f_slope = power * (first + (k - origin) * value / pole)
                squared = slope * slope
                _add_mode(mapping, first_x + k, row, paired, (f_slope - f * curvatures[i]) / squared)
                _add_mode(mapping, first_x + k, width + row, paired, f / squared)
                _add_mode(mapping, first_y + k, first_e + row, paired, power / reciprocal / slope)
            power *= pole
        row += 2 if paired else 1
        mode += 1
    if origin > 0:
        # Power series at the origin of 1/A, B/A and B/A^2: their terms are the weights of 1/p and of 1/p^2.
        a0, a1 = a[n], a[n - 1] if n > 0 else 0.0
        b0, b1 = b[b.size - 1], b[b.size - 2] if b.size > 1 else 0.0
        own = (1.0 / a0, -a1 / a0**2)
        output = (b0 * own[0], b1 * own[0] + b0 * own[1])
        driven = (output[0] * own[0], output[1] * own[0] + output[0] * own[1])
        for place in range(origin):
            residues[mode, place] = output[origin - 1 - place]
            for k in range(origin - place):
                mapping[k, row + place * width] = own[origin - 1 - place - k]
                if k < n:
                    mapping[first_x + k, row + place * width] = driven[origin - 1 - place - k]
    mapping[n + origin, 2 * width] = 1.0
    mapping[3 * n + origin + 1, 2 * width + 1] = 1.0
    # p x, where p^(n + l)/(p^l A) v = v - sum of a_k p^(n + l - k)/(p^l A) v.
    for i in range(b.size if n + origin > 0 else 0):
        power = b.size - i
        for column in range(mapping.shape[1]):
            mapping[3 * n + origin + 2, column] += b[i] * mapping[power, column]
            if power == n + origin:
                for k in range(1, n + 1):
                    mapping[3 * n + origin + 2, column] -= b[i] * a[k] * mapping[power - k, column]
    return condition, poles, residues, mapping


# --- response of a mode to a held input over a step -----------------------------------------------------------------
# All weights follow from f(x) = (exp(x) - 1 - x)/x^2 and its derivative at x = pole * step: with
# g = (exp(x) - 1)/x = 1 + x f and g' = f + x f', the decay is exp(x) = 1 + x g.


@njit(cache=True, nogil=True, fastmath={"contract"}, inline="always")
def _series(re: float, im: float) -> tuple[float, float, float, float]:
    """Return real and imaginary part of f and of f' at |x| <= 1, without cancellation for slow poles."""
    # Division of a real polynomial by t^2 - 2 re t + |x|^2, which is zero at x, leaves a linear remainder: two products
    # for each coefficient instead of four. last is the quotient's constant term at the end.
    twice, square = re + re, re * re + im * im
    before, last = 0.0, SERIES[14]
    for k in range(13, 0, -1):
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


@njit(cache=True, nogil=True, error_model="numpy")
def step_weights(pole: complex, step: float) -> tuple[complex, complex, complex, complex, complex, complex]:
    """Return the weights d, m, b, c, f, g of ``z = 1/(s - p) v``, ``w = 1/(s - p)^2 v`` over a step with v linear.

    ``z+ = d z + b v + c (change of v)`` and ``w+ = d w + m z + f v + g (change of v)``.
    """
    x = pole * step
    if x.real * x.real + x.imag * x.imag <= 1.0:
        f_re, f_im, slope_re, slope_im = _series(x.real, x.imag)
        f, slope = complex(f_re, f_im), complex(slope_re, slope_im)
        g, g_slope = 1.0 + x * f, f + x * slope
        decay = 1.0 + x * g
    else:
        # Divided by x throughout: 1 + x f would cancel for long steps.
        over = 1.0 / x
        decay = np.exp(x)
        g = (decay - 1.0) * over
        f, g_slope = (g - 1.0) * over, (decay - g) * over
        slope = (g - 2.0 * f) * over
    square = step * step
    return decay, step * decay, step * g, step * f, square * g_slope, square * slope


#: A regular clock: the interval, and shift and fraction of the delay ``(shift - fraction) interval``; else None.
Grid = tuple[float, int, float] | None
#: Any other clock: instants of the samples and of the breaks of the input, the delay, and the time by which a break may
#: be late and still count as reached; else None.
Instants = tuple[Array, Array, float, float] | None


# --- passes of modes over steps with held inputs ----------------------------------------------------------------------


@njit(cache=True, nogil=True, fastmath={"contract"})
def _weigh(
    pole: complex, double: bool, grid: Grid, instants: Instants, longest: float, count: int, steps: Array
) -> None:
    """Write the decay of a mode over each step of a block, and the terms that the held input adds to z and w.

    The parts of ``steps``, shape (PARTS, BLOCK): the gaps, the input and its change over them, and the results. On a
    grid all gaps are equal; on any other clock none is longer than ``longest``.
    """
    if grid is not None:
        decay, _, at_b, at_c, at_f, at_g = step_weights(pole, steps[GAP, 0])
        d_re, d_im, b_re, b_im, c_re, c_im = decay.real, decay.imag, at_b.real, at_b.imag, at_c.real, at_c.imag
        f_re, f_im, g_re, g_im = at_f.real, at_f.imag, at_g.real, at_g.imag
        for k in range(count):
            steps[DECAY_RE, k], steps[DECAY_IM, k] = d_re, d_im
            steps[SINGLE_RE, k] = b_re * steps[VALUE, k] + c_re * steps[CHANGE, k]
            steps[SINGLE_IM, k] = b_im * steps[VALUE, k] + c_im * steps[CHANGE, k]
        for k in range(count if double else 0):
            steps[DOUBLE_RE, k] = f_re * steps[VALUE, k] + g_re * steps[CHANGE, k]
            steps[DOUBLE_IM, k] = f_im * steps[VALUE, k] + g_im * steps[CHANGE, k]
    if instants is not None:
        size = abs(pole) * longest
        doublings = max(0, math.ceil(math.log2(size))) if 0.0 < size < np.inf else 0
        if doublings > MOST_DOUBLINGS:
            # Steps far longer than the memory of the mode.
            for k in range(count):
                decay, _, at_b, at_c, at_f, at_g = step_weights(pole, steps[GAP, k])
                single, double = (
                    at_b * steps[VALUE, k] + at_c * steps[CHANGE, k],
                    at_f * steps[VALUE, k] + at_g * steps[CHANGE, k],
                )
                steps[DECAY_RE, k], steps[DECAY_IM, k] = decay.real, decay.imag
                steps[SINGLE_RE, k], steps[SINGLE_IM, k] = single.real, single.imag
                steps[DOUBLE_RE, k], steps[DOUBLE_IM, k] = double.real, double.imag
            return
        scale = 0.5**doublings
        re, im = scale * pole.real, scale * pole.imag
        # f and f' are stored in the places of the weights computed from them.
        for k in range(count):
            steps[SINGLE_RE, k], steps[SINGLE_IM, k], steps[DOUBLE_RE, k], steps[DOUBLE_IM, k] = _series(
                re * steps[GAP, k], im * steps[GAP, k]
            )
        for _ in range(doublings):
            # f(2 x) = (g^2 + 2 f)/4, hence f'(2 x) = (g g' + f')/4. All steps double equally often: no branches.
            for k in range(count):
                x_re, x_im = re * steps[GAP, k], im * steps[GAP, k]
                f_re, f_im, slope_re, slope_im = (
                    steps[SINGLE_RE, k],
                    steps[SINGLE_IM, k],
                    steps[DOUBLE_RE, k],
                    steps[DOUBLE_IM, k],
                )
                g_re, g_im = 1.0 + x_re * f_re - x_im * f_im, x_re * f_im + x_im * f_re
                g_slope_re = f_re + x_re * slope_re - x_im * slope_im
                g_slope_im = f_im + x_re * slope_im + x_im * slope_re
                steps[SINGLE_RE, k] = 0.25 * (g_re * g_re - g_im * g_im) + 0.5 * f_re
                steps[SINGLE_IM, k] = 0.5 * (g_re * g_im + f_im)
                steps[DOUBLE_RE, k] = 0.25 * (g_re * g_slope_re - g_im * g_slope_im + slope_re)
                steps[DOUBLE_IM, k] = 0.25 * (g_re * g_slope_im + g_im * g_slope_re + slope_im)
            re, im = 2.0 * re, 2.0 * im
        for k in range(count):
            gap, value, change = steps[GAP, k], steps[VALUE, k], steps[CHANGE, k]
            x_re, x_im = pole.real * gap, pole.imag * gap
            f_re, f_im, slope_re, slope_im = (
                steps[SINGLE_RE, k],
                steps[SINGLE_IM, k],
                steps[DOUBLE_RE, k],
                steps[DOUBLE_IM, k],
            )
            g_re, g_im = 1.0 + x_re * f_re - x_im * f_im, x_re * f_im + x_im * f_re
            steps[DECAY_RE, k], steps[DECAY_IM, k] = 1.0 + x_re * g_re - x_im * g_im, x_re * g_im + x_im * g_re
            steps[SINGLE_RE, k] = gap * (g_re * value + f_re * change)
            steps[SINGLE_IM, k] = gap * (g_im * value + f_im * change)
            if not double:
                continue
            g_slope_re = f_re + x_re * slope_re - x_im * slope_im
            g_slope_im = f_im + x_re * slope_im + x_im * slope_re
            steps[DOUBLE_RE, k] = gap * gap * (g_slope_re * value + slope_re * change)
            steps[DOUBLE_IM, k] = gap * gap * (g_slope_im * value + slope_im * change)


@njit(cache=True, nogil=True, fastmath={"contract"})
def _advance(steps: Array, count: int, state: ComplexArray, rows: Array, w: int, paired: bool, begin: int) -> None:
    """Advance z and w of a mode over steps; the state after step k is written to column ``begin + k``.

    The rows begin with the real and imaginary part of z; those of w are ``w`` rows below (0: none). In real arithmetic,
    so that the state stays in registers. If ``begin`` is 1, column 0 is the state before all steps.
    """
    # The imaginary part of a real mode is zero, and written to the last row, which is never read.
    z_row, w_row = (1, w + 1) if paired else (rows.shape[0] - 1, rows.shape[0] - 1)
    z_re, z_im, w_re, w_im = state[0].real, state[0].imag, state[1].real, state[1].imag
    rows[0, 0], rows[z_row, 0] = z_re, z_im
    if w > 0:
        rows[w, 0], rows[w_row, 0] = w_re, w_im
        for k in range(count):
            # w+ = d (w + gap z) + …, from z before its step. Summed so that only two of the products depend on the
            # previous step.
            d_re, d_im, gap = steps[DECAY_RE, k], steps[DECAY_IM, k], steps[GAP, k]
            moved_re, moved_im = gap * z_re, gap * z_im
            driven_re = d_re * moved_re - d_im * moved_im + steps[DOUBLE_RE, k]
            driven_im = d_re * moved_im + d_im * moved_re + steps[DOUBLE_IM, k]
            new_re = d_re * w_re + (driven_re - d_im * w_im)
            w_im = d_re * w_im + (driven_im + d_im * w_re)
            w_re = new_re
            new_re = d_re * z_re + (steps[SINGLE_RE, k] - d_im * z_im)
            z_im = d_re * z_im + (steps[SINGLE_IM, k] + d_im * z_re)
            z_re = new_re
            at = begin + k
            rows[0, at], rows[z_row, at], rows[w, at], rows[w_row, at] = z_re, z_im, w_re, w_im
        state[1] = complex(w_re, w_im)
    else:
        for k in range(count):
            d_re, d_im = steps[DECAY_RE, k], steps[DECAY_IM, k]
            new_re = d_re * z_re + (steps[SINGLE_RE, k] - d_im * z_im)
            z_im = d_re * z_im + (steps[SINGLE_IM, k] + d_im * z_re)
            z_re = new_re
            rows[0, begin + k], rows[z_row, begin + k] = z_re, z_im
    state[0] = complex(z_re, z_im)


@njit(cache=True, nogil=True, fastmath={"contract"})
def _read_out(
    steps: Array, count: int, path: Array, instants: Instants, passed: IntArray, rows: Array, w: int, paired: bool
) -> None:
    """Write the states at the samples of a block: sample k is one step after state k of the path.

    On an irregular clock it is one step after state ``passed[k]``.
    """
    z_row, w_row = (1, w + 1) if paired else (rows.shape[0] - 1, rows.shape[0] - 1)
    for k in range(count):
        at = k
        if instants is not None:
            at = passed[k]
        d_re, d_im, z_re, z_im = steps[DECAY_RE, k], steps[DECAY_IM, k], path[0, at], path[1, at]
        rows[0, k] = steps[SINGLE_RE, k] + d_re * z_re - d_im * z_im
        rows[z_row, k] = steps[SINGLE_IM, k] + d_re * z_im + d_im * z_re
    for k in range(count if w > 0 else 0):
        at = k
        if instants is not None:
            at = passed[k]
        d_re, d_im, gap = steps[DECAY_RE, k], steps[DECAY_IM, k], steps[GAP, k]
        driven_re, driven_im = path[2, at] + gap * path[0, at], path[3, at] + gap * path[1, at]
        rows[w, k] = steps[DOUBLE_RE, k] + d_re * driven_re - d_im * driven_im
        rows[w_row, k] = steps[DOUBLE_IM, k] + d_re * driven_im + d_im * driven_re


@njit(cache=True, nogil=True, inline="always")
def _held(tu: Array, u: Array, foh: bool, at: int) -> tuple[float, float, float]:
    """Return the length of the step from a break, the input at its start, and its change over the step."""
    if at + 1 == tu.size:
        return 0.0, u[at], 0.0
    return tu[at + 1] - tu[at], u[at], u[at + 1] - u[at] if foh else 0.0


@njit(cache=True, nogil=True, inline="always")
def _irregular_steps(
    instants: Instants, u: Array, foh: bool, start: int, last: int, steps: Array, passed: IntArray
) -> tuple[int, int, int, float]:
    """Fill in the steps of a block on any clock: from break to break, up to delayed samples, from sample to sample.

    Returns the number of samples, the number of breaks reached, the last of these, and the longest step. ``passed`` is
    the number of breaks of the block before each sample. A block ends when samples or breaks fill it: if the input has
    far more breaks than the output has samples, some blocks contain no sample. Before the first break the states remain
    zero, by steps of length zero without input.
    """
    assert instants is not None
    t, tu, delay, slack = instants
    breaks, late, samples = steps[0], steps[1], steps[2]
    count, reached = min(BLOCK, t.size - start), 0
    gap, value, change = 0.0, 0.0, 0.0
    longest_gap, latest, longest_interval = 0.0, 0.0, 0.0
    if last >= 0:
        gap, value, change = _held(tu, u, foh, last)
    for k in range(count):
        instant = t[start + k] - delay
        while last + 1 < tu.size and tu[last + 1] <= instant + slack:
            if reached == BLOCK:
                return k, reached, last, max(longest_gap, latest, longest_interval)
            breaks[GAP, reached], breaks[VALUE, reached], breaks[CHANGE, reached] = gap, value, change
            longest_gap = max(longest_gap, gap)
            reached, last = reached + 1, last + 1
            gap, value, change = _held(tu, u, foh, last)
        # Read out between this break and the next; the states stay at this one.
        step = max(0.0, instant - tu[last]) if last >= 0 else 0.0
        passed[k] = reached
        late[GAP, k], late[VALUE, k], late[CHANGE, k] = step, value, change * (step / gap) if change != 0.0 else 0.0
        samples[GAP, k] = t[start + k] - t[max(start + k - 1, 0)]
        latest, longest_interval = max(latest, step), max(longest_interval, samples[GAP, k])
    return count, reached, last, max(longest_gap, latest, longest_interval)


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _emit(block: Array, count: int, use: BoolArray, start: int, gram: Array, rows: Array, written: int) -> int:
    """Add the used columns of a block to the upper part of the moments, or to the rows; return the number of rows.

    Moments are the products of leading rows with all following rows, in tiles of two by four rows: each number that is
    loaded enters several products, and the eight sums are independent. Block and moments are padded to whole tiles.
    """
    kept = 0
    for k in range(count):
        if use[start + k]:
            if kept < k:
                for i in range(block.shape[0]):
                    block[i, kept] = block[i, k]
            kept += 1
    for k in range(kept if rows.size else 0):
        for i in range(rows.shape[1]):
            rows[written + k, i] = block[i, k]
    for i in range(0, gram.shape[0] - 1, 2):
        one, two = block[i], block[i + 1]
        # Superfluous products below the diagonal of a tile are overwritten at the end.
        for j in range(i, gram.shape[1] - 3, 4):
            a, b, c, d = block[j], block[j + 1], block[j + 2], block[j + 3]
            one_a, one_b, one_c, one_d, two_a, two_b, two_c, two_d = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for k in range(kept):
                one_a += one[k] * a[k]
                one_b += one[k] * b[k]
                one_c += one[k] * c[k]
                one_d += one[k] * d[k]
                two_a += two[k] * a[k]
                two_b += two[k] * b[k]
                two_c += two[k] * c[k]
                two_d += two[k] * d[k]
            gram[i, j] += one_a
            gram[i, j + 1] += one_b
            gram[i, j + 2] += one_c
            gram[i, j + 3] += one_d
            gram[i + 1, j] += two_a
            gram[i + 1, j + 1] += two_b
            gram[i + 1, j + 2] += two_c
            gram[i + 1, j + 3] += two_d
    return written + kept


@njit(cache=True, nogil=True, fastmath={"contract"})
def filter_pass(
    poles: ComplexArray,
    owner: IntArray,
    residues: ComplexArray,
    direct: Array,
    states: ComplexArray,
    grid: Grid,
    instants: Instants,
    instruments: tuple[Array, bool],
    measured: Array,
    output: tuple[Array, bool],
    use: BoolArray,
    layout: tuple[int, int, int],
    gram: Array,
    rows: Array,
    simulated: Array,
) -> None:
    """Filter a record by the modes of one model or of several submodels.

    On a regular clock ``grid`` is the interval, and shift and fraction of the delay ``(shift - fraction) interval``; on
    any other it is None, and ``instants`` are those of the samples and of the breaks of the input, the delay, and the
    time by which a break may be late and still count as reached. Code for the other kind of clock is not compiled.
    ``instruments`` are the values of v at the breaks and whether they are interpolated linearly; ``measured`` those of
    u if it differs from v, else empty; ``output`` the samples of y and whether they are interpolated linearly. Mode i
    belongs to submodel ``owner[i]``, whose output is ``x = sum Re(residues z) + direct u``. The rows of a pass are z;
    w; v; ``y - sum x``; e, driven by y less the outputs of the other submodels; and z and w of u, and u, if u differs
    from v. ``layout`` has the row numbers of w, v and e (0: not requested). ``states`` are z, w, e, and z and w of u at
    the first sample, and are overwritten by those after the last one. ``gram`` receives the products of its leading
    rows with all rows, ``rows`` the rows of the used samples, and ``simulated`` the output x at every sample; empty
    arrays are not filled.
    """
    v, foh = instruments
    y, y_foh = output
    w_row, v_row, e_row = layout
    first = np.zeros(poles.size + 1, np.int64)
    for i in range(poles.size):
        first[i + 1] = first[i] + (2 if poles[i].imag != 0.0 else 1)
    n, submodels = first[poles.size], direct.size
    sources = 2 if measured.size > 0 else 1
    u_row = e_row + n if sources == 2 else 0
    u_place, u_square = (u_row + 2 * n, n) if sources == 2 else (v_row, w_row)
    block = np.zeros((max(rows.shape[1], gram.shape[1], v_row + 2) + 3, WIDTH))
    outputs, before = np.zeros((submodels, BLOCK)), np.zeros(submodels)
    # The steps from break to break, from the last break to a delayed sample, and from sample to sample.
    steps, path, passed = np.zeros((3, PARTS, BLOCK)), np.zeros((4, WIDTH)), np.zeros(BLOCK, np.int64)
    breaks, late, samples = steps[0], steps[1], steps[2]
    start, last, written, longest, part = 0, -1, 0, 0.0, 1.0
    if grid is not None:
        part = grid[2]
        breaks[GAP], late[GAP], samples[GAP] = grid[0], part * grid[0], grid[0]
    while start < y.size:
        count = min(BLOCK, y.size - start)
        reached = count
        for source in range(sources):
            u = v if source == 0 else measured
            base, square, place = (0, w_row, v_row) if source == 0 else (u_row, u_square, u_place)
            if grid is not None:
                # Sample k depends on the input from break start + k - shift on; zero if that is negative.
                for k in range(count):
                    at = start + k - grid[1]
                    breaks[VALUE, k] = late[VALUE, k] = u[at] if at >= 0 else 0.0
                    breaks[CHANGE, k] = u[at + 1] - u[at] if foh and 0 <= at < u.size - 1 else 0.0
                    late[CHANGE, k] = part * breaks[CHANGE, k]
            if instants is not None:
                count, reached, last, longest = _irregular_steps(instants, u, foh, start, last, steps, passed)
            for k in range(count):
                block[place, k] = late[VALUE, k] + late[CHANGE, k]
            for i in range(poles.size):
                paired, state, own = poles[i].imag != 0.0, states[i, 3 * source :], block[base + first[i] :]
                _weigh(poles[i], square > 0, grid, instants, longest, reached, breaks)
                if part == 0.0:
                    _advance(breaks, reached, state, own, square, paired, 1)
                else:
                    _advance(breaks, reached, state, path, 2 if square > 0 else 0, True, 1)
                    _weigh(poles[i], square > 0, grid, instants, longest, count, late)
                    _read_out(late, count, path, instants, passed, own, square, paired)
        # x of each submodel, and y less the sum of them.
        error = block[v_row + 1]
        for k in range(count):
            error[k] = y[start + k]
        for i in range(submodels):
            for k in range(count):
                outputs[i, k] = direct[i] * block[u_place, k]
        for i in range(poles.size):
            own, x = block[u_row + first[i] :], outputs[owner[i]]
            single, double = residues[i, 0], residues[i, 1].real
            for k in range(count):
                x[k] += single.real * own[0, k]
            if poles[i].imag != 0.0:
                for k in range(count):
                    x[k] -= single.imag * own[1, k]
            if double != 0.0:
                for k in range(count):
                    x[k] += double * own[u_square, k]
        for i in range(submodels):
            for k in range(count):
                error[k] -= outputs[i, k]
        if simulated.size:
            for k in range(count):
                simulated[start + k] = y[start + k] - error[k]
        if e_row > 0:
            # y less the outputs of the other submodels drives e.
            for i in range(submodels):
                for k in range(count):
                    outputs[i, k] += error[k]
            for i in range(poles.size):
                paired, left, own = poles[i].imag != 0.0, outputs[owner[i]], block[e_row + first[i] :]
                for k in range(count):
                    earlier = left[k - 1] if k > 0 else before[owner[i]]
                    samples[VALUE, k], samples[CHANGE, k] = earlier, left[k] - earlier if y_foh else 0.0
                _weigh(poles[i], False, grid, instants, longest, count, samples)
                if start == 0 and count > 0:
                    # The first sample has no step before it.
                    samples[DECAY_RE, 0], samples[DECAY_IM, 0] = 1.0, 0.0
                    samples[SINGLE_RE, 0], samples[SINGLE_IM, 0] = 0.0, 0.0
                _advance(samples, count, states[i, 2:], own, 0, paired, 0)
            for i in range(submodels):
                if count > 0:
                    before[i] = outputs[i, count - 1]
        if gram.size or rows.size:
            written = _emit(block, count, use, start, gram, rows, written)
        start += count
    # Only the upper part was summed.
    for i in range(gram.shape[0]):
        for j in range(i):
            gram[i, j] = gram[j, i]


# --- chains, for repeated poles -------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def regular_states(
    transition: Array, from_value: Array, from_change: Array, values: Array, changes: Array, initial: Array
) -> Array:
    """Return the states ``z+ = F z + g value + h change`` of a chain before each of its steps, shape (N, n).

    F is zero above its first superdiagonal.
    """
    n = initial.size
    states = np.zeros((values.size, n))
    for i in range(n if values.size else 0):
        states[0, i] = initial[i]
    for k in range(values.size - 1):
        now, following = states[k], states[k + 1]
        for i in range(n):
            total = from_value[i] * values[k] + from_change[i] * changes[k]
            for m in range(min(i + 2, n)):
                total += transition[i, m] * now[m]
            following[i] = total
    return states


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _chain_step(
    powers: Array,
    quantum: float,
    starts: IntArray,
    columns: IntArray,
    values: Array,
    step: float,
    state: Array,
    work: Array,
) -> None:
    """Advance ``state = [z, v, v']`` of a chain by ``step``, in place, see `irregular_states`."""
    # Digits from the lowest up; the transitions commute. The table ends at the longest step, so that only rounding can
    # give its last level more than one digit.
    size = state.size
    n = size - 2
    whole = math.floor(step / quantum)
    rest = step - whole * quantum
    level = 0
    while whole > 0.0 and level < powers.shape[0]:
        shifted = math.floor(whole / BASE)
        digit = int(whole - shifted * BASE)
        if level == powers.shape[0] - 1:
            digit = min(int(whole), BASE - 1)
        if digit > 0:
            power = powers[level, digit]
            # Zero above the first superdiagonal, except for the two columns of the signal.
            for i in range(n):
                total = power[i, n] * state[n] + power[i, n + 1] * state[n + 1]
                for m in range(min(i + 2, n)):
                    total += power[i, m] * state[m]
                work[0, i] = total
            state[n] += power[n, n + 1] * state[n + 1]
            for i in range(n):
                state[i] = work[0, i]
        whole = shifted
        level += 1
    # The remaining fraction of a quantum: sum of (M rest)^d/d! applied to the state, term by term; M is sparse.
    if rest > 0.0:
        term, following = work[0], work[1]
        for i in range(size):
            term[i] = state[i]
        for degree in range(1, TAYLOR_DEGREE + 1):
            for i in range(size):
                total = 0.0
                for k in range(starts[i], starts[i + 1]):
                    total += values[k] * term[columns[k]]
                following[i] = total * rest / degree
            for i in range(size):
                state[i] += following[i]
            term, following = following, term


@njit(cache=True, nogil=True)
def irregular_states(
    powers: Array,
    quantum: float,
    starts: IntArray,
    columns: IntArray,
    values: Array,
    tu: Array,
    u: Array,
    foh: bool,
    instants: Array,
    slack: float,
    initial: Array,
) -> Array:
    """Return the states ``[z, v, v']`` of a chain at rising instants, shape (N, n + 2).

    ``powers[level, digit]`` are the transitions over ``digit BASE^level`` quanta; ``starts``, ``columns`` and
    ``values`` the nonzero entries of the dynamics, row by row; ``initial`` the state at the first break, before which
    everything is zero.
    """
    size = initial.size + 2
    states = np.zeros((instants.size, size))
    base, work = np.zeros(size), np.zeros((2, size))
    for i in range(initial.size):
        base[i] = initial[i]
    j = -1  # the last break that has been reached
    for k in range(instants.size):
        # A break that is late by rounding only counts as reached.
        while j + 1 < tu.size and tu[j + 1] <= instants[k] + slack:
            if j >= 0:
                _chain_step(powers, quantum, starts, columns, values, tu[j + 1] - tu[j], base, work)
            j += 1
            base[size - 2], base[size - 1] = u[j], 0.0
            if foh and j + 1 < tu.size:
                base[size - 1] = (u[j + 1] - u[j]) / (tu[j + 1] - tu[j])
        if j >= 0:
            # Read out on a copy, so that the recursion does not depend on the delay.
            now = states[k]
            for i in range(size):
                now[i] = base[i]
            _chain_step(powers, quantum, starts, columns, values, max(0.0, instants[k] - tu[j]), now, work)
    return states


# --- loops ----------------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def loop_signals(
    plant: tuple[Array, Array, Array, float, int],
    law: tuple[Array, Array, Array, float],
    relay: tuple[float, float, float],
    r: Array,
    v: Array,
    before: float,
    push: Array,
    start: tuple[Array, Array, Array],
) -> tuple[Array, Array, Array]:
    """Simulate a sampled plant ``F, g, c, direct, shift`` in a loop with a controller ``A, B, C, D``.

    Returns input, noise-free output and plant states. The output of a relay (amplitude, hysteresis, bias) is added to
    that of the controller; without a relay its amplitude is 0. ``before`` is 1 if r enters before the controller, else
    0. ``push``, shape (N, n) or (0, n), is added to the plant's next states. ``start`` has the states of plant and
    controller, and the inputs before the first sample.
    """
    F, g, c, direct, shift = plant
    A, B, C, D = law
    amplitude, hysteresis, bias = relay
    n, m, pushed = g.size, B.size, push.shape[0] > 0
    # If plant and controller both have direct feedthrough, the loop is algebraic: solve it for the input.
    own = direct if shift == 0 else 0.0
    closing = 1.0 / (1.0 + D * own)
    u, x, states = np.empty(r.size), np.empty(r.size), np.empty((r.size, n))
    z, z_next = start[0].copy(), np.zeros(n)
    s, s_next = start[1].copy(), np.zeros(m)
    side, free, held, late = 1.0, 0.0, 0.0, start[2]
    for i in range(n):
        free += c[i] * z[i]
    for i in range(m):
        held += C[i] * s[i]
    for k in range(r.size):
        # x from earlier inputs.
        arriving = 0.0
        if shift > 0:
            arriving = u[k - shift] if shift <= k else late[k]
        output = free + direct * arriving
        error = before * r[k] - v[k] - output
        # Within the hysteresis the relay keeps its value.
        if error > hysteresis:
            side = 1.0
        elif error < -hysteresis:
            side = -1.0
        value = (held + (1.0 - before) * r[k] + bias + amplitude * side + D * error) * closing
        if shift == 0:
            arriving = value
        u[k], x[k] = value, output + own * value
        # Advance both states to the next sample.
        error -= own * value
        free, held = 0.0, 0.0
        for i in range(n):
            total = g[i] * arriving
            for j in range(n):
                total += F[i, j] * z[j]
            if pushed:
                total += push[k, i]
            states[k, i] = z[i]
            z_next[i] = total
            free += c[i] * total
        for i in range(m):
            total = B[i] * error
            for j in range(m):
                total += A[i, j] * s[j]
            s_next[i] = total
            held += C[i] * total
        z, z_next = z_next, z
        s, s_next = s_next, s
    return u, x, states


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def loop_input(
    poles: ComplexArray,
    residues: ComplexArray,
    direct: float,
    clock: tuple[float, int, float],
    reference: Array,
    numerator: Array,
    denominator: Array,
    at_controller: bool,
) -> Array:
    """Return the input of the noise-free loop of a modal model with a discrete controller, from rest, shape (N,).

    The model and its clock are those of `filter_pass`. The controller has polynomials of one length in descending
    powers of q; the reference enters before or behind it.
    """
    interval, shift, fraction = clock
    modes, order = poles.size, numerator.size - 1
    v = np.zeros(reference.size)
    # Over a whole interval z+ = d z + b v and w+ = d w + m z + f v; x at the read-out instant, a fraction of an
    # interval after the break, follows from the states at the break and from the delayed input.
    weights = np.zeros((modes, 4), np.complex128)
    read = np.zeros((modes, 2), np.complex128)
    gain = direct
    for i in range(modes):
        decay, mixed, at_b, _, at_f, _ = step_weights(poles[i], interval)
        weights[i, 0], weights[i, 1], weights[i, 2], weights[i, 3] = decay, mixed, at_b, at_f
        decay, mixed, at_b, _, at_f, _ = step_weights(poles[i], fraction * interval)
        read[i, 0] = residues[i, 0] * decay + residues[i, 1] * mixed
        read[i, 1] = residues[i, 1] * decay
        gain += (residues[i, 0] * at_b + residues[i, 1] * at_f).real
    z, w = np.zeros(modes, np.complex128), np.zeros(modes, np.complex128)
    # The controller in transposed direct form II, with a zero after its states. Its direct feedthrough and that of a
    # model without delay form an algebraic loop.
    memory = np.zeros(order + 1)
    own = gain if shift == 0 else 0.0
    first = numerator[0]
    closing = 1.0 / (1.0 + first * own)
    x = 0.0
    for k in range(v.size):
        # x_k from the inputs before sample k.
        arrived = v[k - shift] if 0 < shift <= k else 0.0
        x += gain * arrived
        # v_k = C (r - x), or r - C x, solved for v_k if x_k depends on v_k.
        error = reference[k] - x if at_controller else -x
        value = memory[0] + first * error
        if not at_controller:
            value += reference[k]
        value *= closing
        v[k] = value
        # The model over a whole interval, driven by the delayed input; and its contribution to the next x.
        last = value if shift == 0 else arrived
        x = 0.0
        for i in range(modes):
            if residues[i, 1] != 0.0:
                w[i] = weights[i, 0] * w[i] + weights[i, 1] * z[i] + weights[i, 3] * last
                x += (read[i, 1] * w[i]).real
            z[i] = weights[i, 0] * z[i] + weights[i, 2] * last
            x += (read[i, 0] * z[i]).real
        # The controller's state depends on the whole error, including the direct effect of v_k on x_k.
        error -= own * value
        response = memory[0] + first * error
        for m in range(order):
            memory[m] = numerator[m + 1] * error - denominator[m + 1] * response + memory[m + 1]
    return v
