"""One compiled pass over a regular record for a sum of submodels, in open or closed loop.

All submodels are driven by one held input, so their modes are *pooled*: for each pole p of any submodel the pass
advances ``z = 1/(s - p) v`` and ``w = 1/(s - p)^2 v`` of the instrument source v, and ``e = 1/(s - p)`` of what the
other submodels leave of the output, ``y - sum of the other x_l``. In open loop v is the input u. In closed loop v is
the input of the noise-free loop of the *model* with the controller, driven by the reference; the loop is simulated
before the pass, and a further ``z_u = 1/(s - p) u`` of the measured input makes the model outputs.

Everything is done block by block, mode by mode, see :mod:`ctid_cli.filtering.mode_blocks`.
"""

import numpy as np
from numba import njit

from ctid_cli.arrays import Array, ComplexArray, IntArray
from ctid_cli.filtering.filter_data import FilterData, split_delay
from ctid_cli.filtering.mode_blocks import Clock, Source, first_rows, keep_used, output_block
from ctid_cli.filtering.partial_fractions import MODAL_CONDITION_LIMIT
from ctid_cli.filtering.row_sink import BLOCK, RowSink, emit, finish, row_sink
from ctid_cli.filtering.step_weights import all_weights
from ctid_cli.filtering.submodel_blocks import LoopData, input_block, loop_input
from ctid_cli.filtering.submodel_map import PooledModes, pooled_modes


@njit(cache=True, nogil=True)
def _model_outputs(modes: PooledModes, first: IntArray, count: int, block: Array, outputs: Array) -> None:
    """Outputs of the submodels over a block, from the rows driven by the measured input, shape (submodels, BLOCK)."""
    layout = modes.layout
    for i in range(outputs.shape[0]):
        for k in range(count):
            outputs[i, k] = 0.0
    # Re(residue z_u), summed for each submodel; a pair has real and imaginary part as neighbouring rows.
    for i in range(modes.poles.size):
        source, target = layout.u_modes + first[i], modes.owner[i]
        re, im = modes.residues[i].real, modes.residues[i].imag
        if modes.poles[i].imag != 0.0:
            for k in range(count):
                outputs[target, k] += re * block[source, k] - im * block[source + 1, k]
        else:
            for k in range(count):
                outputs[target, k] += re * block[source, k]
    # The integrals belong to one submodel, as does the feed-through.
    for m in range(layout.integrals):
        for k in range(count):
            outputs[modes.origin_owner, k] += modes.origin[m] * block[layout.u_integrals + m, k]
    if modes.direct != 0.0:
        for k in range(count):
            outputs[modes.direct_owner, k] += modes.direct * block[layout.u_value, k]


@njit(cache=True, nogil=True)
def _submodel_pass(
    modes: PooledModes,
    submodels: int,
    loop: LoopData,
    shift: int,
    fraction: float,
    data: FilterData,
    states: ComplexArray,
    sink: RowSink,
) -> None:
    """Pass over a regular record, with the delay ``(shift - fraction) interval``.

    ``states`` holds z, w, e and z_u of each mode, and is left as it is after the last sample, shape (modes, 4).
    """
    poles, layout, block = modes.poles, modes.layout, sink.block
    first = first_rows(poles)
    closed = loop.reference.size > 0
    whole, part = all_weights(poles, data.interval), all_weights(poles, data.interval * fraction)
    clock = Clock(data.interval, shift, fraction, whole, part)
    v = loop_input(modes, clock, loop)
    # The rows of psi, driven by v, and those of phi and the model output, driven by u: in open loop the same.
    foh = data.input_foh and not closed
    instruments = Source(v if closed else data.u, foh, 0, layout.modes, 2 * layout.modes, layout.value)
    measured = Source(data.u, foh, layout.u_modes, -1, layout.u_integrals, layout.u_value)
    integrals = np.zeros((2, layout.integrals))
    outputs, before = np.zeros((submodels, BLOCK)), np.zeros(submodels)
    written = 0
    for start in range(0, data.y.size, BLOCK):
        count = min(BLOCK, data.y.size - start)
        input_block(modes, first, clock, instruments, start - shift, count, states, integrals[0], block)
        if closed:
            input_block(modes, first, clock, measured, start - shift, count, states[:, 3:], integrals[1], block)
        _model_outputs(modes, first, count, block, outputs)
        # eps = y - sum of x_i.
        for k in range(count):
            total = data.y[start + k]
            for i in range(submodels):
                total -= outputs[i, k]
            block[layout.error, k] = total
        # What the other submodels leave of the output drives e.
        for i in range(submodels):
            for k in range(count):
                outputs[i, k] += block[layout.error, k]
        for i in range(poles.size):
            row, paired, left = layout.error + 1 + first[i], poles[i].imag != 0.0, outputs[modes.owner[i]]
            last = before[modes.owner[i]]
            output_block(clock.whole[i], left, last, start > 0, data.y_foh, states[i], row, paired, count, block)
        # The next block's first step starts from here.
        for i in range(submodels):
            before[i] = outputs[i, count - 1]
        written = emit(sink, keep_used(data.use, start, count, block), written)
    finish(sink, 0, written)


@njit(cache=True, nogil=True)
def _unused(data: FilterData, y: Array) -> FilterData:
    """The record with another output, of which no sample enters sums."""
    use = np.zeros(y.size, np.bool_)
    return FilterData(data.t, y, use, data.tu, data.u, data.input_foh, data.y_foh, data.interval, data.common_clock)


@njit(cache=True, nogil=True, error_model="numpy")
def _periodic_states(
    modes: PooledModes, submodels: int, loop: LoopData, shift: int, fraction: float, data: FilterData
) -> ComplexArray:
    """States that come back after one period."""
    count = data.y.size
    period = data.interval * count
    sink = row_sink(modes.layout.width, np.zeros(count, np.bool_), True)
    decay = np.exp(modes.poles * period)
    initial = np.zeros((modes.poles.size, 4), np.complex128)
    states = initial.copy()
    _submodel_pass(modes, submodels, loop, shift, fraction, _unused(data, data.y), states, sink)
    # z(T) = decay z(0) + what the period adds, the same at both ends; and w(T) = decay (w(0) + T z(0)) + …
    for i in range(decay.size):
        initial[i, 0] = states[i, 0] / (1.0 - decay[i])
        initial[i, 1] = (states[i, 1] + period * decay[i] * initial[i, 0]) / (1.0 - decay[i])
    # What filters see of the output depends on the output of the model, so it comes second; and once round, back at the
    # first sample.
    states = initial.copy()
    _submodel_pass(modes, submodels, loop, shift, fraction, _unused(data, np.append(data.y, data.y[0])), states, sink)
    for i in range(decay.size):
        initial[i, 2] = states[i, 2] / (1.0 - decay[i])
    return initial


@njit(cache=True, nogil=True)
def filtered_submodels(
    theta: Array, degrees: IntArray, loop: LoopData, delay: float, periodic: bool, data: FilterData, want_rows: bool
) -> tuple[float, int, Array, Array]:
    """Rows of the pass, or their moments, and what makes psi, phi and the model output of them: one compiled entry.

    The condition of the partial fractions, above whose limit there is no pass; the row of the output error; the maps,
    shape (2 p + 1, q); and rows, or the moments of those up to the error with all, shape (row + 1, q).
    """
    modes = pooled_modes(theta, degrees, loop.reference.size > 0)
    layout, submodels = modes.layout, degrees.shape[0]
    sink = row_sink(layout.width, data.use, want_rows, layout.error + 1)
    if modes.condition < MODAL_CONDITION_LIMIT:
        shift, fraction = split_delay(delay, data.interval)
        # A periodic input comes already late by whole intervals, and begins in its steady state.
        shift = 0 if periodic else shift
        states = np.zeros((modes.poles.size, 4), np.complex128)
        if periodic:
            states = _periodic_states(modes, submodels, loop, shift, fraction, data)
        _submodel_pass(modes, submodels, loop, shift, fraction, data, states, sink)
    return modes.condition, layout.error, modes.maps, sink.rows if want_rows else sink.gram
