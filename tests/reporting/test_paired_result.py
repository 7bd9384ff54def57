"""Comparison of two estimators of an experiment."""

import numpy as np
import pytest

from ctid_cli.errors import UsageError
from ctid_cli.inference.paired import holm, percent_difference, rms_difference
from ctid_cli.reporting.paired_result import compare_estimators, paired_rows

FIRST = [8.01, 9.0, 7.97, 12.0, 8.02, 8.03, 7.5]
SECOND = [8.0, 8.01, 7.99, 8.02, 8.01, 12.0, 8.0]


@pytest.fixture
def results(make_results, add_estimator, estimate):
    found = make_results({(5.0, "0.0"): [estimate(delay) for delay in FIRST]})
    add_estimator(found, "other", {(5.0, None): [estimate(delay) for delay in SECOND]})
    for cell in found.manifest["data_cells"]:
        cell["replicates"] = 7
    return found


def test_differences_are_paired_and_corrected(results):
    rows = paired_rows(results, "existing", "other")
    percent, *errors = rows
    assert [row["measure"] for row in rows] == ["percent", *["rmse"] * 4]
    assert (percent["only_first"], percent["only_second"], percent["n"]) == (1, 3, 7)
    assert [percent[key] for key in ("value", "low", "high", "p_value")] == list(percent_difference(1, 3, 7))
    delay = next(row for row in errors if row["parameter"] == "delay")
    sides = [np.array(side) - 8.0 for side in (FIRST, SECOND)]
    assert [delay[key] for key in ("value", "low", "high", "p_value")] == pytest.approx(list(rms_difference(*sides)))
    assert [row["adjusted_p_value"] for row in errors] == holm([row["p_value"] for row in errors])
    assert {row["family"] for row in errors} == {"4 differences in rmse"}
    assert {(row["first"], row["second"], row["initial_delay"]) for row in rows} == {("existing", "other", 0.0)}


def test_the_text_lists_what_only_the_second_solves(results, tmp_path):
    text = compare_estimators(results, "existing,other", tmp_path).summary()
    lost = paired_rows(results, "existing", "other")[0]["failed_ids"]
    assert len(lost) == 3
    assert "3 estimates of existing missed on data sets where other did not:" in text
    assert all(f"--id {name} --out {tmp_path}" in text for name in lost)
    assert "adjusted by Holm over the 1 difference in percent; 4 differences in rmse" in " ".join(text.split())


def test_each_pair_and_each_estimate_counts_once(results, add_estimator, estimate, tmp_path):
    # The second one has two sets of options: failures of the first are listed once.
    add_estimator(results, "third", {(5.0, None): [estimate(delay) for delay in SECOND]})
    _, other, third = results.manifest["estimators"]
    other["swept"], third["swept"], third["name"] = {"zeros": 0}, {"zeros": 1}, "other"
    assert "3 estimates of existing missed" in compare_estimators(results, "existing,other", tmp_path).summary()
    # One difference for two options of an estimator, not two of opposite sign.
    rows = paired_rows(results, "other", "other")
    assert [(row["first"], row["second"]) for row in rows] == [("other, zeros 0", "other, zeros 1")] * 5
    with pytest.raises(UsageError, match="existing has no swept option; compare it with another estimator"):
        compare_estimators(results, "existing,existing", tmp_path)
