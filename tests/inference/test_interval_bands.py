"""A small version of the study of band coverage, and the published values of the large one."""

import pandas as pd
import pytest
from scipy import stats

from benchmarks import interval_bands as bands

RUNS = 40


@pytest.mark.parametrize("row", [row for row in bands.ROWS if row[0] in "cd"], ids=["white", "coloured"])
def test_bands_cover_within_the_binomial_band(row):
    lines = pd.DataFrame(bands.coverage(*row, RUNS))
    assert (lines["converged"] == RUNS).all()
    assert sorted(set(lines["response"])) == sorted(bands.RESPONSES)
    least = stats.binom.ppf(1e-5, RUNS, 0.95)
    assert 28 <= least < 33
    assert (lines["covered"] >= least).all()


def test_too_small_a_covariance_is_seen():
    (row,) = [row for row in bands.ROWS if row[0] == "d"]
    lines = pd.DataFrame(bands.coverage(row[0], row[1], "white", row[3], RUNS))
    least = stats.binom.ppf(1e-5, RUNS, 0.95)
    assert (lines["covered"] < least).sum() > 5


def test_published_bands_cover():
    lines = pd.read_csv(bands.PUBLISHED / "bands.csv")
    assert len(lines) == 56
    assert (lines["converged"] == 1000).all()
    assert lines["percent"].between(93.0, 97.2).all()
    assert lines["percent"].mean() == pytest.approx(95.0, abs=0.5)
