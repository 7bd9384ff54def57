"""Positions of the points of a figure: the settings that an experiment varies, and their labels."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

from ctid_cli.reporting.figures.style import plain
from ctid_cli.reporting.layout import delay_label, number
from ctid_cli.reporting.measures import settings_of
from ctid_cli.reporting.results import Results
from ctid_cli.specification.reference import unit_of

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes


class Settings(NamedTuple):
    """Settings that vary between groups of the estimates of an experiment."""

    #: Keys of rows, the last one varying fastest.
    names: tuple[str, ...]
    #: Their titles with units.
    titles: tuple[str, ...]
    #: Values of the settings at each place of a figure.
    points: list[tuple[Any, ...]]
    methods: list[str]


def placed(frame: pd.DataFrame, results: Results) -> tuple[Settings, pd.DataFrame]:
    """Return the settings that vary in the rows of an experiment, and the rows with their ``place``.

    A row without a setting, such as an initial delay, counts for all its values.
    """
    import pandas as pd

    values = {name: _ordered(frame[name]) for name in [*settings_of(frame), "initial_delay"]}
    varied = {name: found for name, found in values.items() if len(found) > 1}
    titles = tuple(title_of(name, results.settings) for name in varied)
    points: list[tuple[Any, ...]] = []
    parts: list[pd.DataFrame] = []
    for point in itertools.product(*varied.values()):
        own = frame
        for name, value in zip(varied, point, strict=True):
            column = own[name].map(_hashable)
            own = own[column.isna() | (column == value)]
        # Estimators of one name may have different options, so not every combination is planned.
        if len(own):
            parts.append(own.assign(place=len(points)))
            points.append(point)
    rows = pd.concat(parts).drop_duplicates([*({"parameter"} & {*frame}), "method", "place"])
    return Settings((*varied,), titles, points, frame["method"].unique().tolist()), rows


def _ordered(values: Any) -> list[Any]:
    """Return values without repetition, numbers in order and before words."""
    found = [value for value in dict.fromkeys(map(_hashable, values)) if value is not None and value == value]
    return sorted(found, key=lambda value: (0, value) if _is_number(value) else (1, 0.0))


def _hashable(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def value_text(value: Any) -> str:
    """Return a value of a setting as text."""
    return plain(number(value))


def title_of(name: str, settings: Mapping[str, Any]) -> str:
    """Return the name of a swept setting with its unit."""
    if name == "initial_delay":
        return "initial delay [s]"
    key, title = name.rpartition(".")[2], "SNR" if name == "snr_db" else name.replace("_", " ")
    sections = [(section, item) for section, item in settings.items() if isinstance(item, Mapping)]
    sections += [("estimators", item) for item in settings["estimators"].values()]
    units = (unit_of(section, key) for section, content in sections if key in content)
    unit = next(filter(None, units), "")
    return f"{title} [{unit}]" if unit else title


class Scale(NamedTuple):
    """Positions of the points of a figure along its horizontal axis."""

    places: list[float]
    logarithmic: bool
    #: Labels of the places; none if the places are the values themselves.
    labels: list[str] | None

    def shifted(self, k: int, n: int) -> list[float]:
        """Return the places of the k-th of n series, side by side."""
        moved = [math.log(place) if self.logarithmic else place for place in self.places]
        gaps = [abs(b - a) for a, b in itertools.pairwise(moved) if a != b]
        shift = 0.08 * min(gaps, default=1.0) * (k - 0.5 * (n - 1))
        return [math.exp(place + shift) if self.logarithmic else place + shift for place in moved]

    def apply(self, axes: Axes) -> None:
        """Set the axis of a panel."""
        if self.logarithmic:
            from matplotlib.ticker import NullFormatter, NullLocator

            axes.set_xscale("log")
            axes.set_xticks(self.places, [number(place, 3) for place in self.places])
            axes.xaxis.set_minor_locator(NullLocator())
            axes.xaxis.set_minor_formatter(NullFormatter())
        elif self.labels is not None:
            axes.set_xticks(self.places, self.labels)
            axes.set_xlim(min(self.places) - 0.6, max(self.places) + 0.6)


def scale_of(settings: Settings) -> Scale:
    """Place numbers of a single setting by value, or logarithm if they span decades; everything else evenly."""
    if len(settings.names) == 1 and all(_is_number(value) for (value,) in settings.points):
        places = [float(value) for (value,) in settings.points]
        return Scale(places, places[0] > 0 and places[-1] >= 16 * places[0], None)
    if len(settings.names) == 1:
        labels = [delay_label(v) if settings.names[0] == "initial_delay" else value_text(v) for (v,) in settings.points]
    else:
        labels = [""] * len(settings.points)
    return Scale([float(k) for k in range(len(settings.points))], False, labels)
