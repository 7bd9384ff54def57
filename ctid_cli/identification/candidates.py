"""Fits of many structures to the same records, each started from smaller structures that it contains."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from ctid_cli import progress
from ctid_cli.errors import DataError, OptionError
from ctid_cli.estimation.common import Bound, Fixed
from ctid_cli.estimation.measured_records import MeasuredRecords
from ctid_cli.estimation.optimum.best_model import Optimum, best_near, best_of_orders
from ctid_cli.estimation.optimum.box import Point, box_of, point_of
from ctid_cli.estimation.optimum.search import Local
from ctid_cli.estimation.optimum.starts import QUICK, StructureSearch
from ctid_cli.estimators.additive_output_error import GROWN, AdditiveOutputError
from ctid_cli.estimators.delay_profile import DelayProfile, InputModel
from ctid_cli.estimators.measured_fit import fitted
from ctid_cli.identification.criterion import PENALTY, Candidate, Ranking, Searched, penalised, ranked
from ctid_cli.models.additive import Term
from ctid_cli.models.several_inputs import AnyModel, delays_of
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.record import Record, named, with_hold
from ctid_cli.signals.treatment import Holds, InitialState, InputBefore, Offset

#: Most poles, integrators included.
MOST_POLES = 12
#: The grid ends this many poles above the order of the best structure, and at this order at the least.
BEYOND, FEWEST_TRIED = 2, 4
#: Least order of that end while an added pole lowers the criterion even in white noise: otherwise the part of the
#: response that the closest fit misses would pass as coloured noise.
TRIED_AGAINST_NOISE = 6
#: From then on a number of integrators is dropped if its best structure is this far behind.
BEHIND = 30.0
#: Poles (integrators included) and zeros of the structures with which settings of records are compared.
SMALL = ((1, 0), (2, 1), (3, 2))
#: A zero whose removal costs this many penalties of a parameter at the delays found is not tried at others.
FAR_BEHIND = 10.0
#: Fewest samples for each parameter of a structure.
SAMPLES_PER_PARAMETER = 3


#: Known model with numbers of integrators, poles and zeros; None if there is none.
Known = Callable[[int, int, int], AnyModel | None]


class Setting(NamedTuple):
    """Treatment of records."""

    hold: Holds
    initial_state: InitialState
    input_before: InputBefore
    offset: Offset


class Several(NamedTuple):
    """Options of several inputs, which share a denominator."""

    #: Given ranges of their delays.
    inputs: tuple[InputModel, ...] | None = None
    #: Whether each may have fewer zeros than the structure.
    fewer_zeros: bool = True
    #: Delays of a small model, from which searches start.
    first_delays: tuple[float, ...] | None = None


class Span(NamedTuple):
    """Ranges of the numbers of poles (without integrators) and zeros, and the numbers of integrators."""

    poles: tuple[int, int] = (0, MOST_POLES)
    zeros: tuple[int, int] = (0, MOST_POLES)
    integrators: tuple[int, ...] = (0, 1)
    #: Range of the number of second-order submodels, if models are sums of these.
    modes: tuple[int, int] | None = None
    #: Known and bounded parameters.
    fixed: tuple[Fixed, ...] | None = None
    bounds: tuple[Bound, ...] | None = None

    def only(self, options: Searched) -> "Span":
        """Return the span of the transfer functions of one structure."""
        poles, zeros = options.order - options.integrators, options.zeros
        return Span((poles, poles), (zeros, zeros), (options.integrators,), None, self.fixed, self.bounds)

    @property
    def most_poles(self) -> int:
        """Greatest number of poles, integrators included."""
        return (self.poles[1] if self.modes is None else 2 * self.modes[1]) + max(self.integrators)

    def structures(self, order: int, integrators: int, delay_free: bool) -> Iterable[tuple[int, int]]:
        """Yield poles and zeros of all structures of an order, integrators included."""
        poles = order - integrators
        if max(self.poles[0], int(not integrators)) <= poles <= self.poles[1]:
            for zeros in range(self.zeros[0], min(self.zeros[1], order - int(delay_free)) + 1):
                yield poles, zeros

    def small(self, integrators: int, delay_free: bool, most: int) -> list[tuple[int, int]]:
        """Return small structures with which settings are compared; the smallest one if none is small."""
        orders = range(1, MOST_POLES + max(self.integrators) + 1)
        found = [(n, each) for n in orders for each in self.structures(n, integrators, delay_free)]
        small = [each for n, each in found if (n, each[1]) in SMALL[:most]]
        return small or [each for _, each in found[:1]]


@dataclass(frozen=True, eq=False)
class Structures:
    """Structures with one number of integrators, in one setting of the records."""

    records: Sequence[Record]
    hold: Holds
    options: DelayProfile
    measured: MeasuredRecords
    search: StructureSearch
    span: Span
    #: Models of another setting, from which all searches start.
    near: Callable[[int, int], AnyModel | None] | None = None
    #: Whether each of several inputs may have fewer zeros than its structure.
    fewer_zeros: bool = False
    found: dict[tuple[int, int], Candidate] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        records: Sequence[Record],
        setting: Setting,
        integrators: int,
        delays: tuple[float, float],
        several: Several,
        span: Span,
        near: Callable[[int, int], AnyModel | None] | None = None,
    ) -> "Structures":
        """Prepare records."""
        hold, state, before, offset = setting
        # The offset of an integrator's input is a drift of its output.
        offset = "estimate" if integrators and offset == "drift" else offset
        options = DelayProfile(
            *(int(not integrators), 0, delays),
            initial_state=state,
            offset=offset,
            integrators=integrators,
            input_before=before,
            inputs=several.inputs,
        )
        held = [with_hold(record, hold) for record in records]
        measured = options.prepare(held).laid_out
        box = box_of(measured.problem, measured.treatment.delay_bounds)
        search = StructureSearch(measured.problem, box, effort=QUICK, first_delays=several.first_delays)
        return cls(held, hold, options, measured, search, span, near, several.fewer_zeros)

    def tried(self, order: int, span: Span) -> list[Candidate | None]:
        """Fit all structures of an order, integrators included."""
        structures = span.structures(order, self.options.integrators, self.search.box.delay_free)
        return [self.fit(*structure) for structure in structures]

    def fit(self, poles: int, zeros: int) -> Candidate | None:
        """Fit a structure; return None if there are too few samples."""
        if (poles, zeros) not in self.found:
            if self.span.fixed or self.span.bounds:
                return self._constrained(poles, zeros)
            options, measured = replace(self.options, poles=poles, zeros=zeros), self.measured
            laid_out = measured.with_degrees(options.order, [zeros] * len(measured.degrees.inputs))
            size = laid_out.layout.size - options.integrators
            if SAMPLES_PER_PARAMETER * size > sum(data.count for data in measured.data):
                return None
            found = fitted(laid_out, self._least(poles, zeros), None)
            candidate = Candidate(options, self.hold, found, size)
            self.found[poles, zeros] = self._with_fewer_zeros(candidate) if self.fewer_zeros else candidate
        return self.found[poles, zeros]

    def _constrained(self, poles: int, zeros: int) -> Candidate | None:
        """Fit a structure with its known and bounded parameters; None if it does not have them."""
        try:
            options = replace(self.options, poles=poles, zeros=zeros, fixed=self.span.fixed, bounds=self.span.bounds)
            laid_out = options.prepare(self.records).laid_out
        except OptionError:
            return None
        size = laid_out.layout.size - int(np.count_nonzero(laid_out.given))
        if SAMPLES_PER_PARAMETER * size > sum(data.count for data in laid_out.data):
            return None
        near = None if self.near is None or options.bounds else self.near(poles, zeros)
        try:
            if near is None:
                fit = options._minimum(laid_out, None)
            else:
                fit = fitted(laid_out, laid_out.local(laid_out.begin(near)), None)
        except DataError:
            return None
        self.found[poles, zeros] = Candidate(options, self.hold, fit, size)
        return self.found[poles, zeros]

    def _with_fewer_zeros(self, candidate: Candidate) -> Candidate:
        """Remove the zeros of each input that do not lower the criterion in white noise."""
        names, fit = self.measured.degrees.inputs, candidate.fit
        zeros = [candidate.options.zeros] * len(names)
        if fit.poles_at_infinity or len(names) < 2:
            return candidate
        point = self._point(fit.model)
        error, penalty = fit.cost * fit.count, PENALTY * float(np.log(fit.count)) / fit.count
        for k in range(len(names)):
            while zeros[k] > 0:
                fewer = [*zeros[:k], zeros[k] - 1, *zeros[k + 1 :]]
                found = self._without_zero(fewer, point, error, penalty)
                if np.log(found.squared_error / error) > penalty:
                    break
                zeros, point, error = fewer, found.point, found.squared_error
        return self._near(candidate, zeros, point) if min(zeros) < candidate.options.zeros else candidate

    def _without_zero(self, zeros: Sequence[int], point: Point, error: float, penalty: float) -> Local:
        """Return a minimum with numerators of other degrees, near one with this squared error."""
        poles, most = point.poles.size, max(zeros)
        _, search = self._quick(zeros, point)
        found = search.descent(most).descend(point)
        if penalty < np.log(found.squared_error / error) < FAR_BEHIND * penalty:
            # There may be a lower minimum at other delays.
            search.refine(poles, most, [found.point])
            return search.minima(poles, most)[0]
        return found

    def _near(self, candidate: Candidate, zeros: Sequence[int], point: Point) -> Candidate:
        """Fit numerators of other degrees, starting at known poles and delays."""
        assert isinstance(candidate.options, DelayProfile)
        own = {one.name: one for one in candidate.options.inputs or ()}
        names = self.measured.degrees.inputs
        inputs = tuple(replace(own.get(name, InputModel(name)), zeros=m) for name, m in zip(names, zeros, strict=True))
        laid_out, search = self._quick(zeros, point)
        fit = fitted(laid_out, best_near(search, max(zeros), point), None)
        size = laid_out.layout.size - candidate.options.integrators
        return replace(candidate, options=replace(candidate.options, inputs=inputs), fit=fit, size=size)

    def _quick(self, zeros: Sequence[int], point: Point) -> tuple[MeasuredRecords, StructureSearch]:
        """Prepare numerators of other degrees, with the number of poles of a point, and their search."""
        laid_out = self.measured.with_degrees(point.poles.size + self.options.integrators, zeros)
        return laid_out, StructureSearch(laid_out.problem, self.search.box, effort=QUICK)

    def _point(self, model: AnyModel) -> Point:
        """Return the poles of a model, without integrators, and its delays."""
        return point_of(self.measured.free_poles(model), delays_of(model), self.search.box)

    def model(self, poles: int, zeros: int) -> AnyModel | None:
        """Return a model that was fitted; None if there were too few samples."""
        found = self.found.get((poles, zeros))
        return None if found is None else found.fit.model

    def _least(self, poles: int, zeros: int) -> Optimum:
        near = None if self.near is None else self.near(poles, zeros)
        if near is None:
            return best_of_orders(self.search, poles, zeros)
        return best_near(self.search, zeros, self._point(near))


@dataclass(frozen=True, eq=False)
class Sums:
    """Sums of second-order submodels, the first one with integrators, in one setting of the records."""

    records: Sequence[Record]
    hold: Holds
    #: Options of one submodel.
    options: AdditiveOutputError

    @classmethod
    def of(cls, records: Sequence[Record], setting: Setting, integrators: int, delays: tuple[float, float]) -> "Sums":
        """Prepare records."""
        hold, state, before, offset = setting
        options = AdditiveOutputError(_modes(1, integrators), delays, state, offset, input_before=before)
        return cls([with_hold(record, hold) for record in records], hold, options)

    def tried(self, order: int, span: Span) -> list[Candidate | None]:
        """Fit the sum of an order, integrators included; None if there are too few samples."""
        assert span.modes is not None
        number, odd = divmod(order - self.options.integrators, 2)
        return [self._fit(number)] if not odd and span.modes[0] <= number <= span.modes[1] else []

    def _fit(self, number: int) -> Candidate | None:
        options = replace(self.options, terms=_modes(number, self.options.integrators))
        measured = options.prepare(self.records).laid_out
        size = measured.layout.size
        if SAMPLES_PER_PARAMETER * size > sum(data.count for data in measured.data):
            return None
        fit = options._of_submodels(measured, options._least(measured), GROWN)
        return Candidate(options, self.hold, fit, size)


def _modes(number: int, integrators: int) -> tuple[Term, ...]:
    return Term(2, 0, integrators), *(Term(2, 0) for _ in range(number - 1))


class SmallModels:
    """A few structures in several settings of the same records, found near known models if there are any."""

    def __init__(
        self,
        records: Sequence[Record],
        span: Span,
        delays: tuple[float, float],
        several: Several,
        near: Known | None = None,
        most: int = len(SMALL),
    ) -> None:
        self.records, self.span, self.delays, self.several = records, span, delays, several
        self.near, self.most = near, most
        self._structures: dict[tuple[Setting, int], Structures] = {}

    def compared(self, settings: Sequence[Setting]) -> Ranking:
        """Rank the structures in some settings, which all use the same samples."""
        found = [each for setting in progress.each("setting", settings) for each in self._fitted(setting)]
        if not found:
            raise DataError(f"{named(self.records[0])}too few usable samples for a model's parameters")
        return ranked(found)

    def larger(self, candidate: Candidate) -> Candidate | None:
        """Fit a pole and a zero more than a candidate, without known parameters, and an offset instead of its drift."""
        options = candidate.options
        assert isinstance(options, DelayProfile)
        poles, zeros = options.poles + 1, options.zeros + 1
        if options.order == MOST_POLES:
            return None
        setting = Setting(candidate.hold, options.initial_state, options.input_before, "estimate")
        span = Span((poles, poles), (zeros, zeros), (options.integrators,))
        own = Structures.of(self.records, setting, options.integrators, self.delays, self._begun(), span)
        return own.fit(poles, zeros)

    def _fitted(self, setting: Setting) -> Iterator[Candidate]:
        for integrators in self.span.integrators:
            if integrators and setting.offset == "drift":
                continue
            structures = self._laid_out(setting, integrators)
            for each in self.span.small(integrators, structures.search.box.delay_free, self.most):
                candidate = structures.fit(*each)
                if candidate is not None:
                    yield candidate

    def _laid_out(self, setting: Setting, integrators: int) -> Structures:
        """Prepare records; with another hold or offset, searches start at known models."""
        key = setting, integrators
        if key not in self._structures:
            pairs = ((one, number) for one, number in self._structures if one[1:3] == setting[1:3])
            alike = next((self._structures[pair] for pair in pairs if pair[1] == integrators), None)
            near = None if alike is None else alike.model
            near = near if self.near is None else partial(self.near, integrators)
            self._structures[key] = Structures.of(self.records, *key, self.delays, self._begun(), self.span, near)
        return self._structures[key]

    def _begun(self) -> Several:
        """Return the options of several inputs, whose searches start at the delays found with fewer integrators."""
        found = [each.fit for one in self._structures.values() for each in one.found.values()]
        if self.several.first_delays is not None or not found or not self.records[0].several:
            return self.several
        best = min(found, key=lambda fit: fit.cost)
        return self.several._replace(first_delays=tuple(delays_of(best.model)))

    def model(self, integrators: int, poles: int, zeros: int) -> AnyModel | None:
        """Return a model of a structure in the first setting with this number of integrators."""
        each = (one for (_, number), one in self._structures.items() if number == integrators)
        return next(each).model(poles, zeros)


def zero_on_integrator(model: TransferFunction, length: float) -> float | None:
    """Return the zero that nearly cancels an integrator over a record of a length [s]; None if there is none."""
    zero = min(model.zeros.real[model.zeros.imag == 0.0], key=abs, default=np.inf)
    return float(zero) if model.denominator[-1] == 0.0 and abs(zero) * length < 1.0 else None


def grid(
    records: Sequence[Record],
    setting: Setting,
    span: Span,
    delays: tuple[float, float],
    several: Several,
) -> Ranking:
    """Fit structures of increasing order, until the best lies inside the grid or none is left."""
    families = [
        Structures.of(records, setting, integrators, delays, several, span)
        if span.modes is None
        else Sums.of(records, setting, integrators, delays)
        for integrators in span.integrators
    ]
    found: list[Candidate] = []
    for order in range(1, min(span.most_poles, MOST_POLES) + 1):
        progress.report("order", order, min(span.most_poles, MOST_POLES))
        tried = [each for family in families for each in family.tried(order, span)]
        found += [each for each in tried if each is not None]
        if tried and not any(tried):
            break
        if order >= FEWEST_TRIED and found:
            ranking = ranked(found)
            inside = order - ranking.best.options.order >= BEYOND
            if inside and (order >= TRIED_AGAINST_NOISE or not still_pays(ranking, order)):
                break
            families = [family for family in families if _promising(family, ranking)]
    if not found:
        raise DataError(f"{named(records[0])}too few usable samples for a model's parameters; take a longer record")
    return ranked(found)


def still_pays(ranking: Ranking, order: int) -> bool:
    """Return whether a structure of about the greatest order is the best in white noise."""
    best = min((each for each in ranking.candidates if each.is_admissible), key=_criterion_in_white_noise, default=None)
    return best is not None and order - best.options.order < BEYOND


def _criterion_in_white_noise(candidate: Candidate) -> float:
    fit = candidate.fit
    return penalised(fit.cost * fit.count, fit.count, candidate.size)


def _promising(family: Structures | Sums, ranking: Ranking) -> bool:
    """Return whether structures with a number of integrators may still become the best."""
    own = ranking.of(integrators=family.options.integrators)
    return own is None or own.best.criterion - ranking.best.criterion < BEHIND
