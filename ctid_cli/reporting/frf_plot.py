"""Figure of a frequency response without a model, and its part in the background of a model's response."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.inference.frequency_response import FrequencyResponse
from ctid_cli.inference.units import Units
from ctid_cli.reporting.figures.style import BAND, DARK, LIGHT, MARK, MIDDLE, Drawing, name_axes, plain

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def frf_drawing(found: FrequencyResponse, units: Units, title: str) -> Drawing:
    """Return a figure of gain, phase and coherence over frequency."""

    def draw(figure: Figure) -> None:
        gain, phase, coherence = figure.subplots(3, 1, sharex=True, height_ratios=[2.2, 1.5, 0.9])
        draw_points(gain, phase, found, label=f"estimate, {found.method}")
        if found.distortion is not None and found.distortion.any():
            level = np.sqrt(found.distortion)
            gain.semilogx(found.frequencies, decibels(level), "x", color=MARK, markersize=3, label="distortion")
        for level, color, line, label in (
            (found.standard_error, MIDDLE, "--", "standard error"),
            (found.bias, LIGHT, ":", "bound of the images of the hold"),
        ):
            if level.any():
                look = {"color": color, "linestyle": line, "linewidth": 0.8}
                gain.semilogx(found.frequencies, decibels(level), **look, label=label)
        coherence.semilogx(found.frequencies, found.coherence, ".", color=DARK, markersize=2.5)
        coherence.set_ylim(-0.05, 1.05)
        name_axes(coherence, y="coherence [-]")
        gain.margins(x=0.02)
        # The bound decreases without limit towards low frequencies.
        lowest = np.nanmin(decibels(np.minimum(np.abs(found.response), np.maximum(found.standard_error, 1e-12))))
        gain.set_ylim(bottom=max(gain.get_ylim()[0], float(lowest) - 12.0))
        name_response(gain, phase, coherence, units)
        gain.set_title(plain(title), loc="left")

    return Drawing(7.5, 6.4, draw)


def name_response(gain: Any, phase: Any, lowest: Any, units: Units) -> None:
    """Label the axes of a frequency response, and draw the legend."""
    name_axes(gain, y=f"gain [{units.amount('dB re 1', units.gain)}]", legend="lower left")
    name_axes(phase, y="phase [°]")
    name_axes(lowest, f"frequency ω [rad/{units.time}]")


def draw_points(
    gain: Any, phase: Any, found: FrequencyResponse, label: str = "without a model", around: Array | None = None
) -> None:
    """Draw gain [dB] and phase [degrees] with pointwise 95 % intervals in grey, over logarithmic frequency.

    A lower end of zero is drawn at a tenth of the standard error; a point without an interval has no bar, and one of
    unknown phase is left out. Phases are unwrapped to be nearest to ``around`` [rad], if given.
    """
    low, high = found.gain_band()
    size = np.abs(found.response)
    floor = np.maximum(low, 0.1 * np.minimum(size, found.standard_error))
    gain.set_xscale("log")
    phase.set_xscale("log")
    nonzero = size > 0
    w, drawn = found.frequencies, nonzero & found.has_interval
    gain.vlines(w[drawn], decibels(floor[drawn]), decibels(high[drawn]), color=BAND, linewidth=1.6, zorder=0)
    gain.plot(w[nonzero], decibels(size[nonzero]), ".", color=MIDDLE, markersize=3, label=label, zorder=1)
    known = found.phase_known()
    angle, half = np.rad2deg(found.phase()[known]), np.rad2deg(found.phase_band()[known])
    if around is not None:
        angle = np.rad2deg(around[known] + np.angle(found.response[known] * np.exp(-1j * around[known])))
    phase.vlines(w[known], angle - half, angle + half, color=BAND, linewidth=1.6, zorder=0)
    phase.plot(w[known], angle, ".", color=MIDDLE, markersize=3, label=label, zorder=1)


def decibels(values: Any) -> Any:
    """Return magnitudes in decibels; NaN if there is none."""
    with np.errstate(divide="ignore"):
        return np.where(values > 0, 20 * np.log10(np.maximum(values, 1e-300)), np.nan)
