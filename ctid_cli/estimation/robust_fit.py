r"""Robust loss minimisation for measured records with outliers.

With x the simulated outputs, a loss is minimised by fitting ``x + psi(r)`` instead of ``y = x + r``: the squared errors
majorise twice the loss, so that every fit reduces the loss, and at a fixed point ``sum s psi(r) = 0`` [1]_. Starts,
bounds and classification of minima are those of least squares.

References
----------
.. [1] P. J. Huber and E. M. Ronchetti, *Robust Statistics*, 2nd ed. (Wiley 2009), section 7.8.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.estimation.measured_records import MeasuredRecords
from ctid_cli.estimation.optimum.best_model import Begin, Optimum
from ctid_cli.estimation.optimum.search import ROUNDING
from ctid_cli.inference.robust_loss import Loss, RobustKind, scale_of

#: Largest numbers of fits in one descent, and of fits with an updated scale.
MOST_FITS, MOST_SCALES = 60, 20
#: Relative change of the scale, and relative decrease of the loss, that count as convergence.
SETTLED, DONE = 1e-4, 1e-11
#: Largest number of searches, and relative decrease of the loss required from each.
MOST_SEARCHES, WORTHWHILE = 5, 1e-6


@dataclass(frozen=True, eq=False)
class RobustFit:
    """Local minimum of the loss."""

    found: Optimum
    losses: tuple[Loss, ...]
    #: Simulated outputs and output errors at the used samples of each record.
    simulated: list[Array]
    errors: list[Array]

    def cost(self, losses: Sequence[Loss]) -> float:
        """Return twice the sum of losses with given scales."""
        return sum(loss.cost(r) for loss, r in zip(losses, self.errors, strict=True))

    def modified(self) -> list[Array]:
        """Return the modified outputs of the next least-squares fit."""
        each = zip(self.simulated, self.losses, self.errors, strict=True)
        return [x + loss.weight(r) * r for x, loss, r in each]


def robust_fit(measured: MeasuredRecords, kind: RobustKind, starts: Sequence[Begin]) -> RobustFit:
    """Search for the least Huber loss, and from there for the least Tukey loss.

    The first search uses outputs with interpolated outliers, the next ones the modified outputs of the last fit.
    """
    best = _descend(measured, measured.best(starts), "huber")
    for _ in range(MOST_SEARCHES):
        at = [best.found.start, *starts]
        trial = _descend(measured, measured.with_outputs(best.modified()).best(at), "huber")
        smaller = [min(pair, key=lambda loss: loss.scale) for pair in zip(best.losses, trial.losses, strict=True)]
        if trial.cost(smaller) > best.cost(smaller) * (1.0 - WORTHWHILE):
            break
        best = trial
    return _of_kind(measured, best, kind)


def robust_local(measured: MeasuredRecords, kind: RobustKind, near: Optimum) -> RobustFit:
    """Return the least loss in the basin of an optimum."""
    return _of_kind(measured, _descend(measured, near, "huber"), kind)


def _of_kind(measured: MeasuredRecords, best: RobustFit, kind: RobustKind) -> RobustFit:
    """Return the least loss of a kind, starting from the least Huber loss."""
    if kind == "huber":
        return best
    return _descend(measured, best.found, kind, tuple(replace(loss, kind=kind) for loss in best.losses))


def _descend(
    measured: MeasuredRecords, found: Optimum, kind: RobustKind, losses: tuple[Loss, ...] | None = None
) -> RobustFit:
    """Return the local minimum of the loss at given scales, or at those of the errors, fixed once converged."""
    here = _at(measured, found, kind, losses)
    settled = losses is not None
    for k in range(MOST_FITS):
        there = measured.with_outputs(here.modified()).local(here.found.start)
        there = replace(there, tried=found.tried, agree=found.agree)
        following = _at(measured, there, kind, here.losses if settled else None)
        if settled and following.cost(here.losses) >= here.cost(here.losses) * (1.0 - DONE):
            break
        changes = [new.scale / old.scale - 1.0 for new, old in zip(following.losses, here.losses, strict=True)]
        settled = settled or k >= MOST_SCALES or float(np.abs(changes).max()) < SETTLED
        here = following
    return following


def _at(measured: MeasuredRecords, found: Optimum, kind: RobustKind, losses: tuple[Loss, ...] | None) -> RobustFit:
    simulated, outputs = measured.simulated(found), measured.outputs
    errors = [y - x for y, x in zip(outputs, simulated, strict=True)]
    least = [ROUNDING * float(np.sqrt(np.mean(y**2))) for y in outputs]
    losses = losses or tuple(Loss(kind, scale_of(*pair)) for pair in zip(errors, least, strict=True))
    return RobustFit(found, losses, simulated, errors)
