"""Tests of Monte Carlo measures against theory: power, and false alarms."""

import numpy as np
import pytest

from ctid_cli.inference.monte_carlo import MEASURES, Sample
from ctid_cli.inference.monte_carlo_tests import MEASURED, departures


def departed(n=400, shift=0.0, width=1.0, scale=1.0):
    """Return departures by kind, for normal errors with a theoretical standard deviation of 1."""
    errors = shift + scale * np.random.default_rng(3).standard_normal(n)
    sample = Sample(errors, np.full(n, width), bound=1.0)
    measured = {name: MEASURES[name].compute(sample) for name in MEASURED}
    return {each.kind: each for each in departures(measured, n, n)}


def test_errors_as_theory_has_them_depart_by_nothing():
    found = departed()
    assert {"bias", "coverage", "rmse"} < found.keys()
    assert min(each.p_value for each in found.values()) > 0.05
    assert departed(n=49) == {}


@pytest.mark.parametrize(
    ("given", "kind", "size"),
    [
        ({"shift": 1.0}, "bias", 1.0),
        ({"width": 0.5}, "small", 2.0),
        ({"width": 2.0}, "large", 2.0),
        ({"width": 0.5}, "coverage", 32.7),
        ({"scale": 2.0}, "rmse", 2.0),
    ],
)
def test_a_departure_is_found_with_its_size(given, kind, size):
    found = departed(**given)[kind]
    assert found.p_value < 1e-4
    assert found.size == pytest.approx(size, rel=0.1)
