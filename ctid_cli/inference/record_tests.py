"""Tests of a record beside the response to its input: offset, drift, start, outliers and feedback."""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from ctid_cli.arrays import Array, IntArray
from ctid_cli.inference.intervals import normal_quantile, robust_deviation, student_quantile
from ctid_cli.inference.residual_tests import normal_tail
from ctid_cli.inference.response_layout import CONSTANT, LINE, START
from ctid_cli.inference.response_model import ResponseModel, whitened

#: Probability of each false alarm, if the noise is as modelled. With this 2.5 % of 400 clean records had any
#: (`benchmarks/bench_facts.py`).
LEVEL = 0.001
#: Earlier inputs and responses from which the next input is told, and the delays of the answer of a controller.
ORDER, ANSWERS = 6, 3
#: Steps of the robust regression, and the residual in robust standard deviations from which on it counts no more.
REWEIGHTED, CLIPPED = 8, 1.5
#: Outliers are looked for until so large a share of the samples are.
MOST_OUTLIERS = 0.02
#: Smaller errors, as a share of the deviation of the output, are those of an impulse response in intervals.
SMALL = 0.002
#: Neighbours on each side that show how large errors are about a sample, and the share of theirs that counts: the
#: deviation of so few is uncertain.
ABOUT, LOUDER = 30, 0.7
#: Noise of less power than this, as a share of the output's, is rounding.
NO_NOISE = 1e-20

#: Columns of X of each.
SLOW_TERMS: Mapping[str, tuple[int, ...]] = {"offset": (CONSTANT,), "drift": (LINE,), "start": START}


@dataclass(frozen=True)
class SlowTerm:
    """A part of the output that does not follow the input."""

    detected: bool
    #: Probability of one as large without any [-].
    p_value: float
    #: The constant, the change along the line over the record, or the free response at its beginning [output unit].
    value: float
    #: 95 % interval [output unit].
    low: float
    high: float


def slow_terms(model: ResponseModel, known: tuple[str, ...] = ()) -> dict[str, SlowTerm]:
    """Test offset, drift of the output, and free response of a record beside those that are known to be there.

    F tests by generalised least squares, the greatest first and the others beside it, as long as one is significant.
    The noise has as many degrees of freedom as the record is worth independent samples.
    """
    weighted, count = model.weighted, len(model.layout.columns)
    everything = (CONSTANT, LINE, *START, *model.own)
    freedom = max(2.0, model.noise.effective_count(count) - len(everything))
    least = NO_NOISE * float(weighted.products[0, -1, -1])
    variance = max(weighted.fit(everything)[2], least) / (count - len(everything))

    def p_value(name: str, beside: Iterable[str]) -> float:
        from scipy.special import fdtrc

        others = _columns(model, set(beside) - {name})
        own = SLOW_TERMS[name]
        gain = weighted.fit(others)[2] - weighted.fit((*others, *own))[2]
        return float(fdtrc(len(own), freedom, max(gain, 0.0) / (len(own) * variance)))

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
    """Columns of X that belong to the response, and to slow terms that are detected."""
    return _columns(model, {name for name, term in terms.items() if term.detected})


def _columns(model: ResponseModel, names: Collection[str]) -> tuple[int, ...]:
    return (*model.own, *(column for name in SLOW_TERMS if name in names for column in SLOW_TERMS[name]))


def outlying(model: ResponseModel, rest: Array) -> IntArray:
    """Samples that lie farther from what the others tell than chance explains, in noise of any colour.

    The likelihood ratio of one sample with an error of its own (Chang, Tiao and Chen, Technometrics 30 (1988) 193-204),
    against the deviation of those of all samples, or of its neighbours if that is larger: a model that is wrong leaves
    large errors where the output moves most.
    """
    c, r = model.noise.coefficients, model.noise.order
    limit, rest, found = normal_quantile(1 - LEVEL / rest.size), rest.copy(), list[int]()
    least = SMALL * float(model.layout.columns[:, -1].std())
    energy = np.cumsum(c**2)[np.minimum(np.arange(rest.size)[::-1], r)]
    # An error shows in its neighbours too, so that the greatest is taken away before the next is looked for.
    for _ in range(int(MOST_OUTLIERS * rest.size)):
        ahead = np.append(whitened(rest[:, None], model.noise)[:, 0], np.zeros(r))
        errors = sum(c[k] * ahead[k : k + rest.size] for k in range(r + 1)) / energy
        score = np.abs(errors) * np.sqrt(energy)
        k = int(np.argmax(score))
        about = score[max(k - ABOUT, 0) : k + ABOUT + 1]
        sure = score[k] > limit * max(_deviation(score), LOUDER * robust_deviation(about))
        if not sure or abs(errors[k]) < least:
            break
        found.append(k)
        rest[k] -= errors[k]
    return np.unique(np.array(found, dtype=np.int64))


def _deviation(sizes: Array) -> float:
    """Standard deviation from sizes, of which a few may be far too large."""
    return float(np.sqrt(np.mean(np.minimum(sizes, 3.0 * robust_deviation(sizes)) ** 2)))


def feedback(u: Array, response: Array, rest: Array, model: ResponseModel) -> float:
    """Return the probability that an input which does not depend on the output goes so much with its noise.

    What the input and the response were does not tell all moves: those of a reference that is held are rare and large,
    and would drown the answer to the noise. So they are clipped. Innovations of the noise are independent of any
    function of an input that does not depend on the output.
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
    products = [moves * white[ORDER - k : white.size - k] for k in range(ANSWERS)]
    scores = [abs(float(each.sum())) / max(float(np.sqrt(each @ each)), np.finfo(float).tiny) for each in products]
    return min(1.0, 2 * ANSWERS * normal_tail(max(scores)))
