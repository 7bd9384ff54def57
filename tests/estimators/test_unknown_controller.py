"""Unstable plants in a loop with an unknown controller: two routes, derivatives, and noise of any colour."""

from dataclasses import replace

import numpy as np
import pytest

from ctid_cli.errors import DataError, OptionError
from ctid_cli.estimators.delay_profile import DelayProfile
from ctid_cli.estimators.loop_output_error import LoopOutputError
from ctid_cli.filtering.loop import loop_radius, stabilising_controller
from ctid_cli.inference.fit import Status
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.record import Loop
from tests.estimators.test_loop_output_error import PD, PI, STABLE, UNSTABLE, record

TRUE = {"a1": 0.0, "a2": -1.0, "b0": 4.0}
THETA = np.array([0.05, -1.1, 4.2, 0.0])


def alone(one):
    """Return a record without its loop."""
    return replace(one, loop=None, feedback=True)


def assert_near_the_truth(fit):
    assert fit.status is Status.CONVERGED
    for name, value in TRUE.items():
        assert abs(fit.parameters[name] - value) < 3.5 * fit.standard_errors[name], name


@pytest.mark.parametrize("delay", [0.0, 0.13])
def test_a_controller_that_stabilises_an_unstable_plant(delay):
    plant = TransferFunction([4.0], [1.0, 0.2, -1.0], delay)
    assert loop_radius(plant, stabilising_controller(plant, 0.05), 0.05) < 1.0


def test_a_plant_whose_response_overflows_is_not_admissible():
    problem = LoopOutputError(2, 0).prepare(alone(record(UNSTABLE, PD))).laid_out.problem.around(THETA)
    assert np.isfinite(problem.squared_error(THETA))
    assert problem.squared_error(np.array([-1e5, 1.0, 1.0, 0.0])) == np.inf


def test_a_stable_plant_is_that_of_the_output_error_in_open_loop():
    one = alone(record(STABLE, PI, noise=0.1, count=800))
    options = {"initial_state": "estimate", "offset": "estimate", "covariance": "white"}
    found, opened = LoopOutputError(2, 0, **options).fit(one), DelayProfile(2, 0, (0.0, 0.0), **options).fit(one)
    for name in ("a1", "a2", "b0", "offset"):
        assert found.parameters[name] == pytest.approx(opened.parameters[name], rel=1e-4)
        assert found.standard_errors[name] == pytest.approx(opened.standard_errors[name], rel=0.02)
    assert found.cost == pytest.approx(opened.cost, rel=1e-6)


def test_innovations_do_not_depend_on_the_controller():
    problem = LoopOutputError(2, 0).prepare(alone(record(UNSTABLE, PD, noise=0.1, count=300))).laid_out.problem
    own, other = problem.around(THETA), problem._with(PD)
    first, second = own.columns(THETA), other.columns(THETA)
    np.testing.assert_allclose(first.left, second.left, atol=1e-6)
    np.testing.assert_allclose(first.slopes, second.slopes, atol=1e-4 * np.abs(first.slopes).max())


def test_derivatives_of_innovations_are_those_of_central_differences():
    problem = LoopOutputError(2, 0).prepare(alone(record(UNSTABLE, PD, noise=0.1, count=300))).laid_out.around(THETA)
    slopes = problem.columns(THETA).slopes
    for j, unit in enumerate(1e-5 * np.eye(4)[:3]):
        above, below = (problem.columns(THETA + step, 0).left for step in (unit, -unit))
        np.testing.assert_allclose(slopes[:, j], (below - above) / 2e-5, atol=1e-4 * np.abs(slopes[:, j]).max())


def test_unstable_plant_without_controller_and_reference():
    one = record(UNSTABLE, PD, noise=0.1, count=1500)
    fit = LoopOutputError(2, 0).fit(alone(one))
    assert_near_the_truth(fit)
    known = LoopOutputError(2, 0).fit(one)
    assert all(fit.standard_errors[name] < 1.2 * known.standard_errors[name] for name in TRUE)


def test_coloured_noise_needs_a_noise_model():
    one = record(UNSTABLE, PD, noise=0.1, count=2500, colour=0.9, seed=3)
    unmodelled = LoopOutputError(2, 0).fit(alone(one))
    assert unmodelled.law.kind == "biased"
    assert np.isnan(list(unmodelled.standard_errors.values())).all()
    joint = LoopOutputError(2, 0, noise_model="arma:1,0").fit(alone(one))
    assert_near_the_truth(joint)
    assert joint.noise.noise.denominator[1] == pytest.approx(-0.9, abs=0.05)


def test_options_that_an_unknown_controller_excludes():
    one = record(UNSTABLE, PD, count=300)
    with pytest.raises(OptionError, match="one known value"):
        LoopOutputError(2, 0, (0.0, 0.1)).fit(alone(one))
    with pytest.raises(DataError, match="leave the reference out"):
        LoopOutputError(2, 0).fit(replace(one, loop=Loop(one.loop.reference, None)))
    with pytest.raises(OptionError, match="without controller"):
        LoopOutputError(2, 0, noise_model="auto").fit(one)
