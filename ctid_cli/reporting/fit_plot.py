"""The figure of ``ctid fit``: output, residuals, their correlation, and the search over the delay."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from ctid_cli.arrays import Array, BoolArray, IndexArray, IntArray
from ctid_cli.estimators.identification import Identification
from ctid_cli.inference.residual_tests import ResidualTests
from ctid_cli.models.several_inputs import fractions_of
from ctid_cli.reporting.estimate import Units
from ctid_cli.reporting.figures.style import BAND, DARK, LIGHT, STRIPES, Drawing, outline, plain
from ctid_cli.signals.measurement import Measurement

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: The figure of ``ctid fit``, and its parts.
Kind = Literal["all", "overlay", "residuals", "correlation", "profile"]
#: Experiments that are drawn; more do not fit into one figure.
MOST_DRAWN = 3
#: A profile whose greatest cost is this many times its least one has a logarithmic scale.
STEEP = 5.0


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
        elif kind == "correlation":
            draw_correlations(figure.subplots(1, 2), result, len(measurements))
        elif kind == "profile":
            draw_profile(figure.add_subplot(), result, units)
        else:
            _draw_all(figure, result, measurements, units)

    if kind == "correlation":
        return Drawing(8.0, 3.0, draw)
    if kind == "profile":
        return Drawing(5.5, 3.4, draw)
    return Drawing(8.0, 2.8 * len(drawn) if kind in ("overlay", "residuals") else 3.4 * len(drawn) + 2.8, draw)


def _tested(result: Identification) -> str:
    """What the tests are of."""
    return "residuals" if result.fit.noise is None else "innovations"


def _draw_all(figure: Figure, result: Identification, measurements: Sequence[Measurement], units: Units) -> None:
    drawn = measurements[:MOST_DRAWN]
    grid = figure.add_gridspec(2 * len(drawn) + 1, 2, height_ratios=[2, 1.2] * len(drawn) + [2])
    draw_records(figure, grid, result, measurements, units)
    draw_autocorrelation(figure.add_subplot(grid[-1, 0]), result.tests, len(measurements), _tested(result))
    draw_profile(figure.add_subplot(grid[-1, 1]), result, units)


def draw_correlations(both: Sequence[Any], result: Identification, experiments: int) -> None:
    """Correlation of the residuals with themselves, and with the input."""
    draw_autocorrelation(both[0], result.tests, experiments, _tested(result))
    draw_cross_correlation(both[1], result.tests, experiments, _tested(result))


def draw_records(
    figure: Figure, grid: Any, result: Identification, measurements: Sequence[Measurement], units: Units
) -> None:
    """Output and residuals of the first experiments, each in two rows of a grid."""
    for k, measurement in enumerate(measurements[:MOST_DRAWN]):
        output = figure.add_subplot(grid[2 * k, :])
        error = figure.add_subplot(grid[2 * k + 1, :], sharex=output)
        _draw_output(output, result, measurement, k, units)
        output.tick_params(labelbottom=False)
        output.margins(x=0.0)
        _draw_residuals(error, result, measurement, k, units)
        _name_panels(output, error, measurement, k, len(measurements), units)


def _draw_output(axes: Any, result: Identification, measurement: Measurement, k: int, units: Units) -> None:
    record, use, weighting = measurement.record, result.fit.used[k], result.fit.weighting
    if weighting is not None and weighting.outliers[k].any():
        little = np.flatnonzero(use)[weighting.outliers[k]]
        axes.plot(record.t[little], record.y[little], "x", color="black", markersize=4, label="counts for little")
    draw_overlay(axes, measurement, use, result.fit.residuals[k], units)


def draw_overlay(axes: Any, measurement: Measurement, use: BoolArray, residuals: Array, units: Units) -> None:
    """The measured output, and the simulated one at its used samples."""
    record = measurement.record
    simulated = curve(record.t, use, record.y[use] - residuals)
    axes.plot(*outline(record.t, record.y), color=LIGHT, linewidth=2.2, zorder=1.9, label="measured")
    axes.plot(*simulated, color=DARK, linewidth=0.9, label="simulated")
    axes.set_ylabel(plain(measurement.label("output", units.output)))
    axes.legend(loc="lower right", ncols=3, fontsize=8)
    low, high = axes.get_ylim()
    axes.set_ylim(low - 0.18 * (high - low), high)  # room for the legend below the curves


def _draw_residuals(axes: Any, result: Identification, measurement: Measurement, k: int, units: Units) -> None:
    t = measurement.record.t
    axes.plot(*curve(t, result.fit.used[k], result.fit.residuals[k]), color=DARK, linewidth=0.7)
    axes.axhline(0.0, color="black", linewidth=0.6)
    axes.set_ylabel(plain(f"residual [{units.output}]"))


def _name_panels(upper: Any, lower: Any, measurement: Measurement, k: int, n: int, units: Units) -> None:
    """Name the axis of time below the lower panel, and above the upper one which of n experiments it is."""
    t = measurement.record.t
    thinned = f"; the least and the greatest of each {t.size // STRIPES} samples are drawn"
    label = plain(measurement.label("time", units.time))
    lower.set_xlabel(label + thinned * (outline(t, t)[0].size < t.size))
    if n > 1:
        upper.set_title(f"experiment {k + 1} of {n}", loc="left")


def curve(t: Array, use: BoolArray | IndexArray, values: Array) -> tuple[Array, Array]:
    """The curve of values at the used instants, with breaks in the line where samples are missing."""
    full = np.full(t.size, np.nan)
    full[use] = values
    return outline(t, full)


def draw_autocorrelation(
    axes: Any, tests: Sequence[ResidualTests], experiments: int = 1, what: str = "residuals"
) -> None:
    """Autocorrelation of the residuals, or innovations, of each experiment, with the band of white ones."""
    axes.set_ylabel(f"autocorrelation\nof the {what} [-]")
    _draw_lags(axes, [(np.arange(1, test.lags + 1), test.autocorrelation) for test in tests], experiments)
    if tests:
        _draw_band(axes, tests[0].autocorrelation_band, f"{100 * tests[0].level:.3g} % band if white")


def draw_cross_correlation(
    axes: Any, tests: Sequence[ResidualTests], experiments: int = 1, what: str = "residuals"
) -> None:
    """Correlation of the residuals, or innovations, with the input, with the band where they do not depend on it."""
    axes.set_ylabel(f"correlation of the {what}\nwith the delayed input [-]")
    _draw_lags(axes, [(np.arange(-test.lags, test.lags + 1), test.cross_correlation) for test in tests], experiments)
    if tests:
        _draw_band(axes, tests[0].cross_correlation_band, f"{100 * tests[0].level:.3g} % band if independent")


def _draw_lags(axes: Any, curves: Sequence[tuple[IntArray, Array]], experiments: int) -> None:
    axes.set_xlabel("lag [samples]")
    if not curves:
        axes.text(0.5, 0.5, "too few residuals", ha="center", va="center", transform=axes.transAxes)
    styles = ("o-", "s--", "^:")
    for k, ((lags, values), style) in enumerate(zip(curves[:MOST_DRAWN], styles, strict=False), start=1):
        label = f"experiment {k}" if experiments > 1 else None
        axes.plot(lags, values, style, color=DARK, markersize=3, linewidth=0.8, label=label)


def _draw_band(axes: Any, band: float, label: str) -> None:
    axes.axhspan(-band, band, color=BAND, zorder=0, label=label)
    axes.axhline(0.0, color="black", linewidth=0.6)
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.25 * (high - low))
    axes.legend(loc="upper right", fontsize=8)


def draw_profile(axes: Any, result: Identification, units: Units) -> None:
    """The search over the delay."""
    profile, delay = result.fit.profile, fractions_of(result.fit.model)[0].delay
    axes.set_xlabel(plain(f"delay [{units.time}]"))
    axes.set_ylabel(plain(f"cost [({units.output})²]"))
    if profile is None:
        low, high = result.options.delay_bounds
        what = "estimated delay" if low < high else "known delay"
        axes.plot([delay], [result.fit.cost], "o", color=DARK, label=plain(f"{what} {delay:.4g} {units.time}"))
    else:
        whole = profile.samples >= result.fit.count
        behind = "" if whole else f" of the liveliest {profile.samples} samples"
        behind += "" if profile.cutoff is None else f" below {profile.cutoff:.3g} rad/{units.time}"
        label = plain(f"profile{behind}")
        axes.plot(profile.delays, profile.costs, ".-", color=DARK, linewidth=0.8, markersize=4, label=label)
        noisy = result.fit.noise is not None
        label = plain(f"{'estimate with the noise model:' if noisy else 'minimum at'} {delay:.4g} {units.time}")
        if profile.cutoff is None and whole and not noisy:
            axes.plot([delay], [result.fit.cost], "v", color="black", markersize=7, label=label)
        else:
            # The cost of the estimate is that of all frequencies and samples, or of the innovations.
            axes.axvline(delay, color="black", linewidth=0.8, label=label)
    low, high = axes.get_ylim()
    if profile is not None and 0.0 < STEEP * profile.costs.min() < profile.costs[np.isfinite(profile.costs)].max():
        # The least cost would lie on the axis of a straight scale, whatever the others around it are.
        axes.set_yscale("log")
        low, high = axes.get_ylim()
        axes.set_ylim(low, high * (high / low) ** 0.35)
    else:
        axes.set_ylim(low, high + 0.35 * (high - low))
    axes.legend(loc="upper right", fontsize=8)
