r"""Test of a change of the parameters between the halves of a record, or between records.

With e and psi the residuals and sensitivities of a fit, whitened by a model of the noise, n the columns of the
parameters of single records (initial state, offset, drift), q an orthonormal basis of the other columns without n, and
``m_k(t)`` 1 in part k of the records and else 0, parameters that differ between the parts make

.. math:: e_t = n_t' \nu + \sum_k m_k(t)\, q_t' \delta_k + w_t .

This is a linear regression about the estimate, one step of Gauss and Newton for each part [1]_, and the hypothesis that
all ``delta_k`` are equal has an F-test.

References
----------
.. [1] D. W. K. Andrews, "Tests for parameter instability and structural change with unknown change point",
   *Econometrica* 61 (1993) 821-856. doi:10.2307/2951764
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array, BoolArray, IntArray
from ctid_cli.inference.intervals import student_quantile
from ctid_cli.inference.noise_model import NoiseModel, fit_noise_model, fit_residual_noise
from ctid_cli.inference.residual_tests import orthonormal
from ctid_cli.text import listed, probability

#: Significance level, and the one above which the noise is not estimated by the slower restricted likelihood. By Yule
#: and Walker's equations alone 60 samples of slow noise have a false alarm in .7 %.
LEVEL, CLEAR = 1e-3, 0.05
#: Directions of the parameters in which a part of the records has less than about this share of the information are not
#: tested.
LEAST_SHARE = 0.02
#: Fewest degrees of freedom of the residuals.
FEWEST = 10
#: Smaller relative changes may be errors of the simulation between samples.
SMALL = 1e-3
#: A static gain or delay that differs by this many standard errors is named before coefficients; most records named.
DISTINCT, LISTED = 3.0, 3


class Quantity(NamedTuple):
    """A quantity of a model with its derivatives by the free parameters."""

    name: str
    value: float
    gradient: Array
    #: Whether it is named before others, if it differs distinctly.
    first: bool = False


@dataclass(frozen=True)
class ParameterChange:
    """Parts of the records to which different parameters belong."""

    #: Subject of the sentence, such as ``The halves of the record``.
    what: str
    p_value: float
    #: Quantity that differs most, its values in the parts, and half-widths of their 95 % intervals.
    quantity: str
    values: tuple[float, ...]
    reach: tuple[float, ...]

    @property
    def sentence(self) -> str:
        """The change in words."""
        each = [f"{value:.4g} ± {reach:.2g}" for value, reach in zip(self.values, self.reach, strict=True)]
        order = np.argsort(self.values).tolist()
        shown = range(len(each)) if len(each) <= LISTED else (order[0], order[-1])
        values = [each[k] + f" in record {k + 1}" * (self.what == "The records") for k in shown]
        return f"{self.what} differ ({probability(self.p_value)}): {self.quantity} {listed(values)}"


def parameter_change(
    psi: Sequence[Array],
    residuals: Sequence[Array],
    common: BoolArray,
    quantities: Callable[[], Sequence[Quantity]],
) -> ParameterChange | None:
    """Return a change of the parameters that all records have in common; None if none is significant.

    The sensitivities psi of each record, shape (count, f), are along the free directions of the parameters; ``common``
    is the mask of those that change common ones. One of the quantities is named.
    """
    sizes, several = [len(block) for block in psi], len(psi) > 1
    count = sum(sizes)
    finite = all(np.isfinite(block).all() for block in (*psi, *residuals))
    if not (common.any() and finite and count - common.size - int(common.sum()) >= FEWEST and min(sizes) > 1):
        return None
    records = np.repeat(np.arange(len(sizes)), 2)
    # Numbers of the parts to which the halves of each record belong.
    splits = {f"The halves of the record{'s' * several}": np.tile([0, 1], len(sizes))}
    splits |= {"The records": records} if several else {}
    quick = _Halves.of(psi, residuals, common, fit_noise_model(residuals))
    suspects = [what for what, parts in splits.items() if quick.p_value(parts) < CLEAR]
    if not suspects:
        return None
    exact = _Halves.of(psi, residuals, common, fit_residual_noise(_normalised(psi), residuals))
    least, what = min((min(1.0, len(splits) * exact.p_value(splits[what])), what) for what in suspects)
    return exact.named(what, least, splits[what], quantities()) if least < LEVEL else None


def _normalised(psi: Sequence[Array]) -> list[Array]:
    """Return sensitivities with columns of full rank."""
    weights = orthonormal(np.concatenate(psi), 1e-10)
    return [block @ weights for block in psi]


@dataclass(frozen=True, eq=False)
class _Halves:
    """Triangular factors of whitened sensitivities and errors of the halves of each record, which have their products.

    Shapes (2 records, rows, columns).
    """

    own: Array
    basis: Array
    e: Array
    #: Derivatives of the coordinates along the basis by the common parameters.
    coordinates: Array
    common: BoolArray
    count: int

    @classmethod
    def of(cls, psi: Sequence[Array], residuals: Sequence[Array], common: BoolArray, noise: NoiseModel) -> "_Halves":
        """Whiten residuals and sensitivities, without the first samples of each record."""
        r, width, factors, count = noise.order, common.size + 1, [], 0
        for block, errors in zip(psi, residuals, strict=True):
            whole = np.column_stack([noise.innovations(column)[r:] for column in (*block.T, errors)])
            count += len(whole)
            for half in np.array_split(whole, 2):
                factor = np.linalg.qr(half, mode="r")
                factors.append(np.pad(factor, ((0, width - len(factor)), (0, 0))))
        rows = np.concatenate(factors)
        lengths = np.linalg.norm(rows, axis=0)
        lengths[lengths == 0.0] = 1.0
        columns = (rows / lengths)[:, :-1]
        own, values, _ = np.linalg.svd(columns[:, ~common], full_matrices=False)
        own = own[:, values > 1e-10]
        rest = columns[:, common] - own @ (own.T @ columns[:, common])
        basis, values, vectors = np.linalg.svd(rest, full_matrices=False)
        kept = values > 1e-8 * values[0]
        coordinates = (values[kept, None] * vectors[kept]) * lengths[:-1][common]
        return cls(own, basis[:, kept], rows[:, -1], coordinates, common, count - r)

    def _apart(self, parts: IntArray) -> list[Array]:
        """Return the basis in each part."""
        of = np.repeat(parts, self.e.size // parts.size)
        return [self.basis * (of == k)[:, None] for k in range(int(parts.max()) + 1)]

    def p_value(self, parts: IntArray) -> float:
        """Return the p-value of equal parameters in all parts."""
        from scipy.special import fdtrc

        together, apart = np.column_stack((self.own, self.basis)), np.column_stack(self._apart(parts)[1:])
        apart = apart - together @ (together.T @ apart)
        # For two parts the eigenvalues are the products of their shares in the information.
        values, vectors = np.linalg.eigh(apart.T @ apart)
        kept = values > LEAST_SHARE
        left = self.e - together @ (together.T @ self.e)
        explained = float(np.sum((vectors[:, kept].T @ (apart.T @ left)) ** 2 / values[kept]))
        size, unexplained = int(kept.sum()), float(left @ left) - explained
        freedom = self.count - together.shape[1] - size
        if not size or freedom < FEWEST or not unexplained > 0.0:
            return 1.0
        return float(fdtrc(size, freedom, explained / size / (unexplained / freedom)))

    def named(
        self, what: str, p_value: float, parts: IntArray, quantities: Sequence[Quantity]
    ) -> ParameterChange | None:
        """Return a significant change with the quantity that differs most; None if all changes are small."""
        columns = np.column_stack((self.own, *self._apart(parts)))
        inverse = np.linalg.pinv(columns.T @ columns, rcond=1e-10, hermitian=True)
        found = inverse @ (columns.T @ self.e)
        left, freedom = self.e - columns @ found, self.count - columns.shape[1]
        variance, width = float(left @ left) / freedom, self.basis.shape[1]
        places = np.split(np.arange(self.own.shape[1], columns.shape[1]), np.arange(width, columns.shape[1], width))
        best, change = (False, 0.0), None
        for quantity in quantities:
            along = np.linalg.lstsq(self.coordinates.T, quantity.gradient[self.common])[0]
            values = np.array([quantity.value + along @ found[own] for own in places if own.size])
            errors = np.sqrt([variance * along @ inverse[np.ix_(own, own)] @ along for own in places if own.size])
            low, high = int(np.argmin(values)), int(np.argmax(values))
            difference, error = float(values[high] - values[low]), float(np.hypot(errors[low], errors[high]))
            if not (error > 0.0 and difference > SMALL * float(np.abs(values).max())):
                continue
            rank = quantity.first and difference > DISTINCT * error, difference / error
            if rank > best:
                best, reach = rank, (student_quantile(freedom) * errors).tolist()
                change = ParameterChange(what, p_value, quantity.name, tuple(values.tolist()), tuple(reach))
        return change
