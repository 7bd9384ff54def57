"""Inputs that move in a few steps: a staircase of one's own, and doublets."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError, OptionError
from ctid_cli.signals import checks
from ctid_cli.signals.excitation import Excitation
from ctid_cli.signals.held import HeldSignal


@dataclass(frozen=True)
class Steps(Excitation):
    """A staircase: values that follow one another at given instants.

    Parameters
    ----------
    times : tuple of float
        When the values begin [s], increasing; the input is zero before the first one.
    levels : tuple of float
        The values [input unit], as many as times; each is held until the next one.

    Raises
    ------
    ValueError
        If the lists differ in length, the times do not increase, or all levels are zero.
    """

    kind: ClassVar[str] = "steps"
    deterministic: ClassVar[bool] = True

    times: tuple[float, ...]
    levels: tuple[float, ...]

    def __post_init__(self) -> None:
        for name, unit in (("times", "s"), ("levels", "input unit")):
            object.__setattr__(self, name, tuple(getattr(self, name)))
            for value in getattr(self, name):
                checks.require_finite(name, value, unit, label=f"each of the {name}")
        if len(self.times) != len(self.levels):
            counts = f"there are {len(self.levels)} of them and {len(self.times)} times"
            raise OptionError("levels", f"levels must be as many as times, and {counts}.")
        if not any(self.levels):
            raise OptionError("levels", "levels must not all be zero [input unit]: such an input excites nothing.")
        if self.times[0] < 0 or (np.diff(self.times) <= 0).any():
            raise OptionError("times", f"times must increase from 0 s on; they are {list(self.times)} s.")

    def generate(self, sample_times: Array, rng: np.random.Generator) -> HeldSignal:
        """The staircase, whose first step must come before the last instant; nothing is drawn."""
        end = float(sample_times[-1])
        if self.times[0] >= end:
            raise DataError(
                f"the first step, at {self.times[0]:g} s, comes too late for a record that ends at {end:g} s"
            )
        return staircase(sample_times, np.array(self.times), np.array(self.levels))


@dataclass(frozen=True)
class Doublets(Excitation):
    """Pairs of pulses, one up and one down, as in flight tests.

    Parameters
    ----------
    width : float
        Length of each of the two pulses [s].
    amplitude : float, default 1.0
        Height of the first pulse, not zero [input unit]; that of the second one is the negative.
    time : float, default 0.0
        When the first pair begins [s].
    count : int, default 1
        Number of pairs.
    pause : float, default 0.0
        Time at zero between two pairs [s].

    Notes
    -----
    A pair leaves an integrating system where it was, and its power lies around ``2.3 / width`` rad/s.
    """

    kind: ClassVar[str] = "doublets"
    deterministic: ClassVar[bool] = True

    width: float
    amplitude: float = 1.0
    time: float = 0.0
    count: int = 1
    pause: float = 0.0

    def __post_init__(self) -> None:
        checks.require_positive("width", self.width, "s")
        checks.require_finite("amplitude", self.amplitude, "input unit")
        if self.amplitude == 0:
            raise OptionError("amplitude", "amplitude must not be zero [input unit]: such pulses excite nothing.")
        checks.require_not_negative("time", self.time, "s")
        checks.require_integer("count", self.count, 1, 1_000_000)
        checks.require_not_negative("pause", self.pause, "s")

    def generate(self, sample_times: Array, rng: np.random.Generator) -> HeldSignal:
        """The pairs, the first of which must come before the last instant; nothing is drawn."""
        end = float(sample_times[-1])
        if self.time >= end:
            raise DataError(f"the doublet at {self.time:g} s comes too late for a record that ends at {end:g} s")
        every = 2 * self.width + self.pause
        count = int(min(self.count, (end - self.time) / every + 1))
        starts = self.time + every * np.arange(count)
        levels = np.tile([self.amplitude, -self.amplitude, 0.0], count)
        times = (starts[:, None] + self.width * np.arange(3)).ravel()
        if self.pause == 0.0:
            # The zero between two pairs has no length; that behind the last one stays.
            inside = np.arange(times.size) % 3 < 2
            inside[-1] = True
            times, levels = times[inside], levels[inside]
        return staircase(sample_times, times, levels)


def staircase(sample_times: Array, times: Array, levels: Array) -> HeldSignal:
    """Values held from given instants on, over one record; zero before the first of them."""
    start, end = float(sample_times[0]), float(sample_times[-1])
    times, levels = times[times <= end], levels[: np.count_nonzero(times <= end)]
    if times[0] > start:
        times, levels = np.concatenate(([start], times)), np.concatenate(([0.0], levels))
    return HeldSignal(times, levels)
