"""Figures of a search by useful redundancy: costs of its filters over the delay, and its path."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ctid_cli.arrays import Array
from ctid_cli.estimation.common import Start
from ctid_cli.estimation.filtered_costs import FilteredCost, FilterSearch, percents
from ctid_cli.estimators.useful_redundancy import RedundantFit, UsefulRedundancy
from ctid_cli.reporting.figures.style import DARK, LIGHT, MARK, MIDDLE, Drawing, pointed, ramp, spread
from ctid_cli.simulation.dataset import DataSet

if TYPE_CHECKING:
    from matplotlib.figure import Figure


#: Number of passes over the delays, alternately up and down: more do not lower the costs visibly.
SWEEPS = 2


@dataclass(frozen=True, eq=False)
class Leg:
    """An accepted solver path: from one incumbent to the next."""

    filter: int
    #: Gauss-Newton steps [s], from one incumbent to the next, shape (K,).
    delays: Array
    #: J0 there, as the search evaluates it [%], shape (K,).
    costs: Array
    switched: bool


@dataclass(frozen=True, eq=False)
class Landscape:
    """Costs over the delay and a search through them."""

    #: Delays [s], increasing, shape (N,).
    delays: Array
    #: Least costs found over the coefficients [%], from the filter of longest period, shape (N, filters).
    members: Array
    #: J0 as the search evaluates it [%], shape (N,).
    evaluated: Array
    #: True delay [s].
    true_delay: float
    fit: RedundantFit
    legs: tuple[Leg, ...]

    @property
    def reference(self) -> Array:
        """J0, the mean of the members [%], shape (N,)."""
        return np.asarray(self.members.mean(axis=1))

    @property
    def cutoffs(self) -> Array:
        """Cut-off frequencies of the filters [rad/s], shape (filters,)."""
        assert self.fit.filters is not None
        return self.fit.filters.cutoffs


def landscape(
    estimator: UsefulRedundancy, data_set: DataSet, delays: ArrayLike, initial_delay: float, sweeps: int = SWEEPS
) -> Landscape:
    """Return the costs over the delay, and the search from one initial delay.

    Far from the true delay the costs have local minima over the coefficients, and the one found by the search varies
    with the delay. The least costs come from a continuation: good coefficients at one delay and for one filter are
    tried at the next delay and for its neighbours.
    """
    grid = np.asarray(delays, dtype=float)
    prepared = estimator.prepare(data_set.record)
    assert data_set.true_model is not None
    fit, reference_cost = prepared.fit(Start(delay=initial_delay)), prepared.laid_out.filtered.reference_cost
    ours = replace(estimator, variant="guarded").prepare(data_set.record).laid_out.filtered
    assert isinstance(ours, FilterSearch)
    return Landscape(
        delays=grid,
        members=_least_costs(ours.costs, grid, sweeps),
        evaluated=np.array([reference_cost(delay) for delay in grid.tolist()]),
        true_delay=data_set.true_model.delay,
        fit=fit,
        legs=_legs(reference_cost, fit),
    )


def _least_costs(costs: Sequence[FilteredCost], delays: Array, sweeps: int) -> Array:
    many, size = len(costs), costs[0].size
    thetas, least = np.zeros((delays.size, many, size)), np.full((delays.size, many), np.inf)
    for sweep in range(sweeps):
        before = None
        for i in range(delays.size) if sweep % 2 == 0 else reversed(range(delays.size)):
            # Coefficients at the previous delay and for the neighbouring filters, the widest band first.
            for k in reversed(range(many)):
                known = [] if before is None else [(before, k)]
                known += [(i, near) for near in (k + 1, k - 1) if 0 <= near < many]
                starts = np.array([thetas[place] for place in known if np.isfinite(least[place])]).reshape(-1, size)
                # Least squares on a narrow band is unusable in noise.
                own = sweep == 0 and (k == many - 1 or not starts.size)
                found = costs[k].minimise(float(delays[i]), starts, own)
                if found.squared_error < least[i, k]:
                    thetas[i, k], least[i, k] = found.theta, found.squared_error
            before = i
    return percents(least, np.array([cost.spread for cost in costs]))


def _legs(reference_cost: Callable[[float], float], fit: RedundantFit) -> tuple[Leg, ...]:
    assert fit.search is not None
    legs = []
    for visit in fit.search.trajectory[1:]:
        followed = [path for path in fit.paths if (path.round, path.filter) == (visit.round, visit.path)]
        # The candidates of our search lie on a lattice, unlike the ends of its paths.
        path = min(followed, key=lambda path: abs(path.delays[-1] - visit.point))
        delays = np.append(path.delays[:-1], visit.point)
        costs = np.array([reference_cost(delay) for delay in delays.tolist()])
        legs.append(Leg(path.filter, delays, costs, visit in fit.switches))
    return tuple(legs)


def costs_svg(result: Landscape, title: str) -> bytes:
    """Draw the costs of all filters over the delay."""
    delays, members = result.delays, result.members
    lines = ramp(members.shape[1])
    top = 1.03 * float(members.max())

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot()
        _draw_true_delay(axes, result)
        for k, line in enumerate(lines):
            axes.plot(delays, members[:, k], linewidth=1.1, **line)
        for k, place in enumerate(spread(members[-1], 0.052 * top)):
            color = lines[k]["color"]
            ends = (delays[-1], members[-1, k]), (delays[-1] + 0.35, place)
            name = f"{k + 1}: {result.cutoffs[k]:.3g} rad/s"
            pointed(axes, name, *ends, {"linewidth": 0.5, "color": color}, fontsize=8, color=color)
        axes.text(result.true_delay - 0.1, 0.97 * top, "true delay", ha="right", va="top", fontsize=8, color=MIDDLE)
        axes.set(xlim=(delays[0], delays[-1]), ylim=(0.0, top), xlabel=r"delay $\hat\tau$ [s]")
        axes.set_ylabel(r"cost $100\,\|y_k - \hat x_k\| \,/\, \|y_k - \mathrm{mean}\,y_k\|$ [%]")
        figure.suptitle(title)

    return Drawing(7.5, 4.0, draw).saved()


def trajectory_svg(result: Landscape, title: str, detail: tuple[float, float]) -> bytes:
    """Draw J0 over the delay, and the path of the delay estimate with the filters that it used."""
    whole = (float(result.delays[0]) - 0.2, float(result.delays[-1]))

    def draw(figure: Figure) -> None:
        panels = figure.subplots(2, 2, width_ratios=[1.9, 1], height_ratios=[1.6, 1])
        for (cost, used), (low, high) in zip(panels.T, (whole, detail), strict=True):
            _draw_reference(cost, result, low, high)
            _draw_filters(used, result)
            for axes in (cost, used):
                _draw_true_delay(axes, result)
                axes.set_xlim(low, high)
            cost.tick_params(labelbottom=False)
            used.set_xlabel(r"delay $\hat\tau$ [s]")
        panels[0, 0].set_ylabel("cost $J_0$ [%]")
        panels[1, 0].set_ylabel("filter of the path")
        panels[0, 1].set_title(f"around the true delay, {result.true_delay:g} s", loc="left")
        _name_filters(panels[1, 0], result)
        count = sum(leg.switched for leg in result.legs)
        switches = {0: "no switch", 1: "one switch"}.get(count, f"{count} switches")
        way = f"search from {result.legs[0].delays[0]:g} s: {switches}, ends at {result.legs[-1].delays[-1]:.4f} s"
        figure.suptitle(f"{title}\n{way}; refined on unfiltered data: {result.fit.model.delay:.4f} s")
        above, below = (axes.get_legend_handles_labels() for axes in panels[:, 0])
        handles, labels = (a + b for a, b in zip(above, below, strict=True))
        figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)

    return Drawing(7.5, 5.6, draw).saved()


def _draw_true_delay(axes: Any, result: Landscape) -> None:
    axes.axvline(result.true_delay, color=MIDDLE, linewidth=0.8, zorder=0.9)


def _draw_reference(axes: Any, result: Landscape, low: float, high: float) -> None:
    delays, least = result.delays, result.reference
    axes.plot(delays, least, color=DARK, linewidth=1.4, label="$J_0$, least over the coefficients")
    steps = {"drawstyle": "steps-mid", "zorder": 1.5, "label": "$J_0$ as the search evaluates it"}
    axes.plot(delays, result.evaluated, color=LIGHT, linewidth=0.8, **steps)
    for k, leg in enumerate(result.legs):
        label = None if k else "Gauss-Newton steps"
        axes.plot(leg.delays, leg.costs, "o:", color=MARK, markersize=3.5, linewidth=0.8, label=label)
    _draw_marks(axes, result, [leg.costs for leg in result.legs])
    inside = (low <= delays) & (delays <= high)
    top = 1.05 * max(least.max(), result.evaluated.max()) if inside.all() else 1.25 * least[inside].max()
    axes.set_ylim(0.0, top)


def _draw_filters(axes: Any, result: Landscape) -> None:
    count = result.members.shape[1]
    label: str | None = "end of a path not taken"
    for path in result.fit.paths:
        # The last round, which led to nothing, and the accepted paths are left out.
        if path.round <= len(result.legs) and not any(path.delays is leg.delays for leg in result.legs):
            axes.plot(path.delays, np.full(path.delays.size, path.filter + 1.0), "-", color=LIGHT, linewidth=0.7)
            axes.plot(path.delays[-1:], [path.filter + 1.0], "|", color=MIDDLE, markersize=5, label=label)
            label = None
    rows = [np.full(leg.delays.size, leg.filter + 1.0) for leg in result.legs]
    for leg, row in zip(result.legs, rows, strict=True):
        axes.plot(leg.delays, row, "o-", color=MARK, markersize=3, linewidth=1.0)
    for leg, before, row in zip(result.legs[1:], rows, rows[1:], strict=False):
        axes.plot(leg.delays[[0, 0]], [before[-1], row[0]], color=MARK, linewidth=0.8, linestyle=":")
    _draw_marks(axes, result, rows, named=False)
    axes.grid(False, axis="y")
    axes.set(ylim=(0.4, count + 0.6), yticks=range(1, count + 1, 1 if count <= 10 else 2))
    axes.tick_params(axis="y", labelsize=7)


def _draw_marks(axes: Any, result: Landscape, heights: Sequence[Array], named: bool = True) -> None:
    """Draw start and end of the path, and a star where it switches the filter."""
    first, last = result.legs[0], result.legs[-1]
    leaving = zip(result.legs[1:], heights, strict=False)
    stars = [(leg.delays[0], before[-1]) for leg, before in leaving if leg.switched]
    end = {"marker": "D", "markersize": 5, "markerfacecolor": "white", "zorder": 5}
    for name, places, style in (
        ("start", [(first.delays[0], heights[0][0])], {"marker": "s", "markersize": 5}),
        ("switch", stars, {"marker": "*", "markersize": 10, "zorder": 4}),
        ("end of the search", [(last.delays[-1], heights[-1][-1])], end),
    ):
        if places:
            axes.plot(*np.transpose(places), linestyle="", color=MARK, label=name if named else None, **style)


def _name_filters(axes: Any, result: Landscape) -> None:
    rightmost = max(float(leg.delays.max()) for leg in result.legs)
    used = sorted({leg.filter for leg in result.legs})
    box = {"facecolor": "white", "edgecolor": "none", "pad": 1.0}
    for k, row in zip(used, spread([k + 1.0 for k in used], 0.11 * result.members.shape[1]), strict=True):
        text = f"filter {k + 1}, {result.cutoffs[k]:.3g} rad/s"
        axes.text(rightmost + 0.35, row, text, va="center", fontsize=8, bbox=box, zorder=2.2)
