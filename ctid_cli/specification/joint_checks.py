"""What is wrong with a specification although every section is right by itself."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from ctid_cli.canonical import canonical_json
from ctid_cli.custom_code import reason
from ctid_cli.errors import DataError, UsageError
from ctid_cli.estimation.common import Start, StartFrom
from ctid_cli.frequency.base import FrequencyEstimator
from ctid_cli.inference.monte_carlo import MEASURES, requested
from ctid_cli.kinds import KINDS
from ctid_cli.signals.sampling import GivenInstants, RegularSampling
from ctid_cli.signals.sinusoids import SineDisturbance, SumOfSinusoids
from ctid_cli.simulation.components import is_custom
from ctid_cli.simulation.frequency_measures import true_frequencies
from ctid_cli.simulation.start_points import additive_form
from ctid_cli.specification.custom_sections import CustomMeasureSection
from ctid_cli.specification.messages import Complaint
from ctid_cli.specification.sections import place_of
from ctid_cli.specification.spec import OF_DATA, Spec
from ctid_cli.specification.sweeps import (
    MAX_COMBINATIONS,
    Variant,
    case_count,
    known_variants,
    over,
    replaced,
    variants,
)
from ctid_cli.specification.system_sections import RelativeStart, StartsSection, UniformStart
from ctid_cli.specification.yaml_source import KeyPath

#: Samples, or clock periods of the input, of the longest record; ten times this would not fit in memory.
MAX_SAMPLES = 10_000_000
#: Data cells times estimators with each of their settings that an experiment may have.
MAX_SETTINGS = 1_000_000
#: Settings whose first data sets are tried.
MAX_TRIALS = 64
#: Success rules of systems and of signals.
_RULES_OF_SYSTEMS = ("delay_relative_error", "fit_percent", "parameter_relative_error")
_RULES_OF_SIGNALS = ("band", "by", "window")


# --------------------------------------------------------------------------------------------------------------------
# All sections together


def too_many_cases(spec: Spec) -> str:
    """Return why not even the combinations of a specification can be looked at; empty if they can."""
    cells = math.prod(case_count(getattr(spec, name)) for name in OF_DATA)
    estimators = sum(map(case_count, spec.estimators.values()))
    if cells > MAX_COMBINATIONS:
        return f"the lists combine to {cells} data cells, which are too many; at most {MAX_COMBINATIONS} are allowed"
    if cells * estimators > MAX_SETTINGS:
        product = f"{cells} data cells and {estimators} estimators with their settings combine to {cells * estimators}"
        return f"{product} cases, which are too many; at most {MAX_SETTINGS} are allowed"
    return ""


def joint_complaints(
    spec: Spec, broken: frozenset[str], trial: Callable[[Spec], Iterable[Complaint]], *, files_are_good: bool
) -> list[Complaint]:
    """Return what the sections of a specification have against each other, and what a trial of them shows."""
    found = list(_static_complaints(spec, broken, files_are_good=files_are_good))
    places = {path[0] for path, _ in found if path}
    of_data = {"data", *OF_DATA}
    # A wrong level of the noise, or a wrong estimator, leaves the rest to be tried.
    if files_are_good and not places & of_data - {"noise"}:
        faulty = {path[1] for path, _ in found if path[:1] == ("estimators",)}
        right = {name: section for name, section in spec.estimators.items() if name not in faulty}
        # Estimators would refuse a record for what is wrong with its sections.
        rest = replaced(spec, ("estimators",), {} if (places | broken) & of_data else right)
        found += trial(replaced(rest, ("noise",), None) if "noise" in places else rest)
    return found


def _static_complaints(spec: Spec, broken: frozenset[str], *, files_are_good: bool) -> Iterator[Complaint]:
    yield from _precision_complaints(spec, broken)
    yield from _same_estimators(spec)
    yield from _world_complaints(spec, broken)
    # A file of instants is read only once it is known to be good.
    samplings = spec.samplings if files_are_good or not hasattr(spec.sampling, "sha256") else []
    key = "duration" if hasattr(spec.sampling, "duration") else "samples"
    too_long = over({(): samplings}, partial(_too_long, ("sampling", key)))
    yield from too_long
    if spec.signal is not None:
        yield from () if too_long else _signal_complaints(spec)
        return
    records = extents(spec, samplings) if files_are_good else []
    open_loop = (spec.loop is None or has_relay(spec)) and not broken & {"loop", "data", "excitation"}
    yield from _estimator_complaints(spec, records, open_loop=open_loop)
    if spec.starts is not None:
        yield from _start_complaints(spec, spec.starts, broken)
    yield from _success_complaints(spec)
    yield from _data_complaints(spec, [] if too_long else records)


def _precision_complaints(spec: Spec, broken: frozenset[str]) -> Iterator[Complaint]:
    """Say which measures there are not, and which precision cannot be had."""
    seen: set[str] = set()
    for k, one in enumerate(spec.measures or ()):
        if isinstance(one, CustomMeasureSection):
            if one.name in seen | MEASURES.keys():
                yield ("measures", k), f"another measure is called {one.name!r}; give this one another name"
            seen.add(one.name)
            continue
        try:
            requested(one)
        except UsageError as error:
            yield ("measures", k), str(error)
    until = None if spec.monte_carlo is None else spec.monte_carlo.until
    place = ("monte_carlo", "until")
    if until is None:
        return
    if spec.data is not None:
        yield place, "a measured record is one data set; give runs: 1 in place of until and at_most"
        return
    if until.percent_half_width is not None and spec.success is None and "success" not in broken:
        yield (*place, "percent_half_width"), "is of the estimates that meet the success rule; add success"
    if until.rmse_relative is None or broken & {"system", "data"}:
        return
    if spec.system is None:
        yield (*place, "rmse_relative"), "needs the true values of a simulated system; use percent_half_width"
    elif spec.system.custom and not spec.system.truth:
        yield (*place, "rmse_relative"), "needs true values: system.truth: {gain: 1.0}"


def _same_estimators(spec: Spec) -> Iterator[Complaint]:
    """Say which estimators are the same."""
    seen: dict[str, str] = {}
    for name, section in spec.estimators.items():
        others = [seen.setdefault(canonical_json(variant.values), name) for variant in variants(section)]
        for other in [other for other in others if other != name][:1]:
            yield ("estimators", name), f"the same settings as {other!r}; its estimates would be the same too"


def _world_complaints(spec: Spec, broken: frozenset[str]) -> Iterator[Complaint]:
    """Say which estimators and success rules belong to the other kind of experiment."""
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


# --------------------------------------------------------------------------------------------------------------------
# Records, estimators, starts and success


@dataclass(frozen=True, eq=False)
class Extent:
    """How long a record is."""

    interval: float
    samples: int

    @property
    def duration(self) -> float:
        """Time from the first sample to the last [s]."""
        return self.interval * (self.samples - 1)


def extents(spec: Spec, samplings: Sequence[Variant]) -> list[Variant]:
    """Return how long the records are: the measured one, or one for each sampling."""
    if spec.measured is not None:
        record = spec.measured.dataset(0).record
        interval = record.duration / max(record.n_samples - 1, 1)
        return [Variant({}, {}, Extent(interval, record.n_samples))]
    return [Variant({}, case.swept, _extent_of(case.options)) for case in samplings]


def _extent_of(sampling: Any) -> Extent:
    """Return how long the records of a sampling scheme are; random intervals stand for themselves at their mean."""
    if not isinstance(sampling, GivenInstants):
        return Extent(sampling.mean_interval, sampling.length)
    times = sampling.times(np.random.default_rng(0))
    return Extent(float(np.ptp(times)) / (times.size - 1), times.size)


def _too_long(at: KeyPath, sampling: Any) -> Iterator[Complaint]:
    if sampling.length > MAX_SAMPLES:
        yield at, f"more than {MAX_SAMPLES} samples in a record are not supported"


def _of_greatest_delay(at: KeyPath, options: Any, extent: Extent) -> Iterator[Complaint]:
    """Say that the delay of an estimator may be as long as the record."""
    bounds = getattr(options, "delay_bounds", None)
    key, latest = ("delay", getattr(options, "delay", 0.0)) if bounds is None else ("delay_bounds", bounds[1])
    if latest >= extent.duration and latest > 0:
        yield (*at, key), f"a delay of {latest:g} s is not shorter than the record ({extent.duration:g} s); lower it"


def _estimator_complaints(spec: Spec, records: Sequence[Variant], *, open_loop: bool) -> Iterator[Complaint]:
    """Say what each estimator of a system has against the length of the record and the loop."""
    for name, section in spec.estimators.items():
        if section.custom or issubclass(section.target, FrequencyEstimator):
            continue
        at, cases = ("estimators", name), variants(section)
        yield from over({(): cases, ("sampling",): records}, partial(_of_greatest_delay, at))
        if open_loop:
            yield from over({(): cases}, partial(_of_instruments, at))


def _of_instruments(at: KeyPath, options: Any) -> Iterator[Complaint]:
    if getattr(options, "instruments", None) == "closed_loop":
        give = "give loop, or data.reference and loop.controller for a measured record"
        yield (*at, "instruments"), f"closed-loop instruments need the reference and the controller; {give}"


def _start_complaints(spec: Spec, starts: StartsSection, broken: frozenset[str]) -> Iterator[Complaint]:
    points, given = starts.initial_delay or [], starts.parameters or []
    random = [k for k, point in enumerate(points) if isinstance(point, UniformStart)]
    if random and spec.monte_carlo is None and "monte_carlo" not in broken:
        yield ("starts", "initial_delay", random[0]), "a random start needs a seed; add monte_carlo: {runs: 1, seed: 1}"
    for k, point in enumerate(points):
        ends = point.uniform if isinstance(point, UniformStart) else [point]
        refused = (_refused_starts(spec, ("starts", "initial_delay", k), Start(delay=end), "delay") for end in ends)
        yield from next(filter(None, map(list, refused)), [])
    drawn = [k for k, parameters in enumerate(given) if isinstance(parameters, RelativeStart)]
    for k, parameters in enumerate(given):
        path = ("starts", "parameters", k)
        if not isinstance(parameters, RelativeStart):
            yield from _refused_starts(spec, path, Start(model=parameters.options()), "parameters")
        elif k == drawn[0]:
            # All of them have the structure of the system.
            yield from _of_relative_start(spec, path)


def _of_relative_start(spec: Spec, path: KeyPath) -> Iterator[Complaint]:
    """Say what a start around the true parameters has against the system."""
    if spec.data is not None:
        yield path, "the parameters of a measured record are not known; give values: {additive: [submodels]}"
    elif spec.system is not None and spec.system.custom:
        yield path, "a custom system has no known structure; give values: {additive: [submodels]}"
    elif spec.system is not None:
        try:
            model = additive_form(variants(spec.system)[0].options)
        except DataError as error:
            yield path, f"the system cannot be written as a sum of submodels: {error}; give values: {{additive: …}}"
        else:
            yield from _refused_starts(spec, path, Start(model=model), "parameters")


def _refused_starts(spec: Spec, path: KeyPath, start: Start, start_from: StartFrom) -> Iterator[Complaint]:
    """Say which estimators cannot start from a delay or a model."""
    for name, section in spec.estimators.items():
        if not section.custom and getattr(section.target, "start_from", None) == start_from:
            yield from over({(): variants(section)}, partial(_refused_start, name, path, start))


def _refused_start(name: str, path: KeyPath, start: Start, estimator: Any) -> Iterator[Complaint]:
    try:
        estimator.check_start(start)
    except DataError as error:
        yield path, f"{error} (estimator {name!r})"


def _success_complaints(spec: Spec) -> Iterator[Complaint]:
    rule, other = spec.success, "use fit_percent, or leave it out"
    for name, unknown in (("delay_relative_error", "true values"), ("parameter_relative_error", "parameters")):
        if rule is None or getattr(rule, name) is None:
            continue
        path = ("success", name)
        if spec.data is not None:
            yield path, f"the {unknown} of a measured record are not known; {other}"
        elif spec.system is None:
            continue
        elif spec.system.custom:
            yield from _truth_complaints(path, spec.system.truth, name)
        elif name == "delay_relative_error":
            if 0.0 in np.atleast_1d(spec.system.delay):
                yield path, f"a relative error needs a true delay above zero; {other}"
        elif zero := [key for key, value in variants(spec.system)[0].options.parameters.items() if value == 0.0]:
            yield path, f"a relative error needs true parameters other than zero, and {zero[0]} is zero; leave it out"


def _truth_complaints(path: KeyPath, truth: Mapping[str, Any], rule: str) -> Iterator[Complaint]:
    """Say that a custom system does not say what is true of it."""
    names = ["delay"] if rule == "delay_relative_error" else [name for name in truth if name != "delay"]
    if not names or not truth.keys() >= set(names):
        yield path, f"needs true values: system.truth: {{{names[0] if names else 'gain'}: 1.0}}"
    elif zero := [name for name in names if truth[name] == 0.0]:
        yield path, f"a relative error needs true values other than zero, and {zero[0]} is zero"


# --------------------------------------------------------------------------------------------------------------------
# Simulation


def has_relay(spec: Spec) -> bool:
    """Return whether a relay closes the loop: to estimators the record is one in open loop."""
    return spec.loop is not None and hasattr(spec.loop.controller, "relay")


def _data_complaints(spec: Spec, records: Sequence[Variant]) -> Iterator[Complaint]:
    """Say what the sections that data are made from have against each other."""
    yield from over({("system",): known_variants(spec.system), ("sampling",): records}, _of_delay)
    if spec.generator is not None and spec.data is None:
        place, section = spec.generator
        yield from over({place: known_variants(section), ("sampling",): records}, partial(_of_clock_periods, place))
    if spec.loop is None:
        return
    if spec.data is not None:
        if has_relay(spec):
            yield ("loop",), "a relay is for simulated data; leave the loop out, the record of its input says enough"
        return
    if spec.system is not None and spec.system.custom:
        yield ("system", "kind"), "a loop needs a transfer function in it; give excitation in place of loop"
    yield from over({(): known_variants(spec.noise)}, _of_ratio)
    if any(not isinstance(variant.options, RegularSampling) for variant in variants(spec.sampling)):
        yield ("sampling", "kind"), "must be regular in a loop: the controller is discrete and acts at every sample"


def _of_delay(system: Any, extent: Extent) -> Iterator[Complaint]:
    if system.delay >= extent.duration:
        yield ("system", "delay"), f"{system.delay:g} s is not shorter than the record ({extent.duration:g} s)"


def _of_clock_periods(at: KeyPath, excitation: Any, extent: Extent) -> Iterator[Complaint]:
    clock = getattr(excitation, "clock_period", None)
    if clock is not None and extent.duration / clock > MAX_SAMPLES:
        message = f"a record of {extent.duration:g} s has more than {MAX_SAMPLES} clock periods of {clock:g} s"
        yield (*at, "clock_period"), message


def _of_ratio(noise: Any) -> Iterator[Complaint]:
    if noise.snr_db is not None:
        other = ", or its innovation_variance" if hasattr(noise, "innovation_variance") else ""
        yield ("noise", "snr_db"), f"in a loop the noise feeds back into the output; give the noise's variance{other}"


# --------------------------------------------------------------------------------------------------------------------
# Frequencies of a signal


def _signal_complaints(spec: Spec) -> Iterator[Complaint]:
    """Say what the sections of an experiment on a signal have against each other."""
    clocks = variants(spec.sampling)
    if any(not isinstance(clock.options, RegularSampling) for clock in clocks):
        yield ("sampling", "kind"), "must be regular: estimators of frequencies compare samples at fixed delays"
        return
    signals = variants(spec.signal)
    yield from over({("signal",): signals, ("sampling",): clocks}, partial(_of_tone_clock, spec))
    disturbances = [case.options for case in variants(spec.disturbance)] or [None]
    for name, section in spec.estimators.items():
        at, cases = ("estimators", name), variants(section)
        if isinstance(cases[0].options, FrequencyEstimator):
            yield from over({(): cases, ("sampling",): clocks}, partial(_of_estimator, at))
            yield from over({(): cases, ("signal",): signals[:1]}, partial(_of_tones, at, disturbances))


def _of_tones(at: KeyPath, disturbances: list[Any], options: Any, signal: SumOfSinusoids) -> Iterator[Complaint]:
    try:
        for disturbance in disturbances:
            true_frequencies(signal, disturbance, options.tones, np.zeros(1))
    except ValueError:
        sine = any(isinstance(item, SineDisturbance) for item in disturbances)
        more = ", or one more for the sinusoid that disturbs it" if sine else ""
        yield (*at, "tones"), f"must be {len(signal.tones)}, as many as the signal has{more}, not {options.tones}"


def _of_tone_clock(spec: Spec, signal: SumOfSinusoids, clock: RegularSampling) -> Iterator[Complaint]:
    interval = float(clock.interval)
    duration = interval * clock.samples
    highest, limit = signal.highest_frequency, math.pi / interval
    if highest >= limit:
        yield ("sampling", "interval"), f"shows frequencies below {limit:.4g} rad/s only, the signal has {highest:g}"
    for step in signal.steps:
        if step >= duration - interval:
            yield ("signal", "tones"), f"a step at {step:g} s comes after the last sample, {duration - interval:g} s"
    low, high = getattr(spec.success, "window", None) or (0.0, duration)
    if high > duration * (1 + 1e-9) or high - low < interval:
        yield ("success", "window"), f"must hold samples of the record, which ends at {duration:g} s"
    by = getattr(spec.success, "by", None) or 0.0
    if by > duration:
        yield ("success", "by"), f"{by:g} s come after the end of the record, {duration:g} s"


def _of_estimator(at: KeyPath, options: Any, clock: RegularSampling) -> Iterator[Complaint]:
    try:
        with np.errstate(all="ignore"):
            options.check(clock.samples, clock.interval)
    except ArithmeticError:
        yield at, "these values are too large or too small to compute with"
    except (ValueError, DataError) as error:
        yield (*at, *place_of(error, vars(options))), str(error)
    except Exception as error:
        if not is_custom(options):
            raise
        yield (*at, "kind"), f"cannot check these options: {reason(error)}"
