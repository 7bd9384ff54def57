"""Theoretical accuracy: Cramér-Rao bounds of a record, and the asymptotic limit for long records."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from ctid_cli.arrays import Array
from ctid_cli.errors import BiasedError, DataError
from ctid_cli.filtering.loop import loop_radius, simulate_loop
from ctid_cli.filtering.simulate import sampled_model
from ctid_cli.inference.covariance import sandwich, unit_inverse
from ctid_cli.inference.innovations import SampledNoise, steps_of
from ctid_cli.inference.sensitivities import Structure, sensitivities
from ctid_cli.models.additive import AdditiveModel, Term
from ctid_cli.models.controller import DiscreteController
from ctid_cli.models.factoring import factored, factored_jacobian
from ctid_cli.models.transfer_function import TransferFunction, cancelled
from ctid_cli.processors import one_thread
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.noise import ArmaNoise, Noise
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
        """Return the accuracy of a model's parameters, optionally with the delay or with more zeros of a fraction."""
        if isinstance(model, AdditiveModel):
            names, values = (*model.names, *("delay",) * delay), np.append(model.theta, [model.delay] * delay)
            return cls(model, names, values, covariance)
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
        """Return the accuracy of the submodels of a factored transfer function, by the delta method."""
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


@dataclass(frozen=True, eq=False)
class EstimatedForm:
    """The true system in the parametrisation of an estimator."""

    model: AdditiveModel | TransferFunction
    #: Degree of the numerator of a fraction; None for that of the model.
    zeros: int | None
    #: Samples before this time [s] are not used; None for a known delay.
    delay_from: float | None
    instruments: Instruments
    #: Whether the noise is modelled too, so that the errors are prewhitened.
    weighed: bool = False
    #: Whether the criterion is the output error of the simulated loop, which the noise reaches through the loop.
    simulated: bool = False


@dataclass(frozen=True, eq=False)
class ExpectedAccuracy:
    """Theoretical accuracy of one estimator on one kind of data."""

    parameters: ParameterAccuracy
    #: Whether it is the asymptotic limit for long records.
    limit: bool
    #: How it was computed, in words.
    formula: str


def accuracy_of_long_records(
    form: EstimatedForm,
    interval: float,
    samples: int,
    noise: Noise,
    deviation: float,
    controller: DiscreteController | None = None,
    enters: Enters = "controller",
) -> ExpectedAccuracy:
    """Return the limit for long records, with white Gaussian noise as the input, or as the reference of a loop."""
    # A noise level relative to the output refers to its mean square; in a loop levels are absolute.
    power = [] if controller else [np.sqrt([output_variance(form.model, interval, deviation)])]
    parameters = limiting_accuracy(
        form.model,
        interval,
        controller,
        standard_deviation=deviation,
        innovation_variance=noise.innovation_variance_of(*power),
        noise_filter=noise.filter,
        samples=samples,
        enters=enters,
        instruments=form.instruments if controller else "closed_loop",
        zeros=form.zeros,
    )
    product, matrices = "sigma^2 M^-1", "M = E psi psi'"
    if noise.coloured:
        product = "M^-1 Sigma M^-1"
        matrices += ", Sigma = sigma_e^2 cov(H psi), H the filter and sigma_e^2 the innovation variance of the noise"
    formula = (
        f"the limit for long records, {product} / N with {matrices}, psi {_psi_in_words(form, controller)}; summed "
    )
    formula += f"over responses to a pulse, as the {'reference' if controller else 'input'} is white Gaussian noise"
    return ExpectedAccuracy(parameters, True, formula)


def accuracy_of_records(
    form: EstimatedForm,
    system: AdditiveModel | TransferFunction,
    records: Sequence[Record],
    noise: Noise,
    why_no_limit: str,
) -> ExpectedAccuracy:
    """Return the accuracy on simulated records of a system, averaged over them."""
    covariance = np.mean([_record_covariance(form, system, record, noise) for record in records], axis=0)
    if not np.isfinite(covariance).all():
        model = form.model
        place = cancelled(model.numerator, model.denominator) if isinstance(model, TransferFunction) else ""
        why = f": a zero cancels the pole at s = {place}" if place else ""
        raise DataError(f"the data would not determine the parameters, even without noise{why}")
    parameters = ParameterAccuracy.of(form.model, covariance, form.zeros, form.delay_from is not None)
    # Instruments other than the input are not optimal.
    best = form.instruments == "open_loop"
    start = f"{'the Cramér-Rao bound ' if best else ''}sigma^2 (psi' psi)^-1"
    if form.weighed and noise.coloured:
        start = "the Cramér-Rao bound (psi' R^-1 psi)^-1, R the covariance matrix of the noise"
    elif noise.coloured:
        start = "(psi' psi)^-1 psi' R psi (psi' psi)^-1, R the covariance matrix of the noise"
    if form.simulated:
        start = "(psi' psi)^-1 psi' S R S' psi (psi' psi)^-1, S from the noise to the output, R the noise's covariance"
    sets = len(records)
    where = "in the first data set" if sets == 1 else f"averaged over the first {sets} data sets"
    formula = f"{start}, psi {_psi_in_words(form, records[0].loop)}, {where}, as {why_no_limit}"
    return ExpectedAccuracy(parameters, False, formula)


def _record_covariance(
    form: EstimatedForm, system: AdditiveModel | TransferFunction, record: Record, noise: Noise
) -> Array:
    """Return the covariance of an estimate from one data set; NaN if it does not determine the parameters."""
    signal = record.input
    if form.instruments == "closed_loop" and record.loop is not None and record.loop.controller is not None:
        loop, law, interval = record.loop, record.loop.controller, record.interval or 0.0
        u = simulate_loop(system, law, loop.reference, 0.0, interval, loop.enters).u
        signal = HeldSignal(record.t, u)
    psi = sensitivities(form.model, signal, record.t, form.zeros, estimate_delay=form.delay_from is not None)
    lags = np.arange(psi.shape[0] if noise.coloured else 1)
    autocovariances = noise.autocovariance(lags, record.noise_free)
    if form.simulated:
        # The parameters move the output as noise does, through the loop; its transpose runs backwards.
        moved = _through_loop(system, record, psi)
        return finite_record_covariance(moved, autocovariances, _through_loop(system, record, moved[::-1])[::-1])
    if form.delay_from is not None:
        psi = psi[record.t >= record.input.t[0] + form.delay_from]
    if form.weighed and noise.coloured:
        variance = noise.innovation_variance_of(record.noise_free)
        law = ArmaNoise(*noise.filter, innovation_variance=variance)
        # psi' R^-1 psi is the product of the whitened sensitivities.
        white = SampledNoise(law, steps_of(np.ones(len(psi), dtype=bool))).whitened(psi)
        return finite_record_covariance(white, variance)
    return finite_record_covariance(psi, autocovariances[: psi.shape[0]])


def _through_loop(system: AdditiveModel | TransferFunction, record: Record, columns: Array) -> Array:
    """Return what is measured of signals that are added to the output of a loop without a reference."""
    loop, interval = record.loop, record.interval
    assert loop is not None
    assert loop.controller is not None
    assert interval is not None
    still = np.zeros(len(columns))
    moved = [simulate_loop(system, loop.controller, still, one, interval, loop.enters).x for one in columns.T]
    return columns + np.column_stack(moved)


def _psi_in_words(form: EstimatedForm, loop: object | None) -> str:
    where = "noise-free loop" if form.instruments == "closed_loop" else "loop, noise included"
    return "the sensitivities of the output to the parameters" + ("" if loop is None else f" in the {where}")


def finite_record_covariance(psi: Array, autocovariances: ArrayLike, weights: Array | None = None) -> Array:
    r"""Return the covariance of an unweighted output-error estimate with noise of known autocovariances.

    With ``M = psi' psi`` and the covariance matrix R of the noise, ``M^-1 psi' R psi M^-1``, to first order in the
    noise: ``sigma^2 M^-1`` for white noise. Unlike the limit for long records it includes the start from rest, which
    matters unless the memory of the system or of its loop is short compared with the record. Where noise reaches the
    errors as ``F v``, ``weights`` are ``F' psi``.
    """
    from scipy.linalg import matmul_toeplitz

    lags = np.atleast_1d(np.asarray(autocovariances, dtype=float))
    count, size = psi.shape
    found = unit_inverse(psi.T @ psi) if count >= size else None
    if found is None:
        return np.full((size, size), np.nan)
    inverse, scale = found
    scaled = (psi if weights is None else weights) * scale
    first_column = np.zeros(count)
    first_column[: lags.size] = lags[:count]
    coloured = lags[0] * scaled if lags.size == 1 else matmul_toeplitz(first_column, scaled)
    return sandwich(inverse, scale, scaled.T @ coloured)


@one_thread
def cramer_rao_bound(
    model: TransferFunction,
    record: Record,
    noise_standard_deviation: float,
    start: float = 0.0,
    estimate_delay: bool = True,
) -> Array:
    """Return the Cramér-Rao bound for white Gaussian output noise.

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
        Whether the delay is estimated too.

    Returns
    -------
    ndarray, shape (p, p)
        Lower bound of the covariance of ``(a_1 … a_n, b_0 … b_m[, delay])``.

    Notes
    -----
    ``sigma^2 (sum psi psi')^-1`` with the exact sensitivities psi of the simulated output at these instants.
    """
    psi = sensitivities(model, record.input, record.t, estimate_delay=estimate_delay)
    slack = 1e-9 * (record.interval or 0.0)
    used = record.valid & (record.t >= record.input.t[0] + start - slack)
    return finite_record_covariance(psi[used], noise_standard_deviation**2)


#: Source of the estimator's instruments: the measured input, or the noise-free input of the loop.
Instruments = Literal["open_loop", "closed_loop"]
#: Zero controller.
OPEN = DiscreteController([0.0], [1.0])
#: Amplitude at which a pulse response counts as zero: its square is below rounding.
FORGOTTEN = 1e-12
#: Greatest length of a pulse response [samples], and least magnitude of the slowest pole used to compute its length.
LONGEST_MEMORY, DEADBEAT = 1_000_000, 0.1
#: Filter of white noise: numerator and denominator are 1.
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
    r"""Return the asymptotic accuracy for held white noise as the input, or as the reference of a closed loop.

    With the sensitivities ``psi = dx/d theta`` and ``M = E psi psi'`` the estimates of SRIVC and of its additive form
    approach [1]_

    .. math:: \operatorname{cov} \sqrt N\,\hat\theta = M^{-1} \Sigma M^{-1}, \qquad
              \Sigma = \sum_\tau R_v(\tau)\, E\,\psi(t+\tau)\psi(t)' = \sigma_e^2 \operatorname{cov} H(q)\psi,

    which for white noise is ``sigma^2 M^-1``, the Cramér-Rao bound. Both covariances are sums over exact pulse
    responses, which solve the discrete Lyapunov equations of the sampled system.

    In a closed loop psi are driven by its noise-free input, ``S r``. With the measured input, ``u = S (r - v)`` for a
    reference that enters at the controller, and white noise, psi also depends on the noise, which acts as a second
    reference, and the variances are somewhat smaller [1]_. This requires a delay of one sample in the loop.
    """
    from scipy.signal import lfilter  # slow to import

    # Without a controller the driving signal is the input, and there is no feedback of noise.
    if controller is None:
        controller, enters = OPEN, "input"
    count = _memory(model, interval, controller, noise_filter)
    pulse, times = np.zeros(count), np.asarray(interval * np.arange(count), dtype=float)
    pulse[0] = 1.0
    inputs: list[Array] = [standard_deviation * simulate_loop(model, controller, pulse, 0.0, interval, enters).u]
    # Instruments from the measured input are also driven by the noise.
    if instruments == "open_loop":
        gain = float(np.ravel(noise_filter[0])[0] / np.ravel(noise_filter[1])[0])
        noise = math.sqrt(innovation_variance) * gain * pulse
        inputs.append(simulate_loop(model, controller, np.zeros(count), noise, interval, enters).u)
    responses = [sensitivities(model, HeldSignal(times, u), times, zeros) for u in inputs]
    found = unit_inverse(_moments(responses))
    if found is None:
        wrong = "the parameters are not identifiable"
        raise DataError(f"{wrong}: some have no separate effect, as when a pole cancels a zero or a gain is zero")
    inverse, scale = found
    filtered = [lfilter(*noise_filter, psi * scale, axis=0) for psi in responses]
    covariance = sandwich(inverse, scale, innovation_variance * _moments(filtered), samples)
    return ParameterAccuracy.of(model, covariance, zeros)


def require_uncorrelated_input(
    model: AdditiveModel | TransferFunction,
    interval: float,
    controller: DiscreteController,
    noise_filter: tuple[ArrayLike, ArrayLike],
) -> None:
    """Raise an error if instruments from the input of a loop are correlated with the noise at the same sample."""
    why = "the noise is coloured" if any(np.size(part) > 1 for part in noise_filter) else ""
    if not why and sampled_model(model, interval).state_space()[3].any() and controller.direct != 0.0:
        why = "model and controller both have direct feedthrough"
    if why:
        raise BiasedError(f"{why}, so that the input is correlated with the noise (closed_loop instruments are not)")


def output_variance(model: AdditiveModel | TransferFunction, interval: float, input_deviation: float) -> float:
    """Return the variance of the noise-free output of a stable model for held white noise as the input."""
    pulse = np.zeros(_memory(model, interval, OPEN, WHITE))
    pulse[0] = input_deviation
    x = simulate_loop(model, OPEN, pulse, 0.0, interval, "input").x
    return float(x @ x)


def _memory(
    model: AdditiveModel | TransferFunction,
    interval: float,
    controller: DiscreteController,
    noise_filter: tuple[ArrayLike, ArrayLike],
) -> int:
    """Return the number of samples after which pulse responses have decayed."""
    # Integrators of a submodel are inside the loop only; its other poles also occur in sensitivities outside the loop.
    denominators = [s.denominator for s in model.submodels] if isinstance(model, AdditiveModel) else [model.denominator]
    own = np.exp(interval * np.concatenate([np.roots(part) for part in denominators]).real).max(initial=0.0)
    radius = max(loop_radius(model, controller, interval), float(own))
    if radius >= 1.0:
        wrong = "the system, or its loop, is not stable: there is no limit for long records"
        raise DataError(f"{wrong}; its sampled poles reach the magnitude {radius:.6g}, and must stay below 1")
    slowest = max(radius, float(np.abs(np.roots(np.ravel(noise_filter[1]))).max(initial=0.0)), DEADBEAT)
    count = math.ceil(math.log(FORGOTTEN) / math.log(slowest) + model.delay / interval) + controller.order
    if count > LONGEST_MEMORY:
        raise DataError(f"the system is too slow for the limit of long records: its memory is {count} samples")
    return count


def _moments(responses: Sequence[Array]) -> Array:
    """Return the covariance of outputs driven by independent white noises, from the pulse responses to each."""
    return np.asarray(np.sum([response.T @ response for response in responses], axis=0))
