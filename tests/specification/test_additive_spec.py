"""Specifications of sums of submodels and of loops: valid ones, and messages about invalid ones."""

import pytest

from ctid_cli.models.additive import AdditiveModel, Term
from ctid_cli.running.plan import build_plan
from ctid_cli.specification.sections import geometric_sizes
from tests.specification.written import CLOSED_LOOP as CLOSED
from tests.specification.written import load


def test_it_is_accepted(tmp_path):
    plan = build_plan(load(tmp_path, CLOSED))
    (cell,) = plan.data_cells
    assert isinstance(cell.source.system, AdditiveModel)
    assert cell.source.excitation is None
    assert cell.source.loop.controller.denominator.tolist() == [1.0, -1.0, 0.0]
    assert cell.source.loop.enters == "controller"
    assert plan.estimators[0].estimator.terms == (Term(2, 0), Term(2, 0))
    assert plan.estimators[0].estimator.instruments == "closed_loop"
    assert [start.label for start in plan.starts] == ["parameters(5%)"]
    assert plan.terms == (Term(2, 0), Term(2, 0))


def test_what_can_be_swept(tmp_path):
    spec = load(
        tmp_path, CLOSED, "sampling.samples={geometric: [500, 2000, 3]}", "loop.controller.pid.kp=[0.01, 0.0115]",
        "loop.enters=[controller, input]", "loop.reference.standard_deviation=[1, 2]", "noise.variance=[0.01, 0.02]",
        "estimators.one.instruments=[open_loop, closed_loop]",
    )  # fmt: skip
    plan = build_plan(spec)
    assert spec.canonical()["sampling"]["samples"] == geometric_sizes(500, 2000, 3) == [500, 1000, 2000]
    assert len(plan.data_cells) == 3 * 2 * 2 * 2 * 2
    assert plan.data_cells[0].swept == {
        "kp": 0.01, "standard_deviation": 1.0, "enters": "controller", "samples": 500, "variance": 0.01,
    }  # fmt: skip
    last = plan.data_cells[-1].source
    assert last.loop.controller.numerator[0] == pytest.approx(0.0115 + 0.00725 + 0.00454)
    assert (last.loop.enters, last.loop.reference.standard_deviation, last.sampling.samples) == ("input", 2.0, 2000)
    assert [cell.swept for cell in plan.estimators[1:]] == [
        {"instruments": "open_loop"}, {"instruments": "closed_loop"}
    ]  # fmt: skip


def test_fractions_are_factored_like_the_sorted_system(tmp_path):
    system = "system.additive=[{numerator: [1], denominator: [0.1, 1]}, {numerator: [3], denominator: [0.2, 0.3, 1]}]"
    rest = ["loop=null", "excitation={kind: gaussian}", "starts=null"]
    one = "estimators={one: {kind: srivc, poles: 3, zeros: 2}}"
    assert build_plan(load(tmp_path, CLOSED, system, one, *rest)).terms == (Term(2, 0), Term(1, 0))
    # No submodels were requested.
    fraction = "system={numerator: [1], denominator: [1, 2, 3]}"
    two = "estimators={one: {kind: srivc, poles: 2, zeros: 0}}"
    assert build_plan(load(tmp_path, CLOSED, fraction, two, *rest, "success=null")).terms is None


def test_starts_and_estimators_of_both_kinds(tmp_path):
    overrides = [
        "starts.initial_delay=[0.1, {uniform: [0, 0.2]}]",
        "estimators.search={kind: td_srivc, poles: 4, zeros: 2, delay_bounds: [0, 0.5]}",
        "estimators.filter={kind: svf, poles: 4, zeros: 2}",
        "starts.parameters=[{relative_uniform: 0.05}, {relative_uniform: 0.2}]",
    ]
    plan = build_plan(load(tmp_path, CLOSED, *overrides))
    labels = {}
    for _, cell, start in plan.keys(0, 0):
        labels.setdefault(cell.name, []).append(start.label)
    assert labels == {
        "both": ["parameters(5%)", "parameters(20%)"],
        "one": ["parameters(5%)", "parameters(20%)"],
        "search": ["0.1", "uniform(0, 0.2)"],
        "filter": ["none"],
    }
    # An estimator that accepts parameters computes its own if none are given, and needs no delay.
    plan = build_plan(load(tmp_path, CLOSED, "starts={initial_delay: 0.1}", *overrides[1:2]))
    assert [(cell.name, start.label) for _, cell, start in plan.keys(0, 0)] == [
        ("both", "none"), ("one", "none"), ("search", "0.1"),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("first", "last", "count", "unrounded", "rounded"),
    [(2000, 100_000, 30, 778_580, 778_581), (500, 123_036, 50, 1_153_484, 1_153_482)],
)
def test_sizes_of_the_published_studies_of_additive_models(first, last, count, unrounded, rounded):
    # The totals printed by González, Classens, Rojas, Welsh and Oomen are those of the sizes before rounding.
    exact = [first * (last / first) ** (k / (count - 1)) for k in range(count)]
    assert round(sum(exact)) == unrounded
    assert sum(geometric_sizes(first, last, count)) == rounded
