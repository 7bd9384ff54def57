"""What is odd about records and their fit, in sentences: the worst first, each with its evidence and what to do."""

from collections.abc import Iterator

from ctid_cli.estimators.delay_profile import MeasuredFit
from ctid_cli.estimators.hold_comparison import OtherHold
from ctid_cli.estimators.judging import Options
from ctid_cli.estimators.second_look import RecordLook, SecondLook
from ctid_cli.inference.residuals import ResidualTests
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


def of_second_look(
    look: SecondLook, options: Options, fit: MeasuredFit, tests: tuple[ResidualTests, ...], *, answered: bool
) -> list[str]:
    """Everything that should be said; nothing of a record and a model that fit each other.

    Where no answer to the input is seen there is nothing to say of the model.
    """
    several = len(look.records) > 1
    words: list[str] = []
    poor = _poorest_share(look, tests)
    for k, one in enumerate(look.records):
        found = _of_record(one, look, options, fit, poor) if answered else _of_faults(one)
        words += [f"Experiment {k + 1}: {sentence}" if several else sentence for sentence in found]
    if not answered:
        return words
    diverges = any(one.growth_time > 0 for one in look.records)
    if look.integrator > 0 and not diverges:
        words.append(_of_integrator(look, options, fit))
    if look.held is not None and poor <= look.other_hold and not any(_faulty(one) for one in look.records):
        words += _of_hold(look, look.held)
    return words


def _of_record(one: RecordLook, look: SecondLook, options: Options, fit: MeasuredFit, poor: float) -> Iterator[str]:
    if one.growth_time > 0:
        yield (
            f"The output diverges: it grows by a factor of e every {one.growth_time:.2g}, and the input does not. An "
            "unstable plant shows its dynamics in a stabilising loop only: record the reference there too, and use "
            "--loop FILE --reference COLUMN."
        )
        return
    yield from _of_faults(one)
    chance = _chance_of_feedback(one)
    if chance < FED_BACK:
        yield (
            f"The input answers the output (p = {chance:.1g}), as in a closed loop, where noise biases the estimate. "
            "Record the reference, and use --loop FILE --reference COLUMN; without a controller, look at the clock."
        )
    elif poor > look.other_hold and _poor_share(one):
        yield _of_structure(one, options, fit)
    if one.drift and not (look.integrator > 0 or poor):
        yield (
            f"Beside the model, the output drifts by {abs(one.drift):.2g} standard deviations of the residuals over "
            "the record. Remove the trend, or use a part without it (--from, --to)."
        )


def _of_faults(one: RecordLook) -> Iterator[str]:
    """What the sensor and the recorder did."""
    report, empty = one.examined.report, "leave those fields of the record empty"
    if len(one.outliers):
        many = len(one.outliers)
        where = ", ".join(f"{t:.6g}" for t, _ in one.outliers[:3]) + (", ..." if many > 3 else "")
        what = f"{many} output samples are outliers" if many > 1 else "1 output sample is an outlier"
        size = f"{'up to ' if many > 1 else ''}{one.outliers[:, 1].max():.3g} away from the neighbours"
        yield f"{what} (t = {where}), {size}: leave faults of the sensor empty, or use --loss tukey."
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


def _poorest_share(look: SecondLook, tests: tuple[ResidualTests, ...]) -> float:
    """The largest share of a record; 0 where the residuals pass the test that is printed."""
    passed = len(tests) == len(look.records) and all(test.uncorrelated for test in tests)
    return 0.0 if passed else max(_poor_share(one) for one in look.records)


def _of_structure(one: RecordLook, options: Options, fit: MeasuredFit) -> str:
    low, high = options.delay_bounds
    report, found = one.examined.report, f"About {100 * _poor_share(one):.2g} % of the residuals' variance"
    if low == high and report.delay_early > low and report.suggested_delay is not None:
        first, last = report.suggested_delay
        late = f"the output begins to answer {report.delay_early:.3g} or more after a change of the input"
        return f"{found} still follows the input, and {late}: the delay is too short (try --delay {first:g}:{last:g})."
    if fit.poles_at_infinity or options.poles == 12:
        return f"{found} still follows the input, but more poles do not help: the system may be nonlinear."
    return f"{found} is what one more pole may explain: the structure is too poor (try --poles {options.poles + 1})."


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
    poles = fit.model.order - 1
    return (
        f"A pole has a time constant of {look.integrator:.4g}, too slow for this record: the system seems to integrate"
        f", or the output drifts, and the static gain means nothing. Use --poles {poles} --integrators 1 (with a known "
        "delay), or a longer record."
    )
