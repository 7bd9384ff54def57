"""Sensitivities of both forms against each other, and covariances of records of given length."""

import numpy as np
import pytest
from scipy.linalg import toeplitz

from ctid_cli.inference.bounds import finite_record_covariance
from ctid_cli.inference.sensitivities import sensitivities
from ctid_cli.models.additive import AdditiveModel, Submodel
from ctid_cli.models.factoring import unfactored, unfactored_jacobian
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.noise import ArmaNoise

MODES = AdditiveModel([Submodel([3.0], [0.25, 0.25, 1.0]), Submodel([0.1, 1.0], [0.025, 0.01, 1.0])], 0.13)


def held(hold="zoh"):
    rng = np.random.default_rng(3)
    return HeldSignal(np.arange(0.0, 20.0, 0.25), rng.standard_normal(80), hold)


def clock(regular):
    return 0.05 * np.arange(400) if regular else np.cumsum(np.random.default_rng(1).uniform(0.01, 0.09, 400))


@pytest.mark.parametrize("regular", [True, False])
@pytest.mark.parametrize("zeros", [None, 3])
def test_the_two_forms_obey_the_chain_rule(zeros, regular):
    signal, times = held(), clock(regular)
    model = AdditiveModel([Submodel([3.0], [0.25, 0.25, 1.0]), Submodel([1.0], [0.025, 0.01, 1.0])], 0.13)
    psi = sensitivities(unfactored(model), signal, times, zeros)
    jacobian = unfactored_jacobian(model)
    assert np.abs(jacobian[4]).max() == 0.0  # there is no b of degree 3 in the sum
    chained = psi @ (np.delete(jacobian, 4, axis=0) if zeros is None else jacobian)
    expected = sensitivities(model, signal, times)
    assert (np.abs(chained - expected).max(axis=0) < 1e-9 * np.abs(expected).max(axis=0)).all()


def test_covariance_is_the_double_sum_over_all_pairs_of_samples():
    psi = sensitivities(MODES, held(), clock(True))
    noise = ArmaNoise(numerator=(1.0, 0.5), denominator=(1.0, -0.85), innovation_variance=0.02)
    autocovariances = noise.autocovariance(np.arange(400))
    inverse = np.linalg.inv(psi.T @ psi)
    expected = inverse @ psi.T @ toeplitz(autocovariances) @ psi @ inverse
    deviations = np.sqrt(np.diag(expected))
    covariance = finite_record_covariance(psi, autocovariances)
    assert np.abs((covariance - expected) / np.outer(deviations, deviations)).max() < 1e-9
    # Lags beyond the record have no effect, and missing ones are zero.
    np.testing.assert_allclose(finite_record_covariance(psi, noise.autocovariance(np.arange(900))), covariance)
    padded = np.append([0.3, 0.1], np.zeros(398))
    np.testing.assert_allclose(
        finite_record_covariance(psi, [0.3, 0.1]), finite_record_covariance(psi, padded), rtol=1e-9
    )


def test_covariance_is_undefined_where_the_data_say_nothing():
    assert np.isnan(finite_record_covariance(np.ones((50, 2)), 1.0)).all()
    assert np.isnan(finite_record_covariance(np.zeros((50, 2)), [1.0, 0.5])).all()
    assert np.isnan(finite_record_covariance(np.ones((1, 2)), 1.0)).all()
