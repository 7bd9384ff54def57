from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import pytest

from ctid_cli.inference.monte_carlo import wilson_interval
from ctid_cli.storage.columns import parameter_names
from ctid_cli.storage.summary import counted, export_rows, is_converged


def row(status: str = "CONVERGED", delay: float | None = 8.0, fit: float | None = 95.0) -> dict[str, Any]:
    return {"status": status, "delay": delay, "fit_percent": fit}


@pytest.mark.parametrize(
    ("estimate", "success", "true_delay", "expected"),
    [
        (row(delay=8.079), {"delay_relative_error": 0.01}, 8.0, True),
        (row(delay=8.081), {"delay_relative_error": 0.01}, 8.0, False),
        (row("MAX_ITERATIONS", delay=7.93), {"delay_relative_error": 0.01}, 8.0, True),
        (row(delay=None), {"delay_relative_error": 0.01}, 8.0, False),
        (row("FAILED", delay=8.0), {"delay_relative_error": 0.01}, 8.0, False),
        (row("CRASHED"), {"fit_percent": 90}, None, False),
        (row("TIMEOUT"), {"fit_percent": 90}, None, False),
        (row(fit=89.9), {"fit_percent": 90}, None, False),
        (row(fit=90.0), {"fit_percent": 90}, None, True),
        (row(fit=None), {"fit_percent": 90}, None, False),
        (row(delay=9.0), {"delay_relative_error": 0.01, "fit_percent": 90}, 8.0, False),
        (row(fit=50.0), {"delay_relative_error": 0.01, "fit_percent": 90}, 8.0, False),
        (row(), {"delay_relative_error": 0.01, "fit_percent": None}, None, None),
        (row(), None, 8.0, None),
    ],
)
def test_success_rule(
    estimate: dict[str, Any], success: dict[str, Any] | None, true_delay: float | None, expected: bool | None
) -> None:
    truth = {} if true_delay is None else {"delay": true_delay}
    assert is_converged(estimate, success, truth) is expected


TRUE = {"g1_a1": 0.25, "g1_b0": -3.0}


@pytest.mark.parametrize(
    ("found", "status", "expected"),
    [
        ({"g1_a1": 0.27, "g1_b0": -3.2}, "CONVERGED", True),
        ({"g1_a1": 0.27, "g1_b0": -3.2, "g1_b1": 9.0}, "MAX_ITERATIONS", True),
        ({"g1_a1": 0.28, "g1_b0": -3.2}, "CONVERGED", False),
        ({"g1_a1": 0.25, "g1_b0": 3.0}, "CONVERGED", False),
        ({"g1_a1": 0.25, "g1_b0": None}, "CONVERGED", False),
        ({"g1_a1": 0.25}, "CONVERGED", False),
        (None, "CONVERGED", False),
        ({"g1_a1": 0.25, "g1_b0": -3.0}, "FAILED", False),
    ],
)
def test_success_rule_of_parameters(found: Any, status: str, expected: bool) -> None:
    estimate = row(status) | {"parameters": found}
    success = {"parameter_relative_error": 0.1, "delay_relative_error": None, "fit_percent": None}
    assert is_converged(estimate, success, TRUE | {"delay": 0.0}) is expected
    # Together with another rule both must hold, and without true parameters there is nothing to compare with.
    assert is_converged(estimate, success | {"fit_percent": 96.0}, TRUE) is False
    assert is_converged(estimate, success, {"delay": 0.0}) is None


def test_success_rule_of_the_coefficients_of_a_transfer_function() -> None:
    success = {"parameter_relative_error": 0.1}
    found = row("CONVERGED") | {"numerator": [2.1], "denominator": [1.0, 2.9, 4.0]}
    assert is_converged(found, success, {"b0": 2.0, "a1": 3.0, "a2": 4.0, "delay": 1.0}) is True
    assert is_converged(found, success, {"b0": 2.0, "a1": 3.5, "a2": 4.0, "delay": 1.0}) is False
    assert is_converged(found, success, {"b0": 2.0, "a1": 3.0, "delay": 1.0}) is False, "another number of poles"


def frame() -> pd.DataFrame:
    return pd.DataFrame(
        {
            "estimator": ["b", "b", "b", "a", "a"],
            "initial_delay": pd.Series(["random", 3.0, 3.0, None, None], dtype="object"),
            "status": ["CONVERGED", "CONVERGED", "FAILED", "CONVERGED", "CRASHED"],
            "converged": pd.Series([True, True, False, False, False], dtype="boolean"),
            "seconds": [1.0, 2.0, np.nan, 4.0, 6.0],
            "cpu_seconds": [0.5, 1.0, np.nan, 2.0, 3.0],
            "numerator": pd.Series([[2.0], [1.0, 3.0], None, [4.0], [None]], dtype="object"),
            "denominator": pd.Series([[1.0, 5.0], [1.0, 6.0, 7.0], None, [1.0, 8.0], [1.0, 9.0]], dtype="object"),
            "standard_errors": pd.Series(
                [{"a1": 0.5, "b0": 0.25}, {"delay": 0.1}, None, {}, {"a1": None}], dtype="object"
            ),
        }
    )


def test_a_group_is_counted() -> None:
    failures, times = np.array([False, True]), np.array([4.0, 6.0])
    found = counted(failures, np.array([True, False]), {"seconds": times, "cpu_seconds": np.array([np.nan, 3.0])})
    assert (found["n"], found["failed"], found["converged"], found["percent"]) == (2, 1, 1, 50.0)
    assert (found["median_seconds"], found["median_cpu_seconds"]) == (5.0, 3.0)
    low, high = wilson_interval(1, 2)
    assert (found["low"], found["high"]) == (100 * low, 100 * high)
    # Without a rule, and where no time is known.
    found = counted(failures, None, {"seconds": np.full(2, np.nan)})
    assert (found["n"], found["converged"], found["percent"], found["median_seconds"]) == (2, None, None, None)


def test_export_has_a_column_for_every_coefficient() -> None:
    flat = export_rows(frame())
    assert flat.columns.tolist() == [
        *("estimator", "initial_delay", "status", "converged", "seconds", "cpu_seconds"),
        *("b0", "b1", "a1", "a2", "se_b0", "se_a1", "se_delay"),
    ]
    lists = flat[["b0", "b1", "a1", "a2"]].to_numpy()
    nan = np.nan
    expected = [[2, nan, 5, nan], [1, 3, 6, 7], [nan] * 4, [4, nan, 8, nan], [nan, nan, 9, nan]]
    np.testing.assert_array_equal(lists, expected)
    np.testing.assert_array_equal(flat["se_delay"], [nan, 0.1, nan, nan, nan])
    assert len(flat) == 5


def test_export_has_a_column_for_every_parameter_of_submodels() -> None:
    estimates = frame()
    found = [{"g1_a1": 1.0, "g1_b0": 2.0}, {"g1_a1": 3.0, "g1_a10": 4.0, "g1_a2": None, "g1_b0": 5.0}, None, None, {}]
    estimates.insert(estimates.columns.get_loc("standard_errors"), "parameters", pd.Series(found, dtype="object"))
    estimates["standard_errors"] = pd.Series(
        [{"g1_b0": 0.5}, {"a1": 0.25, "g1_a10": 0.1}, None, {}, {}], dtype="object"
    )
    flat = export_rows(estimates)
    assert flat.columns.tolist() == [
        *("estimator", "initial_delay", "status", "converged", "seconds", "cpu_seconds"),
        *("b0", "b1", "a1", "a2", "g1_a1", "g1_a2", "g1_a10", "g1_b0", "se_a1", "se_g1_a10", "se_g1_b0"),
    ]
    nan = np.nan
    np.testing.assert_array_equal(flat["g1_a1"], [1.0, 3.0, nan, nan, nan])
    np.testing.assert_array_equal(flat["g1_a2"], [nan] * 5)
    np.testing.assert_array_equal(flat["se_g1_b0"], [0.5, nan, nan, nan, nan])


def test_parameters_are_named_by_submodel_and_power() -> None:
    names = ["g10_a1", "g2_b0", "g2_a2", "g2_a1", "g1_b10", "g1_b9", "g1_a1"]
    assert parameter_names([dict.fromkeys(names, 1.0)]) == [
        *("g1_a1", "g1_b9", "g1_b10", "g2_a1", "g2_a2", "g2_b0", "g10_a1"),
    ]
    assert parameter_names([None, {}]) == []
