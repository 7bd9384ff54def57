r"""Filtered signals of a sum of submodels and their second moments: rows of additive refined instrumental variables.

Submodel i is ``G_i = B_i / (p^l A_i)``, ``A_i = 1 + a_1 p + … + a_n p^n``, ``B_i = b_0 + … + b_m p^m``, with
integrators (l > 0) in at most one of them, and ``theta = (a_1 … a_n, b_0 … b_m)`` of each in turn. At each used sample,
with z the instrument source, u the input and ``y_i = y - sum of the other x_l`` what the others leave of the output,

.. math:: \psi_{a_k} = -\frac{p^k B_i}{p^l A_i^2} z, \quad \psi_{b_k} = \frac{p^k}{p^l A_i} z, \qquad
          \varphi_{a_k} = -\frac{p^k}{A_i} y_i, \quad \varphi_{b_k} = \frac{p^k}{p^l A_i} u .

In open loop ``z = u`` and psi are the sensitivities of the model output. In closed loop z is the input of the model's
own noise-free loop (González, Classens, Rojas, Welsh and Oomen, *Identification of additive continuous-time systems in
open and closed loop*, equations (10), (20), (29) and (31)).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError
from ctid_cli.filtering.bank import standard_rows
from ctid_cli.filtering.filter_data import FilterData, plain_array, split_delay
from ctid_cli.filtering.free_response import free_response, free_response_size
from ctid_cli.filtering.loop import simulate_loop
from ctid_cli.filtering.partial_fractions import MODAL_CONDITION_LIMIT
from ctid_cli.filtering.submodel_blocks import LoopData
from ctid_cli.filtering.submodel_pass import filtered_submodels
from ctid_cli.models.additive import AdditiveModel, Submodel, Term
from ctid_cli.models.controller import DiscreteController

#: State of the filters at the first sample.
InitialState = Literal["rest", "periodic", "estimated"]


#: No feedback.
OPEN_LOOP = LoopData(np.zeros(0), np.ones(1), np.ones(1), True)


@dataclass(frozen=True, eq=False)
class SubmodelMoments:
    """Second moments at one parameter vector, in the terms of the module's equations."""

    #: ``sum psi phi'``, shape (p, p).
    instrument_regressor: Array
    #: ``sum psi eps``, shape (p,).
    instrument_error: Array
    #: ``sum psi psi'``, shape (p, p).
    hessian: Array
    #: ``sum eps^2`` [output unit^2].
    squared_error: float
    #: Sum of squares of the model output driven by z [output unit^2].
    output_power: float


class SubmodelFilter:
    """The filters of a record for sums of submodels of one structure.

    On a regular clock all submodels are filtered in one compiled pass of their pooled modes. Any other clock, and
    submodels with (nearly) repeated poles, go through :func:`ctid_cli.filtering.bank.standard_rows` submodel by
    submodel, several times slower.
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
        self.degrees = np.array([(term.poles, term.zeros, term.integrators) for term in terms], dtype=np.int64)
        self.size = sum(term.size for term in terms)
        self._u = data.u
        if self.periodic:
            if data.interval == 0.0:
                raise ValueError("initial_state periodic needs input and output on one regular clock")
            shift, _ = split_delay(delay, data.interval)
            # Two samples more: the last interval leads back to the first sample, where the next slope begins.
            rolled = np.roll(data.u, shift)
            self._u = np.concatenate((rolled, rolled[:2]))

    def moments(self, theta: Array) -> SubmodelMoments | None:
        """Second moments at one parameter vector."""
        # What overflows is found by the sums not being finite.
        with np.errstate(all="ignore"):
            moments = self._moments(theta)
        if moments is None or not np.isfinite(moments.squared_error):
            return None
        finite = np.isfinite(moments.hessian).all() and np.isfinite(moments.instrument_regressor).all()
        return moments if finite else None

    def _moments(self, theta: Array) -> SubmodelMoments | None:
        """Second moments that need not be finite: of the pass, or of the rows where these are made in parts."""
        p = self.size
        fast = None if self.free else self._run(self.data, theta, False)
        if fast is None:
            rows = self.rows(theta)
            if rows is None:
                return None
            psi, phi, error, output = rows
            return SubmodelMoments(
                psi.T @ phi, psi.T @ error, psi.T @ psi, float(error @ error), float(output @ output)
            )
        row, maps, gram = fast
        # psi and the model output are made of the rows before that of the error.
        leading = row + 1
        products = maps[:p, :leading] @ gram
        return SubmodelMoments(
            products @ maps[p : 2 * p].T,
            products[:, row].copy(),
            products @ maps[:p].T,
            float(gram[row, row]),
            float(maps[2 * p, :leading] @ gram @ maps[2 * p]),
        )

    def rows(self, theta: Array) -> tuple[Array, Array, Array, Array] | None:
        """Instruments, regressors, output error and model output at the used samples."""
        if not self.free:
            return self._rows(self.data, theta)
        data = self.data
        parameters, initial = theta[: self.size], theta[self.size :]
        response = free_response(parameters, initial, self.terms, data.t - data.t[0])
        if response is None:
            return None
        x, by_theta, by_free = response
        forced = self._rows(data._replace(y=plain_array(data.y - x)), parameters)
        if forced is None:
            return None
        psi, phi, error, output = forced
        by_theta, by_free = by_theta[data.use], by_free[data.use]
        return (
            np.column_stack((psi + by_theta, by_free)),
            np.column_stack((phi + by_theta, by_free)),
            error,
            output + x[data.use],
        )

    def _rows(self, data: FilterData, theta: Array) -> tuple[Array, Array, Array, Array] | None:
        """The rows without a free response."""
        p = self.size
        fast = self._run(data, theta, True)
        if fast is None:
            return self._general_rows(data, theta)
        row, maps, rows = fast
        return rows @ maps[:p].T, rows @ maps[p : 2 * p].T, rows[:, row].copy(), rows @ maps[2 * p]

    def _run(self, data: FilterData, theta: Array, want_rows: bool) -> tuple[int, Array, Array] | None:
        """The compiled pass: row of the error, maps, and rows or moments; None where it does not apply."""
        if data.interval == 0.0:
            return None
        if self.periodic:
            data = data._replace(u=self._u)
        try:
            condition, row, maps, found = filtered_submodels(
                plain_array(theta), self.degrees, self.loop, self.delay, self.periodic, data, want_rows
            )
        except (ZeroDivisionError, np.linalg.LinAlgError):
            return None
        return (row, maps, found) if condition < MODAL_CONDITION_LIMIT else None

    def _general_rows(self, data: FilterData, theta: Array) -> tuple[Array, Array, Array, Array] | None:
        """psi, phi, eps and the model output driven by z, submodel by submodel; any clock, repeated poles."""
        if self.periodic or not np.isfinite(theta).all():
            return None
        try:
            return self._composed_rows(data, AdditiveModel.from_theta(theta, self.terms, self.delay))
        except (DataError, np.linalg.LinAlgError, ZeroDivisionError):
            # Coefficients that make no model, or one whose response overflows.
            return None

    def _composed_rows(self, data: FilterData, model: AdditiveModel) -> tuple[Array, Array, Array, Array]:
        """The same, of a model."""
        source = data._replace(u=plain_array(self._loop_input(data, model))) if self.loop.closed else data
        everywhere = data._replace(use=np.ones(data.y.size, dtype=bool))
        outputs = [self._submodel_output(everywhere, part) for part in model.submodels]
        error = data.y - np.sum(outputs, axis=0)
        psi, phi = np.empty((data.count, self.size)), np.empty((data.count, self.size))
        total = np.zeros(data.count)
        offset = 0
        for part, term, output in zip(model.submodels, self.terms, outputs, strict=True):
            width = term.size
            left = source._replace(y=plain_array(error + output))
            psi[:, offset : offset + width] = self._submodel_rows(left, part, term, instruments=True)
            left = data._replace(y=left.y)
            phi[:, offset : offset + width] = self._submodel_rows(left, part, term, instruments=False)
            total += self._submodel_output(source, part)
            offset += width
        return psi, phi, error[data.use], total

    def _loop_input(self, data: FilterData, model: AdditiveModel) -> Array:
        """Input of the noise-free loop of a model."""
        controller = DiscreteController(self.loop.numerator, self.loop.denominator)
        enters: Literal["controller", "input"] = "controller" if self.loop.at_controller else "input"
        return simulate_loop(model, controller, self.loop.reference, np.zeros(data.y.size), data.interval, enters).u

    def _submodel_output(self, data: FilterData, part: Submodel) -> Array:
        """Output of one submodel."""
        direct, a, b = _split_direct(part)
        n = a.size - 1
        rows = standard_rows(data, a, b, self.delay)
        return np.asarray(rows[:, :n] @ _rising(b, n) + direct * rows[:, n])

    def _submodel_rows(self, data: FilterData, part: Submodel, term: Term, *, instruments: bool) -> Array:
        """Columns of psi or phi that belong to one submodel."""
        direct, a, b = _split_direct(part)
        n, order_at_origin = term.poles, term.integrators
        highest = float(part.denominator[0])
        columns = np.empty((data.count, term.size))
        whole = n + order_at_origin
        rows = standard_rows(data, a, b, self.delay)
        if whole == 0:
            columns[:, 0] = rows[:, 1]
            return columns
        # p^k/(p^l A) u for k = 0 … n + l, the highest by the equation of the filter.
        driven = _with_highest(rows[:, :whole], rows[:, whole], a)
        columns[:, n:] = driven[:, : term.zeros + 1] / highest
        if n == 0:
            return columns
        if instruments:
            # p^(k + l)/(p^l A) x, x the output of the submodel.
            x = driven[:, :whole] @ _rising(b, whole)
            strictly = _with_highest(rows[:, whole + 1 : 2 * whole + 1], x, a)
            filtered = (strictly + direct * driven)[:, order_at_origin:]
        else:
            own = np.asarray(part.denominator, dtype=float) / highest
            bank = standard_rows(data, own, np.zeros(1), self.delay)
            filtered = _with_highest(bank[:, 2 * n + 1 : 3 * n + 1], data.y[data.use], own)
        columns[:, :n] = -filtered[:, 1 : n + 1] / highest
        return columns


def _split_direct(part: Submodel) -> tuple[float, Array, Array]:
    """Direct feed-through, monic denominator with the integrators, and what is left of the numerator."""
    whole = np.concatenate((np.asarray(part.denominator, dtype=float), np.zeros(part.integrators)))
    a = whole / whole[0]
    b = np.asarray(part.numerator, dtype=float) / whole[0]
    if b.size < a.size:
        return 0.0, a, b
    direct = float(b[0])
    if a.size == 1:
        # A filter needs a pole: any will do where nothing passes through it.
        return direct, np.ones(2), np.zeros(1)
    return direct, a, np.asarray((b - direct * a)[1:])


def _rising(b: Array, count: int) -> Array:
    """Coefficients of p^0, p^1, …, filled up with zeros."""
    rising = np.zeros(count)
    rising[: b.size] = b[::-1]
    return rising


def _with_highest(lower: Array, driving: Array, a: Array) -> Array:
    """Columns ``p^k/A s``, k = 0 … n, from those below n and s itself."""
    return np.column_stack((lower, driving - lower @ a[:0:-1]))
