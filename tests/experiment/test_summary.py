from __future__ import annotations

import math
from typing import Any

import numpy as np
import pandas as pd
import pytest

from ctid_cli.experiment.summary import export_rows, is_converged, summarise, wilson_interval

# R. G. Newcombe, Statistics in Medicine 17 (1998) 857-872, Table I, method 3.
NEWCOMBE = [
    (81, 263, 0.2553, 0.3662),
    (15, 148, 0.0624, 0.1605),
    (0, 20, 0.0, 0.1611),
    (1, 29, 0.0061, 0.1718),
]


@pytest.mark.parametrize(("k", "n", "low", "high"), NEWCOMBE)
def test_wilson_interval_against_published_values(k: int, n: int, low: float, high: float) -> None:
    assert wilson_interval(k, n) == pytest.approx((low, high), abs=5e-5)


def test_wilson_interval_solves_its_defining_equation() -> None:
    for k, n in [(3, 7), (20, 20), (0, 5), (50, 100)]:
        for limit in wilson_interval(k, n):
            if 0 < limit < 1:
                assert abs(k / n - limit) / math.sqrt(limit * (1 - limit) / n) == pytest.approx(1.959963984540054)
        low, high = wilson_interval(k, n)
        assert 0 <= low < high <= 1


def test_wilson_interval_at_the_edges() -> None:
    assert wilson_interval(20, 20)[1] == 1.0
    assert wilson_interval(0, 20)[0] == 0.0
    assert all(math.isnan(limit) for limit in wilson_interval(0, 0))
    with pytest.raises(ValueError, match="got 3 of 2"):
        wilson_interval(3, 2)


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
    assert is_converged(estimate, success, true_delay) is expected


def frame() -> pd.DataFrame:
    return pd.DataFrame(
        {
            "estimator": ["b", "b", "b", "a", "a"],
            "initial_delay": pd.Series(["random", 3.0, 3.0, None, None], dtype="object"),
            "status": ["CONVERGED", "CONVERGED", "FAILED", "CONVERGED", "CRASHED"],
            "converged": pd.Series([True, True, False, False, False], dtype="boolean"),
            "seconds": [1.0, 2.0, np.nan, 4.0, 6.0],
            "numerator": pd.Series([[2.0], [1.0, 3.0], None, [4.0], [None]], dtype="object"),
            "denominator": pd.Series([[1.0, 5.0], [1.0, 6.0, 7.0], None, [1.0, 8.0], [1.0, 9.0]], dtype="object"),
            "standard_errors": pd.Series(
                [{"a1": 0.5, "b0": 0.25}, {"delay": 0.1}, None, {}, {"a1": None}], dtype="object"
            ),
        }
    )


def test_summarise_keeps_the_order_and_counts_failures() -> None:
    table = summarise(frame(), ["estimator", "initial_delay"])
    assert table[["estimator", "initial_delay"]].to_numpy().tolist() == [["b", "random"], ["b", 3.0], ["a", None]]
    assert table["n"].tolist() == [1, 2, 2]
    assert table["failed"].tolist() == [0, 1, 1]
    assert table["converged"].tolist() == [1, 1, 0]
    assert table["percent"].tolist() == [100.0, 50.0, 0.0]
    assert table["median_seconds"].tolist() == [1.0, 2.0, 5.0]
    low, high = wilson_interval(1, 2)
    assert table.loc[1, ["low", "high"]].tolist() == [100 * low, 100 * high]


def test_summarise_without_groups_and_without_a_rule() -> None:
    estimates = frame()
    assert summarise(estimates, [])["n"].tolist() == [5]
    estimates["converged"] = pd.Series([None] * 5, dtype="boolean")
    table = summarise(estimates, ["estimator"])
    assert table["converged"].isna().all()
    assert table[["percent", "low", "high"]].isna().all(axis=None)
    assert summarise(estimates.iloc[:0], ["estimator"]).empty


def test_export_has_a_column_for_every_coefficient() -> None:
    flat = export_rows(frame())
    assert flat.columns.tolist() == [
        *("estimator", "initial_delay", "status", "converged", "seconds"),
        *("b0", "b1", "a1", "a2", "se_b0", "se_a1", "se_delay"),
    ]
    lists = flat[["b0", "b1", "a1", "a2"]].to_numpy()
    nan = np.nan
    expected = [[2, nan, 5, nan], [1, 3, 6, 7], [nan] * 4, [4, nan, 8, nan], [nan, nan, 9, nan]]
    np.testing.assert_array_equal(lists, expected)
    np.testing.assert_array_equal(flat["se_delay"], [nan, 0.1, nan, nan, nan])
    assert len(flat) == 5
