"""Drawings of the estimates themselves: clouds of two errors, histograms of delays, and box plots of errors."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import UsageError
from ctid_cli.inference.monte_carlo import NORMAL_MAD, quantile, share
from ctid_cli.reporting.figures.measure_plot import PANELS
from ctid_cli.reporting.figures.settings import Scale, Settings, part_of, settings_in, value_text
from ctid_cli.reporting.figures.style import DARK, MARK, MIDDLE, Drawing, columns_for, look, panels_of, plain, size_for
from ctid_cli.reporting.measures import parameter_unit
from ctid_cli.reporting.parameter_errors import ParameterEstimates, estimates_by_group, least_covariances
from ctid_cli.reporting.percentages import Row, labelled_groups
from ctid_cli.reporting.results import Results

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Points of one cloud, and of all clouds of a figure: more of them only make the file larger.
CLOUD, ALL_CLOUDS = 400, 2400
#: Clouds are shown to so many robust standard deviations from their medians; what lies farther out is counted.
REACH = 5.0
#: An ellipse that holds 95 % of a normal cloud has this many standard deviations, the root of -2 log 0.05.
ELLIPSE = math.sqrt(-2.0 * math.log(0.05))
#: More boxes than these in a panel need the whole width.
CROWDED = 16
#: Bins of a histogram; empty bins that part two basins; how many basins are named, and their least share [%].
BINS, APART, NAMED, LEAST = 60, 3, 4, 5.0


def grouped_rows(results: Results) -> list[Row]:
    """What every estimator found at every setting and start, as the value of a row that says which."""
    found = {one.group: one for one in estimates_by_group(results)}
    return [labels | {"value": found[group]} for group, labels in labelled_groups(results) if group in found]


def estimated_names(rows: Sequence[Row], asked: Sequence[str] = ()) -> list[str]:
    """Names of the parameters that any of the estimators has values of, or those that were asked for."""
    names = dict.fromkeys(
        name for row in rows for k, name in enumerate(row["value"].names) if row["value"].sample(k).errors.size
    )
    for name in asked:
        if name not in names:
            raise UsageError(f"no estimator has the parameter {name!r}; there are {', '.join(names)}")
    return list(asked) or list(names)


def _errors(estimates: ParameterEstimates, name: str) -> Array:
    """Errors of a parameter, NaN where it has none, shape (R,)."""
    if name not in estimates.names:
        return np.full(estimates.runs, np.nan)
    k = estimates.names.index(name)
    return np.asarray(estimates.values[:, k] - estimates.truth[k])


def _labelled(name: str, rows: Sequence[Row]) -> str:
    unit = next((parameter_unit(name, row["value"].names) for row in rows if name in row["value"].names), "-")
    return f"error of {plain(name)}" + ("" if unit == "-" else f" [{unit}]")


# --------------------------------------------------------------------------------------------------------------------
# Clouds


def errors_drawing(results: Results, asked: Sequence[str] = ()) -> Drawing:
    """Errors of two parameters against each other, with the ellipse that theory gives 95 % of them."""
    rows = grouped_rows(results)
    names = estimated_names(rows, asked)
    pair = names[:2] if asked or "delay" not in names else [names[0], "delay"]
    if len(pair) < 2 or len(set(pair)) < 2:
        raise UsageError(f"{results.experiment}: clouds need two estimated parameters; there is {', '.join(names)}")
    settings = settings_in(rows, results)
    points = settings.points[:PANELS]
    shown = [list(_at(settings, point, rows)) for point in points]
    theory = least_covariances(results, [row["value"].group for found in shown for row in found if row])
    size = min(CLOUD, ALL_CLOUDS // max(1, len(points) * len(settings.methods)))

    def draw(figure: Figure) -> None:
        for axes, point, found in zip(panels_of(figure, len(points)), points, shown, strict=True):
            _draw_clouds(axes, found, pair, theory, size)
            axes.set_title(settings.words(point), loc="left", fontsize=8)
            axes.set_xlabel(_labelled(pair[0], rows))
            axes.set_ylabel(_labelled(pair[1], rows))
        _legend(figure, settings, bool(theory))
        runs = max(row["value"].runs for row in rows)
        part = part_of(points, settings.points) + (f", {size} of {runs} data sets each" if size < runs else "")
        figure.suptitle(f"{results.experiment}: errors of {plain(pair[0])} and {plain(pair[1])}{part}")

    return Drawing(*size_for(len(points)), draw)


def _at(settings: Settings, point: Any, rows: Sequence[Row]) -> Iterator[Row | None]:
    """The row of every estimator at a point."""
    for method in settings.methods:
        yield settings.row_at(point, [row for row in rows if row["method"] == method])


def _draw_clouds(
    axes: Axes, found: Sequence[Row | None], pair: Sequence[str], theory: dict[Any, Any], size: int
) -> None:
    ends = []
    clouds = []
    for k, row in enumerate(found):
        if row is None:
            continue
        points = np.array([_errors(row["value"], name) for name in pair])
        points = points[:, np.isfinite(points).all(axis=0)]
        if not points.size:
            continue
        middle = np.median(points, axis=1)
        spread = NORMAL_MAD * np.median(np.abs(points - middle[:, None]), axis=1)
        ends += [middle - REACH * spread, middle + REACH * spread]
        clouds.append((look(k), points))
        names, covariance = theory.get(row["value"].group, ((), np.zeros((0, 0))))
        if set(pair) <= set(names):
            at = [names.index(name) for name in pair]
            curve = _ellipse(covariance[np.ix_(at, at)])
            ends += [curve.min(axis=1), curve.max(axis=1)]
            axes.plot(*curve, **{**look(k), "marker": "none"}, linewidth=1.2)
    axes.axhline(0.0, color=MIDDLE, linewidth=0.6, zorder=0.5)
    axes.axvline(0.0, color=MIDDLE, linewidth=0.6, zorder=0.5)
    if not clouds:
        return
    low, high = np.min(ends, axis=0), np.max(ends, axis=0)
    outside = 0
    for style, points in clouds:
        inside = ((points >= low[:, None]) & (points <= high[:, None])).all(axis=0)
        outside += int((~inside).sum())
        small = {"linestyle": "none", "markersize": 2.2, "markeredgewidth": 0.5, "alpha": 0.55}
        axes.plot(*points[:, :size][:, inside[:size]], **style | small)
    if (high > low).all():
        edge = 0.04 * (high - low)
        axes.set(xlim=(low[0] - edge[0], high[0] + edge[0]), ylim=(low[1] - edge[1], high[1] + edge[1]))
    if outside:
        axes.annotate(f"{outside} outside", (0.98, 0.03), xycoords="axes fraction", ha="right", fontsize=7)


def _ellipse(covariance: Array) -> Array:
    """A curve that holds 95 % of a normal cloud with this covariance, shape (2, 100)."""
    values, vectors = np.linalg.eigh(covariance)
    angle = np.linspace(0.0, 2.0 * np.pi, 100)
    lengths = np.sqrt(np.maximum(values, 0.0))
    return np.asarray(ELLIPSE * (vectors * lengths) @ np.array([np.cos(angle), np.sin(angle)]))


# --------------------------------------------------------------------------------------------------------------------
# Delays


def delays_drawing(results: Results) -> Drawing:
    """Histograms of the estimated delays, the basins that they fall into, and how many data sets each one takes."""
    rows = [row for row in grouped_rows(results) if "delay" in row["value"].names]
    rows = [row for row in rows if np.isfinite(_delays(row)).any()]
    if not rows:
        raise UsageError(f"{results.experiment}: no estimator estimates a delay; --kind box shows what they do")
    settings = settings_in(rows, results)
    shown = rows[:PANELS]
    every = np.concatenate([_delays(row) for row in shown] + [[_true_delay(row)] for row in shown])
    low, high = np.nanmin(every), np.nanmax(every)
    edges = np.linspace(low, high, BINS + 1) if high > low else np.linspace(low - 0.5, high + 0.5, BINS + 1)

    def draw(figure: Figure) -> None:
        for axes, row in zip(panels_of(figure, len(shown), sharex=True, sharey=True), shown, strict=True):
            _draw_delays(axes, row, edges)
            words = settings.words(tuple(row[name] for name in settings.names))
            failed = f", {row['value'].failed} failed" if row["value"].failed else ""
            axes.set_title(f"{row['method']}{failed}\n{words}".strip(), loc="left", fontsize=8)
            axes.set_xlabel("delay [s]")
            axes.set_ylabel("data sets [%]")
        title = f"{results.experiment}: estimated delays{part_of(shown, rows)}"
        figure.suptitle(f"{title}\nline: true delay; share of the data sets in each basin with its 95 % interval")

    return Drawing(*size_for(len(shown)), draw)


def _delays(row: Row) -> Array:
    estimates = row["value"]
    return np.asarray(estimates.values[:, estimates.names.index("delay")])


def _true_delay(row: Row) -> float:
    return float(row["value"].truth[row["value"].names.index("delay")])


def _draw_delays(axes: Axes, row: Row, edges: Array) -> None:
    delays, runs = _delays(row), row["value"].runs
    counts = np.histogram(delays[np.isfinite(delays)], edges)[0]
    axes.bar(edges[:-1], 100.0 * counts / runs, np.diff(edges), align="edge", color=DARK)
    axes.axvline(_true_delay(row), color=MARK, linewidth=0.9, linestyle="--", zorder=0.5)
    axes.set_ylim(0.0, 108.0)
    named = []
    for first, last in basins(counts):
        inside = (delays >= edges[first]) & (delays <= edges[last])
        found, middle = share(inside), float(np.mean(delays[inside]))
        if found.value is not None and found.value >= LEAST:
            named.append((found.value, f"{middle:.3g} s: {found.value:.0f} % [{found.low:.0f}, {found.high:.0f}]"))
    # Where the bars leave room.
    left = counts[: BINS // 2].max() < counts[BINS // 2 :].max()
    text = "\n".join(text for _, text in sorted(named, reverse=True)[:NAMED])
    place = (0.03 if left else 0.97, 0.95)
    axes.annotate(text, place, xycoords="axes fraction", ha="left" if left else "right", va="top", fontsize=7)


def basins(counts: Array) -> list[tuple[int, int]]:
    """First bin, and the one after the last, of every stretch of bins that hold anything."""
    filled = np.flatnonzero(counts)
    parts = np.split(filled, np.flatnonzero(np.diff(filled) > APART) + 1) if filled.size else []
    return [(int(part[0]), int(part[-1]) + 1) for part in parts]


# --------------------------------------------------------------------------------------------------------------------
# Boxes


def box_drawing(results: Results, asked: Sequence[str] = ()) -> Drawing:
    """Box plots of the errors of every parameter: quartiles, 5 and 95 %, and the median with its 95 % interval."""
    rows = grouped_rows(results)
    settings = settings_in(rows, results)
    names = estimated_names(rows, asked)[:PANELS]
    labels = ["\n".join(map(value_text, point)) for point in settings.points]
    scale = Scale([float(k) for k in range(len(labels))], False, labels)
    # Many boxes need the whole width.
    columns = 1 if len(labels) * len(settings.methods) > CROWDED else columns_for(len(names))

    def draw(figure: Figure) -> None:
        panels = panels_of(figure, len(names), columns)
        for axes, name in zip(panels, names, strict=True):
            for k, method in enumerate(settings.methods):
                own = [row for row in rows if row["method"] == method]
                found = [settings.row_at(point, own) for point in settings.points]
                _draw_boxes(axes, found, name, k, len(settings.methods))
            axes.axhline(0.0, color=MIDDLE, linewidth=0.7, zorder=0.5)
            # The lowest box keeps its distance from the edge.
            axes.use_sticky_edges = False
            axes.set_ylabel(_labelled(name, rows))
            scale.apply(axes)
            axes.grid(False, axis="x")
            axes.set_xlabel(", ".join(settings.titles))
        _legend(figure, settings, False)
        how = "box: quartiles; whiskers: 5 and 95 %; mark: median with its 95 % interval"
        figure.suptitle(f"{results.experiment}: errors of parameters\n{how}")

    return Drawing(*size_for(len(names), columns=columns), draw)


def _draw_boxes(axes: Axes, found: Sequence[Row | None], name: str, k: int, n: int) -> None:
    style, width = {**look(k), "linestyle": "none"}, 0.7 / n
    for place, row in enumerate(found):
        errors = _errors(row["value"], name) if row is not None else np.zeros(0)
        errors = errors[np.isfinite(errors)]
        if not errors.size:
            continue
        at, color = place + width * (k - 0.5 * (n - 1)), style["color"]
        low, first, third, high = np.quantile(errors, (0.05, 0.25, 0.75, 0.95))
        axes.bar(at, third - first, 0.8 * width, first, facecolor="white", edgecolor=color, linewidth=0.9)
        axes.vlines([at, at], [low, third], [first, high], color=color, linewidth=0.9)
        median = quantile(errors)
        if median.low is not None and median.high is not None:
            axes.vlines(at, median.low, median.high, color=color, linewidth=2.4)
        axes.plot(at, np.median(errors), **style, markersize=3.5)


def _legend(figure: Figure, settings: Settings, theory: bool) -> None:
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], **{**look(k), "linestyle": "none"}, markersize=4, label=method)
        for k, method in enumerate(settings.methods)
    ]
    title = "curve: 95 % of the estimates, by theory" if theory else None
    place: dict[str, Any] = {"loc": "outside lower center", "ncols": min(len(handles), 4), "frameon": False}
    figure.legend(handles=handles, title=title, title_fontsize=8, **place)
