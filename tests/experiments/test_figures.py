"""Figures of the studies: what is drawn follows from the theory and from the search, and the same bytes come twice."""

from dataclasses import replace
from functools import cache
from itertools import pairwise
from xml.etree import ElementTree

import numpy as np
import pytest

from ctid_cli.errors import UsageError
from ctid_cli.filtering.filter_set import FilterSet, check_filters, extrema
from ctid_cli.reporting.figures.style import STRIPES, outline, ramp, spread
from ctid_cli.reporting.study import find_study
from ctid_cli.studies.catalogue import find_figures
from experiments.useful_redundancy.search_plot import landscape, trajectory_svg

useful_redundancy = find_study("useful-redundancy").module("figures")
CASE_1, CASE_2 = useful_redundancy.CASE_1, useful_redundancy.CASE_2
COARSE = np.unique(np.concatenate([np.arange(0.0, 15.1, 0.5), np.linspace(7.4, 8.8, 8)]))


def texts(svg):
    """What is written in a figure: matplotlib draws letters as shapes and keeps the text as a comment."""
    root = ElementTree.fromstring(svg, ElementTree.XMLParser(target=ElementTree.TreeBuilder(insert_comments=True)))
    assert root.tag == "{http://www.w3.org/2000/svg}svg"
    return " | ".join(node.text.strip() for node in root.iter() if node.tag is ElementTree.Comment)


class Recorder:
    """Axes in place of matplotlib's that keep what is drawn."""

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
    """One step on each path: the search has to change the filter."""
    return computed(CASE_2, True, np.array([0.0, 4.0, 7.9, 7.98, 8.0, 8.02, 8.1, 12.0, 15.0]), max_iterations=1)


@cache
def drawn(number):
    return getattr(useful_redundancy, f"figure_{number}")()


def test_figure_1_names_region_and_extrema():
    written = texts(drawn("1"))
    region = extrema(2 * np.pi, 1, exact=True)[0]
    for text in (f"{region:.4f}", "(37)", "(50)", "local maximum", "local minimum", "global minimum", "[s]", "unit"):
        assert text in written


def test_figure_2_names_filters_and_the_gap():
    written = texts(drawn("2"))
    ((low, high),) = check_filters(FilterSet(2 * np.pi, 6, 2.0).cutoffs, 15.0).gaps
    assert (f"{low:.2f}", f"{high:.2f}") == ("14.10", "14.25")
    assert f"gap, {low:.2f} to | {high:.2f} s: no filter" in written
    for k in range(1, 7):
        assert f"filter {k}: " in written
    assert "minimum path from 14 s" in written


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


def test_trajectory_names_filters_and_outcome(switching, quiet):
    svg = trajectory_svg(switching, "Some title", (7.9, 8.1))
    assert svg == trajectory_svg(switching, "Some title", (7.9, 8.1))
    written = texts(svg)
    assert "Some title" in written
    for leg in switching.legs:
        assert f"filter {leg.filter + 1}, {switching.cutoffs[leg.filter]:.3g} rad/s" in written
    assert "switch" in written
    assert "end of a path not taken" in written
    written = texts(trajectory_svg(quiet, "Some title", (7.4, 9.0)))
    assert f"ends at {quiet.fit.search.point:.4f} s; refined on unfiltered data: 8.0000 s" in written


@pytest.mark.parametrize(
    ("case", "poles", "zeros", "bandwidth", "filters", "svf_cutoff"),
    [(CASE_1, 2, 0, 2.02, 10, 1.0), (CASE_2, 4, 1, 26.85, 15, 25.0)],
)
def test_settings_are_the_published_ones(case, poles, zeros, bandwidth, filters, svf_cutoff):
    estimator, data_set = useful_redundancy.published_search(case, True)
    assert (estimator.poles, estimator.zeros, estimator.bandwidth) == (poles, zeros, bandwidth)
    assert (estimator.filters, estimator.beta, estimator.order) == (filters, 10, 10)
    assert (estimator.svf_cutoff, tuple(estimator.delay_bounds)) == (svf_cutoff, (0, 15))
    assert data_set.true_model.delay == 8.0
    noise = data_set.record.y - data_set.record.noise_free
    assert 10 * np.log10(np.var(data_set.record.noise_free) / np.var(noise)) == pytest.approx(15.0, abs=0.5)
    quiet = useful_redundancy.published_search(case, False)[1]
    assert np.array_equal(quiet.record.y, data_set.record.noise_free)


def test_names_of_figures():
    assert [str(item.place) for item in find_figures(["2", "useful-redundancy/2", "useful-redundancy/1"])] == [
        "useful_redundancy_figures/figure_2.svg",
        "useful_redundancy_figures/figure_1.svg",
    ]
    assert find_figures([]) == find_figures(["useful-redundancy"])
    assert (
        [item.number for item in find_figures([])] == list("1234567") == list(find_study("useful-redundancy").figures)
    )


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("9", r"useful-redundancy has no figure 9; it has 1, 2, 3, 4, 5, 6, 7$"),
        ("useful-redundancy/0", r"useful-redundancy has no figure 0; it has"),
        ("useful-redundency/2", r"did you mean 'useful-redundancy/2'\? Known: 1, 2"),
        ("additive/9", r"additive has no figure 9; it has 2, 3, 4, 6$"),
        ("nonsense", r"'nonsense' is neither a figure nor a study with figures\. Known: 1, "),
    ],
)
def test_unknown_names_are_refused(name, message):
    with pytest.raises(UsageError, match=message):
        find_figures(["1", name])


def test_labels_keep_their_distance_and_order():
    values = np.array([3.0, 0.0, 0.1, 0.2, 2.9, 10.0])
    places = spread(values, 1.0)
    assert (np.diff(np.sort(places)) >= 1.0 - 1e-12).all()
    assert np.array_equal(np.argsort(places), np.argsort(values))
    assert places.sum() == pytest.approx(values.sum())
    assert places[-1] == 10.0
    assert spread(places, 1.0) == pytest.approx(places)


def test_curves_grow_darker():
    lightness = [sum(line["color"]) for line in ramp(10)]
    assert lightness == sorted(lightness, reverse=True)
    assert all(a["linestyle"] != b["linestyle"] for a, b in pairwise(ramp(10)))
    assert len(ramp(1)) == 1


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
