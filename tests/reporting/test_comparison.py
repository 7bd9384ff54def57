"""Comparison of tables with committed and published ones: significant differences."""

import pandas as pd
import pytest

from ctid_cli.errors import UsageError
from ctid_cli.reporting.comparison_result import LEVEL, check_tables, compare


def table(*rows):
    return pd.DataFrame(rows, dtype=object)


def row(converged=100, n=100, **changes):
    return {
        "table": 1,
        "experiment": "useful-redundancy/case1-regular",
        "sampling": "regular",
        "snr_db": 5.0,
        "initial_delay": 0.0,
        "method": "existing",
        "n": n,
        "failed": 0,
        "converged": converged,
        "percent": None if not n or converged is None else 100 * converged / n,
        "low": None,
        "high": None,
        "published_percent": None,
        "median_seconds": 0.02,
    } | changes


def test_the_same_tables_agree_cell_by_cell():
    rows = table(
        row(97),
        row(95, initial_delay="random"),
        row(99, initial_delay=None, method="delay_profile"),
        row(99, initial_delay=None, method="delay_profile", table=2),
        row(None, n=0, method="redundancy"),
    )
    comparison = compare(rows, rows, "tables.csv")
    # An estimate without a start is in two tables and is compared once.
    cells = comparison.content()["cells"]
    assert [(cell["method"], cell["initial_delay"]) for cell in cells] == [
        ("existing", 0.0),
        ("existing", "random"),
        ("delay_profile", None),
    ]
    assert comparison.identical == 3
    assert (comparison.not_run, comparison.not_in_reference, len(comparison.mismatches)) == (0, 0, 0)
    assert {cell["p_value"] for cell in cells} == {1.0}
    assert "in 3 comparisons with tables.csv, 3 with the same counts, from 100 data sets a cell." in comparison.write(
        "md"
    )


@pytest.mark.parametrize("converged", [60, 100])
def test_any_large_difference_from_the_committed_tables_is_a_mismatch(converged):
    comparison = compare(table(row(converged)), table(row(85)), "tables.csv")
    assert comparison.verdict == "1 of 1 comparison differs by more than sampling error explains"
    text = comparison.summary()
    listed = next(line for line in text.splitlines() if "regular" in line)
    assert listed.split()[-5:-1] == [f"{converged}", "100", "85", "100"]


def test_one_small_difference_among_many_cells_is_sampling_error():
    delays = [float(k) for k in range(40)]
    fresh = [row(90 if delay == 3.0 else 100, initial_delay=delay) for delay in delays]
    committed = table(*(row(100, initial_delay=delay) for delay in delays))
    comparison = compare(table(*fresh), committed, "tables.csv")
    smallest = comparison.cells["p_value"].min()
    assert smallest < LEVEL < 40 * smallest
    assert len(comparison.mismatches) == 0
    assert len(compare(table(fresh[3]), committed, "tables.csv").mismatches) == 1


def test_cells_that_only_one_side_has_are_counted_but_no_mismatch():
    fresh = table(row(99), row(98, initial_delay=1.0))
    committed = table(row(99), row(97, initial_delay=3.0), row(97, initial_delay=5.0))
    comparison = compare(fresh, committed, "tables.csv")
    assert (len(comparison.cells), comparison.not_run, comparison.not_in_reference) == (1, 2, 1)
    assert "Not run, so not compared: 2 cells. Not in tables.csv, but run: 1 cell." in " ".join(
        comparison.summary().split()
    )


def test_without_any_results_it_says_what_to_run(tmp_path):
    with pytest.raises(UsageError, match="none of these cells was run") as error:
        check_tables([], tmp_path)
    assert "ctid run configs/useful_redundancy/case1_regular.yaml" in str(error.value)
