r"""Estimation problems on finite-record spectra: a search stage whose cost does not depend on the number of samples.

At the frequencies of :class:`~ctid_cli.filtering.spectra.RecordSpectra` the model ``x = B/A u(t - tau)`` obeys

.. math:: X = \frac{B(jw)\,U_\tau + T(jw)}{A(jw)}, \qquad \varepsilon = Y - X,

exactly, with one real polynomial T of degree n - 1 for the states at both ends of the window. T is linear: it is
projected out at every parameter vector, so that a record may start and end in mid-motion. The cost
``sum_k g_k |eps_k|^2`` counts every frequency on both sides of zero; with the weight ``g = |L(jw)|^2`` it is, by
Parseval, the mean square over the window of the output error behind the filter L.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from ctid_cli.arrays import Array, ComplexArray
from ctid_cli.estimation.iteration import Equations, compiled_as, inadmissible, solve_scaled
from ctid_cli.estimation.stability import reflect_unstable, with_stable_denominator

#: A column of the transient that the earlier ones explain but for this fraction of its power adds nothing.
DEPENDENT = 1e-14

#: The signals by which ``(jw)^r/A`` is multiplied to form a column: of the transient, of dx/da, dx/db and dx/dtau, and
#: the output error.
ONE, OUTPUT, INPUT, DRIVE, ERROR = range(5)
#: Number of their pairs.
PAIRS = 15


class SpectralProblem(NamedTuple):
    """Coefficients at a held delay: ``theta = (a_1 … a_n, b_0 … b_m, delay)``.

    ``d eps/d tau = jw B/A U``. The end values of the delayed input, which enter the derivative of its finite spectrum
    as well, are a constant: the transient takes them. The regressors are the sensitivities: steps are Gauss-Newton's.
    """

    frequencies: Array
    outputs: ComplexArray
    #: At the delay, shape (K,).
    inputs: ComplexArray
    weight: Array
    poles: int
    zeros: int

    @property
    def free(self) -> int:
        """Number of parameters to iterate on."""
        return self.poles + self.zeros + 1

    def equations(self, theta: Array) -> Equations:
        """Second moments of the iteration, the transient projected out."""
        moments: Equations = spectral_equations(self, theta)
        return moments

    def admissible(self, theta: Array) -> Array:
        """Reflect unstable denominators."""
        return with_stable_denominator(theta, self.poles)


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
    return left * (9 - left) // 2 + right


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
    # Lane 0: power sums of 1/|A|^2, of which the normal matrix is made, a Hankel matrix up to signs; lane 1: of R.
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
    # Back substitution with the transposed factor.
    for i in range(n - 1, -1, -1):
        for j in range(i + 1, n):
            solution[i] -= factor[j, i] * solution[j]
        solution[i] = solution[i] / factor[i, i] if factor[i, i] > 0.0 else 0.0
        falling[n - 1 - i] = solution[i]
    return factor, falling


@njit(cache=True, nogil=True, error_model="numpy")
def _projected_moments(problem: SpectralProblem, a: Array, b: Array, measured: bool) -> tuple[Array, float]:
    """Moments of the columns (dx/da, dx/db, dx/dtau, eps), the transient projected out of all.

    Every column is ``(jw)^r/A`` times a signal: dx/da takes the model's output, or the measured one, dx/db the input,
    dx/dtau ``jw B U``. All products of columns are therefore sums of powers of w times few products of signals, as in a
    Hankel matrix. Also returns the power of the model's output.
    """
    frequencies, inputs = problem.frequencies, problem.inputs
    n, m, count = a.size - 1, b.size - 1, inputs.size
    # In units of the highest frequency powers of w stay below one.
    unit = frequencies[count - 1] if frequencies[count - 1] > 0.0 else 1.0
    size = n + m + 3
    den, num, scale = np.ones(n + 1), np.empty(m + 1), np.ones(size)
    for i in range(1, n + 1):
        den[i] = a[i] / unit**i
        scale[i - 1] = unit ** (-i)
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
        # A frequency above zero stands for its negative too.
        side[k] = problem.weight[k] if w[k] == 0.0 else 2.0 * problem.weight[k]
        power[k] = side[k] * gain
        drive[k] = _at(num, w[k]) * inputs[k]
        remainder[k] = at * problem.outputs[k] - drive[k]
    factor, polynomial = _transient(w, power, remainder, n)

    # Power sums of the products of all pairs of signals.
    sums = np.zeros((2 * n - 1, PAIRS))
    signals, re, im = np.ones(5, np.complex128), np.empty(PAIRS), np.empty(PAIRS)
    output_power = 0.0
    for k in range(count):
        explained = _at(polynomial, w[k])
        response = (drive[k] + explained) * inverse[k]
        output_power += side[k] * (response.real * response.real + response.imag * response.imag)
        signals[OUTPUT] = problem.outputs[k] if measured else response
        signals[INPUT] = inputs[k]
        signals[DRIVE] = 1j * w[k] * drive[k]
        signals[ERROR] = remainder[k] - explained
        lane = 0
        for i in range(5):
            for j in range(i, 5):
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
        signal[i], exponent[i], sign[i] = OUTPUT, n - 1 - i, -1.0
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


@njit(cache=True, nogil=True)
def spectral_equations(problem: SpectralProblem, theta: Array) -> Equations:
    """Second moments of the iteration, the delay included."""
    n, p = problem.poles, problem.poles + problem.zeros + 2
    if not np.isfinite(theta).all():
        return inadmissible(p)
    a = np.ones(n + 1)
    a[1:] = theta[:n]
    gram, power = _projected_moments(problem, a, theta[n : p - 1].copy(), False)
    if not np.isfinite(gram).all():
        return inadmissible(p)
    hessian = gram[:p, :p].copy()
    return Equations(hessian, gram[:p, p].copy(), hessian, gram[p, p], power)


compiled_as(SpectralProblem, spectral_equations)


@njit(cache=True, nogil=True)
def spectral_least_squares_start(problem: SpectralProblem, svf_cutoff: float) -> tuple[bool, Array]:
    """Least-squares estimate with the state-variable filter ``1/(p + w)^n``, the delay left at zero."""
    n, m = problem.poles, problem.zeros
    p = n + m + 2
    svf = np.zeros(n + 1)
    svf[0] = 1.0
    for i in range(n):
        for k in range(i + 1, 0, -1):
            svf[k] += svf_cutoff * svf[k - 1]
    # A Y = B U + T divided by F reads Y = -sum (a_i - f_i) (jw)^(n-i)/F Y + B/F U + T/F: with F for A and a zero
    # numerator the "output error" is y itself, and with the measured output for the model's the columns are these.
    gram, _ = _projected_moments(problem, svf, np.zeros(m + 1), True)
    theta = np.zeros(p)
    lengths = np.diag(gram).copy()
    solved, coefficients = solve_scaled(gram, gram[:, p].copy(), lengths, lengths, p - 1)
    if solved:
        theta[: p - 1] = coefficients[: p - 1]
        theta[:n] = reflect_unstable(svf + np.concatenate((np.zeros(1), coefficients[:n])))[1:]
    return solved, theta
