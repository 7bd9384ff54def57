"""The figures of a track: frequencies over time, and amplitudes below."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from ctid_cli.arrays import Array, BoolArray
from ctid_cli.reporting.figures.style import BAND, Drawing, plain, ramp, spread
from ctid_cli.tones.track import Track

if TYPE_CHECKING:
    from matplotlib.figure import Figure


#: The figure of ``ctid track``, and its halves.
Kind = Literal["tones", "frequencies", "amplitudes"]
#: Up to so many tones get a panel each, which shows how far they move; more share one.
MOST_PANELS = 5
#: The axis of a panel shows the central part of the valid rows, and so much more on both sides.
SHOWN_PERCENT = 98.0
MARGIN = 0.35
#: Amplitudes that differ by more than this factor are drawn on a logarithmic axis.
LOGARITHMIC = 10.0
#: The axis of the others ends at so many times the largest.
HEADROOM = 1.1


def track_drawing(track: Track, start: float, unit: str | None, title: str, kind: Kind | None = None) -> Drawing:
    """A figure of a track: of all that it holds where no kind is given."""
    t, styles = start + track.t, ramp(track.omega.shape[1])[: track.omega.shape[1]]
    panels = min(max(len(styles), 1), MOST_PANELS) if len(styles) <= MOST_PANELS else 1
    upper = 1.15 * panels if panels > 1 else 2.6
    alone = kind if np.isfinite(track.amplitudes).any() or kind == "amplitudes" else "frequencies"

    def draw(figure: Figure) -> None:
        if alone == "frequencies":
            _draw_all_frequencies(figure, figure.add_gridspec(panels, 1), track, t, styles)
            figure.axes[-1].tick_params(labelbottom=True)
            figure.axes[-1].set_xlabel("t [s]")
            figure.axes[-1].margins(x=0.0)
        elif alone == "amplitudes":
            _draw_amplitudes(figure.add_subplot(), track, t, unit, styles)
        else:
            ratios = [1.0] * panels + [1.5] if panels > 1 else [2.2, 1.4]
            grid = figure.add_gridspec(panels + 1, 1, height_ratios=ratios)
            first = _draw_all_frequencies(figure, grid, track, t, styles)
            _draw_amplitudes(figure.add_subplot(grid[-1], sharex=first), track, t, unit, styles)
        figure.axes[0].set_title(plain(title), loc="left")

    heights = {"frequencies": 1.1 + upper, "amplitudes": 3.2}
    return Drawing(7.2, heights.get(alone or "tones", 2.8 + upper), draw)


def _draw_all_frequencies(figure: Figure, grid: Any, track: Track, t: Array, styles: list[dict[str, Any]]) -> Any:
    """Draw the tones into the first places of a grid, and return the first panel."""
    tones = len(styles)
    panels = tones if 0 < tones <= MOST_PANELS else 1
    # The highest tone on top, as on a sheet of music; a tone that is never valid lies lowest.
    order = np.argsort([_middle(track, k) for k in range(tones)])[::-1]
    first: Any = None
    for row in range(panels):
        mine = [int(order[row])] if panels > 1 or tones == 1 else list(range(tones))
        axes = figure.add_subplot(grid[row], sharex=first)
        first = first or axes
        _draw_frequencies(axes, track, t, [(k, styles[k]) for k in mine])
        if panels > 1:
            place: dict[str, Any] = {"xycoords": "axes fraction", "ha": "right", "va": "top", "fontsize": 8}
            axes.annotate(f"tone {mine[0] + 1}", (0.995, 0.92), **place)
        _shade(axes, t, np.all(~track.valid[:, mine], axis=1))
    if panels > 1:
        figure.supylabel("frequency [Hz]", fontsize=9)
    else:
        first.set_ylabel("frequency [Hz]")
    return first


def _middle(track: Track, k: int) -> float:
    omega = track.omega[:, k]
    omega = omega[track.valid[:, k]] if track.valid[:, k].any() else omega[np.isfinite(omega)]
    return float(np.median(omega)) if omega.size else 0.0


def _draw_frequencies(axes: Any, track: Track, t: Array, lines: list[tuple[int, dict[str, Any]]]) -> None:
    frequencies = track.omega / (2.0 * np.pi)
    for k, style in lines:
        valid = track.valid[:, k]
        axes.plot(t, np.where(valid, np.nan, frequencies[:, k]), color=style["color"], linewidth=0.4, alpha=0.6)
        draw_band(axes, t, frequencies[:, k], track.error[:, k] / (2.0 * np.pi), valid, style["color"])
        _line(axes, t, np.where(valid, frequencies[:, k], np.nan), {**style, "linestyle": "-"})
    which = [k for k, _ in lines]
    _limit(axes, frequencies[:, which], track.valid[:, which])
    axes.tick_params(labelbottom=False)
    axes.ticklabel_format(axis="y", useOffset=False)


def draw_band(axes: Any, t: Array, values: Array, errors: Array, valid: BoolArray, color: str) -> None:
    """A band of one standard error, where it is known."""
    known = valid & np.isfinite(errors)
    if known.any():
        low, high = np.where(known, values - errors, np.nan), np.where(known, values + errors, np.nan)
        axes.fill_between(t, low, high, color=color, alpha=0.25, linewidth=0.0)


def _draw_amplitudes(axes: Any, track: Track, t: Array, unit: str | None, styles: list[dict[str, Any]]) -> None:
    ends = []
    for k, style in enumerate(styles):
        values = np.where(track.valid[:, k], track.amplitudes[:, k], np.nan)
        draw_band(axes, t, values, track.amplitude_error[:, k], track.valid[:, k], style["color"])
        _line(axes, t, values, style)
        finite = values[np.isfinite(values)]
        ends.append(float(finite[-1]) if finite.size else np.nan)
    seen = track.amplitudes[track.valid]
    seen = seen[np.isfinite(seen) & (seen > 0)]
    if seen.size and np.percentile(seen, 95) > LOGARITHMIC * np.percentile(seen, 5):
        axes.set_yscale("log")
        axes.set_ylim(bottom=0.5 * float(seen.min()))
    elif seen.size:
        axes.set_ylim(0.0, HEADROOM * float(seen.max()))
    axes.set(xlabel="t [s]", ylabel=f"amplitude [{plain(unit)}]" if unit else "amplitude")
    axes.margins(x=0.0)
    if t.size > 1:
        axes.set_xlim(t[0], t[-1])
    _shade(axes, t, np.all(~track.valid, axis=1))
    if len(ends) > 1:
        _label_ends(axes, np.array(ends))


def _line(axes: Any, t: Array, values: Array, style: dict[str, Any]) -> None:
    # A valid row between two that are not would be no line.
    lonely = np.isfinite(values) & ~np.isfinite(np.roll(values, 1)) & ~np.isfinite(np.roll(values, -1))
    axes.plot(t, values, linewidth=1.2, **style)
    axes.plot(t[lonely], values[lonely], ".", color=style["color"], markersize=3)


def _limit(axes: Any, frequencies: Array, valid: BoolArray) -> None:
    """Show the valid rows; what strays elsewhere may leave the axes."""
    shown = frequencies[valid] if valid.any() else frequencies
    shown = shown[np.isfinite(shown)]
    if not shown.size:
        return
    rest = 0.5 * (100.0 - SHOWN_PERCENT)
    low, high = np.percentile(shown, [rest, 100.0 - rest])
    room = max(MARGIN * (high - low), 1e-4 * high, 1e-12)
    axes.set_ylim(low - room, high + room)


def _shade(axes: Any, t: Array, grey: Any) -> None:
    """Grey bands where nothing that is drawn is valid."""
    if t.size < 2 or not grey.any():
        return
    half = 0.5 * float(t[1] - t[0])
    steps = np.diff(np.concatenate(([0], grey.astype(np.int8), [0])))
    for a, b in zip(np.flatnonzero(steps == 1), np.flatnonzero(steps == -1), strict=True):
        axes.axvspan(t[a] - half, t[b - 1] + half, color=BAND, linewidth=0.0, zorder=0)


def _label_ends(axes: Any, ends: Array) -> None:
    """Numbers of the tones beside the ends of their lines."""
    low, high = axes.get_ylim()
    log = axes.get_yscale() == "log"
    scale = np.log if log else np.asarray
    known = np.flatnonzero(np.isfinite(ends) & (ends > 0))
    if not known.size:
        return
    places = (scale(ends[known]) - scale(low)) / (scale(high) - scale(low))
    for k, place in zip(known, spread(places, 0.1), strict=True):
        axes.annotate(str(k + 1), (1.008, float(place)), xycoords="axes fraction", ha="left", va="center", fontsize=8)
