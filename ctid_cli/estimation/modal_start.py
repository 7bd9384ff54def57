r"""A start for the estimation of a sum of submodels, from the record alone.

Poles are those of a transfer function with a free numerator, to which they are added pair by pair: as many as the sum
has, and two more of which the least important are left out. Both sets are shared out among the terms. For given poles
the output is linear in the numerators, which least squares on the output error supplies; the set whose output errors
are least, each band of frequencies compared with its own noise level, wins. Where these errors are coloured, poles are
found once more in the record filtered so that they are white.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations, islice
from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array, ComplexArray
from ctid_cli.errors import DataError
from ctid_cli.estimation.additive_problem import AdditiveProblem
from ctid_cli.estimation.iteration import solve_scaled
from ctid_cli.estimation.optimum.box import Point, box_of, point_of
from ctid_cli.estimation.optimum.projection import Problem
from ctid_cli.estimation.optimum.search import Descent
from ctid_cli.filtering.filter_data import FilterData, filter_data
from ctid_cli.filtering.submodels import OPEN_LOOP
from ctid_cli.inference.noise_model import fit_noise_model
from ctid_cli.models.additive import AdditiveModel, Term
from ctid_cli.signals.record import Record, beginning, named

#: Of longer records these first samples are used: poles need not be exact.
LONGEST = 20_000
#: Frequencies of an added pole or pair, and the dampings of a pair, that are tried.
FREQUENCIES = 20
DAMPINGS = (0.03, 0.3)
#: Poles that are added beyond those of the terms, for noise and modes that were not asked for.
SPARE_POLES = 2
#: Ways of sharing poles out among terms of different structure that are tried.
MOST_ARRANGEMENTS = 24
#: Frequencies of a periodogram that share one noise level.
BAND = 16
#: A complex pair that must give two real poles gives them this factor below and above its magnitude.
SPLIT = 1.25


#: How poles were found; the real ones and one of each pair.
PoleSet = tuple[str, list[complex]]


class ModalStart(NamedTuple):
    """Where the estimation of a sum of submodels may start."""

    model: AdditiveModel
    method: str


def automatic_start(record: Record, problem: AdditiveProblem) -> ModalStart:
    r"""Find a start for a sum of submodels.

    Sets of poles are compared by

    .. math:: J = 2 \sum_b n_b \log \frac{1}{n_b} \sum_{k \in b} |E_k|^2,

    where E is the discrete Fourier transform of the output error and b runs over bands of :math:`n_b` neighbouring
    frequencies: twice the negative logarithm of the likelihood for noise of an unknown level in each band. The plain
    output error would prefer a mode that follows a few lines of strong coloured noise to a weak one where noise is low.

    In closed loop the measured input is taken as it is: that biases the numbers a little, which a start may be.

    It fails for modes slower than the record or hidden in the noise, and for two modes that no frequency separates.
    """
    data = filter_data(beginning(record, LONGEST), problem.delay)
    problem = replace(problem, data=data, loop=OPEN_LOOP, fixed={})
    sets = _pole_sets(problem, data)
    best = _best(problem, sets)
    white = None if best is None else _whitened(data, best.error)
    if white is not None:
        way, _ = sets[0]
        sets.append((f"{way}, of the record with white noise", _upper(_Search(problem, white).found())))
        best = _best(problem, sets)
    if best is None:
        raise DataError(
            f"{named(record)}no start was found: {data.count} samples show no modes of the structure asked for; give "
            "the start, or take a longer record or fewer poles"
        )
    text = f"{best.way}; numerators by least squares on the output error; the best of {len(sets)} sets of poles."
    return ModalStart(best.model, text)


def _pole_sets(problem: AdditiveProblem, data: FilterData) -> list[PoleSet]:
    """Candidates for all poles but the integrators; none where the record is too short for them."""
    search = _Search(problem, data)
    count, order = search.poles, search.poles + search.integrators
    if count == 0:
        return [("No poles to be found", [])]
    if data.count <= count + order:
        return []
    found = search.found()
    more = search.with_more(found, SPARE_POLES)
    way = "Poles of a transfer function, added pair by pair up to order "
    return [
        (f"{way}{order}", _upper(found)),
        (f"{way}{order + SPARE_POLES}, the least important left out", search.without(more, SPARE_POLES)),
    ]


def _whitened(data: FilterData, error: Array) -> FilterData | None:
    """The record filtered so that noise like an output error is white; None where it is, or lags are not in time."""
    gaps = not data.use[np.argmax(data.use) :].all()
    if data.interval == 0.0 or not data.common_clock or gaps:
        return None
    noise = fit_noise_model([error])
    if noise.order == 0:
        return None
    return data._replace(y=noise.innovations(data.y), u=noise.innovations(data.u))


# --- poles of one transfer function ----------------------------------------------------------------


class _Search:
    """Transfer functions with the poles of a sum; their numerators and initial states are eliminated."""

    def __init__(self, problem: AdditiveProblem, data: FilterData) -> None:
        terms, delays = problem.terms, (problem.delay, problem.delay)
        self.poles, self.integrators = sum(term.poles for term in terms), sum(term.integrators for term in terms)
        self.direct = any(term.zeros == term.order for term in terms)
        # Of one period the state at the first sample is unknown, too.
        unknown = problem.initial_state != "rest"
        self.problem = Problem((data,), 0, unknown, (), (0.0,), integrators=self.integrators)
        self.box = box_of(self.problem, delays)

    def descent(self, poles: int) -> Descent:
        """Searches with that number of poles besides the integrators, and a full numerator."""
        return Descent(self.problem._replace(zeros=poles + self.integrators - 1 + self.direct), self.box)

    def point(self, poles: Sequence[complex] | ComplexArray) -> Point:
        """Poles with their conjugates, moved into the set that is searched."""
        return point_of(np.array(poles, dtype=complex), self.box.middle, self.box)

    def found(self) -> ComplexArray:
        """As many poles as the sum has."""
        poles = np.zeros(0, dtype=complex)
        while poles.size < self.poles:
            poles = self.with_more(poles, min(2, self.poles - poles.size))
        return poles

    def with_more(self, poles: ComplexArray, added: int) -> ComplexArray:
        """The poles of the least squared error with one more or two; those that there are move along."""
        frequencies = np.geomspace(self.box.spread[0], self.box.fastest, FREQUENCIES + 2)[1:-1].tolist()
        new = [(-w,) for w in frequencies] if added == 1 else [_pair(w, zeta) for w in frequencies for zeta in DAMPINGS]
        descent = self.descent(poles.size + added)
        trials = descent.sorted([self.point([*poles, *own]) for own in new])
        # What moves the squared error by less than the variance of the noise is not seen.
        return descent.descend(trials[0], near=1.0 / descent.count).point.poles

    def without(self, poles: ComplexArray, left_out: int) -> list[complex]:
        """The poles of the least squared error after some have been left out; one of each pair is listed."""
        upper = _upper(poles)
        kept = []
        for number in range(1, left_out + 1):
            for chosen in combinations(upper, len(upper) - number):
                both = [*chosen, *(pole.conjugate() for pole in chosen if pole.imag)]
                if len(both) == poles.size - left_out:
                    kept.append(both)
        errors = self.descent(poles.size - left_out).squared_errors([self.point(each) for each in kept])
        return _upper(np.array(kept[int(np.argmin(errors))]))


def _pair(frequency: float, damping: float) -> tuple[complex, complex]:
    """A pair of poles."""
    pole = frequency * complex(-damping, np.sqrt(1.0 - damping**2))
    return pole, pole.conjugate()


def _upper(poles: ComplexArray) -> list[complex]:
    """The real poles and one of each pair."""
    return [complex(pole) for pole in poles if pole.imag >= 0]


# --- poles to terms --------------------------------------------------------------------------------


def _arrangements(poles: Sequence[complex], terms: Sequence[Term]) -> Iterator[list[list[complex]]]:
    """Ways of giving each term its poles, conjugates not listed.

    Complex pairs beyond what the terms can hold become real poles, and real poles that are left over fill pairs as
    neighbours. Groups go to the terms by rising frequency, in every order of the different structures.
    """
    single, double = sum(term.poles % 2 for term in terms), sum(term.poles // 2 for term in terms)
    pairs, reals = _at_most_pairs(poles, double)
    tried: list[list[list[complex]]] = []
    for alone in combinations(range(len(reals)), single):
        rest = [pole for k, pole in enumerate(reals) if k not in alone]
        doubles = [[pole] for pole in pairs] + [rest[k : k + 2] for k in range(0, len(rest), 2)]
        doubles.sort(key=lambda group: abs(group[0]))
        for order in _distinct_orders(terms, range(len(terms))):
            groups = _dealt(terms, order, doubles, [reals[k] for k in alone])
            # Exchanging a term of one pole with one of two changes nothing.
            if groups not in tried:
                tried.append(groups)
                yield groups


def _dealt(
    terms: Sequence[Term], order: Sequence[int], doubles: list[list[complex]], singles: list[complex]
) -> list[list[complex]]:
    """Pairs and single poles given to the terms in an order."""
    two, one = iter(doubles), iter(singles)
    groups: list[list[complex]] = [[] for _ in terms]
    for k in order:
        groups[k] = [pole for pair in islice(two, terms[k].poles // 2) for pole in pair]
        groups[k] += islice(one, terms[k].poles % 2)
    return groups


def _at_most_pairs(poles: Sequence[complex], count: int) -> tuple[list[complex], list[complex]]:
    """Complex poles, one of each pair and at most a number of them, and real ones; both by rising magnitude."""
    pairs = sorted((pole for pole in poles if pole.imag), key=abs)
    reals = [pole for pole in poles if not pole.imag]
    while len(pairs) > count:
        # The best damped pair is nearest to two real poles.
        pole = pairs.pop(int(np.argmax([-pole.real / abs(pole) for pole in pairs])))
        reals += [complex(-abs(pole) / SPLIT), complex(-abs(pole) * SPLIT)]
    return pairs, sorted(reals, key=abs)


def _distinct_orders(terms: Sequence[Term], left: Sequence[int]) -> Iterator[list[int]]:
    """Orders of those of the terms that are left which differ in structure; equal terms keep theirs."""
    if not left:
        yield []
    for k in sorted({terms[j]: j for j in reversed(left)}.values()):
        for rest in _distinct_orders(terms, [j for j in left if j != k]):
            yield [k, *rest]


# --- numerators ------------------------------------------------------------------------------------


class _Fitted(NamedTuple):
    """A model with fitted numerators, its output error, its J, and how its poles were found."""

    model: AdditiveModel
    error: Array
    criterion: float
    way: str


def _best(problem: AdditiveProblem, sets: Sequence[PoleSet]) -> _Fitted | None:
    """The fit of least J with the poles of one of several sets, shared out among the terms."""
    found = [
        fitted
        for way, poles in sets
        for groups in islice(_arrangements(poles, problem.terms), MOST_ARRANGEMENTS)
        if (fitted := _with_numerators(problem, groups, way)) is not None
    ]
    return min(found, key=lambda fitted: fitted.criterion, default=None)


def _with_numerators(problem: AdditiveProblem, groups: Sequence[Sequence[complex]], way: str) -> _Fitted | None:
    """The model with given poles of each term; None where they give no valid model or no finite response."""
    theta, free = np.zeros(problem.free), np.ones(problem.free, dtype=bool)
    first = 0
    for poles, term in zip(groups, problem.terms, strict=True):
        monic = np.atleast_1d(np.real(np.poly([*poles, *(pole.conjugate() for pole in poles if pole.imag)])))
        own = slice(first, first + term.poles)
        theta[own], free[own] = monic[-2::-1] / monic[-1], False
        first += term.size
    rows = problem.rows(theta)
    if rows is None or not np.isfinite(rows[0]).all():
        return None
    # With all of them zero the output error is what numerators and free response have to explain.
    columns, error = rows[0][:, free], rows[1]
    gram = columns.T @ columns
    scales = np.diag(gram).copy()
    solved, theta[free] = solve_scaled(gram, columns.T @ error, scales, scales, scales.size)
    if not solved:
        return None
    try:
        model = problem.model(theta)
    except DataError:
        return None
    left = error - columns @ theta[free]
    return _Fitted(model, left, _criterion(left), way)


def _criterion(error: Array) -> float:
    """The criterion J of :func:`automatic_start`."""
    power = np.abs(np.fft.rfft(error)) ** 2
    edges = BAND * np.arange(max(power.size // BAND, 1))
    counts = np.diff(np.append(edges, power.size))
    means = np.add.reduceat(power, edges) / counts
    floor = np.finfo(float).tiny
    return float(2.0 * counts @ np.log(np.maximum(means, floor)))
