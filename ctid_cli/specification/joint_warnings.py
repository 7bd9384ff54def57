"""Warnings about valid but questionable settings of a specification, before anything is run."""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from ctid_cli.errors import DataError
from ctid_cli.models.transfer_function import TransferFunction, cancelled
from ctid_cli.signals.noise import stream
from ctid_cli.specification.joint_checks import MAX_TRIALS, cases_of
from ctid_cli.specification.messages import Violation
from ctid_cli.specification.spec import Spec
from ctid_cli.specification.sweeps import checked, variants

#: Minimum record length beyond the delay, in time constants of the slowest pole: in shorter records the standard
#: error of the pole grows much faster than it would fall with the number of samples in longer ones.
TIME_CONSTANTS = 3.0
#: Input edges within this fraction of the sampling interval of a sample count as simultaneous with it.
ON_TIME = 1e-6


def joint_warnings(spec: Spec) -> list[Violation]:
    """Return the warnings."""
    cases = cases_of(spec)
    warnings = [*checked(cases, CHECKS), *checked(cases, (_of_sampled_input,), MAX_TRIALS)]
    if spec.starts is not None:
        taken = {getattr(variants(section)[0].options, "start_from", None) for section in spec.estimators.values()}
        for name, kind in (("initial_delay", "delay"), ("parameters", "parameters")):
            if getattr(spec.starts, name) and kind not in taken:
                warnings.append((("starts", name), "no estimator here uses a start of this kind; each is run once"))
    return warnings


# --------------------------------------------------------------------------------------------------------------------
# The record


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


# --------------------------------------------------------------------------------------------------------------------
# Estimators


def _of_white_formula(noise: Any, estimator: Any) -> Iterator[Violation]:
    if getattr(noise, "coloured", False) and getattr(estimator, "covariance", "") == "white":
        short = "is for white noise and the noise is coloured, so that the intervals are too short or too long"
        yield ("estimator", "covariance"), f"{short}; write covariance: auto, unless that is the point"


# --------------------------------------------------------------------------------------------------------------------
# Frequencies of a signal


def _of_whole_record(estimator: Any, signal: Any) -> Iterator[Violation]:
    if estimator.whole_record and signal.frequency_steps:
        yield ("estimator", "kind"), "gives one estimate of the whole record, in which a frequency steps"


def _of_warnings(estimator: Any, signal: Any, sampling: Any) -> Iterator[Violation]:
    for name, text in estimator.warnings(sampling.interval, signal.highest_frequency):
        yield ("estimator", name), text


CHECKS = (
    *(_of_runs, _of_slow_sampling, _of_short_record, _of_cancellation),
    *(_of_white_formula, _of_whole_record, _of_warnings),
)
