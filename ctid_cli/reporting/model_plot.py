"""Figures of a fitted model: validation, responses over frequency and time, poles, and the delay."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from ctid_cli.arrays import ComplexArray
from ctid_cli.errors import DataError
from ctid_cli.estimators.identification import DelayCosts, Identification, Validation, costs_about_delay, models_of
from ctid_cli.inference.frequency_response import FrequencyResponse, estimate_frequency_response
from ctid_cli.inference.model_responses import FrequencyBand, PoleBand, ResponseBand
from ctid_cli.inference.units import Units
from ctid_cli.models.several_inputs import fractions_of
from ctid_cli.reporting.document import Section
from ctid_cli.reporting.figures.style import BAND, DARK, MARK, MIDDLE, Drawing, name_axes, plain
from ctid_cli.reporting.fit_plot import MOST_DRAWN, FitFigures, draw_overlay
from ctid_cli.reporting.frf_plot import decibels, draw_points, name_response
from ctid_cli.reporting.pages.page import Chapter, shown
from ctid_cli.signals.measurement import Measurement

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Number of points of an ellipse.
AROUND = np.linspace(0.0, 2 * np.pi, 121)
#: Number of frequencies at which a model is drawn.
POINTS = 500
#: Line style of a model.
LINE: dict[str, Any] = {"color": DARK, "linewidth": 1.2}
#: Bands of the gain [dB] are cut at this distance from it; a wider band of the phase [degrees] is not informative.
WIDEST_GAIN, WIDEST_PHASE = 40.0, 180.0


def validation_drawing(outcome: Validation, measurement: Measurement, units: Units) -> Drawing:
    """Return the figure of measured and simulated output of the validation record."""

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot()
        draw_overlay(axes, measurement, outcome.applied.used[0], outcome.applied.residuals[0], units)
        axes.margins(x=0.0)
        name_axes(axes, units.column(measurement, "time"))

    return Drawing(8.0, 2.8, draw)


def bode_drawing(band: FrequencyBand, found: FrequencyResponse | None, units: Units) -> Drawing:
    """Return the figure of gain [dB] and phase [degrees] of a model, over the response estimated without a model."""

    def draw(figure: Figure) -> None:
        gain, phase = figure.subplots(2, 1, sharex=True, height_ratios=[1.4, 1.0])
        if found is not None:
            around = np.interp(found.frequencies, band.frequencies, band.phase)
            draw_points(gain, phase, found, "without a model", around)
        draw_bode(gain, phase, band, units)

    return Drawing(8.0, 4.8, draw)


def draw_bode(gain: Any, phase: Any, band: FrequencyBand, units: Units) -> None:
    """Draw gain [dB] and phase [degrees] of a model with their bands."""
    w, size, angle = band.frequencies, decibels(band.gain), np.rad2deg(band.phase)
    low = np.maximum(decibels(band.gain_lower), size - WIDEST_GAIN)
    gain.fill_between(w, low, np.minimum(decibels(band.gain_upper), size + WIDEST_GAIN), **_shade(band.level))
    lower, upper = np.rad2deg(band.phase_lower), np.rad2deg(band.phase_upper)
    phase.fill_between(w, lower, upper, where=upper - lower <= WIDEST_PHASE, **_shade(band.level))
    for axes, values in ((gain, size), (phase, angle)):
        axes.semilogx(w, values, label="model", **LINE)
    name_response(gain, phase, phase, units)


def step_drawing(band: ResponseBand, units: Units) -> Drawing:
    """Return the figure of the unit step response, with its band."""
    return Drawing(8.0, 2.8, lambda figure: draw_step(figure.add_subplot(), band, units))


def draw_step(axes: Any, band: ResponseBand, units: Units) -> None:
    """Draw the unit step response, with its band."""
    axes.fill_between(band.t, band.lower, band.upper, **_shade(band.level))
    axes.plot(band.t, band.value, label="model", **LINE)
    axes.margins(x=0.0)
    name_axes(axes, f"time after the step [{units.time}]", units.label("output", units.gain), legend="best")


def _shade(level: float) -> dict[str, Any]:
    """Return the style of the band of a model."""
    return {"color": DARK, "alpha": 0.25, "linewidth": 0.0, "label": f"{100 * level:.3g} % band of the model"}


def inputs_drawing(figures: FitFigures) -> Drawing:
    """Return output, residuals and their correlation of a fit with several inputs, and a row for each input."""
    models, n = models_of(figures.result), figures.drawn

    def draw(figure: Figure) -> None:
        heights = [2.0, 1.2] * n + [2.0] + [1.4, 1.0] * len(models)
        grid = figure.add_gridspec(len(heights), 2, height_ratios=heights)
        figures.draw_experiments(figure, grid)
        figures.draw_autocorrelation(figure.add_subplot(grid[2 * n, 0]))
        figures.draw_cross_correlation(figure.add_subplot(grid[2 * n, 1]))
        for k, (name, model) in enumerate(models.items()):
            row, units = 2 * n + 1 + 2 * k, figures.units.of_input(k)
            step, gain = figure.add_subplot(grid[row : row + 2, 0]), figure.add_subplot(grid[row, 1])
            draw_step(step, model.step_response(), units)
            draw_bode(gain, figure.add_subplot(grid[row + 1, 1], sharex=gain), model.frequency_response(), units)
            for axes, what in ((step, "unit step response to"), (gain, "frequency response to")):
                axes.set_title(plain(f"{what} {name}"), loc="left")

    return Drawing(8.0, 3.4 * n + 2.8 + 3.2 * len(models), draw)


def poles_drawing(band: PoleBand, zeros: ComplexArray, units: Units) -> Drawing:
    """Return the figure of poles with confidence regions, and zeros, in the complex plane."""

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot()
        axes.axvline(0.0, color=MIDDLE, linewidth=0.8)
        axes.axhline(0.0, color=MIDDLE, linewidth=0.8)
        draw_poles(axes, band)
        if zeros.size:
            axes.plot(zeros.real, zeros.imag, "o", color=MARK, markersize=6, markerfacecolor="none", label="zero")
        axes.margins(0.12)
        if not (band.value.imag.any() or zeros.imag.any()):
            reach = 0.3 * float(np.ptp(axes.get_xlim()))
            axes.set_ylim(-reach, reach)
        rate = f"rad/{units.time}"
        name_axes(axes, f"real part [{rate}]", f"imaginary part [{rate}]", legend="best")

    return Drawing(5.5, 3.8, draw)


def draw_poles(axes: Any, band: PoleBand) -> None:
    """Draw poles with an ellipse each, real poles with an interval."""
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


def delay_drawing(near: DelayCosts, delay: float, units: Units) -> Drawing:
    """Return the cost over delays close to the estimate, with all other parameters free."""

    def draw(figure: Figure) -> None:
        axes, allowed = figure.add_subplot(), near.percent_above(near.allowed)
        share = near.percent_above(near.costs)
        axes.plot(near.delays, share, ".-", color=DARK, linewidth=0.8, markersize=4, label="all other parameters free")
        axes.plot([delay], [0.0], "v", color="black", markersize=7, label=f"estimate {delay:.5g} {plain(units.time)}")
        axes.axhline(allowed, color=MARK, linewidth=0.9, linestyle="--", label="95 % interval: below this")
        axes.set_ylim(top=1.35 * max(float(np.max(share)), allowed))
        name_axes(axes, f"delay [{units.time}]", "cost above the least [%]", legend="upper center")

    return Drawing(5.5, 3.2, draw)


def figure_chapters(figures: FitFigures, main: Drawing, validation: Measurement | None) -> Iterator[Chapter]:
    """Return the figures of a page: the main one, responses, poles, and the cost about the delay."""
    result, units = figures.result, figures.units
    outcome, more = result.validation, len(figures.measurements) - MOST_DRAWN
    several, left = len(models_of(result)) > 1, result.fit.left_over
    what = "responses to each input" if several else "the cost over the delay"
    found = [Section(drawing=main, caption=f"Output, residuals, autocorrelation of the {left}, and {what}.")]
    found += [Section(sentences=[f"{more} more experiments are not drawn."])] if more > 0 else []
    if result.tests and not several:
        caption = f"Correlation of the {left} with the {result.driver}."
        found.append(Section(drawing=figures.cross_correlation(), caption=caption))
    found.append(Section(notes=[test.sentence for test in result.tests]))
    if outcome is not None and validation is not None:
        caption = f"Validation record {shown(outcome.name)}; only its initial state and offset are estimated from it."
        found.append(Section(drawing=validation_drawing(outcome, validation, units), caption=caption))
    yield Chapter("Output", found)
    if not several:
        yield Chapter("Responses", _responses(figures))
    yield poles_chapter(result, units)
    near = None if result.profile is None else costs_about_delay(result)
    if near is not None:
        drawing = delay_drawing(near, figures.delay, units)
        yield Chapter("Delay", [Section(drawing=drawing, caption="Cost about the estimated delay.")])


def poles_chapter(result: Identification, units: Units) -> Chapter:
    """Return the figure of the poles, one for each input."""
    drawn = []
    for (name, model), fraction in zip(models_of(result).items(), fractions_of(result.fit.model), strict=True):
        of = f" of the response to {name}" if name else ""
        poles = poles_drawing(model.poles(), fraction.zeros, units)
        drawn.append(Section(drawing=poles, caption=f"Poles with their regions, and zeros{of}."))
    return Chapter("Poles", drawn)


def _responses(figures: FitFigures) -> list[Section]:
    """Return the model over frequency and time, with the frequency response of the first record without a model."""
    result, units, found = figures.result, figures.units, None
    notes: list[str] = []
    w = result.frequency_response().frequencies
    try:
        found = estimate_frequency_response(figures.measurements[0].record, time_unit=units.time)
        notes += found.notes
        w = np.geomspace(min(w[0], found.frequencies[0]), max(w[-1], found.frequencies[-1]), POINTS)
    except DataError as error:
        notes.append(f"The record gives no frequency response without a model: {error}.")
    bode, step = bode_drawing(result.frequency_response(w), found, units), step_drawing(result.step_response(), units)
    return [
        Section(drawing=bode, caption="Frequency response, with pointwise 95 % bands; points without a model."),
        Section(notes=notes),
        Section(drawing=step, caption="Response to a unit step, with its pointwise band."),
    ]
