"""Exact responses of models to a held input at any instants, and their zero-order-hold equivalents."""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError
from ctid_cli.filtering.bank import (
    MODAL_CONDITION_LIMIT,
    Chains,
    chain_form,
    chain_states,
    modal_form,
    modal_output,
)
from ctid_cli.filtering.filter_data import FilterData, clock_slack, plain_array, split_delay
from ctid_cli.filtering.realisation import held_step
from ctid_cli.models.additive import AdditiveModel
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.band_limited import FINER
from ctid_cli.signals.checks import require_positive
from ctid_cli.signals.held import REGULARITY, HeldSignal, regular_interval


def simulate(model: TransferFunction, signal: HeldSignal, times: ArrayLike) -> Array:
    """Return the output of a model at rest before the first break of its input.

    Parameters
    ----------
    model : TransferFunction
        Any proper transfer function: up to order 12 with poles spread over six decades, repeated poles included.
    signal : HeldSignal
        The input; zero before its first break.
    times : array_like, shape (N,)
        Instants [s], strictly increasing.

    Returns
    -------
    ndarray, shape (N,)
        Noise-free output [output unit].

    Raises
    ------
    DataError
        If the input is no held signal, the instants do not increase strictly, or the model has more zeros than poles.

    Notes
    -----
    No step size is involved: between the input's breaks the state advances by a matrix exponential. At the jump of a
    biproper model's input the value from the right is returned.

    Examples
    --------
    >>> from ctid_cli.signals.held import HeldSignal
    >>> step = HeldSignal([0.0], [1.0])
    >>> simulate(TransferFunction([1], [1, 1], delay=0.5), step, [0.25, 1.5]).round(6)
    array([0.      , 0.632121])
    """
    if not isinstance(signal, HeldSignal):
        what = type(signal).__name__
        raise DataError(f"the input of a simulation must be a HeldSignal, such as HeldSignal(t, u), not {what}")
    t = plain_array(times)
    if t.ndim != 1 or not np.isfinite(t).all() or not (np.diff(t) > 0).all():
        raise DataError("the instants of a simulation must be finite numbers that increase strictly")
    if t.size == 0:
        return t
    if signal.hold == "band-limited":
        signal = signal.lines
        # At the instants of the input's samples a pass over the finer regular clock suffices.
        if np.array_equal(t, signal.t[::FINER]):
            return simulate(model, signal, signal.t)[::FINER].copy()
    direct, strictly_proper = feedthrough(model)
    if model.order == 0:
        return np.asarray(direct * signal.at(t - model.delay))
    interval = regular_interval(t)
    on_grid = (
        interval is not None and signal.t.size == t.size and bool(np.abs(signal.t - t).max() <= REGULARITY * interval)
    )
    data = FilterData(
        t=t,
        y=np.zeros(t.size),
        use=np.zeros(0, dtype=bool),
        tu=plain_array(signal.t),
        u=plain_array(signal.values),
        input_foh=signal.hold == "foh",
        y_foh=False,
        interval=(interval or 0.0) if on_grid else 0.0,
        common_clock=False,
        slack=clock_slack(t, signal.t),
    )
    x: Array = _response(plain_array(model.denominator), plain_array(strictly_proper), model.delay, data)
    if direct:
        x = x + direct * signal.at(t - model.delay)
    return x


def feedthrough(model: TransferFunction) -> tuple[float, Array]:
    """Return the direct feedthrough of a model, and the n numerator coefficients of its strictly proper part."""
    if model.relative_degree < 0:
        raise DataError("a model with more zeros than poles has no response to a jump")
    numerator = np.concatenate([np.zeros(model.relative_degree), model.numerator])
    direct = float(numerator[0])
    return direct, (numerator - direct * model.denominator)[1:]


def _response(a: Array, b: Array, delay: float, data: FilterData) -> Array:
    """Return the output of a strictly proper model at all samples of a clock; ``b`` has n entries."""
    modal = modal_form(a, b)
    if modal.condition < MODAL_CONDITION_LIMIT:
        return modal_output(data, modal.modes, delay)
    form = chain_form(a, b)
    return np.asarray(chain_states(form.dynamics, form.gain, form.w0, data, delay)[:, :-1] @ form.output)


class SampledModel(NamedTuple):
    r"""Sampled model ``z_(k+1) = F z_k + g u_(k-shift)``, ``x_k = c z_k + d u_(k-shift)`` for a zero-order hold."""

    #: F, block diagonal for a sum of submodels, shape (n, n).
    transition: Array
    #: g, shape (n,).
    from_input: Array
    #: c, shape (n,).
    output: Array
    direct: float
    shift: int

    def state_space(self) -> tuple[Array, Array, Array, Array]:
        """Return the realisation with the delayed inputs as further states."""
        n, size = self.from_input.size, self.from_input.size + self.shift
        A, B, C, D = np.zeros((size, size)), np.zeros((size, 1)), np.zeros((1, size)), np.zeros((1, 1))
        A[:n, :n], C[0, :n] = self.transition, self.output
        if self.shift:
            # The states after the plant's are u_(k-1) … u_(k-shift).
            A[:n, -1], C[0, -1], B[n, 0] = self.from_input, self.direct, 1.0
            A[n:, n:] = np.eye(self.shift, k=-1)
        else:
            B[:, 0], D[0, 0] = self.from_input, self.direct
        return A, B, C, D


def sampled_model(model: AdditiveModel | TransferFunction, interval: float) -> SampledModel:
    r"""Return the exact zero-order-hold equivalent of a model at rest.

    With the delay ``(shift - fraction) h``, ``0 <= fraction < 1``, the output at ``t_k`` is that of the undelayed model
    ``fraction h`` after ``t_(k-shift)``, where its input is still ``u_(k-shift)``.
    """
    require_positive("the sampling interval", interval, "s")
    parts = [s.transfer_function() for s in model.submodels] if isinstance(model, AdditiveModel) else [model]
    split = [feedthrough(part) for part in parts]
    forms = [
        chain_form(plain_array(part.denominator), plain_array(rest))
        for part, (_, rest) in zip(parts, split, strict=True)
    ]
    return sampled_chains(Chains(tuple(forms), np.array([direct for direct, _ in split])), interval, model.delay)


def sampled_chains(chains: Chains, interval: float, delay: float) -> SampledModel:
    """Return the zero-order-hold equivalent of chains."""
    shift, fraction = split_delay(delay, interval)
    size, first, at_once = sum(form.width for form in chains.forms), 0, float(chains.direct.sum())
    transition, from_input, output = np.zeros((size, size)), np.zeros(size), np.zeros(size)
    for form in chains.forms:
        place = slice(first, first + form.width)
        transition[place, place], from_input[place], _ = held_step(form.dynamics, form.gain, interval * form.w0)
        part_way, from_held, _ = held_step(form.dynamics, form.gain, fraction * interval * form.w0)
        output[place], at_once = form.output @ part_way, at_once + float(form.output @ from_held)
        first += form.width
    return SampledModel(transition, from_input, output, at_once, shift)


def simulate_additive(model: AdditiveModel, signal: HeldSignal, times: ArrayLike) -> Array:
    """Return the output of a sum of submodels at rest before the first break of its input.

    Parameters
    ----------
    model : AdditiveModel
        The sum.
    signal : HeldSignal
        The input; zero before its first break.
    times : array_like, shape (N,)
        Instants [s], strictly increasing.

    Returns
    -------
    ndarray, shape (N,)
        Noise-free output [output unit].

    Raises
    ------
    DataError
        If the instants do not increase strictly.

    Notes
    -----
    Exact for every clock and delay, as :func:`ctid_cli.filtering.simulate`. Submodels are simulated separately, which
    avoids a polynomial of the order of the sum and the rounding of its roots.

    Examples
    --------
    >>> from ctid_cli.models.additive import Submodel
    >>> model = AdditiveModel([Submodel([1.0], [1.0, 1.0]), Submodel([2.0], [0.5, 1.0])])
    >>> simulate_additive(model, HeldSignal([0.0], [1.0]), [1.0]).round(6)
    array([2.36145])
    """
    parts = [submodel.transfer_function() for submodel in model.submodels]
    delayed = [TransferFunction(part.numerator, part.denominator, model.delay) for part in parts]
    return np.asarray(np.sum([simulate(part, signal, times) for part in delayed], axis=0))
