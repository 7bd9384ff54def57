"""Figures of the study of additive models: they show the computed and found values."""

from pathlib import Path

import numpy as np
import pytest

from ctid_cli.errors import UsageError
from ctid_cli.filtering.simulate import simulate
from ctid_cli.models.factoring import unfactored
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.reporting.study import find_study
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record
from ctid_cli.studies.catalogue import find_figures, require_results
from experiments.additive.measures import errors_of
from tests.reporting.ideal_results import TWO_MODES, ideal_results, plan_of

STUDY = find_study("additive")
additive = STUDY.module("figures")
METHODS = {"additive": "the sum", "srivc": "the fraction"}
NAMES = ["g1_a1", "g1_a2", "g1_b0", "g2_a1", "g2_a2", "g2_b0"]


@pytest.fixture
def errors(tmp_path):
    results = ideal_results(plan_of(TWO_MODES, tmp_path), tmp_path, bias={"srivc": {"g2_b0": 5.0}})
    return errors_of(results)


def content(axes):
    return [(line.get_xdata(), line.get_ydata()) for line in axes.lines]


def test_figure_2_is_the_sum_of_its_submodels(drawn):
    additive.figure_2()
    above, below = drawn[0].axes
    frequencies, magnitude = content(above)[-1]
    system = STUDY.plan("open-loop").data_cells[0].source.system
    response = unfactored(system).frequency_response(frequencies)
    assert magnitude == pytest.approx(20 * np.log10(np.abs(response)), abs=1e-6)
    (_, phase), *others = content(below)
    assert not others
    assert phase == pytest.approx(np.rad2deg(np.unwrap(np.angle(response))), abs=1e-6)
    # Static gains in dB, and resonances at the printed poles.
    assert [values[0] for _, values in content(above)] == pytest.approx(
        20 * np.log10([3, 0.4, 0.2, 0.05, 3.65]), abs=0.15
    )
    peaks = frequencies[1:-1][(np.diff(magnitude)[:-1] > 0) & (np.diff(magnitude)[1:] < 0)]
    assert peaks == pytest.approx([1.39, 3.16, 5.77, 9.99], rel=0.04)


def test_figure_6_says_that_it_is_simulated_and_ends_at_the_truth(drawn):
    additive.figure_6()
    assert "SIMULATED" in drawn[0].get_suptitle()
    assert "CONVERGED" in drawn[0].get_suptitle()
    measured, start, true, estimate = content(drawn[0].axes[0])
    grid = np.linspace(1, 400, 500)
    on_grid = [np.interp(grid, *curve) for curve in (start, true, estimate)]
    assert np.median(np.abs(on_grid[2] - on_grid[1])) < 0.01
    assert np.abs(on_grid[0] - on_grid[1]).max() > 20
    assert measured[0] == pytest.approx(0.5 * np.arange(1, 1001))
    assert np.median(np.abs(measured[1] - np.interp(measured[0], *true))) < 0.5


def test_a_response_without_a_model_knows_the_hold():
    rng = np.random.default_rng(1)
    h, count = 0.01, 20000
    t = h * np.arange(count)
    system = TransferFunction([30.0], [1.0, 8.0, 30.0])
    u = HeldSignal(t, rng.standard_normal(count))
    record = Record(t, simulate(system, u, t), u)
    frequencies, response = additive.empirical_response(record, 0.5, 60.0)
    assert np.diff(frequencies) == pytest.approx(2 * np.pi / (count * h))
    assert frequencies[0] >= 0.5
    assert frequencies[-1] <= 60.0
    # The hold's delay of half an interval is 0.3 rad at the upper end. The remaining errors are images beyond half the
    # sampling frequency, and the response to the input before the window.
    error = np.abs(response - system.frequency_response(frequencies)) / np.abs(system.frequency_response(frequencies))
    assert np.median(error) < 0.01
    assert np.quantile(error, 0.9) < 0.05


@pytest.mark.parametrize("parameters", [NAMES, NAMES[2:3]])
def test_errors_are_drawn_with_their_theory(drawn, errors, parameters):
    additive.mse_svg(errors, METHODS, parameters, 2, "Some title")
    panels = [axes for axes in drawn[0].axes if axes.get_visible()]
    assert [axes.get_title(loc="left") for axes in panels] == [additive.symbol(name) for name in parameters]
    assert drawn[0].get_suptitle() == "Some title (40 data sets a point)"
    for axes, parameter in zip(panels, parameters, strict=True):
        assert (axes.get_xscale(), axes.get_yscale()) == ("log", "log")
        curves = content(axes)
        for method, (theory, points) in zip(METHODS, zip(curves[::2], curves[1::2], strict=True), strict=True):
            own = errors[(errors["estimator"] == method) & (errors["parameter"] == parameter)]
            assert points[0].tolist() == theory[0].tolist() == [1000, 4000]
            assert points[1].tolist() == own["mse"].tolist()
            assert theory[1] == pytest.approx((own["theory"] / own["samples"]).tolist())
    wrong = errors[errors["estimator"] == "srivc"].assign(not_converged=2, failed=1, valueless=1)
    assert additive.labelled("the fraction", wrong) == "the fraction (6 of 80 not converged, 2 without a value)"


@pytest.mark.parametrize(("number", "panels"), [("3", 4), ("4", 6)])
def test_figures_of_results_draw_every_estimator_of_their_experiments(number, panels, drawn, tmp_path):
    (short,) = STUDY.figures[number]
    plan = STUDY.plan(short, ["monte_carlo.runs=4"])
    assert set(additive.OPEN_LOOP if number == "3" else additive.CLOSED_LOOP) == {part.name for part in plan.estimators}
    getattr(additive, f"figure_{number}")(ideal_results(plan, tmp_path))
    assert [bool(axes.lines) for axes in drawn[0].axes] == [True] * panels


def test_results_that_are_missing_are_named_before_anything_is_drawn(tmp_path, monkeypatch):
    figures = find_figures(["additive"])
    assert [figure.number for figure in figures] == ["2", "3", "4", "6"]
    assert str(figures[-1].place) == "additive_figures/figure_6.svg"
    out = tmp_path / "my results"
    command = f"run first: ctid run configs/additive/open_loop.yaml configs/additive/closed_loop.yaml --out '{out}'"
    with pytest.raises(UsageError) as refused:
        require_results(figures, out)
    assert str(refused.value).endswith(command)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UsageError, match=r"run first: ctid run configs/additive/open_loop\.yaml$"):
        figures[1].svg(Path("results"))
    require_results([figures[0], figures[3], *find_figures(["2"])], out)
