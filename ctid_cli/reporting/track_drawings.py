"""Figures of a tracked record: the signal with its spectrogram, and spectra of it and of what its tones leave."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.reporting.figures.style import DARK, LIGHT, MARK, MIDDLE, Drawing, outline, plain
from ctid_cli.reporting.track_residual import Spectra
from ctid_cli.signals.sampled_signal import SampledSignal
from ctid_cli.tones.residual import without_spikes
from ctid_cli.tones.track import Track

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TURN = 2.0 * np.pi
#: The frequency axes end at so many times the highest tone or line, or at the Nyquist frequency.
BEYOND = 2.0
#: A spectrogram has so many columns, of segments in which the closest tones are so many bins apart where it is long
#: enough, shows so many decibels, and has at most so many rows.
COLUMNS = 480
RESOLVED_BINS = 8.0
SHORTEST, LONGEST = 64, 2**15
RANGE_DB = 70.0
MOST_ROWS = 360
#: Missing lines that have their frequency beside them, and how far the axes go below the median of what is left.
NAMED_LINES = 8
BELOW = 30.0


def highest_shown(track: Track, interval: float) -> float:
    """Where the frequency axes end [Hz]."""
    frequencies = [*track.omega[np.isfinite(track.omega)].tolist(), *(line.omega for line in track.missing)]
    nyquist = 0.5 / interval
    return min(nyquist, BEYOND * max(frequencies) / TURN) if frequencies else nyquist


def signal_drawing(signal: SampledSignal, track: Track) -> Drawing:
    """The signal over time, and its spectrogram."""

    def draw(figure: Figure) -> None:
        upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[1.0, 1.6])
        t = signal.start + signal.interval * np.arange(signal.samples.size, dtype=np.float64)
        upper.plot(*outline(t, signal.samples), color=DARK, linewidth=0.6)
        upper.set_ylabel(f"{plain(signal.column)} [{plain(signal.unit)}]" if signal.unit else plain(signal.column))
        top = highest_shown(track, signal.interval)
        levels, ends = _spectrogram(without_spikes(signal.samples), signal.interval, track, top)
        first, last = signal.start + ends[0], signal.start + ends[1]
        image = lower.imshow(
            levels,
            origin="lower",
            aspect="auto",
            extent=(first, last, 0.0, top),
            cmap="Greys",
            vmin=-RANGE_DB,
            vmax=0.0,
        )
        lower.grid(visible=False)
        lower.set(xlabel="t [s]", ylabel="frequency [Hz]")
        upper.set_xlim(t[0], max(t[-1], t[0] + signal.interval))
        figure.colorbar(image, ax=lower, label="dB below the strongest", pad=0.01)

    return Drawing(8.0, 4.8, draw)


def _spectrogram(samples: Array, interval: float, track: Track, top: float) -> tuple[Array, tuple[float, float]]:
    """Levels [dB] over frequency, from 0 to `top` [Hz], and time, and where the latter begins and ends [s]."""
    size = min(_segment(samples.size, interval, track), samples.size)
    window = np.hanning(size + 2)[1:-1]
    values = np.where(np.isfinite(samples), samples, 0.0)
    padded = 2 * size
    bins = max(2, int(top * padded * interval) + 1)
    # Of neighbouring bins that share a row the strongest is shown.
    together = -(-bins // MOST_ROWS)
    columns = []
    for first in np.linspace(0, samples.size - size, min(COLUMNS, samples.size - size + 1)).astype(int):
        part = values[first : first + size]
        power = np.abs(np.fft.rfft((part - part.mean()) * window, padded)[:bins])
        columns.append(np.pad(power, (0, -bins % together)).reshape(-1, together).max(axis=1))
    table = np.array(columns).T
    strongest = float(table.max()) or 1.0
    levels = 20.0 * np.log10(np.maximum(table / strongest, 10.0 ** (-RANGE_DB / 20.0)))
    half = 0.5 * size * interval
    return levels, (half, max(samples.size * interval - half, half + interval))


def _segment(count: int, interval: float, track: Track) -> int:
    """Samples in a segment: enough to tell the closest tones apart, not too many to see what moves."""
    middles = np.array(
        [np.median(column[np.isfinite(column)]) for column in track.omega.T if np.isfinite(column).any()]
    )
    known = [0.0, *middles.tolist(), *(line.omega for line in track.missing)]
    apart = np.diff(np.sort(known)) / TURN
    apart = apart[apart > 0.0]
    wanted = RESOLVED_BINS / (float(apart.min()) * interval) if apart.size else 256.0
    return int(np.clip(2.0 ** np.ceil(np.log2(wanted)), SHORTEST, max(SHORTEST, min(LONGEST, count // 8))))


def spectra_drawing(spectra: Spectra, track: Track, unit: str | None, interval: float) -> Drawing:
    """Amplitude spectra of the signal and of what the tones leave, in which missing lines are marked."""

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot()
        top = highest_shown(track, interval)
        shown = spectra.hertz <= top
        hertz = spectra.hertz[shown]
        axes.plot(*outline(hertz, spectra.signal[shown]), color=LIGHT, linewidth=0.9, label="signal")
        axes.plot(*outline(hertz, spectra.residual[shown]), color=DARK, linewidth=0.9, label="what the tones leave")
        axes.set_yscale("log")
        left = spectra.residual[shown]
        floor, peak = float(np.median(left[left > 0])) if (left > 0).any() else 1e-9, float(spectra.signal[shown].max())
        axes.set_ylim(max(floor / BELOW, 1e-9 * peak) if peak > 0 else None, 4.0 * peak if peak > 0 else None)
        _mark_lines(axes, track)
        axes.set_xlim(0.0, top)
        axes.set_xlabel("frequency [Hz]")
        axes.set_ylabel(f"amplitude [{plain(unit)}]" if unit else "amplitude")
        axes.legend(loc="upper right", fontsize=8)

    return Drawing(8.0, 3.4, draw)


def _mark_lines(axes: Any, track: Track) -> None:
    label: str | None = "line that is missing"
    for k, line in enumerate(track.missing):
        axes.plot([line.omega / TURN], [line.amplitude], "v", color=MARK, markersize=7, label=label)
        if k < NAMED_LINES:
            place = {"xytext": (0, 7), "textcoords": "offset points", "ha": "center", "fontsize": 8, "color": MIDDLE}
            axes.annotate(f"{line.omega / TURN:.5g}", (line.omega / TURN, line.amplitude), **place)
        label = None
