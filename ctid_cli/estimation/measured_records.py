r"""Measured records laid out for estimation: delay, initial state, offset, several experiments, and what is refused.

.. math:: y(t_k) = \frac{B}{A} u(t_k-\tau) + \frac{C}{A}\delta(t_k-t_s) + c + d (t_k-t_0) + e_k

``C/A`` applied to an impulse at the first used instant ``t_s`` spans every free response of A, so the n coefficients of
C are the initial state, whatever happened before. C, the offset c and the drift d belong to one experiment each, the
rest is common.
"""

from collections.abc import Sequence
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array, BoolArray, ComplexArray
from ctid_cli.errors import DataError
from ctid_cli.estimation.common import check_greatest_delay, check_record
from ctid_cli.estimation.optimum.best_model import (
    Begin,
    Optimum,
    best_output_error,
    best_sum,
    most_active_parts,
    poles_of_submodels,
)
from ctid_cli.estimation.optimum.box import ANYWHERE, point_of
from ctid_cli.estimation.optimum.chain import Chain, block_diagonal, chains_dynamics, numerators
from ctid_cli.estimation.optimum.known import NOTHING, KnownCoefficients
from ctid_cli.estimation.optimum.projection import Problem
from ctid_cli.estimation.optimum.search import local_minimum
from ctid_cli.estimation.optimum.triangle import Columns, rows_of
from ctid_cli.filtering.filter_data import FilterData, filter_data, used_samples
from ctid_cli.inference.covariance import nearly_regular
from ctid_cli.inference.innovations import sampled
from ctid_cli.inference.input_response import output_bandwidth
from ctid_cli.inference.robust_loss import Weighting
from ctid_cli.inference.sensitivities import Model, Structure, SumStructure
from ctid_cli.inference.signal_features import outliers
from ctid_cli.models.additive import AdditiveModel
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.noise import ArmaNoise
from ctid_cli.signals.record import Record, named
from ctid_cli.signals.treatment import InitialState, InputBefore, Offset, OutputHold

#: Parameters of the powers of time that the output has beside the response.
TREND_NAMES = ("offset", "drift", "drift2", "drift3")
#: Random starts, this number and as many again for each pole.
RANDOM_STARTS = 2


@dataclass(frozen=True)
class Layout:
    """Which numbers stand where in the parameter vector: coefficients, delay, then each experiment's own."""

    structure: Structure | SumStructure
    experiments: int = 1
    initial_state: bool = False
    #: Powers of time.
    trend: tuple[int, ...] = ()
    #: Poles at the origin: that many of the last coefficients of the denominator are zero.
    integrators: int = 0

    @property
    def own(self) -> int:
        """Number of parameters that belong to one experiment."""
        return self.structure.poles * self.initial_state + len(self.trend)

    @property
    def size(self) -> int:
        """Number of parameters."""
        return self.structure.size + self.experiments * self.own

    @property
    def names(self) -> tuple[str, ...]:
        """Parameter names; those of an experiment end in its number where there are several."""
        names = list(self.structure.names)
        for k in range(self.experiments):
            tail = f"_{k + 1}" if self.experiments > 1 else ""
            names += [f"x{i}{tail}" for i in range(1, self.structure.poles + 1)] * self.initial_state
            names += [f"{TREND_NAMES[power]}{tail}" for power in self.trend]
        return tuple(names)

    def theta(self, model: Model) -> Array:
        """The parameters of a model of this structure, and zeros for what belongs to the experiments."""
        return np.concatenate((self.structure.theta_of(model), np.zeros(self.experiments * self.own)))

    def own_of(self, theta: Array, experiment: int) -> tuple[Array, float]:
        """Initial state and offset of one experiment."""
        first = self.first(experiment)
        own = theta[first : first + self.own]
        states = self.structure.poles * self.initial_state
        return own[:states], float(own[states]) if self.trend[:1] == (0,) else 0.0

    def first(self, experiment: int) -> int:
        """Where the parameters of an experiment begin."""
        return self.structure.size + experiment * self.own


def sensitivities(problem: Problem, layout: Layout, theta: Array, delay: float) -> list[tuple[Array, Array]]:
    """Derivatives of the simulated output to the parameters, and the output error, at the used samples of each record.

    The delay is that of theta where it is a parameter. The last coefficients of the denominator are zero where the
    problem has integrators.
    """
    structure, n = layout.structure, layout.structure.poles
    fractions, chain_rule = structure.fractions_of(theta)
    shared = len(chain_rule)
    delay = theta[structure.size - 1] if structure.delay else delay
    terms, rows, powers, outputs, direct = problem.submodels(n).terms, [], [], [], np.zeros(len(fractions))
    for k, ((b, a), term) in enumerate(zip(fractions, terms, strict=True)):
        stable = np.roots(a[: term.poles + 1]).astype(complex)
        point = point_of(stable, delay, ANYWHERE)
        (sections,) = problem._replace(terms=(), integrators=term.integrators).rows(point.speed, point.damping)
        rows.append(sections)
        # From the states to p^(n-1)/A ... 1/A. With n zeros B/A = b0 + B'/A, and p^n/A u = u - sum a_i p^(n-i)/A u.
        powers.append(np.asarray(np.linalg.inv(numerators(*sections)), dtype=float))
        if b.size == a.size:
            direct[k], b = b[0], (b - b[0] * a)[1:]
        outputs.append(np.concatenate((np.zeros(a.size - 1 - b.size), b)) @ powers[-1])
    (F, g), output, free_powers = chains_dynamics(rows), np.concatenate(outputs), block_diagonal(powers)
    columns = Columns.of(n, second=True, free=layout.initial_state, trend=layout.trend)
    # Columns of the rows that are wanted, each a combination of the states, the input and what else stands there: first
    # the derivatives to the coefficients of all monic fractions.
    monic, by_a, first, column = np.zeros((columns.size, shared)), np.zeros((n, shared)), 0, 0
    for (b, a), own in zip(fractions, powers, strict=True):
        order, m = a.size - 1, b.size - 1
        states = slice(first, first + order)
        by_a[states, column : column + order] = -own.T
        coefficients = np.column_stack((-own.T @ a[1:], own.T))[:, order - m :]
        monic[states, column + order : column + order + m + 1] = coefficients
        if m == order:
            monic[columns.u, column + order] = 1.0
        first, column = first + order, column + order + m + 1
    monic[n : 2 * n] = by_a
    count = chain_rule.shape[1]
    common = np.zeros((columns.size, layout.size + 1))
    common[:, :count] = monic @ chain_rule
    if structure.delay:
        common[:n, count], common[columns.u, count] = -(output @ F), -(output @ g)
    common[:n, -1], common[columns.u, -1], common[columns.u + 1, -1] = -output, -direct.sum(), 1.0
    result = []
    for k, (data, period) in enumerate(zip(problem.records, problem.periods, strict=True)):
        first = layout.first(k)
        own = theta[first : first + layout.own]
        state = own[:n] if layout.initial_state else np.zeros(n)
        form = Chain(rows, F, g, F, g).driving(output, direct, state @ free_powers)
        wanted = common.copy()
        if layout.initial_state:
            alone, driven_alone = wanted[columns.free_states][:n], wanted[columns.free_states][n:]
            driven_alone[:, :count] = by_a @ chain_rule
            alone[:, first : first + n] = free_powers.T
        wanted[columns.powers, first + layout.own - len(layout.trend) : first + layout.own] = np.eye(len(layout.trend))
        wanted[:, -1] -= wanted[:, first : first + layout.own] @ own
        found = np.vstack([part.T @ wanted for part in rows_of(form, columns, point.delay, data, period)])
        result.append((found[:, :-1], found[:, -1].copy()))
    return result


class Treatment(NamedTuple):
    """How records are laid out."""

    delay_bounds: tuple[float, float]
    initial_state: InitialState
    offset: Offset
    hold_output: OutputHold
    #: Whether samples far from their neighbours are bridged while the search looks for starts.
    bridge: bool = False
    #: Poles at the origin, counted among those of the structure.
    integrators: int = 0
    #: Input before the first sample of a record that begins at rest [input unit].
    input_before: InputBefore = None


@dataclass(frozen=True, eq=False)
class AppliedModel:
    """A given model on records that it need not have been estimated from."""

    #: Output errors at the used samples of each experiment [output unit].
    residuals: tuple[Array, ...] = field(repr=False)
    used: tuple[BoolArray, ...] = field(repr=False)
    initial_states: tuple[Array, ...]
    #: Output offset of each experiment [output unit].
    offsets: tuple[float, ...]
    #: Derivatives of the output at the used samples to all parameters, the delay and what is each experiment's among
    #: them, shape (count, p).
    sensitivities: tuple[Array, ...] = field(repr=False)


class MeasuredRecords:
    """Records of one system, laid out for estimation, and their output-error cost over all parameters."""

    def __init__(
        self,
        records: Sequence[Record],
        structure: Structure | SumStructure,
        treatment: Treatment,
        known: KnownCoefficients = NOTHING,
    ) -> None:
        if not records:
            raise DataError("there is no record to estimate from")
        self.structure = structure
        self.treatment, self.known = treatment, known
        free_state, integrators = treatment.initial_state == "estimate", treatment.integrators
        # Integrators make powers of time of an offset of their input; the lower ones are their free responses.
        highest = {"estimate": integrators, "drift": 1}.get(treatment.offset, -1)
        trend = tuple(range(integrators if free_state else 0, highest + 1))
        self.layout = Layout(structure, len(records), free_state, trend, integrators)
        for record in records:
            self._check_input(record)
        removed = treatment.offset == "remove"
        bridged = [_bridged(record) if treatment.bridge else record for record in records]
        level = treatment.input_before
        centred = [without_means(record) if removed else above_level(record, level) for record in bridged]
        self.records = [one for one, _, _ in centred]
        self.input_offsets = [u0 for _, u0, _ in centred]
        self.offsets = [y0 for _, _, y0 in centred]
        self.data = [self._lay_out(record) for record in self.records]
        for record, data in zip(self.records, self.data, strict=True):
            may_be_constant = self.layout.initial_state or treatment.input_before is not None
            check_record(record, data, self.layout.size, may_be_constant)
        each = zip(records, self.offsets, self.data, strict=True)
        #: Outputs at the used samples as they were measured, less their means where those are removed.
        self.outputs = [record.y[used_samples(data, record)] - y0 for record, y0, data in each]

    @cached_property
    def bandwidth(self) -> float:
        """Highest frequency that matters in an output [rad/s]."""
        return max(output_bandwidth(record) for record in self.records)

    def with_structure(self, structure: Structure) -> "MeasuredRecords":
        """The same records for another model."""
        other = copy(self)
        other.structure = structure
        other.layout = replace(self.layout, structure=structure)
        other.problem = self.problem._replace(zeros=structure.zeros)
        return other

    @property
    def plain(self) -> bool:
        """Whether there is but one record and nothing of its own to be estimated."""
        treatment = self.treatment
        if isinstance(self.structure, SumStructure):
            return False
        from_rest = self.layout.own == 0 and treatment.initial_state != "periodic" and not treatment.integrators
        return from_rest and len(self.data) == 1 and self.structure.zeros < self.structure.poles

    def _check_input(self, record: Record) -> None:
        """Refuse what an input cannot tell."""
        low, high = self.treatment.delay_bounds
        if high > 0:
            check_greatest_delay(record, high)
        first, before = float(record.input.values[0]), self.treatment.input_before
        if np.ptp(record.input.values) > 0.0 or before not in (None, "first", first):
            return
        if low < high or self.treatment.initial_state != "estimate":
            raise DataError(
                f"{named(record)}the input is constant ({first:g}) over the whole record; if the record begins with "
                "its step, give the level of the input before it: input_before (--input-before VALUE)"
            )

    def _lay_out(self, record: Record) -> FilterData:
        # At rest the input before the record is known to be zero, whatever the delay, and that of a periodic record is
        # known too; otherwise it is not known.
        treatment = self.treatment
        known_after = treatment.delay_bounds[1] if treatment.initial_state == "estimate" else 0.0
        periodic = treatment.initial_state == "periodic"
        return filter_data(record, known_after, treatment.hold_output, periodic=periodic)

    @cached_property
    def problem(self) -> Problem:
        """The records and what is eliminated with them."""
        if self.treatment.initial_state == "periodic":
            periods = tuple(_period(record) for record in self.records)
            data = tuple(_one_period(*pair) for pair in zip(self.data, periods, strict=True))
        else:
            periods, data = (0.0,) * len(self.data), tuple(self.data)
        layout, integrators = self.layout, self.treatment.integrators
        terms = self.structure.terms if isinstance(self.structure, SumStructure) else ()
        free, trend = layout.initial_state, layout.trend
        return Problem(data, self.structure.zeros, free, trend, periods, integrators=integrators, terms=terms)

    def part(self) -> "MeasuredRecords | None":
        """The most active parts of long records, each from a state of its own; None where they tell too little."""
        treatment = self.treatment
        parts = most_active_parts(self.data, treatment.delay_bounds[1])
        if parts is None or treatment.initial_state == "periodic":
            return None
        offset: Offset = "none" if treatment.offset == "remove" else treatment.offset
        cut = [_cut(record, part) for record, part in zip(self.records, parts, strict=True)]
        with suppress(DataError):
            own = treatment._replace(initial_state="estimate", offset=offset, bridge=False, input_before=None)
            return MeasuredRecords(cut, self.structure, own)
        return None

    @cached_property
    def centred(self) -> FilterData:
        """The first record without its means, for starts that know no offset and no initial state."""
        if self.treatment.offset not in ("estimate", "drift"):
            return self.data[0]
        return self._lay_out(without_means(self.records[0])[0])

    @property
    def spread(self) -> float:
        """Sum of the squares of the outputs about the mean of each record."""
        return float(sum(np.sum((y - y.mean()) ** 2) for y in self.outputs))

    @property
    def regular(self) -> bool:
        """Whether lags counted in samples are lags in time, up to jitter."""
        return all(nearly_regular(data.t) for data in self.data)

    def used(self) -> tuple[BoolArray, ...]:
        """Which samples of each record enter the sums."""
        return tuple(used_samples(*pair) for pair in zip(self.data, self.records, strict=True))

    # --- the least output error ----------------------------------------------------------------------

    def with_outputs(self, outputs: Sequence[Array]) -> "MeasuredRecords":
        """The same with other outputs at the used samples of each record."""
        records = []
        for data, values in zip(self.problem.sampled, outputs, strict=True):
            y = data.y.copy()
            y[data.use] = values
            records.append(data._replace(y=y))
        other = copy(self)
        other.problem = self.problem._replace(records=tuple(records))
        return other

    def whitened_by(self, noise: ArmaNoise) -> "MeasuredRecords":
        """The same where errors count by their innovations under a noise."""
        other = copy(self)
        other.problem = self.problem._replace(noises=sampled(noise, self.used()))
        return other

    def near(
        self, errors: Sequence[Array], weighting: Weighting | None, noise: ArmaNoise | None = None
    ) -> "MeasuredRecords":
        """The records whose least squares are, near the estimate, what its loss or likelihood is."""
        if noise is not None:
            return self.whitened_by(noise)
        if weighting is None:
            return self
        each = zip(self.outputs, errors, weighting.pseudo_errors, strict=True)
        return self.with_outputs([y - r + pseudo for y, r, pseudo in each])

    def best(self, starts: Sequence[Begin], nested: bool) -> Optimum:
        """The least output error from denominators and delays, and if nested of smaller models and at random too.

        Of a sum a start has the poles of its submodels, and sums grow term by term in any case. A profile under an
        unknown initial state, an offset or a period has too few basins: smaller models help then.
        """
        if self.problem.terms:
            return best_sum(self.problem, self.treatment.delay_bounds, starts, known=self.known)
        return best_output_error(
            self.problem,
            self.structure.poles - self.problem.integrators,
            self.treatment.delay_bounds,
            starts,
            nested=nested or not self.plain or self.known is not NOTHING,
            fewer_poles=nested,
            random_starts=RANDOM_STARTS if nested or self.plain else 0,
            known=self.known,
        )

    def local(self, *starts: Begin) -> Optimum:
        """Return the least output error in the basins of denominators, without their integrators, and delays."""
        if self.problem.terms:
            return best_sum(self.problem, self.treatment.delay_bounds, starts, grown=False, known=self.known)
        poles, delays = starts[0][0].size - 1, self.treatment.delay_bounds
        return best_output_error(self.problem, poles, delays, starts, nested=False, random_starts=0, known=self.known)

    def parameters(self, found: Optimum) -> tuple[Layout, Array]:
        """Which numbers an optimum has, and what they are."""
        layout = self.layout_of(found.model.order, self.structure.delay)
        theta = layout.theta(found.additive or found.model)
        for k in range(layout.experiments):
            state, first = found.free_responses[k] if layout.initial_state else (), layout.first(k)
            theta[first : first + layout.own] = [*state, *found.trends[k]]
        return layout, theta

    def simulated(self, found: Optimum) -> list[Array]:
        """Outputs of an optimum at the used samples of each record."""
        parts = sensitivities(self.problem, *self.parameters(found), found.model.delay)
        return [data.y_used - eps for data, (_, eps) in zip(self.problem.records, parts, strict=True)]

    def squared_error_at(self, model: Model, delay: float) -> float:
        """Least sum of squared output errors at a given delay, in the basin of a model."""
        return local_minimum(
            self.problem, self.free_poles(model), delay, (delay, delay), known=self.known
        ).squared_error

    def errors_of(self, model: Model) -> AppliedModel:
        """Errors of a given model on these records, each with its own best initial state and offset."""
        layout = self.layout_of(model.order, delay=True)
        theta, residuals = layout.theta(model), []
        found = sensitivities(self.problem, layout, theta, model.delay)
        for k, (psi, eps) in enumerate(found):
            own = slice(layout.first(k), layout.first(k) + layout.own)
            noises = self.problem.noises
            weigh = noises[k].whitened if noises else np.asarray
            theta[own] = np.linalg.lstsq(weigh(psi[:, own]), weigh(eps))[0]
            bridged = self.problem.records[k].y_used
            residuals.append(eps - psi[:, own] @ theta[own] + (self.outputs[k] - bridged))
        slopes = tuple(psi for psi, _ in found)
        return AppliedModel(tuple(residuals), self.used(), *self.own(layout, theta), slopes)

    def free_poles(self, model: Model) -> ComplexArray:
        """The poles of a model but its integrators."""
        if isinstance(model, AdditiveModel):
            return poles_of_submodels(model)
        return np.roots(model.denominator[: model.denominator.size - self.problem.integrators]).astype(complex)

    @property
    def given(self) -> BoolArray:
        """Which of the coefficients of the structure are known, those that integrators make zero among them."""
        if isinstance(self.structure, SumStructure):
            found = np.zeros(self.structure.size - int(self.structure.delay), dtype=bool)
            if self.known is not NOTHING:
                found[self.structure.denominators] = np.isfinite(self.known.denominator)
                found[self.structure.numerators] = np.isfinite(self.known.numerator)
            return found
        zeros = self.structure.zeros + 1
        if self.known is NOTHING:
            free = self.structure.poles - self.problem.integrators
            of_a, of_b = np.zeros(free, dtype=bool), np.zeros(zeros, dtype=bool)
        else:
            of_a, of_b = np.isfinite(self.known.denominator), np.isfinite(self.known.numerator)
        return np.concatenate((of_a, np.ones(self.problem.integrators, dtype=bool), of_b))

    def layout_of(self, poles: int, delay: bool) -> Layout:
        """Layout of the parameters for a number of poles, integrators among them; a sum has its own."""
        if isinstance(self.structure, SumStructure):
            return replace(self.layout, structure=replace(self.structure, delay=delay))
        return replace(self.layout, structure=Structure(poles, self.structure.zeros, delay))

    def own(self, layout: Layout, theta: Array) -> tuple[tuple[Array, ...], tuple[float, ...]]:
        """Initial states and offsets of the experiments, means that were subtracted included."""
        own = [layout.own_of(theta, k) for k in range(layout.experiments)]
        offsets = tuple(y0 + c for y0, (_, c) in zip(self.offsets, own, strict=True))
        return tuple(state for state, _ in own), offsets


def _bridged(record: Record) -> Record:
    """Record whose outliers are replaced by what lies between their neighbours."""
    present = np.flatnonzero(record.valid)
    wild = present[outliers(record.y[present])]
    kept = np.setdiff1d(present, wild)
    y = record.y.copy()
    y[wild] = np.interp(record.t[wild], record.t[kept], record.y[kept])
    return replace(record, y=y)


def _cut(record: Record, part: slice) -> Record:
    """Some samples of a record whose input is known at them."""
    t, signal = record.t[part], record.input
    return Record(t, record.y[part], HeldSignal(t, signal.values[part], signal.hold), name=record.name)


def above_level(record: Record, before: InputBefore) -> tuple[Record, float, float]:
    """Record whose input counts from the level before its first sample, that level, and zero for its output."""
    signal = record.input
    level = float(signal.values[0]) if before == "first" else float(before or 0.0)
    if not level:
        return record, 0.0, 0.0
    return replace(record, input=HeldSignal(signal.t, signal.values - level, signal.hold)), level, 0.0


def without_means(record: Record) -> tuple[Record, float, float]:
    """Record less the mean of its output samples and the time average of its input."""
    y0 = float(np.nanmean(record.y))
    signal = record.input
    u0 = float(np.mean(signal.at(record.t)))
    centred = HeldSignal(signal.t, signal.values - u0, signal.hold)
    loop = record.loop and replace(record.loop, reference=record.loop.reference - record.loop.reference.mean())
    return Record(record.t, record.y - y0, centred, name=record.name, loop=loop), u0, y0


def _period(record: Record) -> float:
    """Period of a record that repeats: its duration and one more interval."""
    return record.duration + (record.interval or float(np.median(np.diff(record.t))))


def _one_period(data: FilterData, period: float) -> FilterData:
    """Return the record with the breaks of its input within one period."""
    within = data.tu < data.tu[0] + period * (1 - 1e-9)
    if within.all():
        return data
    # A regular pass takes a break for each sample.
    return data._replace(tu=data.tu[within].copy(), u=data.u[within].copy(), interval=0.0)
