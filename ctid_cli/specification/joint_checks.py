"""What is wrong with a specification although every section is right by itself, and what is unwise in it."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ctid_cli.errors import DataError
from ctid_cli.kinds import KINDS
from ctid_cli.models.additive import AdditiveModel, Term
from ctid_cli.models.factoring import unfactored
from ctid_cli.signals.streams import stream
from ctid_cli.simulation.dataset import LoopOptions, located
from ctid_cli.specification.sections import Complaint, Section, Variant, grouped, variants
from ctid_cli.specification.signal_checks import signal_complaints, signal_warnings, world_complaints
from ctid_cli.specification.start_points import additive_form
from ctid_cli.specification.start_sections import RelativeStart, StartsSection, UniformStart
from ctid_cli.specification.yaml_source import KeyPath

if TYPE_CHECKING:
    from ctid_cli.specification.spec import Spec

#: Samples, or clock periods of the input, of the longest record; ten times this would not fit in memory.
MAX_SAMPLES = 10_000_000
#: Combinations that are tried out when a specification is checked, of sections whose faults show only together.
MAX_TRIALS = 64

Failure = tuple[KeyPath, str, Mapping[KeyPath, Any]]


class _Extent:
    """How long a record is, and how many of its samples are left after a delay."""

    def __init__(self, combination: Mapping[KeyPath, Any], interval: float, samples: int, times: Any = None) -> None:
        self.combination = combination
        self.duration = interval * (samples - 1)
        self._interval = interval
        self._samples = samples
        self._times = times

    def samples_after(self, delay: float) -> int:
        if self._times is not None:
            return int(np.count_nonzero(self._times >= delay))
        return max(self._samples - math.ceil(delay / self._interval), 0)


def joint_complaints(spec: Spec, broken: frozenset[str], *, files_are_good: bool) -> Iterator[Complaint]:
    """What the sections of a specification have against each other."""
    yield from world_complaints(spec, broken)
    if spec.signal is not None:
        too_long = list(too_long_complaints(variants(spec.sampling) if spec.sampling is not None else []))
        yield from too_long or signal_complaints(spec)
        return
    extents = _extents(spec) if files_are_good else []
    estimators = {
        name: section
        for name, section in spec.estimators.items()
        if getattr(section, "kind", None) not in KINDS["frequency_estimator"]
    }
    for name, section in estimators.items():
        cases = variants(section)
        failures = [
            (("estimators", name, *path), message, {**variant.swept, **extent.combination})
            for variant in cases
            for extent in extents
            for path, message in _record_complaints(variant.options, extent)
        ]
        yield from grouped(failures, len(cases) * len(extents))
        if spec.loop is None and not broken & {"loop", "data", "excitation"}:
            yield from grouped(_instrument_failures(name, cases), len(cases))
        if spec.starts is not None:
            yield from grouped(_delay_failures(spec.starts, name, cases), len(cases))
    if spec.starts is not None:
        yield from _start_complaints(spec, spec.starts)
    yield from _success_complaints(spec)
    if spec.loop is not None and spec.data is None:
        yield from _loop_complaints(spec, spec.loop)
    if files_are_good:
        yield from _simulation_complaints(spec, extents)


def joint_warnings(spec: Spec) -> list[Complaint]:
    """What is allowed but unwise."""
    if spec.signal is not None:
        return signal_warnings(spec)
    warnings: list[Complaint] = []
    if spec.system is not None and spec.sampling is not None:
        fastest = float(np.abs(variants(spec.system)[0].options.poles).max(initial=0.0))
        slow = []
        cases = variants(spec.sampling)
        for variant in cases:
            interval = _mean_interval(variant.options)
            if interval * fastest > math.pi:
                key: KeyPath = ("sampling", "interval") if hasattr(variant.options, "interval") else ("sampling",)
                message = (
                    f"sampling every {interval:g} s is slower than twice the fastest pole ({fastest:.4g} rad/s, "
                    f"{fastest / (2 * math.pi):.4g} Hz): intervals below {math.pi / fastest:.4g} s see it"
                )
                slow.append((key, message, variant.swept))
        warnings += grouped(slow, len(cases))
    if spec.data is not None and spec.monte_carlo is not None and spec.monte_carlo.runs > 1:
        warnings.append((("monte_carlo", "runs"), "a measured record is one data set; it is run once"))
    if spec.starts is not None:
        taken = {variants(section)[0].options.start_from for section in spec.estimators.values()}
        unused = "no estimator here uses a start of this kind; each is run once"
        if spec.starts.delays and "delay" not in taken:
            warnings.append((("starts", "initial_delay"), unused))
        if spec.starts.parameter_sets and "parameters" not in taken:
            warnings.append((("starts", "parameters"), unused))
    return warnings


# --------------------------------------------------------------------------------------------------------------------
# Length of the records


def _extents(spec: Spec) -> list[_Extent]:
    if spec.measured is not None:
        record = spec.measured.dataset(0).record
        interval = record.duration / max(record.n_samples - 1, 1)
        return [_Extent({}, interval, record.n_samples, (record.t - record.t[0])[record.valid])]
    return [
        # Random intervals stand for themselves at their mean.
        _Extent(_prefixed(("sampling",), variant.swept), _mean_interval(variant.options), variant.options.samples)
        for variant in (variants(spec.sampling) if spec.sampling is not None else [])
    ]


def _prefixed(section: KeyPath, combination: Mapping[KeyPath, Any]) -> dict[KeyPath, Any]:
    return {(*section, *path): value for path, value in combination.items()}


def _mean_interval(sampling: Any) -> float:
    return float(sampling.interval) if hasattr(sampling, "interval") else 0.5 * float(sampling.low + sampling.high)


def _record_complaints(options: Any, extent: _Extent) -> Iterator[Complaint]:
    bounds = getattr(options, "delay_bounds", None)
    key = "delay" if bounds is None else "delay_bounds"
    latest = float(getattr(options, "delay", 0.0) if bounds is None else bounds[1])
    terms = getattr(options, "terms", None)
    coefficients = options.poles + options.zeros + 1 if terms is None else sum(term.size for term in terms)
    parameters = int(coefficients + (bounds is not None))
    total, left = extent.samples_after(0.0), extent.samples_after(latest)
    if latest >= extent.duration and latest > 0:
        yield (
            (key,),
            f"a delay of {latest:g} s is not shorter than the record ({extent.duration:g} s), so no sample would be "
            "left to use; lower it, or take more samples",
        )
    elif left <= parameters:
        masked = f" after the first {latest:g} s" if left < total else ""
        yield (
            (),
            f"{left} samples{masked} are too few for {parameters} parameters; "
            "take more samples, fewer poles or zeros, or a smaller largest delay",
        )


# --------------------------------------------------------------------------------------------------------------------
# Estimators, starts and success


def _instrument_failures(name: str, cases: Sequence[Variant]) -> Iterator[Failure]:
    for variant in cases:
        if getattr(variant.options, "instruments", None) == "closed_loop":
            message = (
                "closed-loop instruments are made of the reference and the controller, and both are missing: give "
                "loop to simulate, or data.reference and loop.controller for a measured record"
            )
            yield ("estimators", name, "instruments"), message, variant.swept


def _delay_failures(starts: StartsSection, name: str, cases: Sequence[Variant]) -> Iterator[Failure]:
    for variant in cases:
        if not (variant.options.start_from == "delay" and hasattr(variant.options, "delay_bounds")):
            continue
        low, high = variant.options.delay_bounds
        for k, point in enumerate(starts.delays):
            ends = point.uniform if isinstance(point, UniformStart) else [point]
            outside = [end for end in ends if not low <= end <= high]
            if outside:
                message = f"{outside[0]:g} s is outside the delay bounds [{low:g}, {high:g}] s of estimator {name!r}"
                yield ("starts", "initial_delay", k), message, variant.swept


def _start_complaints(spec: Spec, starts: StartsSection) -> Iterator[Complaint]:
    random = [k for k, point in enumerate(starts.delays) if isinstance(point, UniformStart)]
    if spec.data is not None and random and spec.monte_carlo is None:
        yield ("starts", "initial_delay", random[0]), "a random start needs a seed; add monte_carlo: {runs: 1, seed: 1}"
    drawn = [k for k, parameters in enumerate(starts.parameter_sets) if isinstance(parameters, RelativeStart)]
    for k, parameters in enumerate(starts.parameter_sets):
        path = ("starts", "parameters", k)
        if not isinstance(parameters, RelativeStart):
            yield from _structure_complaints(spec, path, variants(parameters)[0].options)
        elif k != drawn[0]:
            continue  # all of them have the structure of the system
        elif spec.data is not None:
            yield path, "the parameters of a measured record are not known; give values: {additive: [submodels]}"
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
        cases = variants(section)
        failures = [
            (path, f"{message} of estimator {name!r}", variant.swept)
            for variant in cases
            if getattr(variant.options, "start_from", None) == "parameters"
            for message in _mismatch(model, variant.options)
        ]
        yield from grouped(failures, len(cases))


def _mismatch(model: AdditiveModel, options: Any) -> Iterator[str]:
    """Say that a start has another structure than the estimator."""
    if hasattr(options, "terms"):
        if model.terms != tuple(options.terms):
            yield (
                f"the start has the submodels {_terms_text(model.terms)}, which are not, in this order, the terms "
                f"{_terms_text(options.terms)}"
            )
        return
    fraction = unfactored(model)
    zeros = fraction.numerator.size - 1
    if fraction.order != options.poles or zeros > options.zeros:
        yield (
            f"the start has {fraction.order} poles and {zeros} zeros as one fraction, which are not the "
            f"{options.poles} poles and {options.zeros} zeros"
        )


def _terms_text(terms: Sequence[Term]) -> str:
    texts = []
    for term in terms:
        integrators = f", integrators: {term.integrators}" if term.integrators else ""
        texts.append(f"{{poles: {term.poles}, zeros: {term.zeros}{integrators}}}")
    return ", ".join(texts)


def _success_complaints(spec: Spec) -> Iterator[Complaint]:
    if spec.success is None:
        return
    if spec.success.delay_relative_error is not None:
        path = ("success", "delay_relative_error")
        if spec.data is not None:
            yield path, "the true delay of a measured record is not known; use fit_percent, or leave it out"
        elif spec.system is not None and 0.0 in np.atleast_1d(spec.system.delay):
            yield path, "a relative error needs a true delay above zero; use fit_percent, or leave it out"
    if spec.success.parameter_relative_error is not None:
        path = ("success", "parameter_relative_error")
        if spec.data is not None:
            yield path, "the parameters of a measured record are not known; use fit_percent, or leave it out"
        elif spec.system is not None:
            model = variants(spec.system)[0].options
            if not isinstance(model, AdditiveModel):
                yield path, "is about the parameters of submodels; give the system as system.additive, or leave it out"
            elif 0.0 in model.theta:
                zero = model.names[model.theta.tolist().index(0.0)]
                yield path, f"a relative error needs true parameters other than zero, and {zero} is zero; leave it out"


# --------------------------------------------------------------------------------------------------------------------
# Simulation


def _loop_complaints(spec: Spec, section: Section) -> Iterator[Complaint]:
    """What noise, sampling and system have against a loop."""
    noises = variants(spec.noise) if spec.noise is not None else []
    ratio = [
        (
            ("noise", "snr_db"),
            "in a loop the noise feeds back into the output, so no output is known before it; give the noise's "
            "variance" + (", or its innovation_variance" if variant.options.coloured else ""),
            {} if ("snr_db",) in variant.swept else variant.swept,
        )
        for variant in noises
        if variant.options.snr_db is not None
    ]
    yield from grouped(ratio, len(noises))
    samplings = variants(spec.sampling) if spec.sampling is not None else []
    if any(not hasattr(variant.options, "interval") for variant in samplings):
        yield (
            ("sampling", "kind"),
            "must be regular in a loop: the controller is discrete and acts at every sample, at equal intervals",
        )
        return
    if spec.system is None:
        return
    intervals = {variant.options.interval: variant for variant in samplings}
    pairs = list(itertools.product(variants(spec.system), variants(section), intervals.values()))[:MAX_TRIALS]
    failures = []
    for system, loop, sampling in pairs:
        message = _unstable(system.options, loop.options, sampling.options.interval)
        if message:
            interval: dict[KeyPath, Any] = {path: v for path, v in sampling.swept.items() if path == ("interval",)}
            combination = {
                **_prefixed(("system",), system.swept),
                **_prefixed(("loop",), loop.swept),
                **_prefixed(("sampling",), interval),
            }
            failures.append((("loop", "controller"), message, combination))
    yield from grouped(failures, len(pairs))


def _unstable(system: Any, loop: LoopOptions, interval: float) -> str:
    """Why a loop cannot be simulated; empty if it can."""
    from ctid_cli.filtering.loop import loop_radius

    try:
        with np.errstate(all="ignore"):
            radius = loop_radius(system, loop.controller, interval)
    except DataError as error:
        return str(error)
    except np.linalg.LinAlgError:
        return (
            f"the loop cannot be simulated: its numbers overflow at intervals of {interval:g} s; scale the coefficients"
        )
    if radius < 1.0:
        return ""
    return (
        f"the loop of the true system and this controller is unstable: at intervals of {interval:g} s its largest pole "
        f"has the magnitude {radius:.6g}, which must be below 1; lower the gain"
    )


def too_long_complaints(samplings: Sequence[Variant]) -> Iterator[Complaint]:
    """Say that a record has too many samples."""
    too_long: list[Failure] = [
        (
            ("sampling", "duration" if "duration" in variant.values else "samples"),
            f"more than {MAX_SAMPLES} samples in a record are not supported",
            {},
        )
        for variant in samplings
        if variant.options.samples > MAX_SAMPLES
    ]
    yield from grouped(too_long, 1)


def _simulation_complaints(spec: Spec, extents: Sequence[_Extent]) -> Iterator[Complaint]:
    """What the sections that data are simulated from have against each other."""
    samplings = variants(spec.sampling) if spec.sampling is not None else []
    too_long = list(too_long_complaints(samplings))
    if too_long:
        yield from too_long
        return
    if spec.system is not None:
        delays = variants(spec.system)
        late = [
            (
                ("system", "delay"),
                f"a delay of {variant.options.delay:g} s is not shorter than the record ({extent.duration:g} s); "
                "the output would be noise alone",
                {**_prefixed(("system",), variant.swept), **extent.combination},
            )
            for variant in delays
            for extent in extents
            if variant.options.delay >= extent.duration
        ]
        yield from grouped(late, len(delays) * len(extents))
    if spec.generator is None:
        return
    place, section = spec.generator
    generators = variants(section)
    # Some faults show only where an excitation meets a sampling scheme: a step after the end, a tone that the clock
    # cannot carry. One data set of each pair tells; pairs beyond the first ones repeat what these say.
    failures: list[Failure] = []
    pairs = list(itertools.product(generators, zip(samplings, extents, strict=False)))[:MAX_TRIALS]
    seed = spec.monte_carlo.seed if spec.monte_carlo is not None else 0
    for generator, (sampling, extent) in pairs:
        combination = {**_prefixed(place, generator.swept), **extent.combination}
        clock = getattr(generator.options, "clock_period", None)
        if clock is not None and extent.duration / clock > MAX_SAMPLES:
            message = f"a record of {extent.duration:g} s has more than {MAX_SAMPLES} clock periods of {clock:g} s"
            failures.append(((*place, "clock_period"), message, combination))
            continue
        try:
            times = sampling.options.times(stream(seed, "sampling", 0))
            located(generator.options, spec.folder).generate(times, stream(seed, "input", 0))
        except DataError as error:
            failures.append((place, str(error), combination))
    yield from grouped(failures, len(pairs))
