"""The tones of a recorded signal over time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ctid_cli.arrays import Array, BoolArray, IndexArray
from ctid_cli.errors import DataError
from ctid_cli.frequency.flags import Flag
from ctid_cli.processors import one_thread
from ctid_cli.progress import calling, reported
from ctid_cli.signals.checks import require_integer, require_positive
from ctid_cli.tones import constants as c
from ctid_cli.tones.check import Readings
from ctid_cli.tones.condition import Conditioned, condition
from ctid_cli.tones.follow import LENGTH, paths_of, readings_at


class Sampled(Protocol):
    """Regularly sampled signal: the interface of records that can be tracked."""

    @property
    def samples(self) -> Array:
        """Signal [signal unit], shape (N,); NaN for a missing sample."""

    @property
    def interval(self) -> float:
        """Sampling interval [s]."""


class MissingLine(NamedTuple):
    """Spectral line in the residual of a record."""

    #: Frequency [rad/s].
    omega: float
    #: Share of the rows whose residual contains it.
    share: float
    #: Median amplitude in these rows [signal unit].
    amplitude: float


@dataclass(frozen=True, eq=False)
class Track:
    """Tones over time: one column for each tone, NaN where it is absent or unknown.

    The frequencies of a row need not ascend.

    Parameters
    ----------
    t : ndarray, shape (N,)
        Instants since the first sample [s].
    omega, error : ndarray, shape (N, n)
        Frequencies and their standard errors [rad/s].
    amplitudes, amplitude_error : ndarray, shape (N, n)
        Amplitudes and their standard errors [signal unit].
    phase : ndarray, shape (N, n)
        Phase at the instant of the row, of ``amplitude sin(phase)`` [rad].
    growth : ndarray, shape (N, n)
        Logarithmic growth of the amplitude [1/s]; negative where it decays.
    rate : ndarray, shape (N, n)
        Rate of change of the frequency [rad/s^2].
    window, middle : ndarray, shape (N, n)
        Length of the window from which the row is estimated [s], and its middle [s since the first sample].
    flags : ndarray of uint16, shape (N, n)
        Bit fields of :class:`~ctid_cli.frequency.flags.Flag`.
    every : float
        Time from one row to the next [s].
    missing : tuple of MissingLine
        Lines of the residual, the strongest first.
    reasons, warnings : tuple of str
        Choices with their reasons, and limitations of the tones, as sentences.
    fitted_interval : float
        Sampling interval of the fitted signal [s].
    kept_of, filter_samples : int
        Decimation factor, and length of the decimation filter [samples].
    longest_window : float
        Longest window [s].
    """

    t: Array
    omega: Array
    error: Array
    amplitudes: Array
    amplitude_error: Array
    phase: Array
    growth: Array
    rate: Array
    window: Array
    middle: Array
    flags: NDArray[np.uint16]
    every: float
    missing: tuple[MissingLine, ...] = ()
    reasons: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    fitted_interval: float = np.nan
    kept_of: int = 1
    filter_samples: int = 1
    longest_window: float = np.nan

    def __post_init__(self) -> None:
        if self.t.ndim != 1 or self.omega.ndim != 2 or self.omega.shape[0] != self.t.size:
            raise DataError(f"a track of {self.t.shape} instants has frequencies of shape {self.omega.shape}")
        for item in fields(self):
            value = getattr(self, item.name)
            if isinstance(value, np.ndarray) and item.name != "t" and value.shape != self.omega.shape:
                raise DataError(f"{item.name} of a track is of shape {value.shape}, not {self.omega.shape}")

    @classmethod
    def of(cls, t: Array, omega: Array, flags: NDArray[np.uint16], every: float, **known: Any) -> Track:
        """Return a track with some of its fields.

        Parameters
        ----------
        t : ndarray, shape (N,)
            Instants [s].
        omega : ndarray, shape (N, n)
            Frequencies [rad/s].
        flags : ndarray, shape (N, n) or (N,)
            Flags of each tone, or of each row.
        every : float
            Time from one row to the next [s].
        **known
            Further fields; NaN if not given.

        Returns
        -------
        Track
            The track.
        """
        names = ("error", "amplitudes", "amplitude_error", "phase", "growth", "rate", "window", "middle")
        parts: dict[str, Any] = {name: np.asarray(known.pop(name, np.full(omega.shape, np.nan))) for name in names}
        each = np.broadcast_to(flags if flags.ndim == 2 else flags[:, None], omega.shape).astype(np.uint16)
        return cls(t=t, omega=omega, flags=each, every=every, **parts, **known)

    @property
    def settings(self) -> dict[str, Any]:
        """Settings of the method, for machine-readable output."""
        return {
            "interval": self.fitted_interval,
            "kept_of": self.kept_of,
            "filter_samples": self.filter_samples,
            "longest_window": self.longest_window,
        }

    @property
    def valid(self) -> BoolArray:
        """True where no flag is set, shape (N, n)."""
        return np.asarray(self.flags == 0)

    @property
    def there(self) -> BoolArray:
        """True unless the tone is known to be absent, shape (N, n)."""
        return np.asarray((self.flags & int(Flag.ABSENT)) == 0)

    def of_accuracy(self, accuracy: float | None) -> Track:
        """Return the track with rows marked invalid if a standard error exceeds ``accuracy``.

        Parameters
        ----------
        accuracy : float or None
            Largest standard error [Hz]; if None, .001 of the frequency.

        Returns
        -------
        Track
            Copy with changed flags.
        """
        limit = c.USUAL_ACCURACY * np.abs(self.omega) if accuracy is None else np.asarray(2.0 * np.pi * accuracy)
        with np.errstate(invalid="ignore"):
            coarse = self.error > limit
        kept = self.flags & np.uint16(~int(Flag.INACCURATE) & 0xFFFF)
        return replace(self, flags=np.where(coarse, kept | np.uint16(Flag.INACCURATE), kept).astype(np.uint16))


@one_thread
@reported("following the tones")
def track(
    record: Sampled,
    tones: int | None = None,
    accuracy: float | None = None,
    every: float | None = None,
    window: float | None = None,
    *,
    on_progress: Callable[[int, int], None] | None = None,
) -> Track:
    """Follow the strongest tones of a recorded signal, or all of them.

    In windows of all lengths, doubled from 64 samples to the whole record, decaying chirps are fitted one by one until
    the whitened residual contains no significant line. At each instant each tone is taken from the longest window with
    no residual line near it, no change within the window, and no other tone too close.

    Parameters
    ----------
    record : Sampled
        Regularly sampled signal: ``samples``, shape (N,), NaN if missing, and ``interval`` [s].
    tones : int, optional
        Number of tones, at most 64; by default all detected ones.
    accuracy : float, optional
        Rows with a larger standard error are invalid [Hz]; by default .001 of the tone's frequency.
    every : float, optional
        Time from row to row [s]; by default a thousandth of the record.
    window : float, optional
        Longest window [s]; by default the record.
    on_progress : callable, optional
        Called with the numbers of completed and of all window lengths.

    Returns
    -------
    Track
        Frequencies ascending, with their standard errors and flags.

    Raises
    ------
    DataError
        If the signal is too short, constant, or contains no detectable tone.

    Examples
    --------
    >>> import numpy as np
    >>> from ctid_cli import track
    >>> from ctid_cli.signals.sampled_signal import SampledSignal
    >>> t = 0.001 * np.arange(2000)
    >>> y = np.sin(2 * np.pi * 50 * t) + 0.01 * np.random.default_rng(1).standard_normal(t.size)
    >>> found = track(SampledSignal(y, 0.001, 0.0, "y.csv", "y", None, "s", None))
    >>> float((np.median(found.omega, axis=0) / (2 * np.pi)).round(2)[0]), bool(found.valid.all())
    (50.0, True)
    """
    samples, interval = record.samples, record.interval
    require_positive("interval", interval, "s")
    for name, value, unit in (("accuracy", accuracy, "Hz"), ("every", every, "s"), ("window", window, "s")):
        if value is not None:
            require_positive(name, value, unit)
    if tones is not None:
        require_integer("tones", tones, 0, c.MOST_TONES)
    ready = condition(samples, interval)
    thin = ready.interval
    longest = _longest(window, thin, ready.samples.size)
    step = max(1.0, (samples.size * interval / c.USUAL_ROWS if every is None else every) / thin)
    places = np.arange(0.0, ready.samples.size - 0.5, step)
    with calling(on_progress, LENGTH):
        found = readings_at(ready.samples, places, longest)
    paths = paths_of(found, places)
    if not paths and tones is None:
        raise DataError(
            f"no tone stands out of {samples.size * interval:.4g} s, in which a tone must turn eight times; use a "
            "longer record, or one with less noise"
        )
    wanted = sorted(paths[: c.MOST_TONES if tones is None else tones], key=lambda path: _middle(found, path))
    columns = _columns(found, wanted, len(wanted) if tones is None else tones, places, ready)
    lost = paths[len(wanted) :][: c.MOST_MISSING]
    highest = max((_middle(found, path) for path in wanted), default=0.0) / (2.0 * np.pi * thin)
    return Track(
        t=places * thin + ready.begins,
        **columns,
        every=step * thin,
        missing=tuple(
            MissingLine(
                _middle(found, path) / thin,
                path.size / places.size,
                ready.scale * float(np.median(found.amplitude[path])),
            )
            for path in lost
        ),
        reasons=(*_counted(len(paths), len(wanted), tones), *ready.reasons, *_windows_used(found, wanted, thin)),
        warnings=tuple(_doubts(len(paths), tones, highest, 0.5 / interval)),
        fitted_interval=thin,
        kept_of=ready.factor,
        filter_samples=ready.weights.size,
        longest_window=longest * thin,
    ).of_accuracy(accuracy)


def _middle(found: Readings, path: IndexArray) -> float:
    """Return the median frequency of a tone [rad/sample]."""
    return float(np.median(found.omega[path]))


def _longest(window: float | None, thin: float, count: int) -> int:
    """Return the length of the longest window [samples]."""
    if window is None:
        return count
    length = round(min(window / thin, count + 1.0))
    if not c.SHORTEST <= length <= count:
        allowed = f"from {c.SHORTEST * thin:.4g} s to {count * thin:.4g} s"
        raise DataError(f"the longest window must be {allowed}, not {window:g} s")
    return length


def _columns(found: Readings, paths: list[IndexArray], count: int, places: Array, ready: Conditioned) -> dict[str, Any]:
    """Return the fields of the track, one column for each tone, in units of the record."""
    thin, scale = ready.interval, ready.scale
    gain = ready.gain(found.omega)
    values = {
        "omega": found.omega / thin,
        "error": found.error / thin,
        "amplitudes": found.amplitude * scale / gain,
        "amplitude_error": found.amplitude_error * scale / gain,
        # Readings use cosines, tracks use sines.
        "phase": np.angle(1j * np.exp(1j * found.phase)),
        "growth": found.growth / thin,
        "rate": found.rate / thin**2,
        "window": found.window * thin,
        "middle": found.middle * thin + ready.begins,
    }
    columns = {name: np.full((places.size, count), np.nan) for name in values}
    flags = np.full((places.size, count), int(Flag.ABSENT), np.uint16)
    present = np.flatnonzero(np.isfinite(ready.samples))
    alone = np.abs(places - present[np.minimum(np.searchsorted(present, places), present.size - 1)])
    alone = np.minimum(alone, np.abs(places - present[np.maximum(np.searchsorted(present, places) - 1, 0)]))
    for k, path in enumerate(paths):
        rows = found.row[path]
        for name, each in values.items():
            columns[name][rows, k] = each[path]
        # Between its readings the tone exists, but no window is free of changes.
        flags[rows[0] : rows[-1] + 1, k] = int(Flag.CHANGE)
        flags[rows, k] = np.where(found.significant[path], 0, int(Flag.ABSENT))
        flags[rows, k] |= np.where(found.resolved[path], 0, int(Flag.UNRESOLVED)).astype(np.uint16)
        # The tone is unknown where a gap is longer than one of its periods.
        flags[rows, k] |= np.where(alone[rows] * found.omega[path] > 2.0 * np.pi, int(Flag.GAP), 0).astype(np.uint16)
    return {**columns, "flags": flags}


def _counted(found: int, count: int, tones: int | None) -> Iterator[str]:
    """Yield a sentence on the number of tones and how it was determined."""
    if tones is None:
        more = f" The strongest {count} of {found} are followed." if found > count else ""
        how = "lines are added until the whitened residual shows none, and kept if they justify their parameters"
        yield f"Tones: {count}, from the record ({how}: minimum description length).{more}"


def _windows_used(found: Readings, paths: list[IndexArray], thin: float) -> Iterator[str]:
    """Yield a sentence on the windows from which the tones were estimated."""
    if paths:
        windows = found.window[np.concatenate(paths)] * thin
        low, middle, high = windows.min(), np.median(windows), windows.max()
        how = "the longest in which no line is left and nothing changes"
        range_ = f"to {high:.4g} s, half of them up to {middle:.4g} s" if low < high else "everywhere"
        yield f"Windows of {low:.4g} s {range_}: {how}."


def _doubts(found: int, tones: int | None, highest: float, nyquist: float) -> Iterator[str]:
    """Yield warnings about the tones; ``highest`` and ``nyquist`` in Hz."""
    if tones is not None and found < tones:
        if found:
            yield f"Only {found} of {tones} tones stand out of the record: the other columns are empty."
        else:
            yield "No tone stands out of the record: the columns are empty."
    if highest > c.SUSPICIOUS * nyquist:
        yield f"The tone at {highest:.6g} Hz may be the image of one above the Nyquist frequency, {nyquist:.6g} Hz."
