r"""A continuous-time model in a loop with a controller in discrete or continuous time, or a relay.

The reference r enters before the controller, ``u = C (r - y)``, or behind it, ``u = r - C y``. The measured output is
``y = x + v``, and x is the response of the model to the input u, which a discrete controller holds. A relay switches
at the sampling instants only. All signals are exact at these instants.
"""

from typing import NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike

from ctid_cli.arrays import Array, ComplexArray
from ctid_cli.errors import DataError
from ctid_cli.filtering.filter_data import plain_array
from ctid_cli.filtering.simulate import SampledModel, sampled_model, simulate
from ctid_cli.models.additive import AdditiveModel
from ctid_cli.models.controller import ContinuousController, DiscreteController, Relay
from ctid_cli.models.factoring import unfactored
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.checks import require_choice, require_positive
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Controller, Enters

#: Below this fraction of its terms, 1 + (direct loop gain) is rounding.
NO_GAIN = 1e-12
#: Weight of the states of a stabilising controller, relative to those of input and output.
LITTLE = 1e-6
#: Why a loop in continuous time is not simulated with a delay.
NO_DELAY = (
    "a loop in continuous time with a delay in it has no finite state; the delay must be 0, or the controller discrete"
)
#: Zero controller for a loop with a relay, and zero relay for a loop with a controller.
NOTHING, NO_RELAY = DiscreteController([0.0], [1.0]), (0.0, 0.0, 0.0)


#: State space of a controller for the kernel.
Law = tuple[Array, Array, Array, float]


class LoopSignals(NamedTuple):
    """Signals of a closed loop at the sampling instants, each of shape (N,)."""

    #: Input of the model [input unit].
    u: Array
    #: Its output without the noise [output unit].
    x: Array


def simulate_loop(
    model: AdditiveModel | TransferFunction,
    controller: Controller | Relay,
    reference: ArrayLike,
    noise: ArrayLike,
    interval: float,
    enters: Enters = "controller",
) -> LoopSignals:
    """Return input and noise-free output of a loop that is at rest before the first sample.

    Parameters
    ----------
    model : AdditiveModel or TransferFunction
        The plant; any proper model, any delay.
    controller : Controller or Relay
        The controller, which computes the input from reference and output; in continuous time with reference and
        noise held (zoh).
    reference : array_like, shape (N,)
        r at the sampling instants [output unit; input unit if it enters behind the controller].
    noise : array_like, shape (N,) or ()
        v, added to the output before the controller [output unit]; 0 for none.
    interval : float
        Sampling interval [s].
    enters : {"controller", "input"}, default "controller"
        Whether r enters before or behind the controller.

    Returns
    -------
    LoopSignals
        u and x; the measured output is ``x + noise``.

    Raises
    ------
    DataError
        If the loop has no solution (a direct loop gain of -1), a relay is combined with a model that has direct
        feedthrough, the signals overflow, or the lengths of reference and noise differ.
    ValueError
        If the interval is not positive or `enters` is not one of its values.

    Examples
    --------
    >>> plant, half = TransferFunction([1.0], [1.0, 1.0]), DiscreteController([0.5], [1.0])
    >>> simulate_loop(plant, half, [1.0, 1.0, 1.0], 0.0, 0.5).u.round(4)
    array([0.5   , 0.4016, 0.3613])
    """
    require_choice("enters", enters, get_args(Enters))
    r = plain_array(reference)
    v = plain_array(noise)
    if v.ndim == 0:
        v = np.full(r.shape, v)
    if r.ndim != 1 or v.shape != r.shape:
        raise DataError(
            f"reference and noise of a loop must be lists of equal length; got shapes {r.shape} and {v.shape}"
        )
    if isinstance(controller, ContinuousController):
        require_positive("the sampling interval", interval, "s")
        held = HeldSignal(np.asarray(interval * np.arange(r.size), dtype=float), r)
        return simulate_continuous_loop(model, controller, held, v, enters)
    plant = sampled_model(model, interval)
    if isinstance(controller, Relay):
        if plant.shift == 0 and plant.direct != 0.0:
            text = "a relay needs a model without direct feedthrough: give it a delay, or fewer zeros than poles"
            raise DataError(text)
        law, relay = law_of(NOTHING), (controller.amplitude, controller.hysteresis, controller.bias)
    else:
        discrete = _realised(controller)
        _require_sampled_solution(plant, discrete)
        law, relay = law_of(discrete), NO_RELAY
    u, x, _ = loop_pass(plant, law, r, v, enters == "controller", relay=relay)
    if not (np.isfinite(u).all() and np.isfinite(x).all()):
        if isinstance(controller, Relay):
            raise DataError("the signals of the loop with the relay are not finite; check the system and the reference")
        raise DataError(
            "the signals of the closed loop are not finite; check reference, noise and stability: its largest pole has "
            f"the magnitude {loop_radius(model, controller, interval):.6g}"
        )
    return LoopSignals(u, x)


def simulate_continuous_loop(
    model: AdditiveModel | TransferFunction,
    controller: ContinuousController,
    reference: HeldSignal,
    noise: Array,
    enters: Enters = "controller",
) -> LoopSignals:
    """Input and noise-free output of a loop in continuous time, at the breaks of its reference and at rest before.

    The noise is held from one break to the next. Where r enters before a controller D/C of a plant B/A, the loop is
    ``x = B D/(A C + B D) (r - v)`` and ``u = A D/(A C + B D) (r - v)``; behind the controller ``C r - D v`` is in the
    place of ``D (r - v)``.
    """
    if reference.hold == "band-limited":
        raise DataError("a loop in continuous time needs a reference that is held between its samples: zoh or foh")
    closed, plant = _closed(model, controller)
    t, from_reference = reference.t, controller.numerator if enters == "controller" else controller.denominator
    driven = ((reference, from_reference), (HeldSignal(t, -noise), controller.numerator))

    def response_with(side: Array) -> Array:
        parts = [simulate(TransferFunction(np.polymul(side, over), closed), signal, t) for signal, over in driven]
        return np.asarray(np.sum(parts, axis=0))

    with np.errstate(over="ignore", invalid="ignore"):
        u, x = response_with(plant.denominator), response_with(plant.numerator)
    if not (np.isfinite(u).all() and np.isfinite(x).all()):
        raise DataError("the signals of the closed loop are not finite; check reference, noise and stability")
    return LoopSignals(u, x)


def _closed(
    model: AdditiveModel | TransferFunction, controller: ContinuousController
) -> tuple[Array, TransferFunction]:
    """Return the characteristic polynomial of a loop in continuous time, and its plant as one fraction."""
    plant = unfactored(model) if isinstance(model, AdditiveModel) else model
    if plant.delay:
        raise DataError(NO_DELAY)
    once = (side.numerator[0] if side.numerator.size == side.denominator.size else 0.0 for side in (plant, controller))
    _require_solution(float(np.prod(list(once))))
    around = np.polymul(plant.numerator, controller.numerator)
    return np.polyadd(np.polymul(plant.denominator, controller.denominator), around), plant


def loop_pass(
    plant: SampledModel,
    law: Law,
    r: Array,
    v: Array,
    at_controller: bool,
    *,
    push: Array | None = None,
    start: tuple[Array, Array, Array] | None = None,
    relay: tuple[float, float, float] = NO_RELAY,
) -> tuple[Array, Array, Array]:
    """Return input, noise-free output and plant states of a sampled loop; arguments are those of the kernel."""
    from ctid_cli.filtering import kernels  # numba is slow to import

    size = plant.from_input.size
    push = np.zeros((0, size)) if push is None else push
    start = (np.zeros(size), np.zeros(law[1].size), np.zeros(plant.shift)) if start is None else start
    found: tuple[Array, Array, Array] = kernels.loop_signals(
        (*plant,), law, relay, r, v, float(at_controller), push, start
    )
    return found


def law_of(controller: DiscreteController) -> Law:
    """Return the state space of a controller for the kernel."""
    A, B, C, D = controller.state_space()
    return plain_array(A), plain_array(B[:, 0]), plain_array(C[0]), float(D[0, 0])


def loop_radius(model: AdditiveModel | TransferFunction, controller: Controller, interval: float) -> float:
    """Return the largest magnitude of the poles of the loop over a sampling interval, which is stable below 1."""
    if isinstance(controller, ContinuousController):
        return float(np.exp(np.roots(_closed(model, controller)[0]).real.max(initial=-np.inf) * interval))
    return sampled_radius(sampled_model(model, interval), _realised(controller))


def sampled_radius(sampled: SampledModel, discrete: DiscreteController) -> float:
    """Return the largest magnitude of the poles of the loop of a sampled model."""
    return float(np.abs(sampled_poles(sampled, discrete)).max(initial=0.0))


def sampled_poles(sampled: SampledModel, discrete: DiscreteController) -> ComplexArray:
    """Return the poles of the loop of a sampled model."""
    _require_sampled_solution(sampled, discrete)
    A, B, C, D = sampled.state_space()
    Ac, Bc, Cc, Dc = discrete.state_space()
    # Without reference and noise u = Cc s - Dc x and x = C z + D u.
    u = np.hstack((-Dc @ C, Cc)) / (1.0 + Dc * D)
    x = np.hstack((C, np.zeros((1, len(Ac))))) + D @ u
    n = len(A)
    dynamics = np.vstack((B @ u, -Bc @ x))
    dynamics[:n, :n] += A
    dynamics[n:, n:] += Ac
    return np.asarray(np.linalg.eigvals(dynamics), dtype=complex)


def stabilising_controller(plant: TransferFunction, interval: float) -> DiscreteController:
    """Return a controller that stabilises a sampled plant with little effort: linear quadratic, with an observer.

    Its poles are almost those of the plant, unstable ones reflected.
    """
    from scipy.linalg import solve_discrete_are  # slow to import
    from scipy.signal import ss2tf

    A, B, C, D = sampled_model(plant, interval).state_space()
    weight, one = LITTLE * np.eye(len(A)), np.eye(1)
    P, S = solve_discrete_are(A, B, weight, one), solve_discrete_are(A.T, C.T, weight, one)
    K = np.linalg.solve(one + B.T @ P @ B, B.T @ P @ A)
    L = np.linalg.solve(one + C @ S @ C.T, C @ S @ A.T).T
    numerator, denominator = ss2tf(A - B @ K - L @ C + L @ D @ K, L, K, np.zeros((1, 1)))
    return DiscreteController(numerator[0], denominator)


def _realised(controller: Controller) -> DiscreteController:
    """Return the controller as a `DiscreteController`."""
    if isinstance(controller, DiscreteController):
        return controller
    return DiscreteController(controller.numerator, controller.denominator)


def _require_sampled_solution(plant: SampledModel, controller: DiscreteController) -> None:
    _require_solution(0.0 if plant.shift else controller.direct * plant.direct)


def _require_solution(gain: float) -> None:
    """Raise an error if an algebraic loop of some direct gain has no unique solution."""
    if abs(1.0 + gain) <= NO_GAIN * max(1.0, abs(gain)):
        raise DataError(
            "the loop has no solution: the product of the direct gains of model and controller is -1; change the gain "
            "of the controller, or give the model a delay or fewer zeros"
        )
