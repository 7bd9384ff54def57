r"""Derivatives of the simulated output by the parameters.

With ``theta = (a_1 … a_n, b_0 … b_m)`` and the delay last, the derivatives of the simulated output x are

.. math:: \partial x/\partial a_i = -p^{n-i}/A\,x, \quad \partial x/\partial b_j = p^{m-j}/A\,u(t-\tau), \quad
          \partial x/\partial\tau = -p\,x.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from ctid_cli.arrays import Array, IndexArray
from ctid_cli.errors import DataError
from ctid_cli.filtering.bank import standard_rows
from ctid_cli.filtering.filter_data import filter_data
from ctid_cli.filtering.simulate import feedthrough
from ctid_cli.filtering.submodels import SubmodelFilter
from ctid_cli.models.additive import AdditiveModel
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record


@dataclass(frozen=True)
class Structure:
    """Degrees of a transfer function and whether its delay is a parameter."""

    poles: int
    zeros: int
    delay: bool = False

    @property
    def size(self) -> int:
        """Number of parameters."""
        return self.poles + self.zeros + 1 + int(self.delay)

    @property
    def names(self) -> tuple[str, ...]:
        """Parameter names in the order of theta: ``a1 … an, b0 … bm`` and ``delay``."""
        names = [f"a{i}" for i in range(1, self.poles + 1)] + [f"b{j}" for j in range(self.zeros + 1)]
        return tuple(names + ["delay"] * self.delay)

    @cached_property
    def sensitivity_rows(self) -> IndexArray:
        """Standard rows of dx/dtheta, up to the sign."""
        n, m = self.poles, self.zeros
        rows = [n + 1 + n - i for i in range(1, n + 1)] + [m - j for j in range(m + 1)]
        return np.array(rows + [3 * n + 2] * self.delay, dtype=np.intp)

    @cached_property
    def regressor_rows(self) -> IndexArray:
        """Standard rows of the regressor: as the sensitivities, the measured output in the model output's place."""
        rows = self.sensitivity_rows.copy()
        rows[: self.poles] += self.poles
        return rows

    @cached_property
    def signs(self) -> Array:
        """Signs of the rows above."""
        signs = np.ones(self.size)
        signs[: self.poles] = -1.0
        if self.delay:
            signs[-1] = -1.0
        return signs

    @property
    def error_row(self) -> int:
        """Standard row of the output error."""
        return 3 * self.poles + 1

    def hessian(self, moments: Array) -> Array:
        """``sum psi psi'`` from the second moments of the standard rows."""
        rows = self.sensitivity_rows
        return np.asarray(moments[np.ix_(rows, rows)] * np.outer(self.signs, self.signs))


def sensitivities(
    model: AdditiveModel | TransferFunction,
    signal: HeldSignal,
    times: ArrayLike,
    zeros: int | None = None,
    *,
    estimate_delay: bool = False,
) -> Array:
    """Derivatives of a model's output at given times by its parameters, of a fraction also by its delay."""
    instants = np.asarray(times, dtype=float)
    data = filter_data(Record(instants, np.zeros(instants.size), signal), start=-np.inf)
    if isinstance(model, AdditiveModel):
        found = SubmodelFilter(data, model.terms, model.delay).rows(model.theta)
        if found is None:
            raise DataError("the response of the system is not finite")
        return found[0]
    structure = Structure(model.order, model.numerator.size - 1 if zeros is None else zeros, estimate_delay)
    if model.order == 0:
        return np.column_stack([signal.at(instants - model.delay), *[np.zeros(instants.size)] * estimate_delay])
    n, (direct, rest) = model.order, feedthrough(model)
    rows = standard_rows(data, model.denominator, rest if direct else model.numerator, model.delay)
    if structure.zeros == n:
        # p^n/A u = u - sum of a_i p^(n-i)/A u, and x is what passes at once besides. Between the breaks of a held input
        # the derivative by the delay has nothing of that.
        rows[:, n + 1 : 2 * n + 1] += direct * rows[:, :n]
        rows[:, n] -= rows[:, n - 1 :: -1] @ model.denominator[1:]
    return np.asarray(rows[:, structure.sensitivity_rows] * structure.signs)
