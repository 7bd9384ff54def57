"""Poles at 0 in addition to the searched ones, against simulations."""

import numpy as np
import pytest

from ctid_cli.estimation.optimum.projection import project, slopes
from ctid_cli.estimation.optimum.triangle import Delay
from ctid_cli.filtering.filter_data import filter_data
from ctid_cli.models.transfer_function import TransferFunction
from tests.estimation.optimum.dense import squared_error
from tests.estimation.optimum.systems import problem_of, record_of

SPEED, DAMPING = np.array([2.2, 0.4]), np.array([0.3, -1.0])
DENOMINATOR = np.convolve([1.0, 1.32, 4.84], [1.0, 0.4])
MODEL = [TransferFunction([1.0, 3.0], np.append([1.0, 1.3, 2.4], np.zeros(k)), 0.7) for k in range(3)]


@pytest.mark.parametrize("treatment", [{}, {"free_response": True}, {"offset": True}], ids=str)
@pytest.mark.parametrize("regular", [True, False])
@pytest.mark.parametrize("integrators", [1, 2])
@pytest.mark.parametrize("zeros", [0, 3])
def test_projection_is_that_of_dense_matrices(integrators, regular, zeros, treatment):
    record = record_of(MODEL[integrators], np.random.default_rng(1), noise=0.1, offset=0.3, regular=regular)
    problem = problem_of([filter_data(record)], zeros, integrators=integrators, **treatment)
    found = project(problem, SPEED, DAMPING, Delay(0.37, -1)).squared_error
    whole = np.append(DENOMINATOR, np.zeros(integrators))
    assert found == pytest.approx(squared_error(record, whole, zeros, 0.37, **treatment), rel=1e-8)


@pytest.mark.parametrize("free_response", [False, True])
@pytest.mark.parametrize("integrators", [1, 2])
def test_gradient_is_that_of_differences(integrators, free_response):
    record = record_of(MODEL[integrators], np.random.default_rng(2), noise=0.1)
    problem = problem_of([filter_data(record)], 2, integrators=integrators, free_response=free_response)

    def value(step):
        speed, damping = SPEED * np.exp([step[0], step[2]]), DAMPING * np.exp([step[1], 0.0])
        return project(problem, speed, damping, Delay(0.37 + step[3], -1)).squared_error

    here = Delay(0.37, -1)
    found = slopes(problem, SPEED, DAMPING, here, project(problem, SPEED, DAMPING, here), (0,))
    differences = [(value(step) - value(-step)) / 4e-5 for step in 1e-5 * np.eye(4)]
    np.testing.assert_allclose(found.gradient, differences, rtol=0, atol=1e-6 * np.abs(found.gradient).max())
