"""Warnings of a fit: at most five sentences, the most important first."""

import re
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from ctid_cli.arrays import BoolArray
from ctid_cli.errors import DataError
from ctid_cli.estimators.delay_profile import DelayProfile
from ctid_cli.estimators.identification import Identification, unsafe_intervals
from ctid_cli.estimators.measured_fit import MeasuredFit, MultiInputFit, delay_names
from ctid_cli.estimators.reported_parameters import direction_names, free_directions
from ctid_cli.identification.choice import Candidate, Choice, Given, HeldBack, fit_options, zero_on_integrator
from ctid_cli.identification.choose import choose
from ctid_cli.identification.criterion import held_back, refitted
from ctid_cli.identification.sentences import outlying, spelled
from ctid_cli.inference.covariance import LARGE_STANDARD_ERROR, describe_conditioning
from ctid_cli.inference.fit import Status
from ctid_cli.inference.residual_tests import FEWEST_TESTED, input_dependence
from ctid_cli.inference.signal_features import growth_time, residual_outliers, saturated
from ctid_cli.inference.uncertainty import Uncertainty
from ctid_cli.models.several_inputs import delays_of, fractions_of
from ctid_cli.progress import reported
from ctid_cli.signals.record import Record, with_hold
from ctid_cli.text import count, listed, probability

#: Why residuals may depend on later inputs.
AHEAD = "the delay is too long, the output was recorded ahead of the input, or a loop acts"
#: Most sentences that are printed.
MOST = 5
#: A fit below this is reported [%].
LOW_FIT = 80.0
#: A validation record is reported if its fit is low and its root mean square error exceeds that of the fit this many
#: times: in 4,000 draws of AR(1) noise of .95, 150 samples have four times the variance of 300 others in .2 %.
GREATER = 2.0
#: Significance levels at which residuals depend on the input, and the input on residuals (stricter, because many inputs
#: are tested), and least share of the residuals' variance that such feedback explains.
DEPENDENT, FED_BACK, FEEDBACK_SHARE = 0.01, 1e-4, 0.01
#: Endings of a search after which no other result of a fit is meaningful.
UNFINISHED = (Status.MAX_ITERATIONS, Status.DIVERGED, Status.REFLECTED)
#: A real pole is slow if its time constant exceeds this fraction of the record.
SLOW = 0.6
#: Most instants of outliers that are listed.
LISTED = 3


def with_warnings(found: Identification, time_unit: str = "s", free: Given | None = None) -> Identification:
    """Return a fit with its warnings; one with a given structure is compared with a choice by other options."""
    return replace(found, warnings=tuple(f"{text}." for text in fit_warnings(found, time_unit, free)))


@reported("tests of the fit")
def fit_warnings(found: Identification, time_unit: str = "s", free: Given | None = None) -> list[str]:
    """Return the warnings of a fit without their full stops, the most important first."""
    fit, records = found.fit, found.records
    growing = [
        growth_time(record.t[use], record.y[use], signal.at(record.t[use]))
        for record, use in _used(found)
        for signal in record.held.values()
    ]
    if all(np.isfinite(growing)):
        fastest = float(np.nanmin(growing))
        what = f"The output diverges: it grows by a factor of e every {fastest:.2g} {time_unit}, and the input does not"
        return [f"{what}; an unstable plant is not among the models"]
    if fit.status in UNFINISHED:
        loop = ". In a loop the plant may be unstable: that needs the controller (--loop FILE), or --unstable"
        unfinished = fit.status.value.removesuffix(".")
        return [f"{unfinished}{loop * any(record.loop is not None for record in records)}"]
    suspicious = not found.answer.seen or fit.fit_percent < LOW_FIT or fit.status is not Status.CONVERGED
    suspicious |= not all(test.white and test.uncorrelated for test in found.tests)
    chosen = [] if free is None or not suspicious else list(_of_choice(found, free, time_unit))
    if not found.answer.seen:
        no_model = f"No model: no response of the output to the input is detected ({probability(found.answer.p_value)})"
        return [f"{no_model}. {found.answer.evidence[:-1]}", *chosen]
    others = [
        *of_lost_poles(fit),
        *_of_residuals(found, time_unit),
        *_of_noise(fit),
        *_of_fit(fit),
        *of_search(fit, time_unit),
        *_of_uncertainty(found, time_unit),
    ]
    changed = [] if fit.change is None else [fit.change.sentence]
    return list(dict.fromkeys([*_of_validation(found), *chosen, *changed, *others]))[:MOST]


def _used(found: Identification) -> Iterator[tuple[Record, BoolArray]]:
    return zip(found.records, found.fit.linear.used, strict=True)


# --- observations ------------------------------------------------------------------------------------


def _of_choice(found: Identification, free: Given, time_unit: str) -> Iterator[str]:
    """Yield what would be chosen if the structure were free, if it predicts held-back blocks better."""
    options, fit = found.options, found.fit
    # In a loop the reference drives the response; a part of the records may begin later than they do.
    if not isinstance(options, DelayProfile) or fit.noise is not None or fit.weighting is not None:
        return
    try:
        choice = choose(found.records, free, time_unit)
        own, other = _held_back_of(found, choice)
    except DataError as error:
        yield f"No structure could be chosen for comparison: {str(error).removesuffix('.')}"
        return
    if not choice.has_model or own is None or other is None or own.acceptable:
        return
    before, after = fit_options(options, found.records[0]), fit_options(choice.options, choice.records[0])
    typed = [*before, *["--fix"] * bool(options.fixed), *["--bound"] * bool(options.bounds)]
    old, new = ([word for text in texts for word in text.split() if word.startswith("--")] for texts in (typed, after))
    dropped = list(dict.fromkeys(word for word in old if word not in new))
    words = " ".join(text for text in after if text not in before) or "the same options"
    words += f" and without {listed(dropped)}" if dropped else ""
    fits = f"{other.percent:.1f} instead of {own.percent:.1f} %"
    yield f"A free choice takes {spelled(choice.options)}: with {words} the held-back fit is {fits}"


def _held_back_of(found: Identification, choice: Choice) -> tuple[HeldBack | None, HeldBack | None]:
    """Return the errors of held-back blocks of a fit and of a choice."""
    options, records = found.options, choice.fitted
    assert isinstance(options, DelayProfile)
    moved = any(part.t[0] > record.t[0] for part, record in zip(records, found.records, strict=True))
    treated = replace(options, initial_state="estimate", input_before=None) if moved else options
    held = [with_hold(record, found.records[0].hold) for record in records]
    given = refitted(Candidate(treated, found.records[0].hold, found.fit, choice.taken.size), held)
    other, own = held_back([(refitted(choice.taken, records), records), (given, held)])
    return own, other


def _dependence(found: Identification, least: float = 0.05) -> str:
    """Return which residuals depend most on the input, if they do at a significance level."""
    tests = [(test.cross_p_value, k, test) for k, test in enumerate(found.tests, start=1)]
    p, k, test = min(tests, default=(1.0, 0, None), key=lambda each: np.nan_to_num(each[0], nan=1.0))
    if test is None or not p < least:
        return ""
    later = int(np.argmax(np.abs(test.cross_correlation))) < test.lags
    names = list(found.records[0].held)
    record, name = divmod(k - 1, len(names))
    if later and found.records[record].feedback:  # as the input of a loop must
        return ""
    of = f" of experiment {record + 1}" * (len(found.records) > 1)
    which = f" {names[name]}" * (len(names) > 1)
    if later:
        return f"The residuals{of} depend most on later values of the input{which} ({probability(p)})"
    return f"The residuals{of} depend on the input{which} ({probability(p)})"


def _outliers(found: Identification, time_unit: str) -> str:
    """Return the samples that are far from their neighbours; empty if there are none."""
    listed_times, largest, total = [], 0.0, 0
    for k, ((record, use), e) in enumerate(zip(_used(found), found.fit.linear.residuals, strict=True), start=1):
        places, off = residual_outliers(e)
        total += places.size
        largest = max(largest, float(np.abs(off).max(initial=0.0)))
        of = f" of experiment {k}" * (len(found.records) > 1)
        times = [f"{t:.6g}" for t in record.t[use][places][:LISTED]]
        listed_times += [f"t = {', '.join(times)} {time_unit}{', ...' * (places.size > LISTED)}{of}"] * (
            places.size > 0
        )
    if not total:
        return ""
    return f"{outlying(total)} ({'; '.join(listed_times)}), up to {largest:.3g} away from the neighbours"


def _slow_pole(found: Identification, time_unit: str) -> str:
    """Return that a real pole is slow for the record; empty if none is."""
    poles = found.fit.model.poles
    sizes = np.abs(poles[(poles.imag == 0.0) & (poles.real != 0.0)])
    longest = max(record.duration for record in found.records)
    if not sizes.size or sizes.min() * longest * SLOW >= 1.0:
        return ""
    what = f"A pole has a time constant of {1 / sizes.min():.4g} {time_unit}"
    return f"{what}: over a record of {longest:.4g} {time_unit} it is nearly indistinguishable from an integrator"


def _of_cancelled_integrator(found: Identification, time_unit: str) -> Iterator[str]:
    """Yield that a zero nearly cancels the integrator, which then describes a drift of the output."""
    longest = max(record.duration for record in found.records)
    for model in fractions_of(found.fit.model) if isinstance(found.options, DelayProfile) else ():
        zero = zero_on_integrator(model, longest)
        if zero is not None:
            gain = model.numerator[-2] / model.denominator[-2]
            what = f"The zero at {zero:.2g} rad/{time_unit} nearly cancels the integrator over this record"
            yield f"{what}, which describes a drift of the output; without both the static gain is {gain:.3g}"


def _of_validation(found: Identification) -> Iterator[str]:
    fit, other = found.fit, found.validation
    if other is None:
        return
    if shared := found.seen_in_validation:
        what = f"{shared} of the {count(other.record.n_samples, 'sample')} of the validation record are those that"
        yield f"{what} the model was estimated from, so its fit there is no test; give a record without them"
    ratio = float(np.sqrt(np.mean(np.square(other.applied.residuals[0])) / max(fit.cost, np.finfo(float).tiny)))
    if other.fit_percent < LOW_FIT and ratio > GREATER and fit.weighting is None:
        what = f"The root mean square error on the validation record is {ratio:.2g} times that of the fit"
        yield f"{what}: the model does not generalise, or there is more noise"


def _of_residuals(found: Identification, time_unit: str) -> Iterator[str]:
    """Yield warnings about residuals and outputs."""
    if what := _dependence(found, DEPENDENT):
        yield f"{what}: {AHEAD if 'later values' in what else 'the model misses a part of the response'}"
    outliers = _outliers(found, time_unit)
    if outliers:
        yield outliers
    share = max(saturated(record.y[record.valid]) for record in found.records)
    if share:
        where = f"{100 * share:.2g} % of the output samples lie exactly at the least or greatest value"
        yield f"{where}: if a limit of the sensor or the actuator cut them off, parameters and intervals are biased"
    fit, noisy = found.fit.linear, found.fit.noise is not None
    # With outliers the residuals are not tested further.
    for k, (record, use) in enumerate(_used(found) if not outliers else ()):
        if record.feedback:  # which is known
            continue
        e, psi, t = fit.residuals[k], fit.sensitivities[k], record.t[use]
        acting = found.options._acting(record)
        x = record.y[use] - (found.fit.residuals[k] if noisy else e)
        dependences = [
            input_dependence(e, x, psi, t, one, delay)
            for one, delay in zip(acting.each_input, delays_of(fit.model), strict=True)
        ]
        clearest = min(filter(None, dependences), key=lambda each: each.feedback_p_value, default=None)
        if clearest is None or clearest.feedback_share < FEEDBACK_SHARE:
            continue
        # Missed dynamics may correlate residuals with later inputs too.
        if clearest.feedback_p_value < min(FED_BACK, clearest.pole_p_value):
            what = "The input follows earlier residuals" if acting is record else "The reference follows the output"
            where = f"{what} ({probability(clearest.feedback_p_value)})"
            yield f"{where}, as in a loop, where noise biases the estimate, or as if the output is ahead of the input"


def _of_fit(fit: MeasuredFit) -> Iterator[str]:
    """Yield that a fit is low, as it always is with outliers."""
    if fit.fit_percent < LOW_FIT and fit.weighting is None and fit.noise is None:
        yield f"The fit is {fit.fit_percent:.1f} %: {100 * (1 - fit.r2):.2g} % of the output's variance is left"


def _of_noise(fit: MeasuredFit) -> Iterator[str]:
    """Yield that the estimate depends on the noise model."""
    if fit.noise is not None and fit.noise.differs:
        what = "The output-error fit and the fit with the noise model differ by more than chance gives"
        found = f"(Hausman's test, {probability(fit.noise.test.p_value)})"
        yield f"{what} {found}: the model of the plant or of the noise is too small"


def of_search(fit: MeasuredFit, time_unit: str) -> Iterator[str]:
    """Yield how the search ended, unless it converged."""
    if fit.status not in (Status.CONVERGED, Status.DELAY_AT_BOUND) and not (fit.held_poles or fit.bounds_met):
        yield fit.status.value.removesuffix(".")
    if fit.bounds_met:
        at = listed(f"{name} = {end:g}" for name, end in fit.bounds_met)
        yield f"At the given bound: {at}; beyond it the cost is lower, and other standard errors take this as known"
    if fit.held_poles:
        held = listed(f"{pole:.4g}" if pole.imag else f"{pole.real:.4g}" for pole in fit.held_poles)
        met = () if fit.box is None else fit.box.limits_met(fit.held_poles)
        why = "".join(f"; the {limit.what} is {value:.4g}: {limit.meaning}" for _, limit, value in met)
        yield f"Held at the border of the admissible models: {held} (poles, rad/{time_unit}){why}"
    yield from (f"{where}, and has no standard error" for where in _delays_at_ends(fit, time_unit))


def _delays_at_ends(fit: MeasuredFit, time_unit: str) -> Iterator[str]:
    """Yield which delays are at the end of their range."""
    names = delay_names(fit)
    for name, delay in zip(names, delays_of(fit.model), strict=True) if fit.status is Status.DELAY_AT_BOUND else ():
        if name in fit.parameter_names and not fit.tangent[fit.parameter_names.index(name)].any():
            where = f"end of its range, {delay:.4g} {time_unit}" if delay else "least possible, 0"
            of = f" of {name.removesuffix('_delay')}" * (len(names) > 1)
            yield f"The delay{of} is at the {where}"


def of_lost_poles(fit: MeasuredFit) -> Iterator[str]:
    """Yield that the model has fewer poles than specified."""
    if lost := fit.poles_at_infinity:
        gone = f"{'it has' if lost == 1 else 'they have'} run to infinity, where the cost is least"
        yield f"The model has {count(lost, 'pole')} fewer than specified: {gone}"


def of_conditioning(fit: MeasuredFit, known: Uncertainty) -> Iterator[str]:
    """Yield what the data do not determine."""
    hessian = free_directions(fit.linear)[1]
    yield from (
        each.removesuffix(".") for each in describe_conditioning(known.free_covariance, direction_names(fit), hessian)
    )
    for name, value, error in zip(fit.parameter_names, fit.theta, known.errors(np.eye(fit.theta.size)), strict=True):
        looked_at = re.fullmatch(r"[ab]\d+|delay", name) and (fit.signs_known or not name.startswith("a"))
        if looked_at and error > LARGE_STANDARD_ERROR * abs(value):
            times = f"{error / abs(value):.2g} times its value" if value else "its value being zero"
            start = f"{name} = {value:.3g} has a standard error of {error:.3g}, {times}"
            yield f"{start}: these data do not even determine its sign"


def _of_uncertainty(found: Identification, time_unit: str) -> Iterator[str]:
    """Yield what the record does not determine, and which intervals are unreliable."""
    if slow := _slow_pole(found, time_unit):
        yield slow
    yield from _of_cancelled_integrator(found, time_unit)
    fit, uncertainty = found.fit, found.uncertainty
    yield from of_conditioning(fit, fit.uncertainty("white") if uncertainty.kind == "biased" else uncertainty)
    if uncertainty.short:
        freedom = f"{uncertainty.degrees_of_freedom:.2g} degrees of freedom"
        yield f"The record is short for its noise: some intervals are those of Student's t with {freedom}, and rough"
    if unsafe := unsafe_intervals(found):
        what = f"Intervals of {listed(unsafe)} are" if len(unsafe) > 1 else f"The interval of {unsafe[0]} is"
        yield f"{what} unsafe: so far from the estimate the output is not linear in the parameters"
    low, high = found.options.delay_bounds
    interval = None if isinstance(fit, MultiInputFit) else found.delay_interval
    # A delay cannot be below zero, so that end is not reported.
    ends = (
        [] if interval is None else [f"{low:g}"] * (interval.open_low and low > 0) + [f"{high:g}"] * interval.open_high
    )
    if ends:
        yield f"The interval of the delay reaches the end of its range ({' and '.join(ends)} {time_unit})"
    if len(found.tests) < len(fit.residuals) * len(delays_of(fit.model)):
        yield f"Fewer than {FEWEST_TESTED} residuals are too few to test; standard errors take them as white"
