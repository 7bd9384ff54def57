"""Optima of many structures for the price of a few: each from those below it, with few starts and none at random."""

import numpy as np

from ctid_cli.arrays import ComplexArray
from ctid_cli.estimation.optimum.best_model import Optimum, optimum
from ctid_cli.estimation.optimum.box import Point
from ctid_cli.estimation.optimum.search import Judged
from ctid_cli.estimation.optimum.starts import SAME, Nest

#: Frequencies tried for a pole that is added to a smaller model, and for a pair; dampings of a pair.
POLES, PAIRS, DAMPINGS = 12, 20, (0.03, 0.3)
#: Starts refined beside those that the structure contains.
REFINED = 2
#: Up to so many poles the whole range of the delay is looked at.
LOOKED_AT = 2


class Ladder(Nest):
    """The optima of a range of structures; cheaper than those of a nest, and as good where smaller models lead on."""

    def __init__(self, nest: Nest) -> None:
        super().__init__(nest.problem, nest.box, 0, nest.seed)
        self._judged: dict[tuple[int, int], Judged] = {}

    def best(self, poles: int, zeros: int) -> Optimum:
        """The least squared error of a structure and of those with fewer poles that are in its closure."""
        fewest = max(zeros + int(self.box.delay_free), 1)
        sizes = range(poles, fewest - 1, -1)
        # A pole at infinity costs nothing: a smaller model must be worse by more than rounding to lose.
        errors = [self._settled(n, zeros).local.squared_error for n in sizes]
        lost = next(k for k, error in enumerate(errors) if error <= min(errors) * (1 + 1e-9))
        n = poles - lost
        ends = np.array(self.ends(n, zeros))
        agree = int(np.count_nonzero(ends <= ends.min() * (1 + SAME) + self.descent(zeros).floor))
        return optimum(self._settled(n, zeros), lost, ends.size, agree, self)

    def _settled(self, poles: int, zeros: int) -> Judged:
        key = poles, zeros
        if key not in self._judged:
            descent = self.descent(zeros)
            self._judged[key] = descent.settle(self.optima(poles, zeros)[0])
            self.evaluations += descent.evaluations
        return self._judged[key]

    def _from_below(self, poles: int, zeros: int) -> list[Point]:
        """Starts from smaller models; of few poles also along the delay."""
        contained: list[Point] = []
        others: list[Point] = []
        if zeros > 0:
            contained.append(self.optima(poles, zeros - 1)[0].point)
        if poles > 1 and zeros > 0:
            contained += self._with_poles(poles - 1, zeros - 1, zeros, 1)
        for n, m in ((poles - 1, zeros), (poles - 2, zeros - 2), (poles - 2, zeros)):
            if n > 0 and 0 <= m < n + (not self.box.delay_free):
                others += self._with_poles(n, m, zeros, poles - n)
        if poles <= LOOKED_AT:
            others += self._alone(zeros, poles)
        descent = self.descent(zeros)
        points = contained + descent.sorted(others)[:REFINED]
        if poles <= LOOKED_AT:
            points += self._along_delay(zeros, descent.sorted(points)[:1])[1:]
        self.evaluations += descent.evaluations
        return points

    def _with_poles(self, poles: int, zeros: int, new_zeros: int, added: int) -> list[Point]:
        """The best pole or pair beside those of a smaller model, by elimination alone."""
        smaller = self.optima(poles, zeros)[0].point
        return self._best_beside(smaller.poles, smaller.delay.seconds, new_zeros, added, 1)

    def _alone(self, zeros: int, poles: int) -> list[Point]:
        """The best single poles, or single pairs, at the delay of the smallest model or in the middle of the range."""
        delay = 0.5 * sum(self.box.delays) if poles == 1 else self.optima(1, 0)[0].point.delay.seconds
        return self._best_beside(np.zeros(0, dtype=complex), delay, zeros, poles, REFINED + 1)

    def _best_beside(self, roots: ComplexArray, delay: float, zeros: int, added: int, most: int) -> list[Point]:
        found = self._beside_poles(roots, delay, zeros, added, POLES if added == 1 else PAIRS, DAMPINGS)
        return [point for _, point in found[:most]]
