"""Faults of sensors and recorders planted in a sequence."""

import numpy as np
import pytest

from ctid_cli.inference.signal_features import growth_time, outliers, residual_outliers, saturated


def test_one_sample_in_twenty_may_be_an_outlier():
    rng = np.random.default_rng(0)
    y = rng.standard_normal(300)
    wild = 5 + 20 * np.arange(14)
    y[wild] += 50.0
    np.testing.assert_array_equal(outliers(y), wild)
    found, off = residual_outliers(y)
    np.testing.assert_array_equal(found, wild)
    assert off == pytest.approx(50.0, abs=5.0)


def test_a_few_samples_at_one_limit_are_cut_off():
    y = np.random.default_rng(3).standard_normal(400)
    limit = np.sort(y)[-6]
    assert saturated(y) == 0
    assert saturated(np.minimum(y, limit)) == 6 / 400
    # An output at rest before it moves may be below all later values.
    assert saturated(np.concatenate((np.full(40, y.min() - 1), y))) == 0


@pytest.mark.parametrize(("grown", "diverges"), [(np.exp, True), (lambda t: t**3, False), (np.sin, False)])
def test_only_exponential_growth_diverges(grown, diverges):
    t = np.linspace(0.0, 12.0, 600)
    y, u = grown(t), np.sin(3 * t)
    assert growth_time(t, y, u) == (pytest.approx(1.0, rel=0.05) if diverges else pytest.approx(np.nan, nan_ok=True))
    # An input that resumes after a pause does not count as growing.
    pausing = np.where((t > 7.5) & (t < 9.0), 0.0, u)
    assert np.isfinite(growth_time(t, y, pausing)) == diverges
    # Growth of the input explains growth of the output.
    assert np.isnan(growth_time(t, y, grown(t)))


def test_bursts_that_a_nonlinear_system_leaves_are_no_outliers():
    rng = np.random.default_rng(3)
    e = 0.02 * rng.standard_normal(5000)
    for start in (700, 2100, 4000):
        e[start : start + 100] += 2.0 * np.hanning(100) * np.sin(0.7 * np.arange(100))
    assert residual_outliers(e)[0].size == 0
    e[3000] += 9.0
    assert residual_outliers(e)[0].tolist() == [3000]
