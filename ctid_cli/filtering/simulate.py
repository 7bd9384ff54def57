"""Exact response of a transfer function to a held input, at any instants."""

import numpy as np
from numpy.typing import ArrayLike

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError
from ctid_cli.filtering.bank import MODAL_CONDITION_LIMIT, chain_states, modal_form, modal_output
from ctid_cli.filtering.filter_data import FilterData, clock_slack, plain_array
from ctid_cli.filtering.realisation import chain, scaled_roots
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.band_limited import FINER
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.regularity import REGULARITY, regular_interval


def simulate(model: TransferFunction, signal: HeldSignal, times: ArrayLike) -> Array:
    """Output of a model at rest before the first break of its input.

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
        If the instants do not increase strictly, or the model has more zeros than poles.

    Notes
    -----
    No step size is involved: between the input's breaks the state moves by a matrix exponential. At the jump of a
    biproper model's input the value from the right is returned.

    Examples
    --------
    >>> from ctid_cli.signals.held import HeldSignal
    >>> step = HeldSignal([0.0], [1.0])
    >>> simulate(TransferFunction([1], [1, 1], delay=0.5), step, [0.25, 1.5]).round(6)
    array([0.      , 0.632121])
    """
    t = plain_array(times)
    if t.ndim != 1 or not np.isfinite(t).all() or not (np.diff(t) > 0).all():
        raise DataError("the instants of a simulation must be finite numbers that increase strictly")
    if t.size == 0:
        return t
    if signal.hold == "band-limited":
        signal = signal.lines
        # Where a sample is wanted at each of the input's own, a regular pass over the finer clock gives it.
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
    """What of its input a model passes on at once, and the numerator of the rest, in n coefficients."""
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
    w0, roots = scaled_roots(a)
    dynamics, gain, powers = chain(roots)
    n = gain.size
    reading = (b / w0 ** np.arange(1.0, n + 1))[::-1] @ powers
    return np.asarray(chain_states(dynamics, gain, w0, data, delay)[:, :n] @ reading)
