"""The figure of the structures of a choice: what each gains."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ctid_cli.identification.choice import Choice
from ctid_cli.reporting.figures.style import LOOKS, MARK, Drawing, name_axes, plain

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def order_drawing(choice: Choice, title: str) -> Drawing:
    """Root mean square error, and the criterion above the least, over all poles; a line for each number of zeros.

    Structures with an integrator are drawn with open marks.
    """

    def draw(figure: Figure) -> None:
        error, criterion = figure.subplots(1, 2)
        best = choice.ranking.best
        by_size = sorted(choice.ranking.candidates, key=lambda each: each.options.order)
        families = sorted({(each.options.zeros, each.options.integrators) for each in by_size})
        for zeros, integrators in families:
            own = [each for each in by_size if (each.options.zeros, each.options.integrators) == (zeros, integrators)]
            poles = [each.options.order for each in own]
            look = dict(LOOKS[zeros % len(LOOKS)], markersize=5, linewidth=1.0)
            look |= {"fillstyle": "none", "linestyle": ":"} if integrators else {}
            label = f"{zeros} zero{'s' * (zeros != 1)}{', integrator' * bool(integrators)}"
            error.plot(poles, np.sqrt([each.fit.cost for each in own]), label=label, **look)
            above = np.array([each.criterion - best.criterion for each in own])
            criterion.plot(poles, above, label=label, **look)
        if choice.seen:
            at = best.options.order, 0.0
            criterion.plot(*at, "o", color=MARK, markersize=13, fillstyle="none", label="chosen")
        error.set_yscale("log")
        # Linear where structures differ by little, logarithmic beyond.
        criterion.set_yscale("symlog", linthresh=10.0)
        for axes, name in ((error, "root mean square output error"), (criterion, "criterion above the least")):
            name_axes(axes, "poles, integrators included", name)
            axes.set_xticks(sorted({each.options.order for each in by_size}))
        handles, labels = criterion.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 6), frameon=False)
        error.set_title(plain(title), loc="left")

    return Drawing(7.5, 3.7, draw)
