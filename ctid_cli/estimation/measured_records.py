r"""Measured records prepared for estimation: delay, initial state, offset, several experiments, and data checks.

.. math:: y(t_k) = \frac{B}{A} u(t_k-\tau) + \frac{C}{A}\delta(t_k-t_s) + c + d (t_k-t_0) + e_k

``C/A`` applied to an impulse at the first used instant ``t_s`` spans every free response of A, so the n coefficients of
C represent any initial state. C, the offset c and the drift d are separate for each experiment, all other parameters
are common.
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array, BoolArray, ComplexArray
from ctid_cli.errors import CtidError, DataError
from ctid_cli.estimation.common import check_greatest_delay, check_record
from ctid_cli.estimation.optimum.best_model import (
    Begin,
    Optimum,
    best_local,
    best_output_error,
    best_sum,
    poles_of_submodels,
)
from ctid_cli.estimation.optimum.box import Bounds, Box, each_bounds
from ctid_cli.estimation.optimum.known import NOTHING, KnownCoefficients
from ctid_cli.estimation.optimum.projection import Problem
from ctid_cli.estimation.optimum.search import local_minimum
from ctid_cli.estimation.output_sensitivities import sensitivities
from ctid_cli.estimation.parameter_layout import Degrees, Layout, SumDegrees
from ctid_cli.estimation.record_preparation import (
    above_level,
    period_of,
    refuse_collinear,
    within_one_period,
    without_means,
    without_outliers,
)
from ctid_cli.filtering.filter_data import FilterData, filter_data, used_samples
from ctid_cli.inference.covariance import Rounding
from ctid_cli.inference.innovations import sampled
from ctid_cli.inference.repetition import Equivalent, Repetition, repetitions_of, without_level
from ctid_cli.inference.robust_loss import Weighting
from ctid_cli.inference.sensitivities import Structure, SumStructure
from ctid_cli.inference.signal_features import quantum
from ctid_cli.models.additive import AdditiveModel
from ctid_cli.models.several_inputs import AnyModel, SystemModel, delays_of, fractions_of
from ctid_cli.signals.noise import ArmaNoise
from ctid_cli.signals.record import Record, named
from ctid_cli.signals.treatment import InitialState, InputBefore, Offset, OutputHold

#: Difference of a delay from a shift, relative to it, that counts as zero.
SAME_SHIFT = 1e-3
#: Distance below the range of a delay, as a share of a shift, from which its lower bound is tried.
BELOW = 0.25
#: Excess of the squared error, in units of the noise variance, that rejects a model: 95 % of chi-square with one
#: degree of freedom.
REJECTED = 3.84


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
        bridged = [without_outliers(record) if treatment.bridge else record for record in records]
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
                    "(--input-before VALUE); else take a record in which the input changes"
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
            periods = tuple(period_of(record) for record in self.records)
            data = tuple(within_one_period(*pair) for pair in zip(self.data, periods, strict=True))
        else:
            periods, data = (0.0,) * len(self.data), tuple(self.data)
        layout, arguments = self.layout, dict(self.degrees.search_arguments)
        return Problem(data, arguments.pop("zeros"), layout.initial_state, layout.trend, periods, **arguments)

    @property
    def spread(self) -> float:
        """Sum of the squares of the outputs about the mean of each record."""
        return float(sum(np.sum((y - y.mean()) ** 2) for y in self.outputs))

    @cached_property
    def repetitions(self) -> tuple[tuple[Repetition, ...], ...]:
        """Repetitions of each input that leave its delay ambiguous; of several records those that all have.

        An assumed input before the records is no evidence, a given level is. With the opposite sign a level other than
        zero changes the offset.
        """
        treatment, found = self.treatment, []
        known = isinstance(treatment.input_before, float | int)
        for k, (low, high) in enumerate(each_bounds(treatment.delay_bounds)):
            of_records = []
            for record in self.records if low < high and not known else ():
                signal = list(record.held.values())[k]
                period = period_of(record) if treatment.initial_state == "periodic" else None
                all_of = repetitions_of(signal, record.t, period)
                of_records.append(all_of if treatment.offset != "none" else without_level(all_of, signal))
            first, *others = of_records or [()]
            found.append(tuple(one for one in first if all(any(map(one.agrees, other)) for other in others)))
        return tuple(found)

    def with_least_delays(self, found: Optimum) -> Optimum:
        """Return an optimum with the least of the delays in their ranges that the inputs cannot tell apart."""
        for k, repetitions in enumerate(self.repetitions):
            low = each_bounds(self.treatment.delay_bounds)[k][0]
            for one in sorted(repetitions, key=lambda one: one.shift):
                # A delay just below a whole shift may also be one just below the lower bound.
                while found.delays[k] - one.shift > low - BELOW * one.shift:
                    delays = list(found.delays)
                    delays[k] = max(delays[k] - one.shift, low)
                    trial = self.local((found.start[0], tuple(delays)))
                    if trial.delays[k] >= found.delays[k] or not self.as_good(trial, found):
                        break
                    found = replace(trial, tried=found.tried, agree=found.agree, others=found.others)
        return found

    def as_good(self, one: Optimum, other: Optimum) -> bool:
        """Return whether the data do not reject an optimum for another one, in white noise."""
        count = sum(data.count for data in self.problem.records)
        return one.squared_error <= other.squared_error * (1.0 + REJECTED / count)

    def equivalents(self, model: SystemModel) -> tuple[Equivalent, ...]:
        """Return the next models with other delays that the inputs cannot tell from an estimate."""
        begin = self.begin(model)
        return tuple(
            Equivalent(delay, one.sign, self.degrees.inputs[k] if self.degrees.several else "")
            for k, repetitions in enumerate(self.repetitions)
            for one in repetitions
            if (delay := self._equivalent_delay(begin, k, one)) is not None
        )

    def _equivalent_delay(self, begin: Begin, k: int, one: Repetition) -> float | None:
        """Return the delay of an equivalent of a model; None if the samples after both delays distinguish them."""
        assert isinstance(begin[1], tuple)
        delays = list(begin[1])
        delay = max(delays[k] + one.shift * (1 if delays[k] < one.shift * (1 - SAME_SHIFT) else -1), 0.0)
        # A shift of the input of an integrator changes its output by a constant.
        if one.exact and not (any(self.treatment.integrators) and self.treatment.offset == "none"):
            return delay
        treatment, bounds = self.treatment, list(each_bounds(self.treatment.delay_bounds))
        bounds[k] = min(delay, delays[k]), max(delay, delays[k])
        offset: Offset = "none" if treatment.offset == "remove" else treatment.offset
        with suppress(CtidError, np.linalg.LinAlgError):
            own = treatment._replace(
                delay_bounds=tuple(bounds), initial_state="estimate", offset=offset, input_before=None, bridge=False
            )
            both = MeasuredRecords(self.records, self.degrees, own, self.known)
            here = both.local(begin)
            delays[k] = delay
            there = both.local((begin[0], tuple(delays)))
            return there.delays[k] if both.as_good(there, here) else None
        return None

    def used(self) -> tuple[BoolArray, ...]:
        """Return the mask of the samples of each record that enter the sums."""
        return tuple(used_samples(*pair) for pair in zip(self.data, self.records, strict=True))

    # --- minimum of the output error -----------------------------------------------------------------

    @cached_property
    def _steps(self) -> list[float]:
        """Step of the output of each record, if it is coarsely rounded, else NaN."""
        return [quantum(record.y[record.valid]) for record in self.records]

    def rounding(self, errors: Sequence[Array]) -> tuple[Rounding | None, ...]:
        """Return the rounding of each output whose step exceeds the deviation of the output errors; none of lines."""
        each = zip(self._steps, self.problem.records, errors, strict=False)
        return tuple(Rounding(step, data.y_used - e) if step > e.std() else None for step, data, e in each)

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

    def best(self, starts: Sequence[Begin] = ()) -> Optimum:
        """Return the least output error, with given starts in addition to those of the search.

        A start of several denominators consists of poles.
        """
        bounds, known = self.treatment.delay_bounds, self.known
        if self.problem.terms:
            return self.with_least_delays(best_sum(self.problem, bounds, starts, known=known))
        poles = self.degrees.poles - self.problem.integrators
        return self.with_least_delays(best_output_error(self.problem, poles, bounds, starts, known=known))

    def begin(self, model: SystemModel) -> Begin:
        """Return the start of a search from a model."""
        poles = self.free_poles(model)
        return poles if self.problem.terms else np.atleast_1d(np.poly(poles).real), tuple(delays_of(model))

    def local(self, *starts: Begin, box: Box | None = None) -> Optimum:
        """Return the least output error in the basins of denominators, without their integrators, and delays."""
        bounds, known = self.treatment.delay_bounds, self.known
        if self.problem.terms:
            return best_sum(self.problem, bounds, starts, grown=False, known=known)
        poles = starts[0][0].size - 1
        found = best_local(self.problem, poles, bounds, starts, known=known, box=box)
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

    def errors(self, found: Optimum) -> list[Array]:
        """Return the output errors of an optimum at the used samples of each record."""
        return [y - x for y, x in zip(self.outputs, self.simulated(found), strict=True)]

    def squared_error_at(self, model: SystemModel, delay: float, k: int = 0) -> float:
        """Return the least sum of squared output errors at a given delay of an input, in the basin of a model."""
        delays = delays_of(model)
        delays[k] = delay
        poles, bounds = self.free_poles(model), self.with_delays({k: delay}).treatment.delay_bounds
        return local_minimum(self.problem, poles, delays, bounds, known=self.known).squared_error

    def with_delays(self, known: Mapping[int, float]) -> "MeasuredRecords":
        """Return a copy with known delays of some inputs, by their indices; the used samples stay."""
        other, each = copy(self), enumerate(each_bounds(self.treatment.delay_bounds))
        bounds = tuple((known[k],) * 2 if k in known else pair for k, pair in each)
        other.treatment = self.treatment._replace(delay_bounds=bounds)
        return other

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
