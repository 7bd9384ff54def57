"""What is wrong with an experiment on a signal although every section is right by itself, and what is unwise in it."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from ctid_cli.errors import DataError, OptionError
from ctid_cli.frequency.drem_window import DremWindow
from ctid_cli.frequency.esprit import Esprit
from ctid_cli.kinds import KINDS
from ctid_cli.signals.sampling import RegularSampling
from ctid_cli.signals.sinusoids import SineDisturbance
from ctid_cli.simulation.frequency_measures import true_frequencies
from ctid_cli.specification.sections import Complaint, Variant, grouped, variants
from ctid_cli.specification.yaml_source import KeyPath

if TYPE_CHECKING:
    from ctid_cli.specification.spec import Spec

Failure = tuple[KeyPath, str, Mapping[KeyPath, Any]]

#: Success rules of systems and of signals.
_OF_SYSTEMS = ("delay_relative_error", "fit_percent", "parameter_relative_error")
_OF_SIGNALS = ("band", "by")


def world_complaints(spec: Spec, broken: frozenset[str]) -> Iterator[Complaint]:
    """Say which estimators and success rules belong to the other kind of experiment."""
    on_signal = spec.signal is not None
    if not on_signal and ("signal" in broken or (spec.system is None and spec.data is None)):
        return
    for name, section in spec.estimators.items():
        kind = str(getattr(section, "kind"))  # noqa: B009 - every section of an estimator has one
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
    clocks = variants(spec.sampling) if spec.sampling is not None else []
    if any(not isinstance(clock.options, RegularSampling) for clock in clocks):
        yield ("sampling", "kind"), "must be regular: estimators of frequencies compare samples at fixed delays"
        return
    signals = variants(spec.signal) if spec.signal is not None else []
    pairs = list(itertools.product(signals, clocks))
    yield from grouped([failure for pair in pairs for failure in _of_clock(spec, *pair)], len(pairs))
    disturbances = [None] if spec.disturbance is None else [case.options for case in variants(spec.disturbance)]
    for name, section in spec.estimators.items():
        if str(getattr(section, "kind")) not in KINDS["frequency_estimator"]:  # noqa: B009
            continue
        cases = variants(section)
        failures: list[Failure] = []
        for case, clock in itertools.product(cases, clocks):
            combination = {**case.swept, **_prefixed("sampling", clock.swept)}
            for path, message in _of_estimator(case.options, clock.options):
                failures.append((("estimators", name, *path), message, combination))
        yield from grouped(failures, len(cases) * len(clocks))
        for case in cases[:1] if not signals else cases:
            if signals and not _fits(case.options, signals[0].options, disturbances):
                count = len(signals[0].options.tones)
                sine = any(isinstance(item, SineDisturbance) for item in disturbances)
                more = ", or one more for the sinusoid that disturbs it" if sine else ""
                message = f"must be {count}, as many as the signal has{more}, not {case.options.tones}"
                yield ("estimators", name, "tones"), message
                break


def signal_warnings(spec: Spec) -> list[Complaint]:
    """What is allowed but unwise in an experiment on a signal."""
    if spec.signal is None:
        return []
    signal = variants(spec.signal)[0].options
    clocks = variants(spec.sampling) if spec.sampling is not None else []
    warnings: list[Complaint] = []
    for name, section in spec.estimators.items():
        cases = variants(section)
        aliased = [
            (
                ("estimators", name, "h"),
                f"with h = {case.options.h:g} s, frequencies above pi/h = {math.pi / case.options.h:.4g} rad/s are "
                f"seen as lower ones, and the signal has {signal.highest_frequency:g} rad/s",
                case.swept,
            )
            for case in cases
            if hasattr(case.options, "h") and signal.highest_frequency > math.pi / case.options.h
        ]
        warnings += grouped(aliased, len(cases))
        rounded = [
            (("estimators", name, "h"), note, {**case.swept, **_prefixed("sampling", clock.swept)})
            for case, clock in itertools.product(cases, clocks)
            if case.options.online
            for note in case.options.start(clock.options.interval).notes
        ]
        warnings += grouped(rounded, len(cases) * len(clocks))
        if not cases[0].options.online and signal.frequency_steps:
            message = "gives one estimate of the whole record, in which a frequency steps"
            warnings.append((("estimators", name, "kind"), message))
    return warnings


def _of_clock(spec: Spec, signal: Variant, clock: Variant) -> Iterator[Failure]:
    combination = {**_prefixed("signal", signal.swept), **_prefixed("sampling", clock.swept)}
    interval = float(clock.options.interval)
    duration = interval * clock.options.samples
    highest = signal.options.highest_frequency
    if highest >= math.pi / interval:
        message = f"samples every {interval:g} s show frequencies below {math.pi / interval:.4g} rad/s, and the signal "
        yield ("sampling", "interval"), f"{message}has {highest:g} rad/s", combination
    for step in signal.options.steps:
        if step >= duration - interval:
            message = f"a step at {step:g} s comes after the last sample, at {duration - interval:g} s"
            yield ("signal", "tones"), message, combination
    if spec.tracks is not None:
        if spec.tracks.interval < interval * (1.0 - 1e-9) or spec.tracks.interval > duration:
            message = f"must lie between the sampling interval, {interval:g} s, and the length of the record, "
            yield ("tracks", "interval"), f"{message}{duration:g} s", combination
        window = spec.tracks.window
        if window is not None and (window[1] > duration * (1 + 1e-9) or window[1] - window[0] < interval):
            message = f"must hold samples of the record, which ends at {duration:g} s"
            yield ("tracks", "window"), message, combination
    by = None if spec.success is None else spec.success.by
    if by is not None and by > duration:
        yield ("success", "by"), f"{by:g} s come after the end of the record, {duration:g} s", combination


def _of_estimator(options: Any, clock: RegularSampling) -> Iterator[Complaint]:
    if not options.online:
        yield from _of_batch(options, clock)
        return
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
        yield (
            ("h",),
            f"its delays are filled after {filled:g} s, and the record ends at {duration:g} s; take a smaller h",
        )
        return
    try:
        with np.errstate(all="ignore"):
            options.start(clock.interval)
    except OptionError as error:
        yield ((error.field,) if hasattr(options, error.field) else ()), str(error)
    except ArithmeticError:
        yield (), "these values are too large or too small to compute with"


def _of_batch(options: Any, clock: RegularSampling) -> Iterator[Complaint]:
    initial = getattr(options, "initial_frequencies", None)
    if initial is not None:
        highest = math.pi / clock.interval
        if max(initial) >= highest:
            yield (
                ("initial_frequencies",),
                f"initial_frequencies must be below {highest:.4g} rad/s, pi over the sampling interval",
            )
        return
    start = options if isinstance(options, Esprit) else Esprit(tones=options.tones, averaging=options.averaging)
    try:
        start.blocks(clock.samples, clock.interval)
    except (OptionError, DataError) as error:
        yield ((error.field,) if hasattr(options, error.field) else ()), str(error)


def _fits(options: Any, signal: Any, disturbances: list[Any]) -> bool:
    for disturbance in disturbances:
        try:
            true_frequencies(signal, disturbance, options.tones, np.zeros(1))
        except ValueError:
            return False
    return True


def _prefixed(section: str, combination: Mapping[KeyPath, Any]) -> dict[KeyPath, Any]:
    return {(section, *path): value for path, value in combination.items()}
