"""What is odd about records and their fit, in sentences: the worst first, each with its evidence and what to do."""

from collections.abc import Iterator, Mapping
from typing import NamedTuple, TypeGuard

from ctid_cli.estimators.delay_profile import DelayProfile, MeasuredFit
from ctid_cli.estimators.hold_comparison import OtherHold
from ctid_cli.estimators.identification_warnings import of_treatment
from ctid_cli.estimators.measured_submodels import MeasuredSubmodels, Options
from ctid_cli.estimators.second_look import RecordLook, SecondLook
from ctid_cli.inference.residual_tests import ResidualTests
from ctid_cli.signals.treatment import Hold

#: Chances of a test statistic like this without feedback, and without missing dynamics.
FED_BACK, TOO_POOR = 1e-4, 1e-3
#: Shares of the residuals' variance below these are not worth a pole, and may be what a nonlinear system leaves.
WORTH_A_POLE, WORTH_A_LOOP = 0.05, 0.01
#: A delay that depends on the hold is worth a word from this many sampling intervals on.
FELT = 0.2
#: What each hold takes the input for.
TAKEN: dict[Hold, str] = {
    "zoh": "held between its samples",
    "foh": "straight lines between its samples",
    "band-limited": "band-limited",
}
#: Where more of the intervals are long the clock is irregular, and has no gaps.
GAPS = 0.05
#: Causes that are named, those of which the share is at least this fraction of the largest.
MOST_NAMED, COMPARABLE = 3, 0.6
#: Another delay, or one more pole, has to lower the cost by this fraction.
ANOTHER = 0.05
#: A state at the beginning that explains so much is named, whatever else there is.
MOSTLY = 0.5
#: A simpler cause is named before one more pole that does so little better.
SIMPLER = 0.9


class Cause(NamedTuple):
    """Something that residuals may fail their tests for."""

    #: Share of the residuals' variance that it explains [-]; 0 where it was ruled out.
    share: float
    #: What was seen, and the command to try; or what was tried, where it was ruled out.
    words: str
    #: Whether a better model mends it, and whether it is only named where none does. Another hold is no better model:
    #: it shifts all by half a sampling interval, as a bad clock may.
    mends: bool = False
    last: bool = False


def of_second_look(
    look: SecondLook,
    options: Options,
    fit: MeasuredFit,
    tests: tuple[ResidualTests, ...],
    gains: Mapping[str, float],
    *,
    answered: bool,
) -> list[str]:
    """Everything that should be said; nothing of a record and a model that fit each other.

    Where no answer to the input is seen there is nothing to say of the model.
    """
    words: list[str] = []
    for k, one in enumerate(look.records):
        words += [_of_which(k, look) + sentence for sentence in _of_record(one, options)]
    if not answered or any(one.growth_time > 0 for one in look.records):
        return words
    causes = list(_causes(look, options, fit, tests, gains))
    named = sorted((cause for cause in causes if cause.share > 0), key=lambda cause: -cause.share)
    if any(cause.mends for cause in named):
        # What a better model leaves may no longer look like a bad clock.
        named = [cause for cause in named if not cause.last]
    words += [cause.words for cause in named[:MOST_NAMED] if cause.share >= COMPARABLE * named[0].share]
    if look.integrator > 0:
        words.append(_of_integrator(look, options, fit))
    if look.held is not None and not look.other_hold and not named and not any(map(_faulty, look.records)):
        words += _of_hold(look, look.held)
    out = [cause.words for cause in causes if not cause.share and cause.words]
    failed = [test for test in tests if not (test.white and test.uncorrelated)]
    if failed and out and not any(_faulty(one) for one in look.records):
        words.append(f"Tested as causes of what the residuals show and ruled out: {'; '.join(out)}.")
    return words


def _of_which(k: int, look: SecondLook) -> str:
    return f"Experiment {k + 1}: " if len(look.records) > 1 else ""


def _of_record(one: RecordLook, options: Options) -> Iterator[str]:
    """What needs no model: an output that diverges, and faults of sensor and recorder."""
    if one.growth_time > 0:
        yield (
            f"The output diverges: it grows by a factor of e every {one.growth_time:.2g}, and the input does not. An "
            "unstable plant shows its dynamics in a stabilising loop only: record the reference there too, and use "
            "--loop FILE --reference COLUMN."
        )
        return
    yield from _of_faults(one, options)


# --- causes ------------------------------------------------------------------------------------------


def _causes(
    look: SecondLook,
    options: Options,
    fit: MeasuredFit,
    tests: tuple[ResidualTests, ...],
    gains: Mapping[str, float],
) -> Iterator[Cause]:
    """Every cause that was tried."""
    correlated = len(tests) < len(look.records) or not all(test.uncorrelated for test in tests)
    faulty = any(_faulty(one) for one in look.records)
    yield _order(look, options, fit, correlated)
    yield _delay(look, options, correlated and not faulty)
    yield Cause(
        0.0 if faulty else look.other_hold,
        next(_of_hold(look, look.held)) if look.held and look.other_hold else "the hold",
    )
    # Where the record begins somewhere else than at rest, all else may follow from that.
    if not look.integrator > 0 or gains.get("initial_state", 0.0) > MOSTLY:
        start = {"initial_state": gains.get("initial_state", 0.0)}
        yield Cause(
            start["initial_state"], of_treatment(start, options)[0] if start["initial_state"] else "", mends=True
        )
    offset = gains.get("offset", 0.0)
    # An integrator, or a pole as slow as the record, makes both.
    if options.offset == "none" and not look.integrator > 0:
        yield Cause(offset, of_treatment({"offset": offset}, options)[0] if offset else "an offset", mends=True)
    for k, one in enumerate(look.records):
        for cause in (_drift(one, look, offset), _feedback(one, options)):
            yield cause._replace(words=_of_which(k, look) * (cause.share > 0 or k > 0) + cause.words)
    yield _clock(look, faulty)


def _order(look: SecondLook, options: Options, fit: MeasuredFit, correlated: bool) -> Cause:
    poor = max(_poor_share(one) for one in look.records) if correlated else 0.0
    richer = look.richer
    if not poor:
        if richer is None:
            return Cause(0.0, "one more pole")
        return Cause(0.0, f"one more pole ({_little(richer.fall)})" if richer.fall < ANOTHER else "")
    found = f"About {100 * poor:.2g} % of the residuals' variance"
    if fit.poles_at_infinity or options.poles == 12 or (richer is not None and richer.fall < ANOTHER):
        return Cause(poor, f"{found} still follows the input, but more poles do not help: the system may be nonlinear.")
    zeros = f" --zeros {richer.zeros}" if richer is not None and richer.zeros != options.zeros else ""
    if richer is not None:
        poor, found = richer.fall, f"{100 * richer.fall:.2g} % of the residuals' variance"
    # Integrators are asked for beside the poles.
    more = f"--poles {options.poles - _integrators(options) + 1}{zeros}"
    if _is_sum(options):
        more = f"another submodel, --terms {_terms_of(options)},1/0"
    what = f"the structure is too poor (try {more})"
    return Cause(SIMPLER * poor, f"{found} is what one more pole explains: {what}.", mends=True)


def _is_sum(options: Options) -> TypeGuard[MeasuredSubmodels]:
    """Whether the degrees are given by --terms, not --poles."""
    if not (isinstance(options, MeasuredSubmodels) and options.factored):
        return False
    return len(options.terms) > 1 or not _integrators(options)


def _terms_of(options: MeasuredSubmodels) -> str:
    """The submodels as --terms has them."""
    return ",".join(f"{term.poles}/{term.zeros}" for term in options.terms)


def _integrators(options: Options) -> int:
    return sum(term.integrators for term in options.terms) if isinstance(options, MeasuredSubmodels) else 0


def _delay(look: SecondLook, options: Options, correlated: bool) -> Cause:
    elsewhere, (low, high) = look.elsewhere, options.delay_bounds
    if elsewhere is None:
        return Cause(0.0, "")
    if not correlated or elsewhere.fall < ANOTHER:
        return Cause(0.0, f"another delay ({_little(elsewhere.fall)})" if elsewhere.fall < ANOTHER else "")
    reach = f"{min(low, 0.5 * elsewhere.delay):.3g}:{max(high, 2.0 * elsewhere.delay):.3g}"
    known = "was taken as known" if low == high else "was searched"
    return Cause(
        elsewhere.fall,
        f"A delay of {elsewhere.delay:.3g} lowers the cost by {100 * elsewhere.fall:.2g} %, and {_range(low, high)} "
        f"{known}: the range of the delay is wrong (try --delay {reach}).",
        mends=True,
    )


def _little(fall: float) -> str:
    """What does not lower the cost, or hardly."""
    return f"lowers the cost by {100 * fall:.2g} %" if fall > 0 else "does not lower the cost"


def _range(low: float, high: float) -> str:
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"


def _drift(one: RecordLook, look: SecondLook, offset: float) -> Cause:
    if not one.drift or look.integrator > 0:
        return Cause(0.0, "drift" * (not look.integrator > 0))
    power = one.drift**2 / 12.0
    words = (
        f"Beside the model, the output drifts by {abs(one.drift):.2g} standard deviations of the residuals over "
        "the record. Remove the trend, or use a part without it (--from, --to)."
    )
    # It is seen beside a constant, and may have one of its own: then it is more than an offset.
    return Cause(max(power / (1.0 + power), min(1.01 * offset, 1.0)), words)


def _feedback(one: RecordLook, options: Options) -> Cause:
    chance = _chance_of_feedback(one)
    if not chance < FED_BACK or one.dependence is None:
        return Cause(0.0, "feedback")
    if isinstance(options, MeasuredSubmodels) and options.closed:
        words = (
            f"The reference answers the output (p = {chance:.1g}), as in a further loop about this one: look at both."
        )
        return Cause(one.dependence.feedback_share, words)
    words = (
        f"The input answers the output (p = {chance:.1g}), as in a closed loop, where noise biases the estimate. "
        "Record the reference, and use --loop FILE --reference COLUMN; without a controller, look at the clock."
    )
    return Cause(one.dependence.feedback_share, words)


def _clock(look: SecondLook, faulty: bool) -> Cause:
    clock = look.clock
    if faulty or clock.share < ANOTHER:
        return Cause(0.0, "the clock")
    interval = look.records[0].examined.report.interval
    words = (
        f"{100 * clock.share:.2g} % of the residuals' variance goes with the speed of the output (p = "
        f"{clock.p_value:.1g}), as if the clock were wrong by about {clock.jitter / interval:.2g} sampling intervals: "
        "look at the time stamps, and give those of the recorder (--time COLUMN)."
    )
    return Cause(clock.share, words, last=True)


# --- evidence ----------------------------------------------------------------------------------------


def _of_faults(one: RecordLook, options: Options) -> Iterator[str]:
    """What the sensor and the recorder did."""
    report, empty = one.examined.report, "leave those fields of the record empty"
    if len(one.outliers):
        many = len(one.outliers)
        where = ", ".join(f"{t:.6g}" for t, _ in one.outliers[:3]) + (", ..." if many > 3 else "")
        what = f"{many} output samples are outliers" if many > 1 else "1 output sample is an outlier"
        # Submodels, and models in a loop, are fitted by squares.
        robust = "" if isinstance(options, MeasuredSubmodels) else ", or use --loss tukey"
        size = f"{'up to ' if many > 1 else ''}{one.outliers[:, 1].max():.3g} away from the neighbours"
        yield f"{what} (t = {where}), {size}: leave faults of the sensor empty{robust}."
    if report.saturated and report.input_kind not in ("constant", "steps"):
        share = f"{100 * report.saturated:.2g} % of the output samples sit exactly at the least or greatest value"
        yield f"{share}, as at a limit of the sensor: {empty}, or repeat the record with a smaller input."
    if len(one.stood_still):
        begin, end = max(one.stood_still.tolist(), key=lambda pair: pair[1] - pair[0])
        yield (
            f"The output keeps one value from t = {begin:.6g} to {end:.6g}, and never does elsewhere: the recorder "
            f"stood still; {empty}."
        )
    if 0 < len(report.gaps) <= GAPS * report.n_samples:
        longest = max(report.gaps, key=lambda gap: gap.length)
        gaps = f"{len(report.gaps)} gaps, the longest" if len(report.gaps) > 1 else "a gap"
        yield (
            f"The record has {gaps} of {longest.length:.4g} after t = {longest.start:.6g}, across which the input is "
            "taken as held. If it was not, use a part without (--from, --to)."
        )


def _faulty(one: RecordLook) -> bool:
    """Whether the residuals are not those of a linear model in noise."""
    return bool(len(one.outliers) or len(one.stood_still) or one.examined.report.saturated or one.growth_time > 0)


def _chance_of_feedback(one: RecordLook) -> float:
    """Chance of such a dependence without feedback; 1 where something else explains it."""
    found = one.dependence
    if found is None or _faulty(one) or found.feedback_share < WORTH_A_LOOP:
        return 1.0
    # Dynamics that are missed may leave something for later inputs to tell.
    return found.feedback_p_value if found.feedback_p_value < found.pole_p_value else 1.0


def _poor_share(one: RecordLook) -> float:
    """Share of the residuals' variance that one more pole would explain; 0 where that may be chance or a fault."""
    found = one.dependence
    if found is None or _faulty(one) or not found.pole_p_value < TOO_POOR or found.pole_share < WORTH_A_POLE:
        return 0.0
    return found.pole_share


def _of_hold(look: SecondLook, other: OtherHold) -> Iterator[str]:
    """That another hold is better, or that the records do not tell and the delay depends on it."""
    given = look.records[0].examined.record.input.hold
    change, size = f"{'longer' if other.later > 0 else 'shorter'} by", abs(other.later) / other.interval
    delay = f"the delay is {change} {abs(other.later):.3g}, {size:.2g} sampling intervals" if size > FELT else ""
    if other.fall:
        yield (
            f"Taken as {TAKEN[other.hold]}, not as {TAKEN[given]}, the input lowers the cost by "
            f"{100 * other.fall:.2g} %{' and ' + delay if delay else ''}: use --hold {other.hold}, unless you know "
            "better."
        )
    elif delay and not other.told:
        yield (
            f"The record does not tell whether its input was {TAKEN[given]} or {TAKEN[other.hold]}: with --hold "
            f"{other.hold} {delay}. Say how it was made."
        )


def _of_integrator(look: SecondLook, options: Options, fit: MeasuredFit) -> str:
    """That a pole is slower than the record can show, and the command for a model with an integrator."""
    slow = f"A pole has a time constant of {look.integrator:.4g}"
    if look.indistinguishable:
        what = f"{slow} or more, and is indistinguishable from an integrator over this record: the system integrates"
    else:
        what = f"{slow}, too slow for this record: the system seems to integrate"
    command = _with_integrator(look, options, fit)
    use = f"Use {command}, or a longer record." if command else "Use a longer record."
    return f"{what}, or the output drifts, and the static gain means nothing. {use}"


def _with_integrator(look: SecondLook, options: Options, fit: MeasuredFit) -> str:
    """Options of ``ctid fit`` that change the model into one with an integrator; none where it would refuse them."""
    if options.initial_state == "periodic":
        return ""
    integrators = 1 + (options.integrators if isinstance(options, DelayProfile) else _integrators(options))
    if _is_sum(options):
        return f"--integrators {integrators} and one pole fewer in --terms"
    words = [f"--poles {fit.model.order - integrators} --integrators {integrators}"]
    words += [f"--zeros {options.zeros}"] * (options.zeros > 0)
    words += ["--offset estimate"] * (options.offset == "remove")
    hold = look.records[0].examined.record.input.hold
    words += [f"--hold {hold}"] * (hold != "zoh")
    return " ".join(words) + " without --fix" * bool(options.fixed)
