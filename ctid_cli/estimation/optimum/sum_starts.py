"""Starts of searches for sums of submodels: sums extended term by term."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import permutations

import numpy as np

from ctid_cli.arrays import ComplexArray
from ctid_cli.estimation.optimum.box import Box, Point, point_of
from ctid_cli.estimation.optimum.projection import Problem
from ctid_cli.estimation.optimum.search import Local
from ctid_cli.estimation.optimum.starts import StructureSearch, with_added_poles
from ctid_cli.models.additive import Term

#: Number of frequencies of an added pole or pair, and dampings of a pair.
FREQUENCIES, DAMPINGS = 24, (0.005, 0.05, 0.5)
#: Largest numbers of sums kept after each step, of extensions of each, and of orders in which terms are added.
KEPT, PLACES, MOST_ORDERS = 2, 2, 3
#: Number of delays in the search for the first term.
FIRST_DELAYS = 10


class SumGrowth:
    """Extension of sums: the first term over the whole range of the delay, each further one added to the best sums."""

    def __init__(self, problem: Problem, box: Box) -> None:
        self.problem, self.box = problem, box

    def points(self) -> list[Point]:
        """Return the best sums of all terms, in several orders of extension if terms differ."""
        terms = self.problem.terms
        distinct = dict.fromkeys(tuple(terms[k] for k in order) for order in permutations(range(min(len(terms), 6))))
        # For many terms only the given order is tried.
        orders = list(distinct)[:MOST_ORDERS] if len(terms) <= 6 else [terms]
        return [_rearranged(local.point, order, terms, self.box) for order in orders for local in self._grown(order)]

    def _grown(self, order: tuple[Term, ...]) -> list[Local]:
        """Return the lowest minima of a sum whose terms are added in a given order."""
        best: list[Local] = []
        for count in range(1, len(order) + 1):
            term = order[count - 1]
            # A term of many poles is extended pair by pair.
            for poles in sorted({term.poles, *range(2 - term.poles % 2, term.poles, 2)} - {0}) or [0]:
                zeros = min(term.zeros, poles + term.integrators)
                terms = (*order[: count - 1], Term(poles, zeros, term.integrators))
                best = self._added(terms, best)
        return best

    def _added(self, terms: tuple[Term, ...], known: Sequence[Local]) -> list[Local]:
        """Return the lowest minima of a sum, from those with fewer poles in the last term."""
        problem = self.problem._replace(terms=terms)
        box = replace(self.box, parts=problem.parts)
        search = StructureSearch(problem, box)
        descent, order = search.descent(problem.zeros), sum(term.poles for term in terms)
        found: list[Local] = []
        bases = [(local.point.poles, local.point.delay.seconds) for local in known]
        # The first term is searched over the whole range of the delay.
        delays = search.delays(FIRST_DELAYS) or [box.each_delay[0][0]]
        bases = bases or [(np.zeros(0, dtype=complex), delay) for delay in delays]
        starts: list[Point] = []
        frequencies = np.geomspace(box.spread[0], min(box.fastest, box.imaginary), FREQUENCIES + 2)[1:-1].tolist()
        for roots, delay in bases:
            if added := order - roots.size:
                dampings = DAMPINGS if added == 2 else ()
                starts += with_added_poles(descent, box, (roots, delay), frequencies, dampings, PLACES)
            else:
                starts.append(point_of(roots, delay, box))
        if not known:
            starts = descent.sorted(starts)[: PLACES * KEPT]
        for start in starts:
            # Changes of the squared error below the variance of the noise are not significant.
            found.append(descent.descend(start, found, near=1.0 / descent.count))
        found.sort(key=lambda local: local.squared_error)
        distinct = [one for k, one in enumerate(found) if one not in found[:k]]
        return distinct[:KEPT]


def _rearranged(point: Point, order: Sequence[Term], terms: Sequence[Term], box: Box) -> Point:
    """Return a point with its terms permuted from ``order`` to ``terms``."""
    groups = _groups(point.poles, [term.poles for term in order])
    left = list(zip(order, groups, strict=True))
    found = [left.pop(next(k for k, (own, _) in enumerate(left) if own == term))[1] for term in terms]
    return _joined(found, point, box)


def in_order(point: Point, terms: Sequence[Term], box: Box) -> Point:
    """Return the sum with submodels of equal structure sorted by natural frequency."""
    groups = _groups(point.poles, [term.poles for term in terms])
    rising = sorted(range(len(groups)), key=lambda k: float(np.abs(groups[k]).min(initial=np.inf)))
    of_term = {term: iter([groups[k] for k in rising if terms[k] == term]) for term in terms}
    return _joined([next(of_term[term]) for term in terms], point, box)


def _joined(groups: Sequence[ComplexArray], point: Point, box: Box) -> Point:
    own = replace(box, parts=tuple(group.size for group in groups))
    return point_of(np.concatenate(groups), point.seconds, own).with_delays(point.delays)


def _groups(poles: ComplexArray, sizes: Sequence[int]) -> list[ComplexArray]:
    return np.split(poles, np.cumsum(sizes)[:-1])
