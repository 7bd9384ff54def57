"""A record as the passes take it: one named tuple of plain arrays."""

from math import ceil
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ctid_cli.arrays import Array, BoolArray
from ctid_cli.signals.band_limited import FINER
from ctid_cli.signals.record import Record
from ctid_cli.signals.treatment import OutputHold

#: A delay closer to a whole number of intervals than this fraction of one is that whole number.
WHOLE_INTERVAL = 1e-10
#: Instants closer than this fraction of the shortest interval are one instant, written with different rounding.
ROUNDING_GAP = 1e-9


class FilterData(NamedTuple):
    """A record laid out for the passes.

    Arrays are contiguous and writeable: for any other layout a pass would be compiled again.
    """

    #: Sampling instants [s] and outputs, masked samples bridged by straight lines, shape (N,).
    t: Array
    y: Array
    #: Samples that enter sums: present, and not before the start-up time, shape (N,).
    use: BoolArray
    #: Breaks [s] and values of the input, shape (M,).
    tu: Array
    u: Array
    input_foh: bool
    y_foh: bool
    #: The common interval [s] if input and output share one regular clock, else 0.
    interval: float
    #: Whether input and output have the same instants.
    common_clock: bool
    #: Time [s] by which a break may be late and still count as reached: what rounding makes of one instant.
    slack: float = 0.0

    @property
    def count(self) -> int:  # type: ignore[override]  # what a tuple counts is of no use here
        """Number of samples that enter sums."""
        return int(self.use.sum())

    @property
    def length(self) -> float:
        """Time from the first to the last sample [s]."""
        return float(self.t[-1] - self.t[0])

    @property
    def y_used(self) -> Array:
        """Outputs that enter sums, shape (count,)."""
        return self.y[self.use]


def plain_array(values: ArrayLike) -> Array:
    """A fresh, writeable, contiguous array."""
    return np.array(values, dtype=np.float64, order="C")


def filter_data(
    record: Record, start: float = 0.0, hold_output: OutputHold = "foh", *, periodic: bool = False
) -> FilterData:
    """Lay a record out for filtering; a periodic one repeats itself one interval after its end.

    The samples of a record whose input is band-limited are every k-th point of its finer clock: regular passes are
    many times faster than those over any clock.
    """
    signal = record.input.periodic_lines if periodic else record.input.lines
    slack = 1e-9 * (record.interval or 0.0)
    use = record.valid & (record.t >= record.input.t[0] + start - slack)
    t, y, interval = record.t, record.bridged_y, (record.interval or 0.0) if record.input_on_grid else 0.0
    same = bool(np.array_equal(signal.t, t))
    if signal is not record.input and record.input_on_grid:
        points = np.zeros(signal.t.size, dtype=bool)
        points[::FINER] = use
        t, y, use, interval, same = signal.t, np.interp(signal.t, t, y), points, interval / FINER, False
    return FilterData(
        t=plain_array(t),
        y=plain_array(y),
        use=use,
        tu=plain_array(signal.t),
        u=plain_array(signal.values),
        input_foh=signal.hold == "foh",
        y_foh=hold_output == "foh",
        interval=interval,
        common_clock=same,
        slack=clock_slack(t, signal.t),
    )


def clock_slack(*clocks: Array) -> float:
    """Return a small fraction of the shortest interval of some clocks [s]."""
    shortest = min((float(np.diff(clock).min()) for clock in clocks if clock.size > 1), default=0.0)
    return ROUNDING_GAP * shortest


def used_samples(data: FilterData, record: Record) -> BoolArray:
    """Samples of a record that enter sums, shape (N,)."""
    return data.use if data.use.size == record.n_samples else data.use[::FINER]


def split_delay(delay: float, interval: float) -> tuple[int, float]:
    """Return whole intervals by which the read-out lags, and the fraction of an interval read beyond that break."""
    ratio = delay / interval
    shift = ceil(ratio)
    fraction = shift - ratio
    if fraction > 1.0 - WHOLE_INTERVAL:
        return shift - 1, 0.0
    return shift, fraction if fraction >= WHOLE_INTERVAL else 0.0
