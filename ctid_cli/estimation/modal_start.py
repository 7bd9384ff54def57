r"""Start for the estimation of a sum of submodels, from the record only.

Poles are those of a transfer function with a free numerator, to which they are added pair by pair: the number of the
sum, and two more, of which the least important are removed. Both sets are assigned to the terms. For given poles the
output is linear in the numerators, which follow by least squares on the output error; the set with the least output
errors, each frequency band weighted by its noise level, is chosen. If these errors are coloured, poles are found again
in a prewhitened record.
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

#: Number of first samples that are used of longer records: poles need not be exact.
LONGEST = 20_000
#: Number of trial frequencies of an added pole or pair, and trial dampings of a pair.
FREQUENCIES = 20
DAMPINGS = (0.03, 0.3)
#: Number of additional poles for noise and unmodelled modes.
SPARE_POLES = 2
#: Largest number of assignments of poles to terms that are tried.
MOST_ARRANGEMENTS = 24
#: Frequencies of a periodogram that share one noise level.
BAND = 16
#: A complex pair is split into two real poles this factor below and above its magnitude.
SPLIT = 1.25


#: Method by which poles were found; the real poles and one of each pair.
PoleSet = tuple[str, list[complex]]


class ModalStart(NamedTuple):
    """Start of the estimation of a sum of submodels."""

    model: AdditiveModel
    method: str


def automatic_start(record: Record, problem: AdditiveProblem) -> ModalStart:
    r"""Find a start for a sum of submodels.

    Sets of poles are compared by

    .. math:: J = 2 \sum_b n_b \log \frac{1}{n_b} \sum_{k \in b} |E_k|^2,

    where E is the discrete Fourier transform of the output error and b runs over bands of :math:`n_b` neighbouring
    frequencies: twice the negative logarithm of the likelihood for noise of an unknown level in each band. The plain
    output error would prefer a mode that fits a few lines of strong coloured noise to a weak mode in low noise.

    In closed loop the measured input is used: the small bias is acceptable for a start.

    The method fails for modes slower than the record or below the noise, and for two modes of nearly equal frequency.
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
            f"{named(record)}no start was found: {data.count} samples show no modes of this structure; give "
            "the start, or take a longer record or fewer poles"
        )
    text = f"{best.way}; numerators by least squares on the output error; the best of {len(sets)} sets of poles."
    return ModalStart(best.model, text)


def _pole_sets(problem: AdditiveProblem, data: FilterData) -> list[PoleSet]:
    """Return candidates for all poles except integrators; none if the record is too short."""
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
    """Return the record filtered to whiten an output error; None if it is white or the clock is irregular."""
    gaps = not data.use[np.argmax(data.use) :].all()
    if data.interval == 0.0 or not data.common_clock or gaps:
        return None
    noise = fit_noise_model([error])
    if noise.order == 0:
        return None
    return data._replace(y=noise.innovations(data.y), u=noise.innovations(data.u))


# --- poles of one transfer function ----------------------------------------------------------------


class _Search:
    """Search for the poles of a sum as one transfer function; numerators and initial states are eliminated."""

    def __init__(self, problem: AdditiveProblem, data: FilterData) -> None:
        terms, delays = problem.terms, (problem.delay, problem.delay)
        self.poles, self.integrators = sum(term.poles for term in terms), sum(term.integrators for term in terms)
        self.direct = any(term.zeros == term.order for term in terms)
        # The state at the first sample is unknown for a single period, too.
        unknown = problem.initial_state != "rest"
        self.problem = Problem((data,), 0, unknown, (), (0.0,), integrators=self.integrators)
        self.box = box_of(self.problem, delays)

    def descent(self, poles: int) -> Descent:
        """Return the local search with ``poles`` poles in addition to the integrators, and a full numerator."""
        return Descent(self.problem._replace(zeros=poles + self.integrators - 1 + self.direct), self.box)

    def point(self, poles: Sequence[complex] | ComplexArray) -> Point:
        """Return the point of poles with their conjugates, projected onto the searched set."""
        return point_of(np.array(poles, dtype=complex), self.box.middle, self.box)

    def found(self) -> ComplexArray:
        """Return the poles of a search with the number of poles of the sum."""
        poles = np.zeros(0, dtype=complex)
        while poles.size < self.poles:
            poles = self.with_more(poles, min(2, self.poles - poles.size))
        return poles

    def with_more(self, poles: ComplexArray, added: int) -> ComplexArray:
        """Return the poles of least squared error after adding one or two; existing poles are re-estimated."""
        frequencies = np.geomspace(self.box.spread[0], self.box.fastest, FREQUENCIES + 2)[1:-1].tolist()
        new = [(-w,) for w in frequencies] if added == 1 else [_pair(w, zeta) for w in frequencies for zeta in DAMPINGS]
        descent = self.descent(poles.size + added)
        trials = descent.sorted([self.point([*poles, *own]) for own in new])
        # Changes of the squared error below the variance of the noise are not significant.
        return descent.descend(trials[0], near=1.0 / descent.count).point.poles

    def without(self, poles: ComplexArray, left_out: int) -> list[complex]:
        """Return the poles of least squared error after removing ``left_out``; one of each pair is listed."""
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
    """Return a complex pair of poles."""
    pole = frequency * complex(-damping, np.sqrt(1.0 - damping**2))
    return pole, pole.conjugate()


def _upper(poles: ComplexArray) -> list[complex]:
    """Return the real poles and one of each pair."""
    return [complex(pole) for pole in poles if pole.imag >= 0]


# --- assignment of poles to terms ------------------------------------------------------------------


def _arrangements(poles: Sequence[complex], terms: Sequence[Term]) -> Iterator[list[list[complex]]]:
    """Yield assignments of poles to terms, conjugates not listed.

    Surplus complex pairs become real poles, and surplus real poles are paired with their neighbours. Groups are
    assigned to the terms by ascending frequency, in every order of the different structures.
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
            # Exchanging a term of one pole with one of two poles gives an equal assignment.
            if groups not in tried:
                tried.append(groups)
                yield groups


def _dealt(
    terms: Sequence[Term], order: Sequence[int], doubles: list[list[complex]], singles: list[complex]
) -> list[list[complex]]:
    """Return pairs and single poles assigned to the terms in a given order."""
    two, one = iter(doubles), iter(singles)
    groups: list[list[complex]] = [[] for _ in terms]
    for k in order:
        groups[k] = [pole for pair in islice(two, terms[k].poles // 2) for pole in pair]
        groups[k] += islice(one, terms[k].poles % 2)
    return groups


def _at_most_pairs(poles: Sequence[complex], count: int) -> tuple[list[complex], list[complex]]:
    """Return at most ``count`` complex poles, one of each pair, and real poles; both by ascending magnitude."""
    pairs = sorted((pole for pole in poles if pole.imag), key=abs)
    reals = [pole for pole in poles if not pole.imag]
    while len(pairs) > count:
        # The pair with the highest damping is closest to two real poles.
        pole = pairs.pop(int(np.argmax([-pole.real / abs(pole) for pole in pairs])))
        reals += [complex(-abs(pole) / SPLIT), complex(-abs(pole) * SPLIT)]
    return pairs, sorted(reals, key=abs)


def _distinct_orders(terms: Sequence[Term], left: Sequence[int]) -> Iterator[list[int]]:
    """Yield the orders of the remaining terms that differ in structure; equal terms keep their order."""
    if not left:
        yield []
    for k in sorted({terms[j]: j for j in reversed(left)}.values()):
        for rest in _distinct_orders(terms, [j for j in left if j != k]):
            yield [k, *rest]


# --- numerators ------------------------------------------------------------------------------------


class _Fitted(NamedTuple):
    """Model with fitted numerators, its output error, its J, and the method that found its poles."""

    model: AdditiveModel
    error: Array
    criterion: float
    way: str


def _best(problem: AdditiveProblem, sets: Sequence[PoleSet]) -> _Fitted | None:
    """Return the fit of least J over several sets of poles and their assignments to the terms."""
    found = [
        fitted
        for way, poles in sets
        for groups in islice(_arrangements(poles, problem.terms), MOST_ARRANGEMENTS)
        if (fitted := _with_numerators(problem, groups, way)) is not None
    ]
    return min(found, key=lambda fitted: fitted.criterion, default=None)


def _with_numerators(problem: AdditiveProblem, groups: Sequence[Sequence[complex]], way: str) -> _Fitted | None:
    """Return the model with given poles of each term; None if the model is invalid or its response not finite."""
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
    # With zero numerators the output error is the regressand of numerators and free response.
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
    """Return the criterion J of :func:`automatic_start`."""
    power = np.abs(np.fft.rfft(error)) ** 2
    edges = BAND * np.arange(max(power.size // BAND, 1))
    counts = np.diff(np.append(edges, power.size))
    means = np.add.reduceat(power, edges) / counts
    floor = np.finfo(float).tiny
    return float(2.0 * counts @ np.log(np.maximum(means, floor)))
