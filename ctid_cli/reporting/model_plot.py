"""Figures of a fitted model: what it does on another record, over frequency and time, and how well it is known."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ctid_cli.arrays import ComplexArray
from ctid_cli.estimators.identification import DelayCosts, Identification, Validation
from ctid_cli.inference.frequency_response import FrequencyResponse
from ctid_cli.inference.model_responses import FrequencyBand, PoleBand, ResponseBand
from ctid_cli.models.several_inputs import fractions_of
from ctid_cli.reporting.estimate import Units
from ctid_cli.reporting.figures.style import BAND, DARK, MARK, MIDDLE, Drawing, plain
from ctid_cli.reporting.fit_plot import draw_overlay, draw_profile
from ctid_cli.reporting.frf_plot import decibels, draw_points, name_axes
from ctid_cli.signals.measurement import Measurement

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Points of an ellipse.
AROUND = np.linspace(0.0, 2 * np.pi, 121)
#: Bands of the gain [dB] are cut at this distance from it; a wider band of the phase [degrees] says nothing.
WIDEST_GAIN, WIDEST_PHASE = 40.0, 180.0


def validation_drawing(outcome: Validation, measurement: Measurement, units: Units) -> Drawing:
    """Measured and simulated output of the record that the model was validated on."""

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot()
        draw_overlay(axes, measurement, outcome.applied.used[0], outcome.applied.residuals[0], units)
        axes.margins(x=0.0)
        axes.set_xlabel(plain(measurement.label("time", units.time)))

    return Drawing(8.0, 2.8, draw)


def bode_drawing(band: FrequencyBand, found: FrequencyResponse | None, units: Units) -> Drawing:
    """Gain and phase of a model with their bands, over what the record says without a model."""

    def draw(figure: Figure) -> None:
        gain, phase = figure.subplots(2, 1, sharex=True, height_ratios=[1.4, 1.0])
        if found is not None:
            around = np.interp(found.frequencies, band.frequencies, band.phase)
            draw_points(gain, phase, found, "without a model", around)
        draw_bode(gain, phase, band)
        name_axes(gain, phase, phase, units)

    return Drawing(8.0, 4.8, draw)


def draw_bode(gain: Any, phase: Any, band: FrequencyBand, label: str = "model", **look: Any) -> None:
    """One model's gain [dB] and phase [degrees] with their bands, on logarithmic frequency."""
    style: dict[str, Any] = {"color": DARK, "linewidth": 1.2, **look}
    shade: dict[str, Any] = {"color": style["color"], "alpha": 0.25, "linewidth": 0.0}
    w, size, angle = band.frequencies, decibels(band.gain), np.rad2deg(band.phase)
    shade["label"] = f"{100 * band.level:.3g} % band of the {label}"
    low = np.maximum(decibels(band.gain_lower), size - WIDEST_GAIN)
    gain.fill_between(w, low, np.minimum(decibels(band.gain_upper), size + WIDEST_GAIN), **shade)
    lower, upper = np.rad2deg(band.phase_lower), np.rad2deg(band.phase_upper)
    phase.fill_between(w, lower, upper, where=upper - lower <= WIDEST_PHASE, **shade)
    gain.semilogx(w, size, label=label, **style)
    phase.semilogx(w, angle, label=label, **style)


def step_drawing(band: ResponseBand, units: Units) -> Drawing:
    """Response to a step of size one, with its band."""

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot()
        draw_response(axes, band)
        axes.set_xlabel(f"time after the step [{plain(units.time)}]")
        axes.set_ylabel(f"output [{plain(units.gain)}]")
        axes.margins(x=0.0)
        axes.legend(loc="best", fontsize=8)

    return Drawing(8.0, 2.8, draw)


def draw_response(axes: Any, band: ResponseBand, label: str = "model", **look: Any) -> None:
    """One model's response over time with its band."""
    style: dict[str, Any] = {"color": DARK, "linewidth": 1.2, **look}
    words = f"{100 * band.level:.3g} % band of the {label}"
    axes.fill_between(band.t, band.lower, band.upper, color=style["color"], alpha=0.25, linewidth=0.0, label=words)
    axes.plot(band.t, band.value, label=label, **style)


def poles_drawing(band: PoleBand, zeros: ComplexArray, units: Units) -> Drawing:
    """Poles with the regions that hold them, and zeros, in the complex plane."""

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot()
        axes.axvline(0.0, color=MIDDLE, linewidth=0.8)
        axes.axhline(0.0, color=MIDDLE, linewidth=0.8)
        draw_poles(axes, band)
        if zeros.size:
            axes.plot(zeros.real, zeros.imag, "o", color=MARK, markersize=6, markerfacecolor="none", label="zero")
        axes.set_xlabel(f"real part [rad/{plain(units.time)}]")
        axes.set_ylabel(f"imaginary part [rad/{plain(units.time)}]")
        axes.margins(0.12)
        if not (band.value.imag.any() or zeros.imag.any()):
            reach = 0.3 * float(np.ptp(axes.get_xlim()))
            axes.set_ylim(-reach, reach)
        axes.legend(loc="best", fontsize=8)

    return Drawing(5.5, 3.8, draw)


def draw_poles(axes: Any, band: PoleBand) -> None:
    """Poles, with an ellipse each, of a real pole an interval."""
    words: str | None = f"{100 * band.level:.3g} % region"
    for pole, covariance, low, high, reach in zip(
        band.value, band.covariance, band.lower, band.upper, band.reach, strict=True
    ):
        if not np.isfinite([low.real, high.real]).all():
            continue
        if pole.imag == 0:
            axes.plot([low.real, high.real], [0.0, 0.0], "|-", color=DARK, linewidth=2.5, markersize=10, label=words)
        else:
            values, vectors = np.linalg.eigh(covariance)
            ring = (vectors * np.sqrt(np.maximum(values, 0.0)) * reach) @ np.array([np.cos(AROUND), np.sin(AROUND)])
            ends = pole.real + ring[0], pole.imag + ring[1]
            axes.fill(*ends, facecolor=BAND, edgecolor=DARK, linewidth=1.2, label=words)
        words = None
    axes.plot(band.value.real, band.value.imag, "x", color=DARK, markersize=5, markeredgewidth=1.2, label="pole")


def delay_drawing(result: Identification, near: DelayCosts | None, units: Units) -> Drawing:
    """The search over the delay, and beside it the cost so close to the estimate that its minimum is seen."""

    def draw(figure: Figure) -> None:
        panels = figure.subplots(1, 1 if near is None else 2, squeeze=False)[0]
        draw_profile(panels[0], result, units)
        if near is None:
            return
        axes, delay = panels[1], fractions_of(result.fit.model)[0].delay
        share = 100.0 * (near.costs / near.least - 1.0)
        allowed = 100.0 * (near.allowed / near.least - 1.0)
        axes.plot(near.delays, share, ".-", color=DARK, linewidth=0.8, markersize=4, label="all other parameters free")
        axes.plot([delay], [0.0], "v", color="black", markersize=7, label=f"estimate {delay:.5g} {plain(units.time)}")
        axes.axhline(allowed, color=MARK, linewidth=0.9, linestyle="--", label="95 % interval: below this")
        axes.set_xlabel(f"delay [{plain(units.time)}]")
        axes.set_ylabel("cost above the least [%]")
        axes.set_ylim(top=1.35 * max(float(np.max(share)), allowed))
        axes.legend(loc="upper center", fontsize=8)

    return Drawing(5.5 if near is None else 8.0, 3.2, draw)
