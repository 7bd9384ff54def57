"""The figure of ``ctid track --pmu``: frequency, its rate of change, magnitude and angle over time."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.frequency.synchrophasor import SynchrophasorTrack
from ctid_cli.reporting.figures.style import BAND, DARK, Drawing

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def synchrophasor_drawing(track: SynchrophasorTrack, unit: str | None, title: str) -> Drawing:
    """A figure of synchrophasors, grey where a row is not valid."""
    # A turn of the phase is no jump: it is drawn unwound.
    angle = np.full(track.t.size, np.nan)
    angle[track.valid] = np.unwrap(np.angle(track.phasor[track.valid]))
    courses = {
        "frequency [Hz]": track.frequency,
        "ROCOF [Hz/s]": track.rocof,
        f"magnitude [{unit}]" if unit else "magnitude": np.abs(track.phasor),
        "angle [rad]": angle,
    }

    def draw(figure: Figure) -> None:
        axes = figure.subplots(len(courses), 1, sharex=True)
        for panel, (label, course) in zip(axes, courses.items(), strict=True):
            _draw(panel, track, course)
            panel.set_ylabel(label)
        axes[0].set_title(title, loc="left")
        axes[-1].set_xlabel("t [s]")
        figure.align_ylabels()

    return Drawing(7.2, 6.4, draw)


def _draw(axes: Any, track: SynchrophasorTrack, course: Array) -> None:
    valid, across = track.valid, axes.get_xaxis_transform()
    shown = np.where(valid, course, np.nan)
    axes.plot(track.t, shown, color=DARK, linewidth=1.0, marker="." if track.t.size < 60 else None, markersize=3)
    if not valid.all():
        # A row stands for the time up to the next one.
        edges = np.append(track.t, track.t[-1] + 1.0 / track.reporting_rate) - 0.5 / track.reporting_rate
        bad = np.append(~valid, False)
        axes.fill_between(
            edges, 0.0, 1.0, where=bad, step="post", transform=across, color=BAND, linewidth=0.0, zorder=0
        )
    axes.ticklabel_format(axis="y", useOffset=False)
    axes.margins(x=0.0)
