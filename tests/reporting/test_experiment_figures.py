"""Figures of any experiment: their points are the measures and the estimates, and their intervals are drawn."""

import numpy as np
import pytest

from ctid_cli.errors import UsageError
from ctid_cli.reporting.accuracy_report import accuracy_object
from ctid_cli.reporting.figures.estimate_plot import basins
from ctid_cli.reporting.figures.experiment_plot import chosen_kind, experiment_drawing, kinds_of
from ctid_cli.reporting.figures.settings import settings_in
from ctid_cli.reporting.measures import measure_rows
from ctid_cli.running.plan import build_plan
from ctid_cli.specification.load import spec_from_canonical
from tests.reporting.ideal_results import TWO_MODES, ideal_results, plan_of


@pytest.fixture
def results(make_results, estimate):
    """Two noise levels and two starts; from 0 s, half of the estimates end in another minimum."""
    right = [estimate(delay) for delay in (8.1, 7.9, 8.05, 8.02)]
    wrong = [estimate(delay) for delay in (8.0, 2.1, 2.0, 7.95)]
    failed = [*right[:3], estimate(None, status="FAILED")]
    return make_results(
        {(5.0, "0.0"): wrong, (15.0, "0.0"): right, (5.0, "uniform(0, 9)"): failed, (15.0, "uniform(0, 9)"): right}
    )


@pytest.fixture(scope="module")
def ideal(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ideal")
    return ideal_results(plan_of(TWO_MODES.replace("runs: 40", "runs: 400"), folder), folder)


def points(axes):
    """Values of every line with markers, in the order of drawing; the ends of bars are markers too."""
    lines = [line for line in axes.lines if line.get_marker() not in ("None", "none", "_")]
    return [np.asarray(line.get_ydata(), float) for line in lines]


def bars(axes):
    """Ends of the vertical bars."""
    ends = [tuple(part[:, 1]) for lines in axes.collections for part in lines.get_segments() if np.ptp(part[:, 0]) == 0]
    return sorted(ends)


def drawn(results, *args, **options):
    return [axes for axes in experiment_drawing(results, *args, **options).figure().axes if axes.get_visible()]


def test_points_and_bars_are_the_measure_rows(results):
    rows = [row for row in measure_rows(results, ["rmse"]) if row["n"]]
    *panels, stairs = drawn(results, measure="rmse")
    for axes in panels:
        name = axes.get_title(loc="left")
        own = [row for row in rows if row["parameter"] == name]
        (found,) = points(axes)
        assert found.tolist() == [row["value"] for row in own]
        assert np.array(bars(axes)) == pytest.approx(np.array(sorted((row["low"], row["high"]) for row in own)))
    assert [label.get_text() for label in stairs.get_yticklabels()] == ["SNR [dB]", "initial delay [s]"]


def test_an_estimator_without_a_start_stands_under_every_start(results, estimate, add_estimator):
    add_estimator(results, "startless", {(snr, None): [estimate(8.0)] * 4 for snr in (5.0, 15.0)})
    rows = measure_rows(results, ["percent"])
    settings = settings_in(rows, results)
    assert settings.points == [(5.0, 0.0), (5.0, "random"), (15.0, 0.0), (15.0, "random")]
    own = [row for row in rows if row["method"] == "startless"]
    assert [settings.row_at(point, own) for point in settings.points] == [own[0], own[0], own[1], own[1]]
    panel, _ = drawn(results, measure="percent")
    assert [values.tolist() for values in points(panel)] == [[50.0, 25.0, 50.0, 50.0], [100.0] * 4]


def test_a_single_number_is_its_own_axis(ideal):
    axes = drawn(ideal, measure="rmse:g1_a1")[0]
    assert axes.get_xscale() == "linear"
    assert axes.get_xlabel() == "samples"
    assert axes.get_ylabel() == "rmse [s]"
    line, other = (line for line in axes.lines if line.get_marker() in "os")
    assert np.mean([line.get_xdata(), other.get_xdata()], axis=0) == pytest.approx([1000.0, 4000.0])


def test_ellipses_are_those_of_check_accuracy(ideal):
    """Their extent is that of ``ctid check accuracy``, and 95 % of a normal cloud lies within."""
    content = accuracy_object(build_plan(spec_from_canonical(ideal.settings)))
    reach = np.sqrt(-2 * np.log(0.05))
    for axes in drawn(ideal, "errors", parameters=["g1_a1", "g2_b0"]):
        samples = int(axes.get_title(loc="left").split()[-1])
        clouds = [line.get_xydata() for line in axes.lines if line.get_linestyle() == "None"]
        assert [len(cloud) for cloud in clouds] == [400, 400]
        curves = [line.get_xydata() for line in axes.lines if len(line.get_xydata()) == 100]
        for method, curve in zip(("additive", "srivc"), curves, strict=True):
            (entry,) = (e for e in content["estimates"] if (e["estimator"], e["samples"]) == (method, samples))
            errors = {row["name"]: row["standard_error"] for row in entry["parameters"]}
            extent = np.abs(curve).max(axis=0)
            assert extent == pytest.approx([reach * errors[name] for name in ("g1_a1", "g2_b0")], rel=2e-3)


def test_delays_are_counted_by_basin(results):
    assert basins(np.array([0, 3, 1, 0, 0, 2, 0, 0, 0, 0, 5])) == [(1, 6), (10, 11)]
    assert basins(np.zeros(5)) == []
    panels = drawn(results, "delays")
    assert len(panels) == 4
    heights = [sum(bar.get_height() for bar in axes.patches) for axes in panels]
    assert sorted(heights) == pytest.approx([75.0, 100.0, 100.0, 100.0])  # a failed estimate is no delay
    said = next(text.get_text() for axes in panels for text in axes.texts if "50 %" in text.get_text())
    assert "2.05 s: 50 % [15, 85]" in said


def test_boxes_have_the_quantiles_of_the_errors(results):
    axes = drawn(results, "box", parameters=["delay"])[0]
    errors = np.array([0.0, -5.9, -6.0, -0.05])
    low, high = np.quantile(errors, [0.25, 0.75])
    assert any((bar.get_y(), bar.get_y() + bar.get_height()) == pytest.approx((low, high)) for bar in axes.patches)
    assert any(values == pytest.approx(np.median(errors)) for values in points(axes))


def test_convergence_ends_at_the_measure_itself(ideal):
    rows = {(r["samples"], r["method"]): r for r in measure_rows(ideal, ["rmse:g1_a1"])}
    panels = drawn(ideal, "convergence", measure="rmse:g1_a1")
    for axes, samples in zip(panels, (1000, 4000), strict=True):
        ends = [values[-1] for values in points(axes)]
        assert ends == [rows[samples, method]["value"] for method in ("additive", "srivc")]
        assert [line.get_xdata()[-1] for line in axes.lines] == [400.0, 400.0]


@pytest.mark.parametrize(("style", "begins"), [("svg", b"<?xml"), ("png", b"\x89PNG"), ("pdf", b"%PDF")])
def test_formats_and_the_same_bytes_twice(results, style, begins):
    first = experiment_drawing(results, "box").saved(style)
    assert first.startswith(begins)
    assert experiment_drawing(results, "box").saved(style) == first


def test_what_an_experiment_has_decides_what_it_shows(results, make_results, estimate):
    assert kinds_of(results) == ["measure", "box", "errors", "delays", "convergence"]
    alone = make_results({(5.0, "0.0"): [estimate(8.0)] * 4}, snrs=(5.0,), swept=False)
    assert chosen_kind(alone) == "box"
    assert chosen_kind(alone, measure="rmse") == "measure"
    with pytest.raises(UsageError, match="no stored estimates yet"):
        kinds_of(make_results({}))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("boxes",), r"no kind of figure 'boxes'; did you mean 'box'\? there are measure"),
        (("box", "rmse"), "--measure goes with --kind measure and convergence, not box"),
        (("measure", "rmse", ["a1"]), "for one parameter: --measure rmse:a1"),
        (("errors", None, ["a1", "a9"]), "no estimator has the parameter 'a9'; there are a1, a2, b0, delay"),
        (("errors", None, ["a1"]), "clouds need two estimated parameters"),
    ],
)
def test_what_cannot_be_drawn_is_refused_in_a_sentence(results, arguments, message):
    with pytest.raises(UsageError, match=message):
        experiment_drawing(results, *arguments)


def test_a_name_with_a_dollar_is_no_formula(results):
    for cell in results.manifest["data_cells"]:
        cell["content"]["system"] = {"kind": "own", "truth": {"cost $x": 1.0, "_{$": 2.0}}
    for key, value in results.stored.results.items():
        value["parameters"] = {"cost $x": 1.0 + key.replicate, "_{$": 2.0}
    for kind in ("measure", "box", "errors"):
        experiment_drawing(results, kind, "rmse" if kind == "measure" else None).saved()
