"""What to know before a fit is used: at most five sentences, ordered by what they cost."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ctid_cli.arrays import BoolArray
from ctid_cli.estimators.delay_profile import MeasuredFit, MultiInputFit
from ctid_cli.estimators.identification import Identification, delay_names, free_directions, unsafe_intervals
from ctid_cli.identification.remedies import Kind, Remedy, Trials, tried_remedies
from ctid_cli.inference.covariance import condition_number, describe_conditioning
from ctid_cli.inference.fit import Status
from ctid_cli.inference.residual_tests import FEWEST_TESTED, input_dependence
from ctid_cli.inference.signal_features import growth_time, residual_outliers, saturated
from ctid_cli.inference.uncertainty import Uncertainty
from ctid_cli.models.several_inputs import delays_of
from ctid_cli.signals.record import Record
from ctid_cli.text import count, listed, probability

#: Why residuals may depend on inputs that are still to come.
AHEAD = "the delay is too long, the output was recorded ahead of the input, or a loop acts"
#: Sentences that are printed.
MOST = 5
#: Below this fit something may be missing [%].
LOW_FIT = 80.0
#: Residuals depend on the input where chance gives as much less often than this; of feedback, which is looked for among
#: many inputs, and explains this share of the residuals' variance.
DEPENDENT, FED_BACK, FEEDBACK_SHARE = 0.01, 1e-4, 0.01
#: Endings of a search at which nothing else of a fit means anything.
UNFINISHED = (Status.MAX_ITERATIONS, Status.DIVERGED, Status.REFLECTED)
#: A real pole is slow where its time constant exceeds this fraction of the record.
SLOW = 0.6
#: Instants of outliers that are listed.
LISTED = 3


@dataclass(frozen=True)
class FitWarning:
    """What was observed of a fit, and a remedy that was tried and helped, if there is one."""

    observed: str
    remedy: Remedy | None = None

    def __str__(self) -> str:
        return f"{self.observed}." if self.remedy is None else f"{self.observed}: {self.remedy}."


def with_warnings(found: Identification, time_unit: str = "s") -> Identification:
    """Return a fit with its warnings, after changes of it have been tried on its records."""
    return replace(found, warnings=tuple(map(str, fit_warnings(found, time_unit))))


def fit_warnings(found: Identification, time_unit: str = "s") -> list[FitWarning]:
    """Try changes of a fit, and return its warnings, the costliest first."""
    fit, records = found.fit, found.records
    growing = [
        growth_time(record.t[use], record.y[use], signal.at(record.t[use]))
        for record, use in _used(found)
        for signal in record.held.values()
    ]
    if all(np.isfinite(growing)):
        fastest = float(np.nanmin(growing))
        what = f"The output diverges: it grows by a factor of e every {fastest:.2g} {time_unit}, and the input does not"
        return [FitWarning(f"{what}; an unstable plant is not among the models")]
    if fit.status in UNFINISHED:
        loop = ". In a loop the plant may be unstable: that needs the controller (--loop FILE)"
        unfinished = fit.status.value.removesuffix(".")
        return [FitWarning(f"{unfinished}{loop * any(record.loop is not None for record in records)}")]
    seen = found.answer.seen
    suspicious = (
        fit.fit_percent < LOW_FIT
        or fit.status is not Status.CONVERGED
        or len(found.tests) < len(records) * len(delays_of(fit.model))
    )
    suspicious |= not all(test.white and test.uncorrelated for test in found.tests)
    # Changes are compared as output-error fits are.
    tried = Trials([], [])
    if fit.noise is None and not isinstance(fit, MultiInputFit):
        tried = tried_remedies(records, found.options, fit, suspicious=suspicious, response=seen)
    named = [FitWarning(_observed(remedy, found, time_unit), remedy) for remedy in tried.remedies]
    mended = {remedy.kind for remedy in tried.remedies}
    if not seen:
        no_model = f"No model: the output is not seen to respond to the input ({probability(found.answer.p_value)})"
        return [FitWarning(f"{no_model}. {found.answer.evidence[:-1]}"), *named]
    others = [*of_lost_poles(fit), *_of_residuals(found, mended, time_unit)]
    if not named:
        # Of an estimate that will change, neither its search nor its errors need to be known.
        others += [
            *_of_noise(fit),
            *_of_fit(fit, tried),
            *of_search(fit, time_unit),
            *_of_uncertainty(found, time_unit),
        ]
    failed = list(_of_validation(found))
    return [*failed, *named, *(FitWarning(each) for each in dict.fromkeys(others))][:MOST]


def _used(found: Identification) -> Iterator[tuple[Record, BoolArray]]:
    return zip(found.records, found.fit.linear.used, strict=True)


# --- what a remedy is for ----------------------------------------------------------------------------


def _observed(remedy: Remedy, found: Identification, time_unit: str) -> str:
    """Return what a kind of remedy mends, as it was seen."""
    fit, options = found.fit, found.options
    if remedy.kind == "loss":
        return _outliers(found, time_unit)
    if remedy.kind == "hold":
        return f"The input is taken with --hold {' --hold '.join(found.records[0].hold_options)}"
    if remedy.kind == "treatment":
        return f"The fit is made with --initial-state {options.initial_state} --offset {options.offset}"
    low, high = options.delay_bounds
    if remedy.kind == "delay" and fit.status is Status.DELAY_AT_BOUND:
        return f"The delay lies at the end of its range, {fit.model.delay:.4g} {time_unit}"
    if remedy.kind == "delay" and low == high:
        return f"The delay is taken as {low:g} {time_unit}"
    if getattr(remedy.options, "integrators", 0) and (slow := _slow_pole(found, time_unit)):
        return slow
    return _dependence(found) or f"The model has {count(options.poles, 'pole')} and {count(options.zeros, 'zero')}"


def _dependence(found: Identification, least: float = 0.05) -> str:
    """Return which residuals depend on the input most, if chance would give as much less often than a level."""
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
    """Return which samples are far from their neighbours; nothing where none is."""
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
    what = "1 output sample is an outlier" if total == 1 else f"{total} output samples are outliers"
    return f"{what} ({'; '.join(listed_times)}), up to {largest:.3g} away from the neighbours"


def _slow_pole(found: Identification, time_unit: str) -> str:
    """Return that a real pole is slow for the record; nothing where none is."""
    poles = found.fit.model.poles
    sizes = np.abs(poles[(poles.imag == 0.0) & (poles.real != 0.0)])
    longest = max(record.duration for record in found.records)
    if not sizes.size or sizes.min() * longest * SLOW >= 1.0:
        return ""
    what = f"A pole has a time constant of {1 / sizes.min():.4g} {time_unit}"
    return f"{what}: over a record of {longest:.4g} {time_unit} it is nearly indistinguishable from an integrator"


# --- what has no remedy ------------------------------------------------------------------------------


def _of_validation(found: Identification) -> Iterator[FitWarning]:
    fitted, other = found.fit.r2, found.validation
    if other is not None and (seen := found.seen_in_validation):
        what = f"{seen} of the {count(other.record.n_samples, 'sample')} of the validation record are those that"
        yield FitWarning(
            f"{what} the model was estimated from, so its fit there is no test; give a record without them"
        )
    if other is not None and other.r2 < 0.5 < fitted:
        what = f"The model explains {100 * fitted:.0f} % of the variance of the record it was estimated from, but only"
        yield FitWarning(f"{what} {100 * max(other.r2, 0.0):.0f} % of the validation record's: it does not carry over")


def _of_residuals(found: Identification, mended: set[Kind], time_unit: str) -> Iterator[str]:
    """What residuals and record show beside the model."""
    if not mended & {"structure", "delay", "hold"} and (what := _dependence(found, DEPENDENT)):
        yield f"{what}: {AHEAD if 'later values' in what else 'the model misses a part of the response'}"
    outliers = _outliers(found, time_unit)
    if outliers and "loss" not in mended:
        yield outliers
    share = max(saturated(record.y[record.valid]) for record in found.records)
    if share:
        where = f"{100 * share:.2g} % of the output samples lie exactly at the least or greatest value"
        yield f"{where}: if a limit of the sensor or the actuator cut them off, parameters and intervals are biased"
    fit, noisy = found.fit.linear, found.fit.noise is not None
    # Of residuals with outliers nothing else is told.
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
        seen = min(filter(None, dependences), key=lambda each: each.feedback_p_value, default=None)
        if seen is None or seen.feedback_share < FEEDBACK_SHARE:
            continue
        # Dynamics that are missed may leave something for later inputs to tell.
        if seen.feedback_p_value < min(FED_BACK, seen.pole_p_value):
            what = "The input follows earlier residuals" if acting is record else "The reference follows the output"
            where = f"{what} ({probability(seen.feedback_p_value)})"
            yield f"{where}, as in a loop, where noise biases the estimate, or as if the output is ahead of the input"


def _of_fit(fit: MeasuredFit, tried: Trials) -> Iterator[str]:
    """That a fit is low, and what did not raise it; with outliers it always is."""
    if fit.fit_percent < LOW_FIT and fit.weighting is None and fit.noise is None:
        what = f"The fit is {fit.fit_percent:.1f} %: {100 * (1 - fit.r2):.2g} % of the output's variance is left"
        words = (word for option in tried.without_gain for word in option.split())
        names = list(dict.fromkeys(word for word in words if word.startswith("--")))
        yield f"{what}; tried without gain: other values of {listed(names)}" if names else what


def _of_noise(fit: MeasuredFit) -> Iterator[str]:
    """That the estimate depends on how the noise is modelled."""
    if fit.noise is not None and fit.noise.differs:
        what = "The output-error fit and the fit with the noise model differ by more than chance gives"
        found = f"(Hausman's test, {probability(fit.noise.test.p_value)})"
        yield f"{what} {found}: the model of the plant or of the noise is too small"


def of_search(fit: MeasuredFit, time_unit: str) -> Iterator[str]:
    """How the search ended, where it did not end well."""
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
    if fit.status is Status.DELAY_AT_BOUND:
        names, delays = delay_names(fit), delays_of(fit.model)
        for name, delay in zip(names, delays, strict=True):
            if name in fit.parameter_names and not fit.tangent[fit.parameter_names.index(name)].any():
                where = f"end of its range, {delay:.4g} {time_unit}" if delay else "least possible, 0"
                of = f" of {name.removesuffix('_delay')}" * (len(names) > 1)
                yield f"The delay{of} is at the {where}, and has no standard error"


def of_lost_poles(fit: MeasuredFit) -> Iterator[str]:
    """That the model has fewer poles than were asked for."""
    if lost := fit.poles_at_infinity:
        gone = f"{'it has' if lost == 1 else 'they have'} run to infinity, where the cost is least"
        yield f"The model has {count(lost, 'pole')} fewer than asked for: {gone}"


def of_conditioning(fit: MeasuredFit, known: Uncertainty) -> Iterator[str]:
    """What the data do not determine."""
    _, hessian = free_directions(fit.linear)
    names: list[str] = []
    values: list[float] = []
    for column in fit.tangent.T:
        place = int(np.argmax(np.abs(column)))
        own = np.count_nonzero(column) == 1
        names.append(fit.parameter_names[place] if own else f"pole {len(names) + 1}")
        any_value = names[-1].startswith("a") and not fit.signs_known
        values.append(np.inf if any_value else fit.theta[place])
    told = describe_conditioning(known.free_covariance, np.array(values), names, condition_number(hessian), hessian)
    yield from (each.removesuffix(".") for each in told)


def _of_uncertainty(found: Identification, time_unit: str) -> Iterator[str]:
    """What the record does not determine, and intervals that cannot be trusted."""
    if slow := _slow_pole(found, time_unit):
        yield slow
    fit, uncertainty = found.fit, found.uncertainty
    yield from of_conditioning(fit, fit.uncertainty("white") if uncertainty.kind == "biased" else uncertainty)
    if uncertainty.short:
        worth = f"its {fit.count} samples are worth {uncertainty.effective_count:.2g} independent ones"
        size = len(uncertainty.free_covariance)
        yield f"The record is short for its noise: {worth}, the model has {size} parameters, and intervals are rough"
    if unsafe := unsafe_intervals(found):
        what = f"Intervals of {listed(unsafe)} are" if len(unsafe) > 1 else f"The interval of {unsafe[0]} is"
        yield f"{what} unsafe: so far from the estimate the output is not linear in the parameters"
    low, high = found.options.delay_bounds
    interval = None if isinstance(fit, MultiInputFit) else found.delay_interval
    # Below zero there is nothing left to search.
    ends = (
        [] if interval is None else [f"{low:g}"] * (interval.open_low and low > 0) + [f"{high:g}"] * interval.open_high
    )
    if ends:
        yield f"The interval of the delay reaches the end of its range ({' and '.join(ends)} {time_unit})"
    if len(found.tests) < len(fit.residuals) * len(delays_of(fit.model)):
        yield f"Fewer than {FEWEST_TESTED} residuals are too few to test; standard errors take them as white"
