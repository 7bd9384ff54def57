"""What is wrong with a specification although every section is right by itself."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError
from ctid_cli.kinds import KINDS
from ctid_cli.models.additive import AdditiveModel, Term
from ctid_cli.models.controller import Relay
from ctid_cli.models.factoring import unfactored
from ctid_cli.signals.sampling import RegularSampling
from ctid_cli.signals.streams import stream
from ctid_cli.simulation.dataset import LoopOptions, located
from ctid_cli.specification.messages import Complaint
from ctid_cli.specification.sections import MAX_COMBINATIONS, Section, Variant, case_count, over, variants
from ctid_cli.specification.signal_checks import signal_complaints, world_complaints
from ctid_cli.specification.spec import OF_DATA, Spec
from ctid_cli.specification.start_points import additive_form
from ctid_cli.specification.start_sections import RelativeStart, StartsSection, UniformStart
from ctid_cli.specification.yaml_source import KeyPath

#: Samples, or clock periods of the input, of the longest record; ten times this would not fit in memory.
MAX_SAMPLES = 10_000_000
#: Data cells times estimators with each of their settings that an experiment may have.
MAX_SETTINGS = 1_000_000
#: Combinations that are tried when a specification is checked, of sections whose faults show only together.
MAX_TRIALS = 64


@dataclass(frozen=True, eq=False)
class Extent:
    """How long a record is, and how many of its samples are left after a delay."""

    interval: float
    samples: int
    #: Instants of the samples of a measured record [s].
    times: Array | None = None
    sampling: Any = None

    @property
    def duration(self) -> float:
        """Time from the first sample to the last [s]."""
        return self.interval * (self.samples - 1)

    def samples_after(self, delay: float) -> int:
        """How many samples a delay [s] leaves."""
        if self.times is not None:
            return int(np.count_nonzero(self.times >= delay))
        return max(self.samples - math.ceil(delay / self.interval), 0)


def too_many_cases(spec: Spec) -> str:
    """Why not even the combinations of a specification can be looked at; empty if they can."""
    cells = math.prod(case_count(getattr(spec, name)) for name in OF_DATA)
    estimators = sum(map(case_count, spec.estimators.values()))
    if cells > MAX_COMBINATIONS:
        return f"the lists combine to {cells} data cells, which are too many; at most {MAX_COMBINATIONS} are allowed"
    if cells * estimators > MAX_SETTINGS:
        product = f"{cells} data cells and {estimators} estimators with their settings combine to {cells * estimators}"
        return f"{product} cases, which are too many; at most {MAX_SETTINGS} are allowed"
    return ""


def joint_complaints(spec: Spec, broken: frozenset[str], *, files_are_good: bool) -> Iterator[Complaint]:
    """What the sections of a specification have against each other."""
    yield from world_complaints(spec, broken)
    samplings = variants(spec.sampling)
    key = "duration" if hasattr(spec.sampling, "duration") else "samples"
    of_ours = [] if getattr(spec.sampling, "own", False) else samplings
    too_long = over({(): of_ours}, partial(_too_long, ("sampling", key)))
    if spec.signal is not None:
        yield from too_long or signal_complaints(spec)
        return
    records = extents(spec, samplings) if files_are_good else []
    open_loop = (spec.loop is None or has_relay(spec)) and not broken & {"loop", "data", "excitation"}
    yield from _estimator_complaints(spec, records, open_loop=open_loop)
    if spec.starts is not None:
        yield from _start_complaints(spec, spec.starts, broken)
    yield from _success_complaints(spec)
    if spec.loop is not None and spec.data is None:
        yield from _loop_complaints(spec, spec.loop)
    elif has_relay(spec):
        yield ("loop",), "a relay is for simulated data; leave the loop out, the record of its input says enough"
    if files_are_good:
        yield from too_long or _simulation_complaints(spec, records)


# --------------------------------------------------------------------------------------------------------------------
# Length of the records


def extents(spec: Spec, samplings: Sequence[Variant]) -> list[Variant]:
    """How long the records are: the measured one, or one for each sampling."""
    if spec.measured is not None:
        record = spec.measured.dataset(0).record
        interval = record.duration / max(record.n_samples - 1, 1)
        return [Variant({}, {}, Extent(interval, record.n_samples, (record.t - record.t[0])[record.valid]))]
    # What is one's own is asked in a worker process only, before the run.
    if getattr(spec.sampling, "own", False):
        return []
    # Random intervals stand for themselves at their mean.
    plans = [(case, Extent(case.options.mean_interval, case.options.samples, None, case.options)) for case in samplings]
    return [Variant({}, case.swept, extent) for case, extent in plans]


def _too_long(at: KeyPath, sampling: Any) -> Iterator[Complaint]:
    if sampling.samples > MAX_SAMPLES:
        yield at, f"more than {MAX_SAMPLES} samples in a record are not supported"


def _of_record(at: KeyPath, options: Any, extent: Extent) -> Iterator[Complaint]:
    """Say that an estimator has too few samples of a record."""
    bounds = getattr(options, "delay_bounds", None)
    key = "delay" if bounds is None else "delay_bounds"
    latest = float(getattr(options, "delay", 0.0) if bounds is None else bounds[1])
    terms = getattr(options, "terms", None)
    coefficients = options.poles + options.zeros + 1 if terms is None else sum(term.size for term in terms)
    parameters = int(coefficients + (bounds is not None))
    left = extent.samples_after(latest)
    if latest >= extent.duration and latest > 0:
        yield (*at, key), f"a delay of {latest:g} s is not shorter than the record ({extent.duration:g} s); lower it"
    elif left <= parameters:
        masked = f" after the first {latest:g} s" if left < extent.samples_after(0.0) else ""
        yield at, f"{left} samples{masked} are too few for {parameters} parameters; take more, or fewer poles or zeros"


# --------------------------------------------------------------------------------------------------------------------
# Estimators, starts and success


def _estimator_complaints(spec: Spec, records: Sequence[Variant], *, open_loop: bool) -> Iterator[Complaint]:
    """What each estimator of a system has against the record, the loop and the initial delays."""
    for name, section in spec.estimators.items():
        if section.kind in KINDS["frequency_estimator"] or section.own:
            continue
        at, cases = ("estimators", name), variants(section)
        yield from over({(): cases, ("sampling",): records}, partial(_of_record, at))
        if open_loop:
            yield from over({(): cases}, partial(_of_instruments, at))
        if spec.starts is not None:
            yield from over({(): cases}, partial(_of_delays, name, spec.starts.initial_delay or []))


def _of_instruments(at: KeyPath, options: Any) -> Iterator[Complaint]:
    if getattr(options, "instruments", None) == "closed_loop":
        give = "give loop, or data.reference and loop.controller for a measured record"
        yield (*at, "instruments"), f"closed-loop instruments need the reference and the controller; {give}"


def _of_delays(name: str, delays: Sequence[float | UniformStart], options: Any) -> Iterator[Complaint]:
    if options.start_from != "delay" or not hasattr(options, "delay_bounds"):
        return
    low, high = options.delay_bounds
    for k, point in enumerate(delays):
        ends = point.uniform if isinstance(point, UniformStart) else [point]
        outside = [end for end in ends if not low <= end <= high]
        if outside:
            message = f"{outside[0]:g} s is outside the delay bounds [{low:g}, {high:g}] s of estimator {name!r}"
            yield ("starts", "initial_delay", k), message


def _start_complaints(spec: Spec, starts: StartsSection, broken: frozenset[str]) -> Iterator[Complaint]:
    points, given = starts.initial_delay or [], starts.parameters or []
    random = [k for k, point in enumerate(points) if isinstance(point, UniformStart)]
    if random and spec.monte_carlo is None and "monte_carlo" not in broken:
        yield ("starts", "initial_delay", random[0]), "a random start needs a seed; add monte_carlo: {runs: 1, seed: 1}"
    drawn = [k for k, parameters in enumerate(given) if isinstance(parameters, RelativeStart)]
    for k, parameters in enumerate(given):
        path = ("starts", "parameters", k)
        if not isinstance(parameters, RelativeStart):
            yield from _structure_complaints(spec, path, parameters.options())
        elif k == drawn[0]:
            # All of them have the structure of the system.
            yield from _of_relative_start(spec, path)


def _of_relative_start(spec: Spec, path: KeyPath) -> Iterator[Complaint]:
    """What a start around the true parameters has against the system."""
    if spec.data is not None:
        yield path, "the parameters of a measured record are not known; give values: {additive: [submodels]}"
    elif spec.system is not None and spec.system.own:
        yield path, "a system of one's own has no known structure; give values: {additive: [submodels]}"
    elif spec.system is not None:
        try:
            model = additive_form(variants(spec.system)[0].options)
        except DataError as error:
            yield path, f"the system cannot be written as a sum of submodels: {error}; give values: {{additive: …}}"
        else:
            yield from _structure_complaints(spec, path, model)


def _structure_complaints(spec: Spec, path: KeyPath, model: AdditiveModel) -> Iterator[Complaint]:
    """Say which estimators cannot start from a model."""
    for name, section in spec.estimators.items():
        if not section.own:
            yield from over({(): variants(section)}, partial(_of_structure, name, model, path))


def _of_structure(name: str, model: AdditiveModel, path: KeyPath, options: Any) -> Iterator[Complaint]:
    if options.start_from != "parameters":
        return
    if hasattr(options, "terms"):
        if model.terms != tuple(options.terms):
            wanted = f"{_terms_text(options.terms)} of estimator {name!r}"
            yield path, f"the start has the submodels {_terms_text(model.terms)}, not, in this order, {wanted}"
        return
    fraction = unfactored(model)
    zeros = fraction.numerator.size - 1
    if fraction.order != options.poles or zeros > options.zeros:
        wanted = f"{options.poles} poles and {options.zeros} zeros of estimator {name!r}"
        yield path, f"the start has {fraction.order} poles and {zeros} zeros as one fraction, not the {wanted}"


def _terms_text(terms: Sequence[Term]) -> str:
    parts = [{name: value for name, value in asdict(term).items() if value or name != "integrators"} for term in terms]
    return ", ".join(str(part).replace("'", "") for part in parts)


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
        elif spec.system.own:
            yield from _truth_complaints(path, spec.system.truth, name)
        elif name == "delay_relative_error":
            if 0.0 in np.atleast_1d(spec.system.delay):
                yield path, f"a relative error needs a true delay above zero; {other}"
        elif zero := [key for key, value in variants(spec.system)[0].options.parameters.items() if value == 0.0]:
            yield path, f"a relative error needs true parameters other than zero, and {zero[0]} is zero; leave it out"


def _truth_complaints(path: KeyPath, truth: Mapping[str, Any], rule: str) -> Iterator[Complaint]:
    """Say that a system of one's own does not say what is true of it."""
    names = ["delay"] if rule == "delay_relative_error" else [name for name in truth if name != "delay"]
    if not names or not truth.keys() >= set(names):
        yield path, f"needs true values: system.truth: {{{names[0] if names else 'gain'}: 1.0}}"
    elif zero := [name for name in names if truth[name] == 0.0]:
        yield path, f"a relative error needs true values other than zero, and {zero[0]} is zero"


# --------------------------------------------------------------------------------------------------------------------
# Simulation


def has_relay(spec: Spec) -> bool:
    """Whether a relay closes the loop: estimators know nothing of it, and take the record for one in open loop."""
    return spec.loop is not None and hasattr(spec.loop.controller, "relay")


def _loop_complaints(spec: Spec, section: Section) -> Iterator[Complaint]:
    """What noise, sampling and system have against a loop."""
    if spec.system is not None and spec.system.own:
        yield ("system", "kind"), "a loop needs a transfer function in it; give excitation in place of loop"
        return
    yield from over({(): variants(spec.noise)}, _of_ratio)
    samplings = variants(spec.sampling)
    if any(not isinstance(variant.options, RegularSampling) for variant in samplings):
        yield ("sampling", "kind"), "must be regular in a loop: the controller is discrete and acts at every sample"
        return
    # How many samples there are makes no difference.
    clocks = {
        case.options.interval: replace(case, swept={path: v for path, v in case.swept.items() if path == ("interval",)})
        for case in samplings
    }
    parts: dict[KeyPath, list[Variant]] = {("system",): variants(spec.system), ("loop",): variants(section)}
    yield from over(parts | {("sampling",): list(clocks.values())}, _of_stability, MAX_TRIALS)


def _of_ratio(noise: Any) -> Iterator[Complaint]:
    if noise.snr_db is not None:
        other = ", or its innovation_variance" if hasattr(noise, "innovation_variance") else ""
        yield ("noise", "snr_db"), f"in a loop the noise feeds back into the output; give the noise's variance{other}"


def _of_stability(system: Any, loop: LoopOptions, sampling: Any) -> Iterator[Complaint]:
    """Say why a loop cannot be simulated."""
    from ctid_cli.filtering.loop import loop_radius

    path, interval, radius = ("loop", "controller"), sampling.interval, 0.0
    if isinstance(loop.controller, Relay):
        return  # it bounds the input, and oscillates on purpose
    try:
        with np.errstate(all="ignore"):
            radius = loop_radius(system, loop.at(interval).controller, interval)
    except DataError as error:
        yield path, str(error)
    except np.linalg.LinAlgError:
        yield path, f"the loop: its numbers overflow at intervals of {interval:g} s; scale the coefficients"
    if not radius < 1.0:
        largest = f"at intervals of {interval:g} s its largest pole has the magnitude {radius:.6g}"
        yield path, f"the loop with the true system is unstable: {largest}; lower the gain"


def _simulation_complaints(spec: Spec, records: Sequence[Variant]) -> Iterator[Complaint]:
    """What the sections that data are simulated from have against each other."""
    yield from over({("system",): variants(spec.system), ("sampling",): records}, _of_delay)
    if spec.generator is None:
        return
    place, section = spec.generator
    if section.own:
        return
    seed = spec.monte_carlo.seed if spec.monte_carlo is not None else 0

    # Some faults show only where an excitation meets a sampling scheme: a step after the end, a tone that the clock
    # cannot carry. One data set of each pair tells; pairs beyond the first ones repeat what these say.
    def tried(excitation: Any, extent: Extent) -> Iterator[Complaint]:
        clock = getattr(excitation, "clock_period", None)
        if clock is not None and extent.duration / clock > MAX_SAMPLES:
            message = f"a record of {extent.duration:g} s has more than {MAX_SAMPLES} clock periods of {clock:g} s"
            yield (*place, "clock_period"), message
            return
        try:
            times = extent.sampling.times(stream(seed, "sampling", 0))
            located(excitation, spec.folder).generate(times, stream(seed, "input", 0))
        except DataError as error:
            yield place, str(error)

    if spec.data is None:
        yield from over({place: variants(section), ("sampling",): records}, tried, MAX_TRIALS)


def _of_delay(system: Any, extent: Extent) -> Iterator[Complaint]:
    if getattr(system, "delay", 0.0) >= extent.duration:
        yield ("system", "delay"), f"{system.delay:g} s is not shorter than the record ({extent.duration:g} s)"
