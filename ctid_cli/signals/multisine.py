"""Multisine excitation."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, ClassVar, Literal

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError, OptionError
from ctid_cli.signals import checks
from ctid_cli.signals.excitation import ClockPeriod, Excitation, clock_instants
from ctid_cli.signals.held import COINCIDENCE, HeldSignal

Spacing = Literal["linear", "logarithmic"]
Phases = Literal["random", "schroeder"]
#: Maximum number of harmonics of a full band, and highest harmonic otherwise.
MAX_FILLED, MAX_HARMONIC = 10_000, 1_000_000


@dataclass(frozen=True)
class Multisine(checks.Checked, Excitation):
    r"""Sum of sinusoids with equal amplitudes, held between clock instants.

    Parameters
    ----------
    lowest_frequency : float, optional
        Lower end of the band [rad/s]; without a period, the first tone.
    highest_frequency : float, optional
        Upper end of the band [rad/s], below pi over the (mean) clock period.
    tones : int, optional
        Number of tones, spaced over the band; a single one lies at its lower end. With a period, None means every
        harmonic in the band.
    amplitude : float, default 1.0
        Root mean square over whole periods of the tones [input unit].
    clock_period : float, optional
        Time for which each value is held [s]; None for a new value at every sampling instant.
    frequencies : tuple of float, optional
        The tones [rad/s], in place of a band.
    spacing : {"linear", "logarithmic"}, default "linear"
        How the tones are spaced over the band.
    period : float, optional
        Time after which the signal repeats [s]: tones are moved to the nearest harmonics of 2 pi over it.
    phases : {"random", "schroeder"}, default "random"
        ``random`` draws new phases for every data set; ``schroeder`` gives a low peak and is the same in every data
        set.

    Raises
    ------
    ValueError
        If neither tones nor a band is given, or both; or the band holds no harmonic of the period.

    Notes
    -----
    Each tone has the amplitude ``amplitude * sqrt(2 / tones)``, independent of the record length: a longer record
    begins with the shorter one. Tones moved to the same harmonic by a period become one.

    Schroeder's phases sweep through the tones in a time T (M. R. Schroeder, IEEE Trans. Inf. Theory 16(1), 1970,
    https://doi.org/10.1109/TIT.1970.1054411): for N equally spaced tones ``phase_k = -pi k (k - 1) / N``, and in
    general ``phase_k - phase_(k-1) = -(w_k - w_(k-1)) T (k - 1) / N``, T being 2 pi over the smallest distance of two
    tones. The crest factor (peak over root mean square) is about 1.7 for many equally spaced tones, and 2.6 to
    3.5 with random phases; sparse tones, as in logarithmic spacing, have a higher one.

    Examples
    --------
    >>> from ctid_cli.signals.multisine import Multisine
    >>> Multisine(1.0, 4.5, period=6.283185307).frequencies_used.round(6)
    array([1., 2., 3., 4.])
    """

    kind: ClassVar[str] = "multisine"
    #: Values of an option for which no random numbers are drawn.
    deterministic_with: ClassVar[dict[str, tuple[str, ...]]] = {"phases": ("schroeder",)}

    lowest_frequency: Annotated[float, checks.require_positive, "rad/s"] | None = None
    highest_frequency: Annotated[float, checks.require_positive, "rad/s"] | None = None
    tones: Annotated[int, checks.require_integer, 1] | None = None
    amplitude: Annotated[float, checks.require_positive, "input unit"] = 1.0
    clock_period: ClockPeriod = None
    frequencies: tuple[Annotated[float, checks.require_positive, "rad/s"], ...] | None = None
    spacing: Spacing = "linear"
    period: Annotated[float, checks.require_positive, "s"] | None = None
    phases: Phases = "random"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.frequencies is None:
            self._check_band()
            highest, filled = self.band[1], self.tones is None
        else:
            for name in ("lowest_frequency", "highest_frequency", "tones", "spacing"):
                if getattr(self, name) != getattr(type(self), name):
                    raise OptionError(name, f"{name} is of a band, and frequencies are given; keep one of the two.")
            highest, filled = max(self.frequencies, default=0.0), False
        most = MAX_FILLED if filled else MAX_HARMONIC
        if self.period is not None and highest * self.period / (2 * math.pi) > most:
            raise OptionError("period", f"the tones reach beyond harmonic {most} of the period; give a shorter one.")
        if self.frequencies_used.size == 0:
            raise OptionError(
                "period", "the band contains no harmonic of the period; widen the band, or give a longer one."
            )
        if self.frequencies is not None and self.frequencies_used.size < len(self.frequencies):
            raise OptionError("frequencies", "two of the frequencies, or their harmonics, are the same; leave one out.")

    def _check_band(self) -> None:
        for name in ("lowest_frequency", "highest_frequency"):
            if getattr(self, name) is None:
                raise OptionError(name, f"{name} is missing [rad/s]; give a band, or a list of frequencies.")
        if self.tones is None and (self.period is None or self.spacing == "logarithmic"):
            why = "with a period and linear spacing it may be left out"
            raise OptionError("tones", f"tones is missing, the number of tones; {why}.")
        low, high = self.band
        if low > high:
            message = f"lowest_frequency must not exceed highest_frequency; they are {low:g} and {high:g} rad/s."
            raise OptionError("lowest_frequency", message)
        if (self.tones or 1) > 1 and low == high:
            raise OptionError("tones", f"{self.tones} tones need a band, but its ends are both {low:g} rad/s.")

    @property
    def band(self) -> tuple[float, float]:
        """Ends of the band [rad/s]."""
        assert self.lowest_frequency is not None
        assert self.highest_frequency is not None
        return self.lowest_frequency, self.highest_frequency

    @cached_property
    def frequencies_used(self) -> Array:
        """Frequencies of the tones [rad/s], ascending."""
        base = None if self.period is None else 2 * math.pi / self.period
        if self.frequencies is not None:
            given = np.unique(self.frequencies)
            return given if base is None else np.asarray(base * np.unique(np.maximum(np.rint(given / base), 1)))
        spaced = np.geomspace if self.spacing == "logarithmic" else np.linspace
        if base is None:
            assert self.tones is not None
            return np.asarray(spaced(*self.band, self.tones))
        # A band edge that equals a harmonic up to rounding belongs to the band.
        first = math.ceil(self.band[0] / base * (1 - COINCIDENCE))
        last = math.floor(self.band[1] / base * (1 + COINCIDENCE))
        if self.tones is None or first > last:
            return np.asarray(base * np.arange(first, last + 1))
        nearest = first + np.rint(spaced(*self.band, self.tones) / base - first)
        return np.asarray(base * np.unique(np.clip(nearest, first, last)))

    def _phases(self, rng: np.random.Generator) -> Array:
        """Return the phases of the tones [rad]."""
        frequencies = self.frequencies_used
        if self.phases == "random":
            return rng.uniform(0.0, 2 * math.pi, frequencies.size)
        steps = np.diff(frequencies)
        # The fraction of the sweep completed by the end of each step is the fraction of power in the tones before.
        over = 2 * math.pi / steps.min(initial=math.inf) * np.arange(1, frequencies.size) / frequencies.size
        return np.concatenate(([0.0], -np.cumsum(steps * over)))

    def generate(self, sample_times: Array, rng: np.random.Generator) -> HeldSignal:
        """Return the sum on its clock, which must be fast enough for the highest tone; phases may be random."""
        clock, frequencies = clock_instants(sample_times, self.clock_period), self.frequencies_used
        elapsed, total = clock - clock[0], np.zeros(clock.size)
        mean_period = elapsed[-1] / (clock.size - 1) if clock.size > 1 else math.inf
        if frequencies[-1] >= (limit := math.pi / mean_period):
            most = f"{limit:g} rad/s = pi / {mean_period:g} s, the most its clock can carry; lower one or the other"
            raise DataError(f"the multisine's highest tone, {frequencies[-1]:g} rad/s, is not below {most}")
        # One tone at a time: a table of all tones at all instants would not fit in memory for long records.
        for frequency, phase in zip(frequencies, self._phases(rng), strict=True):
            total += np.cos(frequency * elapsed + phase)
        return HeldSignal(clock, self.amplitude * math.sqrt(2 / frequencies.size) * total)
