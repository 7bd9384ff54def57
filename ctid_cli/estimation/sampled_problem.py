"""Estimation problem of a single transfer function on the samples of one record, and its stable denominators."""

from collections.abc import Sequence
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.estimation.iteration import inadmissible, solve_scaled, with_best
from ctid_cli.filtering.bank import Equations, second_moments, standard_rows
from ctid_cli.filtering.filter_data import FilterData
from ctid_cli.filtering.realisation import scaled_roots
from ctid_cli.inference.input_response import output_bandwidth
from ctid_cli.inference.sensitivities import Structure
from ctid_cli.signals.record import Record

#: Distance by which a root is moved off the axis, relative to the largest root: filters require strict stability.
OFF_THE_AXIS = 1e-6
#: Default cut-offs of the state-variable filter, as multiples of the output's bandwidth.
CUTOFFS = (1.0, 0.2, 5.0, 0.04)


def is_hurwitz(a: Array) -> bool:
    """Return whether every root of a monic polynomial lies in the open left half-plane (Routh's criterion)."""
    coefficients = a.tolist()
    # Positive coefficients are necessary, and sufficient for n <= 2; the test also rejects NaN.
    if not all(c > 0.0 for c in coefficients):
        return False
    # The first two rows of Routh's array are the even and the odd coefficients.
    upper, lower = coefficients[0::2], coefficients[1::2]
    # Each new row replaces the older of its two predecessors; without sign changes in the first column it is stable.
    while len(lower) > 0 and len(upper) > 1:
        ratio = upper[0] / lower[0]
        padded = [*lower, 0.0]
        upper, lower = lower, [upper[k] - ratio * padded[k] for k in range(1, len(upper))]
        if not lower[0] > 0.0:
            return False
    return True


def reflect_unstable(a: Array) -> Array:
    """Return a monic polynomial with its right-half-plane roots reflected into the left half-plane."""
    if is_hurwitz(a):
        return a
    # With scaled time the coefficients neither overflow nor underflow.
    w0, roots = scaled_roots(a)
    least = OFF_THE_AXIS * (float(np.abs(roots).max()) or 1.0)
    mirrored = -np.maximum(np.abs(roots.real), least) + 1j * roots.imag
    return np.asarray(np.poly(mirrored).real * w0 ** np.arange(a.size))


def with_stable_denominator(theta: Array, poles: int) -> Array:
    """Return a parameter vector with its leading denominator reflected if it is unstable."""
    if not np.isfinite(theta).all():
        return theta
    a = np.concatenate(([1.0], theta[:poles]))
    if is_hurwitz(a):
        return theta
    stable = theta.copy()
    stable[:poles] = reflect_unstable(a)[1:]
    return stable


class SampledProblem(NamedTuple):
    """Coefficients and delay: ``theta = (a_1 … a_n, b_0 … b_m, delay)``; the delay is fixed or free within bounds."""

    data: FilterData
    poles: int
    zeros: int
    free_delay: bool
    low: float
    high: float

    @property
    def structure(self) -> Structure:
        """Structure of the estimated parameters."""
        return Structure(self.poles, self.zeros, self.free_delay)

    @property
    def free(self) -> int:
        """Number of parameters to iterate on."""
        return self.poles + self.zeros + 1 + self.free_delay

    @property
    def samples(self) -> int:
        """Number of samples in the sums."""
        return self.data.count

    def split(self, theta: Array) -> tuple[Array, Array, float]:
        """Return denominator, numerator and delay [s] of a parameter vector."""
        return np.concatenate(([1.0], theta[: self.poles])), theta[self.poles : -1], float(theta[-1])

    def equations(self, theta: Array) -> Equations:
        """Return the second moments of the iteration."""
        n, m = self.poles, self.zeros
        delay = float(theta[-1])
        if not (self.low <= delay <= self.high and np.isfinite(theta).all()):
            return inadmissible(theta.size)
        b = theta[n:-1]
        # What overflows is found by the moments not being finite.
        with np.errstate(all="ignore"):
            moments = second_moments(self.data, np.concatenate(([1.0], theta[:n])), b, delay)
        if not np.isfinite(moments).all():
            return inadmissible(theta.size)
        whole = _with_delay(n, m)
        psi, phi, signs, error = whole.sensitivity_rows, whole.regressor_rows, whole.signs, whole.error_row
        mixed, hessian = (moments[psi[:, None], rows] * (signs[:, None] * signs) for rows in (phi, psi))
        # x = sum b_j p^(m-j)/A u.
        rising = b[::-1]
        power = float(rising @ moments[: m + 1, : m + 1] @ rising)
        return Equations(mixed, moments[psi, error] * signs, hessian, float(moments[error, error]), power)

    def rows(self, theta: Array) -> tuple[Array, Array]:
        """Return sensitivities of the simulated output, and the output error, at the used samples."""
        rows, structure = standard_rows(self.data, *self.split(theta)), self.structure
        return rows[:, structure.sensitivity_rows] * structure.signs, rows[:, structure.error_row]

    def admissible(self, theta: Array) -> Array:
        """Reflect unstable denominators."""
        return with_stable_denominator(theta, self.poles)


#: Rows of the sensitivities, including the delay, in the second moments.
_with_delay = lru_cache(partial(Structure, delay=True))


def at_known_delay(data: FilterData, structure: Structure) -> SampledProblem:
    """Return the problem of the coefficients at a fixed delay."""
    return SampledProblem(data, structure.poles, structure.zeros, False, 0.0, np.inf)


def cutoffs_of(record: Record, given: float | None) -> tuple[float, ...]:
    """Return the cut-offs of the state-variable filter of starts [rad/s]: the given one, or several by bandwidth."""
    if given is not None:
        return (given,)
    return cutoffs_around(output_bandwidth(record))


def cutoffs_around(bandwidth: float) -> tuple[float, ...]:
    """Return the cut-offs of starts for a bandwidth [rad/s]."""
    return tuple(multiple * bandwidth for multiple in CUTOFFS)


def least_squares_starts(
    data: FilterData, structure: Structure, delay: float, svf_cutoffs: Sequence[float], refit: bool = False
) -> list[Array]:
    """Return the least-squares estimates of several cut-offs, without singular ones."""
    found = (least_squares_start(data, structure, delay, cutoff, refit) for cutoff in svf_cutoffs)
    return [theta for theta in found if theta is not None]


def least_squares_start(
    data: FilterData, structure: Structure, delay: float, svf_cutoff: float, refit: bool = False
) -> Array | None:
    """Return the least-squares estimate with the state-variable filter ``1/(p + w)^n``; None if it is singular.

    ``refit`` refits the numerator to the output error for the denominator of the estimate.
    """
    n, m = structure.poles, structure.zeros
    filter_denominator = np.asarray(np.poly(np.full(n, -svf_cutoff)), dtype=np.float64)
    # With a zero numerator the "output error" row is y itself.
    moments = second_moments(data, filter_denominator, np.zeros(1), delay)
    regressors, signs = structure.regressor_rows, structure.signs
    gram = moments[np.ix_(regressors, regressors)] * np.outer(signs, signs)
    # p^n/A_svf y = y - sum a_i p^(n-i)/A_svf y holds exactly at the samples.
    highest = moments[3 * n + 1, regressors] - sum(
        filter_denominator[i] * moments[3 * n + 1 - i, regressors] for i in range(1, n + 1)
    )
    lengths = np.diag(gram).copy()
    solved, coefficients = solve_scaled(gram, highest * signs, lengths, lengths, gram.shape[0])
    if not solved:
        return None
    stable = reflect_unstable(np.concatenate(([1.0], coefficients[:n])))
    theta = np.concatenate((stable[1:], coefficients[n:], [delay]))
    if not refit:
        return theta
    return with_best(at_known_delay(data, structure), theta, n, n + m + 1)
