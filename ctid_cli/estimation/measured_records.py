r"""Measured records laid out for estimation: delay, initial state, offset, several experiments, and what is refused.

.. math:: y(t_k) = \frac{B}{A} u(t_k-\tau) + \frac{C}{A}\delta(t_k-t_s) + c + e_k

``C/A`` applied to an impulse at the first used instant ``t_s`` spans every free response of A, so the n coefficients of
C are the initial state, whatever happened before. C and the offset c belong to one experiment each, the rest is common.
"""

from collections.abc import Sequence
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array, BoolArray
from ctid_cli.errors import DataError
from ctid_cli.estimation.common import check_greatest_delay, check_record
from ctid_cli.estimation.optimum.best_model import SearchOptions, problem_of
from ctid_cli.estimation.optimum.box import ANYWHERE, point_of
from ctid_cli.estimation.optimum.chain import Chain, chain_dynamics, numerators
from ctid_cli.estimation.optimum.pilot import liveliest_parts
from ctid_cli.estimation.optimum.projection import Problem
from ctid_cli.estimation.optimum.triangle import Columns, rows_of
from ctid_cli.filtering.filter_data import FilterData, filter_data, used_samples
from ctid_cli.inference.input_response import output_bandwidth
from ctid_cli.inference.sensitivities import Structure
from ctid_cli.inference.signal_features import outliers
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record, named
from ctid_cli.signals.treatment import InitialState, Offset, OutputHold


@dataclass(frozen=True)
class Layout:
    """Which numbers stand where in the parameter vector: coefficients, delay, then each experiment's own."""

    structure: Structure
    experiments: int = 1
    initial_state: bool = False
    offset: bool = False
    #: Poles at the origin: that many of the last coefficients of the denominator are zero.
    integrators: int = 0

    @property
    def own(self) -> int:
        """Number of parameters that belong to one experiment."""
        return self.structure.poles * self.initial_state + int(self.offset)

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
            names += [f"offset{tail}"] * self.offset
        return tuple(names)

    def theta(self, model: TransferFunction) -> Array:
        """The parameters of a model of this structure, and zeros for what belongs to the experiments."""
        theta, n = np.zeros(self.size), self.structure.poles
        theta[:n] = model.denominator[1:]
        last = n + self.structure.zeros + 1
        theta[last - model.numerator.size : last] = model.numerator
        if self.structure.delay:
            theta[last] = model.delay
        return theta

    def own_of(self, theta: Array, experiment: int) -> tuple[Array, float]:
        """Initial state and offset of one experiment."""
        first = self.first(experiment)
        own = theta[first : first + self.own]
        return own[: self.structure.poles * self.initial_state], float(own[-1]) if self.offset else 0.0

    def first(self, experiment: int) -> int:
        """Where the parameters of an experiment begin."""
        return self.structure.size + experiment * self.own


def sensitivities(problem: Problem, layout: Layout, theta: Array, delay: float) -> list[tuple[Array, Array]]:
    """Derivatives of the simulated output to the parameters, and the output error, at the used samples of each record.

    The delay is that of theta where it is a parameter. The last coefficients of the denominator are zero where the
    problem has integrators.
    """
    structure, n, m = layout.structure, layout.structure.poles, layout.structure.zeros
    a, b = np.concatenate(([1.0], theta[:n])), theta[n : n + m + 1]
    stable = np.roots(a[: n + 1 - problem.integrators]).astype(complex)
    point = point_of(stable, theta[n + m + 1] if structure.delay else delay, ANYWHERE)
    sections = problem.sections(point.speed, point.damping)
    F, g = chain_dynamics(*sections)
    # From the states to p^(n-1)/A ... 1/A. With n zeros B/A = b0 + B'/A, and p^n/A u = u - sum a_i p^(n-i)/A u.
    powers = np.linalg.inv(numerators(*sections))
    direct = b[0] if m == n else 0.0
    output = ((b - direct * a)[1:] if m == n else np.concatenate((np.zeros(n - 1 - m), b))) @ powers
    columns = Columns.of(n, second=True, free=layout.initial_state, offset=layout.offset)
    result = []
    for k, (data, period) in enumerate(zip(problem.records, problem.periods, strict=True)):
        first = layout.first(k)
        own = theta[first : first + layout.own]
        state = own[:n] if layout.initial_state else np.zeros(n)
        form = Chain(*sections, F, g, F, g).driving(output, direct, state @ powers)
        # Columns of the rows that are wanted, each a combination of the states, the input and what else stands there.
        wanted = np.zeros((columns.size, layout.size + 1))
        states, driven, now, measured = wanted[:n], wanted[n : 2 * n], wanted[columns.u], wanted[columns.u + 1]
        driven[:, :n] = -powers.T
        filtered = powers.T
        coefficients = np.column_stack((-filtered @ a[1:], filtered))[:, n - m :]
        states[:, n : n + m + 1] = coefficients
        if m == n:
            now[n] = 1.0
        if structure.delay:
            states[:, n + m + 1], now[n + m + 1] = -(output @ F), -(output @ g)
        if layout.initial_state:
            alone, driven_alone = wanted[columns.free_states][:n], wanted[columns.free_states][n:]
            driven_alone[:, :n] = -powers.T
            alone[:, first : first + n] = powers.T
        if layout.offset:
            wanted[-1, first + layout.own - 1] = 1.0
        states[:, -1], now[-1], measured[-1] = -output, -direct, 1.0
        wanted[:, -1] -= wanted[:, first : first + layout.own] @ own
        rows = np.vstack([part.T @ wanted for part in rows_of(form, columns, point.delay, data, period)])
        result.append((rows[:, :-1], rows[:, -1].copy()))
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


class MeasuredRecords:
    """Records of one system, laid out for filtering."""

    def __init__(self, records: Sequence[Record], structure: Structure, treatment: Treatment) -> None:
        if not records:
            raise DataError("there is no record to estimate from")
        self.structure = structure
        self.treatment = treatment
        free_state, integrators = treatment.initial_state == "estimate", treatment.integrators
        # The free response of an integrator is a constant.
        offset = treatment.offset == "estimate" and not (free_state and integrators)
        self.layout = Layout(structure, len(records), free_state, offset, integrators)
        for record in records:
            self._check_input(record)
        removed = treatment.offset == "remove"
        bridged = [_bridged(record) if treatment.bridge else record for record in records]
        centred = [without_means(record) if removed else (record, 0.0, 0.0) for record in bridged]
        self.records = [one for one, _, _ in centred]
        self.input_offsets = [u0 for _, u0, _ in centred]
        self.offsets = [y0 for _, _, y0 in centred]
        self.data = [self._lay_out(record) for record in self.records]
        for record, data in zip(self.records, self.data, strict=True):
            check_record(record, data, self.layout.size, self.layout.initial_state)
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
        for name in ("options", "problem"):
            other.__dict__.pop(name, None)
        return other

    @property
    def plain(self) -> bool:
        """Whether there is but one record and nothing of its own to be estimated."""
        treatment = self.treatment
        from_rest = self.layout.own == 0 and treatment.initial_state != "periodic" and not treatment.integrators
        return from_rest and len(self.data) == 1 and self.structure.zeros < self.structure.poles

    def _check_input(self, record: Record) -> None:
        """Refuse what an input cannot tell."""
        low, high = self.treatment.delay_bounds
        if high > 0:
            check_greatest_delay(record, high)
        if np.ptp(record.input.values) > 0.0:
            return
        constant = f"{named(record)}the input is constant ({record.input.values[0]:g}) over the whole record"
        if low < high or self.treatment.initial_state != "estimate":
            raise DataError(
                f"{constant}: only a free response tells anything; give a known delay and initial_state 'estimate'"
            )

    def _lay_out(self, record: Record) -> FilterData:
        # At rest the input before the record is known to be zero, whatever the delay, and that of a periodic record is
        # known too; otherwise it is not known.
        treatment = self.treatment
        known_after = treatment.delay_bounds[1] if treatment.initial_state == "estimate" else 0.0
        periodic = treatment.initial_state == "periodic"
        return filter_data(record, known_after, treatment.hold_output, periodic=periodic)

    @cached_property
    def options(self) -> SearchOptions:
        """What is estimated beside the coefficients."""
        periodic = self.treatment.initial_state == "periodic"
        return SearchOptions(
            delays=self.treatment.delay_bounds,
            free_response=self.layout.initial_state,
            offset=self.layout.offset,
            integrators=self.layout.integrators,
            periods=[_period(record) for record in self.records] if periodic else (),
        )

    @cached_property
    def problem(self) -> Problem:
        """The records and what is eliminated with them."""
        return problem_of(self.data, self.structure.zeros, self.options)

    def part(self) -> "MeasuredRecords | None":
        """The liveliest parts of long records, each from a state of its own; None where they tell too little."""
        treatment = self.treatment
        parts = liveliest_parts(self.data, treatment.delay_bounds[1])
        if parts is None or treatment.initial_state == "periodic":
            return None
        offset: Offset = "none" if treatment.offset == "remove" else treatment.offset
        cut = [_cut(record, part) for record, part in zip(self.records, parts, strict=True)]
        with suppress(DataError):
            own = treatment._replace(initial_state="estimate", offset=offset, bridge=False)
            return MeasuredRecords(cut, self.structure, own)
        return None

    @cached_property
    def centred(self) -> FilterData:
        """The first record without its means, for starts that know no offset and no initial state."""
        if self.treatment.offset != "estimate":
            return self.data[0]
        return self._lay_out(without_means(self.records[0])[0])

    def used(self) -> tuple[BoolArray, ...]:
        """Which samples of each record enter the sums."""
        return tuple(used_samples(*pair) for pair in zip(self.data, self.records, strict=True))


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
