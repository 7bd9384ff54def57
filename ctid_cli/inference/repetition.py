r"""Shifts after which an input repeats, and the models that it therefore cannot tell apart.

If ``u(t + T) = s u(t) + c`` with s = 1 or -1 wherever the record knows the input, ``(G, tau)`` and ``(s G, tau + T)``
have the same response except where the input before the record matters, up to a constant for s = -1: its static gain
times c, which an offset of the output absorbs.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ctid_cli.arrays import Array, ComplexArray
from ctid_cli.signals.held import HeldSignal, regular_interval

#: Largest mean square difference after a shift, as a fraction of the input's variance: an input repeats; and repeats
#: exactly, up to the rounding of a file with four digits.
ALIKE, EXACT = 0.04, 1e-6
#: Least share of the compared instants that are farther than a sampling interval from a change of the input: the edges
#: of a sampled square wave are displaced by up to one.
AWAY = 0.3
#: Longest shift as a share of the record, for an exact repetition and for one with noise or displaced edges, which
#: must be seen more often.
LONGEST, LONGEST_ALIKE = 0.5, 1 / 3
#: Level of an input, relative to its deviation, that counts as zero.
SAME_LEVEL = 1e-3
#: Relative difference of shifts that count as equal.
SAME = 1e-2
#: Largest number of parts of the least distance of two lines that is tried as their common divisor.
MOST_PARTS = 4
#: Fewest samples of a record whose input may repeat.
FEWEST_SAMPLES = 8
#: Fewest changes of an input that repeats.
FEWEST_CHANGES = 4
#: Points of the grid on which an input with an irregular clock is compared, for each of its breaks.
FINER = 4
SIGNS: tuple[Literal[1, -1], ...] = (-1, 1)


@dataclass(frozen=True)
class Repetition:
    """Shift after which an input repeats, or repeats with the opposite sign."""

    #: Least such shift [s].
    shift: float
    sign: Literal[1, -1]
    #: Level about which the sign changes [input unit]; 0 for an equal sign.
    level: float = 0.0
    #: Whether the input repeats exactly.
    exact: bool = True

    def agrees(self, other: "Repetition") -> bool:
        """Return whether another input repeats after the same shift with the same sign."""
        return self.sign == other.sign and abs(self.shift - other.shift) <= SAME * self.shift


def repetitions_of(signal: HeldSignal, t: Array, period: float | None = None) -> tuple[Repetition, ...]:
    """Return the repetitions of an input between the instants of its record, at most one of each sign.

    With a ``period`` [s] the input is known to repeat after it, before the record too.
    """
    found = [] if period is None else [Repetition(period, 1)]
    if t.size < FEWEST_SAMPLES:
        return tuple(found)
    interval, sampled = regular_interval(t), signal.values if np.array_equal(signal.t, t) else signal.at(t)
    moved = np.append(sampled[1:] != sampled[:-1], False)
    if np.count_nonzero(moved) < FEWEST_CHANGES:
        return tuple(found)
    # The edge of a sampled square wave is anywhere between the sample that shows it and the one before.
    away = 1.0 - moved if 2 * np.count_nonzero(moved) < t.size else np.ones(t.size)
    if interval is None:
        step = float(t[-1] - t[0]) / (FINER * t.size)
        grid = t[0] + step * np.arange(FINER * t.size + 1)
        since = np.clip(np.searchsorted(t, grid + 1e-9 * step, side="right") - 1, 0, t.size - 1)
        u, away = signal.at(grid), away[since]
    else:
        step, u = interval, sampled
    shorter = [each for sign in SIGNS if (each := _of_sign(u, away, step, sign)) is not None]
    found = [each for each in found if all(other.sign != each.sign for other in shorter)] + shorter
    # A whole period follows from half of one.
    half = min((each.shift for each in found if each.sign < 0 and each.exact), default=np.inf)
    return tuple(each for each in found if each.sign < 0 or each.shift < half)


def without_level(repetitions: Sequence[Repetition], signal: HeldSignal) -> tuple[Repetition, ...]:
    """Return the repetitions about a level of zero: another level changes the offset of the output."""
    tolerance = SAME_LEVEL * float(np.std(signal.values))
    return tuple(one for one in repetitions if abs(one.level) <= tolerance)


def range_of(repetitions: Sequence[Repetition]) -> float:
    """Return the length of the range of delays that an input can tell apart [s]; infinite without a repetition."""
    exact = [each.shift for each in repetitions if each.exact]
    # One that is not exact may be distinguished by its difference: the range then covers both signs.
    return min(exact or [(1.5 - 0.5 * each.sign) * each.shift for each in repetitions], default=np.inf)


def _of_sign(u: Array, away: Array, step: float, sign: Literal[1, -1]) -> Repetition | None:
    """Return the least shift after which the input repeats with a sign, exactly or else away from its changes."""
    variance = float(np.var(u))
    for weights, least, longest in ((np.ones(u.size), EXACT, LONGEST), (away, ALIKE, LONGEST_ALIKE)):
        mean, square = _differences(u, weights, sign, int(longest * u.size))
        alike = square <= least * variance
        if sign > 0:
            # A slow input differs little after a short shift.
            alike &= np.maximum.accumulate(square > variance)
        if alike.any():
            first = int(np.argmax(alike))
            last = first + int(np.argmin(alike[first:])) if not alike[first:].all() else alike.size
            lag = 0.5 * (first + last - 1) if least == ALIKE else first
            level = 0.5 * float(mean[int(lag)]) if sign < 0 else 0.0
            return Repetition(step * (lag + 1), sign, level, least == EXACT)
    return None


def _differences(u: Array, weights: Array, sign: int, most: int) -> tuple[Array, Array]:
    """Return mean and mean square about it of ``u(t + T) - s u(t)`` for the first lags; infinite without enough pairs.

    Each pair counts with the product of its weights.
    """
    n, centred = u.size, u - u.mean()
    one, first, second = (np.fft.rfft(weights * power, 2 * n) for power in (np.ones(n), centred, centred**2))

    def products(later: ComplexArray, earlier: ComplexArray) -> Array:
        return np.fft.irfft(later * earlier.conj())[1 : most + 1]

    overlap = n - np.arange(1, most + 1)
    pairs = np.maximum(products(one, one), 0.5)
    mean = (products(first, one) - sign * products(one, first)) / pairs
    square = (products(second, one) + products(one, second) - 2 * sign * products(first, first)) / pairs
    if sign < 0:
        square = square - mean**2
        mean = mean + 2 * u.mean()
    return mean, np.where(pairs >= AWAY * overlap, np.maximum(square, 0.0), np.inf)


def repetitions_of_lines(frequencies: Array) -> tuple[Repetition, ...]:
    """Return the shifts of a delay that multiply a response at all frequencies [rad/s] by 1 or by -1.

    Frequencies that are multiples of one have its period, odd multiples half of it with the opposite sign.
    """
    lines = np.unique(frequencies[frequencies > 0.0])
    for part in range(1, MOST_PARTS + 1) if lines.size > 1 else ():
        step = min(float(np.diff(lines).min()), float(lines[0])) / part
        whole = np.round(lines / step)
        if np.all(np.abs(lines / step - whole) < SAME):
            step = float(lines @ whole / (whole @ whole))
            odd = bool(np.all(whole % 2 == 1)) and 0.0 not in frequencies
            return (Repetition(np.pi / step, -1),) if odd else (Repetition(2 * np.pi / step, 1),)
    return ()


@dataclass(frozen=True)
class Equivalent:
    """Model with another delay and sign that the input cannot tell from an estimate."""

    #: Its delay [s].
    delay: float
    #: Sign of its gain relative to that of the estimate.
    sign: Literal[1, -1]
    #: Name of one of several inputs, else empty.
    input: str = ""
