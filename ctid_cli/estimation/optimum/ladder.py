"""Optima of many structures for the price of a few: each from those below it, with few starts and none at random."""

from ctid_cli.estimation.optimum.best_model import Optimum, least
from ctid_cli.estimation.optimum.starts import QUICK, Nest


class Ladder(Nest):
    """The optima of a range of structures; cheaper than those of a nest, and as good where smaller models lead on."""

    def __init__(self, nest: Nest) -> None:
        super().__init__(nest.problem, nest.box, 0, nest.seed, effort=QUICK)

    def best(self, poles: int, zeros: int) -> Optimum:
        """The least squared error of a structure and of those with fewer poles that are in its closure."""
        return least(self, poles, zeros, fewer_poles=True)
