"""Output error of sums: against one transfer function, against simulation, and with known parameters."""

from dataclasses import replace

import numpy as np
import pytest

from ctid_cli.errors import DataError
from ctid_cli.estimation.common import Fixed, Start
from ctid_cli.estimators.additive_output_error import AdditiveOutputError
from ctid_cli.estimators.additive_srivc import AdditiveSrivc
from ctid_cli.estimators.delay_profile import DelayProfile
from ctid_cli.inference.fit import Status
from ctid_cli.models.additive import AdditiveModel, Submodel, Term
from tests.estimators.additive_records import MODE, TWO_MODES, open_record

ONE = AdditiveModel([Submodel([1.0, 3.0], [0.25, 0.25, 1.0])], 0.13)
TWO = AdditiveModel(TWO_MODES.submodels, 0.13)
TREATMENTS = {
    "at rest": {},
    "offset": {"offset": "estimate"},
    "state and drift": {"offset": "drift", "initial_state": "estimate"},
    "periodic": {"offset": "estimate", "initial_state": "periodic"},
    "robust": {"offset": "estimate", "loss": "huber"},
}


def with_level(record, level):
    return replace(record, y=record.y + level)


@pytest.mark.parametrize("name", TREATMENTS)
def test_a_sum_of_one_mode_is_the_transfer_function(name):
    treatment, count = TREATMENTS[name], 2 if name == "offset" else 1
    records = [with_level(open_record(ONE, 300, 0.1, seed), 0.5 * seed) for seed in range(count)]
    additive = AdditiveOutputError((Term(2, 1),), (0.0, 0.5), **treatment).fit(records)
    fraction = DelayProfile(2, 1, (0.0, 0.5), **treatment).fit(records)
    assert additive.cost == pytest.approx(fraction.cost, rel=1e-9)
    assert additive.status is fraction.status
    np.testing.assert_allclose(additive.model.denominator, fraction.model.denominator, rtol=1e-5)
    np.testing.assert_allclose(additive.model.numerator, fraction.model.numerator, rtol=1e-5)
    np.testing.assert_allclose(additive.initial_states, fraction.initial_states, rtol=1e-4, atol=1e-6)
    errors, others = additive.standard_errors, fraction.standard_errors
    for name in set(errors) & set(others):
        assert errors[name] == pytest.approx(others[name], rel=1e-4)


def test_at_a_known_delay_it_is_where_the_published_iteration_ends():
    record = open_record(TWO, 1000, 0.1, 3)
    optimum = AdditiveOutputError((MODE, MODE), (0.13, 0.13), covariance="white").fit(record)
    root = AdditiveSrivc((MODE, MODE), 0.13, tolerance=1e-12, covariance="white").fit(record)
    np.testing.assert_allclose(optimum.additive.theta, root.additive.theta, rtol=1e-6)


def test_the_delay_is_searched_and_every_parameter_is_near_the_truth():
    fit = AdditiveOutputError((MODE, MODE), (0.0, 2.0)).fit(open_record(TWO, 1000, 0.1, 4))
    assert fit.status is Status.CONVERGED
    for name, value in (*TWO.parameters.items(), ("delay", TWO.delay)):
        assert fit.parameters[name] == pytest.approx(value, abs=4 * fit.standard_errors[name])
    assert fit.consistency > 1.0
    assert fit.sampling > 1.0


def test_a_known_coefficient_keeps_its_value_and_moves_the_optimum_to_where_it_is_true():
    record = open_record(TWO, 600, 0.1, 7)
    options = AdditiveOutputError((MODE, MODE), (0.0, 0.5))
    free = options.fit(record)
    value = free.parameters["g1_b0"]
    near = replace(options, fixed=(Fixed("g1_b0", value), Fixed("g2_a2", free.parameters["g2_a2"]))).fit(record)
    assert near.parameters["g1_b0"] == value
    assert near.cost == pytest.approx(free.cost, rel=1e-9)
    assert np.isnan(near.standard_errors["g1_b0"]) or near.standard_errors["g1_b0"] == 0.0
    assert replace(options, fixed=(Fixed("g1_b0", 1.1 * value),)).fit(record).cost > free.cost


def test_a_start_of_other_submodels_is_refused():
    with pytest.raises(DataError, match="the start has the submodels"):
        AdditiveOutputError((MODE,)).fit(open_record(ONE, 100, 0.1, 8), Start(model=TWO))
