"""Fits of many structures to the same records, each found from the smaller ones that it contains."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from ctid_cli.errors import DataError
from ctid_cli.estimation.measured_records import MeasuredRecords
from ctid_cli.estimation.optimum.best_model import Optimum, best_near, best_of_orders
from ctid_cli.estimation.optimum.box import box_of
from ctid_cli.estimation.optimum.starts import QUICK, StructureSearch
from ctid_cli.estimators.additive_output_error import GROWN, AdditiveOutputError
from ctid_cli.estimators.delay_profile import DelayProfile, fitted
from ctid_cli.identification.criterion import Candidate, Ranking, Searched, penalised, ranked
from ctid_cli.inference.sensitivities import Structure
from ctid_cli.models.additive import Term
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record, named
from ctid_cli.signals.treatment import Hold, InitialState, InputBefore, Offset

#: Most poles, integrators included.
MOST_POLES = 12
#: The grid ends this many poles above the order of the best structure, and at this order at the least.
BEYOND, FEWEST_TRIED = 2, 4
#: It ends at this order at the least while each more pole pays even if the rest is taken as white noise: what the
#: closest fit misses of the response would pass as coloured noise.
TRIED_AGAINST_NOISE = 6
#: From then on a number of integrators whose best structure is so far behind is left out.
BEHIND = 30.0
#: All poles and zeros of the structures that settings of records are compared with.
SMALL = ((1, 0), (2, 1), (3, 2))
#: Samples for each parameter of a structure at least.
SAMPLES_PER_PARAMETER = 3


class Setting(NamedTuple):
    """How records are taken."""

    hold: Hold
    initial_state: InitialState
    input_before: InputBefore
    offset: Offset

    @property
    def state(self) -> tuple[InitialState, InputBefore]:
        """The state before the records."""
        return self.initial_state, self.input_before


class Span(NamedTuple):
    """Least and greatest number of poles (integrators not among them) and of zeros, and the numbers of integrators."""

    poles: tuple[int, int] = (0, MOST_POLES)
    zeros: tuple[int, int] = (0, MOST_POLES)
    integrators: tuple[int, ...] = (0, 1)
    #: Least and greatest number of second-order submodels, where models are sums of these.
    modes: tuple[int, int] | None = None

    @classmethod
    def only(cls, options: Searched) -> "Span":
        """Return the span of the transfer functions of one structure."""
        poles, zeros = options.order - options.integrators, options.zeros
        return cls((poles, poles), (zeros, zeros), (options.integrators,))

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
        """Return the structures that settings of records are compared with: small ones, or else the smallest."""
        orders = range(1, MOST_POLES + max(self.integrators) + 1)
        found = [(n, each) for n in orders for each in self.structures(n, integrators, delay_free)]
        small = [each for n, each in found if (n, each[1]) in SMALL[:most]]
        return small or [each for _, each in found[:1]]


def with_hold(record: Record, hold: Hold) -> Record:
    """Return a record with another hold of its input."""
    signal = record.input
    return record if signal.hold == hold else replace(record, input=HeldSignal(signal.t, signal.values, hold))


@dataclass(frozen=True, eq=False)
class Structures:
    """Structures with one number of integrators, in one setting of the records."""

    records: Sequence[Record]
    hold: Hold
    options: DelayProfile
    measured: MeasuredRecords
    search: StructureSearch
    #: Models of another setting, from which all searches start.
    near: Callable[[int, int], TransferFunction | None] | None = None
    found: dict[tuple[int, int], Candidate] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        records: Sequence[Record],
        setting: Setting,
        integrators: int,
        delays: tuple[float, float],
        near: Callable[[int, int], TransferFunction | None] | None = None,
    ) -> "Structures":
        """Lay records out."""
        hold, state, before, offset = setting
        least = int(not integrators)
        options = DelayProfile(
            *(least, 0, delays), initial_state=state, offset=offset, integrators=integrators, input_before=before
        )
        held = [with_hold(record, hold) for record in records]
        measured = options.prepare(held).laid_out
        # One box for all: a wider one for those at rest would favour them.
        box = box_of(measured.problem._replace(free_response=state != "periodic"), delays)
        return cls(held, hold, options, measured, StructureSearch(measured.problem, box, effort=QUICK), near)

    def tried(self, order: int, span: Span) -> list[Candidate | None]:
        """Fit all structures of an order, integrators included."""
        structures = span.structures(order, self.options.integrators, self.search.box.delay_free)
        return [self.fit(*structure) for structure in structures]

    def fit(self, poles: int, zeros: int) -> Candidate | None:
        """Fit a structure; None where there are too few samples."""
        if (poles, zeros) not in self.found:
            options, measured = replace(self.options, poles=poles, zeros=zeros), self.measured
            structure = Structure(options.order, zeros, delay=self.search.box.delay_free)
            own = measured.layout_of(options.order, structure.delay).own * len(self.records)
            size = structure.size - options.integrators + own
            if SAMPLES_PER_PARAMETER * size > sum(data.count for data in measured.data):
                return None
            found = fitted(measured.with_structure(structure), self._least(poles, zeros), None, None)
            self.found[poles, zeros] = Candidate(options, self.hold, found, size)
        return self.found[poles, zeros]

    def model(self, poles: int, zeros: int) -> TransferFunction | None:
        """Return a model that has been fitted; None where there were too few samples."""
        found = self.found.get((poles, zeros))
        return None if found is None else found.fit.model

    def _least(self, poles: int, zeros: int) -> Optimum:
        start = None if self.near is None else self.near(poles, zeros)
        if start is None:
            return best_of_orders(self.search, poles, zeros)
        alone = start.denominator[: start.denominator.size - self.options.integrators]
        return best_near(self.search, zeros, alone, start.delay)


@dataclass(frozen=True, eq=False)
class Sums:
    """Sums of second-order submodels with integrators in the first of them, in one setting of the records."""

    records: Sequence[Record]
    hold: Hold
    #: Of one submodel.
    options: AdditiveOutputError

    @classmethod
    def of(cls, records: Sequence[Record], setting: Setting, integrators: int, delays: tuple[float, float]) -> "Sums":
        """Lay records out."""
        hold, state, before, offset = setting
        options = AdditiveOutputError(_modes(1, integrators), delays, state, offset, input_before=before)
        return cls([with_hold(record, hold) for record in records], hold, options)

    def tried(self, order: int, span: Span) -> list[Candidate | None]:
        """Fit the sum of an order, integrators included; None where there are too few samples."""
        assert span.modes is not None
        number, odd = divmod(order - self.options.integrators, 2)
        return [self._fit(number)] if not odd and span.modes[0] <= number <= span.modes[1] else []

    def _fit(self, number: int) -> Candidate | None:
        options = replace(self.options, terms=_modes(number, self.options.integrators))
        measured = options.prepare(self.records).laid_out
        size = measured.layout_of(options.order, measured.structure.delay).size
        if SAMPLES_PER_PARAMETER * size > sum(data.count for data in measured.data):
            return None
        fit = options._of_submodels(measured, options._least(measured, []), GROWN)
        return Candidate(options, self.hold, fit, size)


def _modes(number: int, integrators: int) -> tuple[Term, ...]:
    return Term(2, 0, integrators), *(Term(2, 0) for _ in range(number - 1))


class SmallModels:
    """A few structures in several settings of the same records."""

    def __init__(
        self,
        records: Sequence[Record],
        span: Span,
        delays: tuple[float, float],
        most: int = len(SMALL),
        near: TransferFunction | None = None,
    ) -> None:
        self.records, self.span, self.delays, self.most, self.near = records, span, delays, most, near
        self._structures: dict[tuple[Setting, int], Structures] = {}

    def compared(self, settings: Sequence[Setting]) -> Ranking:
        """Rank the structures in some settings, which all use the same samples."""
        found = [each for setting in settings for each in self._fitted(setting)]
        if not found:
            raise DataError(f"{named(self.records[0])}too few usable samples for a model's parameters")
        return ranked(found)

    def _fitted(self, setting: Setting) -> Iterator[Candidate]:
        for integrators in self.span.integrators:
            structures = self._laid_out(setting, integrators)
            for each in self.span.small(integrators, structures.search.box.delay_free, self.most):
                candidate = structures.fit(*each)
                if candidate is not None:
                    yield candidate

    def _laid_out(self, setting: Setting, integrators: int) -> Structures:
        """Lay records out; another hold or offset has its minima near those that are known."""
        key = setting, integrators
        if key not in self._structures:
            pairs = ((one, number) for one, number in self._structures if one.state == setting.state)
            alike = next((self._structures[pair] for pair in pairs if pair[1] == integrators), None)
            model = self.near
            near = (lambda *_: model) if model is not None else None if alike is None else alike.model
            self._structures[key] = Structures.of(self.records, *key, self.delays, near)
        return self._structures[key]


def grid(records: Sequence[Record], setting: Setting, span: Span, delays: tuple[float, float]) -> Ranking:
    """Fit structures of ever more poles, until the best lies inside or there are no more."""
    kind = Structures if span.modes is None else Sums
    families = [kind.of(records, setting, integrators, delays) for integrators in span.integrators]
    found: list[Candidate] = []
    for order in range(1, min(span.most_poles, MOST_POLES) + 1):
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
    """Whether structures of about the greatest order are the best of those that leave white noise."""
    best = min((each for each in ranking.candidates if each.is_admissible), key=_criterion_in_white_noise, default=None)
    return best is not None and order - best.options.order < BEYOND


def _criterion_in_white_noise(candidate: Candidate) -> float:
    fit = candidate.fit
    return penalised(fit.cost * fit.count, fit.count, candidate.size)


def _promising(family: Structures | Sums, ranking: Ranking) -> bool:
    """Whether structures with a number of integrators may still become the best."""
    own = ranking.of(integrators=family.options.integrators)
    return own is None or own.best.criterion - ranking.best.criterion < BEHIND
