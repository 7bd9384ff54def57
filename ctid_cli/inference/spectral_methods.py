r"""Nonparametric estimates of a frequency response: local polynomials, periodic signals, and Welch's method.

The spectrum of samples of interval h is the sum of the spectrum over all aliased frequencies. With ``w_s = 2 pi/h``, an
input held between its samples has the spectrum ``H(w) U(w)`` at each of them,

.. math:: H_{zoh} = \frac{1 - e^{-jwh}}{jwh}, \quad H_{foh} = \Big(\frac{\sin(wh/2)}{wh/2}\Big)^2, \quad H_{bl} = 1,

the last one below half of w_s only. The output over the input and H is ``G(jw) + sum_m G(j(w + m w_s)) H(w + m w_s) /
H(w)``, m ≠ 0: the response and its images, which decrease with the sampling interval.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array, BoolArray, ComplexArray, IntArray
from ctid_cli.errors import DataError
from ctid_cli.progress import reported
from ctid_cli.signals.treatment import Hold

#: Number of images on each side in the sum; the others add less than a hundredth of the first.
IMAGES = 20
#: Share of the highest estimated frequencies from whose gain the images are extrapolated.
HIGHEST = 0.1


class ResponseLines(NamedTuple):
    """A response at some frequencies, not corrected for the hold of the input."""

    #: Frequencies [rad/s], rising, shape (K,).
    frequencies: Array
    #: Response [output unit/input unit], shape (K,).
    response: ComplexArray
    #: Variance of the complex response, shape (K,).
    variance: Array
    #: Degrees of freedom of the complex residuals of the variance [-], shape (K,).
    freedom: Array
    #: Share of the output's power that is linear in the input [-], shape (K,).
    coherence: Array
    #: Variance of the response of one realisation due to nonlinear distortions, if determined, shape (K,).
    distortion: Array | None
    notes: tuple[str, ...]
    #: Whether an interval can be given, shape (K,).
    has_interval: BoolArray


def images(hold: Hold, frequencies: Array, response: ComplexArray, variance: Array, interval: float) -> Array:
    """Return a bound of the images [unit of the response], for a gain that falls like 1/w beyond the estimate."""
    order = {"zoh": 1, "foh": 2}.get(hold, 0)
    if not order:
        return np.zeros(frequencies.size)
    last = max(1, round(HIGHEST * frequencies.size))
    # Less the power of the noise.
    power, noise = (float(np.mean(x[-last:] * frequencies[-last:] ** 2)) for x in (np.abs(response) ** 2, variance))
    beyond = np.sqrt(max(power - noise, noise / np.sqrt(last)))
    numbers = np.arange(1, IMAGES + 1)
    distances = 2 * np.pi / interval * np.concatenate((-numbers, numbers))[:, None] + frequencies
    return np.asarray((beyond / np.abs(distances) * np.abs(frequencies / distances) ** order).sum(axis=0))


#: Degree of the polynomials, and parameters of both together.
DEGREE = 2
PARAMETERS = 2 * (DEGREE + 1)
#: Half-widths tried [lines]; the least leaves three degrees of freedom.
HALF_WIDTHS = (4, 6, 8, 11, 16, 22, 32, 45, 64, 90, 128)
#: Divisor of the greatest width whose residuals do not exceed those of the least one. A bias as large as the standard
#: error is not visible in residuals, and decreases with the third power of the width or faster.
NARROWER = 2.0
#: A peak narrower than a window has large residuals and a bias beyond its interval. No interval is given if the
#: residuals of the least width exceed their median power within a number of lines by this factor, and the gain exceeds
#: this share of the greatest one in the window. With 500 samples, at peaks of resonances with a damping ratio of .03 to
#: .1 at two to eight periods per record, one in ten has an interval then; without this rule, coverage was 30 to 50 %.
PEAK_RESIDUALS, USUAL, PEAK_GAIN = 8.0, 32, 0.5
#: A given width is too wide if its residuals exceed those of the least one by this number of standard deviations.
TOO_WIDE = 2.0
#: Largest condition number of the normalised columns.
SINGULAR = 1e6
#: Lines with less than this share of the input's greatest amplitude are not excited.
LEAST_AMPLITUDE = 1e-8


class _LocalFit(NamedTuple):
    """Local polynomials of one half-width at some centres."""

    response: ComplexArray
    variance: Array
    #: Mean square of the residuals, and their degrees of freedom.
    noise: Array
    freedom: Array
    determined: BoolArray


def local_polynomial(
    u: ComplexArray, y: ComplexArray, base: float, points: int, half_width: int | None, time_unit: str
) -> ResponseLines:
    """Estimate the response from spectra at the frequencies ``base, 2 base, …`` at up to ``points`` of them.

    By default the half-width at each centre is half of the greatest one that fits the lines as well as the least one.

    The finite spectra of a record satisfy ``Y(k) = G(k) U(k) + T(k) + V(k)`` with a transient T that is as smooth as
    the response. Around each line G and T are polynomials of degree 2 in the number of the line, with six complex
    parameters, fitted by least squares over ``2 n + 1`` lines. The residuals determine the variance of V, and with it
    that of G. Leakage is thus estimated instead of reduced by a window.

    R. Pintelon and J. Schoukens, *System Identification: A Frequency Domain Approach*, 2nd ed., Wiley, 2012, chapter 7.
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
    has_interval = _is_resolved(fits[0], centres) | (chosen > 1)
    if half_width:
        has_interval &= excess[chosen, pick] <= 1.0 + TOO_WIDE / np.sqrt(half_width)
    power = np.convolve(np.abs(u) ** 2, np.ones(9), "same") / np.convolve(np.ones(lines), np.ones(9), "same")
    followed = np.abs(response) ** 2 * power[centres]
    known = known.astype(bool) & np.isfinite(variance)
    coherence = np.divide(followed, followed + noise, out=np.zeros(centres.size), where=followed + noise > 0)
    used = sorted({int(widths[k]) for k in chosen[known]})
    places = base * (centres[known] + 1.0)
    notes = _notes(used, base, half_width is None, places[~has_interval[known]], time_unit)
    return ResponseLines(
        places, response[known], variance[known], freedom[known], coherence[known], None, notes, has_interval[known]
    )


def _notes(used: list[int], base: float, chosen: bool, unresolved: Array, time_unit: str) -> tuple[str, ...]:
    if not used:
        return ()
    span = f"{2 * used[0] + 1}" if len(used) == 1 else f"{2 * used[0] + 1} to {2 * used[-1] + 1}"
    how = ", half of the widest that fits as well as the narrowest" if chosen else ", as given"
    text = (
        f"Each estimate is from a window of {span} lines, {base:.4g} rad/{time_unit} apart{how}. Estimates whose "
        "windows overlap share data."
    )
    if not unresolved.size:
        return (text,)
    return (
        text,
        f"No interval at {unresolved.size} of the frequencies, between {unresolved[0]:.3g} and {unresolved[-1]:.3g} "
        f"rad/{time_unit}: the response varies within the lines of one estimate, as on a narrow peak, and its error "
        f"may exceed the noise. A longer record resolves it{'' if chosen else ', or a smaller width'}.",
    )


def _centres(lines: int, points: int) -> IntArray:
    """Return the indices of the lines at which the response is estimated: all, or spaced logarithmically."""
    if lines <= points:
        return np.arange(lines)
    return np.unique(np.round(np.geomspace(1, lines, points)).astype(np.int64)) - 1


def _fit(u: ComplexArray, y: ComplexArray, centres: IntArray, n: int) -> _LocalFit:
    """Fit local polynomials around all centres; at the upper end of the band windows are one-sided."""
    # Spectra at negative frequencies are conjugate: a window may extend there. Line zero was removed with the means.
    window = np.minimum(centres, u.size - 1 - n)[:, None] + np.arange(-n, n + 1)
    place = (window - centres[:, None]) / n
    present = window != -1
    mirrored = window < 0
    index = np.where(mirrored, np.maximum(-window - 2, 0), window)
    inputs, outputs = (np.where(mirrored, x[index].conj(), x[index]) * present for x in (u, y))
    powers = place[:, :, None] ** np.arange(DEGREE + 1) * present[:, :, None]
    columns = np.concatenate((powers * inputs[:, :, None], powers), axis=2)
    lengths = np.linalg.norm(columns, axis=1, keepdims=True)
    excited = lengths[:, 0, 0] > LEAST_AMPLITUDE * float(np.abs(u).max())
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
    """Return the residual power of each width over that of the least one on the same lines, shape (widths, centres)."""
    least = fits[0]
    total = np.concatenate(([0.0], np.cumsum(np.where(least.determined, least.noise, 0.0))))
    number = np.concatenate(([0], np.cumsum(least.determined)))
    excess = np.zeros((widths.size, centres.size))
    for row, fit, n in zip(excess, fits, widths, strict=True):
        first, last = np.searchsorted(centres, centres - n), np.searchsorted(centres, centres + n, side="right")
        count = number[last] - number[first]
        usual = (total[last] - total[first]) / np.maximum(count, 1)
        # Zero if the least width is not determined.
        np.divide(fit.noise, usual, out=row, where=(count > 0) & fit.determined & (usual > 0))
    return excess


def _is_resolved(least: _LocalFit, centres: IntArray) -> BoolArray:
    """Return whether the least width is narrow enough for the response."""
    gain = np.abs(least.response)
    usual = _around(least.noise, centres, USUAL, np.median)
    greatest = _around(gain, centres, HALF_WIDTHS[0], np.max)
    return np.asarray((least.noise <= PEAK_RESIDUALS * usual) | (gain < PEAK_GAIN * greatest))


def _around(values: Array, centres: IntArray, reach: int, measure: Callable[[Array], float]) -> Array:
    """Return a measure of the values at all centres within a given number of lines."""
    first, last = np.searchsorted(centres, centres - reach), np.searchsorted(centres, centres + reach, side="right")
    return np.array([measure(values[a:b]) for a, b in zip(first, last, strict=True)])


def _choose(excess: Array, determined: BoolArray, widths: IntArray) -> IntArray:
    """Return the index of the half-width of each centre."""
    fitting = np.cumprod(excess[1:] <= 1.0, axis=0).sum(axis=0)
    target = np.maximum(widths[fitting] / NARROWER, widths[0])
    chosen = np.searchsorted(widths, 1.01 * target, side="right") - 1
    # If a narrow window is not determined, the narrowest one that is.
    first = np.where(determined.any(axis=0), np.argmax(determined, axis=0), 0)
    able = determined[chosen, np.arange(chosen.size)]
    return np.asarray(np.where(able, chosen, np.maximum(first, chosen)), dtype=np.int64)


#: An input is periodic if the mean square of its change over a period is below this share of twice its variance.
REPEATED = 1e-3
#: Lines are excited if the input exceeds this share of its greatest power and this multiple of its noise variance.
LEAST_POWER, ABOVE_NOISE = 1e-6, 10.0
#: Lines on each side of an excited line from which transient and noise are estimated.
BETWEEN = 4
#: Unexcited lines on each side of an excited one from which its distortion is estimated.
DETECTION = 3
#: Fewest unexcited lines of a kind for the distortion.
FEWEST = 4


class _Periods(NamedTuple):
    """Spectra and noise from the periods of one realisation, on every line above zero."""

    #: Spectra without the transient, shape (K,).
    inputs: ComplexArray
    outputs: ComplexArray
    #: Variances and covariance of these, shape (K,).
    input_noise: Array
    output_noise: Array
    both: ComplexArray
    number: int


@reported("period of the input")
def find_period(u: Array) -> int | None:
    """Return the period of an input in samples, with at least two periods in the record; None if there is none."""
    n = u.size
    centred = u - u.mean()
    energy = float(centred @ centred)
    if n < 8 or not energy > 0:
        return None
    size = 1 << (2 * n - 1).bit_length()
    shared = np.fft.irfft(np.abs(np.fft.rfft(centred, size)) ** 2, size)[: n // 2 + 1]
    squares = np.concatenate(([0.0], np.cumsum(centred**2)))
    lags = np.arange(n // 2 + 1)
    # Mean square of the change over a lag, relative to twice the mean square of the same samples.
    around = squares[n - lags] + squares[n] - squares[lags]
    change = 1.0 - 2.0 * shared / np.maximum(around, 1e-300)
    # Short lags of a slow input have small changes without being a period: skip to the first large change.
    away = np.flatnonzero(change > 0.5)
    if not away.size:
        return None
    repeated = np.flatnonzero(change[away[0] :] < REPEATED)
    if not repeated.size:
        return None
    first = int(away[0] + repeated[0])
    stretch = change[first : min(first + max(2, first // 8), change.size)]
    return first + int(np.argmin(stretch))


def from_periods(signals: Sequence[tuple[Array, Array]], period: int, interval: float) -> ResponseLines:
    r"""Estimate the response from periodic inputs and outputs, one pair for each realisation.

    The DFT of M whole periods has the input on every M-th line only. On the lines between, input and output contain
    noise and the transient, which is smooth over frequency. A polynomial of degree 2 through the nearest of these lines
    gives the transient on the line of the input, which is subtracted, and its residuals give the variances and the
    covariance of the noise, including noise on the input. With the lines U and Y the response is Y/U, of variance

    .. math:: \sigma_G^2 = |G|^2 \Big(\frac{\sigma_Y^2}{|Y|^2} + \frac{\sigma_U^2}{|U|^2}
              - 2 \mathrm{Re} \frac{\sigma_{YU}^2}{Y U^*}\Big).

    Nonlinear distortions are periodic with the input, and therefore not visible in differences between periods. They
    are visible on lines that the input does not excite, and in differences between realisations of the input.

    R. Pintelon and J. Schoukens, *System Identification: A Frequency Domain Approach*, 2nd ed., Wiley, 2012, chapters
    2-4.
    """
    found = [_periods(u, y, period) for u, y in signals]
    excited = np.flatnonzero(np.all([_excited(one) for one in found], axis=0))
    if not excited.size:
        raise DataError(f"the input excites no line of a period of {period} samples above its noise")
    each = [_response(one, excited) for one in found]
    responses = np.array([response for response, _ in each])
    noise = np.array([variance for _, variance in each])
    response = responses.mean(axis=0)
    freedom = np.full(excited.size, 2.0 * BETWEEN - DEGREE - 1.0)
    variance, distortion = noise.mean(axis=0) / len(found), None
    if len(found) > 1:
        scatter = np.var(responses, axis=0, ddof=1)
        distortion = np.maximum(scatter - noise.mean(axis=0), 0.0)
        variance, freedom = scatter / len(found), np.full(excited.size, len(found) - 1.0)
        notes = [
            f"Mean over {len(found)} realisations; the variance between them includes noise and nonlinear distortions; "
            "its excess over the noise within each is the level of the distortions."
        ]
    else:
        distortion, notes = _distortion(found[0], excited)
    followed = np.mean([np.abs(response * one.inputs[excited]) ** 2 for one in found], axis=0)
    rest = np.mean([one.number * one.output_noise[excited] for one in found], axis=0)
    coherence = np.asarray(followed / np.maximum(followed + rest, np.finfo(float).tiny), dtype=np.float64)
    frequencies = np.asarray(2 * np.pi / (period * interval) * (excited + 1), dtype=np.float64)
    head = (
        f"{found[0].number} periods of {period} samples, {excited.size} excited lines. Transient and noise are "
        f"estimated from the {2 * BETWEEN} nearest lines without input around each one.",
    )
    has_interval = np.ones(excited.size, dtype=bool)
    return ResponseLines(frequencies, response, variance, freedom, coherence, distortion, (*head, *notes), has_interval)


def _periods(u: Array, y: Array, period: int) -> _Periods:
    count = u.size // period
    if count < 2:
        raise DataError(f"{u.size} samples are less than two periods of {period}; give the input's period, in samples")
    size = count * period
    spectra = [np.fft.fft(x[x.size - size :]) / size for x in (u, y)]
    lines = count * np.arange(1, (period + 1) // 2)
    apart = np.arange(1, 2 * BETWEEN + 1)
    apart = apart[apart % count > 0][:BETWEEN].astype(np.int64)
    places = np.concatenate((-apart[::-1], apart))
    powers = (places / places[-1])[:, None] ** np.arange(DEGREE + 1)
    inverse = np.linalg.pinv(powers)
    # The spectra of samples are periodic.
    between = [x[(lines[:, None] + places) % size] for x in spectra]
    inputs, outputs = (x[lines] - near @ inverse[0] for x, near in zip(spectra, between, strict=True))
    off_u, off_y = (near - near @ (powers @ inverse).T for near in between)
    scale = (1.0 + float(inverse[0] @ inverse[0])) / (places.size - DEGREE - 1)
    noise = [scale * np.sum(a * b.conj(), axis=1) for a, b in ((off_u, off_u), (off_y, off_y), (off_y, off_u))]
    return _Periods(inputs, outputs, noise[0].real, noise[1].real, noise[2], count)


def _excited(one: _Periods) -> BoolArray:
    power = np.abs(one.inputs) ** 2
    return np.asarray((power > LEAST_POWER * power.max()) & (power > ABOVE_NOISE * one.input_noise))


def _response(one: _Periods, lines: IntArray) -> tuple[ComplexArray, Array]:
    """Return the response and its variance on some lines."""
    u, y = one.inputs[lines], one.outputs[lines]
    g = y / u
    noise_y, noise_u, both = one.output_noise[lines], one.input_noise[lines], one.both[lines]
    error = noise_y + np.abs(g) ** 2 * noise_u - 2 * np.real(both * g.conj())
    return g, np.maximum(error, 0.0) / np.abs(u) ** 2


def _distortion(one: _Periods, excited: IntArray) -> tuple[Array | None, list[str]]:
    """Return the variance of the response due to distortions, from unexcited lines between excited ones, and notes.

    With an input on odd harmonics only, even distortions are on even harmonics, and odd distortions on odd ones.
    """
    silent = np.setdiff1d(np.arange(excited[0], excited[-1] + 1), excited)
    # Index k is harmonic k + 1.
    kinds = {"odd": silent[silent % 2 == 0], "even": silent[silent % 2 == 1]}
    if (excited % 2 == 1).any():
        kinds = {"all": silent}
    enough = {kind: lines for kind, lines in kinds.items() if lines.size >= FEWEST}
    cure = "leave random lines of the input unexcited, or record several realisations of it"
    if not enough:
        return None, [f"Nonlinear distortions cannot be distinguished from the response; to detect them, {cure}."]
    power = np.abs(one.outputs) ** 2 - one.output_noise
    signal = float(np.mean(np.abs(one.outputs[excited]) ** 2))
    sizes = []
    for kind, lines in enough.items():
        level, noise = float(np.mean(power[lines])), float(np.mean(one.output_noise[lines]))
        seen = level > 4 * noise / np.sqrt(lines.size) and level > 1e-24 * signal
        size = f"{10 * np.log10(level / signal):.3g} dB of the excited ones" if seen else "no more than noise"
        sizes.append(f"{kind}: {size}" if kind != "all" else size)
    text = f"Nonlinear distortions, from {sum(map(len, enough.values()))} unexcited lines: {', '.join(sizes)}."
    # Even distortions of an input on odd harmonics do not affect odd lines.
    source = enough.get("odd", enough.get("all"))
    if source is None:
        return None, [f"{text} Odd ones cannot be distinguished from the response; to detect them, {cure}."]
    weights = np.ones(2 * DETECTION + 1)
    nearby = np.convolve(power[source], weights, "full") / np.convolve(np.ones(source.size), weights, "full")
    level = np.interp(excited, source, np.maximum(nearby[DETECTION : DETECTION + source.size], 0.0))
    return np.asarray(level / np.abs(one.inputs[excited]) ** 2), [text]


#: Record length over the default segment length; with half overlap there are twice this number of segments less one.
PARTS = 8
#: Squared correlation of neighbouring segments under Hann windows with half overlap.
SHARED = 1 / 36
#: The shortest segment [samples].
SHORTEST = 16
#: Lines with less than this share of the input's greatest power are not excited.
LEAST_AVERAGE_POWER = 1e-12


def welch(u: Array, y: Array, interval: float, length: int | None, time_unit: str) -> ResponseLines:
    """Estimate response, coherence and variance by Welch's method."""
    from scipy.signal import csd  # slow to import

    size = length or max(SHORTEST, u.size // PARTS)
    half = size // 2
    segments = (u.size - size) // half + 1
    if size < SHORTEST or segments < 3:
        raise DataError(
            f"segments of {size} samples are too {'short' if size < SHORTEST else 'long'}: there must be three of "
            f"{SHORTEST} samples or more, each beginning in the middle of the one before; the record has {u.size}"
        )
    options = {"nperseg": size, "noverlap": size - half, "detrend": "constant"}
    uu, yy, yu = (csd(*pair, window="hann", **options)[1] for pair in ((u, u), (y, y), (u, y)))
    uu, yy = uu.real, yy.real
    # The window mixes the first line with the removed mean.
    kept = (np.arange(uu.size) >= 2) & (uu > LEAST_AVERAGE_POWER * uu.max()) & (np.arange(uu.size) < size / 2)
    uu, yy, yu = uu[kept], yy[kept], yu[kept]
    coherence = np.minimum(np.abs(yu) ** 2 / np.maximum(uu * yy, np.finfo(float).tiny), 1.0)
    count = segments / (1.0 + 2.0 * SHARED * (segments - 1) / segments)
    variance = (1.0 - coherence) * yy / uu / (count - 1.0)
    note = (
        f"Averages over {segments} segments of {size} samples under Hann windows with half "
        "overlap. There are no intervals, as the scatter of the averages shows neither leakage nor the flattening of "
        f"peaks narrower than {8 * np.pi / (size * interval):.3g} rad/{time_unit}; --method local-polynomial gives "
        "intervals."
    )
    frequencies: Array = 2 * np.pi / (size * interval) * np.flatnonzero(kept).astype(np.float64)
    freedom = np.full(frequencies.size, count - 1.0)
    has_interval = np.zeros(frequencies.size, dtype=bool)
    return ResponseLines(frequencies, yu / uu, variance, freedom, coherence, None, (note,), has_interval)
