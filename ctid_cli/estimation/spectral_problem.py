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


class SpectralProblem(NamedTuple):
    """Coefficients at a held delay: ``theta = (a_1 … a_n, b_0 … b_m, delay)``.

    ``d eps/d tau = jw B/A U``. The end values of the delayed input, which enter the derivative of its finite spectrum
    as well, are a constant: the transient takes them.
    """

    frequencies: Array
    outputs: ComplexArray
    #: At the delay, as far as the weight reaches, shape (K,).
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
        moments: Equations = _spectral_equations(self, theta)
        return moments

    def admissible(self, theta: Array) -> Array:
        """Reflect unstable denominators."""
        return with_stable_denominator(theta, self.poles)


def spectral_problem(spectra: RecordSpectra, structure: Structure, delay: float, weight: Array) -> SpectralProblem:
    """The coefficients of a record's spectra at a delay, with the weights of a filter."""
    inputs = np.array(spectra.inputs(delay, used_bins(weight)))
    weight = plain_array(weight)
    return SpectralProblem(spectra.frequencies, spectra.outputs, inputs, weight, structure.poles, structure.zeros)


def used_bins(weight: Array) -> int:
    """Number of frequencies, from the lowest, beyond which the weight is negligible."""
    return int(np.flatnonzero(weight >= NEGLIGIBLE_WEIGHT * weight.max())[-1]) + 1


def enough_bins(weight: Array, structure: Structure) -> bool:
    """Whether a filter passes enough frequencies for an estimate."""
    passed = int((weight >= 0.5 * weight.max()).sum())
    return 2 * passed >= EQUATIONS_PER_PARAMETER * (structure.size + structure.poles)


def spectral_least_squares_start(problem: SpectralProblem, delay: float, svf_cutoff: float) -> Array | None:
    """Least-squares estimate with the state-variable filter ``1/(p + w)^n``."""
    n, m = problem.poles, problem.zeros
    filter_denominator = np.asarray(np.poly(np.full(n, -svf_cutoff)), dtype=np.float64)
    # With a zero numerator the "output error" is y itself, and with F for A the regressors are the filtered signals:
    # A Y = B U + T divided by F reads Y = -sum (a_i - f_i) (jw)^(n-i)/F Y + B/F U + T/F.
    gram, _ = _projected_moments(
        problem.frequencies, problem.outputs, problem.inputs, problem.weight, filter_denominator, np.zeros(m + 1)
    )
    regressors = np.arange(n + m + 1)
    regressors[:n] += n + m + 2
    normal = gram[regressors[:, None], regressors]
    lengths = np.diag(normal).copy()
    solved, coefficients = solve_scaled(normal, gram[regressors, -1], lengths, lengths, n + m + 1)
    if not solved:
        return None
    stable = reflect_unstable(np.concatenate(([1.0], filter_denominator[1:] + coefficients[:n])))
    return np.concatenate((stable[1:], coefficients[n:], [delay]))


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
        # A frequency above zero stands for its negative too.
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


@njit(cache=True, nogil=True)
def _spectral_equations(problem: SpectralProblem, theta: Array) -> Equations:
    """Second moments of the iteration, the delay included."""
    n, m = problem.poles, problem.zeros
    p = n + m + 2
    if not np.isfinite(theta).all():
        return inadmissible(p)
    a = np.ones(n + 1)
    a[1:] = theta[:n]
    b = theta[n : p - 1].copy()
    gram, power = _projected_moments(problem.frequencies, problem.outputs, problem.inputs, problem.weight, a, b)
    if not np.isfinite(gram).all():
        return inadmissible(p)
    # The columns of the sensitivities come first; the regressors are the same but for the denominator's n.
    hessian, mixed, gradient = gram[:p, :p].copy(), gram[:p, :p].copy(), gram[:p, -1].copy()
    mixed[:, :n] = gram[:p, p : p + n]
    return Equations(mixed, gradient, hessian, gram[-1, -1], power)


compiled_as(SpectralProblem, _spectral_equations)
