r"""A frequency response by local polynomials: spectra of input and output, fitted over a few neighbouring lines.

Between the finite spectra of a record the system holds up to a transient T, which is as smooth as the response:
``Y(k) = G(k) U(k) + T(k) + V(k)``. Around each line G and T are polynomials of degree 2 in the number of the line, six
complex parameters, found by least squares over ``2 n + 1`` lines. The residuals give the variance of V, and with it
that of G. Leakage is thus estimated, not windowed away.

R. Pintelon and J. Schoukens, *System Identification: A Frequency Domain Approach*, 2nd ed., Wiley, 2012, chapter 7.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array, BoolArray, ComplexArray, IntArray
from ctid_cli.errors import DataError
from ctid_cli.inference.response_lines import ResponseLines

#: Degree of the polynomials, and parameters of both together.
DEGREE = 2
PARAMETERS = 2 * (DEGREE + 1)
#: Half-widths that are tried [lines]; the least leaves three degrees of freedom.
HALF_WIDTHS = (4, 6, 8, 11, 16, 22, 32, 45, 64, 90, 128)
#: The greatest width whose residuals are no larger than those of the least one is divided by this. A bias as large as
#: the standard error is not seen in residuals, and falls with the third power of the width or faster.
NARROWER = 2.0
#: A peak narrower than a window leaves large residuals and is flattened by more than its interval. There is none where
#: the residuals of the least width exceed their usual power within a number of lines by this factor, and the gain is
#: above this share of the greatest one in the window. At 500 samples, of the tops of resonances with a damping ratio
#: of .03 to .1 at two to eight periods of the record, one in ten is drawn then; unguarded, 30 to 50 % were covered.
PEAK_RESIDUALS, USUAL, PEAK_GAIN = 8.0, 32, 0.5
#: A width that was asked for is too wide where its residuals exceed those of the least one by this number of standard
#: deviations of their ratio.
TOO_WIDE = 2.0
#: Equations whose columns, scaled to one length, have a greater condition number say nothing of the response.
SINGULAR = 1e6
#: Lines on which the input has less than this share of its greatest amplitude do not excite.
EXCITED = 1e-8


class _LocalFit(NamedTuple):
    """Local polynomials at some centres, one half-width."""

    response: ComplexArray
    variance: Array
    #: Mean square of the residuals, and their degrees of freedom.
    noise: Array
    freedom: Array
    determined: BoolArray


def local_polynomial(
    u: ComplexArray, y: ComplexArray, base: float, points: int, half_width: int | None, time_unit: str
) -> ResponseLines:
    """Response from spectra at the frequencies ``base, 2 base, …`` at up to ``points`` of them.

    Without a half-width each centre has half of the greatest one that fits the lines as well as the least one does.
    """
    lines = u.size
    least = half_width or HALF_WIDTHS[0]
    if lines < 2 * least + 1:
        raise DataError(
            f"a frequency response needs at least {2 * (2 * least + 1)} samples; a local polynomial found {lines} lines"
        )
    most = min(max(lines // 3, 2 * HALF_WIDTHS[1] + 1), lines)
    widths = np.array(sorted({n for n in HALF_WIDTHS if 2 * n + 1 <= most} | {least}))
    centres = _centres(lines, points)
    fits = [_fit(u, y, centres, int(n)) for n in widths]
    excess = _excess(fits, widths, centres)
    if half_width:
        chosen = np.full(centres.size, np.searchsorted(widths, half_width), dtype=np.int64)
    else:
        chosen = _choose(excess, np.array([fit.determined for fit in fits]), widths)
    pick = np.arange(centres.size)
    response, variance, noise, freedom, known = (np.array([fit[k] for fit in fits])[chosen, pick] for k in range(5))
    told = _told(fits[0], centres) | (chosen > 1)
    if half_width:
        told &= excess[chosen, pick] <= 1.0 + TOO_WIDE / np.sqrt(half_width)
    power = np.convolve(np.abs(u) ** 2, np.ones(9), "same") / np.convolve(np.ones(lines), np.ones(9), "same")
    followed = np.abs(response) ** 2 * power[centres]
    known = known.astype(bool) & np.isfinite(variance)
    coherence = np.divide(followed, followed + noise, out=np.zeros(centres.size), where=followed + noise > 0)
    used = sorted({int(widths[k]) for k in chosen[known]})
    places = base * (centres[known] + 1.0)
    notes = _words(used, base, half_width is None, places[~told[known]], time_unit)
    return ResponseLines(
        places, response[known], variance[known], freedom[known], coherence[known], None, notes, told[known]
    )


def _words(used: list[int], base: float, chosen: bool, untold: Array, time_unit: str) -> tuple[str, ...]:
    if not used:
        return ()
    span = f"{2 * used[0] + 1}" if len(used) == 1 else f"{2 * used[0] + 1} to {2 * used[-1] + 1}"
    how = "half of the most that fit as well as the fewest do" if chosen else "as given"
    text = (
        f"Each estimate is from {span} lines, {base:.4g} rad/{time_unit} apart, {how}; estimates closer than that "
        "share data."
    )
    if not untold.size:
        return (text,)
    return (
        text,
        f"No interval at {untold.size} of the frequencies, between {untold[0]:.3g} and {untold[-1]:.3g} "
        f"rad/{time_unit}: the response turns there within the lines of one estimate, as on a narrow peak, and may be "
        f"off by more than the noise shows. A longer record resolves it{'' if chosen else ', or a smaller width'}.",
    )


def _centres(lines: int, points: int) -> IntArray:
    """Places of the lines at which the response is estimated: all, or about evenly spaced logarithmically."""
    if lines <= points:
        return np.arange(lines)
    return np.unique(np.round(np.geomspace(1, lines, points)).astype(np.int64)) - 1


def _fit(u: ComplexArray, y: ComplexArray, centres: IntArray, n: int) -> _LocalFit:
    """Least squares around all centres; at the ends of the band the lines of a window lie on one side."""
    # Below zero spectra are conjugate: a window may go on there. Line zero went with the means.
    window = np.minimum(centres, u.size - 1 - n)[:, None] + np.arange(-n, n + 1)
    place = (window - centres[:, None]) / n
    present = window != -1
    mirrored = window < 0
    index = np.where(mirrored, np.maximum(-window - 2, 0), window)
    inputs, outputs = (np.where(mirrored, x[index].conj(), x[index]) * present for x in (u, y))
    powers = place[:, :, None] ** np.arange(DEGREE + 1) * present[:, :, None]
    columns = np.concatenate((powers * inputs[:, :, None], powers), axis=2)
    lengths = np.linalg.norm(columns, axis=1, keepdims=True)
    excited = lengths[:, 0, 0] > EXCITED * float(np.abs(u).max())
    scaled = columns / np.where(lengths > 0, lengths, 1.0)
    left, singular, right = np.linalg.svd(scaled, full_matrices=False)
    determined = excited & (singular[:, -1] * SINGULAR > singular[:, 0])
    inverse = np.where(determined[:, None], 1.0 / np.maximum(singular, 1e-300), 0.0)
    projected = np.einsum("kij,ki->kj", left.conj(), outputs)
    parameters = np.einsum("kji,kj->ki", right.conj(), inverse * projected)
    residuals = outputs - np.einsum("kij,kj->ki", left, projected)
    freedom = present.sum(axis=1).astype(np.float64) - PARAMETERS
    noise = np.square(np.abs(residuals)).sum(axis=1) / freedom
    # The first row of the pseudo-inverse is that of the response at the centre.
    first = np.square(np.abs(right[:, :, 0].conj() * inverse)).sum(axis=1)
    scale = np.where(lengths[:, 0, 0] > 0, lengths[:, 0, 0], 1.0)
    return _LocalFit(parameters[:, 0] / scale, noise * first / scale**2, noise, freedom, determined)


def _excess(fits: list[_LocalFit], widths: IntArray, centres: IntArray) -> Array:
    """Power of the residuals of each width over that of the least one on the same lines, shape (widths, centres)."""
    least = fits[0]
    total = np.concatenate(([0.0], np.cumsum(np.where(least.determined, least.noise, 0.0))))
    number = np.concatenate(([0], np.cumsum(least.determined)))
    excess = np.zeros((widths.size, centres.size))
    for row, fit, n in zip(excess, fits, widths, strict=True):
        first, last = np.searchsorted(centres, centres - n), np.searchsorted(centres, centres + n, side="right")
        count = number[last] - number[first]
        usual = (total[last] - total[first]) / np.maximum(count, 1)
        # Where the least width says nothing there is nothing to exceed.
        np.divide(fit.noise, usual, out=row, where=(count > 0) & fit.determined & (usual > 0))
    return excess


def _told(least: _LocalFit, centres: IntArray) -> BoolArray:
    """Whether the least width is narrow enough for what is seen in it."""
    gain = np.abs(least.response)
    usual = _around(least.noise, centres, USUAL, np.median)
    greatest = _around(gain, centres, HALF_WIDTHS[0], np.max)
    return np.asarray((least.noise <= PEAK_RESIDUALS * usual) | (gain < PEAK_GAIN * greatest))


def _around(values: Array, centres: IntArray, reach: int, measure: Callable[[Array], float]) -> Array:
    """Return a measure of the values at all centres within a given number of lines."""
    first, last = np.searchsorted(centres, centres - reach), np.searchsorted(centres, centres + reach, side="right")
    return np.array([measure(values[a:b]) for a, b in zip(first, last, strict=True)])


def _choose(excess: Array, determined: BoolArray, widths: IntArray) -> IntArray:
    """Number of the half-width of each centre."""
    fitting = np.cumprod(excess[1:] <= 1.0, axis=0).sum(axis=0)
    target = np.maximum(widths[fitting] / NARROWER, widths[0])
    chosen = np.searchsorted(widths, 1.01 * target, side="right") - 1
    # Where a narrow window says nothing, the narrowest one that does.
    first = np.where(determined.any(axis=0), np.argmax(determined, axis=0), 0)
    able = determined[chosen, np.arange(chosen.size)]
    return np.asarray(np.where(able, chosen, np.maximum(first, chosen)), dtype=np.int64)
