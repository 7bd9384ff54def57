r"""Filtered signals of a sum of submodels and their second moments, for additive refined instrumental variables.

Submodel i is ``G_i = B_i / (p^l A_i)``, ``A_i = 1 + a_1 p + … + a_n p^n``, ``B_i = b_0 + … + b_m p^m``, with
integrators (l > 0) in at most one of them, and ``theta = (a_1 … a_n, b_0 … b_m)`` of each in turn. At each used sample,
with z the instrument source, u the input and ``y_i = y - sum of the other x_l`` the output less the other submodels',

.. math:: \psi_{a_k} = -\frac{p^k B_i}{p^l A_i^2} z, \quad \psi_{b_k} = \frac{p^k}{p^l A_i} z, \qquad
          \varphi_{a_k} = -\frac{p^k}{A_i} y_i, \quad \varphi_{b_k} = \frac{p^k}{p^l A_i} u .

In open loop ``z = u`` and psi are the sensitivities of the model output. In closed loop z is the input of the
noise-free loop with the model (González, Classens, Rojas, Welsh and Oomen, *Identification of additive continuous-time
systems in open and closed loop*, equations (10), (20), (29) and (31)).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from ctid_cli.arrays import Array, ComplexArray
from ctid_cli.filtering import kernels
from ctid_cli.filtering.bank import (
    MODAL_CONDITION_LIMIT,
    MOST_MODAL_INTEGRATORS,
    ChainForm,
    Chains,
    Equations,
    Form,
    ModalForm,
    Modes,
    chain_form,
    chain_pass,
    modal_form,
    modal_pass,
    to_steady_state,
)
from ctid_cli.filtering.filter_data import FilterData, plain_array, split_delay
from ctid_cli.filtering.loop import law_of, loop_pass
from ctid_cli.filtering.simulate import sampled_chains
from ctid_cli.models.additive import Term
from ctid_cli.models.controller import DiscreteController

#: State of the filters at the first sample.
InitialState = Literal["rest", "periodic", "estimated"]


class LoopData(NamedTuple):
    """Feedback loop of a record."""

    #: Reference at the sampling instants; empty in open loop, shape (N,).
    reference: Array
    #: Controller in descending powers of q, monic, both of one length, shape (nc + 1,).
    numerator: Array
    denominator: Array
    at_controller: bool
    #: Whether the reference is the input of the instruments, for an unknown controller.
    direct: bool = False

    @property
    def closed(self) -> bool:
        """Whether there is feedback."""
        return self.reference.size > 0


#: No feedback.
OPEN_LOOP = LoopData(np.zeros(0), np.ones(1), np.ones(1), True)


@dataclass(frozen=True, eq=False)
class Part:
    """One submodel with a monic denominator, split into direct feedthrough and strictly proper part."""

    term: Term
    #: Coefficient of the highest power of A; theta has A with a constant term of 1.
    highest: float
    #: A, monic, without the integrators, and B less the direct part, descending powers.
    a: Array
    b: Array
    direct: float

    @classmethod
    def of(cls, theta: Array, term: Term) -> "Part":
        """Return the submodel with parameters ``a_1 … a_n, b_0 … b_m``."""
        rising = np.concatenate(([1.0], theta[: term.poles]))
        highest = float(rising[-1])
        a, b = rising[::-1] / highest, theta[term.poles :][::-1] / highest
        if term.zeros < term.order:
            return cls(term, highest, a, b, 0.0)
        direct = float(b[0])
        rest = b[1:] - direct * np.concatenate((a, np.zeros(term.integrators)))[1:]
        return cls(term, highest, a, rest if rest.size else np.zeros(1), direct)

    def modal(self) -> ModalForm | None:
        """Return the partial fractions; None if they amplify rounding too much."""
        if self.term.integrators > MOST_MODAL_INTEGRATORS:
            return None
        form = modal_form(plain_array(self.a), plain_array(self.b), self.term.integrators)
        return form if form.condition < MODAL_CONDITION_LIMIT else None

    def chain(self) -> ChainForm:
        """Return the chain, which also exists for repeated poles."""
        return chain_form(plain_array(self.a), plain_array(self.b), self.term.integrators)

    def output(self, driven: Array, u: Array) -> Array:
        """Return the output from ``p^k/(p^l A) u``, columns, and u."""
        return np.asarray(driven[:, : self.b.size] @ self.b[::-1][: driven.shape[1]] + self.direct * u)

    def instruments(self, driven: Array, u: Array, strictly: Array) -> Array:
        """Return psi from ``p^k/(p^l A) z`` and z, and from ``p^k/A x`` of the strictly proper part of the output."""
        of_input = self._with_highest(driven, u)
        of_output = self._with_highest(strictly, self.output(driven, 0.0 * u), 0)
        of_output = of_output + self.direct * of_input[:, self.term.integrators :]
        return np.column_stack((-of_output[:, 1:], of_input[:, : self.term.zeros + 1])) / self.highest

    def regressors(self, driven: Array, u: Array, filtered: Array, left: Array) -> Array:
        """Return phi from ``p^k/(p^l A) u`` and u, and from ``p^k/A y_i`` and ``y_i``."""
        of_output = self._with_highest(filtered, left, 0)
        of_input = self._with_highest(driven, u)
        return np.column_stack((-of_output[:, 1:], of_input[:, : self.term.zeros + 1])) / self.highest

    def _with_highest(self, lower: Array, signal: Array, integrators: int | None = None) -> Array:
        """Return the columns ``p^k/(p^l A) s``, k = 0 … n + l, from the lower ones and s."""
        first = self.term.integrators if integrators is None else integrators
        return np.column_stack((lower, signal - lower[:, first:] @ self.a[:0:-1]))


class SubmodelFilter:
    """The filters of a record for sums of submodels of one structure.

    All submodels are filtered in one compiled pass over all their modes. If one has (nearly) repeated poles, all use
    chains, which are several times slower.
    """

    def __init__(
        self,
        data: FilterData,
        terms: Sequence[Term],
        delay: float = 0.0,
        loop: LoopData = OPEN_LOOP,
        initial_state: InitialState = "rest",
    ) -> None:
        self.data = data
        self.terms = tuple(terms)
        self.delay = float(delay)
        self.loop = loop
        self.periodic = initial_state == "periodic"
        self.free = free_response_size(terms) if initial_state == "estimated" else 0
        self.size = sum(term.size for term in terms)
        self._controller = DiscreteController(loop.numerator, loop.denominator)
        if self.periodic and data.interval == 0.0:
            raise ValueError("initial_state periodic needs input and output on one regular clock")

    def moments(self, theta: Array) -> Equations | None:
        """Return the second moments at one parameter vector; None if they are not finite."""
        # Overflow is detected by sums that are not finite.
        with np.errstate(all="ignore"):
            moments = self._moments(theta)
        if moments is None or not np.isfinite(moments.squared_error):
            return None
        finite = np.isfinite(moments.hessian).all() and np.isfinite(moments.instrument_regressor).all()
        return moments if finite else None

    def _moments(self, theta: Array) -> Equations | None:
        if self.free:
            rows = self.rows(theta)
            if rows is None:
                return None
            psi, phi, error, output = rows
            return Equations(psi.T @ phi, psi.T @ error, psi.T @ psi, float(error @ error), float(output @ output))
        pooled = self._pooled(theta)
        if pooled is None:
            return None
        psi, phi, output = pooled.psi, pooled.phi, pooled.output
        # psi and the model output depend on the rows up to that of the error only.
        leading = 2 * pooled.width + 2
        gram = self._pass(self.data, pooled, rows=False, leading=leading)
        products = psi[:leading].T @ gram
        power = output[:leading] @ gram @ output
        squared = float(gram[leading - 1, leading - 1])
        error = products[:, leading - 1].copy()
        return Equations(products @ phi, error, products @ psi, squared, float(power))

    def rows(self, theta: Array, form: Form = "auto") -> tuple[Array, Array, Array, Array] | None:
        """Return instruments, regressors, output error and model output at the used samples."""
        data, parameters = self.data, theta[: self.size]
        pooled = self._pooled(parameters, form)
        response = None
        if self.free:
            response = free_response(parameters, theta[self.size :], self.terms, data.t - data.t[0])
            if response is None:
                return None
            data = data._replace(y=plain_array(data.y - response[0]))
        if pooled is None:
            return None
        rows = self._pass(data, pooled, rows=True, leading=None)
        psi, phi, output = rows @ pooled.psi, rows @ pooled.phi, rows @ pooled.output
        error = rows[:, 2 * pooled.width + 1].copy()
        if response is None:
            return psi, phi, error, output
        x, by_theta, by_free = (part[data.use] for part in response)
        return np.column_stack((psi + by_theta, by_free)), np.column_stack((phi + by_theta, by_free)), error, output + x

    def _pooled(self, theta: Array, form: Form = "auto") -> "Pooled | None":
        """Return all submodels for one pass; None for inadmissible parameters."""
        parts = _parts(theta, self.terms) if np.isfinite(theta).all() else None
        if parts is None:
            return None
        direct = np.array([part.direct for part in parts])
        forms = [None if form == "chain" else part.modal() for part in parts]
        modal = [each for each in forms if each is not None]
        if len(modal) == len(parts):
            return pooled_forms(parts, modal, pooled_modes(modal, direct), self.loop.closed)
        if self.periodic:
            return None
        chains = Chains(tuple(part.chain() for part in parts), direct)
        return pooled_forms(parts, chains.forms, chains, self.loop.closed)

    def _pass(self, data: FilterData, pooled: "Pooled", *, rows: bool, leading: int | None) -> Array:
        """Return the rows of the pass, or their moments."""
        model, delay = pooled.model, self.delay
        instruments = self._loop_input(model) if self.loop.closed else None
        if isinstance(model, Chains):
            found = chain_pass(data, model, delay, instruments)
            return found if rows else found[:, :leading].T @ found
        states = None
        if self.periodic:
            data, delay, states = self._in_steady_state(data, model)
        return modal_pass(data, model, delay, rows=rows, leading=leading, states=states, instruments=instruments)

    def instrument_input(self, theta: Array) -> Array | None:
        """Return the input of the instruments: the measured one, or that of the noise-free loop."""
        if not self.loop.closed:
            return self.data.u
        pooled = self._pooled(theta)
        return None if pooled is None else self._loop_input(pooled.model)

    def _loop_input(self, model: Modes | Chains) -> Array:
        """Return the input of the noise-free loop of a model."""
        interval, reference = self.data.interval, self.loop.reference
        if self.loop.direct:
            return reference
        if isinstance(model, Modes):
            clock = (interval, *split_delay(self.delay, interval))
            direct = float(model.direct.sum())
            return np.asarray(kernels.loop_input(model.poles, model.residues, direct, clock, *self.loop[:4]))
        plant, law = sampled_chains(model, interval, self.delay), law_of(self._controller)
        return loop_pass(plant, law, reference, np.zeros(reference.size), self.loop.at_controller)[0]

    def _in_steady_state(self, data: FilterData, modes: Modes) -> tuple[FilterData, float, ComplexArray]:
        """Return the record with its input shifted by whole intervals, the remaining delay, and the periodic states."""
        count, interval = data.y.size, data.interval
        period = interval * count
        shift, fraction = split_delay(self.delay, interval)
        rolled = np.roll(data.u, shift)
        # Two more samples: the last interval ends at the first sample, where the next slope begins.
        data, delay = data._replace(u=np.concatenate((rolled, rolled[:2]))), -fraction * interval
        nothing = data._replace(use=np.zeros(count, dtype=bool))
        initial = np.zeros((modes.poles.size, 5), np.complex128)
        modal_pass(nothing, modes, delay, states=initial)
        initial[:, 2:] = 0.0
        to_steady_state(modes.poles, period, initial)
        # The filters of y_i need the periodic output of the model, hence a second pass over one whole period.
        states, once_round = initial.copy(), np.append(data.y, data.y[0])
        whole = nothing._replace(y=once_round, use=np.zeros(count + 1, dtype=bool))
        modal_pass(whole, modes, delay, states=states)
        initial[:, 2] = states[:, 2] / -np.expm1(modes.poles * period)
        return data, delay, initial


def _parts(theta: Array, terms: Sequence[Term]) -> list[Part] | None:
    """Return the submodels of parameters; None if a leading denominator coefficient is zero."""
    parts: list[Part] = []
    first = 0
    for term in terms:
        own = theta[first : first + term.size]
        if term.poles and own[term.poles - 1] == 0.0:
            return None
        parts.append(Part.of(own, term))
        first += term.size
    return parts


class Pooled(NamedTuple):
    """All submodels in one pass, with the maps from its rows to psi, phi and the model output driven by z."""

    model: Modes | Chains
    #: Number of rows of z.
    width: int
    #: Shapes (q, p), (q, p) and (q,).
    psi: Array
    phi: Array
    output: Array


def pooled_modes(forms: Sequence[ModalForm], direct: Array) -> Modes:
    """Return the modes of all submodels."""
    owner = np.repeat(np.arange(len(forms)), [form.poles.size for form in forms]).astype(np.int64)
    poles, residues = (np.concatenate(parts) for parts in zip(*[form[1:3] for form in forms], strict=True))
    return Modes(poles, owner, residues, direct)


def pooled_forms(
    parts: Sequence[Part], forms: Sequence[ModalForm | ChainForm], model: Modes | Chains, closed: bool
) -> Pooled:
    """Return the maps from the rows of one pass over all submodels."""
    n = sum(form.width for form in forms)
    v, error, u = 2 * n, 2 * n + 1, 5 * n + 2 if closed else 2 * n
    width = u + 1 if closed else 3 * n + 2
    psi, phi, output = [], [], np.zeros(width)
    first = 0
    for part, form in zip(parts, forms, strict=True):
        own, order, poles_of = form.width, part.term.order, part.term.poles
        # Columns of the standard rows from the rows of the pass, driven by z and by the measured input.
        z, w = first + np.arange(own), n + first + np.arange(own)
        places = np.concatenate((z, w, [v, error], 2 * n + 2 + z))
        of_u = places.copy()
        if closed:
            of_u[: 2 * own] += 3 * n + 2
            of_u[2 * own] = u
        driven, measured = np.zeros((width, len(form.mapping))), np.zeros((width, len(form.mapping)))
        driven[places[: form.mapping.shape[1]]] = form.mapping.T
        measured[of_u[: form.mapping.shape[1]]] = form.mapping.T
        strictly, filtered = order + 1, order + 1 + poles_of
        own_output = part.output(measured[:, :order], measured[:, order])
        left = own_output.copy()
        left[error] += 1.0
        psi.append(part.instruments(driven[:, :order], driven[:, order], driven[:, strictly:filtered]))
        phi.append(
            part.regressors(measured[:, :order], measured[:, order], measured[:, filtered : filtered + poles_of], left)
        )
        output += part.output(driven[:, :order], driven[:, order])
        first += own
    return Pooled(model, n, np.hstack(psi), np.hstack(phi), output)


# --- free responses -------------------------------------------------------------------------------------------------


def free_response_size(terms: Sequence[Term]) -> int:
    """Return the number of parameters of the free responses."""
    return sum(term.order for term in terms)


def free_response(
    theta: Array, free: Array, terms: Sequence[Term], elapsed: Array
) -> tuple[Array, Array, Array] | None:
    r"""Return the free response to initial conditions, and its derivatives by theta and by the conditions.

    The free response of submodel i after the first sample is that of ``C_i / (p^l A_i)`` to an impulse,
    ``C_i = c_0 + … + c_(n+l-1) p^(n+l-1)``, hence

    .. math:: \frac{\partial x}{\partial c_k} = \frac{p^k}{p^l A_i}\delta, \qquad
              \frac{\partial x}{\partial a_k} = -\frac{p^k C_i}{p^l A_i^2}\delta .

    None if a leading denominator coefficient is zero.
    """
    response = np.zeros(elapsed.size)
    by_theta, by_free = np.zeros((elapsed.size, theta.size)), np.zeros((elapsed.size, free.size))
    first, first_free = 0, 0
    for term in terms:
        own, last = theta[first : first + term.poles], first_free + term.order
        if term.order:
            driving = Term(term.poles, term.order - 1, term.integrators)
            parts = _parts(np.concatenate((own, free[first_free:last])), [driving])
            if parts is None:
                return None
            (part,) = parts
            driven, behind = _impulse_responses(part, elapsed)
            nothing = np.zeros(elapsed.size)
            derivatives = part.instruments(driven, nothing, behind)
            by_theta[:, first : first + term.poles] = derivatives[:, : term.poles]
            by_free[:, first_free:last] = derivatives[:, term.poles :]
            response += part.output(driven, nothing)
        first, first_free = first + term.size, last
    return response, by_theta, by_free


def _impulse_responses(part: Part, elapsed: Array) -> tuple[Array, Array]:
    """Return the impulse responses of ``p^k/(p^l A)`` and of ``p^k B/(p^l A^2)`` as columns."""
    n, order = part.term.poles, part.term.order
    form = part.modal() or part.chain()
    if isinstance(form, ChainForm):
        impulse = form.after_impulse(elapsed)
    else:
        # z and w of each mode.
        singles: list[Array] = []
        for pole in form.poles:
            response = np.exp(pole * elapsed)
            singles += [response.real, response.imag] if pole.imag else [response.real]
        impulse = np.column_stack([*singles, *(elapsed * single for single in singles)])
    rows = impulse @ form.mapping[:, : impulse.shape[1]].T
    return rows[:, :order], rows[:, order + 1 : order + 1 + n]
