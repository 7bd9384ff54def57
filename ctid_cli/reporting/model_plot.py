"""Figures of ``ctid model``: responses with their bands, models on a record, residuals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ctid_cli.estimators.model_comparison import ModelOnRecord
from ctid_cli.inference.frequency_response import FrequencyResponse
from ctid_cli.inference.model_responses import FrequencyBand, ResponseBand
from ctid_cli.reporting.figures.style import DARK, LIGHT, Drawing, look, outline, plain
from ctid_cli.reporting.fit_drawings import draw_bode, draw_response
from ctid_cli.reporting.frf_plot import decibels, draw_points, name_axes
from ctid_cli.reporting.identification_plot import curve, draw_autocorrelation, draw_cross_correlation
from ctid_cli.reporting.model_report import NamedFit
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.measurement import Measurement
from ctid_cli.signals.table import split_header

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def _line(k: int) -> dict[str, Any]:
    """The line of the k-th model."""
    return {key: value for key, value in look(k).items() if key in ("color", "linestyle")} | {"linewidth": 1.2}


def response_drawing(
    models: Sequence[NamedFit], bands: Sequence[ResponseBand], what: str, signal: HeldSignal | None = None
) -> Drawing:
    """Responses over time with their bands, above the input that they answer to."""
    units = models[0].units

    def draw(figure: Figure) -> None:
        if signal is None:
            upper = lower = figure.add_subplot()
        else:
            upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[2.6, 1.0])
            style = "steps-post" if signal.hold == "zoh" else "default"
            lower.plot(*outline(signal.t, signal.values), color=DARK, linewidth=0.8, drawstyle=style)
            lower.set_ylabel(f"input [{plain(units.input)}]")
        for k, (model, band) in enumerate(zip(models, bands, strict=True)):
            draw_response(upper, _thinned(band), f"model {plain(model.name)}", **_line(k))
        upper.set_ylabel(f"{what} [{plain(units.gain if signal is None else units.output)}]")
        lower.set_xlabel(f"time [{plain(units.time)}]")
        upper.margins(x=0.0)
        upper.legend(loc="best", fontsize=8)

    return Drawing(7.5, 3.6 if signal is None else 4.8, draw)


def models_bode_drawing(
    models: Sequence[NamedFit], bands: Sequence[FrequencyBand], behind: FrequencyResponse | None
) -> Drawing:
    """Gain and phase with their bands, over the response that a record shows without a model."""
    units = models[0].units

    def draw(figure: Figure) -> None:
        gain, phase = figure.subplots(2, 1, sharex=True, height_ratios=[1.5, 1.0])
        if behind is not None:
            around = np.interp(behind.frequencies, bands[0].frequencies, bands[0].phase)
            draw_points(gain, phase, behind, f"record, {behind.method}", around)
        for k, (model, band) in enumerate(zip(models, bands, strict=True)):
            draw_bode(gain, phase, band, f"model {plain(model.name)}", **_line(k))
        # Points that are all noise lie anywhere.
        for axes, curves, room in (
            (gain, [decibels(band.gain) for band in bands], 25.0),
            (phase, [np.rad2deg(band.phase) for band in bands], 180.0),
        ):
            bottom, top = axes.get_ylim()
            low, high = min(np.nanmin(x) for x in curves), max(np.nanmax(x) for x in curves)
            axes.set_ylim(max(bottom, low - room), min(top, high + room))
        gain.margins(x=0.02)
        name_axes(gain, phase, phase, units)

    return Drawing(7.5, 5.2, draw)


def comparison_drawing(models: Sequence[NamedFit], found: Sequence[ModelOnRecord], measurement: Measurement) -> Drawing:
    """What was measured and what each model answers, above what each leaves."""
    units, record = models[0].units, measurement.record

    def draw(figure: Figure) -> None:
        upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[1.8, 1.0])
        upper.plot(*outline(record.t, record.y), color=LIGHT, linewidth=2.4, label="measured")
        for k in np.argsort([-one.fit_percent for one in found], kind="stable").tolist():
            label = f"{plain(models[k].name)}: {found[k].fit_percent:.4g} %"
            used = np.searchsorted(record.t, found[k].t)
            upper.plot(*curve(record.t, used, found[k].simulated), label=label, **_line(k))
            lower.plot(*curve(record.t, used, found[k].residuals), **_line(k) | {"linewidth": 0.7})
        lower.axhline(0.0, color="black", linewidth=0.6)
        upper.set_ylabel(f"{plain(split_header(measurement.output)[0])} [{plain(units.output)}]")
        lower.set_ylabel(f"residual [{plain(units.output)}]")
        lower.set_xlabel(f"{plain(split_header(measurement.time)[0])} [{plain(units.time)}]")
        upper.margins(x=0.0)
        upper.legend(loc="best", fontsize=8)

    return Drawing(8.0, 5.0, draw)


def residual_drawing(model: NamedFit, one: ModelOnRecord, measurement: Measurement) -> Drawing:
    """Residuals over time, and their correlations with themselves and with the input."""

    def draw(figure: Figure) -> None:
        grid = figure.add_gridspec(2, 2, height_ratios=[1.0, 1.2])
        over_time = figure.add_subplot(grid[0, :])
        t = measurement.record.t
        over_time.plot(*curve(t, np.searchsorted(t, one.t), one.residuals), color=DARK, linewidth=0.7)
        over_time.axhline(0.0, color="black", linewidth=0.6)
        over_time.set_ylabel(f"residual [{plain(model.units.output)}]")
        over_time.set_xlabel(f"{plain(split_header(measurement.time)[0])} [{plain(model.units.time)}]")
        over_time.margins(x=0.0)
        over_time.set_title(plain(f"{model.name} on {measurement.record.name}"), loc="left")
        tests = [] if one.tests is None else [one.tests]
        draw_autocorrelation(figure.add_subplot(grid[1, 0]), tests)
        draw_cross_correlation(figure.add_subplot(grid[1, 1]), tests)

    return Drawing(8.0, 5.0, draw)


def _thinned(band: ResponseBand) -> ResponseBand:
    """A band at no more instants than an eye can tell apart."""
    kept = np.searchsorted(band.t, outline(band.t, band.value)[0])
    parts = {name: getattr(band, name)[kept] for name in ("t", "value", "standard_error", "lower", "upper")}
    return replace(band, **parts)
