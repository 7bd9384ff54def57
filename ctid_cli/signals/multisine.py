"""Sums of sinusoids as inputs."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Literal, get_args

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import OptionError
from ctid_cli.signals import checks
from ctid_cli.signals.clock import check_clock, clock_instants, require_carried
from ctid_cli.signals.crest import low_crest_phases
from ctid_cli.signals.excitation import Excitation
from ctid_cli.signals.held import COINCIDENCE, HeldSignal

Spacing = Literal["linear", "logarithmic", "odd"]
Phases = Literal["random", "schroeder", "low_crest"]
#: Number of the highest harmonic: with phases that are searched for, of a band that is filled, and otherwise.
MAX_SEARCHED, MAX_FILLED, MAX_HARMONIC = 4_000, 10_000, 1_000_000


@dataclass(frozen=True)
class Multisine(Excitation):
    r"""Sum of sinusoids with equal amplitudes, held between clock instants.

    Parameters
    ----------
    lowest_frequency : float, optional
        Lower end of the band [rad/s]; the first tone without a period.
    highest_frequency : float, optional
        Upper end of the band [rad/s], below pi over the (mean) clock period.
    tones : int, optional
        Number of tones, spaced over the band; a single one lies at its lower end. With a period, None takes every
        harmonic in the band.
    amplitude : float, default 1.0
        Root mean square over whole periods of the tones [input unit].
    clock_period : float, optional
        Time for which each value is held [s]; None for a new value at every sampling instant.
    frequencies : tuple of float, optional
        The tones [rad/s], in place of a band.
    spacing : {"linear", "logarithmic", "odd"}, default "linear"
        How the tones are spaced over the band; ``odd`` is linear and keeps odd harmonics of the period only.
    period : float, optional
        Time after which the signal repeats [s]: tones are moved to the nearest harmonics of 2 pi over it.
    phases : {"random", "schroeder", "low_crest"}, default "random"
        ``random`` draws them anew in every data set; ``schroeder`` and ``low_crest``, which needs a period, make the
        peak low and are the same in every data set.

    Raises
    ------
    ValueError
        If neither tones nor a band is given, or both; or the band holds no harmonic of the period.

    Notes
    -----
    Each tone has the amplitude ``amplitude * sqrt(2 / tones)``, whatever the length of the record: a longer record
    begins with the shorter one. Tones that a period moves to the same harmonic become one; odd harmonics tell an
    odd nonlinearity of the system from an even one, which answers at the others.

    Schroeder's phases sweep through the tones in a time T (M. R. Schroeder, IEEE Trans. Inf. Theory 16(1), 1970,
    https://doi.org/10.1109/TIT.1970.1054411): for N equally spaced tones ``phase_k = -pi k (k - 1) / N``, and in
    general ``phase_k - phase_(k-1) = -(w_k - w_(k-1)) T (k - 1) / N``, T being 2 pi over the smallest distance of two
    tones. The peak over the root mean square, the crest factor, is about 1.7 for many equally spaced tones, 1.4
    with ``low_crest`` and 2.6 to 3.5 with random phases; sparse tones, as in logarithmic spacing, have more. The
    descent to ``low_crest`` begins at Schroeder's phases, and may end at others on another processor.

    Examples
    --------
    >>> from ctid_cli.signals.multisine import Multisine
    >>> Multisine(1.0, 6.5, spacing="odd", period=6.283185307).frequencies_used.round(6)
    array([1., 3., 5.])
    """

    kind: ClassVar[str] = "multisine"
    #: Values of an option with which no random number is drawn.
    deterministic_with: ClassVar[dict[str, tuple[str, ...]]] = {"phases": ("schroeder", "low_crest")}

    lowest_frequency: float | None = None
    highest_frequency: float | None = None
    tones: int | None = None
    amplitude: float = 1.0
    clock_period: float | None = None
    frequencies: tuple[float, ...] | None = None
    spacing: Spacing = "linear"
    period: float | None = None
    phases: Phases = "random"

    def __post_init__(self) -> None:
        checks.require_positive("amplitude", self.amplitude, "input unit")
        check_clock(self.clock_period)
        checks.require_choice("spacing", self.spacing, get_args(Spacing))
        checks.require_choice("phases", self.phases, get_args(Phases))
        if self.period is not None:
            checks.require_positive("period", self.period, "s")
        if self.frequencies is None:
            self._check_band()
        else:
            self._check_frequencies(self.frequencies)
        for name, value in (("spacing", "odd"), ("phases", "low_crest")):
            if getattr(self, name) == value and self.period is None:
                raise OptionError("period", f"{name} {value} needs the period [s] of which the tones are harmonics.")
        if self.period is not None:
            self._check_harmonics(self.period)
        if self.frequencies is not None and self.frequencies_used.size < len(self.frequencies):
            harmonic = "" if self.period is None else ", or fall on the same harmonic of the period"
            raise OptionError("frequencies", f"two of the frequencies are the same{harmonic}; leave one out.")
        if self.frequencies_used.size == 0:
            harmonic = f"{'odd ' * (self.spacing == 'odd')}harmonic of {2 * math.pi / (self.period or 1.0):g} rad/s"
            raise OptionError("period", f"there is no {harmonic} in the band; give a longer period, or a wider band.")

    def _check_harmonics(self, period: float) -> None:
        highest = self.band[1] if self.frequencies is None else max(self.frequencies)
        what, most = "the tones are", MAX_HARMONIC
        if self.phases == "low_crest":
            what, most = "low_crest phases are searched for", MAX_SEARCHED
        elif self.tones is None and self.frequencies is None:
            what, most = "a band without tones is filled", MAX_FILLED
        if highest * period / (2 * math.pi) > most:
            raise OptionError("period", f"{what} up to harmonic {most} of the period; give a shorter one.")

    def _check_frequencies(self, frequencies: tuple[float, ...]) -> None:
        object.__setattr__(self, "frequencies", tuple(frequencies))
        for frequency in frequencies:
            checks.require_positive("frequencies", frequency, "rad/s", label="each of the frequencies")
        if self.spacing != "linear":
            raise OptionError("spacing", "spacing is how a band is filled, and frequencies are given; leave it out.")
        for name in ("lowest_frequency", "highest_frequency", "tones"):
            if getattr(self, name) is not None:
                raise OptionError(name, f"{name} is of a band, and frequencies are given; keep one of the two.")

    def _check_band(self) -> None:
        for name in ("lowest_frequency", "highest_frequency"):
            if getattr(self, name) is None:
                raise OptionError(name, f"{name} is missing [rad/s]; give a band, or a list of frequencies.")
            checks.require_positive(name, getattr(self, name), "rad/s")
        low, high = self.band
        if self.tones is not None:
            checks.require_integer("tones", self.tones, 1)
        elif self.period is None:
            raise OptionError("tones", "tones is missing: the number of tones; with a period it may be left out.")
        elif self.spacing == "logarithmic":
            raise OptionError("tones", "tones is missing: the number of tones that are spaced logarithmically.")
        ends = f"{low:g} and {high:g} rad/s"
        if low > high:
            raise OptionError(
                "lowest_frequency", f"lowest_frequency must not exceed highest_frequency; they are {ends}."
            )
        if self.tones is not None and self.tones > 1 and low == high:
            raise OptionError("tones", f"{self.tones} tones need a band, but its ends are {ends}.")

    @property
    def band(self) -> tuple[float, float]:
        """Ends of the band [rad/s]."""
        assert self.lowest_frequency is not None
        assert self.highest_frequency is not None
        return self.lowest_frequency, self.highest_frequency

    @cached_property
    def harmonics(self) -> tuple[int, ...]:
        """Numbers of the harmonics of the period that the tones are."""
        assert self.period is not None
        base, step = 2 * math.pi / self.period, 2 if self.spacing == "odd" else 1
        if self.frequencies is not None:
            return tuple(np.unique(np.maximum(np.rint(np.array(self.frequencies) / base), 1)).astype(int).tolist())
        # An end that is a harmonic up to rounding belongs to the band.
        low = math.ceil(self.band[0] / base * (1 - COINCIDENCE))
        first = low + 1 if step == 2 and low % 2 == 0 else low
        inside = np.arange(first, math.floor(self.band[1] / base * (1 + COINCIDENCE)) + 1, step)
        if self.tones is None or inside.size == 0:
            return tuple(inside.tolist())
        nearest = np.rint((self._spaced(self.tones) / base - first) / step).astype(int)
        return tuple(np.unique(inside[np.clip(nearest, 0, inside.size - 1)]).tolist())

    @cached_property
    def frequencies_used(self) -> Array:
        """Frequencies of the tones [rad/s], ascending."""
        if self.period is not None:
            return 2 * math.pi / self.period * np.array(self.harmonics)
        if self.frequencies is not None:
            return np.unique(self.frequencies)
        assert self.tones is not None
        return self._spaced(self.tones)

    def _spaced(self, tones: int) -> Array:
        return (np.geomspace if self.spacing == "logarithmic" else np.linspace)(*self.band, tones)

    def _phases(self, rng: np.random.Generator) -> Array:
        """Phases of the tones [rad]."""
        frequencies = self.frequencies_used
        if self.phases == "random":
            return rng.uniform(0.0, 2 * math.pi, frequencies.size)
        steps = np.diff(frequencies)
        # By the end of each step as much of the sweep is over as there is power in the tones before.
        over = 2 * math.pi / steps.min(initial=math.inf) * np.arange(1, frequencies.size) / frequencies.size
        schroeder = np.concatenate(([0.0], -np.cumsum(steps * over)))
        return schroeder if self.phases == "schroeder" else low_crest_phases(self.harmonics, tuple(schroeder.tolist()))

    def generate(self, sample_times: Array, rng: np.random.Generator) -> HeldSignal:
        """The sum on its clock, which must carry the highest tone; random phases are drawn."""
        clock = clock_instants(sample_times, self.clock_period)
        frequencies = self.frequencies_used
        require_carried(clock, frequencies[-1], "the multisine's highest tone")
        elapsed = clock - clock[0]
        total = np.zeros(clock.size)
        # One tone at a time: a table of all tones at all instants would not fit in memory for long records.
        for frequency, phase in zip(frequencies, self._phases(rng), strict=True):
            total += np.cos(frequency * elapsed + phase)
        return HeldSignal(clock, self.amplitude * math.sqrt(2 / frequencies.size) * total)
