"""What a response without a structure tells: signal-to-noise ratio, response time and delay, with 95 % intervals."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.inference.noise_model import NoiseModel
from ctid_cli.inference.response_layout import INTEGRAL, prior_factor
from ctid_cli.inference.response_model import Directions, ResponseModel

#: Tails of the intervals [-].
TAILS = (0.025, 0.975)
#: Impulse responses that are drawn, and the seed: one record always gives one result.
DRAWS, SEED = 400, 20140801
#: The response time ends where so much of the final value is reached: a time constant after the delay, of first order.
SHARE = 1 - math.exp(-1)
#: The response between two samples is not seen: intervals of the response time are longer by this share of the sampling
#: interval on each side. Without it they held the truth in 90 % of 200 simulated records, with it in 94 % of 400.
BETWEEN = 0.25
#: Standard deviations beyond which a response is taken as certain.
SURE = 5.0
#: A response has ended where the last quarter of its length changes it by less than this share.
ENDED = 0.1
#: Powers of ``1 - exp(-s/T)`` with which a response may begin, and delays that are compared.
STARTS, DELAYS = (0, 1, 2, 3), 12
#: Weight of the likelihood of a delay. None of these beginnings is the true one: of 97 simulated records of one to four
#: poles, intervals with weight 1 held the delay in 91 %, with 1/2 in 97 %.
WEIGHT = 0.5
#: Share of the independent samples of the noise that count: its model is chosen from the same record. With all of them
#: intervals held the ratio in 88 to 93 % of some hundred simulated records, with three quarters in 95 % of 400.
SPARE = 0.75
#: Frequencies at which the spectrum of a noise is summed.
FREQUENCIES = 1 << 14


class Estimate(NamedTuple):
    """A value with its 95 % interval; nan where the record does not tell it."""

    value: float = math.nan
    low: float = math.nan
    high: float = math.nan


UNKNOWN = Estimate()


def signal_to_noise(model: ResponseModel, slow: Sequence[int]) -> Estimate:
    """Return the variance of the response to the input over that of the noise [dB], beside columns of X.

    Both are taken about their means over the record.
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
    # The variance of coloured noise is as uncertain as that of fewer white samples.
    fitted = float(np.sum(model.directions.squares > 1))
    worth = max(2.0, len(columns) / squared_correlations(model.noise) - fitted)
    worth = SPARE * 2 / (2 / worth + error**2)
    ratio = power / variance_about_mean(model.noise, len(columns))
    low, high = (ratio * chdtri(worth, tail) / worth for tail in reversed(TAILS))
    return Estimate(*(10 * math.log10(each) for each in (ratio, low, high)))


def variance_about_mean(noise: NoiseModel, count: int) -> float:
    """Mean variance of ``count`` successive samples of a noise about their own mean.

    Noise that is slow for a record wanders far beyond what the record shows of it.
    """
    of_mean = float(noise.covariance_of(np.full((count, 1), 1 / count))[0, 0])
    variance = float(noise.first_autocovariances[0])
    # Above zero in spite of rounding, where the samples hardly differ.
    return max(variance - of_mean, float(np.finfo(float).eps) * variance)


def squared_correlations(noise: NoiseModel) -> float:
    """Sum over all lags of the squared autocorrelation of a noise."""
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
    """Return the time after a step in which 63 % of the final value is reached, delay included.

    The record does not tell it where the system integrates, or the response has not ended.
    """
    final = steps[:, -1]
    moving = abs(steps[0, -1 - steps.shape[1] // 4] - final[0]) > ENDED * abs(final[0])
    if model.integrates or moving or abs(final[0]) < SURE * final[1:].std():
        return UNKNOWN
    rows, edges, shares = np.arange(len(steps)), model.layout.edges, steps / final[:, None]
    k = np.argmax(shares >= SHARE, axis=1)
    before, after = shares[rows, k - 1], shares[rows, k]
    times = edges[k - 1] + (SHARE - before) / (after - before) * (edges[k] - edges[k - 1])
    low, high = np.quantile(times[1:], TAILS) + np.array([-BETWEEN, BETWEEN]) * edges[1]
    return Estimate(float(times[0]), float(low), float(high))


def delay(model: ResponseModel, slow: Sequence[int], steps: Array) -> Estimate:
    """Return the time after which the output begins to respond, in steps of the intervals of the impulse response.

    Its posterior, with responses that begin at once, or like a straight line, a parabola or a cubic.
    """
    edges, taps = model.layout.edges, model.layout.taps
    sure = np.abs(steps[0]) > SURE * steps[1:].std(axis=0)
    last = max(int(np.argmax(sure[1:])) + 1, min(DELAYS, taps // 3))
    # Where it is sure only when it must have begun long before, the record does not tell when.
    if not sure[1:].any() or last > taps // 2:
        return UNKNOWN
    tried = np.unique(np.linspace(0, last - 1, DELAYS).astype(int))
    values = np.array([_criteria(model, slow, int(first)) for first in tried])
    likelihood = np.exp(-0.5 * WEIGHT * (values - values.min())).sum(axis=1)
    below = np.cumsum(likelihood) / likelihood.sum()
    ends = np.append(tried[1:], last)
    low, high = edges[tried[np.argmax(below > TAILS[0])]], edges[ends[np.argmax(below >= TAILS[1])]]
    # A response that fills a small part of an interval is not told from one that begins with the next.
    low = max(low - 0.5 * edges[1], 0.0)
    return Estimate(float(edges[tried[np.argmax(likelihood)]]), float(low), float(high))


def _criteria(model: ResponseModel, slow: Sequence[int], first: int) -> list[float]:
    """BIC of responses that begin with an interval, one for each covariance and beginning."""
    layout, gram = model.layout, model.gram.copy()
    # What a system integrates it integrates from then on.
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
