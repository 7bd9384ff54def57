"""Experiments with several inputs: sum of single-input data sets, and estimates under the names of all inputs."""

import numpy as np
import pytest

from ctid_cli.canonical import plain
from ctid_cli.errors import SpecError
from ctid_cli.running.plan import build_plan
from ctid_cli.running.trial import load_tried
from ctid_cli.specification.load import load_spec
from ctid_cli.storage.manifest import true_values
from ctid_cli.storage.truth import found_of_rows

FIRST = {
    "system": {"numerator": [2.0], "denominator": [1.0, 1.0], "delay": 0.3},
    "excitation": {"kind": "gaussian", "standard_deviation": 1.0, "clock_period": 0.3},
}
SECOND = {**FIRST, "system": {"numerator": [-1.5], "denominator": [1.0, 0.6], "delay": 0.5}}
OF_ONE = {"kind": "delay_profile", "poles": 1, "zeros": 0, "delay_bounds": [0.3, 0.3]}
OF_TWO = {**OF_ONE, "inputs": [{"name": "u1", "poles": 1}, {"name": "u2", "poles": 1, "delay_bounds": [0.5, 0.5]}]}
REST = {
    "experiment": "test",
    "sampling": {"kind": "regular", "interval": 0.1, "samples": 300},
    "noise": {"kind": "white", "variance": 0.01},
    "monte_carlo": {"runs": 2, "seed": 1},
}


def spec(estimator=OF_TWO, second=SECOND, **changed):
    return {**REST, "inputs": {"u1": FIRST, "u2": second}, "estimators": {"here": estimator}, **changed}


def one_input(driven):
    return {**REST, **driven, "estimators": {"here": OF_ONE}}


def fitted(experiment):
    plan = build_plan(load_spec(experiment))
    cell, data = plan.data_cells[0], plan.data_cells[0].dataset(0)
    fit = plan.estimators[0].estimator.fit(data.record)
    return data, fit, found_of_rows([plain(data.result_of(fit, None, None))], true_values({"content": cell.content}))


def test_a_second_response_of_nothing_leaves_the_experiment_with_one_input():
    nothing = {**SECOND, "system": {**SECOND["system"], "numerator": [1e-30]}}
    fixed = [{"name": "u2_a1", "value": 0.6}, {"name": "u2_b0", "value": 0.0}]
    data, both, values = fitted(spec({**OF_TWO, "fixed": fixed}, nothing))
    alone, one, of_one = fitted(one_input(FIRST))
    np.testing.assert_array_equal(data.record.held["u1"].values, alone.record.input.values)
    np.testing.assert_allclose(data.record.y, alone.record.y, rtol=1e-12)
    assert both.cost == pytest.approx(one.cost, rel=1e-9)
    names = list(true_values({"content": build_plan(load_spec(spec())).data_cells[0].content}))
    own = [names.index("u1_a1"), names.index("u1_b0")]
    np.testing.assert_allclose(values.values[0, own], of_one.values[0, :2], rtol=1e-6)
    np.testing.assert_allclose(values.standard_errors[0, own], of_one.standard_errors[0, :2], rtol=0.01)


def test_outputs_add_up_and_inputs_have_random_numbers_of_their_own():
    data = build_plan(load_spec(spec(noise=None))).data_cells[0].dataset(1)
    u1, u2 = (signal.values for signal in data.record.held.values())
    assert abs(np.corrcoef(u1, u2)[0, 1]) < 0.3
    parts = data.true_model.parts
    assert list(parts) == ["u1", "u2"]
    assert (parts["u2"].delay, data.true_model.common) == (0.5, False)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"inputs": {"u1": FIRST}}, "inputs are two or more"),
        ({"system": FIRST["system"]}, "system: is given for each input in inputs"),
        ({"loop": {"controller": {"pid": {"kp": 1.0}}}}, "loop: closes around one input"),
        ({"inputs": {"u1": FIRST, "u2": {**SECOND, "system": {"additive": []}}}}, "is for a system with one input"),
        ({"estimators": {"here": {**OF_ONE, "inputs": [{"name": "u3"}]}}}, "there is no input 'u3'"),
        ({"estimators": {"here": {"kind": "srivc", "poles": 1, "zeros": 0}}}, "this is available for one input only"),
        ({"estimators": {"here": {**OF_TWO, "zeros": 1, "poles": 2}}}, None),
    ],
)
def test_what_does_not_go_with_several_inputs_is_refused(changed, message):
    if message is None:
        assert load_tried(spec(**changed)).inputs is not None
        return
    with pytest.raises(SpecError, match=message):
        load_tried(spec(**changed))
