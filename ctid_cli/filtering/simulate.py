"""Exact response of a transfer function to a held input, at any instants."""

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError
from ctid_cli.filtering.chain_pass import irregular_chain_pass, regular_chain_pass
from ctid_cli.filtering.exponential import held_readout, held_step
from ctid_cli.filtering.filter_data import FilterData, in_unit, plain_array, split_delay
from ctid_cli.filtering.realisation import chain, scaled_roots
from ctid_cli.filtering.row_sink import RowSink
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
        y=t,
        use=np.zeros(0, dtype=bool),
        tu=plain_array(signal.t),
        u=plain_array(signal.values),
        input_foh=signal.hold == "foh",
        y_foh=False,
        interval=(interval or 0.0) if on_grid else 0.0,
        common_clock=False,
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


@njit(cache=True, nogil=True)
def _response(a: Array, b: Array, delay: float, data: FilterData) -> Array:
    """Compiled body of :func:`simulate`: no output is filtered and no row kept; ``b`` has n entries."""
    n = a.size - 1
    w0, roots = scaled_roots(a)
    dynamics, gain, powers = chain(roots)
    output_map = np.zeros(n)
    for i in range(n):
        for j in range(n):
            output_map[j] += b[i] / w0 ** (i + 1) * powers[n - 1 - i, j]
    # Only the output is asked for: no rows, no moments.
    nothing = np.zeros((0, 0))
    sink = RowSink(nothing, nothing, nothing, np.zeros(data.t.size))
    if data.interval == 0.0:
        irregular_chain_pass(dynamics, gain, output_map, delay * w0, in_unit(data, w0), sink)
        return sink.output
    shift, fraction = split_delay(delay, data.interval)
    # x at the instant that arrives now, from the states and the held input at the break before it.
    arrived = held_readout(dynamics, gain, data.interval * w0, fraction)
    readout = np.zeros(n + 2)
    for i in range(n):
        for j in range(n + 2):
            readout[j] += output_map[i] * arrived[i, j]
    regular_chain_pass(held_step(dynamics, gain, data.interval * w0), readout, shift, data, sink)
    return sink.output
