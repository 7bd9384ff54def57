"""Measures of experiments: counted estimates, parameter names, and refusals."""

import numpy as np
import pytest

from ctid_cli.reporting.measures import default_measures, measure_frame, percentage_frame, records_of

DELAYS = (8.1, 7.9, 8.4)


@pytest.fixture
def results(make_results, estimate):
    found = [estimate(delay) for delay in DELAYS]
    return make_results({(5.0, "0.0"): [*found, estimate(None, status="FAILED")], (15.0, "0.0"): found})


def measure_rows(results, names):
    return records_of(measure_frame(results, names))


def rows_of(results, *names):
    return [row for row in measure_rows(results, names) if (row["snr_db"], row["initial_delay"]) == (5.0, 0.0)]


def test_a_row_says_of_what_and_of_how_many(results):
    (row,) = (row for row in rows_of(results, "bias") if row["parameter"] == "delay")
    assert row == {
        "table": "useful-redundancy/case1-regular",
        "experiment": "useful-redundancy/case1-regular",
        "sampling": "regular",
        "snr_db": 5.0,
        "initial_delay": 0.0,
        "method": "existing",
        "parameter": "delay",
        "measure": "bias",
        "unit": "s",
        "n": 4,
        "failed": 1,
        "without_value": 1,
        "value": pytest.approx(np.mean(DELAYS) - 8.0),
        "error": pytest.approx(np.std(DELAYS, ddof=1) / np.sqrt(3)),
        "low": pytest.approx(-0.49183, abs=1e-4),  # Student's quantile is 4.303
        "high": pytest.approx(0.75849, abs=1e-4),
    }
    units = {row["parameter"]: row["unit"] for row in rows_of(results, "mse")}
    assert units == {"a1": "(1/s)^2", "a2": "(1/s^2)^2", "b0": "(out/in/s^2)^2", "delay": "(s)^2"}


def test_measures_come_for_every_planned_cell_in_the_order_asked_for(results):
    rows = measure_rows(results, ["rmse", "percent"])
    places = [*percentage_frame(results)[["snr_db", "initial_delay"]].itertuples(index=False, name=None)]
    assert list(dict.fromkeys((row["snr_db"], row["initial_delay"]) for row in rows)) == places
    assert [row["measure"] for row in rows_of(results, "rmse", "percent")] == ["rmse"] * 4 + ["percent"]
    empty = [row for row in rows if row["initial_delay"] == "random"]
    assert {(row["n"], row["value"], row["parameter"]) for row in empty} == {(0, None, None)}


def test_coefficients_go_together_by_their_power(make_results, estimate):
    # Model b0 p + b1, true system b0; names of standard errors include the dropped leading zero.
    errors = {"a1": 0.1, "a2": 0.2, "b0": 9.0, "b1": 0.4, "delay": 0.01}
    two = [estimate(8.1, numerator=b, standard_errors=errors) for b in ((0.5, 8.3), (7.9,), (8.1,))]
    found = {row["parameter"]: row for row in rows_of(make_results({(5.0, "0.0"): two}), "bias", "coverage")}
    assert found["b0"]["value"] == 100.0
    assert found["b0"]["without_value"] == 0
    bias = {row["parameter"]: row["value"] for row in rows_of(make_results({(5.0, "0.0"): two}), "bias")}
    assert bias == pytest.approx({"a1": 0.0, "a2": 0.0, "b0": 0.1, "delay": 0.1})
    # In a model with another number of poles, only the delay has a true value.
    three = [estimate(8.1, denominator=(1.0, 2.0, 3.0, 4.0))] * 2
    found = rows_of(make_results({(5.0, "0.0"): three}), "bias")
    assert {row["parameter"]: row["without_value"] for row in found} == {"a1": 2, "a2": 2, "b0": 2, "delay": 0}


def test_a_delay_that_was_given_is_no_estimate(make_results, estimate):
    given = [estimate(8.0, numerator=(b,), standard_errors={"b0": 0.1}) for b in (8.1, 7.9)]
    assert [row["parameter"] for row in rows_of(make_results({(5.0, "0.0"): given}), "bias")] == ["a1", "a2", "b0"]


def test_one_parameter_or_the_poles_are_asked_for_by_name(make_results, estimate):
    # The true poles are -1.4 -+ 1.428j.
    found = [estimate(8.1, denominator=(1.0, 2.0 * x, x**2 + y**2)) for x, y in ((1.5, 1.4), (1.3, 1.5))]
    results = make_results({(5.0, "0.0"): [*found, estimate(8.0, denominator=(1.0, 2.0))]})
    assert [row["parameter"] for row in rows_of(results, "rmse:delay")] == ["delay"]
    poles = {row["parameter"]: row for row in rows_of(results, "bias:poles")}
    assert {name: row["value"] for name, row in poles.items()} == pytest.approx(
        {"pole_1_real": 0.0, "pole_1_imag": 1.45 - np.sqrt(4 - 1.4**2)}
    )
    assert {(row["unit"], row["n"], row["without_value"]) for row in poles.values()} == {("rad/s", 3, 1)}


def test_real_poles_are_matched_whatever_their_order(make_results, estimate):
    system = {"numerator": [6.0], "denominator": [1.0, 5.0, 6.0], "delay": 8.0}
    results = make_results({(5.0, "0.0"): [estimate(8.0, denominator=(1.0, 5.3, 6.72))] * 2})
    for cell in results.manifest["data_cells"]:
        cell["content"]["system"] = system
    values = {row["parameter"]: row["value"] for row in rows_of(results, "bias:poles")}
    assert values == pytest.approx({"pole_1": -0.2, "pole_2": -0.1})


def test_the_specification_sets_the_default(results, make_results):
    assert default_measures(results) == ()
    assert default_measures(make_results({}, success=None)) == ("bias", "rmse")
    assert default_measures(make_results({}, measures=["coverage"])) == ["coverage"]
