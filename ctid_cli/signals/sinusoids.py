"""Sums of sinusoids with steps in frequency and amplitude, and their disturbances."""

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike

from ctid_cli.arrays import Array, IndexArray
from ctid_cli.errors import OptionError
from ctid_cli.signals.checks import Checked, require_finite, require_positive
from ctid_cli.signals.held import COINCIDENCE
from ctid_cli.signals.noise import Noise

PhaseAtSteps = Literal["jump", "continuous"]


@dataclass(frozen=True)
class Piece:
    """A constant value until an instant.

    Parameters
    ----------
    value : float
        Value, in the unit of the quantity.
    until : float, optional
        Instant at which the next piece begins [s]; the last piece has none.
    """

    value: float
    until: float | None = None


Course = float | tuple[Piece, ...]


def _require_course(name: str, course: Course, unit: str, label: str = "") -> None:
    """Refuse values that are not positive, and pieces that are not in order."""
    if not isinstance(course, tuple):
        require_positive(name, course, unit)
        return
    if not course:
        raise OptionError(name, f"{name} must hold at least one piece.")
    for piece in course:
        require_positive(name, piece.value, unit, label=f"the value of a piece of {name}")
    *ends, last = (piece.until for piece in course)
    if last is not None or None in ends:
        raise OptionError(name, f"every piece of {name} but the last needs 'until' [s], and the last has none.")
    if (np.diff(_ends(course), prepend=0.0) <= 0).any():
        raise OptionError(name, f"the pieces of {name} must follow one another from 0 s on; their ends are {ends} s.")


@dataclass(frozen=True)
class Tone(Checked):
    """One sinusoid.

    Parameters
    ----------
    frequency : float or tuple of Piece
        Frequency [rad/s], positive.
    amplitude : float or tuple of Piece, default 1.0
        Amplitude [signal unit], positive.
    phase : float, default 0.0
        Phase at time 0 [rad].

    Raises
    ------
    ValueError
        If a value is not positive, or the pieces are not in order.
    """

    frequency: Annotated[Course, _require_course, "rad/s"]
    amplitude: Annotated[Course, _require_course, "signal unit"] = 1.0
    phase: Annotated[float, require_finite, "rad"] = 0.0


@dataclass(frozen=True)
class SumOfSinusoids(Checked):
    r"""A sum of sinusoids and a constant.

    Parameters
    ----------
    tones : tuple of Tone
        The sinusoids.
    bias : float, default 0.0
        Constant term [signal unit].
    phase_at_steps : {"continuous", "jump"}, default "continuous"
        Phase at a step of a frequency: it is the integral of w (``continuous``), or jumps with
        ``sin(w(t) t + phase)`` (``jump``).

    Raises
    ------
    ValueError
        If there is no tone, or two of them have the same frequency at the same time.

    Notes
    -----
    Each tone is ``A(t) sin(int_0^t w + phase)``; with ``jump`` it is ``A(t) sin(w(t) t + phase)``, whose phase jumps
    when the frequency w steps. At the instant named by a piece, the next piece already applies.

    Examples
    --------
    >>> from ctid_cli.signals.sinusoids import Piece, SumOfSinusoids, Tone
    >>> signal = SumOfSinusoids((Tone(3.0), Tone((Piece(1.0, until=5.0), Piece(2.0)))))
    >>> signal.frequencies_at([0.0, 5.0])
    array([[1., 3.],
           [2., 3.]])
    """

    tones: tuple[Tone, ...]
    bias: Annotated[float, require_finite, "signal unit"] = 0.0
    phase_at_steps: PhaseAtSteps = "continuous"

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.tones:
            raise OptionError("tones", "tones must hold at least one sinusoid.")
        instants = [0.0, *self.frequency_steps]
        for instant, row in zip(instants, self.frequencies_at(instants), strict=True):
            if (np.diff(row) == 0.0).any():
                raise OptionError("tones", f"two tones have the same frequency from {instant:g} s on; leave one out.")

    @property
    def frequency_steps(self) -> tuple[float, ...]:
        """Instants at which a frequency steps [s], ascending."""
        return _steps([tone.frequency for tone in self.tones])

    @property
    def steps(self) -> tuple[float, ...]:
        """Instants at which a frequency or an amplitude steps [s], ascending."""
        return _steps([course for tone in self.tones for course in (tone.frequency, tone.amplitude)])

    @property
    def highest_frequency(self) -> float:
        """Highest frequency of any tone at any time [rad/s]."""
        return float(max(_values(tone.frequency).max() for tone in self.tones))

    def frequencies_at(self, times: ArrayLike) -> Array:
        """Return the frequencies at some instants [rad/s], one row each, ascending."""
        t = np.asarray(times, dtype=float)
        return np.sort(np.column_stack([_course_at(tone.frequency, t) for tone in self.tones]), axis=1)

    def generate(self, times: ArrayLike) -> Array:
        """Return the signal at some instants [signal unit]."""
        t = np.asarray(times, dtype=float)
        total = np.full(t.size, float(self.bias))
        for tone in self.tones:
            if self.phase_at_steps == "jump":
                angle = _course_at(tone.frequency, t) * t
            else:
                angle = _integral(tone.frequency, t)
            total += _course_at(tone.amplitude, t) * np.sin(angle + tone.phase)
        return total


@dataclass(frozen=True)
class UniformDisturbance(Checked):
    """Independent samples, uniform between symmetric bounds.

    Parameters
    ----------
    half_width : float
        Bound of the absolute value of a sample [signal unit].

    Raises
    ------
    ValueError
        If the bound is not positive.
    """

    kind: ClassVar[str] = "uniform"

    half_width: Annotated[float, require_positive, "signal unit"]

    def generate(self, undisturbed: Array, rng: np.random.Generator) -> Array:
        """Draw the disturbance of one record; only the length of the signal matters."""
        return self.half_width * rng.uniform(-1.0, 1.0, undisturbed.size)


@dataclass(frozen=True)
class SineDisturbance(Checked):
    """An additional sinusoid, whose frequency is not estimated.

    Parameters
    ----------
    amplitude : float
        Amplitude [signal unit].
    frequency : float
        Frequency [rad/s].
    phase : float, default 0.0
        Phase at time 0 [rad].

    Raises
    ------
    ValueError
        If amplitude or frequency is not positive.
    """

    kind: ClassVar[str] = "sine"
    #: No random numbers are drawn.
    deterministic: ClassVar[bool] = True

    amplitude: Annotated[float, require_positive, "signal unit"]
    frequency: Annotated[float, require_positive, "rad/s"]
    phase: Annotated[float, require_finite, "rad"] = 0.0

    def at(self, times: Array) -> Array:
        """Return the disturbance at some instants [signal unit]."""
        return self.amplitude * np.sin(self.frequency * times + self.phase)


Disturbance = UniformDisturbance | SineDisturbance | Noise


def disturb(signal: Array, times: Array, disturbance: Disturbance | None, rng: np.random.Generator) -> Array:
    """Add a disturbance to a signal."""
    if disturbance is None:
        return signal
    if isinstance(disturbance, SineDisturbance):
        return signal + disturbance.at(times)
    return signal + disturbance.generate(signal, rng)


def _values(course: Course) -> Array:
    return np.array([piece.value for piece in course] if isinstance(course, tuple) else [course], dtype=float)


def _ends(course: Course) -> Array:
    return np.array([piece.until for piece in course[:-1]] if isinstance(course, tuple) else [], dtype=float)


def _steps(courses: list[Course]) -> tuple[float, ...]:
    changes = [_ends(course)[np.diff(_values(course)) != 0.0] for course in courses]
    return tuple(np.unique(np.concatenate(changes)).tolist())


def _place(course: Course, t: Array) -> IndexArray:
    """Return the number of the piece at each instant; 3 k 0.1 and k 0.3 count as equal despite rounding."""
    return np.searchsorted(_ends(course) * (1.0 - COINCIDENCE), t, side="right")


def _course_at(course: Course, t: Array) -> Array:
    return np.asarray(_values(course)[_place(course, t)])


def _integral(course: Course, t: Array) -> Array:
    values, starts = _values(course), np.concatenate(([0.0], _ends(course)))
    before = np.concatenate(([0.0], np.cumsum(values[:-1] * np.diff(starts))))
    place = _place(course, t)
    return np.asarray(before[place] + values[place] * (t - starts[place]))
