"""Accuracy that theory gives: Cramér-Rao bounds of a record, and the limit for long records."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from ctid_cli.arrays import Array
from ctid_cli.errors import BiasedError, DataError
from ctid_cli.filtering.bank import second_moments
from ctid_cli.filtering.filter_data import filter_data
from ctid_cli.filtering.loop import NO_GAIN
from ctid_cli.filtering.sampled import sampled_model
from ctid_cli.inference.covariance import sandwich, unit_inverse, white_noise_covariance
from ctid_cli.inference.sensitivities import DiscreteSystem, Structure, sensitivity_system
from ctid_cli.models.additive import AdditiveModel, Term
from ctid_cli.models.controller import DiscreteController
from ctid_cli.models.factoring import factored, factored_jacobian
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.record import Enters, Record


@dataclass(frozen=True, eq=False)
class ParameterAccuracy:
    """Parameters of the true system and the covariance of their estimates."""

    model: AdditiveModel | TransferFunction
    names: tuple[str, ...]
    #: Their true values, shape (p,).
    values: Array
    #: Covariance of their estimates, shape (p, p).
    covariance: Array

    @classmethod
    def of(
        cls, model: AdditiveModel | TransferFunction, covariance: Array, zeros: int | None = None, delay: bool = False
    ) -> ParameterAccuracy:
        """Accuracy of the parameters of a model, or of a fraction with more zeros or with its delay estimated too."""
        if isinstance(model, AdditiveModel):
            return cls(model, model.names, model.theta, covariance)
        own = model.numerator.size - 1
        m = own if zeros is None else zeros
        parts = [model.denominator[1:], np.zeros(m - own), model.numerator, np.full(int(delay), model.delay)]
        return cls(model, Structure(model.order, m, delay).names, np.concatenate(parts), covariance)

    @property
    def standard_errors(self) -> Array:
        """Square roots of the variances, in the units of the parameters, shape (p,)."""
        errors: Array = np.sqrt(np.diag(self.covariance))
        return errors

    def factored(self, terms: Sequence[Term] | None = None) -> ParameterAccuracy:
        """Accuracy of the submodels into which an estimated transfer function is factored, by the delta method."""
        if isinstance(self.model, AdditiveModel):
            return self
        additive = factored(self.model, terms)
        # The delay is the same in both forms.
        own = len(self.names) - int(self.names[-1] == "delay")
        size, delays = additive.theta.size, len(self.names) - own
        jacobian = np.zeros((size + delays, len(self.names)))
        jacobian[:size, :own] = factored_jacobian(self.model, additive, own - self.model.order)
        jacobian[size:, own:] = np.eye(delays)
        names, values = additive.names + self.names[own:], np.concatenate([additive.theta, self.values[own:]])
        return ParameterAccuracy(additive, names, values, jacobian @ self.covariance @ jacobian.T)


def finite_record_covariance(psi: Array, autocovariances: ArrayLike) -> Array:
    r"""Covariance of an unweighted output-error estimate from one record with noise of known autocovariances.

    With ``M = psi' psi`` and the covariance matrix R of the noise, ``M^-1 psi' R psi M^-1``, to first order in the
    noise: ``sigma^2 M^-1`` for white noise. Unlike the limit of long records it knows the start from rest, which counts
    as long as the memory of the system or of its loop is not short against the record.
    """
    from scipy.linalg import matmul_toeplitz

    lags = np.atleast_1d(np.asarray(autocovariances, dtype=float))
    count, size = psi.shape
    found = unit_inverse(psi.T @ psi) if count >= size else None
    if found is None:
        return np.full((size, size), np.nan)
    inverse, scale = found
    scaled = psi * scale
    first_column = np.zeros(count)
    first_column[: lags.size] = lags[:count]
    coloured = lags[0] * scaled if lags.size == 1 else matmul_toeplitz(first_column, scaled)
    return sandwich(inverse, scale, scaled.T @ coloured)


def cramer_rao_bound(
    model: TransferFunction,
    record: Record,
    noise_standard_deviation: float,
    start: float = 0.0,
    estimate_delay: bool = True,
) -> Array:
    """Cramér-Rao bound for white Gaussian output noise.

    Parameters
    ----------
    model : TransferFunction
        The true, strictly proper system.
    record : Record
        Instants and input; its outputs are not used, but missing ones count as missing.
    noise_standard_deviation : float
        Standard deviation of the noise [output unit].
    start : float, default 0.0
        Samples earlier than this after the first input break [s] are not used.
    estimate_delay : bool, default True
        Whether the delay is unknown too.

    Returns
    -------
    ndarray, shape (p, p)
        Lower bound of the covariance of ``(a_1 … a_n, b_0 … b_m[, delay])``.

    Notes
    -----
    ``sigma^2 (sum psi psi')^-1`` with the exact sensitivities psi of the simulated output at these instants.
    """
    structure = Structure(model.order, model.numerator.size - 1, estimate_delay)
    data = filter_data(record, start)
    moments = second_moments(data, model.denominator, model.numerator, model.delay)
    # N - p and the sum of squares are chosen so that their ratio is the known variance.
    squared_error = noise_standard_deviation**2 * (data.count - structure.size)
    return white_noise_covariance(structure.hessian(moments), squared_error, data.count)


#: What the estimator's instruments are made from: the input, or the noise-free input of the loop.
Instruments = Literal["open_loop", "closed_loop"]
#: Noise that is white: its filter has the numerator and the denominator 1.
WHITE: tuple[Sequence[float], Sequence[float]] = ((1.0,), (1.0,))


def limiting_accuracy(
    model: AdditiveModel | TransferFunction,
    interval: float,
    controller: DiscreteController | None = None,
    *,
    standard_deviation: float,
    innovation_variance: float,
    noise_filter: tuple[ArrayLike, ArrayLike] = WHITE,
    samples: int,
    enters: Enters = "controller",
    instruments: Instruments = "closed_loop",
    zeros: int | None = None,
) -> ParameterAccuracy:
    r"""Accuracy for white noise held between the samples as the input, or as the reference of a closed loop.

    With the sensitivities ``psi = dx/d theta`` and ``M = E psi psi'`` the estimates of SRIVC and of its additive form
    approach [1]_

    .. math:: \operatorname{cov} \sqrt N\,\hat\theta = M^{-1} \Sigma M^{-1}, \qquad
              \Sigma = \sum_\tau R_v(\tau)\, E\,\psi(t+\tau)\psi(t)' = \sigma_e^2 \operatorname{cov} H(q)\psi,

    which for white noise is ``sigma^2 M^-1``, the Cramér-Rao bound. Both covariances solve discrete Lyapunov equations.

    In a closed loop psi are driven by its noise-free input, ``S r``. With the input itself, ``u = S (r - v)`` for a
    reference that enters at the controller, and white noise, psi has the part of the noise too: feedback then is a
    second reference, and the variances are somewhat smaller [1]_. That needs a sample of delay around the loop.
    """
    # Without a controller what drives the loop is the input, and no noise comes back.
    if controller is None:
        controller, enters = DiscreteController([0.0], [1.0]), "input"
    loop = _in_loop(sensitivity_system(model, interval, zeros), controller, enters)
    if loop.radius >= 1.0:
        wrong = "the system, or its loop, is not stable: there is no limit for long records"
        raise DataError(f"{wrong}; its sampled poles reach the magnitude {loop.radius:.6g}, and must stay below 1")
    # What drives the instruments besides the reference: the noise, where they come from the input itself.
    gain = float(np.ravel(noise_filter[0])[0] / np.ravel(noise_filter[1])[0])
    fed_back = float(np.sqrt(innovation_variance)) * abs(gain) if instruments == "open_loop" else 0.0
    deviations = [standard_deviation, fed_back]
    found = unit_inverse(_covariance(loop, deviations)[1:, 1:])
    if found is None:
        wrong = "the parameters are not determined, even by endless data"
        raise DataError(f"{wrong}: some have no effect of their own, as where a pole cancels a zero or a gain is zero")
    inverse, scale = found
    # H(q) psi is psi driven by inputs filtered by H, one filter for each.
    filters = DiscreteSystem(*(np.asarray(np.kron(np.eye(2), part), dtype=float) for part in _filter(noise_filter)))
    sigma = innovation_variance * _covariance(loop.after(filters), deviations)[1:, 1:]
    covariance = sandwich(inverse, scale, sigma * np.outer(scale, scale), samples)
    return ParameterAccuracy.of(model, covariance, zeros)


def require_uncorrelated_input(
    model: AdditiveModel | TransferFunction,
    interval: float,
    controller: DiscreteController,
    noise_filter: tuple[ArrayLike, ArrayLike],
) -> None:
    """Refuse instruments made from the input of a loop if they are correlated with the noise at the same sample."""
    why = "the noise is coloured" if any(np.size(part) > 1 for part in noise_filter) else ""
    if not why and sampled_model(model, interval).state_space()[3].any() and controller.direct != 0.0:
        why = "model and controller both react at once"
    if why:
        raise BiasedError(f"{why}, so that the input is correlated with the noise (closed_loop instruments are not)")


def output_variance(model: AdditiveModel | TransferFunction, interval: float, input_deviation: float) -> float:
    """Variance of the noise-free output of a stable model, for white noise held between the samples as the input."""
    return float(_covariance(sensitivity_system(model, interval), [input_deviation])[0, 0])


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


def _filter(noise_filter: tuple[ArrayLike, ArrayLike]) -> tuple[Array, Array, Array, Array]:
    """State space of a filter in powers of q^-1."""
    parts = [np.atleast_1d(np.asarray(part, dtype=float)) for part in noise_filter]
    length = max(part.size for part in parts)
    return DiscreteController(*(np.pad(part, (0, length - part.size)) for part in parts)).state_space()


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
    return np.asarray(system.C @ P @ system.C.T + D @ D.T)
