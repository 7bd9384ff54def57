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

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from ctid_cli.arrays import Array
from ctid_cli.filtering.lowpass import Lowpass
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.checks import require_integer, require_not_negative, require_positive

Spectrum = Callable[[Array], ArrayLike]

#: Panels of the quadrature whose two halves change them by less than this part of the whole are settled.
_SETTLED = 1e-13
#: More unsettled panels than this mean an integrand that cannot be resolved.
_PANELS_LIMIT = 50_000


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


def filtered_cost(
    delay_error: ArrayLike,
    system: TransferFunction,
    lowpass: Lowpass | TransferFunction,
    input_spectrum: Spectrum | None = None,
    noise_intensity: float = 0.0,
) -> Array:
    r"""Cost of a delay error for any rational system and any low-pass filter, the rational part being known.

    Equation (35). With ``1 - cos w d = 2 sin²(w d/2)`` no term of the integrand is negative, so small costs keep their
    digits too: the relative error is below 1e-10 for white input. Up to ten times the fastest corner frequency, or one
    oscillation, panels are halved until their Gauss-Legendre sums settle; what is left of slowly falling gains beyond
    it is a Fourier integral.
    """
    require_not_negative("noise_intensity", noise_intensity, "output unit² s")
    parts = (system, lowpass)
    for name, part in (("system", system), ("low-pass filter", lowpass)):
        if isinstance(part, TransferFunction) and not part.is_stable:
            raise ValueError(f"the {name} must be stable: every pole strictly in the left half-plane")
    if sum(_relative_degree(part) for part in parts) < 1:
        raise ValueError("the system and the low-pass filter together must have more poles than zeros")
    if noise_intensity > 0 and _relative_degree(lowpass) < 1:
        raise ValueError("with noise, the low-pass filter must have more poles than zeros")

    def power(w: Array) -> Array:
        gain = _gain_squared(system, w) * _gain_squared(lowpass, w)
        return gain if input_spectrum is None else gain * _checked(input_spectrum, w)

    errors = np.asarray(delay_error, dtype=float)
    if not np.isfinite(errors).all():
        raise ValueError("a delay error is not a finite number")
    corners = np.unique(np.concatenate([_corners(part) for part in parts]))
    cost = np.array([_delay_integral(power, corners, abs(d)) for d in errors.flat]).reshape(errors.shape)
    if noise_intensity > 0:
        corners = np.unique(_corners(lowpass))
        top = 10 * corners[-1]
        passed = _integral(lambda w: _gain_squared(lowpass, w), _edges(corners, top))
        cost = cost + noise_intensity / np.pi * (passed + _tail(lambda w: _gain_squared(lowpass, w), top))
    return np.asarray(cost)


def _relative_degree(part: Lowpass | TransferFunction) -> int:
    return part.order if isinstance(part, Lowpass) else part.relative_degree


def _gain_squared(part: Lowpass | TransferFunction, w: Array) -> Array:
    if isinstance(part, Lowpass):
        # The polynomial of a high order would lose digits to cancellation. Far beyond the cut-off the power overflows
        # to infinity, which is the right limit.
        with np.errstate(over="ignore"):
            return np.asarray(1 / (1 + (w / part.cutoff) ** (2 * part.order)))
    return np.asarray(np.abs(part.frequency_response(w)) ** 2)


def _checked(spectrum: Spectrum, w: Array) -> Array:
    density = np.broadcast_to(np.asarray(spectrum(w), dtype=float), w.shape)
    if not (np.isfinite(density).all() and (density >= 0).all()):
        raise ValueError("the input spectrum must be finite and not negative at every frequency")
    return density


def _corners(part: Lowpass | TransferFunction) -> Array:
    """Frequencies around which the gain changes: the poles, and the flanks of their resonances."""
    if isinstance(part, Lowpass):
        return np.array([part.cutoff])
    poles = part.poles
    centre, width = np.abs(poles.imag), np.abs(poles.real)
    corners = np.concatenate([np.abs(poles), np.abs(part.zeros), centre, centre + width, np.abs(centre - width)])
    return corners[corners > 0]


def _edges(corners: Array, top: float) -> Array:
    """Panels to begin with: from corner to corner, and no wider than an octave, so that no steep fall slips between."""
    octaves = corners[0] * 2.0 ** np.arange(np.ceil(np.log2(top / corners[0])))
    return np.unique(np.concatenate([[0.0, top], corners, octaves]))


def _delay_integral(power: Callable[[Array], Array], corners: Array, error: float) -> float:
    """(2/pi) times the integral of ``(1 - cos(w error)) power(w)`` over positive frequencies."""
    if error == 0.0:
        return 0.0
    top = max(10 * float(corners[-1]), 2 * np.pi / error)
    main = _integral(lambda w: 2 * np.sin(0.5 * error * w) ** 2 * power(w), _edges(corners, top))
    rest = _tail(power, top)
    if rest > _SETTLED * main:
        from scipy.integrate import quad  # slow to import, needed only here

        # In units of the oscillation: QUADPACK's Fourier integrator walks along in steps of fixed length.
        wave = quad(
            lambda x: power(np.array([x / error]))[0],
            top * error,
            np.inf,
            weight="cos",
            wvar=1.0,
            epsabs=1e-12 * main * error,
            limlst=500,
        )[0]
        rest -= wave / error
    return 2 / np.pi * (main + rest)


def _tail(power: Callable[[Array], Array], start: float) -> float:
    """Integral of a gain from a frequency to infinity."""
    return _integral(lambda v: power(start / v) * start / v**2, np.array([0.0, 1.0]))


def _integral(function: Callable[[Array], Array], edges: Array) -> float:
    """Integral of a function without sign changes over adjoining panels, each halved until its sum settles."""
    nodes, weights = np.polynomial.legendre.leggauss(16)

    def panels(low: Array, high: Array) -> Array:
        half = 0.5 * (high - low)[:, None]
        points = low[:, None] + half * (nodes + 1)
        return np.asarray((half * weights * function(points.ravel()).reshape(points.shape)).sum(axis=1))

    low, high = edges[:-1], edges[1:]
    sums = panels(low, high)
    settled = 0.0
    while low.size:
        middle = 0.5 * (low + high)
        left, right = panels(low, middle), panels(middle, high)
        halved = left + right
        # A panel that cannot be halved any more holds a jump, and next to nothing.
        open_ = (np.abs(halved - sums) > _SETTLED * (settled + halved.sum())) & (low < middle) & (middle < high)
        settled += float(halved[~open_].sum())
        if 2 * open_.sum() > _PANELS_LIMIT:
            raise ValueError(
                "the integral oscillates too often: the delay error is too large for the fastest corner frequency"
            )
        low, high = np.concatenate([low[open_], middle[open_]]), np.concatenate([middle[open_], high[open_]])
        sums = np.concatenate([left[open_], right[open_]])
    return settled
