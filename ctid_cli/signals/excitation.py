"""Excitations: each input is a frozen dataclass of options that generates a held signal."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import NDArray

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError, OptionError
from ctid_cli.signals import checks
from ctid_cli.signals.held import COINCIDENCE, HeldSignal, Hold
from ctid_cli.signals.measurement import read_held_signal

# fmt: off
#: Taps of a maximal-length feedback register by its number of stages n: ``c[k + n]`` is the parity of ``c[k]`` and the
#: ``c[k + tap]``. The polynomial 1 + sum of x^(n - tap) + x^n is primitive over GF(2), hence the period is 2^n - 1.
#: These are common choices with two or four taps (P. Alfke, Xilinx application note XAPP 052, 1996);
#: the tests verify every period.
TAPS: dict[int, tuple[int, ...]] = {
    2: (1,), 3: (1,), 4: (1,), 5: (2,), 6: (1,), 7: (1,), 8: (2, 3, 4), 9: (4,), 10: (3,), 11: (2,),
    12: (6, 8, 11), 13: (9, 10, 12), 14: (9, 11, 13), 15: (1,), 16: (1, 3, 12), 17: (3,), 18: (7,),
    19: (13, 17, 18), 20: (3,),
}
# fmt: on
#: A positive number, or None for the sampling clock.
ClockPeriod = Annotated[float, checks.require_positive, "s"] | None


class Excitation(ABC):
    """An input: a class of options that generates a held signal."""

    kind: ClassVar[str]
    #: Whether no random numbers are drawn, so that a specification needs no seed.
    deterministic: ClassVar[bool] = False

    @abstractmethod
    def generate(self, sample_times: Array, rng: np.random.Generator) -> HeldSignal:
        """Return the signal over one record.

        Parameters
        ----------
        sample_times : ndarray, shape (N,)
            Sampling instants [s]; the first and the last bound the signal.
        rng : numpy.random.Generator
            Source of all random numbers.

        Returns
        -------
        HeldSignal
            The signal [input unit] on its own clock.

        Raises
        ------
        DataError
            If the signal cannot be generated over these instants.
        """


# --- clock of an input ----------------------------------------------------------------------------------------------


def clock_instants(sample_times: Array, period: float | None) -> Array:
    """Return the instants at which an input changes its value, from the first sample to the last."""
    if period is None:
        return sample_times
    duration = float(sample_times[-1] - sample_times[0])
    # An edge at the last sample counts, even if rounding places it later.
    ticks = math.floor(duration / period + COINCIDENCE) + 1
    return np.asarray(sample_times[0] + period * np.arange(ticks))


# --- random inputs --------------------------------------------------------------------------------------------------


def maximal_length_sequence(stages: int, length: int, state: int) -> NDArray[np.int8]:
    """Return the output of a maximal-length feedback shift register.

    It equals ``scipy.signal.max_len_seq``; importing that takes seconds, in every worker process.
    """
    taps, found = TAPS[stages], np.zeros(max(length, stages), dtype=np.int8)
    found[:stages] = [(state >> k) & 1 for k in range(stages)]
    known, stride = stages, 1
    while known < length:
        # x[n] is the sum modulo 2 of x[n - stages + tap] over all taps and 0, and so at every stride that is a power of
        # two, since squares of polynomials over two elements are those of their terms.
        if 2 * stride * stages <= known:
            stride *= 2
        more = min((stages - max(taps)) * stride, length - known)
        begins = [known - (stages - tap) * stride for tap in (0, *taps)]
        found[known : known + more] = np.bitwise_xor.reduce([found[k : k + more] for k in begins])
        known += more
    return found[:length]


@dataclass(frozen=True)
class Prbs(checks.Checked, Excitation):
    """Pseudo-random binary sequence from a maximal-length feedback register.

    Parameters
    ----------
    stages : int
        Number of stages n of the register, 2 to 20; the sequence repeats after 2^n - 1 clock periods.
    clock_period : float
        Time for which each value is held [s]; independent of the sampling.
    amplitude : float, default 1.0
        Amplitude: the signal is plus or minus this value [input unit].

    Notes
    -----
    The initial state of the register is random, zero excluded, so each data set has another phase of
    the same sequence. Over one period the two values differ in number by one, and the autocorrelation is
    amplitude^2 at lag zero and -amplitude^2 / (2^n - 1) at all other multiples of the clock period.

    Examples
    --------
    >>> import numpy as np
    >>> from ctid_cli.signals.excitation import Prbs
    >>> sample_times = np.array([0.0, 0.3, 1.4])
    >>> signal = Prbs(stages=4, clock_period=0.5).generate(sample_times, np.random.default_rng(0))
    >>> signal.t
    array([0. , 0.5, 1. ])
    """

    kind: ClassVar[str] = "prbs"

    stages: Annotated[int, checks.require_integer, min(TAPS), max(TAPS)]
    clock_period: Annotated[float, checks.require_positive, "s"]
    amplitude: Annotated[float, checks.require_positive, "input unit"] = 1.0

    def generate(self, sample_times: Array, rng: np.random.Generator) -> HeldSignal:
        """Return the sequence on its clock, starting at the first instant; the initial register state is random."""
        clock = clock_instants(sample_times, self.clock_period)
        bits = maximal_length_sequence(self.stages, clock.size, int(rng.integers(1, 2**self.stages)))
        return HeldSignal(clock, np.where(bits == 1, self.amplitude, -self.amplitude))


@dataclass(frozen=True)
class Gbn(checks.Checked, Excitation):
    """Generalised binary noise: two values, with a chance of changing at every tick of a clock.

    Parameters
    ----------
    clock_period : float
        Shortest time for which a value is held [s]; independent of the sampling.
    switching_probability : float, default 0.5
        Probability of a change at each tick [-], above 0 and at most 1. At 0.5 the values are independent.
    amplitude : float, default 1.0
        Amplitude: the signal is plus or minus this value [input unit].

    Notes
    -----
    Both first values are equally likely. A value is held for ``clock_period / switching_probability`` on average,
    and the autocorrelation k ticks apart is ``amplitude^2 (1 - 2 switching_probability)^k``: rare changes put the
    power at low frequencies. With H. J. A. F. Tulleken, *Generalized binary noise test-signal concept for improved
    identification-experiment design*, Automatica 26(1), 1990, https://doi.org/10.1016/0005-1098(90)90156-C, the
    mean holding time is chosen near the time constants that matter.
    """

    kind: ClassVar[str] = "gbn"

    clock_period: Annotated[float, checks.require_positive, "s"]
    switching_probability: Annotated[float, checks.require_share] = 0.5
    amplitude: Annotated[float, checks.require_positive, "input unit"] = 1.0

    def generate(self, sample_times: Array, rng: np.random.Generator) -> HeldSignal:
        """Return the values on their clock, starting at the first instant; first value and changes are random."""
        clock = clock_instants(sample_times, self.clock_period)
        drawn = rng.random(clock.size)
        changes = np.concatenate(([drawn[0] < 0.5], drawn[1:] < self.switching_probability))
        return HeldSignal(clock, np.where(np.cumsum(changes) % 2 == 1, self.amplitude, -self.amplitude))


@dataclass(frozen=True)
class Gaussian(checks.Checked, Excitation):
    """Independent Gaussian values, held between clock instants.

    Parameters
    ----------
    standard_deviation : float, default 1.0
        Standard deviation [input unit].
    clock_period : float, optional
        Time for which each value is held [s]; None for a new value at every sampling instant.
    """

    kind: ClassVar[str] = "gaussian"

    standard_deviation: Annotated[float, checks.require_positive, "input unit"] = 1.0
    clock_period: ClockPeriod = None

    def generate(self, sample_times: Array, rng: np.random.Generator) -> HeldSignal:
        """Return independent values on the clock."""
        clock = clock_instants(sample_times, self.clock_period)
        return HeldSignal(clock, self.standard_deviation * rng.standard_normal(clock.size))


# --- given inputs ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Step(checks.Checked, Excitation):
    """A step from zero.

    Parameters
    ----------
    amplitude : float, default 1.0
        Height [input unit], not zero.
    time : float, default 0.0
        Time of the step [s]; at 0 the input is already high at the first sample.
    """

    kind: ClassVar[str] = "step"
    deterministic: ClassVar[bool] = True

    amplitude: Annotated[float, checks.require_finite, "input unit"] = 1.0
    time: Annotated[float, checks.require_not_negative, "s"] = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.amplitude == 0:
            raise OptionError("amplitude", "amplitude must not be zero [input unit]: such a step excites nothing.")

    def generate(self, sample_times: Array, rng: np.random.Generator) -> HeldSignal:
        """Return the step, which must occur before the last instant; no random numbers are drawn."""
        return Steps((self.time,), (self.amplitude,)).generate(sample_times, rng)


@dataclass(frozen=True)
class Steps(checks.Checked, Excitation):
    """A staircase: values that follow one another at given instants.

    Parameters
    ----------
    times : tuple of float
        Start times of the values [s], increasing; the input is zero before the first one.
    levels : tuple of float
        The values [input unit], as many as times; each is held until the next one.

    Raises
    ------
    ValueError
        If the lists differ in length, the times do not increase, or all levels are zero.
    """

    kind: ClassVar[str] = "steps"
    deterministic: ClassVar[bool] = True

    times: tuple[Annotated[float, checks.require_finite, "s"], ...]
    levels: tuple[Annotated[float, checks.require_finite, "input unit"], ...]

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.times) != len(self.levels):
            counts = f"there are {len(self.levels)} of them and {len(self.times)} times"
            raise OptionError("levels", f"levels must be as many as times, and {counts}.")
        if not any(self.levels):
            raise OptionError("levels", "levels must not all be zero [input unit]: such an input excites nothing.")
        if self.times[0] < 0 or (np.diff(self.times) <= 0).any():
            raise OptionError("times", f"times must increase from 0 s on; they are {list(self.times)} s.")

    def generate(self, sample_times: Array, rng: np.random.Generator) -> HeldSignal:
        """Return the staircase, whose first step must occur before the last instant; no random numbers are drawn."""
        start, end = float(sample_times[0]), float(sample_times[-1])
        if self.times[0] >= end:
            which = f"the {'first ' * (len(self.times) > 1)}step at {self.times[0]:g} s"
            raise DataError(f"{which} comes too late for a record that ends at {end:g} s")
        # Values that begin after the record, or end before it, are not used.
        times = np.array([-np.inf, *self.times])
        used = slice(
            int(np.searchsorted(times, start, side="right")) - 1, int(np.searchsorted(times, end, side="right"))
        )
        return HeldSignal(np.maximum(times[used], start), np.array([0.0, *self.levels])[used])


@dataclass(frozen=True)
class InputFile(checks.Checked, Excitation):
    """The user's own input, from a text (.csv), MATLAB or HDF5 file.

    Parameters
    ----------
    file : str
        Name of the file; its first line names the columns.
    time : str, default "t"
        Column of the break times [s], strictly increasing; they need not be the sampling instants.
    input : str, default "u"
        Column of the values [input unit].
    hold : {"zoh", "foh", "band-limited"}, default "zoh"
        Interpolation of the input between its breaks.
    sha256 : str, optional
        Expected SHA-256 of the file; a specification takes it from the file.

    Notes
    -----
    The input is zero before the file's first instant and keeps its last value after the last one. The file and
    the record have the same time axis: values before the first sample are not used.
    """

    kind: ClassVar[str] = "file"
    deterministic: ClassVar[bool] = True

    file: str
    time: str = "t"
    input: str = "u"
    hold: Hold = "zoh"
    sha256: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.time == self.input:
            raise OptionError("input", f"time and input must be two columns; both are {self.time!r}.")

    def generate(self, sample_times: Array, rng: np.random.Generator) -> HeldSignal:
        """Return the file's signal, starting at the first instant; no random numbers are drawn."""
        whole = read_held_signal(self.file, time=self.time, input=self.input, hold=self.hold)
        start, end = float(sample_times[0]), float(sample_times[-1])
        if whole.t[0] >= end:
            begins = f"the input begins at {whole.t[0]:g} s, and the record ends at {end:g} s"
            raise DataError(f"{self.file}: {begins}; shift the file's times or take more samples")
        # One break beyond the end is kept for interpolation.
        stop = int(np.searchsorted(whole.t, end)) + 1
        times, values = whole.t[:stop], whole.values[:stop]
        if times[0] < start:
            inside = times > start + whole.slack
            times = np.concatenate(([start], times[inside]))
            values = np.concatenate((whole.at([start]), values[inside]))
        return HeldSignal(times, values, self.hold)
