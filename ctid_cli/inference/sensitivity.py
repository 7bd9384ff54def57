r"""Which standard rows are the output's sensitivities to the parameters.

With ``theta = (a_1 … a_n, b_0 … b_m)`` and the delay last, the derivatives of the simulated output x are

.. math:: \partial x/\partial a_i = -p^{n-i}/A\,x, \quad \partial x/\partial b_j = p^{m-j}/A\,u(t-\tau), \quad
          \partial x/\partial\tau = -p\,x.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ctid_cli.arrays import Array, IndexArray


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

    @cached_property
    def _hessian_index(self) -> IndexArray:
        return self._flat(self.sensitivity_rows, self.sensitivity_rows)

    @cached_property
    def _mixed_index(self) -> IndexArray:
        return self._flat(self.sensitivity_rows, self.regressor_rows)

    @cached_property
    def _error_index(self) -> IndexArray:
        return self._flat(self.sensitivity_rows, np.array([self.error_row]))[:, 0]

    def _flat(self, rows: IndexArray, columns: IndexArray) -> IndexArray:
        """Places of a submatrix in the flattened moments: twice as fast to take as row and column lists."""
        return rows[:, None] * (3 * self.poles + 3) + columns

    @cached_property
    def _sign_products(self) -> Array:
        return np.outer(self.signs, self.signs)

    def hessian(self, moments: Array) -> Array:
        """Gauss-Newton matrix ``sum psi psi'`` of half the squared output error."""
        product: Array = moments.take(self._hessian_index) * self._sign_products
        return product

    def instrument_regressor(self, moments: Array) -> Array:
        """Instrumental-variable matrix ``sum psi phi'``."""
        product: Array = moments.take(self._mixed_index) * self._sign_products
        return product

    def instrument_error(self, moments: Array) -> Array:
        """``sum psi eps``, minus the gradient of half the squared output error."""
        product: Array = moments.take(self._error_index) * self.signs
        return product

    def squared_error(self, moments: Array) -> float:
        """Sum of squared output errors [output unit^2]."""
        return float(moments[self.error_row, self.error_row])

    def output_power(self, moments: Array, b: Array) -> float:
        """Sum of squares of the simulated output."""
        rows = slice(0, self.zeros + 1)
        rising = b[::-1]
        return float(rising @ moments[rows, rows] @ rising)
