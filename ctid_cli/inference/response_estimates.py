"""What a response without a structure tells: signal-to-noise ratio, response time and delay, with intervals."""

from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.inference.noise_model import NoiseModel
from ctid_cli.inference.response_model import Directions, ResponseModel, prior_factor

LEVEL = 0.95
DRAWS, SEED = 400, 20140801
SHARE = 1 - np.exp(-1)
CERTAIN = 4.0


class Estimate(NamedTuple):
    """A value with its 95 % interval; nan where the record does not tell it."""

    value: float
    low: float
    high: float


UNKNOWN = Estimate(np.nan, np.nan, np.nan)


def signal_to_noise(model: ResponseModel, response: Array, slow: tuple[int, ...]) -> Estimate:
    from scipy.special import chdtri
    found = model.directions
    covariance = model.taps(slow)[1]
    columns = model.layout.columns[:, : model.layout.taps]
    centred = columns - columns.mean(axis=0)
    own = float(np.einsum("ij,jk,ik->", centred, covariance, centred, optimize=True)) / len(columns)
    power = float(np.var(response)) + own * model.noise.innovation_variance
    noise = float(model.noise.first_autocovariances[0])
    worth = max(2.0, len(columns) / squared_correlations(model.noise) - np.sum(found.squares > 1) )
    low, high = (worth / chdtri(worth, tail) for tail in (0.025, 0.975))
    ratio = power / noise
    return Estimate(*(10 * float(np.log10(r)) for r in (ratio, ratio / high, ratio / low)))


def squared_correlations(noise: NoiseModel) -> float:
    """Sum over all lags of the squared autocorrelation."""
    n = 1 << 14
    power = 1 / np.abs(np.fft.fft(noise.coefficients, n)) ** 2
    return float(np.mean(power**2) / np.mean(power) ** 2)


def step_responses(model: ResponseModel, slow) -> tuple[Array, Array]:
    mean, covariance = model.taps(slow)
    width = np.diff(model.layout.edges)
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0) * model.noise.innovation_variance)
    rng = np.random.default_rng(SEED)
    draws = mean + rng.standard_normal((DRAWS, mean.size)) @ root.T
    every = np.vstack([mean, draws])
    return model.layout.edges, np.column_stack([np.zeros(len(every)), np.cumsum(every * width, axis=1)])


def response_time(model: ResponseModel, slow) -> Estimate:
    if model.integrates:
        return UNKNOWN
    edges, steps = step_responses(model, slow)
    final = steps[:, -1]
    if abs(final[0]) < CERTAIN * final[1:].std():
        return UNKNOWN
    if abs(steps[0, 3 * steps.shape[1] // 4] - final[0]) > 0.05 * abs(final[0]):
        return UNKNOWN
    above = steps / final[:, None] >= SHARE
    k = np.argmax(above, axis=1)
    rows = np.arange(len(k))
    a, b = steps[rows, k - 1] / final, steps[rows, k] / final
    times = edges[k - 1] + (SHARE - a) / (b - a) * (edges[k] - edges[k - 1])
    low, high = np.quantile(times[1:], [0.025, 0.975])
    return Estimate(float(times[0]), float(low), float(high))


STARTS = (0, 1, 2, 3)
CANDIDATES = 12


def delay(model: ResponseModel, slow) -> Estimate:
    edges, steps = step_responses(model, slow)
    sure = np.abs(steps[0]) > 5 * steps[1:].std(axis=0)
    taps = model.layout.taps
    last = int(np.argmax(sure)) if sure.any() else 0
    if not sure.any() or last >= taps - 4:
        return UNKNOWN
    tried = np.unique(np.linspace(0, last - 1, CANDIDATES).astype(int)) if last > 0 else np.array([0])
    count = len(model.layout.columns)
    values = []
    for j in tried:
        part = model.layout._replace(edges=edges[j:] - edges[j])
        gram = model.gram.copy()
        at = taps + 2
        gram[at] -= gram[:j].sum(axis=0)
        gram[:, at] -= gram[:, :j].sum(axis=1)
        gram = gram[j:, j:]
        centres = 0.5 * (part.edges[1:] + part.edges[:-1])
        every = []
        for smooth in (False, True):
            base = prior_factor(part, smooth)
            for start in STARTS:
                factor = (1 - np.exp(-centres / part.decay))[:, None] ** start * base
                directions = Directions.of(gram, factor)
                from ctid_cli.inference.response_model import SCALES
                scales = SCALES / max(float(directions.squares[-1]), 1e-300)
                weighted = directions.weighted(scales)
                every.append(weighted.criteria((*model.own, *slow), count).min())
        values.append(every)
    values = np.array(values)
    likelihood = np.exp(-0.5 * (values - values.min())).sum(axis=1)
    cdf = np.cumsum(likelihood) / likelihood.sum()
    low = tried[np.argmax(cdf > 0.025)]
    k = int(np.argmax(cdf >= 0.975))
    high = tried[k + 1] if k + 1 < tried.size else last
    best = tried[int(np.argmax(likelihood))]
    return Estimate(float(edges[best]), max(float(edges[low]) - 0.5 * (edges[1] - edges[0]), 0.0), float(edges[high]))
