"""Errors of a specification in which every section is valid on its own, and warnings about questionable settings."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from ctid_cli.arrays import ComplexArray
from ctid_cli.canonical import canonical_json
from ctid_cli.custom_code import reason
from ctid_cli.errors import DataError, UsageError
from ctid_cli.estimation.common import Start
from ctid_cli.frequency.base import FrequencyEstimator
from ctid_cli.inference.monte_carlo import MEASURES, requested
from ctid_cli.kinds import KINDS
from ctid_cli.models.controller import Relay
from ctid_cli.models.several_inputs import is_delay
from ctid_cli.models.transfer_function import TransferFunction, cancelled
from ctid_cli.signals.noise import stream
from ctid_cli.signals.sampling import RegularSampling
from ctid_cli.signals.sinusoids import SineDisturbance
from ctid_cli.simulation.components import is_custom
from ctid_cli.simulation.dataset import located
from ctid_cli.simulation.start_points import additive_form
from ctid_cli.specification import sweeps
from ctid_cli.specification.custom_sections import CustomMeasureSection
from ctid_cli.specification.messages import Violation
from ctid_cli.specification.sections import former_options, place_of
from ctid_cli.specification.spec import OF_DATA, Spec
from ctid_cli.specification.sweeps import Case, Cases
from ctid_cli.specification.system_sections import RelativeStart, UniformStart, truth_of
from ctid_cli.specification.yaml_source import KeyPath

#: Maximum number of samples, or clock periods of the input, of a record; ten times this would not fit in memory.
MAX_SAMPLES = 10_000_000
#: Maximum number of data cells times estimator settings of an experiment.
MAX_SETTINGS = 1_000_000
#: Maximum number of settings whose first data sets are tried.
MAX_TRIALS = 64
#: Minimum record length beyond the delay, in time constants of the slowest pole: in shorter records the standard
#: error of the pole grows much faster than it would fall with the number of samples in longer ones.
TIME_CONSTANTS = 3.0
#: Input edges within this fraction of the sampling interval of a sample count as simultaneous with it.
ON_TIME = 1e-6
#: Warning about an option without an effect.
FORMER = "has no effect any more; it only keeps the ids of estimates that were stored with it"
#: Success rules of systems and of signals.
_RULES_OF_SYSTEMS = ("delay_relative_error", "fit_percent", "parameter_relative_error")
_RULES_OF_SIGNALS = ("band", "by", "window")


# --------------------------------------------------------------------------------------------------------------------
# All sections


def too_many_cases(spec: Spec) -> str:
    """Return why a specification has too many combinations to check; empty if it does not."""
    cells = math.prod(map(sweeps.case_count, spec.of_data.values()))
    estimators = sum(map(sweeps.case_count, spec.estimators.values()))
    if cells > (most := sweeps.MAX_COMBINATIONS):
        return f"the lists combine to {cells} data cells, which are too many; at most {most} are allowed"
    if cells * estimators > MAX_SETTINGS:
        product = f"{cells} data cells and {estimators} estimators with their settings combine to {cells * estimators}"
        return f"{product} cases, which are too many; at most {MAX_SETTINGS} are allowed"
    return ""


def joint_violations(
    spec: Spec, broken: frozenset[str], trial: Callable[[Spec], Iterable[Violation]], *, files_are_good: bool
) -> list[Violation]:
    """Return the contradictions between sections of a specification, and the problems found by a trial."""
    found = [*_of_names(spec), *_of_missing(spec, broken), *_of_kinds(spec, broken)]
    cases = cases_of(spec, files_are_good=files_are_good)
    too_long = list(sweeps.checked(cases, (_of_length,)))
    usable = {name: given for name, given in cases.items() if not too_long or name not in ("sampling", "duration")}
    found += [*too_long, *sweeps.checked(usable, CHECKS)]
    places = {path[0] for path, _ in found if path}
    of_data = {"data", "inputs", *OF_DATA}
    # A wrong noise level or estimator does not prevent a trial of the rest.
    if files_are_good and not places & of_data - {"noise"}:
        faulty = {path[1] for path, _ in found if path[:1] == ("estimators",)}
        right = {name: section for name, section in spec.estimators.items() if name not in faulty}
        # Otherwise estimators would refuse a record because of errors in its sections.
        rest = sweeps.replaced(spec, ("estimators",), {} if (places | broken) & of_data else right)
        found += trial(sweeps.replaced(rest, ("noise",), None) if "noise" in places else rest)
    return found


def cases_of(spec: Spec, *, files_are_good: bool = True) -> Cases:
    """Return the cases for the checks of a specification: options of sections, and values derived from them.

    There are no cases for missing sections and custom components, whose options have no known meaning.
    """
    on_signal = spec.signal is not None
    found: dict[str, dict[KeyPath, list[Case]]]
    found = {name: {(name,): []} for name in OF_DATA}
    for path, section in spec.of_data.items():
        found[str(path[-1])][path] = _cases(spec, path, section)
    if (hasattr(spec.sampling, "sha256") and not files_are_good) or (on_signal and not _is_regular(spec)):
        found["sampling"] = {}
    if spec.disturbance is None:
        found["disturbance"] = {("disturbance",): [(None, {})]}
    # The loop, if any, that may stabilise an unstable system.
    found["feedback"] = {("loop",): [(None, {})]} if spec.loop is None else found["loop"]
    found["generator"] = {path: _cases(spec, path, section) for path, section in spec.generators.items()}
    found["truth"] = {
        path: [(truth_of(one), sweeps.swept_in({path: one})) for one in sweeps.variants(section)]
        for path, section in spec.of_data.items()
        if path[-1] == "system"
    }
    if spec.measured is not None and files_are_good:
        found["duration"] = {("data",): [(spec.measured.dataset(0).record.duration, {})]}
    for cases in found["sampling"].values():
        key = next((key for key in ("duration", "times", "file") if hasattr(spec.sampling, key)), "samples")
        found["length"] = {("sampling", key): [(one.length, swept) for one, swept in cases]}
        lasting = [((one.length - 1) * one.mean_interval, swept) for one, swept in cases]
        found.setdefault("duration", {("sampling", key): lasting})
    found["estimator"] = {
        ("estimators", name): _cases(spec, ("estimators", name), section, custom=on_signal)
        for name, section in spec.estimators.items()
        if issubclass(section.target, FrequencyEstimator) is on_signal
    }
    by_name = found["estimator"].items()
    found["named"] = {at: [((at[1], options), swept) for options, swept in cases] for at, cases in by_name}
    return {**found, **_single_cases(spec)}


def _cases(spec: Spec, place: KeyPath, section: Any, *, custom: bool = False) -> list[Case]:
    """Return the options of a section with their swept values by place."""
    if section is None or (section.custom and not custom):
        return []
    return [(located(one.options, spec.folder), sweeps.swept_in({place: one})) for one in sweeps.variants(section)]


def _single_cases(spec: Spec) -> dict[str, dict[KeyPath, list[Case]]]:
    """Return the cases of sections without swept values."""
    given: list[tuple[str, KeyPath, Any]] = [(name, (name,), getattr(spec, name)) for name in ("data", "success")]
    given.append(("monte_carlo", ("monte_carlo",), spec.monte_carlo))
    given.append(("seed", ("monte_carlo", "seed"), getattr(spec.monte_carlo, "seed", 0)))
    given.append(("until", ("monte_carlo", "until"), getattr(spec.monte_carlo, "until", None)))
    custom_system = spec.system if getattr(spec.system, "custom", False) else None
    given.append(("custom_system", ("system",), custom_system))
    for k, delay in enumerate(getattr(spec.starts, "initial_delay", None) or ()):
        ends = delay.uniform if isinstance(delay, UniformStart) else [delay]
        given.append(("start", ("starts", "initial_delay", k), [Start(delay=end) for end in ends]))
    for k, start in enumerate(getattr(spec.starts, "parameters", None) or ()):
        drawn = isinstance(start, RelativeStart)
        name, value = ("relative_start", start) if drawn else ("start", [Start(model=start.options())])
        given.append((name, ("starts", "parameters", k), value))
    found: dict[str, dict[KeyPath, list[Case]]] = {}
    for name, place, value in given:
        if value is not None:
            found.setdefault(name, {})[place] = [(value, {})]
    # All random parameters have the structure of the system.
    found["relative_start"] = dict(list(found.get("relative_start", {}).items())[:1])
    return found


# --------------------------------------------------------------------------------------------------------------------
# Names and missing sections


def _of_names(spec: Spec) -> Iterator[Violation]:
    """Yield unknown and duplicate measures."""
    names: set[str] = set()
    for k, one in enumerate(spec.measures or ()):
        if isinstance(one, CustomMeasureSection):
            if one.name in names | MEASURES.keys():
                yield ("measures", k), f"another measure is called {one.name!r}; give this one another name"
            names.add(one.name)
            continue
        try:
            requested(one)
        except UsageError as error:
            yield ("measures", k), str(error)
    seen: dict[str, str] = {}
    for name, section in spec.estimators.items():
        others = [seen.setdefault(canonical_json(variant.values), name) for variant in sweeps.variants(section)]
        for other in [other for other in others if other != name][:1]:
            yield ("estimators", name), f"the same settings as {other!r}; its estimates would be the same too"


def _of_missing(spec: Spec, broken: frozenset[str]) -> Iterator[Violation]:
    """Yield missing sections, except those that are present but invalid."""
    place = ("monte_carlo", "until", "percent_half_width")
    until = None if spec.monte_carlo is None or spec.data is not None else spec.monte_carlo.until
    if until is not None and until.percent_half_width is not None and not spec.success and "success" not in broken:
        yield place, "is of the estimates that meet the success rule; add success"
    delays = (spec.starts.initial_delay if spec.starts is not None else None) or []
    random = [k for k, point in enumerate(delays) if isinstance(point, UniformStart)]
    if random and spec.monte_carlo is None and "monte_carlo" not in broken:
        yield ("starts", "initial_delay", random[0]), "a random start needs a seed; add monte_carlo: {runs: 1, seed: 1}"
    relay = spec.loop is not None and any(hasattr(spec.loop.controller, form) for form in ("relay", "unknown"))
    # For estimators, a record from a relay loop is an open-loop record.
    if spec.signal is None and (spec.loop is None or relay) and not broken & {"loop", "data", "excitation"}:
        give = "give loop, or data.reference and loop.controller for a measured record"
        message = f"closed-loop instruments need the reference and the controller; {give}"
        for name, section in spec.estimators.items():
            instruments = [] if section.custom else np.atleast_1d(getattr(section, "instruments", "open_loop")).tolist()
            if "closed_loop" in instruments:
                yield ("estimators", name, "instruments"), message
    if spec.data is None and not _is_regular(spec):
        if spec.signal is not None:
            yield ("sampling", "kind"), "must be regular: estimators of frequencies compare samples at fixed delays"
        elif spec.loop is not None and not hasattr(spec.loop.controller, "continuous"):
            yield ("sampling", "kind"), "must be regular in a loop: the controller is discrete and acts at every sample"


def _of_kinds(spec: Spec, broken: frozenset[str]) -> Iterator[Violation]:
    """Yield estimators and success rules that belong to the other kind of experiment."""
    on_signal = spec.signal is not None
    if not on_signal and ("signal" in broken or (spec.system is None and spec.data is None)):
        return
    wanted = "frequency_estimator" if on_signal else "estimator"
    here, does = "a signal; allowed:", "identifies a system from its input and output"
    if not on_signal:
        here, does = "a system; give signal, or one of", "estimates the frequencies of a signal"
    for name, section in spec.estimators.items():
        if issubclass(section.target, FrequencyEstimator) is not on_signal:
            message = f"{section.kind} {does}, and this experiment has {here} {', '.join(KINDS[wanted])}"
            yield ("estimators", name, "kind"), message
    for name in _RULES_OF_SYSTEMS if on_signal else _RULES_OF_SIGNALS:
        if getattr(spec.success, name, None) is not None:
            other = "a signal has none of it; use band and by" if on_signal else "is about the frequencies of a signal"
            yield ("success", name), f"{other}, or leave it out"


def _is_regular(spec: Spec) -> bool:
    return spec.sampling is None or spec.sampling.target is RegularSampling


# --------------------------------------------------------------------------------------------------------------------
# Records and loops


def _of_length(length: int) -> Iterator[Violation]:
    if length > MAX_SAMPLES:
        yield ("length",), f"more than {MAX_SAMPLES} samples in a record are not supported"


def _of_delay(system: Any, duration: float) -> Iterator[Violation]:
    if system.delay >= duration:
        yield ("system", "delay"), f"{system.delay:g} s is not shorter than the record ({duration:g} s)"


def _of_greatest_delay(estimator: Any, duration: float) -> Iterator[Violation]:
    bounds = getattr(estimator, "delay_bounds", None)
    key, latest = ("delay", getattr(estimator, "delay", 0.0)) if bounds is None else ("delay_bounds", bounds[1])
    if latest >= duration and latest > 0:
        text = f"a delay of {latest:g} s is not shorter than the record ({duration:g} s); lower it"
        yield ("estimator", key), text


def _of_clock_periods(generator: Any, duration: float) -> Iterator[Violation]:
    clock = getattr(generator, "clock_period", None)
    if clock is not None and duration / clock > MAX_SAMPLES:
        message = f"a record of {duration:g} s has more than {MAX_SAMPLES} clock periods of {clock:g} s"
        yield ("generator", "clock_period"), message


def _of_ratio(loop: Any, noise: Any) -> Iterator[Violation]:
    if noise.snr_db is not None:
        other = ", or its innovation_variance" if hasattr(noise, "innovation_variance") else ""
        yield ("noise", "snr_db"), f"in a loop the noise feeds back into the output; give the noise's variance{other}"


def _of_relay(loop: Any, data: Any) -> Iterator[Violation]:
    if isinstance(loop.controller, Relay):
        yield ("loop",), "a relay is for simulated data; leave the loop out, the record of its input says enough"


def _of_unstable_system(feedback: Any, system: Any) -> Iterator[Violation]:
    """Yield an unstable system without a linear loop; a trial shows whether a loop stabilises it."""
    if feedback is not None and not isinstance(feedback.controller, Relay):
        return
    if isinstance(system, TransferFunction):
        if not system.is_stable:
            yield ("system",), f"the system is unstable and cannot be simulated: {_unstable(system.poles)}"
        return
    for k, submodel in enumerate(system.submodels):
        if not submodel.is_stable:
            # Poles at the origin are declared as integrators, which can be simulated.
            poles = submodel.poles[submodel.poles != 0]
            place = ("system", "additive", k)
            yield place, f"the submodel is unstable and cannot be simulated: {_unstable(poles)}"


def _unstable(poles: ComplexArray) -> str:
    offending = [
        f"{pole.real:.4g}{pole.imag:+.4g}j" if pole.imag else f"{pole.real:.4g}" for pole in poles if not pole.real < 0
    ]
    noun = "pole" if len(offending) == 1 else "poles"
    remedy = "every pole needs a negative real part, or a loop around it"
    return f"{noun} at {', '.join(offending)} rad/s; {remedy}"


def _of_custom_system(loop: Any, custom_system: Any) -> Iterator[Violation]:
    yield ("system", "kind"), "a loop needs a transfer function in it; give excitation in place of loop"


# --------------------------------------------------------------------------------------------------------------------
# Starts and true values


def _of_start(start: Sequence[Start], named: tuple[str, Any]) -> Iterator[Violation]:
    name, estimator = named
    for one in start:
        if getattr(estimator, "start_from", None) == ("delay" if one.model is None else "parameters"):
            try:
                estimator.check_start(one)
            except DataError as error:
                yield ("start",), f"{error} (estimator {name!r})"
                return


def _of_relative_start(relative_start: Any, system: Any, named: tuple[str, Any]) -> Iterator[Violation]:
    try:
        model = additive_form(system)
    except DataError as error:
        text = f"the system cannot be written as a sum of submodels: {error}; give values: {{additive: …}}"
        yield ("relative_start",), text
    else:
        yield from ((("relative_start",), text) for _, text in _of_start([Start(model=model)], named))


def _of_unknown_parameters(relative_start: Any, data: Any) -> Iterator[Violation]:
    unknown = "the parameters of a measured record are not known"
    yield ("relative_start",), f"{unknown}; give values: {{additive: [submodels]}}"


def _of_unknown_structure(relative_start: Any, custom_system: Any) -> Iterator[Violation]:
    yield ("relative_start",), "a custom system has no known structure; give values: {additive: [submodels]}"


def _of_relative_errors(success: Any, truth: Mapping[str, float]) -> Iterator[Violation]:
    delays = [name for name in truth if is_delay(name)]
    rules = {"delay_relative_error": delays or ["delay"], "parameter_relative_error": [*truth.keys() - {*delays}]}
    for rule, names in rules.items():
        if getattr(success, rule) is None:
            continue
        if not names or not truth.keys() >= set(names):
            yield ("success", rule), f"needs true values: system.truth: {{{names[0] if names else 'gain'}: 1.0}}"
        elif zero := sorted(name for name in names if truth[name] == 0.0):
            text = f"a relative error needs true values other than zero, and {zero[0]} is zero"
            yield ("success", rule), f"{text}; use fit_percent, or leave it out"


def _of_unknown_values(success: Any, data: Any) -> Iterator[Violation]:
    for rule, unknown in (("delay_relative_error", "true values"), ("parameter_relative_error", "parameters")):
        if getattr(success, rule) is not None:
            text = f"the {unknown} of a measured record are not known; use fit_percent, or leave it out"
            yield ("success", rule), text


def _of_one_record(until: Any, data: Any) -> Iterator[Violation]:
    yield ("until",), "a measured record is one data set; give runs: 1 in place of until and at_most"


def _of_error_of_a_signal(until: Any, signal: Any) -> Iterator[Violation]:
    if until.rmse_relative is not None:
        yield ("until", "rmse_relative"), "needs the true values of a simulated system; use percent_half_width"


def _of_error(until: Any, truth: Mapping[str, float]) -> Iterator[Violation]:
    if until.rmse_relative is not None and not truth:
        yield ("until", "rmse_relative"), "needs true values: system.truth: {gain: 1.0}"


# --------------------------------------------------------------------------------------------------------------------
# Frequencies of a signal


def _of_frequencies(signal: Any, sampling: Any) -> Iterator[Violation]:
    highest, limit = signal.highest_frequency, math.pi / sampling.mean_interval
    if highest >= limit:
        yield ("sampling", "interval"), f"shows frequencies below {limit:.4g} rad/s only, the signal has {highest:g}"


def _of_steps(signal: Any, duration: float) -> Iterator[Violation]:
    for step in signal.steps:
        if step >= duration:
            yield ("signal", "tones"), f"a step at {step:g} s comes after the last sample, {duration:g} s"


def _of_times(success: Any, signal: Any, sampling: Any) -> Iterator[Violation]:
    duration = sampling.mean_interval * sampling.length
    low, high = success.window or (0.0, duration)
    if high > duration * (1 + 1e-9) or high - low < sampling.mean_interval:
        yield ("success", "window"), f"must hold samples of the record, which ends at {duration:g} s"
    if success.by is not None and success.by > duration:
        yield ("success", "by"), f"{success.by:g} s come after the end of the record, {duration:g} s"


def _of_tones(estimator: Any, signal: Any, disturbance: Any) -> Iterator[Violation]:
    count, sine = len(signal.tones), isinstance(disturbance, SineDisturbance)
    if estimator.tones != count and not (sine and estimator.tones == count + 1):
        more = ", or one more for the sinusoid that disturbs it" if sine else ""
        yield ("estimator", "tones"), f"must be {count}, as many as the signal has{more}, not {estimator.tones}"


def _of_options(estimator: Any, signal: Any, sampling: Any) -> Iterator[Violation]:
    try:
        with np.errstate(all="ignore"):
            estimator.check(sampling.samples, sampling.interval)
    except ArithmeticError:
        yield ("estimator",), "these values are too large or too small to compute with"
    except (ValueError, DataError) as error:
        yield ("estimator", *place_of(error, vars(estimator))), str(error)
    except Exception as error:
        if not is_custom(estimator):
            raise
        yield ("estimator", "kind"), f"cannot check these options: {reason(error)}"


CHECKS = (
    *(
        _of_delay,
        _of_greatest_delay,
        _of_clock_periods,
        _of_ratio,
        _of_relay,
        _of_unstable_system,
        _of_custom_system,
    ),
    *(_of_start, _of_relative_start, _of_unknown_parameters, _of_unknown_structure),
    *(_of_relative_errors, _of_unknown_values, _of_one_record, _of_error_of_a_signal, _of_error),
    *(_of_frequencies, _of_steps, _of_times, _of_tones, _of_options),
)


# --------------------------------------------------------------------------------------------------------------------
# Warnings about valid but questionable settings


def joint_warnings(spec: Spec) -> list[Violation]:
    """Return the warnings."""
    cases = cases_of(spec)
    warnings = [*sweeps.checked(cases, WARNINGS), *sweeps.checked(cases, (_of_sampled_input,), MAX_TRIALS)]
    for name, section in spec.estimators.items():
        for option, (_, default) in former_options(section.target).items():
            if getattr(section, option) != default:
                place = ("estimators", name, option)
                warnings.append((place, FORMER))
    if spec.starts is not None:
        first = [sweeps.variants(section)[0].options for section in spec.estimators.values()]
        taken = {getattr(options, "start_from", None) for options in first}
        for name, kind in (("initial_delay", "delay"), ("parameters", "parameters")):
            if getattr(spec.starts, name) and kind not in taken:
                warnings.append((("starts", name), "no estimator here uses a start of this kind; each is run once"))
    return warnings


def _of_runs(monte_carlo: Any, data: Any) -> Iterator[Violation]:
    if monte_carlo.most > 1:
        yield ("monte_carlo", "runs"), "a measured record is one data set; it is run once"


def _of_slow_sampling(system: Any, sampling: Any) -> Iterator[Violation]:
    interval, fastest = sampling.mean_interval, float(np.abs(system.poles).max(initial=0.0))
    if interval * fastest > math.pi:
        slow = f"sampling every {interval:g} s is slower than twice the fastest pole ({fastest:.4g} rad/s)"
        key = ("interval",) if hasattr(sampling, "interval") else ()
        yield ("sampling", *key), f"{slow}; intervals below {math.pi / fastest:.4g} s see it"


def _of_short_record(system: Any, duration: float) -> Iterator[Violation]:
    # A lightly damped mode is visible within one period, long before it has decayed.
    frequencies = np.abs(system.poles)
    slowest = float(1.0 / frequencies[frequencies > 0.0].min(initial=math.inf))
    needed = float(system.delay + TIME_CONSTANTS * slowest)
    if duration < needed:
        delayed = f", {system.delay:g} s of it delay," if system.delay else ""
        short = f"a record of {duration:.4g} s{delayed} shows little of the slowest pole"
        cure = f"it must last {needed:.3g} s or more"
        yield ("duration",), f"{short}, whose time constant is {slowest:.4g} s; {cure}"


def _of_cancellation(system: Any) -> Iterator[Violation]:
    for part in getattr(system, "submodels", [system] if isinstance(system, TransferFunction) else []):
        if place := cancelled(part.numerator, part.denominator):
            cure = "leave both out, unless that is the point"
            yield ("system",), f"a zero cancels the pole at s = {place}, so that no data determine either; {cure}"


def _of_sampled_input(excitation: Any, sampling: Any, seed: int) -> Iterator[Violation]:
    if sampling.input_record != "sampled":
        return
    try:
        times = sampling.times(stream(seed, "sampling", 0))
        applied = excitation.generate(times, stream(seed, "input", 0))
    except DataError as error:  # in a case that was not tried
        yield ("excitation",), f"{error}; estimates of such data sets are stored as FAILED"
        return
    if applied.hold != "zoh":
        return
    edges = applied.t[1:][np.diff(applied.values) != 0.0]
    edges = edges[edges < times[-1]]
    interval = sampling.mean_interval
    late = times[np.searchsorted(times, edges - ON_TIME * interval)] - edges
    if late.size and late.mean() > ON_TIME * interval:
        seen = f"the estimator sees the input at its samples only, each change {late.mean():.2g} s late on average"
        biased = "which biases delay and parameters; write input_record: exact, unless that is the point"
        yield ("sampling", "input_record"), f"{seen}, {biased}"


def _of_white_formula(noise: Any, estimator: Any) -> Iterator[Violation]:
    if getattr(noise, "coloured", False) and getattr(estimator, "covariance", "") == "white":
        short = "is for white noise and the noise is coloured, so that the intervals are too short or too long"
        yield ("estimator", "covariance"), f"{short}; write covariance: auto, unless that is the point"


def _of_whole_record(estimator: Any, signal: Any) -> Iterator[Violation]:
    if estimator.whole_record and signal.frequency_steps:
        yield ("estimator", "kind"), "gives one estimate of the whole record, in which a frequency steps"


def _of_warnings(estimator: Any, signal: Any, sampling: Any) -> Iterator[Violation]:
    for name, text in estimator.warnings(sampling.interval, signal.highest_frequency):
        yield ("estimator", name), text


def _of_loose_rules(success: Any) -> Iterator[Violation]:
    for rule in ("delay_relative_error", "parameter_relative_error"):
        value = getattr(success, rule)
        if value is not None and value >= 1.0:
            yield ("success", rule), f"{value:g} is {100 * value:g} %; {value:g} % is {value / 100:g}"


WARNINGS = (
    *(_of_runs, _of_slow_sampling, _of_short_record, _of_cancellation),
    *(_of_white_formula, _of_whole_record, _of_warnings, _of_loose_rules),
)
