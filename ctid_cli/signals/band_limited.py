r"""Signals without power above half the sampling frequency, as straight lines on a finer clock.

Between its samples such a signal is ``sum_k u_k sinc((t - t_k)/h)``, for which there is no exact simulation. There is
one for straight lines between points h/4 apart, and the points are chosen so that the lines have the spectrum of the
signal below half the sampling frequency: lines attenuate a wave ``exp(jwt)`` by ``sinc(w h/8)^2``, so the signal is
divided by that factor. The error consists of the images of the finer clock, around multiples of 4 sampling frequencies.
After a system they are ``(w/(4 w_s - w))^2 |G(4 w_s - w)/G(w)|`` of the response to the frequency w: one or two ten
thousandths of the output at most, whereas lines through the samples themselves have errors of hundredths.

The sum runs over all time. For a periodic signal it is computed exactly by a Fourier series. Otherwise it is truncated
by a Kaiser window after 32 samples, and the signal is extended beyond the ends of a record by odd reflection in its
end samples.
"""

import numpy as np

from ctid_cli.arrays import Array

#: Points of the finer clock per interval.
FINER = 4
#: Number of samples on each side used for an instant between two samples, and the parameter of their window (80 dB).
REACH, KAISER = 32, 8.0


def finer_values(values: Array) -> Array:
    """Return points from the first to the last sample whose connecting lines have the spectrum of a signal."""
    return _of_window(values)


def periodic_values(values: Array) -> Array:
    """Return the ``4 N`` points of one period whose connecting lines have the spectrum of a periodic signal."""
    n = values.size
    spectrum = np.fft.rfft(values) / np.sinc(np.arange(n // 2 + 1) / (n * FINER)) ** 2
    if n % 2 == 0:
        # The line at half the sampling frequency is divided between two lines on the finer clock.
        spectrum[-1] *= 0.5
    return np.asarray(np.fft.irfft(spectrum, n * FINER) * FINER)


def values_between(values: Array) -> Array:
    """Return the signal itself on the finer clock, from the first sample to the last."""
    return _of_window(values, undamped=False)


def finer_times(t: Array, *, periodic: bool) -> Array:
    """Return the instants of these points; every fourth one is a sampling instant."""
    places = np.arange((t.size - 1) * FINER + 1) / FINER
    times = np.interp(places, np.arange(t.size), t)
    if not periodic:
        return times
    step = float(t[-1] - t[0]) / ((t.size - 1) * FINER)
    return np.append(times, t[-1] + step * np.arange(1, FINER))


def _of_window(values: Array, *, undamped: bool = True) -> Array:
    """Return points by the windowed sum; outside, the signal is reflected, and a single sample is held."""
    more = REACH + 2
    if values.size > 1:
        longer = np.pad(values, more, mode="reflect", reflect_type="odd")
    else:
        longer = np.pad(values, more, mode="edge")
    lags = np.arange(-REACH * FINER, REACH * FINER + 1)
    weights = np.sinc(lags / FINER) * np.kaiser(lags.size, KAISER)
    points = np.zeros((longer.size - 2 * REACH) * FINER)
    for phase in range(FINER):
        # Normalised to a sum of one, so that a constant is preserved; the first phase has one more point at the end.
        part = weights[phase::FINER]
        points[phase::FINER] = np.convolve(longer, part / part.sum(), "valid")[int(phase > 0) :]
    # 1/sinc(x/2)^2 = 1 + x^2/12 + x^4/240 + ...: in differences, up to the sixth order in x.
    second = np.array([1.0, -2.0, 1.0])
    if undamped:
        weights = np.array([0.0, 0.0, 1.0, 0.0, 0.0]) - np.pad(second, 1) / 12 + np.convolve(second, second) / 90
        points = np.convolve(points, weights, "same")
    return points[2 * FINER : 2 * FINER + (values.size - 1) * FINER + 1]
