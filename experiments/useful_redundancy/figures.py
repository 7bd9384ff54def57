"""Figures 1 to 7 of the study.

Figures 1 and 2 are theory; 3 to 7 are computed from the specifications of cases 1 and 2, with the first data set on
which our search from 0 s switches the filter, made again from its seed. Equation numbers are those of Ha, Welsh and
Alamir, "Useful redundancy in parameter and time delay estimation for continuous-time models" (arXiv:1703.09344).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.estimation.common import Start
from ctid_cli.estimators.useful_redundancy import UsefulRedundancy
from ctid_cli.filtering.filter_set import FilterCheck, FilterSet, check_filters, convergence_region, extrema, ideal_cost
from ctid_cli.reporting.figures.style import BAND, DARK, LIGHT, MARK, MIDDLE, Drawing, pointed, ramp, spread
from ctid_cli.reporting.study import find_study
from ctid_cli.signals.record import Record
from ctid_cli.simulation.dataset import DataSet

from .search_plot import Landscape, costs_svg, landscape, trajectory_svg

if TYPE_CHECKING:
    from matplotlib.figure import Figure


#: SNR of the drawn data sets [dB].
SNR = 15.0
#: Largest delay of the searches [s].
LARGEST = 15.0


@dataclass(frozen=True)
class Case:
    """One of the two simulated systems of the study."""

    number: int
    experiment: str
    #: Distance of the delays at which costs are computed [s].
    interval: float
    #: Delays [s] that are drawn again in detail.
    detail: tuple[float, float]
    sweeps: int

    @property
    def delays(self) -> Array:
        """Delays at which costs are drawn [s]."""
        whole = np.arange(round(LARGEST / self.interval) + 1) * self.interval
        return np.unique(np.round(np.concatenate([whole, np.linspace(*self.detail, 41)]), 9))


CASE_1 = Case(1, "case1-regular", interval=0.05, detail=(7.4, 9.0), sweeps=4)
CASE_2 = Case(2, "case2-regular", interval=0.04, detail=(7.9, 8.1), sweeps=2)


def figure_1() -> bytes:
    """Cost of a delay error behind an ideal low-pass filter, its extrema and its convergence region."""
    cutoff, largest = 2 * np.pi, 4.0
    errors = np.linspace(-largest, largest, 1601)
    places = extrema(cutoff, 16, exact=True)
    places = places[places < largest]
    region, printed = (convergence_region(cutoff, exact) for exact in (True, False))

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot()
        axes.axvspan(-region, region, color=BAND, linewidth=0)
        axes.axhline(2 * cutoff / np.pi, color=MIDDLE, linewidth=0.8, linestyle="--")
        axes.plot(errors, ideal_cost(errors, cutoff), color=DARK, linewidth=1.2)
        for first, marker, label in ((0, "^", "local maximum"), (1, "v", "local minimum")):
            at = np.concatenate([-places[first::2][::-1], places[first::2]])
            axes.plot(at, ideal_cost(at, cutoff), marker, color=MARK, markersize=4.5, label=label)
        axes.plot([0.0], [0.0], "o", color=DARK, markersize=6, clip_on=False, label="global minimum")
        text = f"convergence region\n$|\\delta\\tau| < {region:.4f}$ s\n(by the approximation (37): {printed:.4f} s)"
        pointed(axes, text, (region, 1.0), (region + 0.3, 1.0), {"linewidth": 0.6, "shrinkA": 2})
        axes.text(-largest + 0.05, 2 * cutoff / np.pi - 0.12, r"$2\omega_c/\pi$", va="top", color=MIDDLE)
        axes.set(xlabel=r"delay error $\delta\tau$ [s]", ylabel=r"cost $\bar{J}$ [(output unit)²]")
        axes.set_xlim(-largest, largest)
        axes.set_ylim(bottom=0.0)
        axes.legend(loc="lower left", frameon=True)
        figure.suptitle(
            r"Ideal low-pass filter, $\omega_c = 2\pi$ rad/s: cost of a delay error, equation (50) "
            "(white input of unit intensity, no noise)"
        )

    return Drawing(7.5, 3.4, draw).saved()


def figure_2() -> bytes:
    """Six ideal costs, which of them serves which delay error, and the minimum path from one of these."""
    filters = FilterSet(bandwidth=2 * np.pi, count=6, beta=2.0)
    check = check_filters(filters.cutoffs, LARGEST)
    path = [(-1, 14.0), *check.path(14.0)]

    def draw(figure: Figure) -> None:
        above, below = figure.subplots(2, 1, height_ratios=[1.25, 1])
        _draw_costs(above, filters, path)
        _draw_intervals(below, check, filters.count)
        corners = [(error, k + 1) for (_, high), (k, low) in pairwise(path) for error in (high, low)]
        below.plot(*np.transpose(corners), color=MARK, linewidth=1.1, label=f"minimum path from {path[0][1]:g} s")
        below.plot([path[0][1]], [path[1][0] + 1], "s", color=MARK, markersize=4)
        at = np.transpose([(low, k + 1) for k, low in path[1:-1]])
        below.plot(*at, "*", color=MARK, markersize=7, markeredgecolor="white", markeredgewidth=0.4, label="switch")
        below.legend(loc="lower left", bbox_to_anchor=(-0.01, 0.99), ncols=4, frameon=False, columnspacing=1.2)
        below.grid(False, axis="y")
        below.set(xlim=(0.0, LARGEST), ylim=(0.45, 6.55), yticks=range(1, 7))
        below.set(xlabel=r"delay error $|\delta\tau|$ [s]", ylabel="filter")
        above.set_title("costs (50), and the end of the minimum path", loc="left")
        figure.suptitle(
            "Six ideal low-pass filters, $\\beta$ = 2, bandwidth $2\\pi$ rad/s: which filter serves which delay error\n"
            "The paper states that every error below 15 s is served; there is one gap"
        )

    return Drawing(7.5, 5.8, draw).saved()


def _draw_costs(axes: Any, filters: FilterSet, path: list[tuple[int, float]]) -> None:
    """Draw ideal costs with the minimum path."""
    shown, lines = 5.25, ramp(filters.count)
    errors = np.linspace(0.0, shown, 1001)
    for k, cutoff in enumerate(filters.cutoffs):
        axes.plot(errors, ideal_cost(errors, cutoff), linewidth=1.0, **lines[k])
    for k, place in enumerate(spread([2 * cutoff / np.pi for cutoff in filters.cutoffs], 0.3)):
        text = f"filter {k + 1}: {filters.cutoffs[k] / np.pi:.2f}$\\pi$ rad/s"
        axes.text(shown + 0.05, place, text, va="center", color=lines[k]["color"], fontsize=8)
    for (_, high), (k, low) in pairwise(path):
        along = np.linspace(low, high, 60)
        cost = ideal_cost(along, filters.cutoffs[k])
        axes.plot(along, cost, color=MARK, linewidth=2.2, alpha=0.8, solid_capstyle="round")
    for (k, low), (following, _) in pairwise(path[1:]):
        heights = [float(ideal_cost(low, filters.cutoffs[i])) for i in (k, following)]
        axes.plot([low, low], heights, color=MARK, linewidth=0.9, linestyle=":")
        axes.plot([low], heights[:1], "*", color=MARK, markersize=8, markeredgecolor="white", markeredgewidth=0.4)
    axes.set_xlim(0.0, shown)
    axes.set_ylim(bottom=0.0)
    axes.set(xlabel=r"delay error $|\delta\tau|$ [s]", ylabel=r"cost $\bar{J}$ [(output unit)²]")


def _draw_intervals(axes: Any, check: FilterCheck, count: int) -> None:
    """Draw which filter serves each delay error, and gaps without one."""
    for color, label, most in ((BAND, "leads closer to zero", None), (LIGHT, "leads closest", 1)):
        for k in range(count):
            spans = [(item.low, item.high) for item in check.intervals if k in item.filters[:most]]
            bars = [(low, high - low) for low, high in _joined(spans)]
            axes.broken_barh(bars, (k + 0.64, 0.72), color=color, linewidth=0, label=None if k else label)
    for low, high in check.gaps:
        axes.axvspan(low, high, facecolor="none", edgecolor="black", hatch="//////", linewidth=0.6)
        text = f"gap, {low:.2f} to\n{high:.2f} s: no filter\nleads closer"
        pointed(axes, text, (high, 3.5), (LARGEST + 0.15, 3.5), {"linewidth": 0.6, "shrinkA": 1}, fontsize=8)


def _joined(spans: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return intervals with adjoining ones joined."""
    joined: list[tuple[float, float]] = []
    for low, high in spans:
        if joined and joined[-1][1] == low:
            low = joined.pop()[0]
        joined.append((low, high))
    return joined


def figure_3() -> bytes:
    """Ten filtered costs of case 1 with the model error, without noise."""
    title = "Case 1 without noise: costs of the ten filters, normalised as in (45), "
    title += "coefficients re-estimated at every delay"
    return costs_svg(_computed(CASE_1, noise=False), title)


def figure_4() -> bytes:
    """J0 of case 1 without noise, and the minimum path of the search as printed: ours has no need to switch there."""
    title = "Case 1 without noise: $J_0$ and the minimum path as printed"
    return trajectory_svg(_computed(CASE_1, noise=False), title, CASE_1.detail)


def figure_5() -> bytes:
    """Costs of the ten filters on one data set of case 1."""
    title = f"Case 1, one data set, regular sampling, SNR {SNR:g} dB: costs of the ten filters, normalised as in (45)"
    return costs_svg(_computed(CASE_1, noise=True), title)


def figure_6() -> bytes:
    """J0 and the trajectory of the delay estimate on one data set of case 1."""
    return _data_set(CASE_1)


def figure_7() -> bytes:
    """J0 and the trajectory of the delay estimate on one data set of case 2."""
    return _data_set(CASE_2)


def _data_set(case: Case) -> bytes:
    title = f"Case {case.number}, one data set, regular sampling, SNR {SNR:g} dB: $J_0$ and the delay estimate"
    return trajectory_svg(_computed(case, noise=True), title, case.detail)


@cache
def _computed(case: Case, noise: bool) -> Landscape:
    estimator, data_set = published_search(case, noise)
    return landscape(estimator, data_set, case.delays, initial_delay=0.0, sweeps=case.sweeps)


def published_search(case: Case, noise: bool) -> tuple[UsefulRedundancy, DataSet]:
    """Return our search of a case, or the printed one without noise, and the first data set on which ours switches."""
    plan = find_study("useful-redundancy").plan(case.experiment)
    ours = next(cell.estimator for cell in plan.estimators if cell.name == "redundancy")
    drawn = next(cell for cell in plan.data_cells if cell.swept["snr_db"] == SNR)
    made = map(drawn.dataset, range(plan.runs))
    data_set = next(item for item in made if ours.fit(item.record, Start(delay=0.0)).switches)
    if noise:
        return ours, data_set
    record = data_set.record
    quiet = replace(data_set, record=Record(record.t, record.noise_free, record.input))
    return replace(ours, variant="plain"), quiet
