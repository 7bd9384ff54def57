r"""Estimation problems on finite-record spectra: a search stage whose cost does not depend on the number of samples.

At the frequencies of :class:`~ctid_cli.filtering.spectra.RecordSpectra` the model ``x = B/A u(t - tau)`` obeys

.. math:: X = \frac{B(jw)\,U_\tau + T(jw)}{A(jw)}, \qquad \varepsilon = Y - X,

exactly, with one real polynomial T of degree n - 1 for the states at both ends of the window. T is linear: it is
projected out at every parameter vector, so that a record may start and end in mid-motion. The cost
``sum_k g_k |eps_k|^2`` counts every frequency on both sides of zero; with the weight ``g = |L(jw)|^2`` it is, by
Parseval, the mean square over the window of the output error behind the filter L.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numba import njit

from ctid_cli.arrays import Array, ComplexArray, IndexArray
from ctid_cli.estimation.problems import reflect_unstable, with_stable_denominator
from ctid_cli.estimation.refined_iv import Equations, scaled_solve
from ctid_cli.filtering.filter_data import plain_array
from ctid_cli.filtering.spectra import RecordSpectra
from ctid_cli.inference.sensitivity import Structure

#: Frequencies above the last one whose weight exceeds this fraction of the greatest are left out.
NEGLIGIBLE_WEIGHT = 1e-6
#: Real equations inside the pass band for every parameter, those of the transient included.
EQUATIONS_PER_PARAMETER = 4
#: A column of the transient that the earlier ones explain but for this fraction of its power adds nothing.
DEPENDENT = 1e-14

#: The signals by which ``(jw)^r/A`` is multiplied to form a column: of the transient, of dx/da, dx/db and dx/dtau, of
#: the regressor, and the output error.
ONE, MODEL, INPUT, DRIVE, OUTPUT, ERROR = range(6)
#: Number of their pairs.
PAIRS = 21


class SpectralCoefficientProblem:
    """Coefficients at a fixed delay: ``theta = (a_1 … a_n, b_0 … b_m)``."""

    def __init__(self, spectra: RecordSpectra, structure: Structure, delay: float, weight: Array) -> None:
        self.spectra = spectra
        self.structure = structure
        self.delay = delay
        self.weight = weight
        self.count = used_bins(weight)
        self._places = _places(structure.poles, structure.zeros, False)

    def split(self, theta: Array) -> tuple[Array, Array, float]:
        """Denominator, numerator and delay [s] of a parameter vector."""
        n = self.structure.poles
        return np.concatenate(([1.0], theta[:n])), theta[n:], self.delay

    def admissible(self, theta: Array) -> Array:
        """Reflect unstable denominators."""
        return with_stable_denominator(theta, self.structure.poles)

    def equations(self, theta: Array) -> Equations | None:
        """Second moments of the iteration, the transient projected out."""
        if not np.isfinite(theta).all():
            return None
        a, b, delay = self.split(theta)
        gram, power = _moments(self.spectra, self.count, self.weight, a, b, delay)
        if not np.isfinite(gram).all():
            return None
        hessian, mixed, error = self._places
        return Equations(gram.take(mixed), gram.take(error), gram.take(hessian), float(gram[-1, -1]), power)


class SpectralDelayProblem(SpectralCoefficientProblem):
    """Coefficients and delay together: ``theta = (a_1 … a_n, b_0 … b_m, delay)``.

    ``d eps/d tau = jw B/A U``. The end values of the delayed input, which enter the derivative of its finite spectrum
    as well, are a constant: the transient takes them.
    """

    def __init__(
        self, spectra: RecordSpectra, structure: Structure, bounds: tuple[float, float], weight: Array
    ) -> None:
        super().__init__(spectra, structure, 0.0, weight)
        self.bounds = bounds
        self._places = _places(structure.poles, structure.zeros, True)

    def split(self, theta: Array) -> tuple[Array, Array, float]:
        """Denominator, numerator and delay [s] of a parameter vector."""
        n = self.structure.poles
        return np.concatenate(([1.0], theta[:n])), theta[n:-1], float(theta[-1])

    def equations(self, theta: Array) -> Equations | None:
        """Second moments of the iteration, the transient projected out."""
        if not self.bounds[0] <= theta[-1] <= self.bounds[1]:
            return None
        return super().equations(theta)


def used_bins(weight: Array) -> int:
    """Number of frequencies, from the lowest, beyond which the weight is negligible."""
    return int(np.flatnonzero(weight >= NEGLIGIBLE_WEIGHT * weight.max())[-1]) + 1


def enough_bins(weight: Array, structure: Structure) -> bool:
    """Whether a filter passes enough frequencies for an estimate."""
    passed = int((weight >= 0.5 * weight.max()).sum())
    return 2 * passed >= EQUATIONS_PER_PARAMETER * (structure.size + structure.poles)


def spectral_least_squares_start(
    spectra: RecordSpectra, structure: Structure, delay: float, svf_cutoff: float, weight: Array
) -> Array | None:
    """Least-squares estimate with the state-variable filter ``1/(p + w)^n``."""
    n, m = structure.poles, structure.zeros
    filter_denominator = np.asarray(np.poly(np.full(n, -svf_cutoff)), dtype=np.float64)
    # With a zero numerator the "output error" is y itself, and with F for A the regressors are the filtered signals:
    # A Y = B U + T divided by F reads Y = -sum (a_i - f_i) (jw)^(n-i)/F Y + B/F U + T/F.
    gram, _ = _moments(spectra, used_bins(weight), weight, filter_denominator, np.zeros(m + 1), delay)
    columns = _regressors(n, m, False)
    normal = gram[columns[:, None], columns]
    diagonal = normal.diagonal()
    theta = scaled_solve(normal, gram[columns, -1], diagonal, diagonal)
    if theta is None:
        return None
    stable = reflect_unstable(np.concatenate(([1.0], filter_denominator[1:] + theta[:n])))
    return np.concatenate((stable[1:], theta[n:]))


def spectral_refit_numerator(
    spectra: RecordSpectra, structure: Structure, theta: Array, delay: float, weight: Array
) -> Array:
    """Best numerator for a given denominator, by linear least squares on the output error."""
    n, m = structure.poles, structure.zeros
    denominator = np.concatenate(([1.0], theta[:n]))
    gram, _ = _moments(spectra, used_bins(weight), weight, denominator, np.zeros(m + 1), delay)
    normal = gram[n : n + m + 1, n : n + m + 1]
    diagonal = normal.diagonal()
    numerator = scaled_solve(normal, gram[n : n + m + 1, -1], diagonal, diagonal)
    return theta if numerator is None else np.concatenate((theta[:n], numerator))


def _regressors(n: int, m: int, with_delay: bool) -> IndexArray:
    """Columns of the moments that hold the regressors: the sensitivities but for the denominator's."""
    columns = np.arange(n + m + 1 + int(with_delay))
    columns[:n] += n + m + 2
    return columns


@lru_cache(maxsize=64)
def _places(n: int, m: int, with_delay: bool) -> tuple[IndexArray, IndexArray, IndexArray]:
    """Places of the Hessian, the instrumental-variable matrix and the gradient in the flattened moments."""
    size = 2 * n + m + 3
    regressors = _regressors(n, m, with_delay)
    sensitivities = np.arange(regressors.size)
    rows = size * sensitivities
    return rows[:, None] + sensitivities, rows[:, None] + regressors, rows + size - 1


def _moments(
    spectra: RecordSpectra, count: int, weight: Array, a: Array, b: Array, delay: float
) -> tuple[Array, float]:
    """Moments at one model from the ``count`` lowest frequencies."""
    gram, power = _projected_moments(
        spectra.frequencies,
        spectra.outputs,
        spectra.inputs(delay, count),
        plain_array(weight),
        plain_array(a),
        plain_array(b),
    )
    return gram, float(power)


@njit(cache=True, nogil=True, error_model="numpy")
def _at(coefficients: Array, w: float) -> complex:
    """Polynomial in descending powers at ``jw``."""
    re, im = 0.0, 0.0
    for c in coefficients:
        re, im = c - im * w, re * w
    return complex(re, im)


@njit(cache=True, nogil=True)
def _lane(left: int, right: int) -> int:
    """Place of a pair of signals, ``left <= right``, among the pairs in lexical order."""
    return left * (11 - left) // 2 + right


@njit(cache=True, nogil=True, error_model="numpy")
def _product(sums: Array, lane: int, r: int, s: int) -> float:
    """``sum Re(conj((jw)^r P) (jw)^s Q)`` from the power sums of ``conj(P) Q``.

    ``conj(j^r) j^s = j^(s - r)``: even powers of w go with the real parts, odd ones with the imaginary parts.
    """
    turn = (s - r) % 4
    value: float = sums[r + s, lane]
    return value if turn == 0 or turn == 3 else -value


@njit(cache=True, nogil=True, error_model="numpy")
def _factor(normal: Array) -> None:
    """Cholesky factor in place of the lower triangle; a dependent column leaves a zero on the diagonal."""
    for i in range(normal.shape[0]):
        own = normal[i, i]
        for j in range(i + 1):
            total = normal[i, j]
            for h in range(j):
                total -= normal[i, h] * normal[j, h]
            if j < i:
                normal[i, j] = total / normal[j, j] if normal[j, j] > 0.0 else 0.0
            else:
                normal[i, i] = np.sqrt(total) if total > DEPENDENT * own else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _forward(factor: Array, vector: Array) -> None:
    """Solve ``L z = vector`` in place; dependent columns take no part."""
    for i in range(vector.size):
        for j in range(i):
            vector[i] -= factor[i, j] * vector[j]
        vector[i] = vector[i] / factor[i, i] if factor[i, i] > 0.0 else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _transient(w: Array, power: Array, remainder: ComplexArray, n: int) -> tuple[Array, Array]:
    """Least squares of R = A Y - B U on the powers ``0 … n - 1`` of jw.

    Returns the factor of the normal equations and the polynomial in descending powers.
    """
    sums = np.zeros((2 * n - 1, 2))
    for k in range(w.size):
        weight = power[k]
        for q in range(2 * n - 1):
            sums[q, 0] += weight if q % 2 == 0 else 0.0
            sums[q, 1] += weight * (remainder[k].real if q % 2 == 0 else remainder[k].imag)
            weight *= w[k]
    factor, solution, falling = np.empty((n, n)), np.empty(n), np.empty(n)
    for i in range(n):
        solution[i] = _product(sums, 1, i, 0)
        for j in range(n):
            factor[i, j] = _product(sums, 0, i, j)
    _factor(factor)
    _forward(factor, solution)
    for i in range(n - 1, -1, -1):
        for j in range(i + 1, n):
            solution[i] -= factor[j, i] * solution[j]
        solution[i] = solution[i] / factor[i, i] if factor[i, i] > 0.0 else 0.0
        falling[n - 1 - i] = solution[i]
    return factor, falling


@njit(cache=True, nogil=True, error_model="numpy")
def _projected_moments(
    frequencies: Array, outputs: ComplexArray, inputs: ComplexArray, weight: Array, a: Array, b: Array
) -> tuple[Array, float]:
    """Moments of the columns (dx/da, dx/db, dx/dtau, phi_1 … phi_n, eps), the transient projected out of all.

    Every column is ``(jw)^r/A`` times a signal: dx/da takes the model's output and phi the measured one, dx/db the
    input, dx/dtau ``jw B U``. All products of columns are therefore sums of powers of w times few products of signals,
    as in a Hankel matrix. Only as many frequencies are used as ``inputs`` holds. Also returns the power of the model's
    output.
    """
    n, m, count = a.size - 1, b.size - 1, inputs.size
    # In units of the highest frequency powers of w stay below one.
    unit = frequencies[count - 1] if frequencies[count - 1] > 0.0 else 1.0
    size = 2 * n + m + 3
    den, num, scale = np.ones(n + 1), np.empty(m + 1), np.ones(size)
    for i in range(1, n + 1):
        den[i] = a[i] / unit**i
        scale[i - 1] = unit ** (-i)
        scale[n + m + 1 + i] = scale[i - 1]
    for j in range(m + 1):
        scale[n + j] = unit ** (m - n - j)
        num[j] = b[j] * scale[n + j]
    scale[n + m + 1] = unit

    w, side, power = np.empty(count), np.empty(count), np.empty(count)
    inverse, drive, remainder = np.empty(count, np.complex128), np.empty(count, np.complex128), inputs.copy()
    for k in range(count):
        w[k] = frequencies[k] / unit
        at = _at(den, w[k])
        gain = 1.0 / (at.real * at.real + at.imag * at.imag)
        inverse[k] = at.conjugate() * gain
        side[k] = weight[k] if w[k] == 0.0 else 2.0 * weight[k]
        power[k] = side[k] * gain
        drive[k] = _at(num, w[k]) * inputs[k]
        remainder[k] = at * outputs[k] - drive[k]
    factor, polynomial = _transient(w, power, remainder, n)

    # Power sums of the products of all pairs of signals.
    sums = np.zeros((2 * n - 1, PAIRS))
    signals, re, im = np.ones(6, np.complex128), np.empty(PAIRS), np.empty(PAIRS)
    output_power = 0.0
    for k in range(count):
        explained = _at(polynomial, w[k])
        response = (drive[k] + explained) * inverse[k]
        output_power += side[k] * (response.real * response.real + response.imag * response.imag)
        signals[MODEL] = response
        signals[INPUT] = inputs[k]
        signals[DRIVE] = 1j * w[k] * drive[k]
        signals[OUTPUT] = outputs[k]
        signals[ERROR] = remainder[k] - explained
        lane = 0
        for i in range(6):
            for j in range(i, 6):
                re[lane] = signals[i].real * signals[j].real + signals[i].imag * signals[j].imag
                im[lane] = signals[i].real * signals[j].imag - signals[i].imag * signals[j].real
                lane += 1
        scaled = power[k]
        for q in range(2 * n - 1):
            part = re if q % 2 == 0 else im
            for lane in range(PAIRS):
                sums[q, lane] += scaled * part[lane]
            scaled *= w[k]

    # Signal, power of jw and sign of every column.
    signal, exponent, sign = np.empty(size, np.int64), np.zeros(size, np.int64), np.ones(size)
    for i in range(n):
        phi = n + m + 2 + i
        signal[i], signal[phi] = MODEL, OUTPUT
        exponent[i] = exponent[phi] = n - 1 - i
        sign[i] = sign[phi] = -1.0
    for j in range(m + 1):
        signal[n + j], exponent[n + j] = INPUT, m - j
    signal[n + m + 1], sign[n + m + 1] = DRIVE, -1.0
    signal[size - 1] = ERROR

    projected = np.zeros((size, n))
    for j in range(size - 1):  # the error is orthogonal to the transient already
        for i in range(n):
            projected[j, i] = sign[j] * _product(sums, _lane(ONE, signal[j]), i, exponent[j])
        _forward(factor, projected[j])
    gram = np.empty((size, size))
    for i in range(size):
        for j in range(i, size):
            total = sign[i] * sign[j] * _product(sums, _lane(signal[i], signal[j]), exponent[i], exponent[j])
            for h in range(n):
                total -= projected[i, h] * projected[j, h]
            gram[i, j] = total * scale[i] * scale[j]
            gram[j, i] = gram[i, j]
    return gram, output_power
