r"""Known coefficients of a model; those of the denominator are constraints on the poles.

With all poles in the left half-plane every coefficient ``a_i`` is positive, and in the logarithms of speeds and
dampings ``ln a_i`` is convex and nearly linear. A few Newton steps therefore solve ``ln a_i = ln v_i`` from almost any
point, and searches move along this surface. Known coefficients of the numerator do not constrain the poles: they are
eliminated with the others (:mod:`~ctid_cli.estimation.optimum.projection`).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ctid_cli.arrays import Array, BoolArray, ComplexArray, IntArray
from ctid_cli.estimation.optimum.box import Box, Point, at_bounds, moved_by
from ctid_cli.inference.sensitivities import SumStructure
from ctid_cli.models.additive import Term

#: Largest number of Newton steps to the constraint, and its tolerance in ``ln a_i``.
MOST_STEPS, MET, ROUNDED = 50, 1e-14, 1e-11
#: Multipliers of bounds and singular values of constraints below this fraction of the largest are zero.
ZERO = 1e-12


@dataclass(frozen=True, eq=False)
class KnownCoefficients:
    """Values of ``a_1 ... a_n`` and ``b_0 ... b_m``, NaN for free coefficients.

    Those of several denominators, and of several numerators, are concatenated.
    """

    denominator: Array
    numerator: Array
    #: Number of poles of each of several denominators, and whether these are monic or have constant terms of 1.
    #: Numerators are always in descending powers.
    parts: tuple[int, ...] = ()
    monic: bool = True

    @classmethod
    def of(
        cls, poles: int, zeros: int, values: Mapping[int, float], parts: tuple[int, ...] = ()
    ) -> "KnownCoefficients":
        """Return the known coefficients from values indexed by ``a_1 ... a_n, b_0 ... b_m``."""
        theta = np.full(poles + zeros + 1, np.nan)
        theta[list(values)] = list(values.values())
        return cls(theta[:poles], theta[poles:], parts)

    @classmethod
    def of_sum(cls, terms: tuple[Term, ...], values: Mapping[int, float]) -> "KnownCoefficients":
        """Return the known coefficients from values indexed by the parameters of a sum."""
        structure = SumStructure(terms)
        theta = np.full(structure.size, np.nan)
        theta[list(values)] = list(values.values())
        parts = tuple(term.poles for term in terms)
        return cls(theta[structure.denominators], theta[structure.numerators], parts, False)

    @property
    def size(self) -> int:
        """Number of coefficients."""
        return self.denominator.size + self.numerator.size

    @property
    def given(self) -> BoolArray:
        """Mask of the known coefficients among ``a_1 ... a_n, b_0 ... b_m``."""
        return np.isfinite(np.concatenate((self.denominator, self.numerator)))

    @cached_property
    def places(self) -> IntArray:
        """Indices of the known coefficients of the denominator."""
        return np.flatnonzero(np.isfinite(self.denominator))

    @property
    def poles(self) -> ComplexArray:
        """Poles, if all coefficients of the denominators are known."""
        each = np.split(self.denominator, np.cumsum(self.parts)[:-1]) if self.parts else [self.denominator]
        whole = [np.append(1.0, a) if self.monic else np.append(a[::-1], 1.0) for a in each]
        return np.concatenate([np.roots(a) for a in whole]).astype(complex)

    @property
    def all_poles(self) -> bool:
        """Whether all denominators are known, so that their poles are constant, even if ill-conditioned."""
        return self.places.size == self.denominator.size > 0

    def slopes(self, point: Point, size: int) -> Array:
        """Return the derivatives of ``ln a_i`` by the coordinates, including the delay, shape (k, size)."""
        n, slopes = point.poles.size, np.zeros((self.places.size, size))
        if self.all_poles:
            slopes[:, :n] = np.eye(n)
        elif self.places.size:
            a = point.coefficients[self.places]
            slopes[:, :n] = point.coefficient_slopes()[self.places] / a[:, None]
        return slopes

    def met(self, point: Point, box: Box) -> Point | None:
        """Return the closest point, in logarithms, with the known denominator coefficients; None if not found."""
        if not self.places.size or self.all_poles:
            return point
        values, last = np.log(self.denominator[self.places]), np.inf
        for _ in range(MOST_STEPS):
            error = np.log(point.coefficients[self.places]) - values
            size = float(np.abs(error).max())
            if size <= MET or ROUNDED >= size >= last:
                return point
            step = self._least_step(point, error, box)
            if not step.any():
                return None
            step /= max(1.0, float(np.abs(step).max()))
            moved = moved_by(point, np.append(step, np.zeros(len(box.free_delays))), box)
            point, last = moved.with_delays(point.delays), size
        return None

    def _least_step(self, point: Point, error: Array, box: Box) -> Array:
        """Return the least-norm Newton step to the constraint; coordinates that would leave the set stay at a bound."""
        n = point.poles.size
        slopes, (low, high) = self.slopes(point, n), at_bounds(point, box)
        free, step = np.ones(n, dtype=bool), np.zeros(n)
        while free.any():
            step[:] = 0.0
            step[free] = -np.linalg.lstsq(slopes[:, free], error)[0]
            leaving = free & ((low[:n] & (step < 0)) | (high[:n] & (step > 0)))
            if not leaving.any():
                break
            free &= ~leaving
        return step * free

    def held(self, slope: Array, slopes: Array, low: BoolArray, high: BoolArray) -> BoolArray:
        """Return which coordinates at a bound are held there, that is those with a positive multiplier.

        ``slope + slopes' l = mu_low - mu_high`` with nonnegative ``mu``, by least squares: the residual is the steepest
        descent that satisfies the constraint and the bounds.
        """
        if not self.places.size:
            return (low & (slope > 0)) | (high & (slope < 0))
        from scipy.optimize import lsq_linear

        held, k = np.zeros(slope.size, dtype=bool), len(slopes)
        places = np.flatnonzero(low | high)
        bounds = np.zeros((slope.size, places.size))
        bounds[places, np.arange(places.size)] = np.where(low[places], -1.0, 1.0)
        if places.size:
            limits = np.concatenate((np.full(k, -np.inf), np.zeros(places.size)))
            found = lsq_linear(np.hstack((slopes.T, bounds)), -slope, (limits, np.inf), method="bvls").x
            held[places] = found[k:] > ZERO * float(np.abs(slope).max())
        return held


def null_space(slopes: Array) -> Array:
    """Return an orthonormal basis of the null space, shape (f, r)."""
    if not slopes.size:
        return np.eye(slopes.shape[1])
    _, values, right = np.linalg.svd(slopes)
    rank = int(np.count_nonzero(values > ZERO * values[0]))
    return np.asarray(right[rank:].T)


#: No known coefficients.
NOTHING = KnownCoefficients(np.zeros(0), np.zeros(0))
