"""Where the points of a figure lie: the settings that an experiment varies, and the words for them."""

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
    """What varies from group to group of the estimates of an experiment."""

    #: Keys of rows, the last one varying fastest.
    names: tuple[str, ...]
    #: Their titles with units.
    titles: tuple[str, ...]
    #: Values of the settings at each place of a figure.
    points: list[tuple[Any, ...]]
    methods: list[str]


def placed(frame: pd.DataFrame, results: Results) -> tuple[Settings, pd.DataFrame]:
    """Return what varies in the rows of an experiment, and the rows with their ``place``.

    A row that lacks a setting, such as an initial delay, is the same at all values of it.
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
        # Estimators of one name may differ in options that only some of them have: not every combination is planned.
        if len(own):
            parts.append(own.assign(place=len(points)))
            points.append(point)
    rows = pd.concat(parts).drop_duplicates([*({"parameter"} & {*frame}), "method", "place"])
    return Settings((*varied,), titles, points, frame["method"].unique().tolist()), rows


def _ordered(values: Any) -> list[Any]:
    """Values without repetition, numbers by size and before words."""
    found = [value for value in dict.fromkeys(map(_hashable, values)) if value is not None and value == value]
    return sorted(found, key=lambda value: (0, value) if _is_number(value) else (1, 0.0))


def _hashable(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def value_text(value: Any) -> str:
    """A value of a setting."""
    return plain(number(value))


def title_of(name: str, settings: Mapping[str, Any]) -> str:
    """The name of a swept setting with its unit."""
    if name == "initial_delay":
        return "initial delay [s]"
    key, title = name.rpartition(".")[2], "SNR" if name == "snr_db" else name.replace("_", " ")
    sections = [(section, item) for section, item in settings.items() if isinstance(item, Mapping)]
    sections += [("estimators", item) for item in settings["estimators"].values()]
    units = (unit_of(section, key) for section, content in sections if key in content)
    unit = next(filter(None, units), "")
    return f"{title} [{unit}]" if unit else title


class Scale(NamedTuple):
    """Where the points of a figure stand along its horizontal axis."""

    places: list[float]
    logarithmic: bool
    #: Labels of the places; none where the places are the values themselves.
    labels: list[str] | None

    def shifted(self, k: int, n: int) -> list[float]:
        """Places of the k-th of n series, side by side."""
        moved = [math.log(place) if self.logarithmic else place for place in self.places]
        gaps = [abs(b - a) for a, b in itertools.pairwise(moved) if a != b]
        shift = 0.08 * min(gaps, default=1.0) * (k - 0.5 * (n - 1))
        return [math.exp(place + shift) if self.logarithmic else place + shift for place in moved]

    def apply(self, axes: Axes) -> None:
        """Give a panel this axis."""
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
    """Numbers of a single setting where they are, by their logarithms if they span decades; all else side by side."""
    if len(settings.names) == 1 and all(_is_number(value) for (value,) in settings.points):
        places = [float(value) for (value,) in settings.points]
        return Scale(places, places[0] > 0 and places[-1] >= 16 * places[0], None)
    if len(settings.names) == 1:
        labels = [delay_label(v) if settings.names[0] == "initial_delay" else value_text(v) for (v,) in settings.points]
    else:
        labels = [""] * len(settings.points)
    return Scale([float(k) for k in range(len(settings.points))], False, labels)
