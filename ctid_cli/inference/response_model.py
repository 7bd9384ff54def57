r"""Nonparametric response of an output to its input: a Gaussian process with slow terms and coloured noise.

.. math:: y(t) = \int_0^S g(s)\, (u(t - s) - u_b)\, ds + X(t) \beta + v(t)

The impulse response g is constant over each of some hundred intervals, and a priori a Gaussian process that decays,
with one of two covariances [1]_, :math:`\theta = e^{-s/T}`, :math:`m = \min(\theta, \theta')`:

- rough ("tuned and correlated"): :math:`\lambda m`;
- smooth ("stable spline"): :math:`\lambda (3 \theta \theta' m - m^3) / 2`.

X contains the slow terms: a constant, a straight line, decaying free responses; and the integral of u if the system
integrates. T, scale, covariance, the input before the record (its first value or zero) and whether the system
integrates are chosen by BIC; v is autoregressive noise by REML, given all of these.

References
----------
.. [1] G. Pillonetto, F. Dinuzzo, T. Chen, G. De Nicolao and L. Ljung, "Kernel methods in system identification,
   machine learning and function estimation: A survey", *Automatica* 50 (2014) 657-682.
   doi:10.1016/j.automatica.2014.01.001
"""

import itertools
import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.inference.noise_model import NoiseModel, fit_residual_noise
from ctid_cli.signals.held import HeldSignal

#: Length of the impulse response [decay times]; its prior deviation is then e^-4 of the first.
LENGTH = 8.0
#: Time constants of free responses [decay times of the impulse response].
FREE = (0.7, 2.0, 6.0)
#: The longest of them [duration of the record]: longer ones cannot be distinguished from a straight line.
LONGEST_FREE = 1 / 6
#: Relative increase of the diagonal of a covariance before its factorisation.
JITTER = 1e-10

#: Columns of X.
CONSTANT, LINE, INTEGRAL, FIRST_FREE = range(4)
START = tuple(range(FIRST_FREE, FIRST_FREE + len(FREE)))


class Signals(NamedTuple):
    """Samples of an output, possibly a subset, the input, and the sampling interval."""

    t: Array
    y: Array
    input: HeldSignal
    interval: float


class Pulse(NamedTuple):
    """Integral of an input about its value before the record."""

    t: Array
    values: Array
    slopes: Array
    sums: Array

    @classmethod
    def of(cls, signal: HeldSignal, before: float) -> "Pulse":
        """Integrate a held or piecewise linear signal exactly."""
        w, steps, slopes = signal.values - before, np.diff(signal.t), np.zeros(signal.t.size)
        if signal.hold != "zoh":
            slopes[:-1] = np.diff(w) / steps
        areas = steps * (w[:-1] + 0.5 * slopes[:-1] * steps)
        return cls(signal.t, w, slopes, np.append(0.0, np.cumsum(areas)))

    def at(self, times: Array) -> Array:
        """Return the integral up to given instants; zero before the record."""
        k = np.maximum(np.searchsorted(self.t, times, side="right") - 1, 0)
        since = np.maximum(times - self.t[k], 0.0)
        return np.asarray(self.sums[k] + since * (self.values[k] + 0.5 * self.slopes[k] * since))


class Layout(NamedTuple):
    """Columns for one decay time and one value of the input before the record."""

    before: float
    decay: float
    #: Ends of the intervals of the impulse response [s], shape (K + 1,).
    edges: Array
    #: Responses to the input over each interval, X and the output, shape (N, K + q + 1).
    columns: Array

    @classmethod
    def of(cls, signals: Signals, before: float, decay: float, taps: int) -> "Layout":
        """Lay signals out; ``taps`` is the greatest number of intervals."""
        t, y, signal, interval = signals
        duration = float(t[-1] - t[0])
        since, pulse = t - t[0], Pulse.of(signal, before)
        edges = _edges(min(LENGTH * decay, duration), interval, taps)
        responses = -np.diff(pulse.at(t[:, None] - edges), axis=1)
        free = [np.exp(-since / min(factor * decay, LONGEST_FREE * duration)) for factor in FREE]
        columns = np.column_stack([responses, np.ones(t.size), since / duration, pulse.at(t), *free, y])
        return cls(before, decay, edges, columns)

    @property
    def taps(self) -> int:
        """Number of intervals."""
        return int(self.edges.size - 1)


def _edges(length: float, interval: float, taps: int) -> Array:
    """Return the ends of the intervals of an impulse response: sampling intervals at first, then equal longer ones."""
    if length <= taps * interval:
        return np.asarray(interval * np.arange(max(round(length / interval), 4) + 1.0))
    first = interval * np.arange(taps // 3 + 1.0)
    return np.append(first, np.linspace(first[-1], length, taps - taps // 3 + 1)[1:])


def prior_factor(layout: Layout, smooth: bool) -> Array:
    """Return the Cholesky factor of the prior covariance of an impulse response, of scale 1."""
    theta = np.exp(-0.5 * (layout.edges[1:] + layout.edges[:-1]) / layout.decay)
    least = np.minimum(theta[:, None], theta)
    covariance = 0.5 * (3 * np.outer(theta, theta) * least - least**3) if smooth else least
    covariance[np.diag_indices_from(covariance)] *= 1 + JITTER
    return np.linalg.cholesky(covariance)


# --- the model --------------------------------------------------------------------------------------------------------

#: Number of intervals of the impulse response while decay and noise are searched, and afterwards; the first third of
#: them are one sampling interval long.
COARSE, FINE = 60, 120
#: Decay times tried: the first [sampling intervals], the last [duration of the record], largest ratio of neighbours.
FASTEST, SLOWEST, RATIO = 1.5, 1 / 4, 2.2
#: Scales tried, as ratios of the greatest variance of the response in one direction to that of the noise.
SCALES = np.geomspace(1e-3, 1e9, 37)
#: Poles of the AR(1) noise at the start of the search.
NOISE_POLES = (0.0, 0.5, 0.8, 0.95)
#: Relative rounding error of products and factors.
ROUNDING = 1e-11
#: An input with less power than this is constant.
LEAST = 1e-200

#: Sets of slow terms compared in the search.
SLOW = ((), (CONSTANT,), (LINE,), (CONSTANT, LINE), (CONSTANT, *START), (CONSTANT, LINE, *START))


class Prior(NamedTuple):
    """Prior of the impulse response."""

    #: Time after which its variance has decayed by the factor e [s].
    decay: float
    smooth: bool
    #: Its first variance over that of the innovations.
    scale: float


class Weighted(NamedTuple):
    """Products of the columns of X and of the output (last), weighted by the inverse of their covariance."""

    #: Scales of the prior, shape (scales,).
    scales: Array
    #: At each scale of the prior, shape (scales, q + 1, q + 1).
    products: Array
    #: Logarithm of the determinant of that covariance over that of the noise, shape (scales,).
    log_determinants: Array

    def fit(self, columns: Sequence[int]) -> tuple[Array, Array, float]:
        """Return coefficients of columns of X, their covariance over the variance, and the residual sum of squares."""
        k, products = list(columns), self.products[0]
        sizes = np.sqrt(np.maximum(products.diagonal()[k], np.finfo(float).tiny))
        scaled = products[np.ix_(k, k)] / np.outer(sizes, sizes)
        inverse = np.linalg.pinv(scaled, rcond=ROUNDING, hermitian=True) / np.outer(sizes, sizes)
        coefficients = inverse @ products[k, -1]
        return coefficients, inverse, float(products[-1, -1] - products[k, -1] @ coefficients)

    def criteria(self, columns: Sequence[int], count: int) -> Array:
        """Return BIC with columns of X at each scale, up to a constant and the noise term."""
        k = list(columns)
        right, left = self.products[:, k, -1], self.products[:, -1, -1]
        if k:
            normal = self.products[:, k][:, :, k]
            normal = normal + np.eye(len(k)) * (ROUNDING * np.einsum("lii->li", normal)[:, None] + LEAST)
            left = left - np.einsum("li,li->l", right, np.linalg.solve(normal, right[..., None])[..., 0])
        left = np.maximum(left, np.finfo(float).tiny)
        return np.asarray(count * np.log(left / count) + self.log_determinants + len(k) * np.log(count))


class Directions(NamedTuple):
    r"""Directions :math:`\Phi L = U S V'` of the response, from whitened columns and a factor L of the prior."""

    #: S^2, rising, and V, shapes (K,) and (K, K).
    squares: Array
    right: Array
    #: Products of the columns with S U, and with one another, shapes (K, q + 1) and (q + 1, q + 1).
    along: Array
    products: Array

    @classmethod
    def of(cls, gram: Array, factor: Array) -> "Directions":
        """Find the directions from the products of all columns."""
        taps = len(factor)
        squares, right = np.linalg.eigh(factor.T @ gram[:taps, :taps] @ factor)
        along = right.T @ (factor.T @ gram[:taps, taps:])
        return cls(np.maximum(squares, 0.0), right, along, gram[taps:, taps:])

    def weighted(self, scales: Array) -> Weighted:
        """Weight the products at each scale l: the share l s^2 / (1 + l s^2) of each direction is subtracted."""
        lost = scales[:, None] / (1 + scales[:, None] * self.squares)
        taken = np.einsum("lk,ki,kj->lij", lost, self.along, self.along, optimize=True)
        return Weighted(scales, self.products - taken, np.log1p(scales[:, None] * self.squares).sum(axis=1))

    def searched(self) -> Weighted:
        """Weight the products at all scales tried."""
        return self.weighted(SCALES / max(float(self.squares[-1]), LEAST))


@dataclass(frozen=True, eq=False)
class ResponseModel:
    """An impulse response with its uncertainty, slow terms, and noise."""

    layout: Layout
    prior: Prior
    noise: NoiseModel
    integrates: bool

    @property
    def own(self) -> tuple[int, ...]:
        """Columns of X that are part of the response."""
        return (INTEGRAL,) if self.integrates else ()

    @cached_property
    def gram(self) -> Array:
        """Products of the whitened columns."""
        white = whitened(self.layout.columns, self.noise)
        return np.asarray(white.T @ white)

    @cached_property
    def factor(self) -> Array:
        """Factor of the prior covariance of the taps over the variance of the innovations."""
        return np.asarray(np.sqrt(self.prior.scale) * prior_factor(self.layout, self.prior.smooth))

    @cached_property
    def directions(self) -> Directions:
        """Directions of the response."""
        return Directions.of(self.gram, self.factor)

    @cached_property
    def weighted(self) -> Weighted:
        """Weighted products of X and the output."""
        return self.directions.weighted(np.ones(1))

    def taps(self, columns: Sequence[int]) -> tuple[Array, Array]:
        """Return the impulse response given columns of X, and its covariance over the variance of the innovations."""
        found, k = self.directions, list(columns)
        beta, uncertain, _ = self.weighted.fit(k)
        gain = self.factor @ found.right / (1 + found.squares)
        moved = gain @ found.along[:, k]
        # The impulse response of an integrating system has a constant part in addition to the decaying one.
        moved -= np.array(k) == INTEGRAL
        mean = gain @ found.along[:, -1] - moved @ beta
        return mean, gain @ (self.factor @ found.right).T + moved @ uncertain @ moved.T

    def parts(self, columns: Sequence[int]) -> tuple[Array, Array]:
        """Return the response to the input, and the residuals of response and columns of X."""
        taps, signals = self.layout.taps, self.layout.columns
        values = dict(zip(columns, self.weighted.fit(columns)[0], strict=True))
        response = signals[:, :taps] @ self.taps(columns)[0]
        if INTEGRAL in values:
            beyond = signals[:, taps + INTEGRAL] - signals[:, :taps].sum(axis=1)
            response += values.pop(INTEGRAL) * beyond
        slow = signals[:, [taps + column for column in values]] @ np.array(list(values.values()))
        return response, signals[:, -1] - response - slow


def ar1(pole: float) -> NoiseModel:
    """Return AR(1) noise of innovation variance 1."""
    return NoiseModel(np.array([1.0, -pole]), np.array([1.0, pole]) / (1 - pole**2), 1.0)


def first_factor(noise: NoiseModel) -> Array:
    """Return the Cholesky factor of the covariance of the first r samples of a noise over its innovation variance."""
    lags = np.abs(np.subtract.outer(np.arange(noise.order), np.arange(noise.order)))
    return np.asarray(np.linalg.cholesky(noise.first_autocovariances[lags] / noise.innovation_variance))


def whitened(columns: Array, noise: NoiseModel) -> Array:
    """Return prewhitened columns, exact from the first row on."""
    white, r = columns.copy(), noise.order
    for k in range(1, r + 1):
        white[r:] += noise.coefficients[k] * columns[r - k : len(columns) - k]
    if r:
        white[:r] = np.linalg.solve(first_factor(noise), columns[:r])
    return white


def fit_response(signals: Signals, befores: Collection[float]) -> ResponseModel:
    """Fit the response of an output to a varying input, which had one of some values before the record."""
    shortest = FASTEST * signals.interval
    longest = max(SLOWEST * float(np.ptp(signals.t)), 2 * shortest)
    decays = np.geomspace(shortest, longest, math.ceil(math.log(longest / shortest, RATIO)) + 1)
    coarse = (Layout.of(signals, *pair, COARSE) for pair in itertools.product(sorted(befores), decays))
    model = _likeliest(coarse, [ar1(pole) for pole in NOISE_POLES], (False, True))
    near = np.clip(model.prior.decay * RATIO ** np.array([-0.5, 0.0, 0.5]), shortest, longest)
    fine = [Layout.of(signals, model.layout.before, float(decay), FINE) for decay in near]
    for _ in range(2):
        model = _likeliest(fine, [residual_noise(model)], (model.integrates,))
    return ResponseModel(model.layout, model.prior, residual_noise(model), model.integrates)


def _likeliest(layouts: Iterable[Layout], noises: Sequence[NoiseModel], integrating: Sequence[bool]) -> ResponseModel:
    """Return the model of the least BIC over all sets of slow terms."""
    least, best = np.inf, None
    for layout, noise in itertools.product(layouts, noises):
        white = whitened(layout.columns, noise)
        gram, count = white.T @ white, len(white)
        determinant = 2 * float(np.log(first_factor(noise).diagonal()).sum())
        for smooth in (False, True):
            directions = Directions.of(gram, prior_factor(layout, smooth))
            weighted = directions.searched()
            for slow, integrates in itertools.product(SLOW, integrating):
                if integrates and LINE in slow:
                    # A slow response to an input with nonzero mean may resemble both of them.
                    continue
                values = determinant + weighted.criteria((*slow, INTEGRAL) if integrates else slow, count)
                k = int(np.argmin(values))
                if values[k] < least:
                    least, prior = float(values[k]), Prior(layout.decay, smooth, float(weighted.scales[k]))
                    best = ResponseModel(layout, prior, noise, integrates)
    assert best is not None
    return best


def residual_noise(model: ResponseModel) -> NoiseModel:
    """Return the REML noise, given X and the directions of the response that the data determine by more than half."""
    fixed = (CONSTANT, LINE, *START, *model.own)
    taps, columns, found = model.layout.taps, model.layout.columns, model.directions
    determined = columns[:, :taps] @ (model.factor @ found.right[:, found.squares > 1.0])
    psi = np.column_stack([determined, columns[:, [taps + k for k in fixed]]])
    basis, singular, _ = np.linalg.svd(psi / np.linalg.norm(psi, axis=0), full_matrices=False)
    return fit_residual_noise([basis[:, singular > 1e-9 * singular[0]]], [model.parts(fixed)[1]], aicc=True)
