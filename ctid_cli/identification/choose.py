"""Choice of delay range, treatment, hold and structure, in this order, by one criterion.

Range, treatment and hold are chosen with a few small structures; then the grid of structures is fitted once. To compare
an estimated state with rest, all candidates are fitted to the samples after the greatest delay: with an unknown input
before the record, an estimated state describes only these.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, get_args

import numpy as np

from ctid_cli.estimation.common import check_greatest_delay
from ctid_cli.estimators.delay_profile import DelayProfile, InputModel
from ctid_cli.estimators.identification import answer_of
from ctid_cli.estimators.measured_fit import MultiInputFit
from ctid_cli.identification import sentences
from ctid_cli.identification.candidates import (
    SMALL,
    Known,
    Setting,
    Several,
    SmallModels,
    Span,
    grid,
    zero_on_integrator,
)
from ctid_cli.identification.choice import Choice, Given
from ctid_cli.identification.criterion import (
    WORTH_A_DRIFT,
    Ranking,
    Searched,
    gains_of_treatments,
    holds_not_rejected,
    ranked,
    without_needless_drift,
)
from ctid_cli.identification.held_back import without_overfitted
from ctid_cli.identification.initial_states import (
    State,
    beginning_is_likely,
    begins_quietly,
    changes_at_the_beginning_only,
    distinguishable_delays,
    excited_after,
    greatest_delay,
    is_slow,
    parts_of,
    states_of,
    with_offsets,
    without_beginning,
)
from ctid_cli.identification.remedies import harmful_outliers, without_samples
from ctid_cli.inference.signal_features import input_moves
from ctid_cli.models.several_inputs import delays_of
from ctid_cli.processors import one_thread
from ctid_cli.progress import reported
from ctid_cli.signals.held import Hold
from ctid_cli.signals.record import Record, as_records, with_hold
from ctid_cli.signals.treatment import Holds

#: The range of the delay ends at this multiple of the delay of a small model, plus this number of sampling intervals:
#: with too few poles the delay is overestimated.
REACH, FURTHER = 1.5, 3
#: A delay beyond this share of the range counts as at its end.
AT_END = 0.9
#: The grid is fitted again for a range narrower than this share.
MUCH_NARROWER = 0.5
#: Decrease of the criterion from which a response begins after one interval of a repeating input.
EVIDENT = 10.0
#: Longest range of delays after which a response may begin, as a share of the record.
HALF = 0.5
#: Smaller differences of criteria are rounding: for integrators alone a state is equivalent to an offset.
TIE = 1e-3


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
    if given.delays_given is not None:
        for record in several:
            check_greatest_delay(record, given.delays_given[1])
    choice = _Choosing(several, given, time_unit).choice()
    best = choice.ranking.best
    if given.loss is not None or given.noise_model != "white" or isinstance(best.fit, MultiInputFit):
        return choice
    outliers = harmful_outliers(choice.fitted, best.options, best.fit)
    if outliers is None:
        return choice
    # All else is chosen again, without the outliers.
    clean = list(without_samples(several, outliers))
    chosen = _Choosing(clean, replace(given, loss="tukey"), time_unit).choice()
    held = tuple(with_hold(record, chosen.records[0].hold) for record in choice.records)
    left_out = sentences.of_outliers(sum(map(len, outliers)))
    return replace(chosen, records=held, sentences=(left_out, *chosen.sentences))


class _Choosing:
    """The steps of a choice."""

    def __init__(self, records: list[Record], given: Given, time_unit: str) -> None:
        self.records, self.given, self.time_unit = records, given, time_unit
        drifts = len(given.span.integrators) > 1 and given.offset != "none" and changes_at_the_beginning_only(records)
        self.span = given.span._replace(integrators=(0,)) if drifts else given.span
        self.first_reasons = [sentences.NO_INTEGRATOR] if drifts else []
        # A periodic state is that of the whole record.
        self.part, self.from_start = (records, True) if given.initial_state == "periodic" else parts_of(records)
        self.quiet = self.from_start and begins_quietly(self.part)
        self.several = Several(self._ranges_of_inputs(), not isinstance(given.zeros, int))
        self.first_hold: Holds = "zoh" if given.hold == "auto" else given.hold
        self.reasons: list[str] = []
        #: Whether the input repeats: its range of delays is kept whole.
        self.repeats = False
        #: Static gains of treatments that the criterion does not reject, if their signs differ, by name.
        self.gains: dict[str, tuple[float, ...]] = {}
        #: Holds of the input that the criterion does not reject beside the best.
        self.holds: tuple[Holds, ...] = ()
        #: Small models of several inputs, near which the settings are compared.
        self.known: Known | None = None

    def _ranges_of_inputs(self) -> tuple[InputModel, ...] | None:
        """Return the given ranges of the delays of single inputs, and those that repeating inputs can tell apart."""
        given, first = self.given, self.part[0]
        ranges = {one.name: one for one in given.delays_of_inputs or ()}
        for name in first.held if first.several and given.delay_bounds is None else ():
            interval = distinguishable_delays([record.of_input(name) for record in self.part], given)
            if name not in ranges and np.isfinite(interval):
                ranges[name] = InputModel(name, delay_bounds=(0.0, _rounded(interval)))
        return tuple(ranges.values()) or None

    def choice(self) -> Choice:
        """Return the choice."""
        delays, latest = self._delays()
        setting = self._setting(self.span, delays)
        if self.given.typed:
            return self._typed(setting, delays)
        ranking = self._grid(setting, delays)
        # A state, or a far too long delay, may make up for the dynamics that small models miss.
        span, narrower = self.span.only(ranking.best.options), self._range_of(ranking, delays)
        narrower = narrower if narrower[1] < MUCH_NARROWER * delays[1] else delays
        confirmed = self._setting(span, narrower, lambda *_: ranking.best.fit.model)
        if (narrower, confirmed) != (delays, setting):
            delays, setting = narrower, confirmed
            ranking = self._grid(setting, delays)
        ranking = without_overfitted(ranking, self._held(setting))
        while delays[1] < latest and max(delays_of(ranking.best.fit.model)) > AT_END * delays[1]:
            delays = 0.0, _rounded(min(2.0 * delays[1], latest))
            ranking = without_overfitted(self._grid(setting, delays), self._held(setting))
        setting, ranking = self._with_drift_for_integrator(setting, ranking, delays)
        about = sentences.of_grid(ranking, delays, self.given, self.time_unit)
        return self._chosen(ranking.best.options, setting, ranking, about)

    def _with_drift_for_integrator(
        self, setting: Setting, ranking: Ranking, delays: tuple[float, float]
    ) -> tuple[Setting, Ranking]:
        """Return models with a drift instead of an integrator that a zero nearly cancels, if they are better."""
        options, model = ranking.best.options, ranking.best.fit.model
        free = self.given.offset is None and self.given.integrators is None and setting.initial_state != "periodic"
        if not (free and isinstance(options, DelayProfile) and options.integrators and not self.part[0].several):
            return setting, ranking
        if zero_on_integrator(model, max(record.duration for record in self.part)) is None:
            return setting, ranking
        drifting = setting._replace(offset="drift")
        span = self.span._replace(integrators=(0,))
        others = without_overfitted(self._grid(drifting, delays, span), self._held(drifting))
        both = ranked([ranking.best, others.best])
        if both.best.fit is not others.best.fit:
            return setting, ranking
        self.reasons = [text for text in self.reasons if not text.startswith("Offset")]
        self.reasons.append(sentences.of_drift(both))
        return drifting, others

    def _typed(self, setting: Setting, delays: tuple[float, float]) -> Choice:
        """Return the choice if degrees of single inputs are given."""
        ranking = self.models.compared([setting])
        delays = self._range_of(ranking, delays)
        given, treated = self.given, ranking.best.options
        degrees = {"poles": given.poles, "zeros": given.zeros or 0, "integrators": given.integrators or 0}
        own: Any = {**degrees, "delay_bounds": delays, "inputs": given.inputs}
        options = replace(treated, **own)
        about = sentences.of_range(delays, given, self.time_unit)
        return self._chosen(options, setting, ranking, about)

    def _chosen(self, options: Searched, setting: Setting, ranking: Ranking, about: Sequence[str]) -> Choice:
        """Return a choice with its sentences."""
        best = ranking.best
        options = replace(options, loss=self.given.loss or "squares", noise_model=self.given.noise_model)
        if isinstance(options, DelayProfile):
            options = replace(options, fixed=self.given.fixed, bounds=self.given.bounds)
        if not self.from_start:
            options = replace(options, initial_state="estimate", input_before=None)
        fitted = tuple(self._held(setting))
        measured = best.options.prepare(fitted).laid_out
        answer = answer_of(best.options, measured.records, measured.used())
        reasons = [*self.first_reasons, *self.reasons, *about]
        reasons += [sentences.of_criterion(ranking)] * bool(reasons)
        held = tuple(with_hold(record, setting.hold) for record in self.records)
        return Choice(options, held, fitted, ranking, answer, tuple(reasons), self.gains, self.holds)

    def _grid(self, setting: Setting, delays: tuple[float, float], span: Span | None = None) -> Ranking:
        if not self.from_start:
            setting = setting._replace(initial_state="estimate", input_before=None)
        return grid(self._held(setting), setting, span or self.span, delays, self.several)

    def _held(self, setting: Setting) -> list[Record]:
        return [with_hold(record, setting.hold) for record in self.part]

    # --- the range of the delay ------------------------------------------------------------------------

    @reported("range of the delay")
    def _delays(self) -> tuple[tuple[float, float], float]:
        """Return the range of the delay, and how far it may be extended [s]."""
        given, several = self.given.delays_given, self.part[0].several
        latest = self._latest() if given is None else given[1]
        delays = given or (0.0, latest)
        if given is not None and not several:
            return delays, latest
        farthest = latest
        if given is None and not self.repeats:
            farthest = max(latest, _rounded(HALF * min(record.duration for record in self.part)))
        most = len(SMALL) if several else 2
        while True:
            # Assuming rest may bias the delay; an estimated state does not.
            settings = self._settings(latest)
            settings = settings[:1] if self.quiet else settings[-1:]
            models = SmallModels(self._common(settings, latest), self.span, delays, self.several, most=most)
            ranking = models.compared(settings)
            if latest >= farthest or max(delays_of(ranking.best.fit.model)) <= AT_END * latest:
                break
            latest = _rounded(min(2.0 * latest, farthest))
            delays = 0.0, latest
        self._note(ranking)
        self.known = models.model if several else None
        if self.repeats and self._begins_later(ranking, latest):
            delays = 0.0, 2.0 * latest
        return self._range_of(ranking, delays), farthest

    def _begins_later(self, ranking: Ranking, latest: float) -> bool:
        """Return whether a response from rest begins after one interval of a repeating input, by the first samples."""
        settings = self._settings(latest)
        rests = [each for each in settings if each.initial_state == "rest"]
        if not rests or 2.0 * latest > HALF * min(record.duration for record in self.part):
            return False
        part = self._common(settings, latest)
        found = SmallModels(part, self.span, (0.0, 2.0 * latest), self.several, most=2).compared(rests)
        best = ranked([*ranking.candidates, *found.candidates]).best
        if max(delays_of(best.fit.model)) <= latest:
            return False
        within = SmallModels(part, self.span, (0.0, latest), self.several, most=2).compared(rests)
        first, second, *_ = ranked([*ranking.candidates, *within.candidates, best]).candidates
        return first.fit is best.fit and first.criterion < second.criterion - EVIDENT

    def _latest(self) -> float:
        """Return the greatest delay that is tried [s]: one whole interval that a repeating input can tell apart."""
        interval = np.inf if self.part[0].several else distinguishable_delays(self.part, self.given)
        self.repeats = bool(np.isfinite(interval))
        return _rounded(interval if self.repeats else greatest_delay(self.part))

    def _note(self, models: Ranking) -> None:
        """Keep the delays of the best small model, from which later searches of several inputs start."""
        if self.several.first_delays is None:
            self.several = self.several._replace(first_delays=tuple(delays_of(models.best.fit.model)))

    def _range_of(self, ranking: Ranking, delays: tuple[float, float]) -> tuple[float, float]:
        """Return the range around the delay of the best model, within another; a given or whole one unchanged."""
        if self.given.delays_given is not None or self.repeats:
            return delays
        interval = max(float(np.median(np.diff(record.t))) for record in self.part)
        reach = REACH * max(delays_of(ranking.best.fit.model)) + FURTHER * interval
        return 0.0, _rounded(min(max(reach, 2.0 * FURTHER * interval), delays[1]))

    # --- state, offset and hold ------------------------------------------------------------------------

    @reported("state, offset and hold")
    def _setting(self, span: Span, delays: tuple[float, float], near: Known | None = None) -> Setting:
        """Return the best state, offset and hold with structures of a span; searches start at known models."""
        self.reasons, near = [], near or self.known
        settings = self._settings(delays[1])
        rests = [each for each in settings if each.initial_state == "rest"]
        if len(rests) > 1:
            # All samples determine the level before the record, mainly the first ones.
            small = SmallModels(self.part, span, delays, self.several, near)
            level = small.compared(rests).best.options.input_before
            settings = [each for each in settings if each.initial_state != "rest" or each.input_before == level]
        models = SmallModels(self._common(settings, delays[1]), span, delays, self.several, near)
        if self.given.offset is None:
            settings = with_offsets(settings, self.part)
        ranking = self._with_needed_drift(models, models.compared(settings))
        self._note(ranking)
        self.models, best = models, self._treated(ranking, self._longest(delays[1]))
        setting = Setting(self.first_hold, best.initial_state, best.input_before, best.offset)
        self.gains = gains_of_treatments(ranking)
        holds = self._holds()
        if len(holds) > 1:
            compared = models.compared([setting._replace(hold=hold) for hold in holds])
            self.reasons.append(sentences.of_setting(compared, "hold"))
            setting = setting._replace(hold=compared.best.hold)
            self.holds = holds_not_rejected(compared)
        return setting

    def _with_needed_drift(self, models: SmallModels, ranking: Ranking) -> Ranking:
        """Return the candidates without a drift unless it is needed: also beside a pole and a zero more without it."""
        kept = without_needless_drift(ranking)
        options = kept.best.options
        if options.offset != "drift" or not isinstance(options, DelayProfile):
            return kept
        larger = models.larger(kept.best)
        others = [each for each in ranking.candidates if each.options.offset != "drift"]
        if larger is None or ranked([*kept.candidates, larger]).best.fit is not larger.fit:
            return kept
        return replace(ranking, candidates=tuple(others))

    def _treated(self, models: Ranking, length: float) -> Searched:
        """Return state and offset: rest, unless the criterion or the first samples reject it."""
        rest, estimated = (models.of(initial_state=state) for state in ("rest", "estimate"))
        chosen = models
        if rest is not None and estimated is not None:
            # From rest, a pole slower than the record is as flexible as a drift.
            lead = WORTH_A_DRIFT if is_slow(rest.best.fit.model, self.part) else -TIE
            at_rest = rest.best.criterion <= estimated.best.criterion - lead
            likely = not at_rest or beginning_is_likely(rest.best, models.noise, self.part, length)
            chosen = rest if at_rest and likely else estimated
            self.reasons.append(sentences.of_state(rest.best, estimated.best, likely))
        elif self.given.initial_state is None:
            options = models.best.options
            self.reasons.append(sentences.rest_assumed(options) if self.from_start else sentences.STATE_OF_PART)
        if self.given.offset is None:
            self.reasons.append(sentences.of_setting(chosen, "offset"))
        return chosen.best.options

    # --- settings to compare ---------------------------------------------------------------------------

    def _settings(self, latest: float) -> list[Setting]:
        """Return settings with the states that can be compared, with an offset."""
        states: list[State] = states_of(self.part, self.given) if self.from_start else [("estimate", None)]
        if self.quiet and ("rest", "first") in states:
            states = [("rest", "first")]
        if len(states) > 1 and not excited_after(self.part, latest):
            states = [state for state in states if state[0] != "estimate"]
        offset = self.given.offset or "estimate"
        return [Setting(self.first_hold, state, before, offset) for state, before in states]

    def _holds(self) -> list[Holds]:
        """Return the holds to compare; steps, and an input in a loop, count as held."""
        moves = {input_moves(each).kind for record in self.records for each in record.each_input}
        if self.given.hold != "auto" or moves != {"continuous"} or any(record.feedback for record in self.records):
            return [self.first_hold]
        if not all(np.array_equal(one.t, record.t) for record in self.records for one in record.held.values()):
            return [self.records[0].hold]
        regular = all(record.interval is not None for record in self.part)
        return [hold for hold in get_args(Hold) if regular or hold != "band-limited"]

    def _common(self, settings: Sequence[Setting], latest: float) -> list[Record]:
        """Return the records with the samples that all settings can use."""
        if all(setting.initial_state != "estimate" for setting in settings):
            return self.part
        return without_beginning(self.part, self._longest(latest))

    def _longest(self, latest: float) -> float:
        """Return the greatest delay of all inputs [s]."""
        return max([latest, *(one.delay_bounds[1] for one in self.several.inputs or () if one.delay_bounds)])


def _rounded(delay: float) -> float:
    """Return a delay rounded to the three digits of the printed options."""
    return float(f"{delay:.3g}")
