r"""Output-error cost with everything a measured record brings: delay, initial state, offset, several experiments.

.. math:: y(t_k) = \frac{B}{A} u(t_k-\tau) + \frac{C}{A}\delta(t_k-t_s) + c + e_k

``C/A`` applied to an impulse at the first used instant ``t_s`` spans every free response of A, so the n coefficients of
C are the initial state, whatever happened before. C and the offset c belong to one experiment each, the rest is common.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ctid_cli.arrays import Array, BoolArray
from ctid_cli.estimation.iteration import Equations, inadmissible, solve_scaled
from ctid_cli.estimation.stability import with_stable_denominator
from ctid_cli.filtering.bank import standard_rows
from ctid_cli.filtering.filter_data import FilterData
from ctid_cli.inference.sensitivity import Structure


@dataclass(frozen=True)
class Layout:
    """Which numbers stand where in the parameter vector: coefficients, delay, then each experiment's own."""

    structure: Structure
    experiments: int = 1
    initial_state: bool = False
    offset: bool = False

    @property
    def own(self) -> int:
        """Number of parameters that belong to one experiment."""
        return self.structure.poles * self.initial_state + int(self.offset)

    @property
    def size(self) -> int:
        """Number of parameters."""
        return self.structure.size + self.experiments * self.own

    @property
    def names(self) -> tuple[str, ...]:
        """Parameter names; those of an experiment end in its number where there are several."""
        names = list(self.structure.names)
        for k in range(self.experiments):
            tail = f"_{k + 1}" if self.experiments > 1 else ""
            names += [f"x{i}{tail}" for i in range(1, self.structure.poles + 1)] * self.initial_state
            names += [f"offset{tail}"] * self.offset
        return tuple(names)

    def first(self, experiment: int) -> int:
        """Where the parameters of an experiment begin."""
        return self.structure.size + experiment * self.own


class OutputErrorProblem:
    """Sensitivities and output error of one or more records."""

    def __init__(
        self,
        data: Sequence[FilterData],
        layout: Layout,
        delay: float = 0.0,
        bounds: tuple[float, float] = (0.0, np.inf),
    ) -> None:
        self.data = tuple(data)
        self.layout = layout
        self.structure = layout.structure
        self.delay = delay
        self.bounds = bounds
        # The records with a unit step at the first used instant in the place of their input.
        self._steps = tuple(
            record._replace(
                tu=record.t[record.use][:1].copy(),
                u=np.ones(1),
                input_foh=False,
                interval=0.0,
                common_clock=False,
                y=np.zeros_like(record.y),
            )
            for record in self.data
        )

    @property
    def free(self) -> int:
        """Number of parameters to iterate on."""
        return self.layout.size

    @property
    def samples(self) -> int:
        """Number of samples in the sums."""
        return sum(record.count for record in self.data)

    def split(self, theta: Array) -> tuple[Array, Array, float]:
        """Denominator, numerator and delay [s] of a parameter vector."""
        n, m = self.structure.poles, self.structure.zeros
        delay = float(theta[n + m + 1]) if self.structure.delay else self.delay
        return np.concatenate(([1.0], theta[:n])), theta[n : n + m + 1], delay

    def own(self, theta: Array, experiment: int) -> tuple[Array, float]:
        """Initial state and offset of one experiment."""
        first = self.layout.first(experiment)
        own = theta[first : first + self.layout.own]
        n = self.structure.poles * self.layout.initial_state
        return own[:n], float(own[-1]) if self.layout.offset else 0.0

    def admissible(self, theta: Array) -> Array:
        """Reflect unstable denominators."""
        stable: Array = with_stable_denominator(theta, self.structure.poles)
        return stable

    def sensitivities(self, theta: Array) -> list[tuple[Array, Array]] | None:
        """Derivatives of the simulated output, and the output error, of each experiment."""
        a, b, delay = self.split(theta)
        if not np.isfinite(theta).all() or not self.bounds[0] <= delay <= self.bounds[1]:
            return None
        layout, n = self.layout, self.structure.poles
        result = []
        for k, record in enumerate(self.data):
            forced, eps = self._forced(record, a, b, delay)
            psi = np.zeros((eps.size, layout.size))
            psi[:, : self.structure.size] = forced
            state, offset = self.own(theta, k)
            first = layout.first(k)
            if layout.initial_state:
                free, filtered = _free_response(self._steps[k], a, state)
                psi[:, first : first + n] = free
                psi[:, :n] -= filtered
                eps -= free @ state
            if layout.offset:
                psi[:, first + layout.own - 1] = 1.0
                eps -= offset
            result.append((psi, eps))
        return result

    def _forced(self, record: FilterData, a: Array, b: Array, delay: float) -> tuple[Array, Array]:
        """Derivatives of ``B/A u(t - tau)`` to coefficients and delay, and y minus it."""
        n, structure = self.structure.poles, self.structure
        if structure.zeros < n:
            rows = standard_rows(record, a, b, delay)
            return rows[:, structure.sensitivity_rows] * structure.signs, rows[:, structure.error_row].copy()
        # Biproper: B/A = b0 + B'/A, and p^n/A u = u - sum a_i p^(n-i)/A u.
        rows = standard_rows(record, a, b[1:] - b[0] * a[1:], delay)
        filtered, u = rows[:, :n], rows[:, n]
        through = rows[:, n + 1 : 2 * n + 1] + b[0] * filtered
        highest = u - filtered[:, ::-1] @ a[1:]
        psi = np.column_stack([-through[:, ::-1], highest, filtered[:, ::-1]])
        return psi, rows[:, 3 * n + 1] - b[0] * u

    def equations(self, theta: Array) -> Equations:
        """Second moments of the iteration; instruments and regressors are both the sensitivities (Gauss-Newton)."""
        nothing: Equations = inadmissible(self.layout.size)
        parts = self.sensitivities(theta)
        if parts is None:
            return nothing
        hessian = sum((psi.T @ psi for psi, _ in parts), np.zeros((self.layout.size, self.layout.size)))
        gradient = sum((psi.T @ eps for psi, eps in parts), np.zeros(self.layout.size))
        squared_error = sum(float(eps @ eps) for _, eps in parts)
        power = sum(
            float(np.sum((record.y_used - eps) ** 2)) for record, (_, eps) in zip(self.data, parts, strict=True)
        )
        finite = np.isfinite(squared_error) and np.isfinite(hessian).all() and np.isfinite(gradient).all()
        return Equations(hessian, gradient, hessian, squared_error, power) if finite else nothing

    def linear_start(self, a: Array, delay: float) -> Array | None:
        """Best numerator, initial states and offsets for a given denominator and delay, by linear least squares."""
        n = self.structure.poles
        theta = np.zeros(self.layout.size)
        theta[:n] = a[1:]
        free = np.ones(self.layout.size, dtype=bool)
        free[:n] = False
        if self.structure.delay:
            theta[self.structure.size - 1] = delay
            free[self.structure.size - 1] = False
        return self._solved(theta, free, least_norm=True)

    def with_best_own(self, theta: Array) -> Array | None:
        """Best initial states and offsets for a given model, by linear least squares."""
        free = np.arange(self.layout.size) >= self.structure.size
        return self._solved(np.where(free, 0.0, theta), free)

    def _solved(self, theta: Array, free: BoolArray, least_norm: bool = False) -> Array | None:
        """Minimise over parameters that are zero and that the output depends on linearly."""
        if not free.any():
            return theta
        equations = self.equations(theta)
        if not np.isfinite(equations.squared_error):
            return None
        matrix = equations.hessian[np.ix_(free, free)]
        lengths = np.diag(matrix).copy()
        right = equations.instrument_error[free]
        solved, solution = solve_scaled(matrix, right, lengths, lengths, right.size)
        if not solved:
            if not least_norm:
                return None
            # Whether a singular matrix is exactly so is a matter of rounding: a start must not hang on that.
            scale = np.sqrt(np.where(lengths > 0, lengths, 1.0))
            solution = np.linalg.lstsq(matrix / scale / scale[:, None], right / scale, rcond=None)[0] / scale
        theta[free] = solution
        return theta


def _free_response(step: FilterData, a: Array, state: Array) -> tuple[Array, Array]:
    """``p^(n-1-j)/A delta`` for each coefficient of C, and ``p^(n-i)/A x_free`` for each a_i."""
    n = a.size - 1
    rows = standard_rows(step, a, state)
    # p^(k+1)/A of a step is p^k/A of the impulse; the highest power follows by division.
    filtered_step, through = rows[:, :n], rows[:, n + 1 : 2 * n + 1]
    powers = np.column_stack([filtered_step[:, 1:], 1.0 - filtered_step[:, ::-1] @ a[1:]])
    response_to_step = -rows[:, 3 * n + 1]
    filtered = np.column_stack([through[:, 1:], response_to_step - through[:, ::-1] @ a[1:]])
    return powers[:, ::-1], filtered[:, ::-1]
