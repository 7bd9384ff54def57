"""The figure of an order search: what each structure gains."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ctid_cli.estimators.order_search import OrderSearch
from ctid_cli.reporting.figures.style import LOOKS, MARK, Drawing, plain

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def order_drawing(found: OrderSearch, title: str) -> Drawing:
    """Root mean square error, and BIC above the least, over the number of poles; a line for each number of zeros."""

    def draw(figure: Figure) -> None:
        error, criterion = figure.subplots(1, 2)
        by_size = sorted(found.orders, key=lambda each: each.options.poles)
        for zeros in sorted({each.options.zeros for each in by_size}):
            own = [each for each in by_size if each.options.zeros == zeros]
            poles = [each.options.poles for each in own]
            look = dict(LOOKS[zeros % len(LOOKS)], markersize=5, linewidth=1.0)
            label = f"{zeros} zero{'s' * (zeros != 1)}"
            error.plot(poles, np.sqrt([each.fit.cost for each in own]), label=label, **look)
            above = np.array([each.criteria.bic - found.best.criteria.bic for each in own])
            criterion.plot(poles, above, label=label, **look)
        best = found.recommended
        if best is not None:
            at = best.options.poles, 0.0
            criterion.plot(*at, "o", color=MARK, markersize=13, fillstyle="none", label="recommended")
        error.set_yscale("log")
        # Linear where structures differ by little, logarithmic beyond.
        criterion.set_yscale("symlog", linthresh=10.0)
        error.set_ylabel("root mean square output error")
        criterion.set_ylabel("BIC above the least")
        for axes in (error, criterion):
            axes.set_xlabel("poles")
            axes.set_xticks(sorted({each.options.poles for each in by_size}))
        handles, labels = criterion.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False)
        error.set_title(plain(title), loc="left")

    return Drawing(7.5, 3.7, draw)
