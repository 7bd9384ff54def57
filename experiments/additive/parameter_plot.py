"""Drawings of mean-square errors of parameters over the number of samples."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from ctid_cli.reporting.figures.style import DARK, MARK, MIDDLE, Drawing, legend_of, panels_of

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

#: Looks of up to four estimators, told apart by colour, marker and line.
LOOKS: tuple[dict[str, Any], ...] = (
    {"color": DARK, "marker": "o", "markerfacecolor": DARK, "linestyle": "-"},
    {"color": MARK, "marker": "s", "markerfacecolor": "none", "linestyle": "--"},
    {"color": MIDDLE, "marker": "^", "markerfacecolor": "none", "linestyle": "-."},
    {"color": "#3a7d34", "marker": "x", "linestyle": ":"},
)
#: Labels of estimators by their names.
Methods = Mapping[str, str]


def symbol(parameter: str) -> str:
    """A parameter of a submodel as a formula."""
    return re.sub(r"^g(\d+)_([ab])(\d+)$", r"$\2_{\1,\3}$", parameter)


def mse_svg(errors: pd.DataFrame, methods: Methods, parameters: Sequence[str], columns: int, title: str) -> bytes:
    """Mean-square errors over the number of samples, one panel for each parameter."""
    lines = -(-len(parameters) // columns)

    def draw(figure: Figure) -> None:
        from matplotlib.ticker import NullFormatter

        panels = panels_of(figure, len(parameters), columns, sharex=True)
        for k, (axes, parameter) in enumerate(zip(panels, parameters, strict=True)):
            for method, look in zip(methods, LOOKS, strict=False):
                own = errors[(errors["estimator"] == method) & (errors["parameter"] == parameter)]
                N, theory = own["samples"], own["theory"] / own["samples"]
                axes.plot(N, theory, color=look["color"], linestyle=look["linestyle"], linewidth=0.9)
                axes.plot(N, own["mse"], **look | {"linestyle": "none"}, markersize=3.2, markeredgewidth=0.8)
            axes.set(xscale="log", yscale="log")
            for axis in (axes.xaxis, axes.yaxis):
                axis.set_minor_formatter(NullFormatter())
            axes.set_title(symbol(parameter), loc="left")
            if k % columns == 0:
                axes.set_ylabel("mean-square error")
            if k // columns == lines - 1:
                axes.set_xlabel("number of samples $N$")
        labels = [labelled(label, errors[errors["estimator"] == method]) for method, label in methods.items()]
        wide = max(map(len, labels)) > 40 or len(labels) > 3
        note = "simulated (marker), theory for long records (line)"
        looks = dict(zip(labels, LOOKS, strict=False))
        legend_of(figure, looks, 2 if wide else 3, title=note, title_fontsize=8)
        runs = " to ".join(map(str, sorted({errors["runs"].min(), errors["runs"].max()})))
        several = " a point" if errors["samples"].nunique() > 1 else ""
        figure.suptitle(f"{title} ({runs} data sets{several})")

    return Drawing(7.5, 1.4 + 2.1 * lines, draw).saved()


def labelled(label: str, groups: pd.DataFrame) -> str:
    """Return what an estimator is called, and how many of its estimates are not as they should be."""
    # Every parameter of a group carries the same counts.
    sums = groups.drop_duplicates("group")[["runs", "failed", "not_converged", "valueless"]].sum()
    unfinished = sums["failed"] + sums["not_converged"]
    notes = [f"{unfinished} of {sums['runs']} not converged"] if unfinished else []
    notes += [f"{sums['valueless']} without a value"] if sums["valueless"] else []
    return f"{label} ({', '.join(notes)})" if notes else label
