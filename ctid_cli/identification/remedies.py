"""Changes of a fit that are tried on its own records, and selection of those that help."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from operator import is_not
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from ctid_cli.arrays import Array, BoolArray
from ctid_cli.errors import CtidError
from ctid_cli.estimators.additive_output_error import AdditiveOutputError
from ctid_cli.estimators.delay_profile import DelayProfile
from ctid_cli.estimators.identification import Options
from ctid_cli.estimators.loop_output_error import LoopOutputError
from ctid_cli.estimators.measured_fit import MeasuredFit
from ctid_cli.estimators.measured_submodels import MeasuredSubmodels
from ctid_cli.identification.candidates import with_hold
from ctid_cli.identification.criterion import criteria_of
from ctid_cli.identification.held_back import Near, compared, held_back_errors, long_enough, near_model
from ctid_cli.inference.signal_features import input_moves, residual_outliers
from ctid_cli.models.additive import Term, terms_text
from ctid_cli.signals.held import Hold, regular_interval
from ctid_cli.signals.record import Record, beginning
from ctid_cli.signals.treatment import Holds, Offset

#: Most samples of all records on which changes are tried.
MOST_SAMPLES = 10_000
#: Least decrease of the criterion if it alone decides, very strong evidence by Kass and Raftery (1995).
DECISIVE = 10.0
#: In that case the squared error at the end of the records may grow by at most this factor.
NO_WORSE = 1.1
#: Most changes of one kind that are compared on held-back blocks, and most changes that are reported.
MOST_COMPARED, MOST_NAMED = 5, 3
#: Delays are tried up to this fraction of the shortest record, or this multiple of the greatest that was searched.
LATEST, FARTHER = 0.1, 2.0
#: Number of rates of an added pole, from 3 / duration to the sampling rate, and of starting delays.
RATES, DELAYS = 4, 12
#: Costs that differ by less than this fraction belong to the same model.
SAME = 1e-6
#: Damping of an added pole pair.
DAMPING = 0.3

#: Estimators of sums of submodels.
SUMS = MeasuredSubmodels | AdditiveOutputError
Kind = Literal["loss", "structure", "delay", "hold", "treatment"]


@dataclass(frozen=True)
class Remedy:
    """A change of a fit that helps on its own records."""

    kind: Kind
    #: Options of ``ctid fit`` that make the change.
    option: str
    #: The changed estimator, and the hold of the input.
    options: Options
    hold: Holds
    #: Fit of held-back blocks without and with the change, and standard error of the difference [%]; or the criterion
    #: [-], and NaN.
    before: float
    after: float
    standard_error: float
    held_back: bool
    #: Fit of all samples without and with the change [%].
    fits: tuple[float, float]
    #: Whether it is combined with the remedies before it.
    besides: bool = False

    @property
    def gain(self) -> float:
        """Increase of the fit by the change [%]."""
        return self.after - self.before if self.held_back else self.fits[1] - self.fits[0]

    def __str__(self) -> str:
        made = f"with {self.option}{' besides' * self.besides}"
        if self.held_back:
            return f"{made} the held-back fit is {self.after:.1f} instead of {self.before:.1f} %"
        numbers = f"BIC of the innovations is {self.after:.1f} instead of {self.before:.1f}, the fit"
        return f"{made} {numbers} {self.fits[1]:.1f} instead of {self.fits[0]:.1f} %"


@dataclass(frozen=True, eq=False)
class Trial:
    """A fit of an estimator to the records with a hold of their input."""

    kind: Kind
    options: Any
    hold: Holds
    records: tuple[Record, ...]
    fit: MeasuredFit

    @property
    def parameters(self) -> int:
        """Number of free parameters, including those at infinity."""
        return self.fit.theta.size - len(self.fit.known) + self.fit.poles_at_infinity

    @property
    def near(self) -> Near:
        """Denominator and delay of its model."""
        return near_model(self.fit.model, self.options.integrators)

    @property
    def starts(self) -> tuple[Near, ...]:
        """Starts of the search for a changed estimate."""
        return (self.near,) if isinstance(self.options, DelayProfile) else ()

    @property
    def rates(self) -> Array:
        """Rates of poles [rad/s] that the records can resolve."""
        longest = max(record.duration for record in self.records)
        shortest = min(float(np.median(np.diff(record.t))) for record in self.records)
        return np.geomspace(3.0 / longest, 1.0 / shortest, RATES)

    @cached_property
    def errors(self) -> list[Array]:
        """Output errors of held-back blocks."""
        return held_back_errors(self.options, self.records, self.near)


class Trials(NamedTuple):
    """Changes of a fit that were tried."""

    #: Changes that help, each combined with those before it.
    remedies: list[Remedy]
    #: Options of changes that do not.
    without_gain: list[str]


def tried_remedies(
    records: Sequence[Record],
    options: Options,
    fit: MeasuredFit,
    *,
    suspicious: bool = True,
    response: bool = True,
) -> Trials:
    """Try changes of a fit on its records, and return those that help, each combined with those before it.

    There are at most three, one of each kind: another loss if there are outliers, then the most helpful change.
    Structures, delays and holds are tried if the residuals or the search give a reason, and delays alone if no response
    to the input is detected. For submodels the criterion decides.

    A change helps if three conditions hold. It lowers Schwarz's criterion of the innovations, under one noise model
    (autoregressive, of the residuals of the closer fit) and 1.5 times the usual penalty. It improves the fit of ten
    blocks of the records, each predicted by a fit without its outputs, by more than twice the standard error of the
    difference. And it does not worsen the fit of the last two, which are held back together, so that a fit
    extrapolates. For another loss only the second counts. If blocks are too short, or the input moves in too few of
    them, the criterion decides, and must decrease by ten.
    """
    if isinstance(options, LoopOutputError):
        # Changes are compared by the response to the input, but here the reference drives the loop.
        return Trials([], [])
    submodels = isinstance(options, SUMS)
    # A record in a loop cannot be cut.
    most = np.inf if submodels else max(MOST_SAMPLES // len(records), 1)
    part = tuple(record if record.n_samples <= most else beginning(record, int(most)) for record in records)
    base = Trial("structure", options, records[0].hold, part, fit)
    found = Trials([], [])
    try:
        if isinstance(options, DelayProfile) and any(map(is_not, part, records)):
            base = replace(base, fit=options._refine(part, base.near))
        wild = [_outliers(base.fit, k) for k in range(len(part))]
        kinds: tuple[Kind, ...] = get_args(Kind)[1:] if suspicious else ("treatment",)
        if any(off.any() for off in wild):
            base = _best_step(base, wild, ("loss",), found)[0]
        kinds = kinds if response else ("delay",)
        while kinds and len(found.remedies) < MOST_NAMED:
            base, kinds = _best_step(base, wild, kinds, found)
    except CtidError:
        return found
    return found


def outliers_of(
    records: Sequence[Record], options: DelayProfile | AdditiveOutputError, fit: MeasuredFit
) -> list[BoolArray]:
    """Return the outliers of each record if another loss helps, else none."""
    wild = [_outliers(fit, k) for k in range(len(records))]
    found = Trials([], [])
    if any(off.any() for off in wild):
        with suppress(CtidError):
            _best_step(Trial("structure", options, records[0].hold, tuple(records), fit), wild, ("loss",), found)
    return [(off != 0.0) & bool(found.remedies) for off in wild]


def _best_step(
    base: Trial, wild: Sequence[Array], kinds: Sequence[Kind], found: Trials
) -> tuple[Trial, tuple[Kind, ...]]:
    """Add the most helpful change of some kinds; return its fit, and the other kinds that help on their own."""
    step = _Step(base, wild)
    helpful = step.helpful(kinds)
    if not found.remedies:
        found.without_gain.extend(step.without_gain)
    if not helpful:
        return base, ()
    remedy, trial = _simplest(helpful)
    found.remedies.append(replace(remedy, besides=bool(found.remedies)))
    return trial, tuple(other.kind for other, _ in helpful if other is not remedy)


# --- changes to try ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Change:
    """An estimator and a hold, with starts of the search."""

    options: Any
    hold: Holds
    starts: tuple[Near, ...]


def _changed(base: Trial, starts: Sequence[Near] = (), **fields: object) -> Iterator[Change]:
    """Yield a change of some options, unless the estimator refuses it."""
    try:
        options = replace(base.options, **fields)
    except ValueError:
        return
    if options != base.options:
        yield Change(options, base.hold, tuple(starts) or base.starts)


def _structures(base: Trial) -> Iterator[Change]:
    """Yield one and two more poles, more zeros, and an integrator, added or replacing a pole."""
    options = base.options
    if options.fixed or base.fit.poles_at_infinity:
        return
    if isinstance(options, SUMS):
        yield from _submodels(base)
        return
    (denominator, delay), n, m = base.near, options.poles, options.zeros
    one = [(np.polymul(denominator, [1.0, rate]), delay) for rate in base.rates]
    two = [(np.polymul(denominator, [1.0, 2.0 * DAMPING * rate, rate**2]), delay) for rate in base.rates]
    more = (one, n + 1, m), (one, n + 1, m + 1), (two, n + 2, m + 1), (two, n + 2, m + 2), ((), n, m + 1)
    for starts, poles, zeros in more:
        yield from _changed(base, starts, poles=poles, zeros=zeros)
    if not options.integrators:
        offset = "estimate" if options.offset in ("remove", "drift") else options.offset
        yield from _changed(base, integrators=1, offset=offset)
        yield from _changed(base, _with_fewer(denominator, delay), poles=n - 1, integrators=1, offset=offset)


def _submodels(base: Trial) -> Iterator[Change]:
    """Yield one more pole of the first submodel, and one more submodel."""
    first, *others = base.options.terms
    yield from _changed(base, terms=(replace(first, poles=first.poles + 1), *others))
    if base.options.factored:
        for poles in (1, 2):
            yield from _changed(base, terms=(first, *others, Term(poles, 0)))


def _with_fewer(denominator: Array, delay: float) -> list[Near]:
    """Return denominators without one real pole, or with a real pole of the same size in place of a pair."""
    poles = np.roots(denominator)
    found = []
    for pole in poles[poles.imag >= 0.0].tolist():
        left = poles[(poles != pole) & (poles != np.conj(pole))]
        left = np.append(left, [-abs(pole)] * (pole.imag > 0.0))
        found.append((polynomial(left), delay))
    return found


def _delays(base: Trial) -> Iterator[Change]:
    """Yield a range of delays from zero to a tenth of the record."""
    if isinstance(base.options, MeasuredSubmodels):
        return
    denominator, _ = base.near
    shortest = min(record.duration for record in base.records)
    reach = float(f"{max(FARTHER * base.options.delay_bounds[1], LATEST * shortest):.2g}")
    if reach < 0.5 * shortest:
        starts = [(denominator, float(delay)) for delay in np.linspace(0.0, reach, DELAYS)]
        yield from _changed(base, starts, delay_bounds=(0.0, reach))


def _holds(base: Trial) -> Iterator[Change]:
    """Yield the other holds; none for steps, whose hold is visible, nor a band-limited one for an input that jumps."""
    kinds = {input_moves(record).kind for record in base.records}
    # A discrete controller holds its input.
    if kinds <= {"constant", "steps"} or any(record.loop is not None for record in base.records):
        return
    regular = all(regular_interval(record.input.t) is not None for record in base.records)
    for hold in get_args(Hold):
        if hold != base.hold and (hold != "band-limited" or (regular and kinds == {"continuous"})):
            yield Change(base.options, hold, base.starts)


def _treatments(base: Trial) -> Iterator[Change]:
    """Yield an initial state, an offset, both, and a drift."""
    options, starts = base.options, base.starts
    offsets: tuple[Offset, ...] = ("remove",)
    if isinstance(options, DelayProfile):
        offsets = ("estimate", "drift")
        # The missing treatment may have moved the poles far away.
        starts += tuple((polynomial(np.full(options.poles, -rate)), base.near[1]) for rate in base.rates)
    state = "estimate" if options.initial_state == "rest" else options.initial_state
    for offset in dict.fromkeys((options.offset, *offsets)):
        for initial_state in dict.fromkeys((options.initial_state, state)):
            fields = {"initial_state": initial_state, "offset": offset}
            if getattr(options, "input_before", None) is not None and initial_state != "rest":
                fields["input_before"] = None
            yield from _changed(base, starts, **fields)


def polynomial(roots: Array) -> Array:
    """Return the monic polynomial with given roots, in descending powers."""
    return np.atleast_1d(np.real(np.poly(roots)))


def _losses(base: Trial) -> Iterator[Change]:
    """Yield a loss that outliers do not affect."""
    if base.options.loss == "squares":
        yield from _changed(base, loss="tukey")


CHANGES: dict[Kind, Callable[[Trial], Iterator[Change]]] = {
    "loss": _losses,
    "structure": _structures,
    "delay": _delays,
    "hold": _holds,
    "treatment": _treatments,
}


# --- assessment --------------------------------------------------------------------------------------


class _Step:
    """Trials of changes of one fit."""

    def __init__(self, base: Trial, wild: Sequence[Array]) -> None:
        self.base, self.wild = base, wild
        self.able = isinstance(base.options, DelayProfile)
        self.blocks = self.able and long_enough(base.records)
        self.without_gain: list[str] = []

    def helpful(self, kinds: Sequence[Kind]) -> list[tuple[Remedy, Trial]]:
        """Return the best change of each kind, if it helps."""
        found = []
        for kind in kinds:
            trials = [trial for change in CHANGES[kind](self.base) if (trial := self._tried(kind, change)) is not None]
            scored = [(self._fall(trial), trial) for trial in trials]
            least = 0.0 if self.blocks or kind == "loss" else DECISIVE
            better = sorted((pair for pair in scored if pair[0] > least), key=lambda pair: -pair[0])
            judged = [(self._judged(trial), trial) for _, trial in better[:MOST_COMPARED]]
            helpful = [(remedy, trial) for remedy, trial in judged if remedy is not None]
            best = self._searched(*_simplest(helpful)) if helpful else None
            if best is not None:
                found.append(best)
            else:
                self.without_gain += [self._option(trial) for trial in trials]
        return found

    def _tried(self, kind: Kind, change: Change) -> Trial | None:
        """Return the fit with a change; None if it is refused."""
        records = tuple(with_hold(record, change.hold) for record in self.base.records)
        try:
            fit = change.options._refine(records, *change.starts) if self.able else change.options.fit(records)
        except CtidError:
            return None
        return Trial(kind, change.options, change.hold, records, fit)

    def _fall(self, trial: Trial) -> float:
        """Return the decrease of the criterion; 1 for another loss, to which it does not apply."""
        if trial.kind == "loss":
            return 1.0
        before, after = self._criteria(trial)
        return before - after

    def _criteria(self, trial: Trial) -> list[float]:
        return criteria([self.base.fit, trial.fit], [self.base.parameters, trial.parameters], self.wild)

    def _judged(self, trial: Trial) -> Remedy | None:
        """Return a change as a remedy; None if it does not help."""
        try:
            if not self.able:
                return self._by_criterion(trial)
            before = [np.where(off == 0.0, e, np.nan) for e, off in zip(self.base.errors, self.wild, strict=True)]
            gain = compared(before, trial.errors, self.base.records)
        except CtidError:
            return None
        if self.blocks or trial.kind == "loss":
            # Outliers affect the fit of all blocks; other faults must also show where a fit extrapolates.
            if not gain.helps or (trial.kind != "loss" and gain.end > 1.0):
                return None
            return self._remedy(trial, gain.before, gain.after, gain.standard_error, held_back=True)
        return self._by_criterion(trial) if gain.end < NO_WORSE else None

    def _searched(self, remedy: Remedy, trial: Trial) -> tuple[Remedy, Trial] | None:
        """Return a remedy with the full search of its estimator; None if it then does not help."""
        if trial.kind in ("loss", "hold") or not self.able:
            return remedy, trial
        fit = replace(trial.options, covariance="white").fit(trial.records)
        if fit.cost >= trial.fit.cost * (1.0 - SAME):
            return remedy, trial
        trial = replace(trial, fit=fit)
        judged = self._judged(trial)
        return None if judged is None else (judged, trial)

    def _by_criterion(self, trial: Trial) -> Remedy:
        before, after = self._criteria(trial)
        return self._remedy(trial, before, after, np.nan, held_back=False)

    def _remedy(self, trial: Trial, before: float, after: float, error: float, *, held_back: bool) -> Remedy:
        made = trial.kind, self._option(trial), trial.options, trial.hold
        fits = self.base.fit.fit_percent, trial.fit.fit_percent
        return Remedy(*made, before, after, error, held_back, fits)

    def _option(self, trial: Trial) -> str:
        """Return the options of a change."""
        words = [typed(self.base.options, trial.options), f"--hold {trial.hold}" * (trial.hold != self.base.hold)]
        return " ".join(word for word in words if word)


def _simplest(helpful: Sequence[tuple[Remedy, Trial]]) -> tuple[Remedy, Trial]:
    """Return the simplest of the changes within a standard error of the best."""
    if not helpful[0][0].held_back:
        return max(helpful, key=lambda pair: pair[0].before - pair[0].after)
    best = max((remedy for remedy, _ in helpful), key=lambda remedy: remedy.after)
    as_good = [pair for pair in helpful if pair[0].after >= best.after - best.standard_error]
    return min(as_good, key=lambda pair: pair[1].parameters)


def criteria(fits: Sequence[MeasuredFit], parameters: Sequence[int], wild: Sequence[Array]) -> list[float]:
    """Return Schwarz's criterion of the innovations of each fit at common samples, under one noise model.

    ``wild``, the distances of outliers from their neighbours, is subtracted.
    """
    masks = [np.logical_and.reduce(uses) for uses in zip(*(fit.used for fit in fits), strict=True)]
    models = []
    for fit in fits:
        common = [mask[use] for mask, use in zip(masks, fit.used, strict=True)]
        tamed = [e - off[use] for e, off, use in zip(fit.residuals, wild, fit.used, strict=True)]
        slopes = [(psi @ fit.tangent)[at] for psi, at in zip(fit.sensitivities, common, strict=True)]
        models.append(([e[at] for e, at in zip(tamed, common, strict=True)], slopes))
    return criteria_of(models, parameters)


def _outliers(fit: MeasuredFit, k: int) -> Array:
    """Return the distance of outliers from their neighbours [output unit], 0 at all other samples, shape (N,)."""
    law = fit.linear
    places, off = residual_outliers(law.residuals[k])
    found = np.zeros(law.used[k].size)
    found[np.flatnonzero(law.used[k])[places]] = off
    return found


def typed(old: Any, new: Any) -> str:
    """Return the options of ``ctid fit`` that turn one estimator into another."""
    words = []
    if isinstance(new, SUMS) and old.terms != new.terms and new.factored:
        words.append(f"--terms {terms_text(new.terms)}")
    if old.delay_bounds != new.delay_bounds:
        words.append("--delay {:g}:{:g}".format(*new.delay_bounds))
    if not getattr(new, "factored", False) and (old.poles, old.zeros) != (new.poles, new.zeros):
        words += [f"--poles {new.poles} --zeros {new.zeros}"]
    for name in ("integrators", "initial_state", "offset", "loss"):
        if getattr(old, name, None) != getattr(new, name, None):
            words.append(f"--{name.replace('_', '-')} {getattr(new, name)}")
    return " ".join(words)
