"""Every measure of docs/measures.md, recomputed with NumPy from the stored results of an experiment."""

import re
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from ctid_cli.inference.monte_carlo import LARGEST_FACTOR, MEASURES
from ctid_cli.reporting.measures import measure_frame, records_of
from ctid_cli.running.theory import least_variances
from tests.reporting.ideal_results import estimate, plan_of, results_of

# 8 / (p^2 + 2.8 p + 4) after 1.5 s.
SPEC = """\
experiment: study
system:      {numerator: [2], denominator: [0.25, 0.7, 1], delay: 1.5}
excitation:  {kind: prbs, stages: 8, clock_period: 0.5}
sampling:    {kind: uniform_intervals, low: 0.05, high: 0.15, samples: 400}
noise:       {kind: white, variance: 0.1}
estimators:
  one:       {kind: delay_profile, poles: 2, zeros: 0, delay_bounds: [1, 2]}
monte_carlo: {runs: 60, seed: 3}
success:     {delay_relative_error: 0.01}
measures:    [fresh_fit]
"""
NAMES, TRUTH = ("a1", "a2", "b0", "delay"), np.array([2.8, 4.0, 8.0, 1.5])
RUNS, FAILED, ONE_POLE = 60, (3, 20, 41), 7
RNG = np.random.default_rng(5)
WIDTHS = np.array([0.1, 0.2, 0.3, 0.01]) * np.exp(0.2 * RNG.standard_normal((RUNS, 4)))
VALUES = TRUTH + 0.03 * WIDTHS.mean(axis=0) + WIDTHS * RNG.standard_normal((RUNS, 4))
VALUES[[11, 50], 2:] += [[300.0, 0.4], [2.0, -0.3]]
WIDTHS[25:45] = np.nan
WIDTHS[50] *= 100.0
FRESH, SECONDS = 90.0 - RNG.exponential(5.0, RUNS), RNG.exponential(0.2, RUNS)
STATUS = np.array(["CONVERGED"] * 40 + ["MAX_ITERATIONS"] * 20)
STATUS[list(FAILED)] = "FAILED"
MODELS = np.setdiff1d(np.arange(RUNS), FAILED)
#: Frequencies of distances [rad/s].
GRID = np.r_[np.linspace(0.0, 64.0, 2**15 + 1), np.geomspace(64.0, 4000.0, 20_000)[1:]]
#: Estimates whose parameters count: a model with one pole has no true values.
COUNTED = np.setdiff1d(MODELS, [ONE_POLE])


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recomputed")
    plan, found = plan_of(SPEC, folder), []
    for k, (a1, a2, b0, delay) in enumerate(VALUES):
        widths = dict(zip(NAMES, WIDTHS[k].tolist(), strict=True)) if np.isfinite(WIDTHS[k]).all() else {}
        model = {"numerator": [b0], "denominator": [1.0, a1] if k == ONE_POLE else [1.0, a1, a2], "delay": delay}
        more = model | {"fresh_fit_percent": FRESH[k]} if k in MODELS else {}
        found.append(estimate(None, widths or None, str(STATUS[k]), cpu_seconds=SECONDS[k], **more))
    return results_of(plan, {("one", 400): found}, folder)


def binomial(hits):
    """Return the percentage with Wilson's interval, the two solutions p of (k/n - p)^2 = z^2 p (1 - p) / n."""
    n, share, z2 = len(hits), np.mean(hits), stats.norm.ppf(0.975) ** 2
    ends = np.sort(np.roots([1 + z2 / n, -2 * share - z2 / n, share**2]))
    return 100 * np.array([share, np.sqrt(share * (1 - share) / n), *ends])


def jackknife(statistic, *columns):
    """Return the jackknife over data sets; the interval is that of the logarithm."""
    n = len(columns[0])
    without = np.array([statistic(*(np.delete(column, k) for column in columns)) for k in range(n)])
    error, of_logarithm = (np.sqrt((n - 1) * np.var(part)) for part in (without, np.log(without)))
    factor = np.exp(stats.t.ppf(0.975, n - 1) * of_logarithm)
    value = statistic(*columns)
    ends = (value / factor, value * factor) if factor <= LARGEST_FACTOR else (np.nan, np.nan)
    return np.array([value, error, *ends])


def order_statistics(values, level=0.5):
    """Return the quantile with an interval of order statistics, which ends at probabilities of at most 2.5 %."""
    n, ordered = len(values), np.sort(values)
    first = max(k for k in range(n) if stats.binom.cdf(k, n, level) <= 0.025)
    last = min(k for k in range(n) if stats.binom.cdf(k, n, level) >= 0.975)
    low, high = ordered[first], ordered[last]
    return np.array([np.quantile(values, level), (high - low) / (2 * stats.norm.ppf(0.975)), low, high])


def student(errors):
    """Return the mean with its t interval."""
    mean, error = np.mean(errors), np.std(errors, ddof=1) / np.sqrt(len(errors))
    return np.array([mean, error, *stats.t.interval(0.95, len(errors) - 1, mean, error)])


def root_mean_square(values):
    return np.sqrt(np.mean(values**2))


def deviation(errors):
    return np.std(errors, ddof=1)


def response(frequency, model, poles=2):
    """Return the response of b0 / (p^2 + a1 p + a2), or of b0 / (p + a1), after a delay."""
    p, (a1, a2, b0, delay) = 1j * frequency, model
    return b0 / (p**2 + a1 * p + a2 if poles == 2 else p + a1) * np.exp(-p * delay)


def distances(norm):
    """Return the relative distances of the models [%], infinite for failures."""
    true, found = response(GRID, TRUTH), np.full(RUNS, np.inf)
    for k in MODELS:
        model = response(GRID, VALUES[k], 1 if k == ONE_POLE else 2)
        found[k] = 100.0 * norm(true - model) / norm(true)
    return found


#: Measures of errors e with standard errors w, which may be missing, and the minimum variance.
OF_ERRORS = {
    "bias": lambda e, w, bound: student(e),
    "deviation": lambda e, w, bound: jackknife(deviation, e),
    "mse": lambda e, w, bound: jackknife(lambda e: np.mean(e**2), e),
    "rmse": lambda e, w, bound: jackknife(root_mean_square, e),
    "median_bias": lambda e, w, bound: order_statistics(e),
    "robust_deviation": lambda e, w, bound: order_statistics(1.4826 * np.abs(e - np.median(e))),
    "standard_error": lambda e, w, bound: jackknife(root_mean_square, w[np.isfinite(w)]),
    "error_ratio": lambda e, w, bound: jackknife(
        lambda e, w: root_mean_square(w) / deviation(e), e[np.isfinite(w)], w[np.isfinite(w)]
    ),
    "coverage": lambda e, w, bound: binomial(np.abs(e) <= np.full(len(e), 1.959964) * w),
    "efficiency": lambda e, w, bound: jackknife(lambda e: 100.0 * bound / np.mean(e**2), e),
}
OF_ESTIMATES = {
    "percent": lambda: binomial((np.abs(VALUES[:, 3] - 1.5) <= 0.015) & (STATUS != "FAILED")),
    "cpu": lambda: order_statistics(SECONDS),
    "cpu_90": lambda: order_statistics(SECONDS, 0.9),
    "h2": lambda: order_statistics(distances(lambda x: np.sqrt(np.trapezoid(np.abs(x) ** 2, GRID)))),
    "hinf": lambda: order_statistics(distances(lambda x: np.abs(x).max())),
    "response:2": lambda: order_statistics(distances(lambda x: np.abs(x[GRID == 2.0][0]))),
    "fresh_fit": lambda: order_statistics(np.where(STATUS != "FAILED", FRESH, -np.inf)),
}
WITHOUT = {"standard_error": 23, "error_ratio": 23}
WITHOUT_MODEL = {"h2": 3, "hinf": 3, "response:2": 3, "fresh_fit": 3}


def measure_rows(results, names):
    return records_of(measure_frame(results, names))


def found_in(row):
    return np.array([np.nan if row[key] is None else row[key] for key in ("value", "error", "low", "high")])


@pytest.mark.parametrize("name", OF_ERRORS)
def test_a_measure_of_errors_is_what_it_says(results, name):
    bounds = least_variances(results.plan, 0, 0)
    rows = measure_rows(results, [name])
    assert [row["parameter"] for row in rows] == list(NAMES)
    for k, row in enumerate(rows):
        e, w = (VALUES - TRUTH)[COUNTED, k], WIDTHS[COUNTED, k]
        assert found_in(row) == pytest.approx(OF_ERRORS[name](e, w, bounds[NAMES[k]]), rel=1e-6, nan_ok=True)
        assert (row["n"], row["failed"], row["without_value"]) == (RUNS, 3, WITHOUT.get(name, 4))


@pytest.mark.parametrize("name", OF_ESTIMATES)
def test_a_measure_of_estimates_is_what_it_says(results, name):
    (row,) = measure_rows(results, [name])
    assert found_in(row) == pytest.approx(OF_ESTIMATES[name](), rel=5e-4)
    assert (row["n"], row["failed"], row["without_value"]) == (RUNS, 3, WITHOUT_MODEL.get(name, 0))


def test_failures_and_poles_are_what_they_say(results):
    failures = measure_rows(results, ["failures"])
    assert [row["parameter"] for row in failures] == ["FAILED", "MAX_ITERATIONS"]
    for row in failures:
        assert found_in(row) == pytest.approx(binomial(row["parameter"] == STATUS))
    upper = np.array([np.roots([1.0, *VALUES[k, :2]])[0] for k in COUNTED]) - np.roots([1.0, 2.8, 4.0])[0]
    for row, errors in zip(measure_rows(results, ["rmse:poles"]), (upper.real, upper.imag), strict=True):
        assert found_in(row) == pytest.approx(jackknife(root_mean_square, errors))


def test_every_measure_of_the_page_is_computed_here():
    page = (Path(__file__).parents[2] / "docs" / "measures.md").read_text(encoding="utf-8")
    table = page.split("|:--|:--|:--|\n")[1].split("\n\n")[0]
    named = {name.split(":")[0] for line in table.splitlines() for name in re.findall(r"`(\S+?)`", line.split("|")[1])}
    computed = {name.split(":")[0] for name in (*OF_ERRORS, *OF_ESTIMATES)} | {"failures"}
    assert named == computed == set(MEASURES)
