"""What is wrong with an experiment on a signal although every section is right by itself, and what is unwise in it."""

import math
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np

from ctid_cli.errors import DataError
from ctid_cli.frequency.drem_window import DremWindow
from ctid_cli.frequency.esprit import Esprit
from ctid_cli.kinds import KINDS
from ctid_cli.signals.sampling import RegularSampling
from ctid_cli.signals.sinusoids import SineDisturbance, SumOfSinusoids
from ctid_cli.simulation.frequency_measures import true_frequencies
from ctid_cli.specification.messages import Complaint
from ctid_cli.specification.sections import over, place_of, variants
from ctid_cli.specification.spec import Spec
from ctid_cli.specification.yaml_source import KeyPath

#: Success rules of systems and of signals.
_OF_SYSTEMS = ("delay_relative_error", "fit_percent", "parameter_relative_error")
_OF_SIGNALS = ("band", "by", "window")


def world_complaints(spec: Spec, broken: frozenset[str]) -> Iterator[Complaint]:
    """Say which estimators and success rules belong to the other kind of experiment."""
    on_signal = spec.signal is not None
    if not on_signal and ("signal" in broken or (spec.system is None and spec.data is None)):
        return
    wanted = "frequency_estimator" if on_signal else "estimator"
    here, does = "a signal; allowed:", "identifies a system from its input and output"
    if not on_signal:
        here, does = "a system; give signal, or one of", "estimates the frequencies of a signal"
    for name, section in spec.estimators.items():
        if section.kind not in KINDS[wanted] and (on_signal or not section.own):
            message = f"{section.kind} {does}, and this experiment has {here} {', '.join(KINDS[wanted])}"
            yield ("estimators", name, "kind"), message
    for name in _OF_SYSTEMS if on_signal else _OF_SIGNALS:
        if getattr(spec.success, name, None) is not None:
            other = "a signal has none of it; use band and by" if on_signal else "is about the frequencies of a signal"
            yield ("success", name), f"{other}, or leave it out"


def signal_complaints(spec: Spec) -> Iterator[Complaint]:
    """What the sections of an experiment on a signal have against each other."""
    clocks = variants(spec.sampling)
    if any(not isinstance(clock.options, RegularSampling) for clock in clocks):
        yield ("sampling", "kind"), "must be regular: estimators of frequencies compare samples at fixed delays"
        return
    signals = variants(spec.signal)
    yield from over({("signal",): signals, ("sampling",): clocks}, partial(_of_clock, spec))
    disturbances = [case.options for case in variants(spec.disturbance)] or [None]
    for name, section in spec.estimators.items():
        if section.kind in KINDS["frequency_estimator"]:
            at, cases = ("estimators", name), variants(section)
            yield from over({(): cases, ("sampling",): clocks}, partial(_of_estimator, at))
            yield from over({(): cases, ("signal",): signals[:1]}, partial(_of_tones, at, disturbances))


def signal_warnings(spec: Spec) -> list[Complaint]:
    """What is allowed but unwise in an experiment on a signal."""
    signal = variants(spec.signal)[0].options
    warnings: list[Complaint] = []
    for name, section in spec.estimators.items():
        at, cases = ("estimators", name), variants(section)
        warnings += over({(): cases}, partial(_aliased, at, signal.highest_frequency))
        warnings += over({(): cases, ("sampling",): variants(spec.sampling)}, partial(_rounded, at))
        if not cases[0].options.online and signal.frequency_steps:
            warnings.append(((*at, "kind"), "gives one estimate of the whole record, in which a frequency steps"))
    return warnings


def _aliased(at: KeyPath, highest: float, options: Any) -> Iterator[Complaint]:
    if hasattr(options, "h") and highest > math.pi / options.h:
        limit = f"with h = {options.h:g} s, frequencies above pi/h = {math.pi / options.h:.4g} rad/s"
        yield (*at, "h"), f"{limit} are seen as lower ones, and the signal has {highest:g} rad/s"


def _rounded(at: KeyPath, options: Any, clock: RegularSampling) -> Iterator[Complaint]:
    for note in options.start(clock.interval).notes if options.online else ():
        yield (*at, "h"), note


def _of_tones(at: KeyPath, disturbances: list[Any], options: Any, signal: SumOfSinusoids) -> Iterator[Complaint]:
    try:
        for disturbance in disturbances:
            true_frequencies(signal, disturbance, options.tones, np.zeros(1))
    except ValueError:
        sine = any(isinstance(item, SineDisturbance) for item in disturbances)
        more = ", or one more for the sinusoid that disturbs it" if sine else ""
        yield (*at, "tones"), f"must be {len(signal.tones)}, as many as the signal has{more}, not {options.tones}"


def _of_clock(spec: Spec, signal: SumOfSinusoids, clock: RegularSampling) -> Iterator[Complaint]:
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
    for path, message in (_of_online if options.online else _of_batch)(options, clock):
        yield (*at, *path), message


def _of_online(options: Any, clock: RegularSampling) -> Iterator[Complaint]:
    duration = clock.interval * clock.samples
    # First of all, since the estimator would keep all the samples of such a time.
    for name in ("prefilter", "difference", "d", "hold", *(("memory",) if options.kind == DremWindow.kind else ())):
        value = getattr(options, name, 0.0)
        if value > duration:
            yield (name,), f"{name} = {value:g} s is longer than the record, {duration:g} s"
            return
    rows = options.first_row + options.tones - 1 if hasattr(options, "d") else 0
    filled = 2 * options.tones * getattr(options, "h", 0.0) + rows * getattr(options, "d", 0.0)
    filled += getattr(options, "prefilter", 0.0) + getattr(options, "difference", 0.0)
    if filled >= duration:
        yield ("h",), f"its delays are filled after {filled:g} s, the record ends at {duration:g} s; take a smaller h"
        return
    try:
        with np.errstate(all="ignore"):
            options.start(clock.interval)
    except ArithmeticError:
        yield (), "these values are too large or too small to compute with"
    except ValueError as error:
        yield place_of(error, vars(options)), str(error)


def _of_batch(options: Any, clock: RegularSampling) -> Iterator[Complaint]:
    initial = getattr(options, "initial_frequencies", None)
    if initial is not None:
        highest = math.pi / clock.interval
        if max(initial) >= highest:
            yield ("initial_frequencies",), f"must be below {highest:.4g} rad/s, pi over the sampling interval"
        return
    start = options if isinstance(options, Esprit) else Esprit(tones=options.tones, averaging=options.averaging)
    try:
        start.blocks(clock.samples, clock.interval)
    except (ValueError, DataError) as error:
        yield place_of(error, vars(options)), str(error)
