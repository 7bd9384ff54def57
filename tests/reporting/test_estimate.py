import math

import pytest

from ctid_cli.reporting.estimate import parameters
from ctid_cli.storage.estimate_text import ESTIMATE_KEYS, as_object

FIT = {
    "numerator": [-6400.0, 1600.0],
    "denominator": [1.0, 5.0, 408.0, 416.0, 1600.0],
    "delay": 8.0,
    "standard_errors": {"b0": 64.0, "b1": None, "a1": 0.5, "a2": 4.0, "a3": 4.0, "a4": 16.0, "delay": 0.01},
}


def test_parameters_have_the_units_of_a_monic_denominator():
    units = {item.name: item.unit for item in parameters(FIT, [0, 15])}
    assert units == {
        "b0": "out/in/s^3",
        "b1": "out/in/s^4",
        "a1": "1/s",
        "a2": "1/s^2",
        "a3": "1/s^3",
        "a4": "1/s^4",
        "delay": "s",
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


def test_objects_have_the_documented_keys_first_and_keep_the_others():
    keys = list(as_object({"snr_db": 5, "delay": 8.0, "id": "x"}))
    assert tuple(keys[: len(ESTIMATE_KEYS)]) == ESTIMATE_KEYS
    assert keys[len(ESTIMATE_KEYS) :] == ["snr_db"]


SUBMODELS = {
    "numerator": [2.0, 3.0],
    "denominator": [1.0, 5.0, 4.0, 0.0, 0.0],
    "delay": 0.5,
    "parameters": {"g1_b0": 2.0, "g1_b1": 1.0, "g1_b2": 0.5, "g1_b3": 0.1, "g2_a1": 3.0, "g2_a2": 4.0, "g2_b1": 5.0},
    "standard_errors": {"g1_b0": 0.1, "g2_a1": 0.3},
}


def test_parameters_of_submodels_have_the_units_of_a_constant_term_of_one():
    found = {item.name: item for item in parameters(SUBMODELS)}
    # Two integrators, which belong to the first submodel; what was estimated as a sum is shown as a sum only.
    assert {name: item.unit for name, item in found.items()} == {
        "g1_b0": "out/in/s^2",
        "g1_b1": "out/in/s",
        "g1_b2": "out/in",
        "g1_b3": "out/in*s",
        "g2_a1": "s",
        "g2_a2": "s^2",
        "g2_b1": "out/in*s",
        "delay": "s",
    }
    assert found["g2_a1"].relative_percent == pytest.approx(10.0)
    assert math.isnan(found["g2_a2"].low)


def test_a_fraction_is_shown_as_such_and_as_a_sum():
    errors = {"b0": 0.1, "a1": 0.1, "g2_a1": 0.3}
    names = [item.name for item in parameters(SUBMODELS | {"standard_errors": errors})]
    assert names == ["b0", "b1", "a1", "a2", "a3", "a4", *SUBMODELS["parameters"], "delay"]


def test_parameters_of_submodels_come_before_the_errors_where_there_are_such():
    keys = list(as_object({"parameters": {}, "id": "x", "standard_errors": {}}))
    assert keys[keys.index("standard_errors") - 1] == "parameters"
    assert "parameters" not in as_object({"id": "x"})
