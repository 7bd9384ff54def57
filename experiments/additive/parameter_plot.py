"""Drawings of parameter errors: mean squares over the number of samples, biases, and coverage of intervals."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ctid_cli.inference.monte_carlo import QUANTILE
from ctid_cli.reporting.figures.style import BAND, DARK, MARK, MIDDLE, Drawing

from .measures import ParameterErrors

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Looks of up to four estimators, told apart by colour, marker and line.
LOOKS: tuple[dict[str, Any], ...] = (
    {"color": DARK, "marker": "o", "markerfacecolor": DARK, "linestyle": "-"},
    {"color": MARK, "marker": "s", "markerfacecolor": "none", "linestyle": "--"},
    {"color": MIDDLE, "marker": "^", "markerfacecolor": "none", "linestyle": "-."},
    {"color": "#3a7d34", "marker": "x", "linestyle": ":"},
)
MARKERS = {"linestyle": "none"}
#: Bias [standard errors of the mean] within which a parameter counts as unbiased: 1 in 1000, two-sided.
UNBIASED = 3.3

#: Labels of estimators by their names.
Methods = Mapping[str, str]


def symbol(parameter: str) -> str:
    """A parameter of a submodel as a formula."""
    return re.sub(r"^g(\d+)_([ab])(\d+)$", r"$\2_{\1,\3}$", parameter)


def mse_svg(
    rows: Sequence[ParameterErrors], methods: Methods, parameters: Sequence[str], columns: int, title: str
) -> bytes:
    """Mean-square errors over the number of samples, one panel for each parameter."""
    lines = -(-len(parameters) // columns)

    def draw(figure: Figure) -> None:
        from matplotlib.ticker import NullFormatter

        panels = figure.subplots(lines, columns, sharex=True, squeeze=False)
        for axes, parameter in zip(panels.flat, parameters, strict=False):
            for method, look in zip(methods, LOOKS, strict=False):
                found = [row for row in rows if (row.estimator, row.parameter) == (method, parameter)]
                found.sort(key=lambda row: row.samples)
                theory = [(row.samples, row.theory / row.samples) for row in found if row.theory is not None]
                if theory:
                    axes.plot(*np.transpose(theory), color=look["color"], linestyle=look["linestyle"], linewidth=0.9)
                points, style = [(row.samples, row.mse) for row in found if row.mse is not None], look | MARKERS
                if points:
                    axes.plot(*np.transpose(points), **style, markersize=3.2, markeredgewidth=0.8)
            axes.set(xscale="log", yscale="log")
            for axis in (axes.xaxis, axes.yaxis):
                axis.set_minor_formatter(NullFormatter())
            axes.set_title(symbol(parameter), loc="left")
        for axes in panels[:, 0]:
            axes.set_ylabel("mean-square error")
        for axes in panels[-1]:
            axes.set_xlabel("number of samples $N$")
        for axes in list(panels.flat)[len(parameters) :]:
            axes.set_visible(False)
        _legend(figure, methods, rows, "simulated (marker), theory for long records (line)")
        figure.suptitle(f"{title} ({_data_sets(rows)})")

    return Drawing(7.5, 1.4 + 2.1 * lines, draw).saved()


def bias_svg(rows: Sequence[ParameterErrors], methods: Methods, parameters: Sequence[str], title: str) -> bytes:
    """Biases in standard deviations of one estimate, one line for each parameter."""
    counted = min((row.counted for row in rows), default=0)
    band = UNBIASED / np.sqrt(counted) if counted else 0.0

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot()
        axes.axvspan(-band, band, color=BAND, linewidth=0)
        axes.axvline(0.0, color=MIDDLE, linewidth=0.8)
        for k, (method, look) in enumerate(zip(methods, LOOKS, strict=False)):
            for place, parameter in enumerate(parameters):
                height = -place + 0.17 * (0.5 * (len(methods) - 1) - k)
                for row in rows:
                    if (row.estimator, row.parameter) != (method, parameter) or row.bias_per_deviation is None:
                        continue
                    axes.plot([0.0, row.bias_per_deviation], [height] * 2, color=look["color"], linewidth=0.8)
                    axes.plot([row.bias_per_deviation], [height], **look | MARKERS, markersize=5)
        axes.set_yticks([-place for place in range(len(parameters))], [symbol(name) for name in parameters])
        axes.set_xlabel("bias / standard deviation of one estimate [-]")
        axes.grid(False, axis="y")
        _legend(figure, methods, rows, f"grey: within {UNBIASED:g} standard errors of zero", line=False)
        figure.suptitle(f"{title} ({_data_sets(rows)})")

    return Drawing(7.5, 1.5 + 0.5 * len(parameters), draw).saved()


def coverage_svg(panels: Sequence[tuple[str, Sequence[ParameterErrors], Methods]], title: str) -> bytes:
    """Percentages of 95 % intervals that contain the true parameter."""
    widths = [len({row.parameter for row in rows}) for _, rows, _ in panels]

    def draw(figure: Figure) -> None:
        drawn = figure.subplots(1, len(panels), sharey=True, squeeze=False, width_ratios=[max(w, 3) for w in widths])[0]
        for axes, (name, rows, methods) in zip(drawn, panels, strict=True):
            parameters = list(dict.fromkeys(row.parameter for row in rows))
            counted = min((row.counted for row in rows), default=0)
            half = 100 * QUANTILE * np.sqrt(0.95 * 0.05 / counted) if counted else 0.0
            axes.axhspan(95 - half, min(95 + half, 100), color=BAND, linewidth=0)
            axes.axhline(95, color=MIDDLE, linewidth=0.8)
            for k, (method, look) in enumerate(zip(methods, LOOKS, strict=False)):
                found = [row for row in rows if row.estimator == method and row.coverage is not None]
                shift = 0.16 * (k - 0.5 * (len(methods) - 1))
                at = np.array([parameters.index(row.parameter) for row in found]) + shift
                places = np.array([(row.coverage, row.low, row.high) for row in found], dtype=float).reshape(-1, 3).T
                style = look | MARKERS | {"markersize": 4, "elinewidth": 0.8}
                label = labelled(method, methods[method], rows)
                axes.errorbar(at, places[0], np.abs(places[1:] - places[0]), **style, label=label)
            axes.set_xticks(range(len(parameters)), [symbol(parameter) for parameter in parameters], fontsize=8)
            axes.set_title(f"{name}, {_data_sets(rows)}", loc="left", fontsize=8)
            axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.1), frameon=False)
            axes.grid(False, axis="x")
        drawn[0].set_ylabel("intervals that contain the true value [%]")
        figure.suptitle(title)

    return Drawing(7.5, 3.8, draw).saved()


def labelled(method: str, label: str, rows: Sequence[ParameterErrors]) -> str:
    """What an estimator is called, and how many of its estimates are not as they should be."""
    # Every parameter of a group carries the same counts.
    own = {(row.samples, row.start): row for row in rows if row.estimator == method}.values()
    runs, counted = sum(row.runs for row in own), sum(row.counted for row in own)
    unfinished = sum(row.failed + row.not_converged for row in own)
    notes = [f"{unfinished} of {runs} not converged"] if unfinished else []
    notes += [f"{runs - counted} without a value"] if counted < runs else []
    return f"{label} ({', '.join(notes)})" if notes else label


def _data_sets(rows: Sequence[ParameterErrors]) -> str:
    runs = {row.runs for row in rows}
    text = " to ".join(map(str, sorted({min(runs, default=0), max(runs, default=0)})))
    return f"{text} data sets{' a point' if len({row.samples for row in rows}) > 1 else ''}"


def _legend(figure: Figure, methods: Methods, rows: Sequence[ParameterErrors], note: str, *, line: bool = True) -> None:
    from matplotlib.lines import Line2D

    off = {} if line else MARKERS
    handles = [
        Line2D([], [], **look | off, markersize=4, linewidth=0.9, label=labelled(method, methods[method], rows))
        for method, look in zip(methods, LOOKS, strict=False)
    ]
    wide = max(len(str(handle.get_label())) for handle in handles) > 40 or len(handles) > 3
    place: dict[str, Any] = {"loc": "outside lower center", "ncols": 2 if wide else 3, "frameon": False}
    figure.legend(handles=handles, title=note, title_fontsize=8, **place)
