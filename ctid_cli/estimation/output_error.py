r"""Output-error cost with everything a measured record brings: delay, initial state, offset, several experiments.

.. math:: y(t_k) = \frac{B}{A} u(t_k-\tau) + \frac{C}{A}\delta(t_k-t_s) + c + e_k

``C/A`` applied to an impulse at the first used instant ``t_s`` spans every free response of A, so the n coefficients of
C are the initial state, whatever happened before. C and the offset c belong to one experiment each, the rest is common.
"""

from dataclasses import dataclass

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.estimation.optimum.box import ANYWHERE, point_of
from ctid_cli.estimation.optimum.chain import Chain, chain_dynamics, numerators
from ctid_cli.estimation.optimum.projection import Problem
from ctid_cli.estimation.optimum.triangle import Columns, rows_of
from ctid_cli.inference.sensitivities import Structure
from ctid_cli.models.transfer_function import TransferFunction


@dataclass(frozen=True)
class Layout:
    """Which numbers stand where in the parameter vector: coefficients, delay, then each experiment's own."""

    structure: Structure
    experiments: int = 1
    initial_state: bool = False
    offset: bool = False
    #: Poles at the origin: that many of the last coefficients of the denominator are zero.
    integrators: int = 0

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

    def theta(self, model: TransferFunction) -> Array:
        """The parameters of a model of this structure, and zeros for what belongs to the experiments."""
        theta, n = np.zeros(self.size), self.structure.poles
        theta[:n] = model.denominator[1:]
        last = n + self.structure.zeros + 1
        theta[last - model.numerator.size : last] = model.numerator
        if self.structure.delay:
            theta[last] = model.delay
        return theta

    def own_of(self, theta: Array, experiment: int) -> tuple[Array, float]:
        """Initial state and offset of one experiment."""
        first = self.first(experiment)
        own = theta[first : first + self.own]
        return own[: self.structure.poles * self.initial_state], float(own[-1]) if self.offset else 0.0

    def first(self, experiment: int) -> int:
        """Where the parameters of an experiment begin."""
        return self.structure.size + experiment * self.own


def sensitivities(problem: Problem, layout: Layout, theta: Array, delay: float) -> list[tuple[Array, Array]]:
    """Derivatives of the simulated output to the parameters, and the output error, at the used samples of each record.

    The delay is that of theta where it is a parameter. The last coefficients of the denominator are zero where the
    problem has integrators.
    """
    structure, n, m = layout.structure, layout.structure.poles, layout.structure.zeros
    a, b = np.concatenate(([1.0], theta[:n])), theta[n : n + m + 1]
    stable = np.roots(a[: n + 1 - problem.integrators]).astype(complex)
    point = point_of(stable, theta[n + m + 1] if structure.delay else delay, ANYWHERE)
    sections = problem.sections(point.speed, point.damping)
    F, g = chain_dynamics(*sections)
    # From the states to p^(n-1)/A ... 1/A. With n zeros B/A = b0 + B'/A, and p^n/A u = u - sum a_i p^(n-i)/A u.
    powers = np.linalg.inv(numerators(*sections))
    direct = b[0] if m == n else 0.0
    output = ((b - direct * a)[1:] if m == n else np.concatenate((np.zeros(n - 1 - m), b))) @ powers
    columns = Columns.of(n, second=True, free=layout.initial_state, offset=layout.offset)
    result = []
    for k, (data, period) in enumerate(zip(problem.records, problem.periods, strict=True)):
        first = layout.first(k)
        own = theta[first : first + layout.own]
        state = own[:n] if layout.initial_state else np.zeros(n)
        form = Chain(*sections, F, g, F, g).driving(output, direct, state @ powers)
        # Columns of the rows that are wanted, each a combination of the states, the input and what else stands there.
        wanted = np.zeros((columns.size, layout.size + 1))
        states, driven, now, measured = wanted[:n], wanted[n : 2 * n], wanted[columns.u], wanted[columns.u + 1]
        driven[:, :n] = -powers.T
        filtered = powers.T
        coefficients = np.column_stack((-filtered @ a[1:], filtered))[:, n - m :]
        states[:, n : n + m + 1] = coefficients
        if m == n:
            now[n] = 1.0
        if structure.delay:
            states[:, n + m + 1], now[n + m + 1] = -(output @ F), -(output @ g)
        if layout.initial_state:
            alone, driven_alone = wanted[columns.free_states][:n], wanted[columns.free_states][n:]
            driven_alone[:, :n] = -powers.T
            alone[:, first : first + n] = powers.T
        if layout.offset:
            wanted[-1, first + layout.own - 1] = 1.0
        states[:, -1], now[-1], measured[-1] = -output, -direct, 1.0
        wanted[:, -1] -= wanted[:, first : first + layout.own] @ own
        rows = np.vstack([part.T @ wanted for part in rows_of(form, columns, point.delay, data, period)])
        result.append((rows[:, :-1], rows[:, -1].copy()))
    return result
