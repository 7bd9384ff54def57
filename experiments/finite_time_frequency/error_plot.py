"""Figures of estimated frequencies over time, and of their errors on a logarithmic axis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.frequency.base import FrequencyTrack
from ctid_cli.reporting.figures.style import BAND, DARK, LIGHT, MARK, MIDDLE, Drawing

if TYPE_CHECKING:
    from matplotlib.figure import Figure


#: Styles of up to three estimators of a group, which differ in colour, lightness and dashes.
LOOKS: tuple[dict[str, Any], ...] = (
    {"color": DARK, "linestyle": "-"},
    {"color": MARK, "linestyle": (0, (3.2, 1.4))},
    {"color": MIDDLE, "linestyle": (0, (1, 1))},
)
#: Styles of estimates that are valid and invalid by their estimator.
FIRM: dict[str, Any] = {"linewidth": 1.5}
FAINT: dict[str, Any] = {"alpha": 0.6, "linewidth": 0.7}
#: Styles of the truth, and of the error of an estimate from the whole record.
TRUTH: dict[str, Any] = {"color": LIGHT, "linewidth": 3.2, "alpha": 0.6, "solid_capstyle": "butt"}
WHOLE: dict[str, Any] = {"color": MIDDLE, "linewidth": 0.8}
#: Smaller errors are rounding, and drawn at this value [rad/s].
ROUNDING = 1e-16


class Curve(NamedTuple):
    """Frequencies of one estimator."""

    label: str
    track: FrequencyTrack
    #: True frequencies [rad/s], shape (N, n).
    true: Array

    @property
    def error(self) -> Array:
        """Largest error of all tones, at least the rounding [rad/s], shape (N,)."""
        return np.asarray(np.maximum(np.abs(self.track.frequencies - self.true).max(axis=1), ROUNDING))


class Row(NamedTuple):
    """One experiment for all groups of estimators: a row of panels with frequencies, and one with errors."""

    title: str
    #: Estimators of each column, by its title.
    groups: Mapping[str, Sequence[Curve]]
    #: Length of the record [s].
    duration: float
    #: Time from which a finite-time estimator can be exact [s].
    exact_from: float
    #: Error of an estimate from the whole record [rad/s]; None for no line.
    reference: float | None = None


def errors_svg(rows: Sequence[Row], frequencies: tuple[float, float], errors: tuple[float, float], title: str) -> bytes:
    """Draw frequencies and errors over time."""

    def draw(figure: Figure) -> None:
        from matplotlib.lines import Line2D
        from matplotlib.ticker import MaxNLocator

        columns = len(rows[0].groups)
        shape: dict[str, Any] = {"squeeze": False, "height_ratios": [1.0, 1.15] * len(rows)}
        panels = figure.subplots(2 * len(rows), columns, sharex=True, sharey="row", **shape)
        for k, row in enumerate(rows):
            for above, below, curves in zip(panels[2 * k], panels[2 * k + 1], row.groups.values(), strict=True):
                _draw_frequencies(above, curves)
                _draw_errors(below, curves, row)
                above.set_ylim(*frequencies)
                below.set(yscale="log", ylim=errors)
            panels[2 * k, 0].set_ylabel(f"{row.title}\nfrequency [rad/s]".strip())
            panels[2 * k + 1, 0].set_ylabel(f"{row.title}\nlarger error [rad/s]".strip())
        for axes, title in zip(panels[0], rows[0].groups, strict=True):
            axes.set_title(title, loc="left", fontsize=8)
        for axes, curves in zip(panels[-1], rows[0].groups.values(), strict=True):
            axes.set(xlabel="time [s]", xlim=(0.0, rows[0].duration))
            axes.xaxis.set_major_locator(MaxNLocator(nbins=4, steps=[1, 1.5, 2, 3, 5, 10]))
            place: dict[str, Any] = {"loc": "upper left", "bbox_to_anchor": (-0.03, -0.27), "frameon": False}
            lines = zip(curves, LOOKS, strict=False)
            handles = [Line2D([], [], **look | FIRM, label=curve.label) for curve, look in lines]
            axes.legend(handles=handles, handlelength=2.8, borderpad=0.0, labelspacing=0.35, **place)
        figure.legend(handles=_common_handles(rows), loc="outside lower center", ncols=2, frameon=False)
        figure.suptitle(title)

    return Drawing(7.8, 2.1 + 2.9 * len(rows), draw).saved()


def _draw_frequencies(axes: Any, curves: Sequence[Curve]) -> None:
    axes.plot(curves[0].track.t, curves[0].true, **TRUTH, zorder=1)
    for curve, look in zip(curves, LOOKS, strict=False):
        for omega in curve.track.frequencies.T:
            _draw_line(axes, curve, omega, look)


def _draw_errors(axes: Any, curves: Sequence[Curve], row: Row) -> None:
    axes.axvspan(0.0, row.exact_from, color=BAND, linewidth=0.0, zorder=0)
    if row.reference is not None:
        axes.axhline(row.reference, **WHOLE, zorder=1)
    for curve, look in zip(curves, LOOKS, strict=False):
        _draw_line(axes, curve, curve.error, look)


def _draw_line(axes: Any, curve: Curve, values: Array, look: dict[str, Any]) -> None:
    axes.plot(curve.track.t, values, **look | FAINT)
    axes.plot(curve.track.t, np.where(curve.track.valid, values, np.nan), **look | FIRM)


def _common_handles(rows: Sequence[Row]) -> list[Any]:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles = [
        Line2D([], [], **TRUTH, label="true frequencies"),
        Line2D([], [], color=DARK, **FAINT, label="thin: called invalid by the estimator itself"),
        Patch(color=BAND, label="before the first instant at which finite time is exact, $n(2h + d)$"),
    ]
    known = any(row.reference is not None for row in rows)
    return [*handles, Line2D([], [], **WHOLE, label="nonlinear least squares, whole record")] if known else handles
