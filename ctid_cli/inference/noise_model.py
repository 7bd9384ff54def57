r"""Autoregressive models of stationary output noise, from residuals on a regular clock: Yule and Walker's, and REML.

Yule and Walker's equations treat residuals as the noise. A fit removes from the residuals the part of the noise that
its sensitivities explain. On a short record of slow noise that is much of the noise's power at low frequency, and the
autocovariances of the residuals are too small. REML maximises the likelihood of the part that does not depend on the
parameters [1]_: with V the covariance matrix of the noise over its innovation variance,

.. math:: \min\; (N - p) \ln s^2 + \ln|V| + \ln|\Psi'V^{-1}\Psi|,\qquad
          s^2 = \min_x (e - \Psi x)' V^{-1} (e - \Psi x) / (N - p).

References
----------
.. [1] H. D. Patterson and R. Thompson, "Recovery of inter-block information when block sizes are unequal",
   *Biometrika* 58 (1971) 545-554. doi:10.1093/biomet/58.3.545
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np

from ctid_cli.arrays import Array

#: Greatest order tried, and number of successive rises of the criterion after which the search stops.
ORDERS, RISES = 8, 3
#: Greatest partial correlation.
INSIDE = 0.9999
#: Fisher scoring ends at a predicted decrease of the criterion below this, or after this number of steps.
PROMISE, STEPS = 1e-10, 60
#: Difference of noise models for derivatives [standard deviations of a parameter].
STEP = 0.01
#: Least curvature of the criterion along a parameter, as a share of the largest.
FLAT = 1e-3
#: Residuals whose unexplained part is below this fraction are rounding errors.
NO_NOISE = 1e-12
#: Least number of samples per order; the order is also at most half of the shortest experiment.
SAMPLES_PER_ORDER = 10
#: Rows of a block: a few dozen columns of them fit into the processor's cache.
ROWS = 4096


class Rows(Protocol):
    """Columns that are computed, or read, in blocks of rows."""

    def __len__(self) -> int:
        """Return the number of rows."""

    def __getitem__(self, rows: slice, /) -> Array:
        """Return a slice of rows, shape (count, columns)."""


def row_blocks(count: int) -> Iterator[slice]:
    """Return slices that cover ``count`` rows."""
    return (slice(first, min(first + ROWS, count)) for first in range(0, count, ROWS))


#: Relative rounding error of the energy of a noise.
ROUNDING = 1e-17


@dataclass(frozen=True, eq=False)
class NoiseModel:
    r"""``v(k) + c_1 v(k-1) + ... + c_r v(k-r) = e(k)``, e white."""

    #: ``(1, c_1 ... c_r)`` [-], shape (order + 1,).
    coefficients: Array
    #: ``R_v(0) ... R_v(r)`` [output unit^2]; they determine the coefficients, and all later autocovariances, shape
    #: (order + 1,).
    first_autocovariances: Array
    #: Variance of e [output unit^2].
    innovation_variance: float
    #: Negative partial correlations at the lags 1 ... r [-], if known, shape (order,).
    partial: Array = field(default_factory=lambda: np.zeros(0))
    #: Degrees of freedom of the innovation variance for given coefficients [-].
    freedom: float = np.inf
    #: Pairs of models displaced by ``-STEP`` and ``STEP`` standard deviations along independent directions of the
    #: uncertain coefficients, with the innovation variances that are then most likely.
    displaced: tuple[tuple["NoiseModel", "NoiseModel"], ...] = field(default=(), repr=False)

    @property
    def order(self) -> int:
        """Order r; 0 is white noise."""
        return int(self.coefficients.size - 1)

    def effective_count(self, count: int) -> float:
        """Return the effective sample size for the mean, at most ``count``."""
        gain = float(self.coefficients.sum()) ** 2
        ratio = gain * float(self.first_autocovariances[0]) / self.innovation_variance if self.order else 1.0
        return count * min(ratio, 1.0)

    def innovations(self, v: Array) -> Array:
        """Return the innovations e of successive samples of v, which is zero before the first one."""
        white: Array = np.convolve(v, self.coefficients)[: v.size]
        return white

    def weights_of(self, columns: Array) -> Array:
        """Return rows g with ``columns' v = sum g(s) e(s)``, for successive samples of v that is zero before them."""
        from ctid_cli.inference.noise_kernels import autoregress  # numba is slow to import

        backwards = np.vstack((np.zeros((self.order, columns.shape[1])), columns[::-1]))
        autoregress(backwards, self.coefficients)
        return backwards[self.order :][::-1]

    def covariance_of(self, columns: Rows) -> Array:
        r"""Return the covariance of the products of successive samples of v with columns.

        R is symmetric in time, so ``columns' R columns = s^2 sum g g'`` with ``g = c(q)^{-1} columns``, over all times,
        including the free response of the recursion after the last row.
        """
        from ctid_cli.inference.noise_kernels import autoregress  # numba is slow to import

        r = self.order
        if not len(columns):
            return np.zeros((0, 0))
        width = columns[:1].shape[1]
        before, total = np.zeros((r, width)), np.zeros((width, width))
        for rows in row_blocks(len(columns)):
            block = np.ascontiguousarray(np.vstack((before, columns[rows])))
            autoregress(block, self.coefficients)
            total += block[r:].T @ block[r:]
            before = block[block.shape[0] - r :]
        if r:
            # Energy of the free response, summed by doubling the step of the recursion.
            step = np.eye(r, k=1)
            step[-1] = -self.coefficients[:0:-1]
            energy = np.outer(step[-1], step[-1])
            # Rounding may put poles of a very slow noise outside the unit circle: the result is then not finite.
            with np.errstate(over="ignore", invalid="ignore"):
                while (more := step.T @ energy @ step).max() > ROUNDING * energy.max():
                    energy, step = energy + more, step @ step
                total += before.T @ energy @ before
        return np.asarray(self.innovation_variance * total)


def fit_noise_model(blocks: Sequence[Array], max_order: int | None = None, penalty: float = 2.0) -> NoiseModel:
    """Return a Yule-Walker model of the noise; the order is chosen by Akaike's criterion or with another penalty.

    The autocovariances are ``sum v(t) v(t - lag) / N``, about a mean of zero, within experiments. An ARMA noise is
    approximated: the order grows with the record.
    """
    count = sum(block.size for block in blocks)
    if max_order is None:
        max_order = min(int(10 * np.log10(max(count, 1))), count // 4)
    lags = range(max_order + 1)
    products = [sum(float(block[k:] @ block[: max(block.size - k, 0)]) for block in blocks) for k in lags]
    covariances = np.array(products) / max(count, 1)
    coefficients, partial = np.ones(1), np.zeros(max_order)
    variance = float(covariances[0])
    best = NoiseModel(coefficients, covariances[:1], variance)
    if variance <= 0:
        return best
    best_criterion = count * np.log(variance)
    for order in range(1, covariances.size):
        # Levinson's recursion
        reflection = partial[order - 1] = -float(coefficients @ covariances[order:0:-1]) / variance
        variance *= 1.0 - reflection**2
        if variance <= 0:
            break
        coefficients = np.append(coefficients, 0.0)
        coefficients = coefficients + reflection * coefficients[::-1]
        criterion = count * np.log(variance) + penalty * order
        if criterion < best_criterion:
            best_criterion = criterion
            best = NoiseModel(coefficients, covariances[: order + 1], variance, partial[:order])
    return best


class _Likelihood(NamedTuple):
    """The criterion at one model, with gradient and information for Fisher scoring, and the innovation variance."""

    criterion: float
    #: Derivatives by the partial correlations, shape (r,), and expected second derivatives, shape (r, r).
    gradient: Array
    information: Array
    variance: float


def levinson(partial: Array) -> tuple[Array, Array, Array]:
    """Return ``(1, c_1 ... c_r)``, their slopes by the partial correlations, and autocovariances over s^2.

    Shapes (r + 1,), (r, r + 1) and (r + 1,).
    """
    r = partial.size
    c, slopes, covariances = np.eye(1, r + 1)[0], np.zeros((r, r + 1)), np.zeros(r + 1)
    covariances[0] = variance = 1.0 / np.prod(1.0 - partial**2)
    for k, value in enumerate(partial):
        # The model of order k predicts the next autocovariance, up to the partial correlation.
        covariances[k + 1] = -value * variance - c[1 : k + 1] @ covariances[k:0:-1]
        variance *= 1.0 - value * value
        # c of order k + 1 is c of order k plus the partial correlation times c reversed; likewise its slopes.
        backwards = c[k + 1 :: -1].copy()
        slopes[:k, : k + 2] += value * slopes[:k, k + 1 :: -1]
        slopes[k, : k + 2] = backwards
        c[: k + 2] += value * backwards
    return c, slopes, covariances


def restricted_likelihood(products: Array, count: int, blocks: int, partial: Array) -> _Likelihood:
    """Return the criterion from products of the columns (Q, e) at pairs of lags, shape (lags, lags, p + 1, p + 1).

    ``v'V^-1 v = sum_ij c_i c_j D_ij`` with ``D_ij = sum_t v(t + i) v(t + j)`` over ``0 <= t < n - i - j``: exact,
    including the first samples (Box and Jenkins, *Time Series Analysis*, appendix A7.4).
    """
    p, r = products.shape[2] - 1, partial.size
    left = count - p
    c, slopes, covariances = levinson(partial)
    products = products[: r + 1, : r + 1]
    # Cholesky's factor of (Q, e)' V^-1 (Q, e): its last diagonal entry is the unexplained part.
    factor = np.linalg.cholesky(np.tensordot(np.outer(c, c), products))
    squared = factor[p, p] ** 2
    # d criterion = sum W d(gram): the last row of the inverse factor has the weights of the residual.
    inverse = np.linalg.inv(factor)
    weight = inverse[:p].T @ inverse[:p] + left * np.outer(inverse[p], inverse[p])
    gradient = slopes @ (2.0 * np.tensordot(products, weight) @ c)
    # |V| = prod (1 - partial_k^2)^-k for each experiment.
    orders, one = np.arange(1, r + 1), 1.0 - partial**2
    criterion = left * np.log(squared / left) + 2.0 * np.log(np.diag(factor)[:p]).sum()
    criterion -= blocks * (orders @ np.log(one))
    gradient += 2.0 * blocks * orders * partial / one
    # Information of the coefficients as in a regression on earlier samples, N R(i - j) / s^2, twice in -2 ln L.
    toeplitz = 2.0 * left * covariances[np.abs(np.subtract.outer(orders, orders))]
    steps = slopes[:, 1:]
    return _Likelihood(float(criterion), gradient, steps @ toeplitz @ steps.T, float(squared / left))


def fit_residual_noise(psi: Sequence[Array], residuals: Sequence[Array], *, aicc: bool = False) -> NoiseModel:
    """Return the REML model of the noise from the residuals of a fit with sensitivities psi of full rank.

    The order has the least BIC, or AICc, among those up to 8, until it has risen three times, and the one that Akaike's
    criterion chooses for the Yule-Walker model, for noise with a long memory. The inverse hyperbolic tangents of the
    partial correlations are nearly normal, with twice the inverse of the second derivatives of the criterion as
    covariance.
    """
    stacked, errors = np.concatenate(psi), np.concatenate(residuals)
    orthonormal = np.linalg.qr(stacked / np.linalg.norm(stacked, axis=0))[0]
    # The part explained by the sensitivities contains no information; away from an optimum it may be most.
    left = errors - orthonormal @ (orthonormal.T @ errors)
    power = float(left @ left)
    if not power > NO_NOISE**2 * float(errors @ errors):
        return fit_noise_model(residuals, max_order=0)
    columns = np.column_stack((orthonormal, left / np.sqrt(power)))
    blocks = np.split(columns, np.cumsum([len(block) for block in psi])[:-1])
    most = min(len(errors) // SAMPLES_PER_ORDER, min(len(block) for block in blocks) // 2)
    guess = fit_noise_model([block[:, -1] for block in blocks]).partial[:most]
    products = _products(blocks, min(most, max(ORDERS, guess.size)))
    (count, size), number = columns.shape, len(blocks)

    def at(partial: Array) -> _Likelihood:
        try:
            likelihood: _Likelihood = restricted_likelihood(products, count, number, partial)
        except np.linalg.LinAlgError:
            # Residuals without noise, which a very slow model would explain completely.
            r = partial.size
            return _Likelihood(np.inf, np.zeros(r), np.eye(r), np.nan)
        return likelihood

    def penalised(partial: Array) -> float:
        k = partial.size + 1
        penalty = 2 * k + 2 * k * (k + 1) / max(count - size - k, 1) if aicc else k * np.log(count)
        return float(at(partial).criterion + penalty)

    best = partial = np.zeros(0)
    least, rises = penalised(best), 0
    for _ in range(min(most, ORDERS)):
        partial = _scored(at, np.append(partial, 0.0))
        value = penalised(partial)
        best, least, rises = (partial, value, 0) if value < least else (best, least, rises + 1)
        if rises == RISES:
            break
    if guess.size > ORDERS and penalised(far := _scored(at, guess)) < least:
        best = far

    def model(partial: Array, displaced: tuple[tuple[NoiseModel, NoiseModel], ...] = ()) -> NoiseModel:
        c, _, covariances = levinson(partial)
        variance = at(partial).variance * power
        return NoiseModel(c, covariances * variance, variance, partial, float(count - size + 1), displaced)

    z = np.arctanh(best)
    return model(best, tuple((model(np.tanh(z - step)), model(np.tanh(z + step))) for step in _steps(at, z)))


def _steps(at: Callable[[Array], _Likelihood], z: Array) -> list[Array]:
    """Return steps of ``STEP`` standard deviations along independent directions of z."""
    if not z.size:
        return []

    def gradient(z: Array) -> Array:
        return np.asarray(at(np.tanh(z)).gradient / np.cosh(z) ** 2)

    small = STEP * np.eye(z.size)
    curvature = np.array([(gradient(z + step) - gradient(z - step)) / (2 * STEP) for step in small])
    if not np.isfinite(curvature).all():
        return []
    values, vectors = np.linalg.eigh(0.5 * (curvature + curvature.T))
    values = np.maximum(values, FLAT * max(values[-1], 1.0))
    return [STEP * np.sqrt(2.0 / value) * vector for value, vector in zip(values, vectors.T, strict=True)]


def _scored(at: Callable[[Array], _Likelihood], start: Array) -> Array:
    """Return partial correlations at a local minimum, by Fisher scoring in their inverse hyperbolic tangents."""
    z = np.arctanh(np.clip(start, -INSIDE, INSIDE))
    here = at(np.tanh(z))
    for _ in range(STEPS):
        slope = 1.0 - np.tanh(z) ** 2
        gradient = slope * here.gradient
        step = -np.linalg.solve(here.information * np.outer(slope, slope), gradient)
        promise = -float(step @ gradient)
        step /= max(1.0, float(np.abs(step).max()))
        while promise > PROMISE:
            moved = np.clip(z + step, -np.arctanh(INSIDE), np.arctanh(INSIDE))
            there = at(np.tanh(moved))
            if there.criterion < here.criterion:
                break
            step, promise = 0.5 * step, 0.5 * promise
        else:
            break
        z, here = moved, there
    return np.asarray(np.tanh(z))


def _products(blocks: Sequence[Array], order: int) -> Array:
    """Return D of all pairs of lags: of a pair with one difference, they differ by products at both ends."""
    size = blocks[0].shape[1]
    products = np.zeros((order + 1, order + 1, size, size))
    for block in blocks:
        for k in range(order + 1):
            n = len(block) - k
            found = block[:n].T @ block[k:]
            for i in range(order + 1 - k):
                products[i, i + k] += found
                found = found - np.outer(block[i], block[i + k]) - np.outer(block[n - 1 - i], block[n + k - 1 - i])
    for i in range(order + 1):
        for j in range(i):
            products[i, j] = products[j, i].T
    return products
