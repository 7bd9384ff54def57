r"""What the methods that estimate a frequency response without a model have in common: lines, holds, and their images.

Of a signal on a regular clock of interval h the samples tell the sum of its spectrum over all frequencies that look
alike. With ``w_s = 2 pi/h``, an input held between its samples has the spectrum ``H(w) U(w)`` at every one of them,

.. math:: H_{zoh} = \frac{1 - e^{-jwh}}{jwh}, \quad H_{foh} = \Big(\frac{\sin(wh/2)}{wh/2}\Big)^2, \quad H_{bl} = 1,

the last one below half of w_s only. The output over the input and H is ``G(jw) + sum_m G(j(w + m w_s)) H(w + m w_s) /
H(w)``, m ≠ 0: the response and its images, which a hold leaves the smaller the faster the clock.
"""

from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array, BoolArray, ComplexArray
from ctid_cli.signals.treatment import Hold

#: Images on each side that are summed; those beyond add less than a hundredth of the first.
IMAGES = 20
#: Share of the estimated frequencies, the highest ones, whose gain the images go on from.
HIGHEST = 0.1


class ResponseLines(NamedTuple):
    """A response at some frequencies as one of the methods finds it; the input is that between the samples."""

    #: Frequencies [rad/s], rising, shape (K,).
    frequencies: Array
    #: Response [output unit/input unit], shape (K,).
    response: ComplexArray
    #: Variance of the response, that of both parts together, shape (K,).
    variance: Array
    #: Degrees of freedom of the complex residuals that the variance is from [-], shape (K,).
    freedom: Array
    #: Share of the output's power that follows the input linearly [-], shape (K,).
    coherence: Array
    #: Variance that nonlinear distortions give the response of one realisation, where they are told, shape (K,).
    distortion: Array | None
    notes: tuple[str, ...]
    #: Whether an interval can be given, shape (K,).
    told: BoolArray


def hold_factor(hold: Hold, frequencies: Array, interval: float) -> ComplexArray:
    """Spectrum of a held input over that of its samples."""
    across = np.sinc(frequencies * interval / (2 * np.pi))
    if hold == "zoh":
        return np.asarray(across * np.exp(-0.5j * frequencies * interval))
    return np.asarray(across**2 if hold == "foh" else np.ones(frequencies.size), dtype=np.complex128)


def images(hold: Hold, frequencies: Array, response: ComplexArray, variance: Array, interval: float) -> Array:
    """What the images may add to a response [its unit], if its gain falls like 1/w or faster from where it was seen."""
    order = {"zoh": 1, "foh": 2}.get(hold, 0)
    if not order:
        return np.zeros(frequencies.size)
    last = max(1, round(HIGHEST * frequencies.size))
    # Freed of the noise, as far as the noise allows.
    power, noise = (float(np.mean(x[-last:] * frequencies[-last:] ** 2)) for x in (np.abs(response) ** 2, variance))
    beyond = np.sqrt(max(power - noise, noise / np.sqrt(last)))
    numbers = np.arange(1, IMAGES + 1)
    distances = 2 * np.pi / interval * np.concatenate((-numbers, numbers))[:, None] + frequencies
    return np.asarray((beyond / np.abs(distances) * np.abs(frequencies / distances) ** order).sum(axis=0))
