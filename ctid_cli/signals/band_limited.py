r"""A signal without power above half its sampling frequency, as straight lines on a finer clock.

Between its samples such a signal is ``sum_k u_k sinc((t - t_k)/h)``, which no exact pass takes. Straight lines between
points h/4 apart do, if the points are chosen so that the lines have the spectrum of the signal below half the sampling
frequency: lines damp a wave ``exp(jwt)`` by ``sinc(w h/8)^2``, so the points are those of the signal over that factor.
What is left are the images of the finer clock, around multiples of 4 sampling frequencies. Behind a system they are
``(w/(4 w_s - w))^2 |G(4 w_s - w)/G(w)|`` of the response to the frequency w: one or two ten thousandths of the output
at most, where lines through the samples themselves are wrong by hundredths.

The sum runs over all time. Of a periodic signal all is known, and it is formed by Fourier's series. Otherwise it is cut
off by a Kaiser window after 32 samples, and beyond the ends of a record the signal is taken as mirrored in its last
sample.
"""

from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array

#: Points of the finer clock in an interval.
FINER = 4
#: Samples on either side that an instant between two samples depends on, and the window that ends there: 80 dB.
REACH, KAISER = 32, 8.0
#: Above this fraction of half the sampling frequency, images leak through the window.
PASSED = 0.9


class BandLimitedDoubt(NamedTuple):
    """What is not known of a signal between its samples."""

    #: Time from both ends within which the unknown samples beyond matter [s].
    reach: float
    #: Root mean square of what another guess of these changes there [input unit].
    ends: float
    #: Share of the signal's power too close to half the sampling frequency [-].
    beyond: float


def finer_values(values: Array, *, periodic: bool) -> Array:
    """Return points between which straight lines have the spectrum of a signal.

    Of a periodic signal those of one whole period, ``4 N``; otherwise those from the first sample to the last.
    """
    return _of_series(values) if periodic else _of_window(values, "odd")


def values_between(values: Array) -> Array:
    """Return the signal itself on the finer clock, from the first sample to the last."""
    return _of_window(values, "odd", undamped=False)


def finer_times(t: Array, *, periodic: bool) -> Array:
    """Return the instants of these points; every fourth of them is one of the signal."""
    places = np.arange((t.size - 1) * FINER + 1) / FINER
    times = np.interp(places, np.arange(t.size), t)
    if not periodic:
        return times
    step = float(t[-1] - t[0]) / ((t.size - 1) * FINER)
    return np.append(times, t[-1] + step * np.arange(1, FINER))


def band_limited_doubt(t: Array, values: Array) -> BandLimitedDoubt:
    """Return what another guess of the samples beyond the ends changes, and the power near the edge of the band."""
    mirrored, held = (_of_window(values, way) for way in ("odd", "constant"))
    edge = min(REACH * FINER, mirrored.size // 2)
    off = np.concatenate([(mirrored - held)[:edge], (mirrored - held)[-edge:]])
    n = values.size
    power = np.abs(np.fft.rfft((values - values.mean()) * np.hanning(n))) ** 2
    total = float(power.sum())
    beyond = float(power[int(PASSED * (power.size - 1)) :].sum()) / total if total > 0 else 0.0
    interval = float(t[-1] - t[0]) / (n - 1)
    return BandLimitedDoubt(min(REACH, n // 2) * interval, float(np.sqrt(np.mean(off**2))), beyond)


def _of_series(values: Array) -> Array:
    n = values.size
    spectrum = np.fft.rfft(values) / np.sinc(np.arange(n // 2 + 1) / (n * FINER)) ** 2
    if n % 2 == 0:
        # The line at half the sampling frequency stands for its two neighbours on the finer clock.
        spectrum[-1] *= 0.5
    return np.asarray(np.fft.irfft(spectrum, n * FINER) * FINER)


def _of_window(values: Array, beyond: str, *, undamped: bool = True) -> Array:
    """Return points by the windowed sum, the signal beyond its ends mirrored (``odd``) or held at the last sample."""
    more = REACH + 2
    if beyond == "odd" and values.size > 1:
        longer = np.pad(values, more, mode="reflect", reflect_type="odd")
    else:
        longer = np.pad(values, more, mode="edge")
    lags = np.arange(-REACH * FINER, REACH * FINER + 1)
    weights = np.sinc(lags / FINER) * np.kaiser(lags.size, KAISER)
    points = np.zeros((longer.size - 2 * REACH) * FINER)
    for phase in range(FINER):
        # Together they weigh one, so that a constant stays what it is; the first phase has one more at the end.
        part = weights[phase::FINER]
        points[phase::FINER] = np.convolve(longer, part / part.sum(), "valid")[int(phase > 0) :]
    # 1/sinc(x/2)^2 = 1 + x^2/12 + x^4/240 + ...: in differences, up to the sixth order in x.
    second = np.array([1.0, -2.0, 1.0])
    if undamped:
        weights = np.array([0.0, 0.0, 1.0, 0.0, 0.0]) - np.pad(second, 1) / 12 + np.convolve(second, second) / 90
        points = np.convolve(points, weights, "same")
    return points[2 * FINER : 2 * FINER + (values.size - 1) * FINER + 1]
