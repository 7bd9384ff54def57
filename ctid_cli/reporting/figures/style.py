"""Common parts of all figures: style, reproducible bytes, colours, and labels that do not overlap."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ctid_cli.arrays import Array
from ctid_cli.errors import UsageError
from ctid_cli.progress import reported
from ctid_cli.text import did_you_mean

if TYPE_CHECKING:
    from matplotlib.figure import Figure


#: Colours of different lightness, for grey prints.
DARK, MIDDLE, LIGHT, BAND = "#08306b", "#6b6b6b", "#a8a8a8", "#e4e4e4"
#: Style of highlights on lines of these colours, also of another shape.
MARK = "#b03a00"
#: Line styles of neighbouring curves.
_STYLES = ("-", "--", "-.", (0, (1, 1)))
#: Stripes in which a long curve is drawn: three per millimetre of paper.
STRIPES = 600
_STYLE: dict[Any, Any] = {
    "svg.hashsalt": "ctid",
    "font.size": 9.0,
    "axes.titlesize": 9.0,
    "figure.titlesize": 9.5,
    "legend.fontsize": 8.0,
    "axes.grid": True,
    "grid.color": "#eeeeee",
    "axes.axisbelow": True,
}


#: Styles of the estimators of an experiment: the colours of Okabe and Ito, for the colour-blind, with a marker and a
#: line for grey prints.
LOOKS: tuple[dict[str, Any], ...] = (
    {"color": "#0072b2", "marker": "o", "linestyle": "-"},
    {"color": "#d55e00", "marker": "s", "markerfacecolor": "white", "linestyle": "--"},
    {"color": "#000000", "marker": "x", "linestyle": ":"},
    {"color": "#009e73", "marker": "^", "markerfacecolor": "white", "linestyle": "-."},
    {"color": "#cc79a7", "marker": "D", "markerfacecolor": "white", "linestyle": (0, (5, 1, 1, 1))},
    {"color": "#56b4e9", "marker": "v", "markerfacecolor": "white", "linestyle": (0, (3, 1, 1, 1, 1, 1))},
    {"color": "#e69f00", "marker": "P", "linestyle": (0, (1, 2))},
    {"color": "#6b6b6b", "marker": "*", "linestyle": (0, (6, 3))},
)

Format = Literal["svg", "png", "pdf"]
#: Metadata of each format that are left out: date and versions.
_METADATA: dict[Format, Any] = {"svg": {"Date": None}, "png": {"Software": None}, "pdf": {"CreationDate": None}}


class Drawing(NamedTuple):
    """A figure to draw."""

    width: float  # [inch]
    height: float
    draw: Callable[[Figure], None]

    def figure(self) -> Figure:
        """Draw the figure."""
        with _style():
            figure = _notebook_figure()(figsize=(self.width, self.height), layout="constrained")
            self.draw(figure)
        return figure

    @reported("drawing the figure")
    def saved(self, style: Format = "svg") -> bytes:
        """Draw the figure as a file; the same drawing always gives the same bytes."""
        from matplotlib.backends.backend_svg import FigureCanvasSVG

        file, figure = io.BytesIO(), self.figure()
        with _style():
            if style == "svg":
                # Matplotlib would draw all parts, invisibly, only to lay them out, and then once more.
                FigureCanvasSVG(figure)
                layout = figure.get_layout_engine()
                assert layout is not None
                layout.execute(figure)
                figure.set_layout_engine("none")
            figure.savefig(file, format=style, metadata=_METADATA[style], dpi=200)
        return file.getvalue()


@cache
def _notebook_figure() -> type[Figure]:
    """Return the class of figures that a notebook shows without pyplot; Matplotlib is loaded by then."""
    from matplotlib.figure import Figure

    class NotebookFigure(Figure):
        def _repr_svg_(self) -> str:
            file = io.BytesIO()
            self.savefig(file, format="svg", metadata=_METADATA["svg"])
            return file.getvalue().decode()

    return NotebookFigure


def _style() -> Any:
    """Return a style independent of the user's defaults, for reproducible figures."""
    import matplotlib.style

    return matplotlib.style.context(["default", _STYLE])


def require_kind(kind: str | None, known: Sequence[str]) -> None:
    """Refuse an unknown kind of figure."""
    if kind is not None and kind not in known:
        hint = did_you_mean(kind, known) or ";"
        raise UsageError(f"there is no kind of figure {kind!r}{hint} there are {', '.join(known)}")


def plain(text: str) -> str:
    """Escape a text, so that nothing in it is read as a formula."""
    return text.replace("$", r"\$")


def name_axes(axes: Any, x: str = "", y: str = "", legend: str = "") -> None:
    """Name the axes of a panel in plain text, and place its legend."""
    if x:
        axes.set_xlabel(plain(x))
    if y:
        axes.set_ylabel(plain(y))
    if legend:
        axes.legend(loc=legend, fontsize=8)


def look(k: int) -> dict[str, Any]:
    """Return the style of the k-th estimator."""
    return LOOKS[k % len(LOOKS)]


def panels_of(figure: Figure, n: int, columns: int | None = None, **shared: Any) -> list[Any]:
    """Return ``n`` panels in rows; with a shared axis, the lowest of each column shows its numbers."""
    across = columns or columns_for(n)
    panels = list(figure.subplots(-(-n // across), across, squeeze=False, **shared).flat)
    for k, axes in enumerate(panels):
        axes.set_visible(k < n)
        if shared.get("sharex"):
            axes.tick_params(labelbottom=k + across >= n)
    return panels[:n]


def columns_for(n: int) -> int:
    """Return the number of columns for n panels."""
    return 2 if n in (2, 4) else min(n, 3)


def size_for(n: int, columns: int | None = None) -> tuple[float, float]:
    """Return width and height of a figure with n panels, a title and a legend [inch]."""
    return (7.5, 1.2 + 2.2 * -(-n // (columns or columns_for(n)))) if n > 1 else (5.5, 4.2)


def legend_of(figure: Figure, looks: Mapping[str, Mapping[str, Any]], columns: int, **others: Any) -> None:
    """Label series below a figure by their styles."""
    from matplotlib.lines import Line2D

    style = {"markersize": 4, "linewidth": 0.9}
    handles = [Line2D([], [], **{**style, **look}, label=label) for label, look in looks.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=columns, frameon=False, **others)


def pointed(axes: Any, text: str, point: ArrayLike, place: ArrayLike, arrow: dict[str, Any], **style: Any) -> None:
    """Write a text outside the axes, with a thin line to the point it describes."""
    line: dict[str, Any] = {"arrowstyle": "-", "shrinkA": 0, "shrinkB": 0}
    axes.annotate(text, point, place, va="center", annotation_clip=False, arrowprops=line | arrow, **style)


def outline(t: Array, values: Array) -> tuple[Array, Array]:
    """Return the least and greatest value of a curve in each stripe, if it has more points than can be seen.

    A stripe without a number remains a gap.
    """
    if values.size <= 4 * STRIPES:
        return t, values
    ends = np.linspace(0, values.size, STRIPES + 1).astype(int)
    low, high = (np.where(np.isnan(values), far, values) for far in (np.inf, -np.inf))
    stripes = list(zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True))
    kept = np.sort([[k + low[k:end].argmin(), k + high[k:end].argmax()] for k, end in stripes]).ravel()
    return t[kept], values[kept]


def ramp(count: int) -> list[dict[str, Any]]:
    """Return line properties of a family of curves, from light to dark, neighbours with different dashes."""
    light, dark = np.array([0.52, 0.68, 0.84]), np.array([0.03, 0.12, 0.30])
    shares = np.linspace(0.0, 1.0, count) if count > 1 else np.ones(1)
    return [
        {"color": tuple(light + share * (dark - light)), "linestyle": _STYLES[k % len(_STYLES)]}
        for k, share in enumerate(shares)
    ]


def spread(values: ArrayLike, distance: float) -> Array:
    """Return positions of labels, as close to their values as a least distance allows, in the same order."""
    values = np.asarray(values, dtype=float)
    groups: list[list[int]] = []

    def centre(group: Sequence[int]) -> float:
        return float(values[list(group)].mean())

    for k in np.argsort(values, kind="stable"):
        groups.append([int(k)])
        while len(groups) > 1:
            below, above = groups[-2:]
            if centre(above) - centre(below) >= 0.5 * distance * (len(below) + len(above)):
                break
            groups[-2:] = [below + above]
    places = np.empty(values.size)
    for group in groups:
        places[group] = centre(group) + distance * (np.arange(len(group)) - 0.5 * (len(group) - 1))
    return places
