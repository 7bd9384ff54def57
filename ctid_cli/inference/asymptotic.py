"""Accuracy that refined instrumental variables reach on long records, known before any data are taken."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError
from ctid_cli.filtering.loop import NO_GAIN
from ctid_cli.filtering.sampled import sampled_model
from ctid_cli.inference.accuracy import ParameterAccuracy, estimated_parameters
from ctid_cli.inference.covariance import condition_number
from ctid_cli.inference.sensitivity_system import DiscreteSystem, sensitivity_system
from ctid_cli.models.additive import AdditiveModel
from ctid_cli.models.controller import DiscreteController
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.checks import require_choice, require_integer, require_not_negative, require_positive
from ctid_cli.signals.record import Enters

#: What the estimator's instruments are made from: the input, or the noise-free input of the loop.
Instruments = Literal["open_loop", "closed_loop"]

#: Noise that is white: its filter has the numerator and the denominator 1.
WHITE: tuple[Sequence[float], Sequence[float]] = ((1.0,), (1.0,))


def open_loop_accuracy(
    model: AdditiveModel | TransferFunction,
    interval: float,
    *,
    input_standard_deviation: float,
    innovation_variance: float,
    noise_filter: tuple[ArrayLike, ArrayLike] = WHITE,
    samples: int,
    zeros: int | None = None,
) -> ParameterAccuracy:
    r"""Accuracy in open loop, for white noise held between the samples as the input.

    With the sensitivities ``psi = dx/d theta`` and ``M = E psi psi'`` the estimates of SRIVC and of its additive form
    approach [1]_

    .. math:: \operatorname{cov} \sqrt N\,\hat\theta = M^{-1} \Sigma M^{-1}, \qquad
              \Sigma = \sum_\tau R_v(\tau)\, E\,\psi(t+\tau)\psi(t)' = \sigma_e^2 \operatorname{cov} H(q)\psi,

    which for white noise is ``sigma^2 M^-1``, the Cramér-Rao bound. Both covariances solve discrete Lyapunov equations.
    """
    require_positive("input_standard_deviation", input_standard_deviation, "input unit")
    names, values = estimated_parameters(model, zeros)
    system = sensitivity_system(model, interval, zeros)
    if not model.is_stable:
        raise DataError(
            "the system is not stable (an integrator counts), so in open loop its sensitivities grow with the record, "
            "and their covariance has no limit; take the covariance for a record of given length instead"
        )
    covariance = _sandwich(system, [input_standard_deviation], innovation_variance, noise_filter, samples)
    return ParameterAccuracy(model, names, values, covariance)


def closed_loop_accuracy(
    model: AdditiveModel | TransferFunction,
    interval: float,
    controller: DiscreteController,
    *,
    reference_standard_deviation: float,
    innovation_variance: float,
    noise_filter: tuple[ArrayLike, ArrayLike] = WHITE,
    samples: int,
    enters: Enters = "controller",
    instruments: Instruments = "closed_loop",
    zeros: int | None = None,
) -> ParameterAccuracy:
    r"""Accuracy in a closed loop with a known controller, for white noise as the reference.

    As :func:`open_loop_accuracy`, with psi driven by the noise-free input of the loop, ``S r``. With the input itself,
    ``u = S (r - v)`` for a reference that enters at the controller, and white noise, psi has the part of the noise
    too: feedback then is a second reference, and the variances are somewhat smaller [1]_. That needs a sample of delay
    around the loop.
    """
    require_positive("reference_standard_deviation", reference_standard_deviation, "unit of the reference")
    require_choice("enters", enters, get_args(Enters))
    require_choice("instruments", instruments, get_args(Instruments))
    names, values = estimated_parameters(model, zeros)
    if isinstance(model, TransferFunction) and model.denominator[-1] == 0:
        raise DataError(
            "the transfer function has a pole at the origin, and its sensitivity to the last denominator coefficient "
            "integrates twice and grows with the record; an additive model keeps its integrators fixed"
        )
    system = sensitivity_system(model, interval, zeros)
    loop = _in_loop(system, controller, enters)
    if loop.radius >= 1.0:
        raise DataError(
            f"the loop is not stable: its sampled poles reach the magnitude {loop.radius:.6g}; they must stay below 1"
        )
    # What drives the instruments besides the reference: the noise, where they come from the input itself.
    fed_back = 0.0
    if instruments == "open_loop":
        require_uncorrelated_input(model, interval, controller, noise_filter)
        fed_back = float(np.sqrt(innovation_variance)) * abs(_gain(noise_filter))
    deviations = [reference_standard_deviation, fed_back]
    covariance = _sandwich(loop, deviations, innovation_variance, noise_filter, samples)
    return ParameterAccuracy(model, names, values, covariance)


def require_uncorrelated_input(
    model: AdditiveModel | TransferFunction,
    interval: float,
    controller: DiscreteController,
    noise_filter: tuple[ArrayLike, ArrayLike],
) -> None:
    """Refuse instruments made from the input of a loop if they are correlated with the noise at the same sample."""
    if any(np.size(part) > 1 for part in noise_filter):
        raise DataError(
            "the noise is coloured, so in closed loop the input is correlated with it, and instruments from the input "
            "itself are biased: no covariance describes their error; ask for closed_loop instruments"
        )
    if sampled_model(model, interval).state_space()[3].any() and controller.direct != 0.0:
        raise DataError(
            "model and controller both react at once, so the input is correlated with the noise at the same sample; "
            "instruments from the input itself are biased here: ask for closed_loop instruments"
        )


def output_variance(
    model: AdditiveModel | TransferFunction, interval: float, *, input_standard_deviation: float
) -> float:
    """Variance of the noise-free output in open loop, for white noise held between the samples as the input."""
    if not model.is_stable:
        return float("inf")
    return float(_covariance(sensitivity_system(model, interval), [input_standard_deviation])[0, 0])


def _in_loop(system: DiscreteSystem, controller: DiscreteController, enters: str) -> DiscreteSystem:
    """Close a loop around the first output of a system; the inputs then are the reference and the output noise."""
    A, B, C, D = system.A, system.B, system.C[:1], system.D[:1]
    Ac, Bc, Cc, Dc = controller.state_space()
    order = controller.order
    at_controller = enters == "controller"
    # From (r, v) to what the controller sees, and past it; x is still to be subtracted from the former.
    error, straight = np.array([[float(at_controller), -1.0]]), np.array([[float(not at_controller), 0.0]])
    denominator = 1.0 + float(Dc[0, 0] * D[0, 0])
    if abs(denominator) <= NO_GAIN:
        raise DataError("model and controller react at once with a loop gain of -1: the loop has no solution")
    u_states = np.hstack([-Dc @ C, Cc]) / denominator
    u_inputs = (Dc @ error + straight) / denominator
    e_states = np.hstack([-C, np.zeros((1, order))]) - D @ u_states
    e_inputs = error - D @ u_inputs
    n = A.shape[0]
    A_loop = np.vstack([np.hstack([A, np.zeros((n, order))]), np.hstack([np.zeros((order, n)), Ac])])
    A_loop = A_loop + np.vstack([B @ u_states, Bc @ e_states])
    B_loop = np.vstack([B @ u_inputs, Bc @ e_inputs])
    C_loop = np.hstack([system.C, np.zeros((system.C.shape[0], order))]) + system.D @ u_states
    return DiscreteSystem(A_loop, B_loop, C_loop, system.D @ u_inputs)


def _sandwich(
    system: DiscreteSystem,
    deviations: Sequence[float],
    innovation_variance: float,
    noise_filter: tuple[ArrayLike, ArrayLike],
    samples: int,
) -> Array:
    """``M^-1 Sigma M^-1 / N`` of the sensitivities, all outputs of a system but the first."""
    require_integer("samples", samples, 1)
    require_not_negative("innovation_variance", innovation_variance, "output unit^2")
    M = _covariance(system, deviations)[1:, 1:]
    if not condition_number(M) <= 1e14:
        raise DataError(
            "the parameters are not determined, even by endless data: some of them have no effect of their own on the "
            "output, as where a pole cancels a zero or a gain is zero"
        )
    scale = 1.0 / np.sqrt(np.diag(M))
    inverse = np.linalg.inv(M * np.outer(scale, scale)) * np.outer(scale, scale)
    # H(q) psi is psi driven by inputs filtered by H, one filter for each.
    single = _filter(noise_filter)
    parts = (single.A, single.B, single.C, single.D)
    filters = DiscreteSystem(*(np.asarray(np.kron(np.eye(len(deviations)), part), dtype=float) for part in parts))
    if filters.radius >= 1.0:
        raise DataError("the noise filter is not stable: the roots of its denominator must lie within the unit circle")
    sigma = innovation_variance * _covariance(system.after(filters), deviations)[1:, 1:]
    covariance: Array = inverse @ sigma @ inverse / samples
    return 0.5 * (covariance + covariance.T)


def _gain(noise_filter: tuple[ArrayLike, ArrayLike]) -> float:
    """First coefficient of the impulse response of a noise filter."""
    numerator, denominator = (np.ravel(np.asarray(part, dtype=float)) for part in noise_filter)
    return float(numerator[0] / denominator[0])


def _filter(noise_filter: tuple[ArrayLike, ArrayLike]) -> DiscreteSystem:
    """State space of a filter in powers of q^-1."""
    numerator, denominator = (np.atleast_1d(np.asarray(part, dtype=float)) for part in noise_filter)
    if denominator[0] == 0:
        raise ValueError("the first denominator coefficient of the noise filter must not be zero")
    order = max(numerator.size, denominator.size) - 1
    b, a = np.zeros(order + 1), np.zeros(order + 1)
    b[: numerator.size], a[: denominator.size] = numerator / denominator[0], denominator / denominator[0]
    A = np.eye(order, k=-1)
    A[:1] = -a[1:]
    return DiscreteSystem(A, np.eye(order, 1), (b[1:] - b[0] * a[1:])[None, :], b[:1, None])


def _covariance(system: DiscreteSystem, deviations: Sequence[float]) -> Array:
    """Stationary covariance of the outputs of a stable system under independent white inputs."""
    size = np.asarray(deviations, dtype=float)
    B, D = system.B * size, system.D * size
    # P = sum A^k B B' A^k', by doubling: sums of squares only, so small variances keep their digits.
    P, power = B @ B.T, system.A
    while np.abs(power).max(initial=0.0) > 0.0:
        step = power @ P @ power.T
        P = P + step
        power = power @ power
        if (np.abs(step) <= 1e-17 * np.sqrt(np.outer(np.diag(P), np.diag(P)))).all():
            break
    covariance: Array = system.C @ P @ system.C.T + D @ D.T
    return covariance
