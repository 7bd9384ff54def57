"""A small version of the coverage study: correct standard errors cover, and a wrong formula is detected."""

import pandas as pd
import pytest
from scipy import stats

from benchmarks import interval_defaults as defaults
from ctid_cli.reporting.study import find_study
from ctid_cli.studies.catalogue import read_study
from tests.reporting.frequency_results import run_here

STUDY = find_study("coverage")
claims, tables = STUDY.module("claims"), STUDY.module("tables")
RUNS = 60


@pytest.fixture(scope="session")
def found(tmp_path_factory):
    out = tmp_path_factory.mktemp("coverage")
    for name in ("first-order", "first-order-coloured"):
        run_here(name, out, [f"monte_carlo.runs={RUNS}"], STUDY)
    return read_study(STUDY, out)


@pytest.fixture(scope="session")
def summary(found):
    return pd.concat([tables.coverage(results) for results in found.experiments.values()])


def chosen(summary, row, formula):
    lines = summary[(summary["row"] == row) & (summary["formula"] == formula)].set_index("parameter")
    assert list(lines.index) == ["a1", "b0", "delay"]
    assert (lines["runs"] == RUNS).all()
    return lines


@pytest.mark.slow
@pytest.mark.parametrize(("row", "formula"), [("c", "white"), ("d", "sandwich, t")])
def test_intervals_cover_within_the_binomial_band(summary, row, formula):
    lines = chosen(summary, row, formula)
    least = stats.binom.ppf(1e-4, RUNS, 0.95)
    assert 48 <= least < RUNS
    assert (lines["covered"] >= least).all()
    # Intervals that are too wide cover too: standard errors must match the scatter, known to about 9 %.
    assert lines["standard_error_ratio"].between(0.7, 1.4).all()


@pytest.mark.slow
@pytest.mark.parametrize(("row", "formula"), [("c", "white"), ("d", "sandwich, t")])
def test_estimates_are_unbiased(summary, row, formula):
    assert (chosen(summary, row, formula)["bias_in_monte_carlo_errors"].abs() < 4).all()


@pytest.mark.slow
def test_the_white_formula_fails_under_coloured_noise(summary):
    wrong, right = chosen(summary, "d", "white"), chosen(summary, "d", "sandwich, t")
    assert (wrong.loc[["a1", "b0"], "percent"] < 75).all()
    assert (wrong["standard_error_ratio"] < 0.75).all()
    assert (wrong["covered"] < right["covered"]).all()


@pytest.mark.slow
def test_only_the_formula_meant_for_a_row_is_judged(found):
    judged = [claim.claim for name in found.experiments for claim in claims.intervals_cover(found[name])]
    assert judged == [
        f"coverage of {name} [%], {formula} formula"
        for formula in ("white", "sandwich, t")
        for name in ("a1", "b0", "delay")
    ]
    assert [claim.holds for claim in claims.white_formula_is_misused(found["first-order-coloured"])][:2] == [True, True]


def test_rows_are_the_experiments_of_the_study_and_all_but_the_biased_one_must_cover():
    assert set(tables.ROWS) == {name.rpartition("/")[2] for name in STUDY.configs}
    judged = [tables.ROWS[name][0] for (name,) in STUDY.claims["intervals_cover"]]
    assert judged == ["a", "b", "c", "d", "f", "g"]


def test_published_intervals_of_default_settings_cover():
    lines = pd.read_csv(defaults.PUBLISHED / "defaults.csv")
    assert (lines["runs"] % 400 == 0).all()
    together = lines[(lines["system"] == "all") & lines["noise"].isin(defaults.BOUNDED)]
    bounded = together[(together["input"] == "prbs") | (together["snr_db"] == 30.0)]
    assert len(bounded) == 8
    assert bounded["percent"].between(92.0, 98.0).all()
    # If intervals of such records cover less than nine in ten, the fit warns.
    short = lines[(lines["system"] != "all") & (lines["percent"] < 90.0) & (lines["snr_db"] == 30.0)]
    assert len(short) == 2
    assert (short["called_unsafe"] > 0.9 * short["runs"]).all()
