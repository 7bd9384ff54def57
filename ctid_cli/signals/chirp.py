"""A sinusoid whose frequency moves."""

import math
from dataclasses import dataclass
from typing import ClassVar, Literal, get_args

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import OptionError
from ctid_cli.signals import checks
from ctid_cli.signals.clock import check_clock, clock_instants, require_carried
from ctid_cli.signals.excitation import Excitation
from ctid_cli.signals.held import HeldSignal

Sweep = Literal["linear", "logarithmic"]


@dataclass(frozen=True)
class Chirp(Excitation):
    r"""Sinusoid whose frequency moves from one value to another, held between clock instants.

    Parameters
    ----------
    first_frequency : float
        Frequency at the beginning [rad/s].
    last_frequency : float
        Frequency at the end [rad/s]; it may be the lower one. Both lie below pi over the (mean) clock period.
    amplitude : float, default 1.0
        Peak value [input unit].
    sweep : {"linear", "logarithmic"}, default "linear"
        Whether the frequency moves by equal amounts or by equal factors in equal times.
    duration : float, optional
        Time from the first frequency to the last [s], after which the sweep begins anew; None for that of the record.
    clock_period : float, optional
        Time for which each value is held [s]; None for a new value at every sampling instant.

    Notes
    -----
    The signal is ``amplitude sin(phi)``; after a part x of the sweep, of duration T and from w1 to w2, phi is
    ``w1 T x + (w2 - w1) T x^2 / 2`` (linear) or ``w1 T (r^x - 1) / ln r`` with ``r = w2 / w1`` (logarithmic). A linear
    sweep has equal power at all frequencies, a logarithmic one in all octaves.
    """

    kind: ClassVar[str] = "chirp"
    deterministic: ClassVar[bool] = True

    first_frequency: float
    last_frequency: float
    amplitude: float = 1.0
    sweep: Sweep = "linear"
    duration: float | None = None
    clock_period: float | None = None

    def __post_init__(self) -> None:
        checks.require_positive("first_frequency", self.first_frequency, "rad/s")
        checks.require_positive("last_frequency", self.last_frequency, "rad/s")
        checks.require_positive("amplitude", self.amplitude, "input unit")
        checks.require_choice("sweep", self.sweep, get_args(Sweep))
        if self.duration is not None:
            checks.require_positive("duration", self.duration, "s")
        check_clock(self.clock_period)
        if self.first_frequency == self.last_frequency:
            same = f"last_frequency is that of the beginning, {self.first_frequency:g} rad/s"
            raise OptionError("last_frequency", f"{same}; for one frequency use kind: multisine with frequencies.")

    def generate(self, sample_times: Array, rng: np.random.Generator) -> HeldSignal:
        """The sweep on its clock, which must carry its highest frequency; nothing is drawn."""
        clock = clock_instants(sample_times, self.clock_period)
        first, last = self.first_frequency, self.last_frequency
        require_carried(clock, max(first, last), "the chirp's highest frequency")
        elapsed = clock - clock[0]
        duration = float(elapsed[-1]) if self.duration is None else self.duration
        x = elapsed / duration if self.duration is None else elapsed / duration % 1.0
        if self.sweep == "linear":
            phase = (first + 0.5 * (last - first) * x) * x
        else:
            rate = math.log(last / first)
            phase = first * np.expm1(rate * x) / rate
        return HeldSignal(clock, self.amplitude * np.sin(duration * phase))
