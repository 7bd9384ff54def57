"""Tests of a record for offset, drift, free response, outliers and feedback, given its response to the input."""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from ctid_cli.arrays import Array, IntArray
from ctid_cli.inference.intervals import normal_quantile, robust_deviation, student_quantile
from ctid_cli.inference.residual_tests import normal_tail
from ctid_cli.inference.response_layout import CONSTANT, LINE, START
from ctid_cli.inference.response_model import ResponseModel, whitened

#: False-alarm probability of each test, if the noise model is correct. With it 2.5 % of 400 clean records had a false
#: alarm (`benchmarks/bench_facts.py`).
LEVEL = 0.001
#: Earlier inputs and responses from which the next input is predicted, and lags of the response of a controller.
ORDER, CONTROLLER_LAGS = 6, 3
#: Steps of the robust regression, and limit at which residuals are clipped [robust standard deviations].
REWEIGHTED, CLIPPED = 8, 1.5
#: Largest share of outliers among the samples.
MOST_OUTLIERS = 0.02
#: Smaller errors, as a share of the deviation of the output, may come from the discretised impulse response.
SMALL = 0.002
#: Neighbours on each side for the local deviation of errors, and factor of it, because it is uncertain.
LOCAL, LOCAL_FACTOR = 30, 0.7
#: Noise of less power than this, as a share of the output's, is rounding error.
NO_NOISE = 1e-20

#: Columns of X of each slow term.
SLOW_TERMS: Mapping[str, tuple[int, ...]] = {"offset": (CONSTANT,), "drift": (LINE,), "start": START}


@dataclass(frozen=True)
class SlowTerm:
    """A part of the output that does not depend on the input."""

    detected: bool
    #: p-value of the test that there is none [-].
    p_value: float
    #: The constant, the change along the line over the record, or the free response at its beginning [output unit].
    value: float
    #: 95 % interval [output unit].
    low: float
    high: float


def slow_terms(model: ResponseModel, known: tuple[str, ...] = ()) -> dict[str, SlowTerm]:
    """Test offset, drift and free response of a record, given the slow terms known to be present.

    Forward selection by F tests with generalised least squares, as long as a term is significant. The degrees of
    freedom of the noise are from the effective sample size.
    """
    weighted, count = model.weighted, len(model.layout.columns)
    everything = (CONSTANT, LINE, *START, *model.own)
    freedom = max(2.0, model.noise.effective_count(count) - len(everything))
    least = NO_NOISE * float(weighted.products[0, -1, -1])
    variance = max(weighted.fit(everything)[2], least) / (count - len(everything))

    def p_value(name: str, included: Iterable[str]) -> float:
        from scipy.special import fdtrc

        others = _columns(model, set(included) - {name})
        tested = SLOW_TERMS[name]
        gain = weighted.fit(others)[2] - weighted.fit((*others, *tested))[2]
        return float(fdtrc(len(tested), freedom, max(gain, 0.0) / (len(tested) * variance)))

    found = known
    while len(found) < len(SLOW_TERMS):
        likely = {name: p_value(name, found) for name in SLOW_TERMS if name not in found}
        name = min(likely, key=lambda key: likely[key])
        if likely[name] > LEVEL:
            break
        found = (*found, name)
    found = tuple(name for name in found if name in known or p_value(name, found) <= LEVEL)
    quantile = student_quantile(freedom)
    terms = {}
    for name in SLOW_TERMS:
        columns = _columns(model, {*found, name})
        values, covariance, _ = weighted.fit(columns)
        places = [columns.index(column) for column in SLOW_TERMS[name]]
        value = float(values[places].sum())
        reach = quantile * float(np.sqrt(variance * covariance[np.ix_(places, places)].sum()))
        p = 0.0 if name in known else p_value(name, found)
        terms[name] = SlowTerm(name in found, p, value, value - reach, value + reach)
    return terms


def slow_columns(model: ResponseModel, terms: Mapping[str, SlowTerm]) -> tuple[int, ...]:
    """Return the columns of X of the response and of detected slow terms."""
    return _columns(model, {name for name, term in terms.items() if term.detected})


def _columns(model: ResponseModel, names: Collection[str]) -> tuple[int, ...]:
    return (*model.own, *(column for name in SLOW_TERMS if name in names for column in SLOW_TERMS[name]))


def outlying(model: ResponseModel, rest: Array) -> IntArray:
    """Return significant additive outliers in noise of any colour.

    The likelihood ratio of an additional error of one sample (Chang, Tiao and Chen, Technometrics 30 (1988) 193-204) is
    compared with the deviation over all samples, or over its neighbours if that is larger, because a wrong model has
    large errors where the output changes most.
    """
    c, r = model.noise.coefficients, model.noise.order
    limit, rest, found = normal_quantile(1 - LEVEL / rest.size), rest.copy(), list[int]()
    least = SMALL * float(model.layout.columns[:, -1].std())
    energy = np.cumsum(c**2)[np.minimum(np.arange(rest.size)[::-1], r)]
    # An outlier also affects its neighbours: the greatest is removed before the search for the next.
    for _ in range(int(MOST_OUTLIERS * rest.size)):
        ahead = np.append(whitened(rest[:, None], model.noise)[:, 0], np.zeros(r))
        errors = sum(c[k] * ahead[k : k + rest.size] for k in range(r + 1)) / energy
        score = np.abs(errors) * np.sqrt(energy)
        k = int(np.argmax(score))
        nearby = score[max(k - LOCAL, 0) : k + LOCAL + 1]
        significant = score[k] > limit * max(_deviation(score), LOCAL_FACTOR * robust_deviation(nearby))
        if not significant or abs(errors[k]) < least:
            break
        found.append(k)
        rest[k] -= errors[k]
    return np.unique(np.array(found, dtype=np.int64))


def _deviation(sizes: Array) -> float:
    """Return a standard deviation from absolute values with outliers."""
    return float(np.sqrt(np.mean(np.minimum(sizes, 3.0 * robust_deviation(sizes)) ** 2)))


def feedback(u: Array, response: Array, rest: Array, model: ResponseModel) -> float:
    """Return the p-value of the correlation of the input with past noise under the hypothesis of no feedback.

    The input is predicted from earlier inputs and responses. Prediction errors are clipped, because rare large changes
    of a held reference would mask the response to the noise. Without feedback, the innovations of the noise are
    independent of any function of the input.
    """
    windows = np.lib.stride_tricks.sliding_window_view
    before = np.column_stack([windows(u, ORDER + 1)[:, :-1], windows(response, ORDER + 1), np.ones(u.size - ORDER)])
    scale = np.abs(before).max(axis=0)
    before, now = before[:, scale > 0] / scale[scale > 0], u[ORDER:]
    weight, moves = np.ones(now.size), now
    for _ in range(REWEIGHTED):
        root = np.sqrt(weight)
        moves = now - before @ np.linalg.lstsq(before * root[:, None], now * root, rcond=1e-10)[0]
        spread = robust_deviation(moves)
        if not spread > 1e-9 * float(np.ptp(now)):
            return 1.0
        weight = 1.0 / np.maximum(np.abs(moves) / spread, 1.0)
    moves = np.clip(moves / spread, -CLIPPED, CLIPPED)
    white = whitened(rest[:, None], model.noise)[:, 0]
    products = [moves * white[ORDER - k : white.size - k] for k in range(CONTROLLER_LAGS)]
    scores = [abs(float(each.sum())) / max(float(np.sqrt(each @ each)), np.finfo(float).tiny) for each in products]
    return min(1.0, 2 * CONTROLLER_LAGS * normal_tail(max(scores)))
