r"""Filtered signals of a record and their second moments, exactly, for any clock, hold and delay.

For a monic A of degree n, l integrators, a numerator B of lower degree than ``p^l A``, and a delay tau, the *standard
rows* at each used sample are

==========================  ===============================================================================
rows                        signal
==========================  ===============================================================================
``0 … n+l-1``               ``p^k/(p^l A) u(t - tau)``, k = 0 … n+l-1
``n+l``                     ``u(t - tau)``
``n+l+1 … 2n+l``            ``p^k/A x(t)``, k = 0 … n-1, ``x = B/(p^l A) u(t - tau)``
``2n+l+1 … 3n+l``           ``p^k/A y``, k = 0 … n-1
``3n+l+1``                  ``y - x``, the output error
``3n+l+2``                  ``p x``, the derivative of the output error with respect to tau
==========================  ===============================================================================

Every refined instrumental variable step, cost, gradient and Hessian is a function of their second moments.
"""

from typing import Literal, NamedTuple

import numpy as np

from ctid_cli.arrays import Array, ComplexArray, IntArray
from ctid_cli.filtering import kernels
from ctid_cli.filtering.filter_data import FilterData, plain_array, split_delay
from ctid_cli.filtering.realisation import chain, held_step, scaled_roots, transitions

#: Partial fractions are used while they amplify rounding by less than this; beyond, poles count as repeated.
MODAL_CONDITION_LIMIT = 1e4
#: Integrators that the modal form has.
MOST_MODAL_INTEGRATORS = 2

Form = Literal["auto", "modal", "chain"]
#: A delay [s]; on a regular clock also the breaks by which the read-out lags, and the fraction of an interval beyond.
Place = float | tuple[int, float]
#: No input besides the first, nothing that is not wanted.
NOTHING, NO_ROWS = np.zeros(0), np.zeros((0, 0))


class Equations(NamedTuple):
    """Second moments at one parameter vector, of sensitivities or instruments psi, regressors phi and output error."""

    #: ``sum psi phi'``, shape (p, p).
    instrument_regressor: Array
    #: ``sum psi eps``, shape (p,).
    instrument_error: Array
    #: ``sum psi psi'``, shape (p, p).
    hessian: Array
    #: Infinite where the parameters are inadmissible or the response is not finite.
    squared_error: float
    #: Sum of squares of the model output [output unit^2].
    output_power: float


class Modes(NamedTuple):
    """Partial fractions of one model, or of several submodels with their modes pooled."""

    #: One pole of each pair [rad/s], shape (m,).
    poles: ComplexArray
    #: Submodel of each mode, shape (m,).
    owner: IntArray
    #: Weights of z and w of each mode in the output, shape (m, 2).
    residues: ComplexArray
    #: Direct feed-through of each submodel.
    direct: Array

    @property
    def width(self) -> int:
        """Number of rows of z: one for a real pole, two for a pair."""
        return self.poles.size + int(np.count_nonzero(self.poles.imag))


class ModalForm(NamedTuple):
    """Partial fractions of the standard rows."""

    #: Amplification of rounding [-], infinite where poles coincide.
    condition: float
    poles: ComplexArray
    residues: ComplexArray
    #: The standard rows of the rows ``z, w, v, y - x, e`` of a pass.
    mapping: Array

    @property
    def modes(self) -> Modes:
        """The modes of a model by itself."""
        return Modes(self.poles, np.zeros(self.poles.size, np.int64), self.residues, np.zeros(1))


def modal_form(a: Array, b: Array, integrators: int = 0) -> ModalForm:
    """Return the partial fractions of ``B/(p^l A)``; their condition says whether they can be used."""
    w0, roots = scaled_roots(a)
    try:
        return ModalForm(*kernels.modal_form(a, b, integrators, roots * w0))
    except ZeroDivisionError:
        # A pole on the imaginary axis, or products that underflow.
        nothing = np.zeros(0, np.complex128)
        return ModalForm(np.inf, nothing, nothing.reshape(0, 2), NO_ROWS)


def modal_pass(
    data: FilterData,
    modes: Modes,
    delay: Place,
    *,
    rows: bool = False,
    double: bool = True,
    filter_output: bool = True,
    leading: int | None = None,
    states: ComplexArray | None = None,
    instruments: Array | None = None,
) -> Array:
    """Return the moments of the rows of a pass, or the rows themselves, shape (count, q).

    The rows are z of all modes; w, if ``double``; v; ``y - sum x``; and, if ``filter_output``, e. Where ``instruments``
    are given they are v, held between the samples of a regular clock, and the rows go on with z, w and u of the input
    itself. ``leading`` rows are multiplied with all (default: all); ``states`` are those at the first sample, and
    become those after the last one, shape (m, 5).
    """
    n = modes.width
    layout = (n if double else 0, 2 * n if double else n, (2 * n + 2 if double else n + 2) if filter_output else 0)
    width = layout[1] + 2 + (n if filter_output else 0) + (0 if instruments is None else 2 * n + 1)
    if rows:
        found = np.zeros((data.count, width))
        _run(data, modes, delay, layout, states, instruments, NO_ROWS, found, NOTHING)
        return found
    # Moments are summed in tiles of two rows and four columns.
    factors = width if leading is None else leading
    gram = np.zeros((factors + factors % 2, width + 3))
    _run(data, modes, delay, layout, states, instruments, gram, NO_ROWS, NOTHING)
    return gram[:factors, :width]


def to_steady_state(poles: ComplexArray, period: float, states: ComplexArray) -> None:
    """Turn what one period adds to z and w from rest into the states at both ends of a periodic input, in place."""
    # z(T) = decay z(0) + what the period adds, the same at both ends; and w(T) = decay (w(0) + T z(0)) + …
    missing = -np.expm1(poles * period)
    states[:, 0] /= missing
    states[:, 1] = (states[:, 1] + period * (1.0 - missing) * states[:, 0]) / missing


def modal_output(data: FilterData, modes: Modes, delay: float) -> Array:
    """Return the output of a model at all samples of a clock, shape (N,)."""
    n, x = modes.width, np.zeros(data.t.size)
    _run(data, modes, delay, (n, 2 * n, 0), None, None, NO_ROWS, NO_ROWS, x)
    return x


def _run(
    data: FilterData,
    modes: Modes,
    delay: Place,
    layout: tuple[int, int, int],
    states: ComplexArray | None,
    instruments: Array | None,
    gram: Array,
    rows: Array,
    simulated: Array,
) -> None:
    """Run the pass for the clock of a record."""
    if states is None:
        states = np.zeros((modes.poles.size, 5), np.complex128)
    grid, clock = None, None
    if data.interval > 0.0:
        grid = (data.interval, *_place(delay, data.interval))
    else:
        assert not isinstance(delay, tuple)
        clock = (data.t, data.tu, float(delay), data.slack)
    driving, measured = ((data.u, data.input_foh), NOTHING) if instruments is None else ((instruments, False), data.u)
    output = data.y, data.y_foh
    kernels.filter_pass(*modes, states, grid, clock, driving, measured, output, data.use, layout, gram, rows, simulated)


def _place(delay: Place, interval: float) -> tuple[int, float]:
    """Return the breaks by which the read-out lags, and the fraction of an interval that is read beyond."""
    return delay if isinstance(delay, tuple) else split_delay(delay, interval)


def chain_states(
    dynamics: Array, gain: Array, w0: float, data: FilterData, delay: Place, initial: Array | None = None
) -> Array:
    """Return ``[z, u]`` at all samples for the chain ``z' = w0 (F z + g u)``, shape (N, n + 1)."""
    initial = np.zeros(gain.size) if initial is None else initial
    if data.interval == 0.0:
        longest = max(
            float(np.diff(data.t).max(initial=0.0)),
            float(np.diff(data.tu).max(initial=0.0)),
            float(data.t[-1] - delay - data.tu[-1]),
        )
        table = transitions(dynamics, gain, longest * w0)
        instants = (data.t - delay) * w0
        breaks = data.tu * w0, data.u, data.input_foh
        return np.asarray(kernels.irregular_states(*table, *breaks, instants, data.slack * w0, initial)[:, :-1])
    shift, fraction = _place(delay, data.interval)
    count, late = data.t.size, min(shift, data.t.size)
    values, changes = np.zeros(count), np.zeros(count)
    values[late:] = data.u[: count - late]
    if data.input_foh:
        changes[late:] = np.diff(data.u, append=data.u[-1])[: count - late]
    step = held_step(dynamics, gain, data.interval * w0)
    states = kernels.regular_states(*step, values, changes, initial)
    if fraction > 0.0:
        # The states stand at the break before the instant that arrives now: this reads them out there.
        part = held_step(dynamics, gain, fraction * data.interval * w0)
        states = states @ part.transition.T + np.outer(values, part.from_value)
        states += np.outer(fraction * changes, part.from_change)
    return np.column_stack((states, values + fraction * changes))


class DoubleChain(NamedTuple):
    """A chain ``z1' = w0 (F z1 + g u)`` and a second one behind it, driven by ``x = B/(p^l A) u``."""

    w0: float
    dynamics: Array
    gain: Array
    #: Maps from the states of one chain to ``p^k/(p^l A)`` of what drives it, in s, and to x.
    powers: Array
    output: Array

    @property
    def order(self) -> int:
        """Number of states of one chain."""
        return self.output.size

    def signals(self, states: Array, integrators: int) -> tuple[Array, Array]:
        """Return ``p^k/(p^l A) u`` and ``p^k/A x`` from the states of both chains, columns."""
        driven = states[:, : self.order] @ self.powers.T
        return driven, (states[:, self.order : 2 * self.order] @ self.powers.T)[:, integrators:]

    def after_impulse(self, elapsed: Array) -> Array:
        """Return the states of both chains after an impulse of u [s]."""
        table = transitions(self.dynamics, self.gain, float(elapsed.max()) * self.w0)
        breaks = np.zeros(1), np.zeros(1), False
        initial = self.gain * self.w0
        return np.asarray(kernels.irregular_states(*table, *breaks, elapsed * self.w0, 0.0, initial))


def double_chain(a: Array, b: Array, integrators: int) -> DoubleChain:
    """Realise ``1/(p^l A)`` twice in a row."""
    order = a.size - 1 + integrators
    w0, roots = scaled_roots(np.concatenate((a, np.zeros(integrators))))
    single, entry, powers = chain(roots)
    powers = powers * (w0 ** np.arange(-order, 0.0))[:, None]
    output = b[::-1] @ powers[: b.size]
    dynamics = np.asarray(np.kron(np.eye(2), single), dtype=np.float64)
    dynamics[order:, :order] = np.outer(entry, output)
    return DoubleChain(w0, dynamics, np.concatenate((entry, np.zeros(order))), powers, output)


def _chain_rows(a: Array, b: Array, integrators: int, delay: float, data: FilterData) -> Array:
    """Return the standard rows for any poles."""
    both = double_chain(a, b, integrators)
    n, order = a.size - 1, both.order
    states = chain_states(both.dynamics, both.gain, both.w0, data, delay)[data.use]
    of_output = data._replace(u=data.y, tu=data.t, input_foh=data.y_foh)
    filtered = chain_states(both.dynamics[:order, :order], both.gain[:order], both.w0, of_output, 0.0)[data.use, :order]
    u, error = states[:, -1:], data.y_used - states[:, :order] @ both.output
    driven, behind = both.signals(states, integrators)
    highest = u[:, 0] - driven[:, order - np.arange(1, n + 1)] @ a[1:]
    slope = np.column_stack((driven[:, 1:], highest))[:, : b.size] @ b[::-1]
    return np.column_stack((driven, u, behind, (filtered @ both.powers.T)[:, integrators:], error, slope))


def standard_rows(
    data: FilterData, a: Array, b: Array, delay: float = 0.0, form: Form = "auto", integrators: int = 0
) -> Array:
    """Return the standard rows at the used samples, shape (count, 3 n + l + 3)."""
    return _standard(data, a, b, delay, form, integrators, True)


def second_moments(
    data: FilterData, a: Array, b: Array, delay: float = 0.0, form: Form = "auto", integrators: int = 0
) -> Array:
    """Return the sums of products of the standard rows over the used samples."""
    return _standard(data, a, b, delay, form, integrators, False)


def _standard(data: FilterData, a: Array, b: Array, delay: float, form: Form, integrators: int, rows: bool) -> Array:
    limit = {"chain": 0.0, "modal": np.inf, "auto": MODAL_CONDITION_LIMIT}[form]
    a, b = plain_array(a), plain_array(b)
    if integrators <= MOST_MODAL_INTEGRATORS and limit > 0.0:
        modal = modal_form(a, b, integrators)
        if modal.condition < limit:
            found = modal_pass(data, modal.modes, delay, rows=rows)
            mapping = modal.mapping
            return found @ mapping.T if rows else mapping @ found @ mapping.T
    found = _chain_rows(a, b, integrators, delay, data)
    return found if rows else found.T @ found
