"""Changes of a fit that are tried on its own records, and selection of those that help."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from operator import is_not
from typing import NamedTuple, get_args

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import CtidError
from ctid_cli.estimators.delay_profile import DelayProfile
from ctid_cli.estimators.identification import Options
from ctid_cli.estimators.measured_fit import MeasuredFit
from ctid_cli.identification.changes import CHANGES, Change, FittedOptions, Kind, option_of
from ctid_cli.identification.criterion import Errors, criteria_of
from ctid_cli.identification.held_back import compared, long_enough
from ctid_cli.inference.signal_features import residual_outliers
from ctid_cli.progress import reported
from ctid_cli.signals.record import Record, beginning, with_hold
from ctid_cli.signals.treatment import Holds

#: Most samples of all records of one input on which changes are tried.
MOST_SAMPLES = 10_000
#: Least decrease of the criterion if it alone decides, very strong evidence by Kass and Raftery (1995).
DECISIVE = 10.0
#: In that case the squared error at the end of the records may grow by at most this factor.
NO_WORSE = 1.1
#: Most changes of one kind that are compared on held-back blocks, and most changes that are reported.
MOST_COMPARED, MOST_NAMED = 5, 3
#: Costs that differ by less than this fraction belong to the same model.
SAME = 1e-6


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
    in_addition: bool = False

    def __str__(self) -> str:
        made = f"with {self.option}{' in addition' * self.in_addition}"
        if self.held_back:
            return f"{made} the held-back fit is {self.after:.1f} instead of {self.before:.1f} %"
        numbers = f"BIC of the innovations is {self.after:.1f} instead of {self.before:.1f}, the fit"
        return f"{made} {numbers} {self.fits[1]:.1f} instead of {self.fits[0]:.1f} %"


class Trials(NamedTuple):
    """Changes of a fit that were tried."""

    #: Changes that help, each combined with those before it.
    remedies: list[Remedy]
    #: Options of changes that do not.
    without_gain: list[str]


class Helpful(NamedTuple):
    """A remedy and its fit."""

    remedy: Remedy
    changed: FittedOptions


@reported("remedies")
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
    to the input is detected. Remedies of transfer functions, of one or several inputs, are tried.

    A change helps if three conditions hold. It lowers Schwarz's criterion of the innovations, under one noise model
    (autoregressive, of the residuals of the closer fit) and 1.5 times the usual penalty. It improves the fit of ten
    blocks of the records, each predicted by a fit without its outputs, by more than twice the standard error of the
    difference. And it does not worsen the fit of the last two, which are held back together, so that a fit
    extrapolates. For another loss only the second counts. If blocks are too short, or the input moves in too few of
    them, the criterion decides, and must decrease by ten.
    """
    found = Trials([], [])
    # Changes are compared by the output error of the response to the input; in a loop the reference drives that, and
    # sums of submodels take long to fit.
    if not isinstance(options, DelayProfile) or fit.noise is not None:
        return found
    # Number and time of the trials both grow with the number of inputs.
    most = max(MOST_SAMPLES // (len(records) * len(records[0].held) ** 2), 1)
    part = tuple(beginning(record, most) for record in records)
    base = FittedOptions(options, records[0].hold, part, fit)
    try:
        if any(map(is_not, part, records)):
            base = _refitted(base, part)
        at = outlier_instants(part, base.fit)
        if any(map(len, at)):
            base = _refitted(_with_best(base, ("loss",), found)[0], without_samples(part, at))
        kinds: tuple[Kind, ...] = get_args(Kind)[1:] if suspicious else ("treatment",)
        kinds = kinds if response else ("delay",)
        while kinds and len(found.remedies) < MOST_NAMED:
            base, kinds = _with_best(base, kinds, found)
    except CtidError:
        return found
    return found


@reported("outliers")
def harmful_outliers(records: tuple[Record, ...], options: Options, fit: MeasuredFit) -> list[Array] | None:
    """Return the instants of the outliers of a fit in each record if another loss helps; else None."""
    found, at = Trials([], []), outlier_instants(records, fit)
    with suppress(CtidError):
        if any(map(len, at)) and isinstance(options, DelayProfile):
            _with_best(FittedOptions(options, records[0].hold, records, fit), ("loss",), found)
    return at if found.remedies else None


def outlier_instants(records: Sequence[Record], fit: MeasuredFit) -> list[Array]:
    """Return the instants of the outliers of a fit in each record [s]."""
    each = zip(records, fit.linear.used, fit.linear.residuals, strict=True)
    return [record.t[use][residual_outliers(e)[0]] for record, use, e in each]


def without_samples(records: Sequence[Record], instants: Sequence[Array]) -> tuple[Record, ...]:
    """Return records whose output is missing at some instants."""
    each = zip(records, instants, strict=True)
    return tuple(replace(record, y=np.where(np.isin(record.t, at), np.nan, record.y)) for record, at in each)


def _refitted(base: FittedOptions, records: tuple[Record, ...]) -> FittedOptions:
    """Return the fit to a part of the records, or without outliers."""
    return _fitted(replace(base, records=records), Change(base.options, base.hold, [base.start()]))


def _fitted(base: FittedOptions, change: Change) -> FittedOptions:
    """Return the fit with a change."""
    records = tuple(with_hold(record, change.hold) for record in base.records)
    return FittedOptions(change.options, change.hold, records, change.options._refine(records, *change.starts))


def _with_best(base: FittedOptions, kinds: Sequence[Kind], found: Trials) -> tuple[FittedOptions, tuple[Kind, ...]]:
    """Add the most helpful change of some kinds; return its fit, and the other kinds that help on their own."""
    helpful = []
    for kind in kinds:
        tried = [one for change in CHANGES[kind](base) if (one := _tried(base, change)) is not None]
        best = _best(base, kind, tried)
        if best is not None:
            helpful.append(best)
        elif not found.remedies:
            found.without_gain.extend(option_of(base, one) for one in tried)
    if not helpful:
        return base, ()
    remedy, changed = _simplest(helpful)
    found.remedies.append(replace(remedy, in_addition=bool(found.remedies)))
    return changed, tuple(other.remedy.kind for other in helpful if other.remedy is not remedy)


def _tried(base: FittedOptions, change: Change) -> FittedOptions | None:
    """Return the fit with a change; None if it is refused."""
    try:
        return _fitted(base, change)
    except CtidError:
        return None


def _best(base: FittedOptions, kind: Kind, tried: Sequence[FittedOptions]) -> Helpful | None:
    """Return the best of the changes of one kind, if it helps."""
    # The criterion does not apply to another loss.
    falls = [np.inf if kind == "loss" else -float(np.diff(criteria(base, one))[0]) for one in tried]
    least = 0.0 if long_enough(base.records) else DECISIVE
    better = [k for k in np.argsort(falls)[::-1].tolist() if falls[k] > least]
    helpful = [each for k in better[:MOST_COMPARED] if (each := _helpful(base, kind, tried[k])) is not None]
    if not helpful:
        return None
    best = _simplest(helpful)
    if kind in ("loss", "hold"):
        return best
    # The search that the estimator makes may find a lower cost, and then must help too.
    searched = replace(best.changed.options, covariance="white").fit(best.changed.records)
    if searched.cost >= best.changed.fit.cost * (1.0 - SAME):
        return best
    return _helpful(base, kind, replace(best.changed, fit=searched))


def _helpful(base: FittedOptions, kind: Kind, changed: FittedOptions) -> Helpful | None:
    """Return a change as a remedy; None if it does not help."""
    fits = base.fit.fit_percent, changed.fit.fit_percent
    made = kind, option_of(base, changed), changed.options, changed.hold
    try:
        # Another loss must improve the fit of the samples that are no outliers.
        clean = base.records
        if kind == "loss":
            clean = without_samples(clean, outlier_instants(clean, base.fit))
        errors = [np.where(record.valid, e, np.nan) for record, e in zip(clean, base.errors, strict=True)]
        gain = compared(errors, changed.errors, base.records)
    except CtidError:
        return None
    if kind == "loss" or long_enough(base.records):
        # Outliers affect the fit of all blocks; other faults must also show where a fit extrapolates.
        helps = gain.helps and (kind == "loss" or gain.end <= 1.0)
        remedy = Remedy(*made, gain.before, gain.after, gain.standard_error, held_back=True, fits=fits)
        return Helpful(remedy, changed) if helps else None
    if gain.end >= NO_WORSE:
        return None
    before, after = criteria(base, changed)
    return Helpful(Remedy(*made, before, after, np.nan, held_back=False, fits=fits), changed)


def _simplest(helpful: Sequence[Helpful]) -> Helpful:
    """Return the simplest of the changes within a standard error of the best."""
    if not helpful[0].remedy.held_back:
        return max(helpful, key=lambda each: each.remedy.before - each.remedy.after)
    best = max((each.remedy for each in helpful), key=lambda remedy: remedy.after)
    as_good = [each for each in helpful if each.remedy.after >= best.after - best.standard_error]
    return min(as_good, key=lambda each: each.changed.parameters)


def criteria(*fits: FittedOptions) -> list[float]:
    """Return the criterion of fits at the samples that all use, under one noise model."""
    models = [Errors.of(each.fit) for each in fits]
    return criteria_of(models, [each.fit.used for each in fits], [each.parameters for each in fits])
