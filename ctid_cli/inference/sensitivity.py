r"""Which standard rows are the output's sensitivities to the parameters.

With ``theta = (a_1 … a_n, b_0 … b_m)`` and the delay last, the derivatives of the simulated output x are

.. math:: \partial x/\partial a_i = -p^{n-i}/A\,x, \quad \partial x/\partial b_j = p^{m-j}/A\,u(t-\tau), \quad
          \partial x/\partial\tau = -p\,x.
"""

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

    def hessian(self, moments: Array) -> Array:
        """``sum psi psi'`` from the second moments of the standard rows."""
        rows = self.sensitivity_rows
        return np.asarray(moments[np.ix_(rows, rows)] * np.outer(self.signs, self.signs))
