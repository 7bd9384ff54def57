"""Tables beside the committed ones and those of the article: what differs by more than chance."""

import itertools
from math import comb

import pandas as pd
import pytest

from ctid_cli.errors import UsageError
from ctid_cli.inference.paired import fisher, holm, smallest_detectable
from ctid_cli.reporting.comparison_result import LEVEL, check_tables, compare
from ctid_cli.reporting.study import find_study

STUDY = find_study()


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


def hypergeometric_p(k1, n1, k2, n2):
    """Two-sided p-value as the definition has it: all tables that are no more likely than the one found."""
    likely = [comb(n1, k) * comb(n2, k1 + k2 - k) for k in range(max(0, k1 + k2 - n2), min(n1, k1 + k2) + 1)]
    found = comb(n1, k1) * comb(n2, k2)
    return sum(value for value in likely if value <= found) / sum(likely)


@pytest.mark.parametrize(("fresh", "committed"), [((20, 20), (80, 100)), ((3, 7), (99, 100)), ((0, 5), (100, 100))])
def test_the_p_value_is_that_of_fisher(fresh, committed):
    (cell,) = compare(table(row(*fresh)), table(row(*committed)), STUDY).content()["cells"]
    assert cell["p_value"] == pytest.approx(hypergeometric_p(*fresh, *committed))
    percents = 100 * fresh[0] / fresh[1], 100 * committed[0] / committed[1]
    assert (cell["percent"], cell["reference_percent"]) == pytest.approx(percents)


def test_holm_is_the_closure_of_bonferroni():
    p = [0.001, 0.2, 0.004, 0.012, 0.012, 0.9]
    for k, adjusted in enumerate(holm(p)):
        subsets = (s for size in range(1, 7) for s in itertools.combinations(range(6), size) if k in s)
        assert adjusted == pytest.approx(max(min(1.0, len(s) * min(p[j] for j in s)) for s in subsets))
    assert list(holm([])) == []


def test_the_same_tables_agree_cell_by_cell():
    rows = table(
        row(97),
        row(95, initial_delay="random"),
        row(99, initial_delay=None, method="delay_profile"),
        row(99, initial_delay=None, method="delay_profile", table=2),
        row(None, n=0, method="redundancy"),
    )
    comparison = compare(rows, rows, STUDY, "tables.csv")
    # An estimate without a start stands in two tables and is compared once.
    cells = comparison.content()["cells"]
    assert [(cell["against"], cell["method"], cell["initial_delay"]) for cell in cells] == [
        ("committed", "existing", 0.0),
        ("committed", "existing", "random"),
        ("committed", "delay_profile", None),
    ]
    assert comparison.identical == 3
    assert (comparison.not_run, comparison.not_in_reference, len(comparison.mismatches)) == (0, 0, 0)
    assert {cell["p_value"] for cell in cells} == {1.0}
    assert "3 comparisons: 3 cells with tables.csv (3 of them with the same counts)" in comparison.write("md")


@pytest.mark.parametrize("converged", [60, 100])
def test_any_large_difference_from_the_committed_tables_is_a_mismatch(converged):
    comparison = compare(table(row(converged)), table(row(85)), STUDY, "tables.csv")
    assert comparison.verdict == "1 of 1 comparison differs by more than sampling error explains"
    text = comparison.summary()
    assert "Other than in tables.csv:" in text
    listed = next(line for line in text.splitlines() if "regular" in line)
    assert listed.split()[-5:-1] == [f"{converged}", "100", "85", "100"]


def test_one_small_difference_among_many_cells_is_sampling_error():
    delays = [float(k) for k in range(40)]
    fresh = [row(90 if delay == 3.0 else 100, initial_delay=delay) for delay in delays]
    committed = table(*(row(100, initial_delay=delay) for delay in delays))
    comparison = compare(table(*fresh), committed, STUDY)
    smallest = comparison.cells["p_value"].min()
    assert smallest < LEVEL < 40 * smallest
    assert len(comparison.mismatches) == 0
    assert len(compare(table(fresh[3]), committed, STUDY).mismatches) == 1


def test_only_our_method_must_reach_the_paper_and_may_exceed_it():
    low = compare(table(row(80, method="redundancy", published_percent=100.0)), None, STUDY)
    (cell,) = low.content()["cells"]
    assert (cell["mismatch"], cell["against"], cell["reference_n"], cell["reference_converged"]) == (
        *(True, "paper", 100, 100),
    )
    assert "Lower than in the paper:" in low.summary()
    high = compare(table(row(100, method="redundancy", published_percent=60.0)), None, STUDY)
    existing = compare(table(row(60, published_percent=100.0)), None, STUDY)
    for comparison in (high, existing):
        assert len(comparison.mismatches) == 0
        assert comparison.cells["differs"].tolist() == [True]
    assert len(existing.decisive) == 0


def test_cells_that_only_one_side_has_are_counted_but_no_mismatch():
    fresh = table(row(99), row(98, initial_delay=1.0))
    committed = table(row(99), row(97, initial_delay=3.0), row(97, initial_delay=5.0))
    comparison = compare(fresh, committed, STUDY, "tables.csv")
    assert (len(comparison.decisive), comparison.not_run, comparison.not_in_reference) == (1, 2, 1)
    assert "Not run, so not compared: 2 cells. Not in tables.csv, but run: 1 cell." in " ".join(
        comparison.summary().split()
    )


def test_without_any_results_it_says_what_to_run(tmp_path):
    with pytest.raises(UsageError, match="none of these cells was run") as error:
        check_tables([], tmp_path)
    assert "ctid run configs/useful_redundancy/case1_regular.yaml" in str(error.value)


@pytest.mark.parametrize(("n", "reference", "m"), [(100, 100, 100), (20, 97, 100), (300, 50, 100)])
def test_the_detectable_difference_is_found_with_80_percent_probability(n, reference, m):
    from scipy.stats import binom

    level = 1e-3
    drop = smallest_detectable(n, reference, m, level, rise=False)
    q = reference / m - drop / 100
    significant = [k for k in range(n + 1) if fisher(k, n, reference, m) < level and k / n < reference / m]
    assert binom.pmf(significant, n, q).sum() == pytest.approx(0.8, abs=1e-6)
