"""Exact response of a transfer function to a held input, at any instants."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError
from ctid_cli.filtering.exponential import held_step
from ctid_cli.filtering.filter_data import plain_array, split_delay
from ctid_cli.filtering.kernels import irregular_chain_pass, regular_chain_pass
from ctid_cli.filtering.realisation import chain, polynomial_roots, scaled_denominator, time_scale
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import REGULARITY, regular_interval


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
    if model.relative_degree < 0:
        raise DataError("a model with more zeros than poles has no response to a jump")
    if model.order == 0:
        return np.asarray(model.numerator[0] * signal.at(t - model.delay))
    numerator = np.concatenate([np.zeros(model.relative_degree), model.numerator])
    direct = numerator[0]
    strictly_proper = (numerator - direct * model.denominator)[1:]
    foh = signal.hold == "foh"
    interval = regular_interval(t)
    on_grid = (
        interval is not None and signal.t.size == t.size and bool(np.abs(signal.t - t).max() <= REGULARITY * interval)
    )
    x: Array = _response(
        plain_array(model.denominator),
        plain_array(strictly_proper),
        model.delay,
        (interval or 0.0) if on_grid else 0.0,
        plain_array(signal.t),
        plain_array(signal.values),
        foh,
        t,
    )
    if direct:
        x = x + direct * signal.at(t - model.delay)
    return x


@njit(cache=True, nogil=True)
def _response(
    a: Array, b: Array, delay: float, interval: float, tu: Array, u: Array, input_foh: bool, t: Array
) -> Array:
    """Compiled body of :func:`simulate`; ``interval`` is 0 on an irregular clock, ``b`` has n entries."""
    n = a.size - 1
    w0 = time_scale(a)
    dynamics, gain, powers = chain(polynomial_roots(scaled_denominator(a, w0)))
    output_map = np.zeros(n)
    for i in range(n):
        for j in range(n):
            output_map[j] += b[i] / w0 ** (i + 1) * powers[n - 1 - i, j]
    output = np.zeros(t.size)
    none, empty = np.zeros(0), np.zeros((0, 0))
    use = np.zeros(0, np.bool_)
    if interval > 0.0:
        transition, from_value, from_change = held_step(dynamics, gain, interval * w0)
        shift, fraction = split_delay(delay, interval)
        regular_map = np.zeros(n + 2)
        if fraction > 0.0:
            part, part_value, part_change = held_step(dynamics, gain, fraction * interval * w0)
            for i in range(n):
                for j in range(n):
                    regular_map[j] += output_map[i] * part[i, j]
                regular_map[n] += output_map[i] * part_value[i]
                regular_map[n + 1] += output_map[i] * part_change[i] * fraction
        else:
            for i in range(n):
                regular_map[i] = output_map[i]
        regular_chain_pass(
            transition,
            from_value,
            from_change,
            regular_map,
            u,
            input_foh,
            shift,
            empty,
            none,
            none,
            t,
            False,
            use,
            output,
            empty,
            empty,
        )
    else:
        irregular_chain_pass(
            dynamics,
            gain,
            output_map,
            tu * w0,
            u,
            input_foh,
            delay * w0,
            empty,
            none,
            t * w0,
            t,
            False,
            use,
            output,
            empty,
            empty,
        )
    return output
