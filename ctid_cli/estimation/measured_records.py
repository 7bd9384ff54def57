r"""Measured records prepared for estimation: delay, initial state, offset, several experiments, and data checks.

.. math:: y(t_k) = \frac{B}{A} u(t_k-\tau) + \frac{C}{A}\delta(t_k-t_s) + c + d (t_k-t_0) + e_k

``C/A`` applied to an impulse at the first used instant ``t_s`` spans every free response of A, so the n coefficients of
C represent any initial state. C, the offset c and the drift d are separate for each experiment, all other parameters
are common.
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
from ctid_cli.estimation.optimum.box import ANYWHERE, Bounds, each_bounds, point_of
from ctid_cli.estimation.optimum.chain import Chain, block_diagonal, numerators
from ctid_cli.estimation.optimum.known import NOTHING, KnownCoefficients
from ctid_cli.estimation.optimum.projection import Problem
from ctid_cli.estimation.optimum.search import local_minimum
from ctid_cli.estimation.optimum.triangle import Columns, Delay, rows_of
from ctid_cli.estimation.parameter_layout import Degrees, Layout, SumDegrees
from ctid_cli.filtering.filter_data import FilterData, filter_data, used_samples
from ctid_cli.inference.innovations import sampled
from ctid_cli.inference.input_response import output_bandwidth
from ctid_cli.inference.robust_loss import Weighting
from ctid_cli.inference.sensitivities import Structure, SumStructure
from ctid_cli.inference.signal_features import outliers
from ctid_cli.models.additive import AdditiveModel
from ctid_cli.models.several_inputs import AnyModel, SystemModel, delays_of, fractions_of
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.noise import ArmaNoise
from ctid_cli.signals.record import Record, named
from ctid_cli.signals.treatment import InitialState, InputBefore, Offset, OutputHold

#: Number of random starts, plus the same number for each pole.
RANDOM_STARTS = 2
#: Inputs are collinear if a combination of them, each scaled to length one, is shorter than the first number; inputs
#: with a larger share in it than the second are named.
COLLINEAR, INVOLVED = 1e-6, 1e-3


def sensitivities(problem: Problem, layout: Layout, theta: Array, delays: Sequence[float]) -> list[tuple[Array, Array]]:
    """Return the derivatives of the output by the parameters, and the output error, at the used samples of each record.

    Delays that are parameters equal those of theta. With integrators the last coefficients of a denominator are zero.
    """
    degrees = layout.degrees
    fractions, chain_rule = degrees.fractions_of(theta)
    total, count = chain_rule.shape
    places = [degrees.delay(k) for k in range(len(delays))]
    seconds = [given if place is None else theta[place] for given, place in zip(delays, places, strict=True)]
    arrangement = problem.arranged(degrees.poles - sum(problem.each_integrators))
    columns = Columns.of(arrangement, True, layout.initial_state, layout.trend)
    # Required combinations of the columns of the rows (states, inputs and others): first the derivatives by the
    # coefficients of all monic fractions.
    monic = np.zeros((columns.size, total))
    common, free = np.zeros((columns.size, layout.size + 1)), np.zeros((columns.size, total))
    forms, to_powers, column = list[tuple[Chain, Array, Array]](), np.zeros((arrangement.order,) * 2), 0
    for k, channel in enumerate(arrangement.channels):
        rows, powers, outputs, direct, first = [], list[Array](), [], np.zeros(len(channel.terms)), 0
        states, driven = monic[columns.z(k)], monic[columns.states(k)][channel.order :]
        alone = free[columns.free_states(columns.free.index(k))] if k in columns.free else np.zeros_like(free)
        for place, term in enumerate(channel.terms):
            (b, a), fractions = fractions[0], fractions[1:]
            order, m = a.size - 1, b.size - 1
            own, at = slice(first, first + order), slice(column, column + order)
            rows.append(_sections_of(a, term.integrators, problem))
            # From the states to p^(n-1)/A ... 1/A. With n zeros B/A = b0 + B'/A, and p^n/A u = u - sum a_i p^(n-i)/A u.
            powers.append(np.asarray(np.linalg.inv(numerators(*rows[-1])), dtype=float))
            turned = powers[-1].T
            driven[own, at] = -turned
            alone[channel.order :][own, at] = -turned
            states[own, at.stop : at.stop + m + 1] = np.column_stack((-turned @ a[1:], turned))[:, order - m :]
            if m == order:
                monic[columns.u(k), at.stop] = 1.0
                direct[place], b = b[0], (b - b[0] * a)[1:]
            outputs.append(np.concatenate((np.zeros(order - b.size), b)) @ powers[-1])
            first, column = first + order, at.stop + m + 1
        form, output = Chain.of(rows), np.concatenate(outputs)
        forms.append((form, output, direct))
        to_powers[channel.states, channel.states] = block_diagonal(powers)
        if (delay := places[channel.input]) is not None:
            common[columns.z(k), delay] = -(output @ form.dynamics)
            common[columns.u(k), delay] = -(output @ form.gain)
        common[columns.z(k), -1], common[columns.u(k), -1] = -output, -direct.sum()
    common[:, :count] += (monic + free) @ chain_rule
    common[columns.y, -1] = 1.0
    result = []
    for record, (data, period) in enumerate(zip(problem.records, problem.periods, strict=True)):
        first = layout.first(record)
        own_values = theta[first : first + layout.own]
        n = arrangement.order
        state = (own_values[:n] if layout.initial_state else np.zeros(n)) @ to_powers
        each = zip(forms, arrangement.channels, strict=True)
        driving = [form.driving(output, direct, state[one.states]) for (form, output, direct), one in each]
        wanted = common.copy()
        for number, k in enumerate(columns.free):
            own = arrangement.channels[k].states
            wanted[columns.free_z(number), first + own.start : first + own.stop] = to_powers[own, own].T
        wanted[columns.powers, first + layout.own - len(layout.trend) : first + layout.own] = np.eye(len(layout.trend))
        wanted[:, -1] -= wanted[:, first : first + layout.own] @ own_values
        parts = rows_of(driving, columns, tuple(Delay(float(tau), -1) for tau in seconds), data, period)
        found = np.vstack([part.T @ wanted for part in parts])
        result.append((found[:, :-1], found[:, -1].copy()))
    return result


def _sections_of(denominator: Array, integrators: int, problem: Problem) -> tuple[Array, Array]:
    """Return the sections of a denominator, whose last coefficients are zero with integrators."""
    stable = np.roots(denominator[: denominator.size - integrators]).astype(complex)
    point = point_of(stable, 0.0, ANYWHERE)
    (sections,) = problem._replace(terms=(), integrators=integrators).rows(point.speed, point.damping)
    return sections


class Treatment(NamedTuple):
    """Options of the preparation of records."""

    delay_bounds: Bounds
    initial_state: InitialState
    offset: Offset
    hold_output: OutputHold
    #: Whether outliers are interpolated during the search for starts.
    bridge: bool = False
    #: Poles at the origin of each denominator, included in those of the structure.
    integrators: tuple[int, ...] = (0,)
    #: Input before the first sample of a record that begins at rest [input unit].
    input_before: InputBefore = None


@dataclass(frozen=True, eq=False)
class AppliedModel:
    """A given model applied to records, which may differ from those of its estimation."""

    #: Output errors at the used samples of each experiment [output unit].
    residuals: tuple[Array, ...] = field(repr=False)
    used: tuple[BoolArray, ...] = field(repr=False)
    initial_states: tuple[Array, ...]
    #: Output offset of each experiment [output unit].
    offsets: tuple[float, ...]
    #: Derivatives of the output at the used samples by all parameters, including the delay and those of each
    #: experiment, shape (count, p).
    sensitivities: tuple[Array, ...] = field(repr=False)


class MeasuredRecords:
    """Records of one system, prepared for estimation, and their output-error cost over all parameters."""

    def __init__(
        self,
        records: Sequence[Record],
        structure: Structure | Degrees | SumDegrees,
        treatment: Treatment,
        known: KnownCoefficients = NOTHING,
    ) -> None:
        if not records:
            raise DataError("there is no record to estimate from")
        self.treatment, self.known = treatment, known
        free_state, integrators = treatment.initial_state == "estimate", max(treatment.integrators)
        degrees = Degrees.of(structure, integrators) if isinstance(structure, Structure) else structure
        # Integrators turn an offset of their input into powers of time; the lower powers are free responses.
        highest = {"estimate": integrators, "drift": 1}.get(treatment.offset, -1)
        trend = tuple(range(integrators if free_state else 0, highest + 1))
        self.layout = Layout(degrees, len(records), free_state, trend)
        for record in records:
            self._check_input(record)
        removed = treatment.offset == "remove"
        bridged = [_bridged(record) if treatment.bridge else record for record in records]
        level = treatment.input_before
        centred = [without_means(record) if removed else above_level(record, level) for record in bridged]
        self.records = [one for one, _, _ in centred]
        self.input_offsets = [u0 for _, levels, _ in centred for u0 in levels]
        self.offsets = [y0 for _, _, y0 in centred]
        for record in self.records if degrees.several else ():
            refuse_collinear(record)
        self.data = [self._lay_out(record) for record in self.records]
        for record, data in zip(self.records, self.data, strict=True):
            may_be_constant = self.layout.initial_state or treatment.input_before is not None
            check_record(record, data, self.layout.size, may_be_constant)
        each = zip(records, self.offsets, self.data, strict=True)
        #: Measured outputs at the used samples, minus their means if those are removed.
        self.outputs = [record.y[used_samples(data, record)] - y0 for record, y0, data in each]

    @cached_property
    def bandwidth(self) -> float:
        """Highest significant frequency of an output [rad/s]."""
        return max(output_bandwidth(record) for record in self.records)

    @property
    def degrees(self) -> Degrees | SumDegrees:
        """Degrees of the model."""
        return self.layout.degrees

    @property
    def structure(self) -> Structure | SumStructure:
        """Degrees of a sum, or of the transfer function of the first input."""
        return self.degrees.structure

    def with_degrees(self, poles: int, zeros: Sequence[int]) -> "MeasuredRecords":
        """Return a copy for a common denominator, with integrators in ``poles``, and other numerator degrees."""
        other = copy(self)
        assert isinstance(self.degrees, Degrees)
        degrees = replace(self.degrees, orders=(poles,), zeros=tuple(zeros))
        other.layout = replace(self.layout, degrees=degrees)
        other.problem = self.problem._replace(**degrees.search_arguments)
        return other

    @property
    def plain(self) -> bool:
        """Whether there is a single record without further parameters, with one input and from rest."""
        treatment, degrees = self.treatment, self.degrees
        if isinstance(degrees, SumDegrees):
            return False
        from_rest = self.layout.own == 0 and treatment.initial_state != "periodic" and not any(treatment.integrators)
        single = len(self.data) == 1 and not degrees.several
        return from_rest and single and max(degrees.zeros) < degrees.poles

    def _check_input(self, record: Record) -> None:
        """Raise DataError if an input does not determine the model."""
        if tuple(record.held) != self.degrees.inputs and self.degrees.several:
            raise DataError(
                f"{named(record)}the inputs are {', '.join(record.held)}, and those of the model are "
                f"{', '.join(self.degrees.inputs)}"
            )
        if record.several and (record.loop is not None or record.feedback):
            raise DataError(f"{named(record)}a record in a loop is fitted with one input; give one")
        before = self.treatment.input_before
        for (name, signal), (low, high) in zip(
            record.held.items(), each_bounds(self.treatment.delay_bounds), strict=True
        ):
            if high > 0:
                check_greatest_delay(record, high)
            first = float(signal.values[0])
            if np.ptp(signal.values) > 0.0 or before not in (None, "first", first):
                continue
            if low < high or self.treatment.initial_state != "estimate":
                raise DataError(
                    f"{named(record)}the input {f'{name} ' * record.several}is constant ({first:g}) over the whole "
                    "record; if the record begins with its step, give the level of the input before it: input_before "
                    "(--input-before VALUE)"
                )

    def _lay_out(self, record: Record) -> FilterData:
        # The input before the record is zero at rest, and known for a periodic record; otherwise it is unknown.
        treatment = self.treatment
        known_after = self.greatest_delay if treatment.initial_state == "estimate" else 0.0
        periodic = treatment.initial_state == "periodic"
        return filter_data(record, known_after, treatment.hold_output, periodic=periodic)

    @property
    def greatest_delay(self) -> float:
        """Greatest delay of all inputs [s]."""
        return max(high for _, high in each_bounds(self.treatment.delay_bounds))

    @cached_property
    def problem(self) -> Problem:
        """Records and eliminated terms of the search."""
        if self.treatment.initial_state == "periodic":
            periods = tuple(_period(record) for record in self.records)
            data = tuple(_one_period(*pair) for pair in zip(self.data, periods, strict=True))
        else:
            periods, data = (0.0,) * len(self.data), tuple(self.data)
        layout, arguments = self.layout, dict(self.degrees.search_arguments)
        return Problem(data, arguments.pop("zeros"), layout.initial_state, layout.trend, periods, **arguments)

    def part(self) -> "MeasuredRecords | None":
        """Return the most active parts of long records, with separate initial states; None if they do not suffice."""
        treatment = self.treatment
        parts = most_active_parts(self.data, self.greatest_delay)
        if parts is None or treatment.initial_state == "periodic":
            return None
        offset: Offset = "none" if treatment.offset == "remove" else treatment.offset
        cut = [_cut(record, part) for record, part in zip(self.records, parts, strict=True)]
        with suppress(DataError):
            own = treatment._replace(initial_state="estimate", offset=offset, bridge=False, input_before=None)
            return MeasuredRecords(cut, self.degrees, own)
        return None

    @cached_property
    def centred(self) -> FilterData:
        """First record without its means, for starts that do not estimate an offset and an initial state."""
        if self.treatment.offset not in ("estimate", "drift"):
            return self.data[0]
        return self._lay_out(without_means(self.records[0])[0])

    @property
    def spread(self) -> float:
        """Sum of the squares of the outputs about the mean of each record."""
        return float(sum(np.sum((y - y.mean()) ** 2) for y in self.outputs))

    def used(self) -> tuple[BoolArray, ...]:
        """Return the mask of the samples of each record that enter the sums."""
        return tuple(used_samples(*pair) for pair in zip(self.data, self.records, strict=True))

    # --- minimum of the output error -----------------------------------------------------------------

    def with_outputs(self, outputs: Sequence[Array]) -> "MeasuredRecords":
        """Return a copy with other outputs at the used samples of each record."""
        records = []
        for data, values in zip(self.problem.sampled, outputs, strict=True):
            y = data.y.copy()
            y[data.use] = values
            records.append(data._replace(y=y))
        other = copy(self)
        other.problem = self.problem._replace(records=tuple(records))
        return other

    def whitened_by(self, noise: ArmaNoise) -> "MeasuredRecords":
        """Return a copy with errors whitened by a noise model."""
        other = copy(self)
        other.problem = self.problem._replace(noises=sampled(noise, self.used()))
        return other

    def near(
        self, errors: Sequence[Array], weighting: Weighting | None, noise: ArmaNoise | None = None
    ) -> "MeasuredRecords":
        """Return records whose least squares approximate the loss or likelihood near the estimate."""
        if noise is not None:
            return self.whitened_by(noise)
        if weighting is None:
            return self
        each = zip(self.outputs, errors, weighting.pseudo_errors, strict=True)
        return self.with_outputs([y - r + pseudo for y, r, pseudo in each])

    def best(self, starts: Sequence[Begin], nested: bool) -> Optimum:
        """Return the least output error from given starts, and if nested from smaller models and random starts.

        A start of several denominators consists of poles, and sums are extended term by term in any case. With an
        unknown initial state, an offset or a period, a profile has too few basins: smaller models are needed then.
        """
        random_starts = RANDOM_STARTS if nested or self.plain else 0
        if self.problem.terms:
            bounds, known = self.treatment.delay_bounds, self.known
            return best_sum(self.problem, bounds, starts, known=known, random_starts=random_starts)
        return best_output_error(
            self.problem,
            self.degrees.poles - self.problem.integrators,
            self.treatment.delay_bounds,
            starts,
            nested=nested or not self.plain or self.known is not NOTHING,
            fewer_poles=nested,
            random_starts=random_starts,
            known=self.known,
        )

    def local(self, *starts: Begin) -> Optimum:
        """Return the least output error in the basins of denominators, without their integrators, and delays."""
        if self.problem.terms:
            return best_sum(self.problem, self.treatment.delay_bounds, starts, grown=False, known=self.known)
        poles, delays = starts[0][0].size - 1, self.treatment.delay_bounds
        found = best_output_error(self.problem, poles, delays, starts, nested=False, random_starts=0, known=self.known)
        # Starts may omit poles at infinity.
        return replace(found, poles_at_infinity=self.degrees.poles - self.problem.integrators - poles)

    def model(self, found: Optimum) -> AnyModel:
        """Return the model of an optimum; a sum as one transfer function."""
        return self.degrees.model(found)

    def parameters(self, found: Optimum) -> tuple[Layout, Array]:
        """Return the layout and the values of the parameters of an optimum."""
        layout = self.layout_of(self.model(found))
        theta = layout.theta(found.additive or self.model(found))
        for k in range(layout.experiments):
            state, first = found.free_responses[k] if layout.initial_state else (), layout.first(k)
            theta[first : first + layout.own] = [*state, *found.trends[k]]
        return layout, theta

    def simulated(self, found: Optimum) -> list[Array]:
        """Return the outputs of an optimum at the used samples of each record."""
        parts = sensitivities(self.problem, *self.parameters(found), found.delays)
        return [data.y_used - eps for data, (_, eps) in zip(self.problem.records, parts, strict=True)]

    def squared_error_at(self, model: SystemModel, delay: float, k: int = 0) -> float:
        """Return the least sum of squared output errors at a given delay of an input, in the basin of a model."""
        delays = delays_of(model)
        delays[k] = delay
        bounds = tuple(
            (delay, delay) if i == k else pair for i, pair in enumerate(each_bounds(self.treatment.delay_bounds))
        )
        poles = self.free_poles(model)
        return local_minimum(self.problem, poles, delays, bounds, known=self.known).squared_error

    def errors_of(self, model: SystemModel) -> AppliedModel:
        """Return the errors of a given model on these records, each with its best initial state and offset."""
        free = [True] * len(delays_of(model))
        layout = replace(self.layout, degrees=self.degrees.with_orders(model, free))
        theta, residuals = layout.theta(model), []
        found = sensitivities(self.problem, layout, theta, delays_of(model))
        for k, (psi, eps) in enumerate(found):
            own = slice(layout.first(k), layout.first(k) + layout.own)
            noises = self.problem.noises
            weigh = noises[k].whitened if noises else np.asarray
            theta[own] = np.linalg.lstsq(weigh(psi[:, own]), weigh(eps))[0]
            bridged = self.problem.records[k].y_used
            residuals.append(eps - psi[:, own] @ theta[own] + (self.outputs[k] - bridged))
        slopes = tuple(psi for psi, _ in found)
        return AppliedModel(tuple(residuals), self.used(), *self.own(layout, theta), slopes)

    def free_poles(self, model: SystemModel) -> ComplexArray:
        """Return the poles of a model without its integrators."""
        if isinstance(model, AdditiveModel):
            return poles_of_submodels(model)
        each = zip(fractions_of(model), self.problem.each_integrators, strict=False)
        return np.concatenate(
            [np.roots(one.denominator[: one.denominator.size - count]) for one, count in each]
        ).astype(complex)

    @property
    def given(self) -> BoolArray:
        """Mask of the known coefficients, including those that are zero due to integrators."""
        return self.degrees.given(self.known)

    def layout_of(self, model: SystemModel) -> Layout:
        """Return the layout of the parameters of a model that may have fewer poles."""
        return replace(self.layout, degrees=self.degrees.with_orders(model, self.degrees.delays))

    def own(self, layout: Layout, theta: Array) -> tuple[tuple[Array, ...], tuple[float, ...]]:
        """Return initial states and offsets of the experiments, including subtracted means."""
        own = [layout.own_of(theta, k) for k in range(layout.experiments)]
        offsets = tuple(y0 + c for y0, (_, c) in zip(self.offsets, own, strict=True))
        return tuple(state for state, _ in own), offsets


def _bridged(record: Record) -> Record:
    """Return a record with outliers replaced by interpolation between their neighbours."""
    present = np.flatnonzero(record.valid)
    outlying = present[outliers(record.y[present])]
    kept = np.setdiff1d(present, outlying)
    y = record.y.copy()
    y[outlying] = np.interp(record.t[outlying], record.t[kept], record.y[kept])
    return replace(record, y=y)


def _cut(record: Record, part: slice) -> Record:
    """Return part of a record, with the input known at its samples."""
    t = record.t[part]
    inputs = {name: HeldSignal(t, signal.values[part], signal.hold) for name, signal in record.held.items()}
    return Record(t, record.y[part], inputs, name=record.name)


def above_level(record: Record, before: InputBefore) -> tuple[Record, list[float], float]:
    """Return a record with inputs relative to their levels before it, these levels, and zero for its output."""
    firsts = [float(signal.values[0]) for signal in record.held.values()]
    levels = firsts if before == "first" else [float(before or 0.0)] * len(firsts)
    return _lowered(record, levels), levels, 0.0


def without_means(record: Record) -> tuple[Record, list[float], float]:
    """Return a record without the mean of its output and the time averages of its inputs, and these levels."""
    y0 = float(np.nanmean(record.y))
    means = [float(np.mean(signal.at(record.t))) for signal in record.held.values()]
    loop = record.loop and replace(record.loop, reference=record.loop.reference - record.loop.reference.mean())
    return Record(record.t, record.y - y0, _lowered(record, means).inputs, name=record.name, loop=loop), means, y0


def _lowered(record: Record, levels: Sequence[float]) -> Record:
    """Return a record with levels subtracted from its inputs."""
    if not any(levels):
        return record
    pairs = zip(record.held.items(), levels, strict=True)
    return replace(
        record, inputs={name: HeldSignal(one.t, one.values - level, one.hold) for (name, one), level in pairs}
    )


def refuse_collinear(record: Record) -> None:
    """Refuse collinear inputs, whose responses cannot be distinguished."""
    u = np.column_stack([signal.at(record.t) for signal in record.held.values()])
    u = u - u.mean(axis=0)
    lengths = np.linalg.norm(u, axis=0)
    if not lengths.all():
        return
    _, values, right = np.linalg.svd(u / lengths, full_matrices=False)
    if values[-1] < COLLINEAR * values[0]:
        collinear = [name for name, weight in zip(record.held, right[-1], strict=True) if abs(weight) > INVOLVED]
        raise DataError(
            f"{named(record)}the inputs {' and '.join(collinear)} are collinear: one is a linear function of the "
            "others, and their responses cannot be told apart; drop one, or record them moving independently"
        )


def _period(record: Record) -> float:
    """Return the period of a periodic record: its duration plus one interval."""
    return record.duration + (record.interval or float(np.median(np.diff(record.t))))


def _one_period(data: FilterData, period: float) -> FilterData:
    """Return the record with the breaks of its input within one period."""
    data = data._replace(further=tuple(_one_period(one, period) for one in data.further))
    within = data.tu < data.tu[0] + period * (1 - 1e-9)
    if within.all():
        return data
    # Filters for regular clocks require one break per sample.
    return data._replace(tu=data.tu[within].copy(), u=data.u[within].copy(), interval=0.0)
