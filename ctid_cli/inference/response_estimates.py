"""Signal-to-noise ratio, response time and delay from a nonparametric response, with 95 % intervals."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.inference.noise_model import NoiseModel
from ctid_cli.inference.response_model import INTEGRAL, Directions, ResponseModel, prior_factor

#: Tails of the intervals [-].
TAILS = (0.025, 0.975)
#: Number of drawn impulse responses, and their fixed seed, for reproducible results.
DRAWS, SEED = 400, 20140801
#: Share of the final value that defines the response time: delay plus time constant of a first-order system.
SHARE = 1 - math.exp(-1)
#: Intervals of the response time are extended by this share of the sampling interval on each side, because the response
#: between samples is unknown. Coverage in simulated records: 90 % of 200 without it, 94 % of 400 with it.
BETWEEN = 0.25
#: Number of standard deviations of a significant response.
SIGNIFICANT = 5.0
#: A response has settled if it changes by less than this share over the last quarter of its length.
SETTLED = 0.1
#: Powers of ``1 - exp(-s/T)`` at the onset of a response, and number of delays compared.
STARTS, DELAYS = (0, 1, 2, 3), 12
#: A delay is not determined if the response becomes significant only after this share of its length.
LATEST = 0.9
#: Weight of the log-likelihood of a delay, because these onsets are approximate: coverage in 97 simulated records of
#: one to four poles was 91 % with weight 1 and 97 % with 1/2.
WEIGHT = 0.5
#: Factor of the effective sample size of the noise, because its model is chosen from the same record: coverage in some
#: hundred simulated records was 88 to 93 % with factor 1, and 95 % of 400 with 0.75.
SPARE = 0.75
#: Number of frequencies for the spectrum of a noise.
FREQUENCIES = 1 << 14


class Estimate(NamedTuple):
    """A value with its 95 % interval; NaN if the record does not determine it."""

    value: float = math.nan
    low: float = math.nan
    high: float = math.nan


UNKNOWN = Estimate()


def signal_to_noise(model: ResponseModel, slow: Sequence[int]) -> Estimate:
    """Return the variance of the response to the input over that of the noise [dB], given slow columns of X.

    Both are about their means over the record.
    """
    from scipy.special import chdtri

    columns, variance = model.layout.columns[:, : model.layout.taps], model.noise.innovation_variance
    response = model.parts(slow)[0]
    response = response - response.mean()
    products = columns.T @ columns - len(columns) * np.outer(columns.mean(axis=0), columns.mean(axis=0))
    covariance = model.taps(slow)[1] * variance
    power = (float(response @ response) + float(np.sum(products * covariance))) / len(columns)
    if not power > 0:
        return UNKNOWN
    along = columns.T @ response
    error = 2 * math.sqrt(float(along @ covariance @ along)) / len(columns) / power
    # Effective sample size for the variance of coloured noise.
    fitted = float(np.sum(model.directions.squares > 1))
    effective = max(2.0, len(columns) / squared_correlations(model.noise) - fitted)
    effective = SPARE * 2 / (2 / effective + error**2)
    ratio = power / variance_about_mean(model.noise, len(columns))
    low, high = (ratio * chdtri(effective, tail) / effective for tail in reversed(TAILS))
    return Estimate(*(10 * math.log10(each) for each in (ratio, low, high)))


def variance_about_mean(noise: NoiseModel, count: int) -> float:
    """Return the expected variance of ``count`` successive samples of a noise about their mean.

    For noise that is slow compared with the record it is much smaller than the stationary variance.
    """
    of_mean = float(noise.covariance_of(np.full((count, 1), 1 / count))[0, 0])
    variance = float(noise.first_autocovariances[0])
    # Positive in spite of rounding if the samples hardly differ.
    return max(variance - of_mean, float(np.finfo(float).eps) * variance)


def squared_correlations(noise: NoiseModel) -> float:
    """Return the sum over all lags of the squared autocorrelation of a noise."""
    power = 1 / np.abs(np.fft.fft(noise.coefficients, FREQUENCIES)) ** 2
    return float(np.mean(power**2) / np.mean(power) ** 2)


def step_responses(model: ResponseModel, slow: Sequence[int]) -> Array:
    """Return the response to a unit step at the edges, and draws of it, shape (1 + DRAWS, K + 1)."""
    mean, covariance = model.taps(slow)
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0) * model.noise.innovation_variance)
    draws = mean + np.random.default_rng(SEED).standard_normal((DRAWS, mean.size)) @ root.T
    areas = np.vstack([mean, draws]) * np.diff(model.layout.edges)
    return np.column_stack([np.zeros(len(areas)), np.cumsum(areas, axis=1)])


def response_time(model: ResponseModel, steps: Array) -> Estimate:
    """Return the time after a step until 63 % of the final value, delay included.

    Unknown if the system integrates, or the response has not settled.
    """
    final = steps[:, -1]
    moving = abs(steps[0, -1 - steps.shape[1] // 4] - final[0]) > SETTLED * abs(final[0])
    if model.integrates or moving or abs(final[0]) < SIGNIFICANT * final[1:].std():
        return UNKNOWN
    rows, edges, shares = np.arange(len(steps)), model.layout.edges, steps / final[:, None]
    k = np.argmax(shares >= SHARE, axis=1)
    before, after = shares[rows, k - 1], shares[rows, k]
    times = edges[k - 1] + (SHARE - before) / (after - before) * (edges[k] - edges[k - 1])
    low, high = np.quantile(times[1:], TAILS) + np.array([-BETWEEN, BETWEEN]) * edges[1]
    return Estimate(float(times[0]), float(low), float(high))


def delay(model: ResponseModel, slow: Sequence[int], steps: Array) -> Estimate:
    """Return the delay of the response, on the grid of the impulse response.

    From its posterior for responses with a constant, linear, quadratic or cubic onset.
    """
    edges, taps = model.layout.edges, model.layout.taps
    significant = np.abs(steps[0]) > SIGNIFICANT * steps[1:].std(axis=0)
    last = max(int(np.argmax(significant[1:])) + 1, min(DELAYS, taps // 3))
    # At the end of the impulse response the onset cannot be told from what follows.
    if not significant[1:].any() or last > LATEST * taps:
        return UNKNOWN
    first = 0
    # The second time between the neighbours of the interval.
    for _ in range(2):
        tried = np.unique(np.linspace(first, last - 1, DELAYS).astype(int))
        values = np.array([_criteria(model, slow, int(begin)) for begin in tried])
        likelihood = np.exp(-0.5 * WEIGHT * (values - values.min())).sum(axis=1)
        below, ends = np.cumsum(likelihood) / likelihood.sum(), np.append(tried[1:], last)
        least, most = int(np.argmax(below > TAILS[0])), int(np.argmax(below >= TAILS[1]))
        if tried.size == last - first:  # every one
            break
        first, last = int(tried[max(least - 1, 0)]), int(ends[min(most + 1, tried.size - 1)])
    # A response in the last part of an interval cannot be distinguished from one that begins with the next.
    low = edges[tried[least]] - 0.5 * (edges[tried[least]] - edges[tried[least - 1]] if least else 0.0)
    return Estimate(float(edges[tried[np.argmax(likelihood)]]), float(low), float(edges[ends[most]]))


def _criteria(model: ResponseModel, slow: Sequence[int], first: int) -> list[float]:
    """Return the BIC of responses that begin with an interval, for each covariance and onset."""
    layout, gram = model.layout, model.gram.copy()
    # The integral of the input also begins there.
    at = layout.taps + INTEGRAL
    gram[at] -= gram[:first].sum(axis=0)
    gram[:, at] -= gram[:, :first].sum(axis=1)
    part = layout._replace(edges=layout.edges[first:] - layout.edges[first])
    begun = 1 - np.exp(-0.5 * (part.edges[1:] + part.edges[:-1]) / part.decay)
    values = []
    for smooth in (False, True):
        factor = prior_factor(part, smooth)
        for power in STARTS:
            directions = Directions.of(gram[first:, first:], begun[:, None] ** power * factor)
            values.append(float(directions.searched().criteria(slow, len(layout.columns)).min()))
    return values
