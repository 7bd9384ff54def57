"""The clock of an input: when it takes a new value, and how fast it may move on it."""

import math

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError
from ctid_cli.signals.checks import require_positive
from ctid_cli.signals.held import COINCIDENCE


def check_clock(period: float | None) -> None:
    """Refuse a clock that does not advance; None is the clock of the sampling."""
    if period is not None:
        require_positive("clock_period", period, "s")


def clock_instants(sample_times: Array, period: float | None) -> Array:
    """Instants at which the signal takes a new value, from the first sample to the last."""
    if period is None:
        return sample_times
    duration = float(sample_times[-1] - sample_times[0])
    # An edge that coincides with the last sample counts, on whichever side rounding puts it.
    ticks = math.floor(duration / period + COINCIDENCE) + 1
    return np.asarray(sample_times[0] + period * np.arange(ticks))


def require_carried(clock: Array, frequency: float, what: str) -> None:
    """Refuse a frequency [rad/s] that the clock, at its mean period, cannot carry."""
    mean_period = (clock[-1] - clock[0]) / (clock.size - 1) if clock.size > 1 else math.inf
    limit = math.pi / mean_period
    if frequency >= limit:
        most = f"{limit:g} rad/s = pi / {mean_period:g} s, the most its clock can carry; lower one or the other"
        raise DataError(f"{what}, {frequency:g} rad/s, is not below {most}")
