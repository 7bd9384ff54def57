"""Figures of a track: its tones over time, the signal with its spectrogram, and spectra of the residual."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ctid_cli.arrays import Array, BoolArray
from ctid_cli.reporting.figures.style import BAND, DARK, LIGHT, MARK, MIDDLE, Drawing, name_axes, outline, plain, ramp
from ctid_cli.signals.sampled_signal import SampledSignal
from ctid_cli.tones.residual import LeftOver
from ctid_cli.tones.spectrogram import spectrogram
from ctid_cli.tones.track import Track

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TURN = 2.0 * np.pi
#: Up to this number of tones get a panel each, which shows their variation; more share one.
MOST_PANELS = 5
#: Most tones in a legend.
MOST_NAMED = 16
#: The axis of a panel shows the central part of the valid rows, and this much more on both sides.
SHOWN_PERCENT = 98.0
MARGIN = 0.35
#: Amplitudes that differ by more than this factor are drawn on a logarithmic axis.
LOGARITHMIC = 10.0
#: The frequency axes end at this multiple of the highest tone or line, or at the Nyquist frequency.
BEYOND = 2.0
#: Range of a spectrogram [dB].
RANGE_DB = 70.0
#: Most missing lines labelled with their frequency, and depth of the axes below the median of the residual.
NAMED_LINES = 8
BELOW = 30.0


def track_drawing(track: Track, start: float, unit: str | None, title: str) -> Drawing:
    """Return the figure of frequencies over time, with amplitudes below if they are known."""
    t, count = start + track.t, track.omega.shape[1]
    # The highest tone on top; a tone that is never valid lies lowest.
    order = np.argsort([-_middle(track, k) for k in range(count)], kind="stable").tolist()
    panels = [[k] for k in order] if 0 < count <= MOST_PANELS else [order]
    has_amplitudes = bool(np.isfinite(track.amplitudes).any())
    height = 1.15 if len(panels) > 1 else 2.6
    heights = [height] * len(panels) + [1.7] * has_amplitudes

    def draw(figure: Figure) -> None:
        axes = figure.subplots(len(heights), 1, sharex=True, squeeze=False, height_ratios=heights)[:, 0]
        colours = [style["color"] for style in ramp(count)]
        for panel, tones in zip(axes, panels, strict=False):
            _draw_frequencies(panel, track, t, tones, colours)
            name_axes(panel, y="frequency [Hz]" if len(panels) == 1 else f"tone {tones[0] + 1} [Hz]")
        if has_amplitudes:
            _draw_amplitudes(axes[-1], track, t, colours)
            name_axes(axes[-1], y=f"amplitude [{unit}]" if unit else "amplitude")
        axes[0].set_title(plain(title), loc="left")
        name_axes(axes[-1], "t [s]")
        for panel in axes:
            panel.margins(x=0.0)

    return Drawing(7.2, 1.1 + sum(heights), draw)


def _middle(track: Track, k: int) -> float:
    omega = track.omega[:, k]
    omega = omega[track.valid[:, k]] if track.valid[:, k].any() else omega[np.isfinite(omega)]
    return float(np.median(omega)) if omega.size else 0.0


def _draw_frequencies(axes: Any, track: Track, t: Array, tones: list[int], colours: list[Any]) -> None:
    hertz, valid = track.omega / TURN, track.valid
    for k in tones:
        axes.plot(t, np.where(valid[:, k], np.nan, hertz[:, k]), color=colours[k], linewidth=0.4, alpha=0.6)
        _draw_valid(axes, t, hertz[:, k], track.error[:, k] / TURN, valid[:, k], colours[k], "-")
    shown = hertz[:, tones][valid[:, tones]] if valid[:, tones].any() else hertz[:, tones]
    shown = shown[np.isfinite(shown)]
    if shown.size:
        # Stray values may lie outside the axes.
        rest = 0.5 * (100.0 - SHOWN_PERCENT)
        low, high = np.percentile(shown, [rest, 100.0 - rest])
        room = max(MARGIN * (high - low), 1e-4 * high, 1e-12)
        axes.set_ylim(low - room, high + room)
    axes.ticklabel_format(axis="y", useOffset=False)
    _shade(axes, t, np.asarray(~valid[:, tones].any(axis=1)))


def _draw_amplitudes(axes: Any, track: Track, t: Array, colours: list[Any]) -> None:
    for k, style in enumerate(ramp(len(colours))):
        parts = track.amplitudes[:, k], track.amplitude_error[:, k], track.valid[:, k]
        _draw_valid(axes, t, *parts, colours[k], style["linestyle"], label=f"tone {k + 1}")
    seen = track.amplitudes[track.valid]
    seen = seen[np.isfinite(seen) & (seen > 0)]
    if seen.size and np.percentile(seen, 95) > LOGARITHMIC * np.percentile(seen, 5):
        axes.set_yscale("log")
        axes.set_ylim(bottom=0.5 * float(seen.min()))
    elif seen.size:
        axes.set_ylim(0.0, 1.1 * float(seen.max()))
    if 1 < len(colours) <= MOST_NAMED:
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False, fontsize=7)
    _shade(axes, t, np.asarray(~track.valid.any(axis=1)))


def _draw_valid(
    axes: Any, t: Array, values: Array, errors: Array, valid: BoolArray, colour: Any, line: Any, label: str = ""
) -> None:
    """Draw valid values with a band of one standard error where it is known."""
    values = np.where(valid, values, np.nan)
    if np.isfinite(values - errors).any():
        axes.fill_between(t, values - errors, values + errors, color=colour, alpha=0.25, linewidth=0.0)
    # A valid row between two invalid ones would not be visible as a line.
    known = np.isfinite(values)
    lonely = known & ~np.roll(known, 1) & ~np.roll(known, -1)
    style = {"color": colour, "linestyle": line, "linewidth": 1.2, "marker": ".", "markersize": 3, "label": label}
    axes.plot(t, values, markevery=np.flatnonzero(lonely).tolist(), **style)


def _shade(axes: Any, t: Array, grey: BoolArray) -> None:
    """Draw grey bands where no drawn value is valid."""
    if t.size < 2:
        return
    half = 0.5 * float(t[1] - t[0])
    steps = np.diff(np.concatenate(([0], grey.astype(np.int8), [0])))
    for a, b in zip(np.flatnonzero(steps == 1), np.flatnonzero(steps == -1), strict=True):
        axes.axvspan(t[a] - half, t[b - 1] + half, color=BAND, linewidth=0.0, zorder=0)


def highest_shown(track: Track, interval: float) -> float:
    """Return the end of the frequency axes [Hz]."""
    frequencies = [*track.omega[np.isfinite(track.omega)].tolist(), *(line.omega for line in track.missing)]
    nyquist = 0.5 / interval
    return min(nyquist, BEYOND * max(frequencies) / TURN) if frequencies else nyquist


def signal_drawing(signal: SampledSignal, track: Track) -> Drawing:
    """Return the figure of the signal over time, and its spectrogram."""

    def draw(figure: Figure) -> None:
        upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[1.0, 1.6])
        t = signal.start + signal.interval * np.arange(signal.samples.size, dtype=np.float64)
        upper.plot(*outline(t, signal.samples), color=DARK, linewidth=0.6)
        name_axes(upper, y=f"{signal.column} [{signal.unit}]" if signal.unit else signal.column)
        top = highest_shown(track, signal.interval)
        levels, first, last = spectrogram(signal.samples, signal.interval, track, top, RANGE_DB)
        extent = (signal.start + first, signal.start + last, 0.0, top)
        place: dict[str, Any] = {"origin": "lower", "aspect": "auto", "extent": extent}
        image = lower.imshow(levels, cmap="Greys", vmin=-RANGE_DB, vmax=0.0, **place)
        lower.grid(visible=False)
        name_axes(lower, "t [s]", "frequency [Hz]")
        upper.set_xlim(t[0], max(t[-1], t[0] + signal.interval))
        figure.colorbar(image, ax=lower, label="dB below the strongest", pad=0.01)

    return Drawing(8.0, 4.8, draw)


def spectra_drawing(left: LeftOver, track: Track, unit: str | None) -> Drawing:
    """Return the figure of amplitude spectra of the signal and of the residual, with missing lines marked."""

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot()
        top = highest_shown(track, left.interval)
        shown = left.hertz <= top
        hertz, whole, rest = left.hertz[shown], left.signal_spectrum[shown], left.residual_spectrum[shown]
        axes.plot(*outline(hertz, whole), color=LIGHT, linewidth=0.9, label="signal")
        axes.plot(*outline(hertz, rest), color=DARK, linewidth=0.9, label="residual")
        axes.set_yscale("log")
        floor, peak = float(np.median(rest[rest > 0])) if (rest > 0).any() else 1e-9, float(whole.max())
        if peak > 0:
            axes.set_ylim(max(floor / BELOW, 1e-9 * peak), 4.0 * peak)
        _mark_lines(axes, track)
        axes.set_xlim(0.0, top)
        name_axes(axes, "frequency [Hz]", f"amplitude [{unit}]" if unit else "amplitude", legend="upper right")

    return Drawing(8.0, 3.4, draw)


def _mark_lines(axes: Any, track: Track) -> None:
    points = [(line.omega / TURN, line.amplitude) for line in track.missing]
    if points:
        style: dict[str, Any] = {"color": MARK, "markersize": 7, "label": "line that is missing"}
        axes.plot(*zip(*points, strict=True), "v", **style)
    for hertz, amplitude in points[:NAMED_LINES]:
        place = {"xytext": (0, 7), "textcoords": "offset points", "ha": "center", "fontsize": 8, "color": MIDDLE}
        axes.annotate(f"{hertz:.5g}", (hertz, amplitude), **place)
