"""Phases that make a sum of harmonics low: as much power as possible under a given peak."""

from functools import cache

import numpy as np

from ctid_cli.arrays import Array

#: Instants of one period of the highest harmonic on which the peak is sought.
OVERSAMPLING = 16
#: Exponents p of the norm that is lowered, one after the other: the greatest is close to the peak itself.
EXPONENTS = (4, 8, 16, 32, 64, 128, 256)
#: Steps of the descent at each exponent.
STEPS = 200


@cache
def low_crest_phases(harmonics: tuple[int, ...], start: tuple[float, ...]) -> Array:
    r"""Phases of equal cosines with the lowest l_p norms, p rising, found by descent from a start [rad].

    Minimising ``|x|_p`` for rising p leads to the Chebyshev solution (P. Guillaume, J. Schoukens, R. Pintelon and
    I. Kollar, *Crest-factor minimization using nonlinear Chebyshev approximation methods*, IEEE Trans. Instrum. Meas.
    40(6), 1991, https://doi.org/10.1109/19.119778); here by quasi-Newton steps, whose gradient is one transform.
    """
    from scipy.optimize import minimize

    k = np.array(harmonics)
    points = 2 ** int(np.ceil(np.log2(OVERSAMPLING * k.max())))

    def cost(phases: Array, p: int) -> tuple[float, Array]:
        """``ln |x|_p`` and its derivatives."""
        spectrum = np.zeros(points // 2 + 1, dtype=complex)
        spectrum[k] = 0.5 * points * np.exp(1j * phases)
        x = np.fft.irfft(spectrum, points)
        peak = np.abs(x).max()
        scaled = np.abs(x) / peak
        mean = float(np.mean(scaled**p))
        # d ln |x|_p / dx, and dx/dphase = -sin(k t + phase) at every instant.
        slope = np.sign(x) * scaled ** (p - 1) / (mean * peak * points)
        return float(np.log(peak) + np.log(mean) / p), np.imag(np.exp(-1j * phases) * np.fft.rfft(slope)[k])

    phases = np.array(start)
    for p in EXPONENTS:
        phases = minimize(cost, phases, args=(p,), jac=True, method="L-BFGS-B", options={"maxiter": STEPS}).x
    return np.asarray(phases, dtype=float)
