"""Figure of a measure over the settings that an experiment varies.

Over several settings at once it is a nested loop plot: all combinations side by side, the last setting varying fastest,
with steps below that show the settings (G. Rücker and G. Schwarzer, Presenting simulation results in a nested loop
plot, BMC Medical Research Methodology 14 (2014) 129). Bars and bands are 95 % intervals of the Monte Carlo error.
"""

from __future__ import annotations

from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np

from ctid_cli.reporting.figures.settings import Scale, Settings, placed, scale_of, value_text
from ctid_cli.reporting.figures.style import DARK, LIGHT, Drawing, legend_of, look, panels_of, plain, size_for
from ctid_cli.reporting.layout import number
from ctid_cli.reporting.measures import measure_frame, measure_of
from ctid_cli.reporting.results import Results
from ctid_cli.text import count

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Ideal value of each measure.
IDEAL = {"bias": 0.0, "median_bias": 0.0, "coverage": 95.0, "error_ratio": 1.0, "efficiency": 100.0}
#: Most panels.
PANELS = 12
#: Heights of a panel of a nested loop plot, and of the steps of one setting [inch].
NESTED, FLIGHT = 1.9, 0.42
#: An axis is logarithmic if positive values span this factor.
SPAN = 8.0
#: Most segments of the steps that are labelled.
LABELLED = 24


def measure_drawing(results: Results, measure: str) -> Drawing:
    """Return a measure over the settings that an experiment varies, one panel for each parameter."""
    frame = measure_frame(results, [measure])
    frame = frame[frame["n"] > 0]
    settings, rows = placed(frame, results)
    names = frame["parameter"].unique().tolist()[:PANELS]
    scale, flights = scale_of(settings), len(settings.names) if len(settings.names) > 1 else 0

    def draw(figure: Figure) -> None:
        if flights:
            # One below the other, above the common steps of the settings.
            heights = [*[NESTED] * len(names), FLIGHT * flights]
            column = figure.subplots(len(heights), 1, sharex=True, height_ratios=heights)
            panels = list(column[:-1])
            _draw_stairs(column[-1], settings)
            scale.apply(column[-1])
        else:
            panels = panels_of(figure, len(names), sharex=True)
            for axes in panels:
                scale.apply(axes)
                axes.set_xlabel(", ".join(settings.titles))
        for axes, name in zip(panels, names, strict=True):
            own = rows[rows["parameter"] == name] if isinstance(name, str) else rows
            _draw_panel(axes, own, settings, scale)
            _label(axes, own, measure)
        labels = [method + _lost(frame[frame["method"] == method]) for method in settings.methods]
        columns = max(1, min(len(labels), 90 // (max(map(len, labels)) + 8)))
        legend_of(figure, {label: look(k) for k, label in enumerate(labels)}, columns)
        figure.suptitle(_title(results, measure, frame))

    return Drawing(*((7.5, 1.2 + NESTED * len(names) + FLIGHT * flights) if flights else size_for(len(names))), draw)


def _draw_panel(axes: Axes, rows: pd.DataFrame, settings: Settings, scale: Scale) -> None:
    """Draw the values of each method with their intervals."""
    for k, method in enumerate(settings.methods):
        own = rows[rows["method"] == method].set_index("place").reindex(range(len(settings.points)))
        value, low, high = own[["value", "low", "high"]].to_numpy(dtype=float).T
        places, style = np.array(scale.shifted(k, len(settings.methods))), look(k)
        # A value whose interval is not known is drawn without a bar.
        known = np.isfinite(value) & np.isfinite(low) & np.isfinite(high)
        bars = np.abs(np.array([value - low, high - value]))[:, known]
        axes.errorbar(places[known], value[known], bars, fmt="none", ecolor=style["color"], elinewidth=0.9, capsize=1.8)
        axes.plot(places, value, **{**style, "linestyle": "none"}, markersize=4.0)
        for part in np.split(np.arange(places.size), _breaks(settings)) if settings.names else ():
            axes.plot(places[part], value[part], **{**style, "marker": "none"}, linewidth=0.9)


def _breaks(settings: Settings) -> list[int]:
    """Return points at which another setting than the last changes, to break lines there."""
    return [k for k, point in enumerate(settings.points) if k and point[:-1] != settings.points[k - 1][:-1]]


def _label(axes: Axes, rows: pd.DataFrame, measure: str) -> None:
    """Set title, unit and vertical scale of a panel."""
    (parameter, unit), base = rows[["parameter", "unit"]].iloc[0], measure.partition(":")[0]
    of_parameter = isinstance(parameter, str)
    axes.set_ylabel(
        (base if of_parameter else measure).replace("_", " ") + (f" [{unit}]" if unit not in ("", "-") else "")
    )
    if of_parameter:
        axes.set_title(plain(parameter), loc="left")
    if base in IDEAL:
        axes.axhline(IDEAL[base], color=DARK, linewidth=0.7, zorder=0.5)
    values = rows["value"].dropna().tolist()
    if unit == "%" and base in ("percent", "coverage", "failures"):
        low, high = axes.get_ylim()
        axes.set_ylim(max(low, -3.0), min(high, 103.0))
    elif values and base not in ("bias", "median_bias") and min(values) > 0 and max(values) > SPAN * min(values):
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter(lambda value, _: number(value, 3))
        axes.yaxis.set_minor_formatter(lambda value, _: number(value, 3) if f"{value:.0e}"[0] in "25" else "")


def _draw_stairs(axes: Axes, settings: Settings) -> None:
    """Draw the settings at each place as steps, one row for each setting, higher for later values."""
    for k in range(len(settings.names)):
        values = [point[k] for point in settings.points]
        levels = list(dict.fromkeys(values))
        base = float(len(settings.names) - 1 - k)
        heights = base + 0.5 * np.array([levels.index(value) for value in values]) / max(len(levels) - 1, 1)
        axes.step(range(len(values)), heights, where="mid", color="#000000", linewidth=0.9)
        stretches = [(value, len(list(group))) for value, group in groupby(values)]
        start = 0
        for value, length in stretches:
            if len(stretches) <= LABELLED:
                middle = start + 0.5 * (length - 1)
                axes.annotate(
                    value_text(value),
                    (middle, heights[start]),
                    (0, 1.5),
                    textcoords="offset points",
                    ha="center",
                    fontsize=7,
                )
            start += length
    axes.set_yticks([len(settings.names) - 0.75 - k for k in range(len(settings.names))], settings.titles, fontsize=8)
    axes.set_ylim(-0.15, len(settings.names) - 0.05)
    axes.tick_params(axis="both", length=0)
    axes.grid(False)
    for side in axes.spines.values():
        side.set_color(LIGHT)


def _lost(rows: pd.DataFrame) -> str:
    """Return how many estimates of an estimator failed, or have no value of some parameter."""
    sums = rows.groupby("parameter", dropna=False)[["n", "failed", "without_value"]].sum()
    runs, failed, without = sums.max().tolist()
    notes = [f"{failed} of {runs} failed"] if failed else []
    notes += [f"{without} without a value"] if without > failed else []
    return f" ({', '.join(notes)})" if notes else ""


def _title(results: Results, measure: str, rows: pd.DataFrame) -> str:
    least, most = rows["n"].min(), rows["n"].max()
    sets = count(most, "data set") if least == most else f"{least} to {most} data sets"
    return f"{results.experiment}: {measure_of(measure, results).meaning}\n{sets} a point, 95 % intervals"
