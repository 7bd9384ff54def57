"""What is wrong with an experiment on a signal although every section is right by itself, and what is unwise in it."""

from __future__ import annotations

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
from ctid_cli.specification.sections import over, variants
from ctid_cli.specification.spec import Spec
from ctid_cli.specification.yaml_source import KeyPath

#: Success rules of systems and of signals.
_OF_SYSTEMS = ("delay_relative_error", "fit_percent", "parameter_relative_error")
_OF_SIGNALS = ("band", "by")


def world_complaints(spec: Spec, broken: frozenset[str]) -> Iterator[Complaint]:
    """Say which estimators and success rules belong to the other kind of experiment."""
    on_signal = spec.signal is not None
    if not on_signal and ("signal" in broken or (spec.system is None and spec.data is None)):
        return
    for name, section in spec.estimators.items():
        kind = section.kind
        if on_signal and kind not in KINDS["frequency_estimator"]:
            message = f"{kind} identifies a system from its input and output, and this experiment has a signal"
            yield ("estimators", name, "kind"), f"{message}; allowed: {', '.join(KINDS['frequency_estimator'])}"
        elif not on_signal and kind in KINDS["frequency_estimator"]:
            message = f"{kind} estimates the frequencies of a signal, and this experiment has a system"
            yield ("estimators", name, "kind"), f"{message}; give signal in its place, or another estimator"
    if spec.success is None:
        return
    for name in _OF_SYSTEMS if on_signal else _OF_SIGNALS:
        if getattr(spec.success, name) is not None:
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
        if section.kind not in KINDS["frequency_estimator"]:
            continue
        at = ("estimators", name)
        cases = variants(section)
        yield from over({(): cases, ("sampling",): clocks}, partial(_of_estimator, at))
        yield from over({(): cases, ("signal",): signals[:1]}, partial(_of_tones, at, disturbances))


def signal_warnings(spec: Spec) -> list[Complaint]:
    """What is allowed but unwise in an experiment on a signal."""
    signal = variants(spec.signal)[0].options
    warnings: list[Complaint] = []
    for name, section in spec.estimators.items():
        cases = variants(section)
        at = ("estimators", name)
        warnings += over({(): cases}, partial(_aliased, at, signal.highest_frequency))
        warnings += over({(): cases, ("sampling",): variants(spec.sampling)}, partial(_rounded, at))
        if not cases[0].options.online and signal.frequency_steps:
            warnings.append(((*at, "kind"), "gives one estimate of the whole record, in which a frequency steps"))
    return warnings


def _aliased(at: KeyPath, highest: float, options: Any) -> Iterator[Complaint]:
    if hasattr(options, "h") and highest > math.pi / options.h:
        yield (
            (*at, "h"),
            f"with h = {options.h:g} s, frequencies above pi/h = {math.pi / options.h:.4g} rad/s are seen as lower "
            f"ones, and the signal has {highest:g} rad/s",
        )


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
        message = f"must be {len(signal.tones)}, as many as the signal has{more}, not {options.tones}"
        yield (*at, "tones"), message


def _of_clock(spec: Spec, signal: SumOfSinusoids, clock: RegularSampling) -> Iterator[Complaint]:
    interval = float(clock.interval)
    duration = interval * clock.samples
    highest = signal.highest_frequency
    if highest >= math.pi / interval:
        message = f"samples every {interval:g} s show frequencies below {math.pi / interval:.4g} rad/s, and the signal "
        yield ("sampling", "interval"), f"{message}has {highest:g} rad/s"
    for step in signal.steps:
        if step >= duration - interval:
            message = f"a step at {step:g} s comes after the last sample, at {duration - interval:g} s"
            yield ("signal", "tones"), message
    if spec.tracks is not None:
        if spec.tracks.interval < interval * (1.0 - 1e-9) or spec.tracks.interval > duration:
            message = f"must lie between the sampling interval, {interval:g} s, and the length of the record, "
            yield ("tracks", "interval"), f"{message}{duration:g} s"
        window = spec.tracks.window
        if window is not None and (window[1] > duration * (1 + 1e-9) or window[1] - window[0] < interval):
            yield ("tracks", "window"), f"must hold samples of the record, which ends at {duration:g} s"
    by = None if spec.success is None else spec.success.by
    if by is not None and by > duration:
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
        message = f"its delays are filled after {filled:g} s, and the record ends at {duration:g} s; take a smaller h"
        yield ("h",), message
        return
    try:
        with np.errstate(all="ignore"):
            options.start(clock.interval)
    except ArithmeticError:
        yield (), "these values are too large or too small to compute with"
    except ValueError as error:
        yield _field(error, options), str(error)


def _of_batch(options: Any, clock: RegularSampling) -> Iterator[Complaint]:
    initial = getattr(options, "initial_frequencies", None)
    if initial is not None:
        highest = math.pi / clock.interval
        if max(initial) >= highest:
            message = f"initial_frequencies must be below {highest:.4g} rad/s, pi over the sampling interval"
            yield ("initial_frequencies",), message
        return
    start = options if isinstance(options, Esprit) else Esprit(tones=options.tones, averaging=options.averaging)
    try:
        start.blocks(clock.samples, clock.interval)
    except (ValueError, DataError) as error:
        yield _field(error, options), str(error)


def _field(error: Exception, options: Any) -> KeyPath:
    """The option that an error is about, if it is about one of them."""
    field = getattr(error, "field", "")
    return (field,) if hasattr(options, field) else ()
