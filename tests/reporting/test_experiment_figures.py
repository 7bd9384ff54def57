"""Figures of experiments: points are the measures and estimates, bars their intervals."""

import numpy as np
import pytest

from ctid_cli.errors import UsageError
from ctid_cli.reporting.figures.experiment_plot import chosen_kind, experiment_drawing, kinds_of
from ctid_cli.reporting.figures.settings import placed
from ctid_cli.reporting.measures import measure_frame
from tests.reporting.ideal_results import TWO_MODES, ideal_results, plan_of


@pytest.fixture
def results(make_results, estimate):
    """Return results at two noise levels from two starts; from 0 s, half of the estimates end in another minimum."""
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
    """Return the values of every line with markers in drawing order; the ends of bars are markers too."""
    lines = [line for line in axes.lines if line.get_marker() not in ("None", "none", "_")]
    return [np.asarray(line.get_ydata(), float) for line in lines]


def bars(axes):
    """Return the ends of the vertical bars."""
    ends = [tuple(part[:, 1]) for lines in axes.collections for part in lines.get_segments() if np.ptp(part[:, 0]) == 0]
    return sorted(ends)


def drawn(results, *args, **options):
    return [axes for axes in experiment_drawing(results, *args, **options).figure().axes if axes.get_visible()]


def test_points_and_bars_are_the_measure_rows(results):
    rows = measure_frame(results, ["rmse"])
    *panels, stairs = drawn(results, measure="rmse")
    for axes in panels:
        name = axes.get_title(loc="left")
        own = rows[rows["parameter"] == name]
        (found,) = points(axes)
        assert found.tolist() == own["value"].tolist()
        assert np.array(bars(axes)) == pytest.approx(own.sort_values("low")[["low", "high"]].to_numpy())
    assert [label.get_text() for label in stairs.get_yticklabels()] == ["SNR [dB]", "initial delay [s]"]


def test_an_estimator_without_a_start_stands_under_every_start(results, estimate, add_estimator):
    add_estimator(results, "startless", {(snr, None): [estimate(8.0)] * 4 for snr in (5.0, 15.0)})
    settings, rows = placed(measure_frame(results, ["percent"]), results)
    assert settings.points == [(5.0, 0.0), (5.0, "random"), (15.0, 0.0), (15.0, "random")]
    own = rows[rows["method"] == "startless"]
    assert own[["place", "snr_db"]].to_numpy().tolist() == [[0, 5.0], [1, 5.0], [2, 15.0], [3, 15.0]]
    panel, _ = drawn(results, measure="percent")
    assert [values.tolist() for values in points(panel)] == [[50.0, 25.0, 50.0, 50.0], [100.0] * 4]


def test_a_single_number_is_its_own_axis(ideal):
    axes = drawn(ideal, measure="rmse:g1_a1")[0]
    assert axes.get_xscale() == "linear"
    assert axes.get_xlabel() == "samples"
    assert axes.get_ylabel() == "rmse [s]"
    line, other = (line for line in axes.lines if line.get_marker() in "os")
    assert np.mean([line.get_xdata(), other.get_xdata()], axis=0) == pytest.approx([1000.0, 4000.0])


def test_boxes_have_the_quantiles_of_the_errors(results):
    axes = drawn(results, "box", parameters=["delay"])[0]
    errors = np.array([0.0, -5.9, -6.0, -0.05])
    low, high = np.quantile(errors, [0.25, 0.75])
    assert any((bar.get_y(), bar.get_y() + bar.get_height()) == pytest.approx((low, high)) for bar in axes.patches)
    assert any(values == pytest.approx(np.median(errors)) for values in points(axes))


def test_divergent_errors_are_counted_at_the_edge_and_the_others_stay_readable(make_results, estimate):
    near = [estimate(delay) for delay in (8.1, 7.9, 8.05, 8.02)]
    far = [estimate(delay) for delay in (8.1, 9e3, 9e3, -9e3)]
    results = make_results({(5.0, "0.0"): near, (15.0, "0.0"): far})
    axes = drawn(results, "box", parameters=["delay"])[0]
    low, high = axes.get_ylim()
    assert -0.4 < low < -0.1
    assert 0.1 < high < 0.4
    assert [text.get_text() for text in axes.texts] == ["1", "2"]


@pytest.mark.parametrize(("style", "begins"), [("svg", b"<?xml"), ("png", b"\x89PNG"), ("pdf", b"%PDF")])
def test_formats_and_the_same_bytes_twice(results, style, begins):
    first = experiment_drawing(results, "box").saved(style)
    assert first.startswith(begins)
    assert experiment_drawing(results, "box").saved(style) == first


def test_what_an_experiment_has_decides_what_it_shows(results, make_results, estimate):
    assert kinds_of(results) == ["measure", "box"]
    alone = make_results({(5.0, "0.0"): [estimate(8.0)] * 4}, snrs=(5.0,), swept=False)
    assert chosen_kind(alone) == "box"
    assert chosen_kind(alone, measure="rmse") == "measure"
    with pytest.raises(UsageError, match="no stored estimates yet"):
        kinds_of(make_results({}))


def test_a_name_with_a_dollar_is_no_formula(results):
    for cell in results.manifest["data_cells"]:
        cell["content"]["system"] = {"kind": "own", "truth": {"cost $x": 1.0, "_{$": 2.0}}
    for key, value in results.stored.results.items():
        value["parameters"] = {"cost $x": 1.0 + key.replicate, "_{$": 2.0}
    for kind in ("measure", "box"):
        experiment_drawing(results, kind, "rmse" if kind == "measure" else None).saved()
