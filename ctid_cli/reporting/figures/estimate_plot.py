"""Box plots of the errors of every parameter, by the settings that an experiment varies."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import UsageError
from ctid_cli.inference.monte_carlo import quantile
from ctid_cli.reporting.figures.measure_plot import PANELS
from ctid_cli.reporting.figures.settings import Scale, Settings, placed, value_text
from ctid_cli.reporting.figures.style import MIDDLE, Drawing, columns_for, legend_of, look, panels_of, plain, size_for
from ctid_cli.reporting.measures import label_frame, parameter_unit
from ctid_cli.reporting.results import Results

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: A panel with more boxes takes the whole width.
CROWDED = 16
#: A panel ends at this many times the median whisker: larger errors are counted at its edge, not drawn.
REACH = 3.0


def box_drawing(results: Results, parameters: Sequence[str] = ()) -> Drawing:
    """Return box plots of the errors of each parameter: quartiles, 5 and 95 %, the median with its 95 % interval."""
    errors = results.errors.dropna(subset="value")
    known = errors["parameter"].unique().tolist()
    for name in parameters:
        if name not in known:
            raise UsageError(f"no estimator has the parameter {name!r}; there are {', '.join(known)}")
    names = (list(parameters) or known)[:PANELS]
    settings, rows = placed(label_frame(results).loc[sorted(set(results.errors["group"]))], results)
    boxes = rows[["method", "place"]].merge(errors, left_index=True, right_on="group")
    labels = ["\n".join(map(value_text, point)) for point in settings.points]
    scale = Scale([float(k) for k in range(len(labels))], False, labels)
    # Many boxes need the whole width.
    columns = 1 if len(labels) * len(settings.methods) > CROWDED else columns_for(len(names))

    def draw(figure: Figure) -> None:
        panels = panels_of(figure, len(names), columns)
        for axes, name in zip(panels, names, strict=True):
            _draw_panel(axes, boxes[boxes["parameter"] == name], settings)
            unit = parameter_unit(name, results.errors["parameter"].unique().tolist())
            axes.set_ylabel(f"error of {plain(name)}" + ("" if unit == "-" else f" [{unit}]"))
            scale.apply(axes)
            axes.set_xlabel(", ".join(settings.titles))
        looks = {name: look(k) | {"linestyle": "none"} for k, name in enumerate(settings.methods)}
        legend_of(figure, looks, min(len(looks), 4))
        how = "box: quartiles; whiskers: 5 and 95 %; mark: median with its 95 % interval"
        figure.suptitle(f"{results.experiment}: errors of parameters\n{how}; number at an edge: errors beyond it")

    return Drawing(*size_for(len(names), columns=columns), draw)


def _draw_panel(axes: Axes, rows: pd.DataFrame, settings: Settings) -> None:
    """Draw the boxes of one parameter; errors outside the panel are counted at the edge."""
    width, middle = 0.7 / len(settings.methods), 0.5 * (len(settings.methods) - 1)
    boxes: list[tuple[float, int, Any]] = [
        (float(str(place)) + width * (k - middle), k, own["value"].to_numpy())
        for k, method in enumerate(settings.methods)
        for place, own in rows[rows["method"] == method].groupby("place")
    ]
    axes.axhline(0.0, color=MIDDLE, linewidth=0.7, zorder=0.5)
    axes.grid(False, axis="x")
    if not boxes:
        return
    low, high = _limits([errors for _, _, errors in boxes])
    for at, k, errors in boxes:
        _draw_box(axes, at, 0.8 * width, errors, look(k))
        for beyond, edge, side in ((errors < low, 0.01, "bottom"), (errors > high, 0.99, "top")):
            if beyond.any():
                inside = axes.get_xaxis_transform()
                look_of_count: dict[str, Any] = {"ha": "center", "va": side, "fontsize": 7}
                behind = {"facecolor": "white", "edgecolor": "none", "pad": 1.0}
                axes.text(at, edge, str(beyond.sum()), transform=inside, bbox=behind, **look_of_count)
    margin = 0.08 * (high - low)
    axes.set_ylim(low - margin, high + margin)


def _limits(groups: Sequence[Array]) -> tuple[float, float]:
    """Return the range of a panel: all errors that are not much larger than the whiskers of most boxes."""
    ends = [float(np.abs(np.quantile(errors, (0.05, 0.95))).max()) for errors in groups]
    # With two boxes the shorter one decides.
    reach = REACH * float(np.quantile(ends, 0.5, method="lower"))
    every = np.concatenate(groups)
    low, high = max(float(every.min()), -reach), min(float(every.max()), reach)
    return (low, high) if high > low else (low - 0.5, low + 0.5)


def _draw_box(axes: Axes, at: float, width: float, errors: Array, style: dict[str, Any]) -> None:
    low, first, third, high = np.quantile(errors, (0.05, 0.25, 0.75, 0.95))
    color = style["color"]
    axes.bar(at, third - first, width, first, facecolor="white", edgecolor=color, linewidth=0.9)
    axes.vlines([at, at], [low, third], [first, high], color=color, linewidth=0.9)
    median = quantile(errors)
    if median.low is not None and median.high is not None:
        axes.vlines(at, median.low, median.high, color=color, linewidth=2.4)
    axes.plot(at, np.median(errors), **{**style, "linestyle": "none"}, markersize=3.5)
