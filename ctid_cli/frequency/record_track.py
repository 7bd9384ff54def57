"""What is known of the tones of a recorded signal over time, whichever method found it."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ctid_cli.arrays import Array, BoolArray
from ctid_cli.errors import DataError
from ctid_cli.frequency.flags import Flag

#: A tone is accurate if its standard error is at most this share of its frequency, unless another limit is given.
USUAL_ACCURACY = 0.001
#: Most tones that can be asked for.
MOST_ASKED = 20


class MissingLine(NamedTuple):
    """A line that the tones of a record leave over."""

    #: Frequency [rad/s].
    omega: float
    #: Share of the rows in which it was left over; NaN where that is not known.
    share: float
    #: Amplitude where it was left over, a median [signal unit].
    amplitude: float


class Procedure(NamedTuple):
    """How a track was found."""

    method: str
    #: Whether each row knows only the samples before it.
    online: bool
    #: What was chosen, and why: one sentence for each choice.
    reasons: tuple[str, ...]
    warnings: tuple[str, ...]
    #: Plain numbers and words, for programs.
    settings: dict[str, Any]


@dataclass(frozen=True, eq=False)
class RecordTrack:
    """Tones over time: a column is one tone from first to last, NaN where it is not there or where nothing is known.

    All arrays but ``t`` are of shape (N, n); the frequencies of a row need not ascend.
    """

    #: Instants since the first sample [s], shape (N,).
    t: Array
    #: Frequencies and their standard errors [rad/s].
    omega: Array
    error: Array
    #: Amplitudes and their standard errors [signal unit].
    amplitudes: Array
    amplitude_error: Array
    #: Phase at the instant of the row, of ``amplitude sin(phase)`` [rad].
    phase: Array
    #: Logarithmic growth of the amplitude [1/s]; negative where it decays.
    growth: Array
    #: Rate of change of the frequency [rad/s^2].
    rate: Array
    #: Length of the stretch of signal that the row is read from [s].
    window: Array
    #: Bit fields of :class:`~ctid_cli.frequency.flags.Flag`.
    flags: NDArray[np.uint16]
    #: Time from one row to the next [s].
    every: float
    #: Lines that are left over, the strongest first.
    missing: tuple[MissingLine, ...] = ()

    def __post_init__(self) -> None:
        if self.t.ndim != 1 or self.omega.ndim != 2 or self.omega.shape[0] != self.t.size:
            raise DataError(f"a track of {self.t.shape} instants has frequencies of shape {self.omega.shape}")
        for item in fields(self):
            value = getattr(self, item.name)
            if isinstance(value, np.ndarray) and item.name != "t" and value.shape != self.omega.shape:
                raise DataError(f"{item.name} of a track is of shape {value.shape}, not {self.omega.shape}")

    @classmethod
    def of(cls, t: Array, omega: Array, flags: NDArray[np.uint16], every: float, **known: Any) -> RecordTrack:
        """A track of which not everything is known; flags of shape (N,) are those of all tones of their row."""
        names = ("error", "amplitudes", "amplitude_error", "phase", "growth", "rate", "window")
        parts: dict[str, Any] = {name: np.asarray(known.pop(name, np.full(omega.shape, np.nan))) for name in names}
        each = np.broadcast_to(flags if flags.ndim == 2 else flags[:, None], omega.shape).astype(np.uint16)
        return cls(t=t, omega=omega, flags=each, every=every, **parts, **known)

    @property
    def valid(self) -> BoolArray:
        """Where no flag is set, shape (N, n)."""
        return np.asarray(self.flags == 0)

    @property
    def there(self) -> BoolArray:
        """Where a tone is there or may be, shape (N, n)."""
        return np.asarray((self.flags & int(Flag.ABSENT)) == 0)

    @property
    def states_errors(self) -> bool:
        """Whether any standard error of a frequency is known, or there is none to be known."""
        return not self.omega.size or bool(np.isfinite(self.error).any())

    def of_accuracy(self, accuracy: float | None) -> RecordTrack:
        """The same, not valid where a standard error exceeds the accuracy [Hz], by default a share of the frequency."""
        limit = USUAL_ACCURACY * np.abs(self.omega) if accuracy is None else np.asarray(2.0 * np.pi * accuracy)
        with np.errstate(invalid="ignore"):
            coarse = self.error > limit
        kept = self.flags & np.uint16(~int(Flag.INACCURATE) & 0xFFFF)
        return replace(self, flags=np.where(coarse, kept | np.uint16(Flag.INACCURATE), kept).astype(np.uint16))
