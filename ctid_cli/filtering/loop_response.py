r"""Response of a loop to its reference, and its exact derivatives by the plant parameters and the initial state.

The plant is ``B/(p^l A) exp(-tau p)`` with ``theta = (a_1 … a_n, b_0 … b_m, tau)`` and monic A; it need not be stable,
if the loop is. A discrete controller acts at the samples and holds the input between them. With a controller in
continuous time the loop is one linear system, driven by the held reference on any clock.

The matrices of the plant, or of the whole loop in continuous time, are analytic in theta: their derivatives are the
imaginary parts at ``theta + i step``, without cancellation (W. Squire and G. Trapp, *Using complex variables to
estimate derivatives of real functions*, SIAM Review 40 (1998) 110-112). With ``z`` and ``u`` the plant's states and
input, the derivatives ``dz`` of the signals are those of the loop without reference, with ``dF z + dg u`` added to the
next states and ``dc z + dd u`` added to the output.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from ctid_cli.arrays import Array, ComplexArray
from ctid_cli.filtering.bank import chain_states
from ctid_cli.filtering.filter_data import FilterData, split_delay
from ctid_cli.filtering.loop import law_of, loop_pass, sampled_poles, sampled_radius
from ctid_cli.filtering.realisation import exponential_minus_identity, time_scale
from ctid_cli.filtering.simulate import SampledModel
from ctid_cli.models.controller import ContinuousController, DiscreteController

#: Complex step; its square is negligible.
TINY = 1e-30


class LoopRows(NamedTuple):
    """Output at all samples, and its derivatives by the parameters, shape (N, p)."""

    output: Array
    slopes: Array


class _Plant(NamedTuple):
    """``z' = w0 (F z + g u)``, ``x = c z + d u`` in the time unit 1/w0, at parameters that may be complex."""

    dynamics: Any
    gain: Any
    output: Any
    direct: Any


@dataclass(frozen=True, eq=False)
class LoopResponse:
    """A loop around a plant of given structure, with its reference."""

    #: The clock, with the reference as the input.
    data: FilterData
    controller: DiscreteController | ContinuousController
    at_controller: bool
    poles: int
    zeros: int
    integrators: int = 0
    #: Whether the controller is at rest at the first sample in any case.
    controller_at_rest: bool = False

    @property
    def continuous(self) -> bool:
        """Whether the controller acts in continuous time."""
        return isinstance(self.controller, ContinuousController)

    def rows(self, theta: Array, count: int, cell: int | None = None, state: Array | None = None) -> LoopRows:
        """Return the output from a state, by default of rest, and its derivatives by the first ``count`` parameters.

        ``cell`` is the sampling interval to which a delay of a whole number of intervals belongs, because the
        derivatives have a kink there. A state has those of plant and controller, and the delayed inputs at the first
        sample.
        """
        if state is not None:
            # That of the plant is p^(n-1)/A u … 1/A u in seconds, independent of the time unit of its companion form.
            n = self.poles + self.integrators
            state = np.concatenate((state[:n] * self._scale(theta) ** np.arange(1.0, n + 1.0), state[n:]))
            if self.controller_at_rest:
                state = np.insert(state, n, np.zeros(self.controller.denominator.size - 1))
        return self._continuous(theta, count, state) if self.continuous else self._discrete(theta, count, cell, state)

    def free(self, theta: Array, cell: int | None = None) -> Array:
        """Return the free responses to each entry of the initial state, shape (N, f)."""
        unforced = replace(self, data=self.data._replace(u=np.zeros_like(self.data.u)))
        size = self.poles + self.integrators
        if not self.controller_at_rest:
            size += self.controller.denominator.size - 1
        if not self.continuous:
            size += self._sampled(theta, cell).shift
        return np.column_stack([unforced.rows(theta, 0, cell, unit).output for unit in np.eye(size)])

    def radius(self, theta: Array) -> float:
        """Return the largest magnitude of the poles of the loop over one sampling interval; it is stable below 1.

        It is infinite if the response of the model overflows within the interval.
        """
        if isinstance(self.controller, DiscreteController):
            try:
                return sampled_radius(self._sampled(theta, None), self.controller)
            except np.linalg.LinAlgError:
                return np.inf
        interval = self.data.interval or float(np.median(np.diff(self.data.t)))
        return float(np.exp(np.linalg.eigvals(self._whole(theta)[0]).real.max(initial=-np.inf) * interval))

    def sensitivity(self, theta: Array) -> tuple[ComplexArray, ComplexArray] | None:
        """Return zeros and poles of the sampled sensitivity function; None on an irregular clock.

        With a discrete controller the zeros are the poles of plant and controller. In continuous time the noise is held
        between the samples, as in simulations, and the loop without noise is ``1 - T`` of a held input.
        """
        if not isinstance(self.controller, DiscreteController):
            if not self.data.interval:
                return None
            F, g, c, d = replace(self, at_controller=True)._whole(theta)
            transition, from_noise = _held(_Plant(F, g, c, d), self.data.interval)
            zeros = np.linalg.eigvals(transition + np.outer(from_noise, c) / (1.0 - d))
            return zeros.astype(complex), np.linalg.eigvals(transition).astype(complex)
        plant = self._sampled(theta, None)
        each = plant.state_space()[0], self.controller.state_space()[0]
        separate = np.concatenate([np.linalg.eigvals(dynamics) for dynamics in each])
        return separate.astype(complex), sampled_poles(plant, self.controller)

    # --- the plant ---------------------------------------------------------------------------------

    def _scale(self, theta: Array) -> float:
        return time_scale(np.concatenate(([1.0], np.real(theta[: self.poles]), np.zeros(self.integrators))))

    def _plant(self, theta: Any, w0: float) -> _Plant:
        """Return the companion form, whose states are ``p^(n-1)/A u … 1/A u``."""
        n = self.poles + self.integrators
        a, b = np.zeros(n, theta.dtype), np.zeros(n + 1, theta.dtype)
        a[: self.poles], b[n - self.zeros :] = theta[: self.poles], theta[self.poles : self.poles + self.zeros + 1]
        powers = w0 ** -np.arange(1.0, n + 1.0)
        dynamics = np.eye(n, k=-1).astype(theta.dtype)
        dynamics[:1] -= a * powers
        return _Plant(dynamics, np.eye(n)[0].astype(theta.dtype), (b[1:] - b[0] * a) * powers, b[0])

    def _sampled(self, theta: Any, cell: int | None) -> SampledModel:
        """Return the plant over a sampling interval, with the input held."""
        interval, delay = self.data.interval, theta[self.poles + self.zeros + 1]
        if cell is None:
            shift, fraction = split_delay(float(np.real(delay)), interval)
            part = fraction * interval - (delay - np.real(delay))
        else:
            shift = cell + 1
            part = shift * interval - delay
        w0 = self._scale(theta)
        plant = self._plant(theta, w0)
        transition, from_input = _held(plant, w0 * interval)
        part_way, from_held = _held(plant, w0 * part)
        direct = plant.direct + plant.output @ from_held
        return SampledModel(transition, from_input, plant.output @ part_way, direct, shift)

    # --- a discrete controller ---------------------------------------------------------------------

    @cached_property
    def _law(self) -> tuple[Array, Array, Array, float]:
        assert isinstance(self.controller, DiscreteController)
        return law_of(self.controller)

    def _discrete(self, theta: Array, count: int, cell: int | None, state: Array | None) -> LoopRows:
        plant, r, law = _real(self._sampled(theta, cell)), self.data.u, self._law
        n, none = plant.from_input.size, np.zeros_like(r)
        state = np.zeros(n + law[1].size + plant.shift) if state is None else state
        late = state[n + law[1].size :].copy()
        start = state[:n].copy(), state[n : n + law[1].size].copy(), late
        u, y, z = loop_pass(plant, law, r, none, self.at_controller, start=start)
        arriving = np.concatenate((late, u))[: r.size]
        slopes = np.empty((r.size, count))
        for j in range(count):
            by = _slope(self._sampled(_stepped(theta, j), cell))
            added = z @ by.output + by.direct * arriving
            moved = by.transition.any() or by.from_input.any()
            push = z @ by.transition.T + np.outer(arriving, by.from_input) if moved else None
            slopes[:, j] = loop_pass(plant, law, none, added, self.at_controller, push=push)[1] + added
        return LoopRows(y, slopes)

    # --- a controller in continuous time -----------------------------------------------------------

    def _whole(self, theta: Any) -> tuple[Any, Any, Any, Any]:
        """Return ``X' = F X + g r``, ``y = c X + d r`` of the loop without a delay, in seconds."""
        w0 = self._scale(theta)
        F, g, c, d = self._plant(theta, w0)
        A, B, C, D = self.controller.state_space()
        closing = 1.0 / (1.0 + D[0, 0] * d)
        share = D[0, 0] if self.at_controller else 1.0
        u = closing * np.concatenate((-D[0, 0] * c, C[0]))
        y = np.concatenate((c, np.zeros(len(A)))) + d * u
        n = g.size
        dynamics = np.zeros((n + len(A),) * 2, u.dtype)
        dynamics[:n], dynamics[n:] = np.outer(w0 * g, u), -np.outer(B[:, 0], y)
        dynamics[:n, :n] += w0 * F
        dynamics[n:, n:] += A
        direct = d * closing * share
        from_reference = (1.0 if self.at_controller else 0.0) - direct
        return dynamics, np.concatenate((w0 * g * closing * share, B[:, 0] * from_reference)), y, direct

    def _continuous(self, theta: Array, count: int, state: Array | None) -> LoopRows:
        from scipy.linalg import schur  # slow to import

        F, g, c, d = self._whole(theta)
        size, data, start = g.size, self.data, np.zeros(g.size) if state is None else state
        # Passes take dynamics that are zero above their first superdiagonal: a real Schur form from below.
        Q = schur(F.T, output="real")[1]
        F, g, c, start = np.tril(Q.T @ F @ Q, 1), Q.T @ g, c @ Q, Q.T @ start
        states = chain_states(F, g, 1.0, data, 0.0, start)
        X, r = states[:, :size], states[:, size]
        slopes = np.empty((data.t.size, count))
        for j in range(count):
            by_F, by_g, by_c, by_d = (np.imag(part) / TINY for part in self._whole(_stepped(theta, j)))
            slopes[:, j] = X @ (by_c @ Q) + by_d * r
            if by_F.any() or by_g.any():
                double = np.block([[F, np.zeros_like(F)], [Q.T @ by_F @ Q, F]])
                gain, begin = np.concatenate((g, Q.T @ by_g)), np.concatenate((start, np.zeros(size)))
                slopes[:, j] += chain_states(double, gain, 1.0, data, 0.0, begin)[:, size:-1] @ c
        return LoopRows(X @ c + d * r, slopes)


def _held(plant: _Plant, step: Any) -> tuple[Any, Any]:
    """Return the transition over a step in the plant's time unit, and the contribution of the held input."""
    n = plant.gain.size
    augmented = np.zeros((n + 1, n + 1), plant.dynamics.dtype)
    augmented[:n, :n], augmented[:n, n] = plant.dynamics, plant.gain
    change = exponential_minus_identity(augmented * step)
    return change[:n, :n] + np.eye(n), change[:n, n]


def _stepped(theta: Array, place: int) -> Any:
    stepped = theta.astype(complex)
    stepped[place] += TINY * 1j
    return stepped


def _real(plant: SampledModel) -> SampledModel:
    """Return a sampled plant with real arrays for the kernel."""
    F, g, c = (np.ascontiguousarray(np.real(part)) for part in plant[:3])
    return SampledModel(F, g, c, float(np.real(plant.direct)), plant.shift)


def _slope(plant: SampledModel) -> SampledModel:
    """Return the derivatives of a sampled plant from one at stepped parameters."""
    F, g, c = (np.imag(part) / TINY for part in plant[:3])
    return SampledModel(F, g, c, float(np.imag(plant.direct)) / TINY, plant.shift)
