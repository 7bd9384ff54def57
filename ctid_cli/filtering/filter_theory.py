r"""What a low-pass filter does to the cost of a delay error.

With the rational part known, an input of spectral density ``Psi(w)`` and white output noise of intensity ``lambda``,
the cost of a delay error d after a low-pass filter L is, by Parseval,

.. math:: J(d) = \frac1\pi \int_{-\infty}^{\infty} (1 - \cos w d) |L G_0(jw)|^2 \Psi(w)\,dw
                 + \frac{\lambda}{2\pi} \int_{-\infty}^{\infty} |L(jw)|^2\,dw,

twice the drop of the autocorrelation of the filtered output from its peak, above a floor of noise. Every such cost is
even in d and least at d = 0. The longer the period of the filter, the wider the valley around zero.

Equation numbers are those of Ha, Welsh and Alamir, "Useful redundancy in parameter and time delay estimation for
continuous-time models" (arXiv:1703.09344).
"""

import numpy as np
from numpy.typing import ArrayLike

from ctid_cli.arrays import Array
from ctid_cli.signals.checks import require_integer, require_not_negative, require_positive


def ideal_cost(delay_error: ArrayLike, cutoff: float, noise_intensity: float = 0.0) -> Array:
    r"""Cost of a delay error where the low-pass filter and the system together are an ideal low-pass filter.

    The input is white noise of unit intensity.

    Equation (50): ``J(d) = 2 wc/pi - 2 sin(wc d)/(pi d) + lambda wc/pi``, the integral (35) with
    ``|L G0| = 1`` up to wc. Near d = 0 a series keeps all digits: ``J(d) ~ wc^3 d^2/(3 pi)``.
    """
    require_positive("cutoff", cutoff, "rad/s")
    require_not_negative("noise_intensity", noise_intensity, "output unit² s")
    x = cutoff * np.asarray(delay_error, dtype=float)
    near = np.abs(x) < 1.0
    small, large = np.where(near, x, 0.0) ** 2, np.where(near, 1.0, x)
    # 1 - sin(x)/x = x²/6 (1 - x²/20 (1 - x²/42 (...)))
    series = np.ones_like(x)
    for k in range(9, 1, -1):
        series = 1.0 - small / (2 * k * (2 * k + 1)) * series
    drop = np.where(near, small / 6 * series, 1.0 - np.sin(large) / large)
    return np.asarray(2 * cutoff / np.pi * drop + noise_intensity * cutoff / np.pi)


def extrema(cutoff: float, count: int, exact: bool = False) -> Array:
    r"""Positive delay errors at which the ideal cost has its extrema.

    The extrema are those of ``sin(x)/x``, ``x = wc d``: the roots of ``tan x = x`` (51), one just below each
    ``q = (i + 1/2) pi``. Equation (36) is ``x ~ q - 1/q``; it lies above the root, by 0.15 % for i = 1, 0.018 % for
    i = 2, and less beyond.
    """
    require_positive("cutoff", cutoff, "rad/s")
    require_integer("count", count, 0)
    q = (np.arange(1, count + 1) + 0.5) * np.pi
    x = q - 1 / q
    if exact:
        # With y = q - x the equation reads y = arctan(1/(q - y)): each round gains the factor x² + 1 > 21.
        y = 1 / q
        for _ in range(14):
            y = np.arctan(1 / (q - y))
        x = q - y
    return np.asarray(x / cutoff)


def convergence_region(cutoff: float, exact: bool = False) -> float:
    r"""Delay error up to which a descent of the ideal cost ends at zero."""
    return float(extrema(cutoff, 1, exact)[0])
