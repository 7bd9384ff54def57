"""A small version of the coverage study: true standard errors cover, and the wrong formula is caught."""

import pytest
from scipy import stats

from experiments.coverage.coverage import BAND, ROWS, markdown, outside, study, summarise

RUNS = 60


@pytest.fixture(scope="module")
def summary():
    return summarise(study(["c", "d"], RUNS))


def chosen(summary, row, formula):
    lines = summary[(summary["row"] == row) & (summary["formula"] == formula)].set_index("parameter")
    assert list(lines.index) == ["a1", "b0", "delay"]
    assert (lines["runs"] == RUNS).all()
    return lines


@pytest.mark.parametrize(("row", "formula"), [("c", "white"), ("d", "sandwich")])
def test_intervals_cover_within_the_binomial_band(summary, row, formula):
    lines = chosen(summary, row, formula)
    least = stats.binom.ppf(1e-4, RUNS, 0.95)
    assert 48 <= least < RUNS
    assert (lines["covered"] >= least).all()
    # Intervals that are too wide cover as well: the standard errors must match the scatter, known to about 9 %.
    assert lines["standard_error_ratio"].between(0.7, 1.4).all()


@pytest.mark.parametrize(("row", "formula"), [("c", "white"), ("d", "sandwich")])
def test_estimates_are_unbiased(summary, row, formula):
    assert (chosen(summary, row, formula)["bias_in_monte_carlo_errors"].abs() < 4).all()


def test_the_white_formula_fails_under_coloured_noise(summary):
    wrong, right = chosen(summary, "d", "white"), chosen(summary, "d", "sandwich")
    assert (wrong.loc[["a1", "b0"], "percent"] < 75).all()
    assert (wrong["standard_error_ratio"] < 0.75).all()
    assert (wrong["covered"] < right["covered"]).all()


def test_only_the_formula_meant_for_a_row_is_judged(summary):
    forced = summary.assign(percent=50.0)
    assert set(zip(outside(forced)["row"], outside(forced)["formula"], strict=True)) == {
        ("c", "white"),
        ("d", "sandwich"),
    }
    assert outside(summary.assign(percent=sum(BAND) / 2)).empty


def test_the_table_names_the_misuse(summary):
    text = markdown(summary)
    assert text.count("white (misused)") == 3
    assert text.count("\n") == len(summary) + 2


def test_a_data_set_does_not_depend_on_the_number_of_runs():
    few, more = study(["c"], 2), study(["c"], 3)
    assert few.equals(more[more["replicate"] < 2].reset_index(drop=True))


def test_rows_that_must_cover():
    assert [key for key, row in ROWS.items() if row.required] == ["a", "b", "c", "d"]
