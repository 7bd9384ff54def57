"""Frequencies from a regression on filtered derivatives: derived, not the published algorithm."""

from dataclasses import dataclass
from math import comb
from typing import Literal

import numpy as np
from numba import njit
from scipy.linalg import expm
from scipy.signal import lfilter

from ctid_cli import DataError, Flag, FrequencyEstimator, FrequencyTrack

from .common import complete_samples, is_certain, require_positive, scaled_inverses

#: Time of the first estimate [s].
HOLD = 1.0
#: Number of samples between two computations of the frequencies.
REFRESH = 5
#: Second moments summed over many samples carry relative errors of about this size.
ROUNDING = 4e-15


@dataclass(frozen=True, kw_only=True)
class FilterRegression(FrequencyEstimator):
    r"""Frequencies from a linear regression on filtered derivatives; derived, not the published algorithm.

    Parameters
    ----------
    tones : int
        Number of sinusoids n, 1 to 8.
    pole : float
        Rate of the filter [rad/s], near the frequencies.
    forgetting : float, default 0.5
        Forgetting rate of old data [1/s].
    algorithm : {"least_squares", "gradient"}, default "least_squares"
        Adaptation of the parameters.
    gains : tuple of float, optional
        Gains of the gradient algorithm, one for each parameter; 1 if not given.
    initial_frequencies : tuple of float, optional
        Initial frequencies [rad/s]; by default spread up to ``pole``.

    Notes
    -----
    Derived, not the published algorithm: with one tone and the gradient it has the structure of the known first-order
    frequency observer, and the extension to several tones is our own.

    ``z = (l/(s + l))^(2n) y`` satisfies ``prod(s^2 + w_i^2) z = 0`` once the filter has settled, a linear regression of
    ``z^(2n)`` on the even derivatives below. They are combinations of the states of a chain of first-order filters,
    advanced exactly for a signal that is linear between its samples. The parameters are those of the polynomial in
    ``X = w^2`` whose roots are the squared frequencies. The gradient is normalised and implicit:
    ``a += Ts K phi e/(1 + Ts phi' K phi)``.

    References
    ----------
    For the structure with one tone: D. J. W. Belleter, R. Galeazzi and T. I. Fossen, "Experimental verification of a
    global exponential stable nonlinear wave encounter frequency estimator", *Ocean Engineering* 97 (2015) 48-56.
    doi:10.1016/j.oceaneng.2014.12.030
    """

    pole: float
    forgetting: float = 0.5
    algorithm: Literal["least_squares", "gradient"] = "least_squares"
    gains: tuple[float, ...] | None = None
    initial_frequencies: tuple[float, ...] | None = None

    def __post_init__(self):
        super().__post_init__()
        require_positive(self, "pole", "forgetting")
        for name, unit in (("gains", "-"), ("initial_frequencies", "rad/s")):
            self.keep_one_for_each(name, unit)

    def check(self, count, interval):
        """Refuse clocks that are too slow."""
        if self.pole * interval > np.pi:
            beyond = f"pole = {self.pole:g} rad/s is beyond what samples every {interval:g} s can show"
            raise DataError(f"{beyond}; use one below {np.pi / interval:g} rad/s", "pole")

    def track(self, samples, interval):
        """Return the estimate at every sample of the record."""
        y = complete_samples(samples)
        self.check(y.size, interval)
        n, count = self.tones, y.size
        initial = np.sort(self.initial_frequencies or self.pole * np.arange(1, n + 1) / n)
        rows = filter_chain(y, self.pole, 2 * n, interval) @ derivative_rows(n, self.pole).T
        # The chain begins at rest at the first sample.
        rows[0] = 0.0

        # Estimates are computed at these samples and held until the next one; before the first the initial ones apply.
        hold = round(HOLD / interval)
        decoded = np.arange(max(hold, REFRESH), count, REFRESH)
        keep = np.exp(-self.forgetting * interval)
        moments = lfilter([1.0], [1.0, -keep], rows[:, :, None] * rows[:, None, :], axis=0)[decoded]
        coefficients = None
        if self.algorithm == "gradient":
            gains = interval * np.asarray(self.gains or np.ones(n))
            coefficients = descend(rows, gains, np.poly(initial**2)[1:])[decoded]
        # The effective length of an exponential window, and the mean delay of the filter.
        elapsed = interval * (decoded + 1.0)
        span = np.minimum(elapsed, 2.0 / self.forgetting + 2 * n / self.pole)
        found, verdicts = self._estimates(moments, coefficients, span, elapsed)

        # Singular moments determine nothing, and leave the estimate unchanged.
        last = np.maximum.accumulate(np.where(verdicts == Flag.UNDETERMINED, -1, np.arange(decoded.size)))
        found = np.vstack((initial, found))[1 + last]
        newest = np.searchsorted(decoded, np.arange(count), side="right")
        omega = np.vstack((initial, found))[newest]
        flags = np.concatenate(([Flag.UNDETERMINED], verdicts))[newest]
        flags[: max(hold, 1)] |= Flag.STARTING
        return FrequencyTrack(interval * np.arange(count), omega, flags.astype(np.uint16))

    def _estimates(self, moments, coefficients, span, elapsed):
        """Return the frequencies from second moments, or from given coefficients, and flags of invalid ones."""
        n = self.tones
        scales, inverses, determined = scaled_inverses(moments[:, :n, :n])
        inverses = inverses / (scales[:, :, None] * scales[:, None, :])
        if coefficients is None:
            coefficients = np.einsum("mij,mj->mi", inverses, moments[:, :n, n])
        roots, flags = positive_roots(coefficients)
        omega = np.sqrt(roots)

        # The misfit of the equations moves a frequency by at most sqrt(g' G^-1 g e'e), with g its derivatives with
        # respect to the coefficients (Cauchy-Schwarz); as a difference of moments it is known up to rounding only.
        weights = np.column_stack((-coefficients, np.ones(span.size)))
        misfit = np.maximum(np.einsum("mi,mij,mj->m", weights, moments, weights), 0.0)
        size = np.sqrt(moments[:, n, n]) + (np.abs(coefficients) * scales).sum(axis=1)
        with np.errstate(all="ignore"):  # equal roots, and a root of zero, have no finite derivatives
            slopes = root_derivatives(roots) / (2.0 * omega[:, :, None])
            directions = np.einsum("mik,mkl->mil", slopes, inverses)
            squares = np.maximum(np.einsum("mik,mik->mi", directions, slopes), 0.0)
            error = np.sqrt(squares * np.maximum(misfit, ROUNDING * size**2)[:, None])
            rounding = ROUNDING * size[:, None] * np.abs(directions * scales[:, None, :]).sum(axis=2)
        flags[~is_certain(omega, error, span, elapsed, rounding)] |= Flag.UNCERTAIN
        flags[~determined] = Flag.UNDETERMINED
        return omega, flags


def derivative_rows(tones, pole):
    """Return regressors and regressand as combinations of the states of the chain, shape (n + 1, 2 n + 1)."""
    order = 2 * tones
    rows = np.zeros((tones + 1, order + 1))
    for k in range(tones + 1):
        derivative = 2 * (tones - k)
        target = k - 1 if k else tones
        sign = -((-1) ** k) if k else 1
        for i in range(derivative + 1):
            rows[target, order - derivative + i] = sign * pole**derivative * comb(derivative, i) * (-1) ** i
    return rows


def filter_chain(y, pole, order, interval):
    """Return a signal, linear between its samples, after 0, 1, ... ``order`` filters ``pole/(s + pole)`` from rest."""
    # x' = pole (J - I) x + pole e_1 y: the exact transition over an interval on which y changes linearly.
    system = np.zeros((order + 2, order + 2))
    system[:order, :order] = pole * interval * (np.eye(order, k=-1) - np.eye(order))
    system[0, order] = pole * interval
    system[order, order + 1] = 1.0
    step = expm(system)
    chain = np.column_stack((y, np.zeros((y.size, order))))
    before, change = y[:-1], np.diff(y)
    for i in range(order):
        # Lower triangular: the input of a filter depends only on those before it.
        driving = step[i, order] * before + step[i, order + 1] * change + chain[:-1, 1 : 1 + i] @ step[i, :i]
        chain[1:, 1 + i] = lfilter([1.0], [1.0, -step[i, i]], driving)
    return chain


def positive_roots(coefficients):
    """Return the real parts of the roots of ``x^n + a_1 x^(n-1) + ... + a_n``, ascending from zero, and flags."""
    count, n = coefficients.shape
    companions = np.zeros((count, n, n))
    companions[:, 0] = -np.where(np.isfinite(coefficients), coefficients, 0.0)
    companions[:, np.arange(1, n), np.arange(n - 1)] = 1.0
    roots = np.linalg.eigvals(companions)
    flags = np.where((np.imag(roots) != 0.0).any(axis=1), Flag.COMPLEX_ROOTS, 0)
    real = np.sort(np.real(roots), axis=1)
    flags[(real < 0.0).any(axis=1)] |= Flag.OUT_OF_BOUNDS
    return np.maximum(real, 0.0), flags


def root_derivatives(roots):
    """Return the derivatives of the roots with respect to the coefficients a_1 ... a_n, shape (N, n, n)."""
    n = roots.shape[1]
    # d x_i/d a_k = -x_i^(n-k)/prod_j(x_i - x_j): implicit derivative of the polynomial at its root.
    differences = roots[:, :, None] - roots[:, None, :] + np.eye(n)
    return -(roots[:, :, None] ** np.arange(n - 1, -1, -1)) / differences.prod(axis=2)[:, :, None]


@njit(cache=True, nogil=True)
def descend(rows, gains, initial):
    """Return the coefficients after each row: implicit steps ``a += K phi e/(1 + phi' K phi)``."""
    count, n = rows.shape[0], initial.size
    found, coefficients = np.empty((count, n)), initial.copy()
    for k in range(count):
        residual, size = rows[k, n], 1.0
        for i in range(n):
            residual -= rows[k, i] * coefficients[i]
            size += gains[i] * rows[k, i] * rows[k, i]
        for i in range(n):
            coefficients[i] += gains[i] * rows[k, i] * residual / size
        found[k] = coefficients
    return found
