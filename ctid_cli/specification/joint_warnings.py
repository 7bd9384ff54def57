"""What is allowed in a specification but unwise, said before anything is run."""

import math
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np

from ctid_cli.frequency.base import FrequencyEstimator
from ctid_cli.models.additive import Term
from ctid_cli.signals.noise import stream
from ctid_cli.signals.sampling import RegularSampling
from ctid_cli.simulation.dataset import located
from ctid_cli.specification.joint_checks import MAX_TRIALS, Extent, extents, has_relay
from ctid_cli.specification.messages import Complaint
from ctid_cli.specification.spec import Spec
from ctid_cli.specification.sweeps import Variant, known_variants, over, variants
from ctid_cli.specification.yaml_source import KeyPath

#: A record shows the slowest pole if it lasts so many of its time constants beyond the delay: below that its standard
#: error grows much faster than that of a longer record falls with the number of samples.
TIME_CONSTANTS = 3.0
#: Input edges this close to a sample, as a fraction of the sampling interval, are seen when they happen.
ON_TIME = 1e-6


def joint_warnings(spec: Spec) -> list[Complaint]:
    """Say what is allowed but unwise."""
    if spec.signal is not None:
        return _signal_warnings(spec)
    warnings = [] if spec.system is None else _simulation_warnings(spec)
    if spec.data is not None and spec.monte_carlo is not None and spec.monte_carlo.most > 1:
        warnings.append((("monte_carlo", "runs"), "a measured record is one data set; it is run once"))
    if spec.loop is not None and not has_relay(spec):
        for name, section in spec.estimators.items():
            cases = known_variants(section) or [Variant({}, {}, None)]
            warnings += over({(): cases}, partial(_of_open_loop, ("estimators", name)))
    if spec.starts is not None:
        taken = {getattr(variants(section)[0].options, "start_from", None) for section in spec.estimators.values()}
        for name, kind in (("initial_delay", "delay"), ("parameters", "parameters")):
            if getattr(spec.starts, name) and kind not in taken:
                warnings.append((("starts", name), "no estimator here uses a start of this kind; each is run once"))
    return warnings


def _of_open_loop(at: KeyPath, options: Any) -> Iterator[Complaint]:
    if getattr(options, "instruments", "open_loop") == "open_loop":
        ignored = "ignores the loop, through which noise reaches the input and biases the estimate"
        yield at, f"{ignored}; use srivc or additive_srivc with instruments: closed_loop, unless that is the point"


def _simulation_warnings(spec: Spec) -> list[Complaint]:
    """Say what is unwise where the truth is known."""
    warnings: list[Complaint] = []
    noises, estimators = known_variants(spec.noise), {("estimators", n): s for n, s in spec.estimators.items()}
    for at, section in estimators.items():
        warnings += over({("noise",): noises, at: known_variants(section)}, partial(_of_white_formula, at))
    samplings = spec.samplings
    told: dict[KeyPath, list[Variant]]
    told = {("excitation",): known_variants(spec.excitation), ("sampling",): samplings}
    warnings += over(told, partial(_of_sampled_input, spec), MAX_TRIALS)
    systems = known_variants(spec.system)
    if not systems:
        return warnings
    fastest = float(np.abs(systems[0].options.poles).max(initial=0.0))
    warnings += over({(): samplings}, partial(_of_slow_sampling, fastest))
    lengths: dict[KeyPath, list[Variant]] = {("system",): systems, ("sampling",): extents(spec, samplings)}
    key = next((name for name in ("duration", "times", "file") if hasattr(spec.sampling, name)), "samples")
    warnings += over(lengths, partial(_of_short_record, key))
    for at, section in estimators.items():
        cases = known_variants(section)
        warnings += over({("system",): systems, at: cases}, partial(_of_delay, at, in_loop=spec.loop is not None))
        warnings += over({("system",): systems[:1], at: cases}, partial(_of_structure, at))
    return warnings


# --------------------------------------------------------------------------------------------------------------------
# The record


def _of_slow_sampling(fastest: float, sampling: Any) -> Iterator[Complaint]:
    interval = sampling.mean_interval
    if interval * fastest > math.pi:
        slow = f"sampling every {interval:g} s is slower than twice the fastest pole ({fastest:.4g} rad/s)"
        key: KeyPath = ("sampling", "interval") if hasattr(sampling, "interval") else ("sampling",)
        yield key, f"{slow}; intervals below {math.pi / fastest:.4g} s see it"


def _of_short_record(key: str, system: Any, extent: Extent) -> Iterator[Complaint]:
    # A lightly damped mode shows within its period, long before it has died away.
    frequencies = np.abs(system.poles)
    slowest = float(1.0 / frequencies[frequencies > 0.0].min(initial=math.inf))
    needed = float(system.delay + TIME_CONSTANTS * slowest)
    if extent.duration < needed:
        delayed = f", {system.delay:g} s of it delay," if system.delay else ""
        short = (
            f"a record of {extent.duration:.4g} s{delayed} shows little of the slowest pole, whose time constant is "
        )
        short += f"{slowest:.4g} s"
        cures = {
            "duration": f"write duration: {needed:.3g} or more",
            "samples": f"write samples: {math.ceil(needed / extent.interval) + 1} or more",
        }
        yield ("sampling", key), f"{short}; {cures.get(key, f'it must last {needed:.3g} s or more')}"


def _of_sampled_input(spec: Spec, excitation: Any, sampling: Any) -> Iterator[Complaint]:
    if sampling.input_record != "sampled":
        return
    seed = spec.monte_carlo.seed if spec.monte_carlo is not None else 0
    times = sampling.times(stream(seed, "sampling", 0))
    applied = located(excitation, spec.folder).generate(times, stream(seed, "input", 0))
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


# --------------------------------------------------------------------------------------------------------------------
# Estimators


def _of_delay(at: KeyPath, system: Any, options: Any, *, in_loop: bool) -> Iterator[Complaint]:
    true, bounds, known = system.delay, getattr(options, "delay_bounds", None), getattr(options, "delay", None)
    if bounds is not None and not bounds[0] <= true <= bounds[1]:
        outside = f"[{bounds[0]:g}, {bounds[1]:g}] s do not hold the delay of the system, {true:g} s"
        yield (*at, "delay_bounds"), f"{outside}; write delay_bounds: [0, {2 * true:g}], unless that is the point"
    elif bounds is None and known is not None and not math.isclose(known, true):
        other = "" if in_loop else " or, to estimate it, use kind: delay_profile"
        wrong = f"is taken as {known:g} s and the system has {true:g} s, which biases the parameters"
        yield (*at, "delay"), f"{wrong}; write delay: {true:g}{other}"


def _of_white_formula(at: KeyPath, noise: Any, options: Any) -> Iterator[Complaint]:
    if getattr(noise, "coloured", False) and getattr(options, "covariance", "") == "white":
        short = "is for white noise and the noise is coloured, so that the intervals are too short or too long"
        yield (*at, "covariance"), f"{short}; write covariance: auto, unless that is the point"


def _of_structure(at: KeyPath, system: Any, options: Any) -> Iterator[Complaint]:
    """Say that no parameters make the model the system."""
    key, more = ("terms", "add to the terms") if hasattr(options, "terms") else ("", "")
    for name, needed, given in zip(("poles", "zeros"), _degrees(system) or (), _degrees(options) or (), strict=False):
        if given < needed:
            few = f"the system has {needed} {name if needed > 1 else name[:-1]} and this model {given}"
            yield (*at, key or name), f"{few}, so that it can only come near; {more or f'write {name}: {needed}'}"
            return


def _degrees(model: Any) -> tuple[int, int] | None:
    """Return the degrees of denominator and numerator of a system or of the model of an estimator, as one fraction."""
    if hasattr(model, "relative_degree"):
        return model.order, model.order - model.relative_degree
    if hasattr(model, "terms"):
        return _fraction_degrees(model.terms)
    if hasattr(model, "zeros"):
        return model.poles + getattr(model, "integrators", 0), model.zeros
    return None


def _fraction_degrees(terms: Sequence[Term]) -> tuple[int, int]:
    order = sum(term.order for term in terms)
    return order, max(order - term.order + term.zeros for term in terms)


# --------------------------------------------------------------------------------------------------------------------
# Frequencies of a signal


def _signal_warnings(spec: Spec) -> list[Complaint]:
    """Say what is allowed but unwise in an experiment on a signal."""
    signal, clocks = variants(spec.signal)[0].options, variants(spec.sampling)
    warnings: list[Complaint] = []
    for name, section in spec.estimators.items():
        at, cases = ("estimators", name), variants(section)
        warnings += over({(): cases, ("sampling",): clocks}, partial(_unwise, at, signal.highest_frequency))
        if cases[0].options.whole_record and signal.frequency_steps:
            warnings.append(((*at, "kind"), "gives one estimate of the whole record, in which a frequency steps"))
    return warnings


def _unwise(at: KeyPath, highest: float, options: FrequencyEstimator, clock: RegularSampling) -> Iterator[Complaint]:
    for name, text in options.warnings(clock.interval, highest):
        yield (*at, name), text
