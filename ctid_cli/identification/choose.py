r"""Choice of what is not given: range of the delay, treatment of the records, hold, and structure.

1. *Range*. It ends at a tenth of the record, or where the response has begun if that is later, and doubles while small
   models end at it; then it is narrowed to the delay of a small model. An input that repeats is searched over one
   whole interval.
2. *Treatment*. States before the records, offsets and holds are compared on common samples with the given structure, or
   with small ones. A record that begins quietly begins at rest. The treatment is compared again with the chosen
   structure.
3. *Grid*. All structures of increasing order until the least criterion is two orders below. With one autoregressive
   model of the residuals of the closest fit, V the sum of squared innovations of a candidate at its generalised
   least-squares estimate, N their number and p its number of parameters, the criterion is

   .. math:: N \ln (V / N) + 1.5\,p \ln N .

   A noise model for each candidate would favour small models: the dynamics they miss would pass as noise.
4. *Held-back blocks*. The structure of least criterion and the best smaller one of each order predict blocks of the
   records from fits without their outputs. The smallest is taken whose errors are not larger by more than a standard
   error. With few changes of the input, blocks decide on the integrator only.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, get_args

import numpy as np

from ctid_cli import progress
from ctid_cli.arrays import Array
from ctid_cli.errors import DataError
from ctid_cli.estimation.common import check_greatest_delay
from ctid_cli.estimation.record_preparation import parts_of, period_of
from ctid_cli.estimators.additive_output_error import GROWN, AdditiveOutputError
from ctid_cli.estimators.delay_profile import DelayProfile, InputModel
from ctid_cli.estimators.identification import answer_of
from ctid_cli.estimators.measured_fit import MultiInputFit
from ctid_cli.estimators.structure_fits import SAMPLES_PER_PARAMETER, StructureFits
from ctid_cli.identification import sentences
from ctid_cli.identification.choice import Candidate, Choice, Given, Ranking, Searched
from ctid_cli.identification.criterion import few_changes, judged, own_criterion, ranked
from ctid_cli.inference.criteria import DECISIVE
from ctid_cli.inference.input_response import first_change, greatest_delay
from ctid_cli.inference.noise_model import NoiseModel
from ctid_cli.inference.repetition import range_of, repetitions_of, without_level
from ctid_cli.inference.residual_tests import chi_square_tail
from ctid_cli.inference.signal_features import FEW_CHANGES, begins_quietly, input_moves, residual_outliers
from ctid_cli.models.additive import Term
from ctid_cli.models.several_inputs import AnyModel, delays_of, fractions_of
from ctid_cli.processors import one_thread
from ctid_cli.progress import reported
from ctid_cli.signals.held import Hold
from ctid_cli.signals.record import Record, as_records, named, with_hold
from ctid_cli.signals.treatment import Holds, InitialState, InputBefore, Offset

#: The range of the delay ends at this multiple of the delay of a small model, plus this number of sampling intervals:
#: with too few poles the delay is overestimated. A delay beyond the last share of the range counts as at its end.
REACH, FURTHER, AT_END = 1.5, 3, 0.9
#: Longest range of delays, as a share of the record; with an input that repeats after a longer interval than the second
#: share, delays are searched as for other inputs, since an estimated state costs as many samples. A periodic state has
#: all samples.
HALF, SHARE, WHOLE = 0.5, 0.4, 0.999
#: The grid ends this many orders above the structure of least criterion, not before this order. Then a number of
#: integrators is dropped if its best structure is this far behind.
BEYOND, FEWEST_TRIED, BEHIND = 2, 4, 30.0
#: Smaller differences of the criterion are rounding: for integrators alone a state is equivalent to an offset.
TIE = 1e-3
#: Increase of the criterion up to which models with equal parameters are likely: 95 % of chi-square with one degree of
#: freedom.
LIKELY = 3.84
#: Rest is rejected if its first samples are less likely than this: an unneeded estimated state costs little.
UNLIKELY = 1e-2
#: Share of its range that the input must cross after the greatest delay, so that an estimated state leaves the gain
#: determined, and least number of samples from then on to the first of a few changes.
EXCITED, LEAD = 0.5, 10
#: Share of its deviation by which the output moves before a few changes if the record does not begin at rest.
MOVING = 0.2
#: Significance level at which outliers have moved an estimate.
MOVED = 0.05
#: A treatment is rejected if its mean squared output error is this many times the least one of those compared.
CONTRADICTED = 4.0
#: Options of the treatment of records.
TREATMENT = ("initial_state", "input_before", "offset")

#: State before the records, and the input before them.
State = tuple[InitialState, InputBefore]
#: Integrators, poles without them, and zeros.
Structure = tuple[int, int, int]


class Setting(NamedTuple):
    """Treatment of records."""

    hold: Holds
    initial_state: InitialState
    input_before: InputBefore
    offset: Offset


@one_thread
@reported("choosing the structure")
def choose(records: Record | Sequence[Record], given: Given | None = None, time_unit: str = "s") -> Choice:
    """Choose those parts of a model's structure and of the treatment of its records that are not given.

    Parameters
    ----------
    records : Record or sequence of Record
        One record for each experiment.
    given : Given, optional
        Given options; by default none.
    time_unit : str, default "s"
        Unit of the records' times, for the sentences.

    Returns
    -------
    Choice
        The options to fit, the candidates, and a sentence for each choice.

    Raises
    ------
    DataError
        If a record cannot be used.
    OptionError
        If given options contradict each other.
    """
    several = as_records(records)
    given = given or Given()
    given.check()
    if (known := given.delays_given(several[0])) is not None:
        for record in several:
            check_greatest_delay(record, known[1])
    choice = _Choosing(several, given, time_unit).choice()
    if given.loss is not None or given.noise_model != "white":
        return choice
    outliers = harmful_outliers(choice)
    if outliers is None:
        return choice
    # All else is chosen again, without the outliers.
    clean = without_samples(several, outliers)
    chosen = _Choosing(clean, replace(given, loss="tukey"), time_unit).choice()
    held = tuple(with_hold(record, chosen.records[0].hold) for record in several)
    left_out = sentences.of_outliers(sum(map(len, outliers)))
    return replace(chosen, records=held, sentences=(left_out, *chosen.sentences))


class _Choosing:
    """The steps of a choice."""

    def __init__(self, records: Sequence[Record], given: Given, time_unit: str) -> None:
        self.records, self.given, self.time_unit = records, given, time_unit
        # A periodic state is that of the whole record.
        self.part, self.from_start = (records, True) if given.initial_state == "periodic" else parts_of(records)
        self.quiet = self.from_start and all(map(begins_quietly, self.part))
        self.several = self.part[0].several
        span = given.span
        late = [signal.at(record.t[LEAD:]) for record in records for signal in record.held.values()]
        self.ramps = (
            len(span.integrators) > 1 and given.offset != "none" and all(u.size and not np.ptp(u) for u in late)
        )
        self.span = span._replace(integrators=(0,)) if self.ramps else span
        self.inputs = self._ranges_of_inputs()
        #: Holds to compare, the first one with all treatments.
        self.tried_holds = self._holds()
        #: Whether the input repeats: its range of delays is kept whole.
        self.repeats = False
        #: Delays of several inputs in the best small model, from which searches start [s], and fits of small models.
        self.first_delays: tuple[float, ...] | None = None
        self.near: dict[int, StructureFits] = {}
        self.structures: list[Structure] = []
        self.gains: dict[str, tuple[float, ...]] = {}
        self.holds: tuple[Holds, ...] = ()
        self.reasons: list[str] = []

    def choice(self) -> Choice:
        """Return the choice."""
        delays = self._range()
        setting = self._setting(delays, self.structures or self._small(delays))
        ranking, taken = self._structure(setting, delays)
        tried = [setting]
        while not (self.given.single or self.given.modes):
            kept = self.reasons, self.gains, self.holds
            confirmed = self._setting(delays, [structure_of(taken)], taken)
            if confirmed == setting:
                break
            if confirmed in tried:
                reasons, self.gains, self.holds = kept
                self.reasons = [*reasons, sentences.of_contradiction(*confirmed)]
                break
            # A state may make up for the dynamics that small models miss.
            setting, (ranking, taken) = confirmed, self._structure(confirmed, delays)
            tried.append(setting)
        about = sentences.of_grid(ranking, taken, few_changes(self.part), delays, self.given, self.time_unit)
        given, options = self.given, replace(taken.options, loss=self.given.loss or "squares")
        options = replace(options, noise_model=given.noise_model)
        if not self.from_start:
            options = replace(options, initial_state="estimate", input_before=None)
        measured = taken.options.prepare(self._held(setting)).laid_out
        reasons = [*[sentences.NO_INTEGRATOR] * self.ramps, *self.reasons, *about]
        reasons += [sentences.of_criterion(ranking)] * bool(reasons)
        return Choice(
            options=options,
            records=tuple(with_hold(record, setting.hold) for record in self.records),
            fitted=tuple(self._held(setting)),
            ranking=ranking,
            taken=taken,
            answer=answer_of(taken.options, measured.records, measured.used()),
            sentences=tuple(reasons),
            gains=self.gains,
            holds=self.holds,
        )

    # --- candidates ------------------------------------------------------------------------------------

    def _small(self, delays: tuple[float, float], most: int = 3) -> list[Structure]:
        """Return the structures with which settings are compared: the given one, or small ones."""
        if self.given.typed:
            poles, zeros = (
                each[0] if isinstance(each, tuple) else each for each in (self.given.poles, self.given.zeros)
            )
            return [(self.given.integrators or 0, 1 if poles is None else poles, zeros or 0)]
        free = delays[0] < delays[1]
        return [(k, *each) for k in self.span.integrators for each in self.span.small(k, free, most)]

    def _fits(
        self,
        records: Sequence[Record],
        setting: Setting,
        delays: tuple[float, float],
        integrators: int,
        near: Callable[[int, int], AnyModel | None] | None = None,
    ) -> StructureFits:
        """Prepare the fits of structures in a setting."""
        hold, state, before, offset = setting
        # The offset of an integrator's input is a drift of its output.
        offset = "estimate" if integrators and offset == "drift" else offset
        given, degrees = self.given, (int(not integrators), 0)
        treated = DelayProfile(
            *(*degrees, delays),
            initial_state=state,
            offset=offset,
            integrators=integrators,
            input_before=before,
            inputs=None if given.typed else self.inputs,
        )
        alone: dict[str, Any] = {"inputs": given.inputs} if given.typed else {}
        alone |= {"fixed": given.fixed} if given.fixed else {}
        alone |= {"bounds": given.bounds} if given.bounds else {}
        fewer = self.several and not isinstance(given.zeros, int) and near is None
        held = [with_hold(record, hold) for record in records]
        return StructureFits(held, treated, alone, self.first_delays, fewer_zeros=fewer, near=near)

    def _compared(
        self,
        records: Sequence[Record],
        settings: Sequence[Setting],
        structures: Sequence[Structure],
        delays: tuple[float, float],
        start: Candidate | None = None,
    ) -> Ranking:
        """Fit structures in several settings of the same records; another hold or offset starts at found models."""
        fits: dict[tuple[Setting, int], StructureFits] = {}
        found = list[Candidate]()
        for setting in settings:
            progress.report("setting", len({each for each, _ in fits}) + 1, len(settings))
            for integrators, poles, zeros in structures:
                key = setting, integrators
                if key not in fits:
                    alike = (own for (one, k), own in fits.items() if one[1:3] == setting[1:3] and k == integrators)
                    known = next(alike, self.near.get(integrators))
                    near = None if known is None else known.model
                    near = near if start is None else lambda *_: start.fit.model
                    fits[key] = self._fits(records, *key[:1], delays, integrators, near)
                found += _candidates(fits[key], setting, [(poles, zeros)])
        self.near |= {k: own for (_, k), own in fits.items()} if self.several and not self.near else {}
        return ranked(self._not_empty(found), records, _treatment_of)

    def _not_empty(self, found: Sequence[Candidate]) -> Sequence[Candidate]:
        if not found:
            what = "too few usable samples for a model's parameters; take a longer record"
            raise DataError(f"{named(self.part[0])}{what}")
        return found

    def _held(self, setting: Setting) -> list[Record]:
        return [with_hold(record, setting.hold) for record in self.part]

    # --- the range of the delay ------------------------------------------------------------------------

    @reported("range of the delay")
    def _range(self) -> tuple[float, float]:
        """Return the range of the delay [s]."""
        given = self.given.delays_given(self.part[0])
        if given is not None and not self.several:
            return given
        interval = np.inf if self.several else self._interval_of(self.part)
        self.repeats = bool(np.isfinite(interval))
        shortest = min(record.duration for record in self.part)
        step = max(float(np.median(np.diff(record.t))) for record in self.part)
        latest = rounded(interval if self.repeats else self._latest(step)) if given is None else given[1]
        farthest = latest if self.repeats or given is not None else max(latest, rounded(HALF * shortest))
        delays = given or (0.0, latest)
        while True:
            # Assuming rest may bias the delay; an estimated state does not.
            settings = self._settings(delays[1])
            settings = settings[:1] if self.quiet else settings[-1:]
            structures = self._small(delays, 2)
            ranking = self._compared(self._common(settings, delays[1]), settings, structures, delays)
            delay = max(delays_of(ranking.best.fit.model))
            if delays[1] >= farthest or delay <= AT_END * delays[1]:
                break
            delays = 0.0, rounded(min(2.0 * delays[1], farthest))
        if self.several:
            # Searches take long: the best structures found are enough for the treatment.
            self.first_delays = tuple(delays_of(ranking.best.fit.model))
            each = [ranking.of(integrators=k) for k in self.span.integrators]
            self.structures = [structure_of(one.best) for one in each if one is not None]
        if given is not None:
            return given
        if self.repeats:
            return (0.0, 2.0 * latest) if self._begins_later(latest, ranking) else delays
        return 0.0, rounded(min(max(REACH * delay + FURTHER * step, 2.0 * FURTHER * step), delays[1]))

    def _latest(self, step: float) -> float:
        """Return the greatest delay that is tried [s]; an initial state before a few steps needs half of the lead."""
        latest, first = greatest_delay(self.part), min(first_change(each) - each.t[0] for each in self.part)
        few = all(input_moves(each).kind == "steps" for record in self.part for each in record.each_input)
        moving = few and not all(begins_quietly(record, MOVING) for record in self.part)
        lead = min(HALF * float(first), float(first) - (LEAD + 1) * step)
        return min(latest, lead) if moving and lead >= FURTHER * step else latest

    def _interval_of(self, records: Sequence[Record]) -> float:
        """Return the length of the range of delays that the input can tell apart [s]; infinite without repetition."""
        given, periodic = self.given, self.given.initial_state == "periodic"
        if isinstance(given.input_before, float | int):
            return float("inf")
        each, shortest = [], min(record.duration for record in records)
        for record in records:
            found = repetitions_of(record.input, record.t, period_of(record) if periodic else None)
            each.append(range_of(without_level(found, record.input) if given.offset == "none" else found))
        longest = max(each)
        return float("inf") if longest > SHARE * shortest and not periodic else min(longest, WHOLE * shortest)

    def _ranges_of_inputs(self) -> tuple[InputModel, ...] | None:
        """Return the given ranges of the delays of single inputs, and those that repeating inputs can tell apart."""
        ranges = {one.name: one for one in self.given.delays_of_inputs or ()}
        for name in self.part[0].held if self.several and self.given.delay_bounds is None else ():
            interval = self._interval_of([record.of_input(name) for record in self.part])
            if name not in ranges and np.isfinite(interval):
                ranges[name] = InputModel(name, delay_bounds=(0.0, rounded(interval)))
        return tuple(ranges.values()) or None

    def _begins_later(self, latest: float, estimated: Ranking) -> bool:
        """Return whether a response from rest begins after one interval of a repeating input, by the first samples."""
        settings = self._settings(latest)
        rests = [each for each in settings if each.initial_state == "rest"]
        if not rests or 2.0 * latest > HALF * min(record.duration for record in self.part):
            return False
        part = self._common(settings, latest)
        farther, within = (
            self._compared(part, rests, self._small((0.0, most), 2), (0.0, most)).candidates
            for most in (2.0 * latest, latest)
        )
        best, *others = ranked([farther[0], *within, *estimated.candidates], part, lambda each: id(each.fit)).candidates
        later = max(delays_of(best.fit.model)) > latest
        return later and bool(others) and best.criterion < others[0].criterion - DECISIVE

    # --- state, offset and hold ------------------------------------------------------------------------

    @reported("state, offset and hold")
    def _setting(
        self, delays: tuple[float, float], structures: Sequence[Structure], start: Candidate | None = None
    ) -> Setting:
        """Return the best state, offset and hold with some structures; searches start at a known model."""
        self.reasons = []
        settings = self._settings(delays[1])
        rests = [each for each in settings if each.initial_state == "rest"]
        if len(rests) > 1:
            # All samples determine the level before the record, mainly the first ones.
            levels = without_contradicted(self._compared(self.part, rests, structures, delays, start))
            level = levels.best.options.input_before
            settings = [each for each in settings if each.initial_state != "rest" or each.input_before == level]
        common = self._common(settings, delays[1])
        if self.given.offset is None:
            # An output that is constant at first has no drift.
            settings = [each for each in with_offsets(settings, self.part) if not self.quiet or each.offset != "drift"]
        ranking = without_contradicted(self._compared(common, settings, structures, delays, start))
        kept = without_needless_drift(ranking, few_changes(common))
        self.gains = gains_of_treatments(kept)
        best = self._treated(kept, delays[1])
        setting = Setting(self.tried_holds[0], best.initial_state, best.input_before, best.offset)
        if len(self.tried_holds) > 1:
            first = kept.of(initial_state=best.initial_state, input_before=best.input_before, offset=best.offset)
            start = (first or kept).best
            tried = [setting._replace(hold=hold) for hold in self.tried_holds]
            compared = self._compared(common, tried, [structure_of(start)], delays, start)
            self.reasons.append(sentences.of_setting(compared, "hold"))
            setting = setting._replace(hold=compared.best.hold)
            limit = compared.best.criterion + LIKELY
            likely = {each.hold: None for each in compared.candidates if each.criterion <= limit}
            self.holds = tuple(hold for hold in likely if hold != setting.hold)
        return setting

    def _treated(self, models: Ranking, latest: float) -> Searched:
        """Return state and offset: rest, unless the criterion or the first samples reject it."""
        rest, estimated = (models.of(initial_state=state) for state in ("rest", "estimate"))
        chosen = models
        if rest is not None and estimated is not None:
            # From rest, a pole slower than the record is as flexible as a drift.
            lead = DECISIVE if is_slow(rest.best.fit.model, self.part) else -TIE
            at_rest = rest.best.criterion <= estimated.best.criterion - lead
            likely = not at_rest or beginning_is_likely(rest.best, models.noise, self.part, self._longest(latest))
            chosen = rest if at_rest and likely else estimated
            pair = rest.best, estimated.best
            self.reasons.append(sentences.of_state(*(pair if chosen is rest else pair[::-1]), likely))
        elif self.given.initial_state is None:
            assumed = sentences.of_assumed(models.best.options, self.given, self.quiet)
            self.reasons.append(assumed if self.from_start else sentences.STATE_OF_PART)
        if self.given.offset is None:
            self.reasons.append(sentences.of_setting(chosen, "offset"))
        return chosen.best.options

    def _settings(self, latest: float) -> list[Setting]:
        """Return settings with the states that can be compared, with an offset."""
        states: list[State] = states_of(self.part, self.given) if self.from_start else [("estimate", None)]
        if self.quiet and ("rest", "first") in states:
            states = [("rest", "first")]
        if len(states) > 1 and not excited_after(self.part, latest):
            states = [state for state in states if state[0] != "estimate"]
        offset = self.given.offset or "estimate"
        return [Setting(self.tried_holds[0], state, before, offset) for state, before in states]

    def _holds(self) -> list[Holds]:
        """Return the holds to compare; steps, and an input in a loop, count as held."""
        if self.given.hold != "auto":
            return [self.given.hold]
        moves = {input_moves(each).kind for record in self.records for each in record.each_input}
        if moves != {"continuous"} or any(record.feedback for record in self.records):
            return ["zoh"]
        if not all(np.array_equal(one.t, record.t) for record in self.records for one in record.held.values()):
            return [self.records[0].hold]
        regular = all(record.interval is not None for record in self.part)
        return [hold for hold in get_args(Hold) if regular or hold != "band-limited"]

    def _common(self, settings: Sequence[Setting], latest: float) -> Sequence[Record]:
        """Return the records with the samples that all settings can use."""
        if all(setting.initial_state != "estimate" for setting in settings):
            return self.part
        first = self._longest(latest) * (1 - 1e-9)
        return [
            replace(each, y=np.where(each.t < each.t[0] + first, np.nan, each.y), noise_free=None) for each in self.part
        ]

    def _longest(self, latest: float) -> float:
        """Return the greatest delay of all inputs [s]."""
        return max([latest, *(one.delay_bounds[1] for one in self.inputs or () if one.delay_bounds)])

    # --- structure -------------------------------------------------------------------------------------

    def _structure(self, setting: Setting, delays: tuple[float, float]) -> tuple[Ranking, Candidate]:
        """Return all structures by increasing criterion, and the one that is taken."""
        if not self.from_start:
            setting = setting._replace(initial_state="estimate", input_before=None)
        records = self._held(setting)
        ranking = ranked(self._not_empty(self._grid(setting, delays)), records, lambda one: one.structure)
        return judged(ranking, records)

    def _grid(self, setting: Setting, delays: tuple[float, float]) -> list[Candidate]:
        """Fit structures of increasing order, until the least criterion is far below or none is left."""
        given, records, found = self.given, self._held(setting), list[Candidate]()
        if given.modes is not None:
            return list(_sums(records, setting, delays, given.modes, given.integrators or 0))
        families = {k: self._fits(self.part, setting, delays, k) for k in self.span.integrators}
        if given.single:
            return [one for k, *own in self._small(delays) for one in _candidates(families[k], setting, [own])]
        orders = self.span.orders(unasked=not isinstance(given.poles, int | tuple))
        for order in orders:
            progress.report("order", order, orders[-1])
            for k, family in families.items():
                structures = self.span.structures(order, k, family.search.box.delay_free)
                found += _candidates(family, setting, structures)
            if order >= FEWEST_TRIED and found:
                ranking = ranked(found, records)
                if order - ranking.best.options.order >= BEYOND:
                    break
                best = ranking.best.criterion
                ahead = {each.options.integrators for each in ranking.candidates if each.criterion < best + BEHIND}
                families = {k: family for k, family in families.items() if k in ahead}
        return found


def _candidates(fits: StructureFits, setting: Setting, structures: Iterable[Sequence[int]]) -> Iterator[Candidate]:
    """Yield the fits of structures, poles and zeros, that can be fitted."""
    for poles, zeros in structures:
        if (found := fits.fit(poles, zeros)) is not None:
            options, fit, size = found
            yield Candidate(options, setting.hold, fit, size)


def _sums(
    records: Sequence[Record], setting: Setting, delays: tuple[float, float], modes: tuple[int, int], integrators: int
) -> Iterator[Candidate]:
    """Yield sums of second-order submodels, the first one with integrators, while there are enough samples."""
    hold, state, before, offset = setting
    for number in range(modes[0], modes[1] + 1):
        progress.report("second-order submodels", number, modes[1])
        terms = Term(2, 0, integrators), *(Term(2, 0) for _ in range(number - 1))
        options = AdditiveOutputError(terms, delays, state, offset, input_before=before)
        measured = options.prepare(records).laid_out
        if SAMPLES_PER_PARAMETER * measured.layout.size > sum(data.count for data in measured.data):
            return
        fit = options._of_submodels(measured, options._least(measured), GROWN)
        yield Candidate(options, hold, fit, measured.layout.size)


def structure_of(candidate: Candidate) -> Structure:
    """Return integrators, poles and zeros of a candidate."""
    return candidate.options.integrators, candidate.options.poles, candidate.options.zeros


def _treatment_of(candidate: Candidate) -> tuple[object, ...]:
    return tuple(candidate.value(name) for name in (*TREATMENT, "hold"))


# --- treatments ----------------------------------------------------------------------------------------


def states_of(records: Sequence[Record], given: Given) -> list[State]:
    """Return the states before the records to compare.

    Rest is equilibrium with a constant input: the first value, or zero.
    """
    state, before = given.initial_state, given.input_before
    if state is not None and state != "rest":
        return [(state, None)]
    found: list[State] = [("rest", None), ("estimate", None)]
    if given.offset == "remove":
        return found if state is None else found[:1]
    signals = [signal for record in records for signal in record.held.values()]
    varies = all(np.ptp(signal.values) > 0.0 for signal in signals)
    levels: list[InputBefore] = ["first"] if before is None else [before]
    if before is None and varies and any(signal.values[0] for signal in signals):
        levels.append(None)
    return [("rest", level) for level in levels] + found[1:] * (state is None and before is None and varies)


def with_offsets(settings: Sequence[Setting], records: Sequence[Record]) -> list[Setting]:
    """Return settings with an estimated offset, and those with none or a drift that are compared with them.

    An estimated state without an offset fits a step response with a slow free response and a gain of either sign, and
    rest at a level other than zero has the offset of the response to it.
    """
    firsts = [float(signal.values[0]) for record in records for signal in record.held.values()]
    found = list(settings)
    for each in settings:
        at_zero = each.input_before in (None, 0.0) or (each.input_before == "first" and not any(firsts))
        found += [each._replace(offset="none")] * (each.initial_state != "estimate" and at_zero)
        found += [each._replace(offset="drift")] * (each.initial_state != "periodic")
    return found


def excited_after(records: Sequence[Record], delay: float) -> bool:
    """Return whether inputs change enough after a delay [s] to separate the gain from an estimated state.

    A state explains most of the response to a single step soon after the first sample.
    """
    for record in (each for whole in records for each in whole.each_input):
        later = record.t >= record.t[0] + delay
        u, whole = record.input.at(record.t[later]), record.input.at(record.t)
        if u.size < 2 or np.ptp(u) <= EXCITED * np.ptp(whole):
            return False
        changes = np.flatnonzero(np.diff(u))
        if changes.size <= FEW_CHANGES and changes[0] < LEAD:
            return False
    return True


def beginning_is_likely(best: Candidate, noise: NoiseModel, records: Sequence[Record], length: float) -> bool:
    """Return whether a model from rest, fitted to later samples, also explains the first samples of the records.

    Their squared innovations over the variance, and the first error over that of the noise, are chi-square.
    """
    held = [with_hold(record, best.hold) for record in records]
    errors = best.options.prepare(held).laid_out.errors_of(best.fit.model).residuals
    later = np.concatenate([noise.innovations(e)[noise.order :] for e in best.fit.residuals])
    deviation, power = float(later.std()), max(float(noise.first_autocovariances[0]), np.finfo(float).tiny)
    squared, count = 0.0, 0
    for record, e in zip(records, errors, strict=True):
        first = int(np.count_nonzero(record.valid & (record.t < record.t[0] + length * (1 - 1e-9))))
        new = noise.innovations(e)[max(noise.order, 1) : first] / deviation
        squared, count = squared + float(new @ new) + float(e[0] ** 2) / power, count + new.size + 1
    return chi_square_tail(count, squared) > UNLIKELY


def is_slow(model: AnyModel, records: Sequence[Record]) -> bool:
    """Return whether a model has a pole slower than the records, other than an integrator."""
    poles = np.abs(np.concatenate([each.poles for each in fractions_of(model)]))
    return bool(np.any(poles[poles > 0.0] * max(record.duration for record in records) < 1.0))


def without_contradicted(ranking: Ranking) -> Ranking:
    """Return the candidates of treatments whose output error is not far above the least one.

    The whitening of slow noise removes most of the error of a wrong level, which a fit of the output then has.
    """
    least: dict[tuple[object, ...], float] = {}
    for each in ranking.candidates:
        least[_treatment_of(each)] = min(each.fit.cost, least.get(_treatment_of(each), np.inf))
    most = CONTRADICTED * min(least.values())
    return replace(ranking, candidates=tuple(e for e in ranking.candidates if least[_treatment_of(e)] <= most))


def without_needless_drift(ranking: Ranking, few: bool) -> Ranking:
    """Return the candidates without a drift of the output, unless it lowers the criterion decisively.

    A needless drift may describe a part of the response: in one case it replaced an integrator, with 8.6 times the
    error. The estimated offset of an integrator is a drift too, and needs no lead. After a few changes of the input the
    criterion is that with own noise models, since a slow disturbance is no drift.
    """
    others = tuple(each for each in ranking.candidates if each.options.offset != "drift")
    drifting = next((each for each in ranking.candidates if each.options.offset == "drift"), None)
    if drifting is None or not others:
        return ranking
    constant = next((each for each in others if not each.options.integrators), None)
    if constant is not None and ranking.best.fit is drifting.fit:
        decisive = constant.criterion - drifting.criterion > DECISIVE
        if decisive and (not few or own_criterion(constant) - own_criterion(drifting) > DECISIVE):
            return ranking
    return replace(ranking, candidates=others)


def gains_of_treatments(ranking: Ranking) -> dict[str, tuple[float, ...]]:
    """Return the static gains of treatments that are not clearly worse than the best, if their signs differ."""
    best_of: dict[tuple[object, ...], Candidate] = {}
    for each in ranking.candidates:
        if each.criterion <= ranking.best.criterion + DECISIVE:
            best_of.setdefault(_treatment_of(each), each)
    found: dict[str, list[float]] = {}
    for each in best_of.values():
        names = list(each.fit.model.parts) if isinstance(each.fit, MultiInputFit) else [""]
        for name, model in zip(names, fractions_of(each.fit.model), strict=False):
            if np.isfinite(model.dc_gain):
                found.setdefault(f"{name}_static_gain" if name else "static_gain", []).append(float(model.dc_gain))
    return {name: tuple(gains) for name, gains in found.items() if min(gains) < 0.0 < max(gains)}


# --- outliers ------------------------------------------------------------------------------------------


@reported("outliers")
def harmful_outliers(choice: Choice) -> list[Array] | None:
    """Return the instants of outliers in each record if the estimate without them is significantly different."""
    taken, records = choice.taken, choice.fitted
    each = zip(records, taken.fit.used, taken.fit.residuals, strict=True)
    at = [record.t[use][residual_outliers(e)[0]] for record, use, e in each]
    if not any(map(len, at)) or isinstance(taken.options, AdditiveOutputError):
        return None
    laid_out = taken.options.prepare(without_samples(records, at)).laid_out
    moved = sum(float(e @ e) for e in laid_out.errors_of(taken.fit.model).residuals)
    count = sum(data.count for data in laid_out.problem.records)
    fall = count * float(np.log(moved / laid_out.local(laid_out.begin(taken.fit.model)).squared_error))
    return at if chi_square_tail(taken.size, fall) < MOVED else None


def without_samples(records: Sequence[Record], instants: Sequence[Array]) -> tuple[Record, ...]:
    """Return records whose output is missing at some instants."""
    each = zip(records, instants, strict=True)
    return tuple(replace(record, y=np.where(np.isin(record.t, at), np.nan, record.y)) for record, at in each)


def rounded(delay: float) -> float:
    """Return a delay rounded to the three digits of the printed options."""
    return float(f"{delay:.3g}")
