r"""Robust loss functions: Huber's, and Tukey's biweight.

The estimate solves ``sum_t s_t psi(r_t) = 0`` with the sensitivities s. Its asymptotic distribution is that of least
squares with the *pseudo-errors* ``psi(r_t) / mean psi'``: covariances, tests and profiles use these.

References
----------
P. J. Huber and E. M. Ronchetti, *Robust Statistics*, 2nd ed. (Wiley 2009), chapter 7. doi:10.1002/9780470434697
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Literal

import numpy as np

from ctid_cli.arrays import Array, BoolArray
from ctid_cli.inference.criteria import percent_from_r_squared
from ctid_cli.inference.fit import DeferredFields
from ctid_cli.inference.intervals import robust_deviation
from ctid_cli.signals.record import Record

#: Losses other than least squares.
RobustKind = Literal["huber", "tukey"]
#: Tuning constants of Huber's and Tukey's loss, in standard deviations: 95 % efficiency for normal errors.
BEND, END = 1.345, 4.685
#: Below this weight an error counts as an outlier of Huber's loss (beyond 2.69 standard deviations).
HALF = 0.5


@dataclass(frozen=True)
class Loss:
    """A loss for errors of a known scale."""

    kind: RobustKind
    #: Standard deviation of the errors without outliers [output unit].
    scale: float

    def weight(self, r: Array) -> Array:
        """Return ``psi(r)/r``, which is 1 for small errors."""
        z = np.abs(r) / self.scale
        if self.kind == "huber":
            return np.asarray(BEND / np.maximum(z, BEND))
        return np.maximum(1.0 - (z / END) ** 2, 0.0) ** 2

    def cost(self, r: Array) -> float:
        """Return ``2 sum rho(r)``, which is ``sum r^2`` if all errors are small [output unit^2]."""
        z = np.abs(r) / self.scale
        if self.kind == "huber":
            losses = np.where(z <= BEND, z**2, 2.0 * BEND * z - BEND**2)
        else:
            losses = END**2 / 3.0 * (1.0 - np.maximum(1.0 - (z / END) ** 2, 0.0) ** 3)
        return float(losses.sum()) * self.scale**2

    def slope(self, r: Array) -> Array:
        """Return ``psi'(r)``."""
        z = np.abs(r) / self.scale
        if self.kind == "huber":
            return (z <= BEND).astype(float)
        u = np.minimum((z / END) ** 2, 1.0)
        return (1.0 - u) * (1.0 - 5.0 * u)


@dataclass(frozen=True, eq=False)
class Weighting(DeferredFields):
    """Weights of the output errors of several records."""

    deferred: ClassVar[tuple[str, ...]] = ("weights", "pseudo_errors")

    losses: tuple[Loss, ...]
    #: Weights of the used samples of each record, 0 to 1 [-].
    weights: tuple[Array, ...] = field(repr=False)
    #: Pseudo-errors of the used samples of each record [output unit].
    pseudo_errors: tuple[Array, ...] = field(repr=False)

    @property
    def kind(self) -> RobustKind:
        """Kind of the loss."""
        return self.losses[0].kind

    @property
    def outliers(self) -> tuple[BoolArray, ...]:
        """Used samples of each record with a weight below one half for Huber's loss, of zero for Tukey's."""
        return tuple(w < HALF if self.kind == "huber" else w == 0.0 for w in self.weights)

    def outlier_times(self, records: Sequence[Record], used: Sequence[BoolArray]) -> list[Array]:
        """Return the instants of the outliers of each record."""
        return [record.t[use][out] for record, use, out in zip(records, used, self.outliers, strict=True)]

    def fit_percent(self, records: Sequence[Record], used: Sequence[BoolArray], residuals: Sequence[Array]) -> float:
        """Return the fit over the used samples without outliers, about the mean of each record [%]."""
        squares = spread = 0.0
        for record, use, out, r in zip(records, used, self.outliers, residuals, strict=True):
            y = record.y[use][~out]
            squares += float(np.sum(r[~out] ** 2))
            spread += float(np.sum((y - y.mean()) ** 2))
        return percent_from_r_squared(1.0 - squares / spread)


def scale_of(errors: Array, least: float) -> float:
    """Return a robust standard deviation of the errors that exceed ``least``, which excludes a system still at rest."""
    moving = errors[np.abs(errors) > least]
    return max(robust_deviation(moving), least) if moving.size else least


def weighted(losses: Sequence[Loss], errors: Sequence[Array], parameters: int) -> Weighting:
    """Return weights and pseudo-errors; samples of zero weight are ignored.

    Pseudo-errors include Huber's correction factor K for the number of parameters.
    """
    pairs = list(zip(losses, errors, strict=True))
    weights = tuple(loss.weight(r) for loss, r in pairs)
    slopes = np.concatenate([loss.slope(r) for loss, r in pairs])[np.concatenate(weights) > 0.0]
    mean = float(slopes.mean())
    factor = (1.0 + parameters / slopes.size * float(slopes.var()) / mean**2) / mean
    return Weighting(tuple(losses), weights, tuple(factor * w * r for w, (_, r) in zip(weights, pairs, strict=True)))
