r"""A frequency response by local polynomials: spectra of input and output, fitted over a few neighbouring lines.

Between the finite spectra of a record the system holds up to a transient T, which is as smooth as the response:
``Y(k) = G(k) U(k) + T(k) + V(k)``. Around each line G and T are polynomials of degree 2 in the number of the line, six
complex parameters, found by least squares over ``2 n + 1`` lines. The residuals give the variance of V, and with it
that of G. Leakage is thus estimated, not windowed away.

R. Pintelon and J. Schoukens, *System Identification: A Frequency Domain Approach*, 2nd ed., Wiley, 2012, chapter 7.
"""

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
#: A width is chosen by the errors at this share of all centres, those next to each other.
NEIGHBOURS = 0.12
#: The width with the least error of prediction is divided by this: the bias falls faster than the variance rises.
NARROWER = 1.4
#: Equations whose columns, scaled to one length, have a greater condition number say nothing of the response.
SINGULAR = 1e6
#: Lines on which the input has less than this share of its greatest amplitude do not excite.
EXCITED = 1e-8


class _LocalFit(NamedTuple):
    """Local polynomials at some centres, one half-width."""

    response: ComplexArray
    variance: Array
    #: Mean square of the residuals, and the error at the centre of a fit without the centre.
    noise: Array
    left_out: Array
    determined: BoolArray


def local_polynomial(
    u: ComplexArray, y: ComplexArray, base: float, points: int, half_width: int | None
) -> ResponseLines:
    """Response from spectra at the frequencies ``base, 2 base, …`` at up to ``points`` of them.

    Without a half-width each centre has the one that predicts the outputs on the lines around it best from their
    neighbours, made narrower.
    """
    lines = u.size
    widths = [half_width] if half_width else [n for n in HALF_WIDTHS if 2 * n + 1 <= max(lines // 3, 9)]
    if lines < 2 * min(widths) + 1:
        needed = 2 * (2 * min(widths) + 1)
        raise DataError(f"a frequency response needs at least {needed} samples; a local polynomial found {lines} lines")
    centres = _centres(lines, points)
    fits = [_fit(u, y, centres, n) for n in widths]
    chosen = _choose([fit.left_out for fit in fits], [fit.determined for fit in fits], np.array(widths, dtype=float))
    pick = np.arange(centres.size)
    response, variance, noise, known = (np.array([fit[k] for fit in fits])[chosen, pick] for k in (0, 1, 2, 4))
    freedom = 2 * np.array(widths, dtype=float)[chosen] + 1 - PARAMETERS
    power = np.convolve(np.abs(u) ** 2, np.ones(9), "same") / np.convolve(np.ones(lines), np.ones(9), "same")
    followed = np.abs(response) ** 2 * power[centres]
    known = known.astype(bool) & np.isfinite(variance)
    coherence = np.divide(followed, followed + noise, out=np.zeros(centres.size), where=followed + noise > 0)
    used = sorted({widths[k] for k in chosen[known]})
    note = _words(used, base, half_width is None)
    places, notes = base * (centres[known] + 1.0), (note,) if used else ()
    return ResponseLines(places, response[known], variance[known], freedom[known], coherence[known], None, notes)


def _words(used: list[int], base: float, chosen: bool) -> str:
    if not used:
        return ""
    span = f"{2 * used[0] + 1}" if len(used) == 1 else f"{2 * used[0] + 1} to {2 * used[-1] + 1}"
    how = "chosen where the neighbours foretell each line best" if chosen else "as given"
    return f"Each estimate is from {span} lines, {base:.4g} rad/s apart, {how}; estimates closer than that share data."


def _centres(lines: int, points: int) -> IntArray:
    """Places of the lines at which the response is estimated: all, or about evenly spaced logarithmically."""
    if lines <= points:
        return np.arange(lines)
    return np.unique(np.round(np.geomspace(1, lines, points)).astype(np.int64)) - 1


def _fit(u: ComplexArray, y: ComplexArray, centres: IntArray, n: int) -> _LocalFit:
    """Least squares around all centres; at the ends of the band the lines of a window lie on one side."""
    begins = np.clip(centres - n, 0, u.size - (2 * n + 1))
    window = begins[:, None] + np.arange(2 * n + 1)
    place = (window - centres[:, None]) / n
    powers = place[:, :, None] ** np.arange(DEGREE + 1)
    inputs, outputs = u[window], y[window]
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
    noise = np.square(np.abs(residuals)).sum(axis=1) / (2 * n + 1 - PARAMETERS)
    # The first row of the pseudo-inverse is that of the response at the centre.
    first = np.square(np.abs(right[:, :, 0].conj() * inverse)).sum(axis=1)
    scale = np.where(lengths[:, 0, 0] > 0, lengths[:, 0, 0], 1.0)
    rows = np.arange(centres.size)
    middle = centres - begins
    leverage = np.square(np.abs(left[rows, middle])).sum(axis=1)
    left_out = np.abs(residuals[rows, middle]) / np.maximum(1.0 - leverage, 1e-9)
    return _LocalFit(parameters[:, 0] / scale, noise * first / scale**2, noise, left_out**2, determined)


def _choose(errors: list[Array], determined: list[BoolArray], widths: Array) -> IntArray:
    """Number of the half-width of each centre."""
    count = errors[0].size
    reach = max(1, min(count, 2 * round(NEIGHBOURS * count / 2) + 1))
    around = np.ones(reach)
    means = []
    for error, known in zip(errors, determined, strict=True):
        weight = np.convolve(known.astype(float), around, "full")[reach // 2 :][:count]
        total = np.convolve(np.where(known, error, 0.0), around, "full")[reach // 2 :][:count]
        means.append(np.where(weight > 0, total / np.maximum(weight, 1.0), np.inf))
    best = widths[np.argmin(means, axis=0)] / NARROWER
    chosen = np.searchsorted(widths, np.maximum(best, widths[0]) * 1.01, side="right") - 1
    # Where a narrow window says nothing, the narrowest one that does.
    able = np.array(determined)
    first = np.where(able.any(axis=0), np.argmax(able, axis=0), 0)
    picked = np.where(able[chosen, np.arange(count)], chosen, np.maximum(first, chosen))
    return np.asarray(picked, dtype=np.int64)
