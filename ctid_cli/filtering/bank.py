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
from ctid_cli.filtering.filter_data import FilterData, plain_array, split_delay
from ctid_cli.filtering.realisation import chain, held_step, scaled_roots, transitions

#: Partial fractions are used if they amplify rounding by less than this; otherwise poles count as repeated.
MODAL_CONDITION_LIMIT = 1e4
#: Largest number of integrators in modal form.
MOST_MODAL_INTEGRATORS = 2

Form = Literal["auto", "modal", "chain"]
#: A delay [s]; on a regular clock alternatively the number of breaks by which the read-out lags, and the fraction of an
#: interval from that break to the read-out.
Place = float | tuple[int, float]
#: Empty arrays: no second input, and outputs that are not requested.
NOTHING, NO_ROWS = np.zeros(0), np.zeros((0, 0))


class Equations(NamedTuple):
    """Second moments of sensitivities or instruments psi, regressors phi and output error at one parameter vector."""

    #: ``sum psi phi'``, shape (p, p).
    instrument_regressor: Array
    #: ``sum psi eps``, shape (p,).
    instrument_error: Array
    #: ``sum psi psi'``, shape (p, p).
    hessian: Array
    #: Sum of squared output errors; infinite for inadmissible parameters or a response that is not finite.
    squared_error: float
    #: Sum of squares of the model output [output unit^2].
    output_power: float


class Modes(NamedTuple):
    """Partial fractions of one model, or of several submodels (modes concatenated)."""

    #: One pole of each pair [rad/s], shape (m,).
    poles: ComplexArray
    #: Submodel of each mode, shape (m,).
    owner: IntArray
    #: Weights of z and w of each mode in the output, shape (m, 2).
    residues: ComplexArray
    #: Direct feedthrough of each submodel.
    direct: Array

    @property
    def width(self) -> int:
        """Number of rows of z: one for a real pole, two for a pair."""
        return self.poles.size + int(np.count_nonzero(self.poles.imag))


class ModalForm(NamedTuple):
    """Partial fractions of the standard rows."""

    #: Amplification of rounding [-]; infinite if poles coincide.
    condition: float
    poles: ComplexArray
    residues: ComplexArray
    #: Map from the rows ``z, w, v, y - x, e`` of a pass to the standard rows.
    mapping: Array

    @property
    def width(self) -> int:
        """Number of rows of z."""
        return self.modes.width

    @property
    def modes(self) -> Modes:
        """Modes of the single model."""
        return Modes(self.poles, np.zeros(self.poles.size, np.int64), self.residues, np.zeros(1))


def modal_form(a: Array, b: Array, integrators: int = 0) -> ModalForm:
    """Return the partial fractions of ``B/(p^l A)``; check their condition before use."""
    from ctid_cli.filtering import kernels  # numba is slow to import

    w0, roots = scaled_roots(a)
    return ModalForm(*kernels.modal_form(a, b, integrators, roots * w0))


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

    The rows are z of all modes; w, if ``double``; v; ``y - sum x``; and, if ``filter_output``, e. ``instruments``, if
    given, replace the input as v, held between the samples of a regular clock, and are followed by the rows z, w and u
    of the input. The first ``leading`` rows are multiplied with all rows (default: all); ``states``, shape (m, 5), are
    those at the first sample, and are overwritten by those after the last one.
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
    """Convert z and w after one period from rest into the periodic states, in place."""
    # z(T) = decay z(0) + z after a period from rest, with z(T) = z(0); and w(T) = decay (w(0) + T z(0)) + …
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
    """Run the compiled pass on the clock of a record."""
    from ctid_cli.filtering import kernels  # numba is slow to import

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
    """Return the number of breaks by which the read-out lags, and the fraction of an interval after that break."""
    return delay if isinstance(delay, tuple) else split_delay(delay, interval)


def chain_states(
    dynamics: Array, gain: Array, w0: float, data: FilterData, delay: Place, initial: Array | None = None
) -> Array:
    """Return ``[z, u]`` at all samples for the chain ``z' = w0 (F z + g u)``, shape (N, n + 1)."""
    from ctid_cli.filtering import kernels  # numba is slow to import

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
        # The states are those at a break; move them to the read-out instant, a fraction of an interval later.
        part = held_step(dynamics, gain, fraction * data.interval * w0)
        states = states @ part.transition.T + np.outer(values, part.from_value)
        states += np.outer(fraction * changes, part.from_change)
    return np.column_stack((states, values + fraction * changes))


class ChainForm(NamedTuple):
    """A chain ``z' = w0 (F z + g u)``, and its map to the standard rows with a second chain driven by x."""

    w0: float
    dynamics: Array
    gain: Array
    #: Map from the states to ``x = B/(p^l A) u``.
    output: Array
    #: Map from the rows ``z, w, v, y - x, e`` of a pass to the standard rows.
    mapping: Array

    @property
    def width(self) -> int:
        """Number of states of one chain."""
        return self.gain.size

    @property
    def double(self) -> tuple[Array, Array]:
        """Dynamics and gain of both chains in series."""
        n = self.width
        dynamics = np.asarray(np.kron(np.eye(2), self.dynamics), dtype=np.float64)
        dynamics[n:, :n] = np.outer(self.gain, self.output)
        return dynamics, np.concatenate((self.gain, np.zeros(n)))

    def after_impulse(self, elapsed: Array) -> Array:
        """Return the states of both chains after an impulse of u [s]."""
        from ctid_cli.filtering import kernels  # numba is slow to import

        dynamics, gain = self.double
        table = transitions(dynamics, gain, float(elapsed.max()) * self.w0)
        breaks = np.zeros(1), np.zeros(1), False
        states = kernels.irregular_states(*table, *breaks, elapsed * self.w0, 0.0, gain * self.w0)
        return np.asarray(states[:, :-2])


def chain_form(a: Array, b: Array, integrators: int = 0) -> ChainForm:
    """Return the chain of ``B/(p^l A)``."""
    n, order = a.size - 1, a.size - 1 + integrators
    w0, roots = scaled_roots(np.concatenate((a, np.zeros(integrators))))
    dynamics, gain, powers = chain(roots)
    powers = powers * (w0 ** np.arange(-order, 0.0))[:, None]
    mapping = np.zeros((3 * n + integrators + 3, 3 * order + 2))
    mapping[:order, :order], mapping[order, 2 * order] = powers, 1.0
    mapping[order + 1 : order + n + 1, order : 2 * order] = powers[integrators:]
    mapping[order + n + 1 : order + 2 * n + 1, 2 * order + 2 :] = powers[integrators:]
    mapping[-2, 2 * order + 1] = 1.0
    # p x, where p^(n + l)/(p^l A) v = v - sum of a_k p^(n + l - k)/(p^l A) v.
    highest = mapping[order] - a[1:] @ mapping[order - np.arange(1, n + 1)]
    mapping[-1] = b[::-1] @ np.vstack((mapping[1:order], highest))[: b.size]
    return ChainForm(w0, dynamics, gain, b[::-1][:order] @ powers[: b.size], mapping)


class Chains(NamedTuple):
    """Chains of one model or of several submodels, with the direct feedthrough of each."""

    forms: tuple[ChainForm, ...]
    direct: Array


def chain_pass(data: FilterData, chains: Chains, delay: float, instruments: Array | None = None) -> Array:
    """Return the rows of a pass over chains, shape (count, q), with the rows of all chains concatenated."""
    inputs = [data] if instruments is None else [data._replace(u=instruments, input_foh=False), data]
    columns: list[list[Array]] = []
    for driving in inputs:
        states = [chain_states(*form.double, form.w0, driving, delay) for form in chains.forms]
        singles = [state[:, : form.width] for form, state in zip(chains.forms, states, strict=True)]
        doubles = [state[:, form.width : -1] for form, state in zip(chains.forms, states, strict=True)]
        columns.append([*singles, *doubles, states[0][:, -1:]])
    # The states of the last pass are driven by the measured input.
    u = states[0][:, -1]
    outputs = [
        single @ form.output + direct * u
        for form, single, direct in zip(chains.forms, singles, chains.direct, strict=True)
    ]
    error, measured = data.y - np.sum(outputs, axis=0), []
    for form, output in zip(chains.forms, outputs, strict=True):
        left = data._replace(u=error + output, tu=data.t, input_foh=data.y_foh)
        measured.append(chain_states(form.dynamics, form.gain, form.w0, left, 0.0)[:, :-1])
    return np.column_stack([*columns[0], error, *measured, *(columns[1] if len(columns) > 1 else [])])[data.use]


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
    chains = Chains((chain_form(a, b, integrators),), np.zeros(1))
    found = chain_pass(data, chains, delay) @ chains.forms[0].mapping.T
    return found if rows else found.T @ found
