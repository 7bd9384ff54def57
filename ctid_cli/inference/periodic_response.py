r"""A frequency response from periods of an input: what lies between the lines of the period is transient and noise.

The DFT of M whole periods has the input on every M-th line only. On the lines between, input and output hold noise and
the transient of a start that has not settled, which is smooth over frequency. A polynomial of degree 2 through the
nearest of these lines gives the transient on the line of the input, which is taken out, and its residuals the variances
and the covariance of the noise, noise on the input included. With the lines U and Y the response is Y/U, of variance

.. math:: \sigma_G^2 = |G|^2 \Big(\frac{\sigma_Y^2}{|Y|^2} + \frac{\sigma_U^2}{|U|^2}
          - 2 \mathrm{Re} \frac{\sigma_{YU}^2}{Y U^*}\Big).

Nonlinear distortions repeat with the input, so that periods do not show them. They show on lines that the input does
not excite, and in the differences between realisations of the input.

R. Pintelon and J. Schoukens, *System Identification: A Frequency Domain Approach*, 2nd ed., Wiley, 2012, chapters 2-4.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array, BoolArray, ComplexArray, IntArray
from ctid_cli.errors import DataError
from ctid_cli.inference.response_lines import ResponseLines

#: An input repeats itself where the mean square of its change over a period is below this share of twice its variance.
REPEATED = 1e-3
#: Lines on which the input has less than this share of its greatest power do not excite, nor those that stand out of
#: the input's noise by less than so many times its variance.
EXCITED, ABOVE_NOISE = 1e-6, 10.0
#: Lines on each side of one of the input from which transient and noise are read, and the degree of the polynomial.
BETWEEN, DEGREE = 4, 2
#: Unexcited lines on each side of an excited one from which the distortion on it is read.
DETECTION = 3
#: A kind of unexcited lines tells the distortions from this number on.
FEWEST = 4


class _Periods(NamedTuple):
    """What the periods of one realisation tell on every line above zero."""

    #: Spectra without the transient, shape (K,).
    inputs: ComplexArray
    outputs: ComplexArray
    #: Variances and covariance of these, shape (K,).
    input_noise: Array
    output_noise: Array
    both: ComplexArray
    number: int


def find_period(u: Array) -> int | None:
    """Samples after which an input repeats itself to the end of the record, at least once in full."""
    n = u.size
    centred = u - u.mean()
    energy = float(centred @ centred)
    if n < 8 or not energy > 0:
        return None
    size = 1 << (2 * n - 1).bit_length()
    shared = np.fft.irfft(np.abs(np.fft.rfft(centred, size)) ** 2, size)[: n // 2 + 1]
    squares = np.concatenate(([0.0], np.cumsum(centred**2)))
    lags = np.arange(n // 2 + 1)
    # Over the samples that have one a lag later: the mean square of the change over twice the mean square.
    around = squares[n - lags] + squares[n] - squares[lags]
    change = 1.0 - 2.0 * shared / np.maximum(around, 1e-300)
    # A slow input is like itself a sample later, which is no period: first it must have moved away.
    away = np.flatnonzero(change > 0.5)
    if not away.size:
        return None
    again = np.flatnonzero(change[away[0] :] < REPEATED)
    if not again.size:
        return None
    first = int(away[0] + again[0])
    stretch = change[first : min(first + max(2, first // 8), change.size)]
    return first + int(np.argmin(stretch))


def from_periods(signals: Sequence[tuple[Array, Array]], period: int, interval: float) -> ResponseLines:
    """Response from inputs and outputs that repeat after ``period`` samples, each a realisation of its own."""
    found = [_periods(u, y, period) for u, y in signals]
    excited = np.flatnonzero(np.all([_excited(one) for one in found], axis=0))
    if not excited.size:
        raise DataError(f"the input excites no line of a period of {period} samples that stands out of its noise")
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
            f"Mean over {len(found)} realisations; the variance is that between them, with noise and nonlinear "
            "distortions; what exceeds the noise within each is the level of the distortions."
        ]
    else:
        distortion, notes = _distortion(found[0], excited)
    followed = np.mean([np.abs(response * one.inputs[excited]) ** 2 for one in found], axis=0)
    rest = np.mean([one.number * one.output_noise[excited] for one in found], axis=0)
    coherence = np.asarray(followed / np.maximum(followed + rest, np.finfo(float).tiny), dtype=np.float64)
    frequencies = np.asarray(2 * np.pi / (period * interval) * (excited + 1), dtype=np.float64)
    head = (
        f"{found[0].number} periods of {period} samples, {excited.size} excited lines. Transient and noise are "
        f"read from the {2 * BETWEEN} lines around each one on which the input has nothing.",
    )
    told = np.ones(excited.size, dtype=bool)
    return ResponseLines(frequencies, response, variance, freedom, coherence, distortion, (*head, *notes), told)


def _periods(u: Array, y: Array, period: int) -> _Periods:
    count = u.size // period
    if count < 2:
        raise DataError(f"{u.size} samples hold no two periods of {period}; give the period of the input, in samples")
    size = count * period
    spectra = [np.fft.fft(x[x.size - size :]) / size for x in (u, y)]
    lines = count * np.arange(1, (period + 1) // 2)
    apart = np.arange(1, 2 * BETWEEN + 1)
    apart = apart[apart % count > 0][:BETWEEN].astype(np.int64)
    places = np.concatenate((-apart[::-1], apart))
    powers = (places / places[-1])[:, None] ** np.arange(DEGREE + 1)
    inverse = np.linalg.pinv(powers)
    # Beyond both ends the spectra of samples go on by themselves.
    between = [x[(lines[:, None] + places) % size] for x in spectra]
    inputs, outputs = (x[lines] - near @ inverse[0] for x, near in zip(spectra, between, strict=True))
    off_u, off_y = (near - near @ (powers @ inverse).T for near in between)
    scale = (1.0 + float(inverse[0] @ inverse[0])) / (places.size - DEGREE - 1)
    noise = [scale * np.sum(a * b.conj(), axis=1) for a, b in ((off_u, off_u), (off_y, off_y), (off_y, off_u))]
    return _Periods(inputs, outputs, noise[0].real, noise[1].real, noise[2], count)


def _excited(one: _Periods) -> BoolArray:
    power = np.abs(one.inputs) ** 2
    return np.asarray((power > EXCITED * power.max()) & (power > ABOVE_NOISE * one.input_noise))


def _response(one: _Periods, lines: IntArray) -> tuple[ComplexArray, Array]:
    """Response and its variance on some lines."""
    u, y = one.inputs[lines], one.outputs[lines]
    g = y / u
    noise_y, noise_u, both = one.output_noise[lines], one.input_noise[lines], one.both[lines]
    error = noise_y + np.abs(g) ** 2 * noise_u - 2 * np.real(both * g.conj())
    return g, np.maximum(error, 0.0) / np.abs(u) ** 2


def _distortion(one: _Periods, excited: IntArray) -> tuple[Array | None, list[str]]:
    """Variance that distortions give the response, from unexcited lines between excited ones, and what is said.

    An input on odd harmonics only makes even distortions show on even ones, and odd distortions on odd ones.
    """
    silent = np.setdiff1d(np.arange(excited[0], excited[-1] + 1), excited)
    # Place k is harmonic k + 1.
    kinds = {"odd": silent[silent % 2 == 0], "even": silent[silent % 2 == 1]}
    if (excited % 2 == 1).any():
        kinds = {"all": silent}
    told = {kind: lines for kind, lines in kinds.items() if lines.size >= FEWEST}
    cure = "leave some lines without input, at random, or record several realisations of it"
    if not told:
        return None, [f"Nonlinear distortions are not told from the response; to see them, {cure}."]
    power = np.abs(one.outputs) ** 2 - one.output_noise
    signal = float(np.mean(np.abs(one.outputs[excited]) ** 2))
    sizes = []
    for kind, lines in told.items():
        level, chance = float(np.mean(power[lines])), float(np.mean(one.output_noise[lines]))
        seen = level > 4 * chance / np.sqrt(lines.size) and level > 1e-24 * signal
        size = f"{10 * np.log10(level / signal):.3g} dB of the excited ones" if seen else "no more than noise"
        sizes.append(f"{kind}: {size}" if kind != "all" else size)
    text = f"Nonlinear distortions, from {sum(map(len, told.values()))} lines that are not excited: {', '.join(sizes)}."
    # Even distortions of an odd input shake no odd line.
    source = told.get("odd", told.get("all"))
    if source is None:
        return None, [f"{text} Odd ones are not told from the response; to see them, {cure}."]
    weights = np.ones(2 * DETECTION + 1)
    nearby = np.convolve(power[source], weights, "full") / np.convolve(np.ones(source.size), weights, "full")
    level = np.interp(excited, source, np.maximum(nearby[DETECTION : DETECTION + source.size], 0.0))
    return np.asarray(level / np.abs(one.inputs[excited]) ** 2), [text]
