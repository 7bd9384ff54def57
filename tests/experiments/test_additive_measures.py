"""Errors of parameters: every number by a second method, and the counted estimates."""

import numpy as np
import pandas as pd
import pytest

from ctid_cli.errors import UsageError
from ctid_cli.reporting.results import Results
from ctid_cli.reporting.study import data_folder
from ctid_cli.running.plan import build_plan
from ctid_cli.running.theory import long_record_variances
from ctid_cli.specification.load import load_spec
from experiments.additive.measures import errors_of, mse_ratio
from tests.reporting.ideal_results import TWO_MODES, estimate, ideal_results, plan_of, results_of
from tests.storage.made_results import MadeResults

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


def test_errors_are_measured_beside_theory(plan, tmp_path):
    results = ideal_results(plan, tmp_path, bias={"srivc": {"g2_a2": 3.0}})
    errors = errors_of(results)
    assert list(errors.groupby(["estimator", "samples"], sort=False).size().index) == [
        *(("additive", 1000), ("additive", 4000), ("srivc", 1000), ("srivc", 4000))
    ]
    values = results.errors.groupby(["group", "parameter"], sort=False)["value"]
    places = pd.MultiIndex.from_frame(errors[["group", "parameter"]])
    assert (errors["counted"] == 40).all()
    squares = values.apply(lambda e: np.mean(e**2))[places].to_numpy()
    np.testing.assert_allclose(errors["n_mse"], errors["samples"] * squares)
    np.testing.assert_allclose(errors["ratio"], errors["n_mse"] / errors["theory"])
    per_deviation = (values.mean() / values.std())[places].to_numpy()
    np.testing.assert_allclose(errors["bias_per_deviation"], per_deviation)
    np.testing.assert_allclose(errors["bias_per_error"], per_deviation * np.sqrt(40))
    biased = (errors["estimator"] == "srivc") & (errors["parameter"] == "g2_a2")
    assert (errors["bias_per_error"][biased].abs() > 10).all()
    assert (errors["bias_per_error"][~biased].abs() < 4).all()
    # The relative scatter of mean squares of normal errors is the square root of 2 over the number of data sets.
    np.testing.assert_allclose(errors["ratio"][~biased], 1.0, atol=4 * np.sqrt(2 / 40))


def test_who_counts_and_who_does_not(plan, tmp_path):
    good, far, width = named(TRUTH + 0.01), named(TRUTH + 1.0), named(np.full(6, 0.1))
    partial = {name: value for name, value in good.items() if not name.startswith("g2")}
    found = [
        estimate(good, width),
        estimate(far, status="MAX_ITERATIONS"),
        estimate(None, status="FAILED"),
        estimate(None),  # a fraction that is no sum of such submodels
        estimate(partial, status="MAX_ITERATIONS"),
        estimate(good | {"g1_a1": None}),
        estimate(good, dict.fromkeys(NAMES)),
    ]
    results = results_of(plan, {("additive", 4000): found}, tmp_path)
    counts = ["runs", "failed", "not_converged", "valueless", "counted", "with_error", "covered"]
    assert errors_of(results)[counts].to_numpy().tolist() == [[7, 1, 2, 4, 3, 1, 1]] * 6
    np.testing.assert_allclose(errors_of(results)["mse"], (2 * 0.01**2 + 1.0) / 3)


def test_a_ratio_is_that_of_pairs(plan, tmp_path):
    results = ideal_results(plan, tmp_path)
    stored = results.stored.results
    # A data set without a value for one of the two is left out for both.
    lost = next(key for key in stored if key.replicate == 3 and key.estimator_hash == plan.estimators[1].hash)
    stored[lost] = estimate(None, status="FAILED")
    # An estimate that lacks a parameter has no values at all: every parameter counts the same data sets.
    partial = next(key for key in stored if key.replicate == 5 and key.estimator_hash == plan.estimators[0].hash)
    stored[partial] = estimate(stored[partial]["parameters"] | {"g1_a1": None})
    wide = results.errors[results.errors["parameter"] == "g2_b0"].pivot(
        index="replicate", columns="group", values="value"
    )
    squares = {1000: wide[[1, 0]].drop([3, 5]) ** 2, 4000: 4 * wide[[3, 2]] ** 2}
    ratio, pairs = mse_ratio(results, "srivc", "g2_b0", [1000])
    sums = squares[1000].to_numpy().T
    without = np.array([np.delete(side, k).sum() for side in sums for k in range(38)]).reshape(2, 38)
    assert pairs == 38
    assert ratio.value == pytest.approx(sums[0].sum() / sums[1].sum())
    assert ratio.error == pytest.approx(np.sqrt(37 * np.var(without[0] / without[1])))
    # All lengths of a data set are one trial.
    ratio, pairs = mse_ratio(results, "srivc", "g2_b0", [1000, 4000])
    together = [squares[1000].iloc[:, k].sum() + squares[4000].iloc[:, k].drop([3, 5]).sum() for k in (0, 1)]
    assert (ratio.value, pairs) == (pytest.approx(together[0] / together[1]), 38)
    for key in [key for key in stored if key.replicate > 0]:
        del stored[key]
    with pytest.raises(UsageError, match="srivc and additive have 1 estimates on the same data sets, too few"):
        mse_ratio(Results(tmp_path, MadeResults(results.manifest, stored)), "srivc", "g2_b0", [1000])


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
    # Noise in the loop acts as a second reference: 0.01 in addition to 1.
    assert [found["srivc"][name] for name in NAMES] == pytest.approx(
        [found["clsrivc"][name] / 1.01 for name in NAMES], rel=1e-9
    )


def test_there_is_no_theory_for_biased_estimates_or_other_structures(tmp_path):
    assert set(variances_of(published("closed_loop_coloured"))) == {"clsrivc", "additive"}
    assert variances_of(published("flexible_beam")) == {}
    for change in (("zeros: 2}", "zeros: 1}"), ("poles: 4,", "poles: 5,"), ("zeros: 2}", "zeros: 2, delay: 0.1}")):
        text = TWO_MODES.replace(*change).replace("starts:", "# ")
        assert set(variances_of(plan_of(text, tmp_path))) == {"additive"}
