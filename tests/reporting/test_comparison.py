import itertools
import json
from math import comb

import pytest

from ctid_cli.errors import UsageError
from ctid_cli.inference.paired import holm
from ctid_cli.reporting.committed import read_tables
from ctid_cli.reporting.comparison import (
    LEVEL,
    check_tables,
    compare,
    fisher,
    mismatch_sentence,
    smallest_detectable,
    write_comparison,
)
from ctid_cli.reporting.layout import csv_text
from ctid_cli.reporting.study import load_study

STUDY = load_study()


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


def written(tmp_path, rows):
    file = tmp_path / "tables.csv"
    file.write_text(csv_text(rows), encoding="utf-8")
    return file


def hypergeometric_p(k1, n1, k2, n2):
    """Two-sided p-value as the definition has it: all tables that are no more likely than the one found."""
    likely = [comb(n1, k) * comb(n2, k1 + k2 - k) for k in range(max(0, k1 + k2 - n2), min(n1, k1 + k2) + 1)]
    found = comb(n1, k1) * comb(n2, k2)
    return sum(value for value in likely if value <= found) / sum(likely)


@pytest.mark.parametrize(("fresh", "committed"), [((20, 20), (80, 100)), ((3, 7), (99, 100)), ((0, 5), (100, 100))])
def test_the_p_value_is_that_of_fisher(fresh, committed):
    (cell,) = compare([row(*fresh)], [row(*committed)], STUDY).cells
    assert cell["p_value"] == pytest.approx(hypergeometric_p(*fresh, *committed))
    assert (cell["percent"], cell["reference_percent"]) == (
        100 * fresh[0] / fresh[1],
        100 * committed[0] / committed[1],
    )


def test_holm_is_the_closure_of_bonferroni():
    p = [0.001, 0.2, 0.004, 0.012, 0.012, 0.9]
    for k, adjusted in enumerate(holm(p)):
        subsets = (s for size in range(1, 7) for s in itertools.combinations(range(6), size) if k in s)
        assert adjusted == pytest.approx(max(min(1.0, len(s) * min(p[j] for j in s)) for s in subsets))
    assert holm([]) == []


def test_the_same_tables_agree_cell_by_cell_also_by_way_of_a_file(tmp_path):
    rows = [
        row(97),
        row(95, initial_delay="random"),
        row(99, initial_delay=None, method="delay_profile"),
        row(99, initial_delay=None, method="delay_profile", table=2),
        row(None, n=0, method="redundancy"),
        row(3, beta=[1, 2], robust=True, window="hann"),
    ]
    comparison = compare(rows, read_tables(written(tmp_path, rows)), STUDY, "tables.csv")
    # an estimate without a start stands in two tables and is compared once
    assert [(cell["against"], cell["method"], cell["initial_delay"]) for cell in comparison.cells] == [
        ("committed", "existing", 0.0),
        ("committed", "existing", "random"),
        ("committed", "delay_profile", None),
        ("committed", "existing", 0.0),
    ]
    assert comparison.identical == 4
    assert (comparison.not_run, comparison.not_in_reference, comparison.mismatches) == (0, 0, [])
    assert all(cell["p_value"] == 1.0 for cell in comparison.cells)
    assert "4 comparisons: 4 cells with tables.csv (4 of them with the same counts)" in write_comparison(
        comparison, "md"
    )


@pytest.mark.parametrize("converged", [60, 100])
def test_any_large_difference_from_the_committed_tables_is_a_mismatch(converged):
    comparison = compare([row(converged)], [row(85)], STUDY, "tables.csv")
    (cell,) = comparison.mismatches
    assert cell["differs"]
    assert mismatch_sentence(comparison) == "1 of 1 comparison differs by more than sampling error explains"
    text = write_comparison(comparison)
    listed = next(line for line in text.splitlines() if line.startswith("1 ") and "regular" in line)
    assert listed.split()[-5:-1] == [f"{converged}", "100", "85", "100"]
    assert "Other than in tables.csv:" in text


def test_one_small_difference_among_many_cells_is_sampling_error():
    delays = [float(k) for k in range(40)]
    fresh = [row(90 if delay == 3.0 else 100, initial_delay=delay) for delay in delays]
    committed = [row(100, initial_delay=delay) for delay in delays]
    comparison = compare(fresh, committed, STUDY)
    smallest = min(cell["p_value"] for cell in comparison.cells)
    assert smallest < LEVEL < 40 * smallest
    assert comparison.mismatches == []
    assert len(compare(fresh[3:4], committed, STUDY).mismatches) == 1


def test_our_method_must_not_fall_below_the_paper_but_may_exceed_it():
    low = compare([row(80, method="redundancy", published_percent=100.0)], None, STUDY)
    (cell,) = low.mismatches
    assert (cell["against"], cell["reference_n"], cell["reference_converged"]) == ("paper", 100, 100)
    assert "Lower than in the paper:" in write_comparison(low)
    high = compare([row(100, method="redundancy", published_percent=60.0)], None, STUDY)
    assert high.mismatches == []
    assert [cell["differs"] for cell in high.differences] == [True]
    assert "For information" in write_comparison(high)


def test_the_existing_method_differs_from_the_paper_for_information_only():
    rows = [row(0, published_percent=100.0), row(100, method="redundancy", published_percent=99.0)]
    comparison = compare(rows, None, STUDY)
    assert [(cell["method"], cell["decisive"]) for cell in comparison.cells] == [
        ("existing", False),
        ("redundancy", True),
    ]
    assert (comparison.mismatches, [cell["method"] for cell in comparison.differences]) == ([], ["existing"])
    # each is a family of its own
    assert all(cell["adjusted_p_value"] == cell["p_value"] for cell in comparison.cells)
    text = write_comparison(comparison)
    assert "No difference beyond sampling error in 1 comparison: 1 cell of redundancy with the paper" in text
    assert "no committed tables here" in text


def test_cells_that_only_one_side_has_are_counted_but_no_mismatch():
    fresh = [
        row(90),
        row(0, n=0, initial_delay=1.0),
        row(0, n=0, initial_delay=3.0, method="redundancy", published_percent=100.0),
        row(50, method="delay_profile", initial_delay=None),
    ]
    committed = [
        row(90),
        row(90, initial_delay=1.0),
        row(0, n=0, initial_delay=3.0, method="redundancy"),
        row(90, initial_delay=5.0),
        row(90, table=3, experiment="useful-redundancy/case2-regular"),
    ]
    comparison = compare(fresh, committed, STUDY, "tables.csv")
    assert len(comparison.cells) == comparison.identical == 1
    # from 1 and 5 s in the reference, from 3 s in the paper; table 3 was not asked for
    assert comparison.not_run == 3
    assert comparison.not_in_reference == 1
    text = " ".join(write_comparison(comparison).split())
    assert "Not run, so not compared: 3 cells." in text
    assert "Not in tables.csv: 1 cell that were run." not in text
    assert "Not in tables.csv, but run: 1 cell." in text


def test_an_experiment_asked_for_by_name_finds_its_cells_in_the_tables_of_the_study():
    name = "useful-redundancy/case1-regular"
    comparison = compare([row(90, table=name)], [row(90), row(90, initial_delay=1.0)], STUDY)
    assert (comparison.identical, comparison.not_run) == (1, 1)


def test_rows_without_a_success_rule_are_not_compared():
    assert compare([row(None)], [row(90)], STUDY).cells == []
    assert compare([row(90)], [row(None)], STUDY).cells == []


def test_the_forms_of_a_comparison():
    fresh = [row(60, published_percent=65.0), row(100, initial_delay=None, method="other_profile")]
    committed = [row(100), row(100, initial_delay=None, method="other_profile")]
    comparison = compare(fresh, committed, STUDY, "results/published/useful_redundancy/tables.csv", ["something"])
    content = json.loads(write_comparison(comparison, "json"))
    assert {key: content[key] for key in ("agrees", "compared", "identical", "mismatches", "notes")} == {
        "agrees": False,
        "compared": 2,
        "identical": 1,
        "mismatches": 1,
        "notes": ["something"],
    }
    first = content["cells"][0]
    assert (first["against"], first["snr_db"], first["percent"], first["reference_percent"]) == (
        "committed",
        5,
        60,
        100,
    )
    assert (first["differs"], first["decisive"], first["mismatch"]) == (True, True, True)
    lines = write_comparison(comparison, "csv").splitlines()
    assert lines[0].split(",") == list(first)
    assert len(lines) == 1 + len(content["cells"])
    assert max(map(len, write_comparison(comparison).splitlines())) <= 100
    assert "|:--|" in write_comparison(comparison, "md")
    assert "Note: something" in write_comparison(comparison)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text.replace("converged", "successes"), "has no column converged"),
        (lambda text: text.replace(",100,0,", ",many,0,"), ":2: n and converged"),
        (lambda text: text.replace(",100,0,", ",50,0,"), ":2: n and converged"),
        (lambda text: text.replace(",100,0,100,", ",100,0,most,"), ":2: n and converged"),
        (lambda text: text.split("\n")[0] + "\n1,e", ":2: n and converged"),
        (lambda text: "", "has no column table"),
        (lambda text: text.encode("utf-16"), "not a comma-separated text file"),
        (None, "No such file"),
    ],
)
def test_a_reference_that_cannot_be_used_says_why(tmp_path, change, message):
    file = written(tmp_path, [row()])
    if change is None:
        file.unlink()
    else:
        content = change(file.read_text(encoding="utf-8"))
        file.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(UsageError, match=message):
        read_tables(file)


def test_without_any_results_it_says_what_to_run(tmp_path):
    with pytest.raises(UsageError, match="none of these cells was run") as caught:
        check_tables(["3"], tmp_path)
    assert "ctid run" in str(caught.value)
    assert "case2_irregular.yaml" in str(caught.value)


@pytest.mark.parametrize(
    ("n", "reference", "m", "level"), [(100, 100, 100, 1e-4), (40, 55, 100, 0.01), (20, 0, 30, 0.01)]
)
def test_the_detectable_difference_is_found_with_80_percent_probability(n, reference, m, level):
    change = smallest_detectable(n, reference, m, level) / 100

    def power(q):
        significant = [k for k in range(n + 1) if fisher(k, n, reference, m) < level]
        return sum(comb(n, k) * q**k * (1 - q) ** (n - k) for k in significant)

    # the other side of the reference adds next to nothing
    powers = [power(q) for q in (reference / m - change, reference / m + change) if 0 <= q <= 1]
    assert max(powers) == pytest.approx(0.8, abs=1e-6)


def test_a_check_says_what_it_could_have_found():
    few = compare([row(1, n=1)], [row(90)], STUDY, "tables.csv")
    assert few.cells[0]["detectable"] is None
    assert "no difference could have been detected, however large" in " ".join(write_comparison(few).split())
    many = compare([row(100), row(1, n=1, initial_delay=1.0)], [row(100), row(100, initial_delay=1.0)], STUDY, "t.csv")
    assert 5 < many.cells[0]["detectable"] < 20
    text = " ".join(write_comparison(many).split())
    change = many.cells[0]["detectable"]
    assert f"differs by {change:.0f} percentage points is detected with 80 % probability" in text
    assert "in 1 cell no difference could have been detected" in text
    # a higher percentage than the paper's is no mismatch, so that only a lower one is looked for
    above = compare([row(0, method="redundancy", published_percent=0.0)], None, STUDY)
    assert above.cells[0]["detectable"] is None
