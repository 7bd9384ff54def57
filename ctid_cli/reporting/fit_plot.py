"""Figure of ``ctid fit``: output, residuals, their correlation, and the cost over the delay."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ctid_cli.arrays import Array, BoolArray, IndexArray, IntArray
from ctid_cli.estimators.identification import Identification
from ctid_cli.inference.units import Units
from ctid_cli.models.several_inputs import fractions_of
from ctid_cli.reporting.figures.style import BAND, DARK, LIGHT, STRIPES, Drawing, name_axes, outline, plain
from ctid_cli.signals.measurement import Measurement

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Most experiments that are drawn in one figure.
MOST_DRAWN = 3
#: A profile is logarithmic if its greatest cost is this many times its least one.
STEEP = 5.0
#: Line styles of the correlations of experiments.
LINES = ("o-", "s--", "^:")


@dataclass(frozen=True, eq=False)
class FitFigures:
    """The figure of a fit and its parts."""

    result: Identification
    measurements: Sequence[Measurement]
    units: Units

    @property
    def drawn(self) -> int:
        """Number of experiments that are drawn."""
        return min(len(self.measurements), MOST_DRAWN)

    def all(self) -> Drawing:
        """Draw output and residuals of each experiment, autocorrelation, and the cost over the delay."""
        n = self.drawn

        def draw(figure: Figure) -> None:
            grid = figure.add_gridspec(2 * n + 1, 2, height_ratios=[2, 1.2] * n + [2])
            self.draw_experiments(figure, grid)
            self.draw_autocorrelation(figure.add_subplot(grid[-1, 0]))
            self.draw_profile(figure.add_subplot(grid[-1, 1]))

        return Drawing(8.0, 3.4 * n + 2.8, draw)

    def cross_correlation(self) -> Drawing:
        """Draw the correlation of the residuals, or innovations, with the delayed input."""
        return Drawing(5.5, 2.6, lambda figure: self.draw_cross_correlation(figure.add_subplot()))

    # --- panels ------------------------------------------------------------------------------------

    def draw_experiments(self, figure: Figure, grid: Any) -> None:
        """Draw output and residuals of the first experiments, each in two rows of a grid."""
        n = len(self.measurements)
        for k in range(self.drawn):
            output = figure.add_subplot(grid[2 * k, :])
            self.draw_output(output, k)
            output.tick_params(labelbottom=False)
            error = figure.add_subplot(grid[2 * k + 1, :], sharex=output)
            self.draw_residuals(error, k)
            for axes in (output, error):
                axes.margins(x=0.0)
            if n > 1:
                output.set_title(f"experiment {k + 1} of {n}", loc="left")

    def draw_output(self, axes: Any, k: int) -> None:
        """Draw measured and simulated output of an experiment, and samples with a small weight."""
        record, fit = self.measurements[k].record, self.result.fit
        if fit.weighting is not None and fit.weighting.outliers[k].any():
            little = np.flatnonzero(fit.used[k])[fit.weighting.outliers[k]]
            axes.plot(record.t[little], record.y[little], "x", color="black", markersize=4, label="small weight")
        draw_overlay(axes, self.measurements[k], fit.used[k], fit.residuals[k], self.units)

    def draw_residuals(self, axes: Any, k: int) -> None:
        """Draw the residuals of an experiment."""
        fit, t = self.result.fit, self.measurements[k].record.t
        axes.plot(*curve(t, fit.used[k], fit.residuals[k]), color=DARK, linewidth=0.7)
        axes.axhline(0.0, color="black", linewidth=0.6)
        thinned = f"; the least and the greatest of each {t.size // STRIPES} samples are drawn"
        label = self.units.column(self.measurements[k], "time") + thinned * (outline(t, t)[0].size < t.size)
        name_axes(axes, label, self.units.label("residual", self.units.output))

    def draw_autocorrelation(self, axes: Any) -> None:
        """Draw the autocorrelation of the residuals or innovations of each experiment, with the band of white ones."""
        tests, several = self.result.tests[:: self._inputs], len(self.measurements) > 1
        name_axes(axes, y=f"autocorrelation\nof the {self.result.fit.left_over} [-]")
        labels = [f"experiment {k}" if several else "" for k in range(1, len(tests) + 1)]
        curves = [(np.arange(1, test.lags + 1), test.autocorrelation) for test in tests]
        _draw_lags(axes, curves, labels)
        if tests:
            _draw_band(axes, tests[0].autocorrelation_band, tests[0].level, "white")

    def draw_cross_correlation(self, axes: Any) -> None:
        """Draw the correlation of the residuals of each experiment with its delayed input, or inputs."""
        result, tests, several = self.result, self.result.tests, len(self.measurements) > 1
        name_axes(axes, y=f"correlation of the {result.fit.left_over}\nwith the delayed {result.driver} [-]")
        labels = [test.driver if self._inputs > 1 else f"experiment {k}" * several for k, test in enumerate(tests, 1)]
        curves = [(np.arange(-test.lags, test.lags + 1), test.cross_correlation) for test in tests]
        _draw_lags(axes, curves, labels)
        if tests:
            _draw_band(axes, tests[0].cross_correlation_band, tests[0].level, "independent")

    @property
    def delay(self) -> float:
        """Estimated delay; for several inputs that of the first."""
        return fractions_of(self.result.fit.model)[0].delay

    @property
    def _inputs(self) -> int:
        return len(fractions_of(self.result.fit.model))

    def draw_profile(self, axes: Any) -> None:
        """Draw the cost over the range of the delay."""
        fit, units = self.result.fit, self.units
        profile, found = self.result.profile, f"{self.delay:.4g} {units.time}"
        if profile is None:
            low, high = self.result.options.delay_bounds
            label = plain(f"{'estimated' if low < high else 'known'} delay {found}")
            axes.plot([self.delay], [fit.cost], "o", color=DARK, label=label)
        else:
            whole = profile.samples >= fit.count
            part = "" if whole else f" of the most active {profile.samples} samples"
            axes.plot(profile.delays, profile.costs, ".-", color=DARK, lw=0.8, ms=4, label=plain(f"profile{part}"))
            if whole and fit.noise is None:
                axes.plot([self.delay], [fit.cost], "v", color="black", ms=7, label=plain(f"minimum at {found}"))
            else:
                # The cost of the estimate uses all samples, or the innovations.
                what = "minimum at" if fit.noise is None else "estimate with the noise model:"
                axes.axvline(self.delay, color="black", linewidth=0.8, label=plain(f"{what} {found}"))
        low, high = axes.get_ylim()
        if profile is not None and 0.0 < STEEP * profile.costs.min() < profile.costs[np.isfinite(profile.costs)].max():
            # On a linear scale the least cost would always lie on the axis.
            axes.set_yscale("log")
            low, high = axes.get_ylim()
            axes.set_ylim(low, high * (high / low) ** 0.35)
        else:
            axes.set_ylim(low, high + 0.35 * (high - low))
        name_axes(axes, f"delay [{units.time}]", units.label("cost", f"({units.output})²"), legend="upper right")


def draw_overlay(axes: Any, measurement: Measurement, use: BoolArray, residuals: Array, units: Units) -> None:
    """Draw the measured output, and the simulated one at its used samples."""
    record = measurement.record
    axes.plot(*outline(record.t, record.y), color=LIGHT, linewidth=2.2, zorder=1.9, label="measured")
    axes.plot(*curve(record.t, use, record.y[use] - residuals), color=DARK, linewidth=0.9, label="simulated")
    name_axes(axes, y=units.column(measurement, "output"))
    axes.legend(loc="lower right", ncols=3, fontsize=8)
    low, high = axes.get_ylim()
    axes.set_ylim(low - 0.18 * (high - low), high)  # room for the legend below the curves


def curve(t: Array, use: BoolArray | IndexArray, values: Array) -> tuple[Array, Array]:
    """Return the curve of values at the used instants, interrupted at missing samples."""
    full = np.full(t.size, np.nan)
    full[use] = values
    return outline(t, full)


def _draw_lags(axes: Any, curves: Sequence[tuple[IntArray, Array]], labels: Sequence[str]) -> None:
    """Draw the correlations of the first experiments, or inputs."""
    axes.set_xlabel("lag [samples]")
    if not curves:
        axes.text(0.5, 0.5, "too few residuals", ha="center", va="center", transform=axes.transAxes)
    for (lags, values), label, line in zip(curves, labels, LINES, strict=False):
        axes.plot(lags, values, line, color=DARK, markersize=3, linewidth=0.8, label=plain(label) or None)


def _draw_band(axes: Any, band: float, level: float, what: str) -> None:
    """Draw the acceptance band of correlations of the first experiment, and the legend above it."""
    axes.axhspan(-band, band, color=BAND, zorder=0, label=f"{100 * level:.3g} % band if {what}")
    axes.axhline(0.0, color="black", linewidth=0.6)
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.25 * (high - low))
    name_axes(axes, legend="upper right")
