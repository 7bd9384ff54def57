r"""ARMA models of output noise by exact maximum likelihood, their innovations and predictions.

With ``v = C(q)/D(q) e`` in the state space of :class:`~ctid_cli.signals.noise.ArmaNoise`, ``z+ = F z + G e`` and
``v = z_1 + e``, a Kalman filter that starts from the stationary covariance gives the innovations i_t of a record and
their variances ``s^2 f_t``, including the first sample; at missing samples it predicts only. So

.. math:: v'V^{-1}v = \sum_t i_t^2 / f_t, \qquad \ln|V| = \sum_t \ln f_t,

and minimising ``-2 ln L = N ln(v'V^-1 v/N) + ln|V|`` is least squares of ``|V|^(1/2N) i_t / f_t^(1/2)`` [1]_.

References
----------
.. [1] A. C. Harvey and G. D. A. Phillips, "Maximum likelihood estimation of regression models with
   autoregressive-moving average disturbances", *Biometrika* 66 (1979) 49-58. doi:10.1093/biomet/66.1.49
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array, BoolArray, IntArray
from ctid_cli.inference.covariance import Dispersion, undefined
from ctid_cli.inference.noise_model import STEP, levinson
from ctid_cli.signals.noise import ArmaNoise

#: Numbers of coefficients of D and of C.
Orders = tuple[int, int]
#: Greatest orders for the choice by BIC, and greatest orders that can be given.
MOST_CHOSEN, MOST_GIVEN = 3, 8
#: Greatest inverse hyperbolic tangent of a partial correlation, which is then 1 - 1.7e-6.
FARTHEST = 7.0
#: The same for the restricted likelihood, of which differences are taken: the correlation is then 1 - 1.2e-5.
RESTRICTED = 6.0
#: Lags per coefficient of the long autoregression of Hannan and Rissanen's method, and least number of samples per lag.
LONG_LAGS, SAMPLES_PER_LAG = 10, 10
#: Relative decrease of the scaled squares at which a fit ends, final and in comparisons of orders; most evaluations.
EXACT, ROUGH, EVALUATIONS = 1e-12, 1e-6, 40
#: Step of central differences by the transformed partial correlations.
DIFFERENCE = 1e-5
#: Step of second differences by them.
SECOND_DIFFERENCE = 1e-2


class Whitener:
    """State of the innovations filter of one record, for any number of rows."""

    def __init__(self, noise: ArmaNoise, rows: int) -> None:
        self.transition, self.gain, _ = noise.state_space
        self.states, self.covariance = np.zeros((self.gain.size, rows)), noise.state_covariance.copy()
        #: ``ln|V|`` of the samples so far, for innovations of variance one.
        self.logarithm = 0.0

    def __call__(self, rows: Array, steps: IntArray, after: Array | None = None) -> Array:
        """Whiten further samples of all rows in place, shape (rows, count)."""
        from ctid_cli.inference.noise_kernels import filter_innovations  # numba is slow to import

        after = np.zeros((0, self.gain.size)) if after is None else after
        own = -self.transition[:, 0] if self.gain.size else self.gain, self.gain, self.states, self.covariance
        self.logarithm += filter_innovations(rows, steps, *own, after)
        return rows


@dataclass(frozen=True, eq=False)
class SampledNoise:
    """Noise of one record at its used samples."""

    noise: ArmaNoise
    #: Intervals of the clock from each used sample to the next; 0 at the first one, shape (count,).
    steps: IntArray

    def whitened(self, columns: Array) -> Array:
        """Return the innovations over their standard deviations of a signal or of columns."""
        rows = np.array(np.atleast_2d(columns.T), dtype=float, order="C")
        return np.asarray(Whitener(self.noise, len(rows))(rows, self.steps).T.reshape(columns.shape))

    def predicted(self, errors: Array, ahead: int) -> Array:
        """Return the prediction of the noise from samples at least ``ahead`` intervals old; zero without any."""
        states = np.zeros((errors.size, self.steps.size and Whitener(self.noise, 1).gain.size))
        whitener, places = Whitener(self.noise, 1), np.cumsum(self.steps)
        whitener(errors[None].copy(), self.steps, states)
        last = np.searchsorted(places, places - ahead, side="right") - 1
        found = np.zeros(errors.size)
        for later in np.unique((places - places[last])[last >= 0]).tolist() if states.size else ():
            of = (last >= 0) & (places - places[last] == later)
            found[of] = states[last[of]] @ np.linalg.matrix_power(whitener.transition, later - 1)[0]
        return found


def steps_of(used: BoolArray) -> IntArray:
    """Return the intervals of a regular clock from each used sample to the next, 0 at the first one."""
    places = np.flatnonzero(used)
    return np.diff(places, prepend=places[:1])


def sampled(noise: ArmaNoise, used: Sequence[BoolArray]) -> tuple[SampledNoise, ...]:
    """Return the noise at the used samples of records with regular clocks."""
    return tuple(SampledNoise(noise, steps_of(use)) for use in used)


class NoiseFit(NamedTuple):
    """ARMA noise of the greatest likelihood."""

    noise: ArmaNoise
    #: ``-2 ln L`` up to a constant.
    deviance: float
    samples: int

    @property
    def orders(self) -> Orders:
        """Numbers of coefficients of D and C."""
        return len(self.noise.denominator) - 1, len(self.noise.numerator) - 1

    @property
    def bic(self) -> float:
        """Schwarz's criterion, counting the coefficients of the noise only."""
        return self.deviance + sum(self.orders) * float(np.log(self.samples))


class _Likelihood:
    """Likelihood as least squares, as a function of the transformed partial correlations z of D and C."""

    def __init__(self, errors: Sequence[Array], steps: Sequence[IntArray], orders: Orders) -> None:
        self.errors, self.steps, self.orders = errors, steps, orders
        self.count = sum(e.size for e in errors)

    def noise(self, z: Array, variance: float = 1.0) -> ArmaNoise:
        """Return the model with an innovation variance."""
        d, c = (levinson(part)[0].tolist() for part in np.split(np.tanh(z), [self.orders[0]]))
        return ArmaNoise(tuple(c), tuple(d), innovation_variance=variance)

    def innovations(self, z: Array) -> tuple[Array, float]:
        """Return the innovations over their standard deviations, and ``ln|V|``."""
        noise, parts, logarithm = self.noise(z), [], 0.0
        for e, steps in zip(self.errors, self.steps, strict=True):
            whitener = Whitener(noise, 1)
            parts.append(whitener(e[None].copy(), steps)[0])
            logarithm += whitener.logarithm
        return np.concatenate(parts), logarithm

    def scaled(self, z: Array) -> Array:
        """Return the standardised innovations times ``|V|^(1/2N)``."""
        white, logarithm = self.innovations(z)
        return np.asarray(white * np.exp(logarithm / (2 * self.count)))

    def found(self, z: Array, tolerance: float) -> NoiseFit:
        """Return the local minimum from a start."""
        if z.size:
            from scipy.optimize import least_squares  # slow to import

            start, bounds = np.clip(z, -0.99 * FARTHEST, 0.99 * FARTHEST), (-FARTHEST, FARTHEST)
            limits = {"ftol": tolerance, "xtol": 1e-8, "gtol": 1e-12, "max_nfev": EVALUATIONS}
            z = least_squares(self.scaled, start, bounds=bounds, x_scale="jac", **limits).x
        white, logarithm = self.innovations(z)
        variance = float(white @ white) / self.count
        return NoiseFit(self.noise(z, variance), self.count * float(np.log(variance)) + logarithm, self.count)


def fit_arma(
    errors: Sequence[Array], steps: Sequence[IntArray], orders: Orders, *near: NoiseFit, tolerance: float = EXACT
) -> NoiseFit:
    """Return the maximum-likelihood ARMA noise of given orders, started from Hannan-Rissanen and from near models."""
    starts = [_transformed(*_padded(fit.noise, orders)) for fit in near]
    if not any(fit.orders == orders for fit in near):
        starts.append(_transformed(*_hannan_rissanen(errors, orders)))
    likelihood = _Likelihood(errors, steps, orders)
    return min((likelihood.found(start, tolerance) for start in starts), key=lambda fit: fit.deviance)


def restricted_dispersion(
    noise: ArmaNoise, psi: Sequence[Array], errors: Sequence[Array], steps: Sequence[IntArray]
) -> Dispersion:
    r"""Return the covariance of an estimate by generalised least squares, for the noise of the restricted likelihood.

    The maximum-likelihood noise is that of errors from which the estimate has taken a part, mostly at low frequencies.
    With the whitened sensitivities, in the notation of the module,

    .. math:: \min\; (N - p) \ln s^2 + \ln|V| + \ln|\Psi'V^{-1}\Psi|, \qquad C = s^2 (\Psi'V^{-1}\Psi)^{-1},

    and the uncertainty of C follows from the second derivatives of this criterion.
    """
    from scipy.optimize import minimize  # slow to import

    orders = len(noise.denominator) - 1, len(noise.numerator) - 1
    likelihood, size = _Likelihood(errors, steps, orders), psi[0].shape[1]
    spare, lengths = likelihood.count - size, np.linalg.norm(np.concatenate(psi), axis=0)
    if not (size and spare > 0 and (lengths > 0.0).all()):
        return undefined(size)
    scale = 1.0 / lengths
    rows = [np.vstack(((block * scale).T, e)) for block, e in zip(psi, errors, strict=True)]

    def at(z: Array) -> tuple[float, Array]:
        """Return the criterion, and the triangle of sensitivities and errors."""
        whitened, logarithm, model = [], 0.0, likelihood.noise(z)
        for block, own in zip(rows, steps, strict=True):
            whitener = Whitener(model, size + 1)
            whitened.append(whitener(block.copy(), own).T)
            logarithm += whitener.logarithm
        triangle = np.asarray(np.linalg.qr(np.concatenate(whitened), mode="r"))
        lengths = np.maximum(np.abs(np.diag(triangle)), np.finfo(float).tiny)
        return float(logarithm + 2.0 * np.log(lengths[:size]).sum() + 2.0 * spare * np.log(lengths[size])), triangle

    def covariance(z: Array) -> Array:
        triangle = at(z)[1]
        inverse = np.linalg.inv(triangle[:size, :size])
        return np.asarray(inverse @ inverse.T * triangle[size, size] ** 2 / spare * np.outer(scale, scale))

    start = np.clip(_transformed(np.array(noise.denominator), np.array(noise.numerator)), -RESTRICTED, RESTRICTED)
    limits = [(-RESTRICTED, RESTRICTED)] * start.size
    z = minimize(lambda z: at(z)[0], start, bounds=limits, method="L-BFGS-B").x if limits else start
    middle = covariance(z)
    values, vectors = np.linalg.eigh(_curvature(lambda z: at(z)[0], z))
    along = []
    for value, vector in zip(values, vectors.T, strict=True):
        step = STEP * vector / np.sqrt(0.5 * max(value, 1.0))
        along.append((covariance(z + step) - covariance(z - step)) / (2.0 * STEP))
    return Dispersion(middle, np.array([middle * np.sqrt(2.0 / spare), *along]))


def _curvature(function: Callable[[Array], float], x: Array) -> Array:
    """Return second derivatives by differences."""
    steps, here = SECOND_DIFFERENCE * np.eye(x.size), function(x)
    ends = [[function(x + sign * step) for step in steps] for sign in (1.0, -1.0)]
    found = np.zeros((x.size, x.size))
    for i, one in enumerate(steps):
        found[i, i] = ends[0][i] + ends[1][i] - 2.0 * here
        for j, other in enumerate(steps[:i]):
            both = function(x + one + other) + function(x - one - other)
            found[i, j] = found[j, i] = 0.5 * (both - ends[0][i] - ends[1][i] - ends[0][j] - ends[1][j] + 2.0 * here)
    return found / SECOND_DIFFERENCE**2


def all_arma(
    errors: Sequence[Array], steps: Sequence[IntArray], near: Mapping[Orders, NoiseFit]
) -> dict[Orders, NoiseFit]:
    """Return ARMA noises up to (3, 3), each started from a near model, or from models of lower order."""
    fits: dict[Orders, NoiseFit] = {}
    for p, q in sorted(product(range(MOST_CHOSEN + 1), repeat=2), key=sum):
        inner = [near[p, q]] if near else [fits[each] for each in ((p - 1, q), (p, q - 1)) if each in fits]
        fits[p, q] = fit_arma(errors, steps, (p, q), *inner, tolerance=ROUGH)
    return fits


def coefficient_slopes(noise: ArmaNoise, errors: Sequence[Array], steps: Sequence[IntArray]) -> Array:
    """Return derivatives of the scaled innovations by ``d_1 ... d_P, c_1 ... c_Q``, shape (N, P + Q)."""
    orders = len(noise.denominator) - 1, len(noise.numerator) - 1
    if not sum(orders):
        return np.zeros((sum(e.size for e in errors), 0))
    likelihood = _Likelihood(errors, steps, orders)
    z = _transformed(np.array(noise.denominator), np.array(noise.numerator))
    each = DIFFERENCE * np.eye(z.size)
    by_z = [(likelihood.scaled(z + h) - likelihood.scaled(z - h)) / (2 * DIFFERENCE) for h in each]
    partial, p, slopes = np.tanh(z), orders[0], np.zeros((z.size, z.size))
    slopes[:p, :p], slopes[p:, p:] = (levinson(part)[1][:, 1:] for part in np.split(partial, [p]))
    return np.column_stack(by_z) @ np.linalg.inv(slopes * (1.0 - partial**2)[:, None]).T


def _padded(noise: ArmaNoise, orders: Orders) -> tuple[Array, Array]:
    """Return D and C padded with zeros."""
    d, c = np.array(noise.denominator), np.array(noise.numerator)
    return np.pad(d, (0, orders[0] + 1 - d.size)), np.pad(c, (0, orders[1] + 1 - c.size))


def _transformed(*polynomials: Array) -> Array:
    """Return inverse hyperbolic tangents of the partial correlations, with unstable roots reflected."""
    found = []
    for polynomial in polynomials:
        roots = np.roots(polynomial)
        outside = np.abs(roots) > 1.0
        roots[outside] = 1.0 / roots[outside].conj()
        c = np.pad(np.atleast_1d(np.poly(roots)).real, (0, polynomial.size - 1 - roots.size))
        partial = np.zeros(c.size - 1)
        for k in range(partial.size, 0, -1):
            # Levinson's recursion backwards.
            value = partial[k - 1] = np.clip(c[k], -np.tanh(FARTHEST), np.tanh(FARTHEST))
            c = (c[:k] - value * c[k:0:-1]) / (1.0 - value**2)
        found.append(np.arctanh(partial))
    return np.concatenate(found)


def _hannan_rissanen(errors: Sequence[Array], orders: Orders) -> tuple[Array, Array]:
    """Return D and C by regression on past noise and past residuals of a long autoregression, ignoring gaps."""
    (p, q), count = orders, sum(e.size for e in errors)
    lags = max(min(LONG_LAGS * (p + q), count // SAMPLES_PER_LAG), p, q)
    blocks = [_lagged(e, lags) for e in errors]
    past = np.concatenate([block[lags:] for block in blocks])
    long = np.linalg.lstsq(past[:, 1:], past[:, 0])[0]
    whites = [_lagged(block[:, 0] - block[:, 1:] @ long, q)[:, 1:] for block in blocks]
    rows = [np.column_stack((-block[:, 1 : p + 1], white)) for block, white in zip(blocks, whites, strict=True)]
    now = np.concatenate([e[lags + q :] for e in errors])
    found = np.linalg.lstsq(np.concatenate([each[lags + q :] for each in rows]), now)[0]
    return np.concatenate(([1.0], found[:p])), np.concatenate(([1.0], found[p:]))


def _lagged(e: Array, lags: int) -> Array:
    """Return a signal and its lagged values, zero before the first sample, shape (N, lags + 1)."""
    return np.column_stack(
        [np.concatenate((np.zeros(min(k, e.size)), e[: max(e.size - k, 0)])) for k in range(lags + 1)]
    )
