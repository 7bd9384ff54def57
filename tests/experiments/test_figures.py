"""Figures of the studies: they follow from theory and search, and are reproducible to the byte."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from ctid_cli.reporting.figures.style import STRIPES, outline, spread
from ctid_cli.reporting.study import find_study
from ctid_cli.studies.catalogue import find_figures
from experiments.useful_redundancy.search_plot import landscape

useful_redundancy = find_study("useful-redundancy").module("figures")
CASE_1, CASE_2 = useful_redundancy.CASE_1, useful_redundancy.CASE_2
COARSE = np.unique(np.concatenate([np.arange(0.0, 15.1, 0.5), np.linspace(7.4, 8.8, 8)]))


class Recorder:
    """Axes that record what is drawn, in place of matplotlib's."""

    def __init__(self):
        self.lines = {}

    def plot(self, x, y, *_, label=None, **__):
        self.lines.setdefault(label, []).append((np.array(x), np.array(y)))

    def __getattr__(self, name):
        return lambda *_, **__: None


def computed(case, noise, delays=COARSE, **options):
    estimator, data_set = useful_redundancy.published_search(case, noise)
    return landscape(replace(estimator, **options), data_set, delays, initial_delay=0.0)


@pytest.fixture(scope="session")
def quiet():
    return computed(CASE_1, noise=False)


@pytest.fixture(scope="session")
def switching():
    """Return one step on each path, so that the search has to change the filter."""
    return computed(CASE_2, True, np.array([0.0, 4.0, 7.9, 7.98, 8.0, 8.02, 8.1, 12.0, 15.0]), max_iterations=1)


@pytest.mark.parametrize("name", ["quiet", "switching"])
def test_legs_follow_the_search(name, request):
    result = request.getfixturevalue(name)
    trajectory = result.fit.search.trajectory
    assert [leg.delays[0] for leg in result.legs] == [visit.point for visit in trajectory[:-1]]
    assert [leg.delays[-1] for leg in result.legs] == [visit.point for visit in trajectory[1:]]
    assert [leg.costs[-1] for leg in result.legs] == [visit.cost for visit in trajectory[1:]]
    assert [leg.filter for leg in result.legs] == [visit.path for visit in trajectory[1:]]
    assert result.legs[0].delays[0] == 0.0
    assert result.legs[-1].delays[-1] == pytest.approx(8.0, abs=0.2)
    switched = [after.delays[0] for before, after in pairwise(result.legs) if after.filter != before.filter]
    assert [leg.delays[0] for leg in result.legs if leg.switched] == switched
    assert len(switched) == len(result.fit.switches)


def test_stars_are_drawn_where_the_search_switched(switching):
    from experiments.useful_redundancy import search_plot

    assert switching.fit.switches
    axes = Recorder()
    search_plot._draw_reference(axes, switching, 0.0, 15.0)
    ((x, y),) = axes.lines["switch"]
    arrivals = list(switching.fit.search.trajectory)
    before = [arrivals[arrivals.index(visit) - 1] for visit in switching.fit.switches]
    assert x.tolist() == [visit.point for visit in before]
    assert y.tolist() == [visit.cost for visit in before]
    ((x, y),) = axes.lines["end of the search"]
    assert (x[0], y[0]) == (switching.fit.search.point, switching.fit.search.cost)
    ((x, y),) = axes.lines["$J_0$, least over the coefficients"]
    assert np.array_equal(x, switching.delays)
    assert np.array_equal(y, switching.members.mean(axis=1))


def test_names_of_figures():
    assert [str(item.place) for item in find_figures(["2", "useful-redundancy/2", "useful-redundancy/1"])] == [
        "useful_redundancy_figures/figure_2.svg",
        "useful_redundancy_figures/figure_1.svg",
    ]
    assert find_figures([]) == find_figures(["useful-redundancy"])
    assert (
        [item.number for item in find_figures([])] == list("1234567") == list(find_study("useful-redundancy").figures)
    )


def test_labels_keep_their_distance_and_order():
    values = np.array([3.0, 0.0, 0.1, 0.2, 2.9, 10.0])
    places = spread(values, 1.0)
    assert (np.diff(np.sort(places)) >= 1.0 - 1e-12).all()
    assert np.array_equal(np.argsort(places), np.argsort(values))
    assert places.sum() == pytest.approx(values.sum())
    assert places[-1] == 10.0
    assert spread(places, 1.0) == pytest.approx(places)


def test_outline_of_a_long_curve_keeps_its_peaks_and_its_gaps():
    t = np.arange(1_000_000.0)
    values = np.sin(1e-4 * t)
    values[[300_001, 700_003]] = 5.0, -7.0
    values[400_000:500_000] = np.nan
    few, drawn = outline(t, values)
    assert few.size == 2 * STRIPES
    assert (np.diff(few) >= 0).all()
    assert np.array_equal(drawn, values[few.astype(int)], equal_nan=True)
    assert {(300_001.0, 5.0), (700_003.0, -7.0)} <= set(zip(few, drawn, strict=True))
    inside = (few > 405_000) & (few < 495_000)
    assert inside.any()
    assert np.isnan(drawn[inside]).all()
    assert not np.isnan(drawn[few < 395_000]).any()
    short = np.arange(4.0 * STRIPES)
    assert outline(short, short)[0] is short
