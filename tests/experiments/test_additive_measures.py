"""Errors of parameters: every number against another route, and who counts and who does not."""

import numpy as np
import pytest

from ctid_cli.errors import UsageError
from ctid_cli.inference.bounds import limiting_accuracy
from ctid_cli.inference.monte_carlo import wilson_interval
from ctid_cli.models.factoring import unfactored
from ctid_cli.reporting.expected_accuracy import long_record_variances
from ctid_cli.reporting.study import data_folder
from ctid_cli.running.plan import build_plan
from ctid_cli.specification.load import load_spec
from experiments.additive.measures import errors_of, estimates_of, mse_ratio
from tests.reporting.ideal_results import TWO_MODES, estimate, ideal_results, plan_of, results_of

NAMES = ("g1_a1", "g1_a2", "g1_b0", "g2_a1", "g2_a2", "g2_b0")
TRUTH = np.array([0.25, 0.25, 3.0, 0.01, 0.025, 1.0])


@pytest.fixture
def plan(tmp_path):
    return plan_of(TWO_MODES, tmp_path)


def named(values):
    return dict(zip(NAMES, map(float, values), strict=True))


def published(name):
    return build_plan(load_spec(data_folder("configs") / "additive" / f"{name}.yaml"))


def variances_of(plan, cell=0):
    found = long_record_variances(plan)
    of_cell = {part.name: found.get((cell, k)) for k, part in enumerate(plan.estimators)}
    return {name: variances for name, variances in of_cell.items() if variances is not None}


def test_mean_square_bias_and_scatter(plan, tmp_path):
    results = ideal_results(plan, tmp_path, bias={"srivc": {"g2_a2": 3.0}})
    rows = {(r.estimator, r.samples, r.parameter): r for r in errors_of(results)}
    assert len(rows) == 2 * 2 * 6
    for (estimator, samples, parameter), row in rows.items():
        found = [
            stored["parameters"][parameter]
            for stored in results.rows
            if (stored["estimator"], stored["samples"]) == (estimator, samples)
        ]
        assert (row.runs, row.counted) == (40, len(found))
        bias, deviation = np.mean(found) - row.true, np.std(found, ddof=1)
        assert row.mse == pytest.approx(bias**2 + deviation**2 * 39 / 40)
        assert row.n_mse == samples * row.mse
        assert row.ratio == row.n_mse / row.theory
        assert (row.bias, row.deviation) == pytest.approx((bias, deviation))
        assert row.bias_per_deviation == pytest.approx(bias / deviation)
        assert row.bias_per_error == pytest.approx(bias / deviation * np.sqrt(40))
        assert row.error_ratio == pytest.approx(np.sqrt(row.theory / samples) / deviation)
        biased = (estimator, parameter) == ("srivc", "g2_a2")
        assert abs(row.bias_per_error) > 10 if biased else abs(row.bias_per_error) < 4
        # Squares of normal errors scatter by the square root of 2 over the number of data sets.
        assert biased or row.ratio == pytest.approx(1.0, abs=4 * np.sqrt(2 / 40))
        squares = (np.array(found) - row.true) ** 2
        assert row.ratio_error == pytest.approx(row.ratio * np.std(squares, ddof=1) / np.mean(squares) / np.sqrt(40))


def test_who_counts_and_who_does_not(plan, tmp_path):
    good, far = named(TRUTH + 0.01), named(TRUTH + 1.0)
    partial = {name: value for name, value in good.items() if not name.startswith("g2")}
    found = [
        estimate(good),
        estimate(far, status="MAX_ITERATIONS"),
        estimate(None, status="FAILED"),
        estimate(None),  # a fraction that is no sum of such submodels
        estimate(partial, status="MAX_ITERATIONS"),
        estimate(good | {"g1_a1": None}),
        estimate(good),
    ]
    results = results_of(plan, {("additive", 4000): found}, tmp_path)
    groups = estimates_of(results)
    assert len(groups) == 1
    assert (groups[0].runs, groups[0].failed, groups[0].not_converged) == (7, 1, 2)
    for row in errors_of(results):
        assert (row.runs, row.failed, row.not_converged, row.counted) == (7, 1, 2, 3)
        assert row.mse == pytest.approx((2 * 0.01**2 + 1.0) / 3)
        assert (row.with_error, row.covered, row.coverage, row.error_ratio) == (0, 0, None, None)


def test_coverage_counts_intervals_and_what_has_none_is_not_covered(plan, tmp_path):
    width = named(np.full(6, 0.1))
    found = [
        estimate(named(TRUTH + 0.19599), width),
        estimate(named(TRUTH - 0.19599), width),
        estimate(named(TRUTH + 0.19601), width),
        estimate(named(TRUTH), dict.fromkeys(NAMES)),
    ]
    for row in errors_of(results_of(plan, {("additive", 1000): found}, tmp_path)):
        assert (row.counted, row.with_error, row.covered, row.coverage) == (4, 3, 2, 50.0)
        assert (row.low, row.high) == pytest.approx([100 * end for end in wilson_interval(2, 4)])


def test_a_ratio_is_that_of_pairs(plan, tmp_path):
    results = ideal_results(plan, tmp_path)
    stored = results.stored.results
    # A data set on which one of the two has no value is left out for both.
    lost = next(key for key in stored if key.replicate == 3 and key.estimator_hash == plan.estimators[1].hash)
    stored[lost] = estimate(None, status="FAILED")
    # One that lacks a parameter has no value at all: every parameter counts the same data sets.
    partial = next(key for key in stored if key.replicate == 5 and key.estimator_hash == plan.estimators[0].hash)
    stored[partial] = estimate(stored[partial]["parameters"] | {"g1_a1": None})
    groups = {(g.estimator, g.samples): g for g in estimates_of(results)}
    one, other = groups["srivc", 1000], groups["additive", 1000]
    ratio, pairs = mse_ratio([one], [other], "g2_b0")
    kept = [k for k in range(40) if k not in (3, 5)]
    squares = np.array([(g.values[kept, 5] - 1.0) ** 2 for g in (one, other)])
    assert pairs == 38
    assert ratio.value == pytest.approx(squares[0].sum() / squares[1].sum())
    without = [np.delete(squares, k, axis=1) for k in range(38)]
    ratios = np.array([left[0].sum() / left[1].sum() for left in without])
    assert ratio.error == pytest.approx(np.sqrt(37 * np.var(ratios)))
    back, _ = mse_ratio([other], [one], "g2_b0")
    assert back.value == pytest.approx(1 / ratio.value)
    assert mse_ratio([one], [one], "g2_b0")[0].error == pytest.approx(0.0, abs=1e-12)


def test_several_lengths_are_one_trial_of_each_data_set(plan, tmp_path):
    results = ideal_results(plan, tmp_path)
    del results.stored.results[next(key for key in results.stored.results if key.replicate == 0)]
    groups = {(g.estimator, g.samples): g for g in estimates_of(results)}
    assert sorted(group.runs for group in groups.values()) == [39, 40, 40, 40]
    one, other = ([groups[name, n] for n in (1000, 4000)] for name in ("srivc", "additive"))
    ratio, pairs = mse_ratio(one, other, "g1_a2")
    # Without the data set that one of them lacks at one of the lengths.
    sums = [sum(g.samples * (g.values[-39:, 1] - 0.25) ** 2 for g in side) for side in (one, other)]
    assert ratio.value == pytest.approx(sums[0].sum() / sums[1].sum())
    assert pairs == 39
    # The same record twice is no more than once.
    twice, _ = mse_ratio(one[:1] * 2, other[:1] * 2, "g1_a2")
    assert twice.error == pytest.approx(mse_ratio(one[:1], other[:1], "g1_a2")[0].error)


def test_the_jackknife_knows_how_far_a_ratio_scatters(tmp_path):
    plan = plan_of(TWO_MODES.replace("samples: [1000, 4000]", "samples: 1000"), tmp_path)
    ratios = []
    for seed in range(60):
        groups = estimates_of(ideal_results(plan, tmp_path, seed=seed))
        ratios.append(mse_ratio([groups[1]], [groups[0]], "g1_a2")[0])
    scatter = np.std([ratio.value for ratio in ratios], ddof=1)
    assert np.mean([ratio.error for ratio in ratios]) == pytest.approx(scatter, rel=0.3)


def test_ratios_that_make_no_sense_are_refused(plan, tmp_path):
    groups = estimates_of(ideal_results(plan, tmp_path))
    with pytest.raises(ValueError, match="same numbers of samples"):
        mse_ratio(groups[:1], groups[3:], "g1_a1")
    with pytest.raises(ValueError, match="same numbers of samples"):
        mse_ratio([], [], "g1_a1")
    with pytest.raises(UsageError, match=r"no parameter 'g3_a1'; it has g1_a1, "):
        mse_ratio(groups[:1], groups[2:3], "g3_a1")
    one = estimates_of(results_of(plan, {("additive", 1000): [estimate(named(TRUTH))]}, tmp_path))
    with pytest.raises(UsageError, match="additive and additive have 1 estimates on the same data sets, too few"):
        mse_ratio(one, one, "g1_a1")


def test_theory_is_that_of_each_estimators_own_form(plan):
    found = variances_of(plan)
    system = plan.data_cells[0].source.system.sorted()
    options = {
        "standard_deviation": 1.0,
        "innovation_variance": 0.02,
        "noise_filter": ([1.0], [1.0, -0.5]),
        "samples": 10**6,
    }
    additive = limiting_accuracy(system, 0.05, **options)
    assert [found["additive"][name] for name in additive.names] == pytest.approx(
        1e6 * additive.standard_errors**2, rel=1e-9
    )
    srivc = limiting_accuracy(unfactored(system), 0.05, zeros=2, **options).factored()
    assert [found["srivc"][name] for name in srivc.names] == pytest.approx(1e6 * srivc.standard_errors**2, rel=1e-6)
    assert variances_of(plan, cell=1) == found


def test_theory_of_the_published_experiments():
    gains = [f"g{k}_b0" for k in range(1, 5)]
    found = variances_of(published("open_loop"))
    assert [found["additive"][name] for name in gains] == pytest.approx([35.60, 2.700, 0.4405, 0.2240], rel=3e-4)
    assert [found["srivc"][name] for name in gains] == pytest.approx([36.75, 3.645, 0.5341, 0.2322], rel=3e-4)
    found = variances_of(published("closed_loop"))
    assert [found["additive"][name] for name in NAMES] == pytest.approx(
        [0.20003, 0.035010, 14.287, 1.28798e-3, 1.52180e-5, 6.7705], rel=1e-4
    )
    assert [found["clsrivc"][name] for name in NAMES] == pytest.approx(
        [0.22218, 0.090118, 14.683, 1.37704e-3, 2.49911e-5, 8.0467], rel=1e-4
    )
    # White noise that is fed back is a second reference: 0.01 on top of 1.
    assert [found["srivc"][name] for name in NAMES] == pytest.approx(
        [found["clsrivc"][name] / 1.01 for name in NAMES], rel=1e-9
    )


def test_there_is_no_theory_for_biased_estimates_or_other_structures(tmp_path):
    assert set(variances_of(published("closed_loop_coloured"))) == {"clsrivc", "additive"}
    assert variances_of(published("flexible_beam")) == {}
    for change in (("zeros: 2}", "zeros: 1}"), ("poles: 4,", "poles: 5,"), ("zeros: 2}", "zeros: 2, delay: 0.1}")):
        text = TWO_MODES.replace(*change).replace("starts:", "# ")
        assert set(variances_of(plan_of(text, tmp_path))) == {"additive"}
