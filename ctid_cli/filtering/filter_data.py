"""Layout of a record for filtering: a named tuple of plain arrays."""

from math import ceil
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ctid_cli.arrays import Array, BoolArray
from ctid_cli.signals.band_limited import FINER
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record
from ctid_cli.signals.treatment import OutputHold

#: A delay within this fraction of an interval of a whole number of intervals is rounded to it.
WHOLE_INTERVAL = 1e-10
#: Instants closer than this fraction of the shortest interval differ by rounding only.
ROUNDING_GAP = 1e-9


class FilterData(NamedTuple):
    """A record laid out for filtering.

    Arrays are contiguous and writeable: any other layout would trigger another compilation.
    """

    #: Sampling instants [s] and outputs, shape (N,); masked samples are interpolated linearly.
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
    #: Time [s] by which a break may be late, due to rounding, and still count as reached.
    slack: float = 0.0
    #: Layouts with each of the further inputs.
    further: tuple["FilterData", ...] = ()

    @property
    def inputs(self) -> tuple["FilterData", ...]:
        """Layouts with each of the inputs."""
        return (self, *self.further)

    @property
    def count(self) -> int:  # type: ignore[override]  # tuple.count is not needed
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
    """Return a new, writeable, contiguous array."""
    return np.array(values, dtype=np.float64, order="C")


def filter_data(
    record: Record, start: float = 0.0, hold_output: OutputHold = "foh", *, periodic: bool = False
) -> FilterData:
    """Lay a record out for filtering; a periodic record repeats one interval after its end.

    The samples of a record with a band-limited input are every k-th point of a finer regular clock, on which filtering
    is many times faster than on an irregular one. All inputs share these points.
    """
    signals = [one.periodic_lines if periodic else one.lines for one in record.held.values()]
    slack = 1e-9 * (record.interval or 0.0)
    known = max(float(one.t[0]) for one in record.held.values()) + start
    use = record.valid & (record.t >= known - slack)
    t, y, on_grid = record.t, record.bridged_y, record.input_on_grid
    interval = (record.interval or 0.0) if on_grid else 0.0
    finer = next((one for one, given in zip(signals, record.held.values(), strict=True) if one is not given), None)
    if finer is not None and on_grid:
        points = np.zeros(finer.t.size, dtype=bool)
        points[::FINER] = use
        t, y, use, interval = finer.t, np.interp(finer.t, t, y), points, interval / FINER
        signals = [_on_points(one, finer.t) for one in signals]
    first, *others = [
        FilterData(
            t=plain_array(t),
            y=plain_array(y),
            use=use,
            tu=plain_array(signal.t),
            u=plain_array(signal.values),
            input_foh=signal.hold == "foh",
            y_foh=hold_output == "foh",
            interval=interval,
            common_clock=finer is None and bool(np.array_equal(signal.t, t)),
            slack=clock_slack(t, signal.t),
        )
        for signal in signals
    ]
    return first._replace(further=tuple(others))


def _on_points(signal: HeldSignal, t: Array) -> HeldSignal:
    """Return a held or piecewise linear signal with a value at every point of a finer clock."""
    return signal if signal.t.size == t.size else HeldSignal(t, signal.at(t), signal.hold)


def clock_slack(*clocks: Array) -> float:
    """Return the rounding tolerance of clocks, a small fraction of their shortest interval [s]."""
    shortest = min((float(np.diff(clock).min()) for clock in clocks if clock.size > 1), default=0.0)
    return ROUNDING_GAP * shortest


def used_samples(data: FilterData, record: Record) -> BoolArray:
    """Return which samples of a record enter sums, shape (N,)."""
    return data.use if data.use.size == record.n_samples else data.use[::FINER]


def split_delay(delay: float, interval: float) -> tuple[int, float]:
    """Return the whole intervals by which the read-out lags, and the fraction of an interval after that break."""
    ratio = delay / interval
    shift = ceil(ratio)
    fraction = shift - ratio
    if fraction > 1.0 - WHOLE_INTERVAL:
        return shift - 1, 0.0
    return shift, fraction if fraction >= WHOLE_INTERVAL else 0.0
