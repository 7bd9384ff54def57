import math

import pytest

from ctid_cli.reporting.estimate import parameters

FIT = {
    "numerator": [-6400.0, 1600.0],
    "denominator": [1.0, 5.0, 408.0, 416.0, 1600.0],
    "delay": 8.0,
    "standard_errors": {"b0": 64.0, "b1": None, "a1": 0.5, "a2": 4.0, "a3": 4.0, "a4": 16.0, "delay": 0.01},
}


def test_intervals_are_symmetric_and_missing_where_there_is_no_error():
    found = {item.name: item for item in parameters(FIT, [0, 15])}
    assert found["b0"].relative_percent == pytest.approx(1.0)
    assert (found["b0"].low + found["b0"].high) / 2 == pytest.approx(-6400)
    assert all(math.isnan(value) for value in (found["b1"].low, found["b1"].relative_percent))


@pytest.mark.parametrize(
    ("delay", "bounds", "status"), [(8.0, [0, 15], "free"), (15.0, [0, 15], "at bound"), (0.0, None, "fixed")]
)
def test_the_delay_is_free_fixed_or_at_a_bound(delay, bounds, status):
    assert parameters(FIT | {"delay": delay}, bounds)[-1].status == status


def test_an_estimate_without_a_model_has_no_parameters():
    assert parameters({"numerator": None, "denominator": None, "standard_errors": None}) == []


SUBMODELS = {
    "numerator": [2.0, 3.0],
    "denominator": [1.0, 5.0, 4.0, 0.0, 0.0],
    "delay": 0.5,
    "parameters": {"g1_b0": 2.0, "g1_b3": 0.1, "g2_a1": 3.0},
    "standard_errors": {"g1_b0": 0.1, "g2_a1": 0.3},
}


def test_what_was_estimated_as_a_sum_is_shown_as_a_sum_only():
    found = {item.name: item for item in parameters(SUBMODELS)}
    # Two integrators, in the first submodel.
    units = {"g1_b0": "out/in/s^2", "g1_b3": "out/in*s", "g2_a1": "s", "delay": "s"}
    assert {name: item.unit for name, item in found.items()} == units
    both = parameters(SUBMODELS | {"standard_errors": {"b0": 0.1, "g2_a1": 0.3}})
    assert [item.name for item in both] == ["b0", "b1", "a1", "a2", "a3", "a4", *SUBMODELS["parameters"], "delay"]
