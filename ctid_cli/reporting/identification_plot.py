"""The figure of ``ctid fit``: output, residuals, their correlation, and the search over the delay."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from ctid_cli.arrays import Array, BoolArray
from ctid_cli.estimators.identification import Identification
from ctid_cli.reporting.estimate import Units
from ctid_cli.reporting.figures.style import BAND, DARK, LIGHT, STRIPES, Drawing, outline
from ctid_cli.signals.measurement import Measurement

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: The figure of ``ctid fit``, and its parts.
Kind = Literal["all", "overlay", "residuals", "correlation", "profile"]
#: Experiments that are drawn; the others would leave no room.
MOST_DRAWN = 3


def identification_drawing(
    result: Identification, measurements: Sequence[Measurement], units: Units, kind: Kind | None = None
) -> Drawing:
    """The figure of a fit, or one part of it."""
    drawn = measurements[:MOST_DRAWN]

    def draw(figure: Figure) -> None:
        if kind in ("overlay", "residuals"):
            part = _draw_output if kind == "overlay" else _draw_residuals
            for k, measurement in enumerate(drawn):
                axes = figure.add_subplot(len(drawn), 1, k + 1)
                part(axes, result, measurement, k, units)
                axes.margins(x=0.0)
                _name_panels(axes, axes, measurement, k, len(measurements), units)
        elif kind in ("correlation", "profile"):
            axes = figure.add_subplot()
            if kind == "correlation":
                _draw_correlation(axes, result, measurements)
            else:
                _draw_profile(axes, result, units)
        else:
            _draw_all(figure, result, measurements, units)

    if kind in ("correlation", "profile"):
        return Drawing(5.5, 3.4, draw)
    return Drawing(8.0, 2.8 * len(drawn) if kind in ("overlay", "residuals") else 3.4 * len(drawn) + 2.8, draw)


def _draw_all(figure: Figure, result: Identification, measurements: Sequence[Measurement], units: Units) -> None:
    drawn = measurements[:MOST_DRAWN]
    grid = figure.add_gridspec(2 * len(drawn) + 1, 2, height_ratios=[2, 1.2] * len(drawn) + [2])
    for k, measurement in enumerate(drawn):
        output = figure.add_subplot(grid[2 * k, :])
        error = figure.add_subplot(grid[2 * k + 1, :], sharex=output)
        _draw_output(output, result, measurement, k, units)
        output.tick_params(labelbottom=False)
        output.margins(x=0.0)
        _draw_residuals(error, result, measurement, k, units)
        _name_panels(output, error, measurement, k, len(measurements), units)
    _draw_correlation(figure.add_subplot(grid[-1, 0]), result, measurements)
    _draw_profile(figure.add_subplot(grid[-1, 1]), result, units)


def _draw_output(axes: Any, result: Identification, measurement: Measurement, k: int, units: Units) -> None:
    record, use = measurement.record, result.fit.used[k]
    simulated = outline(*_with_gaps(record.t, use, record.y[use] - result.fit.residuals[k]))
    axes.plot(*outline(record.t, record.y), color=LIGHT, linewidth=2.2, label="measured")
    axes.plot(*simulated, color=DARK, linewidth=0.9, label="simulated")
    weighting = result.fit.weighting
    if weighting is not None and weighting.outliers[k].any():
        little = np.flatnonzero(use)[weighting.outliers[k]]
        axes.plot(record.t[little], record.y[little], "x", color="black", markersize=4, label="counts for little")
    axes.set_ylabel(f"{measurement.output} [{units.output}]")
    axes.legend(loc="lower right", ncols=3, fontsize=8)
    low, high = axes.get_ylim()
    axes.set_ylim(low - 0.18 * (high - low), high)  # room for the legend below the curves


def _draw_residuals(axes: Any, result: Identification, measurement: Measurement, k: int, units: Units) -> None:
    t = measurement.record.t
    axes.plot(*outline(*_with_gaps(t, result.fit.used[k], result.fit.residuals[k])), color=DARK, linewidth=0.7)
    axes.axhline(0.0, color="black", linewidth=0.6)
    axes.set_ylabel(f"residual [{units.output}]")


def _name_panels(upper: Any, lower: Any, measurement: Measurement, k: int, n: int, units: Units) -> None:
    """Name the axis of time below the lower panel, and above the upper one which of n experiments it is."""
    t = measurement.record.t
    thinned = f"; the least and the greatest of each {t.size // STRIPES} samples are drawn"
    lower.set_xlabel(f"{measurement.time} [{units.time}]{thinned * (outline(t, t)[0].size < t.size)}")
    if n > 1:
        upper.set_title(f"experiment {k + 1} of {n}", loc="left")


def _with_gaps(t: Array, use: BoolArray, values: Array) -> tuple[Array, Array]:
    """Values at the used instants, with breaks in the line where samples are missing."""
    full = np.full(t.size, np.nan)
    full[use] = values
    return t, full


def _draw_correlation(axes: Any, result: Identification, measurements: Sequence[Measurement]) -> None:
    axes.set_xlabel("lag [samples]")
    axes.set_ylabel("autocorrelation\nof the residuals [-]")
    if not result.tests:
        axes.text(0.5, 0.5, "too few residuals", ha="center", va="center", transform=axes.transAxes)
        return
    styles = ("o-", "s--", "^:")
    for k, (test, style) in enumerate(zip(result.tests[:MOST_DRAWN], styles, strict=False), start=1):
        lags = np.arange(1, test.lags + 1)
        label = f"experiment {k}" if len(measurements) > 1 else None
        axes.plot(lags, test.autocorrelation, style, color=DARK, markersize=3, linewidth=0.8, label=label)
    band = result.tests[0].autocorrelation_band
    axes.axhspan(-band, band, color=BAND, zorder=0, label=f"{100 * result.tests[0].level:.3g} % band if white")
    axes.axhline(0.0, color="black", linewidth=0.6)
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.25 * (high - low))
    axes.legend(loc="upper right", fontsize=8)


def _draw_profile(axes: Any, result: Identification, units: Units) -> None:
    profile, delay = result.fit.profile, result.fit.model.delay
    axes.set_xlabel(f"delay [{units.time}]")
    axes.set_ylabel(f"cost [({units.output})²]")
    if profile is None:
        axes.plot([delay], [result.fit.cost], "o", color=DARK, label=f"known delay {delay:.4g} {units.time}")
    else:
        whole = profile.samples >= result.fit.count
        behind = "" if whole else f" of the liveliest {profile.samples} samples"
        behind += "" if profile.cutoff is None else f" below {profile.cutoff:.3g} rad/{units.time}"
        axes.plot(
            profile.delays, profile.costs, ".-", color=DARK, linewidth=0.8, markersize=4, label=f"profile{behind}"
        )
        label = f"minimum at {delay:.4g} {units.time}"
        if profile.cutoff is None and whole:
            axes.plot([delay], [result.fit.cost], "v", color="black", markersize=7, label=label)
        else:
            # The cost of the estimate is that of all frequencies and samples.
            axes.axvline(delay, color="black", linewidth=0.8, label=label)
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.35 * (high - low))
    axes.legend(loc="upper right", fontsize=8)
