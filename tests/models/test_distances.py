"""Distances between models against quadrature and dense grids."""

import numpy as np
import pytest
from scipy.integrate import quad

from ctid_cli.models.distances import h2_distance, hinf_distance, response_distance
from ctid_cli.models.transfer_function import TransferFunction

SYSTEM = TransferFunction([2], [0.25, 0.7, 1], delay=1.0)


@pytest.mark.parametrize(
    "model",
    [
        TransferFunction([2.1], [0.25, 0.7, 1], delay=1.0),
        TransferFunction([2], [0.25, 0.7, 1], delay=1.3),
        TransferFunction([0.3, 2], [0.2, 0.8, 1], delay=0.6),
        TransferFunction([1, 2], [1, 6, 12, 8], delay=1.0),  # a triple pole
    ],
)
def test_the_h2_norm_is_that_of_frequency_responses(model):

    def squared(w, other):
        gain = SYSTEM.frequency_response(w) - (0.0 if other is None else other.frequency_response(w))
        return float(np.abs(gain) ** 2)

    parts = [quad(squared, 0.0, np.inf, args=(other,), limit=500)[0] for other in (model, None)]
    assert h2_distance(SYSTEM, model) == pytest.approx(np.sqrt(parts[0] / parts[1]), rel=1e-5)


def test_the_largest_error_of_the_frequency_response():
    model = TransferFunction([2.2], [0.25, 0.01, 1.0], delay=1.0)  # a resonance far narrower than the grid
    w = np.concatenate([np.linspace(0.0, 30.0, 20_001), np.linspace(1.98, 2.02, 40_001)])
    largest = np.abs(model.frequency_response(w) - SYSTEM.frequency_response(w)).max()
    expected = largest / np.abs(SYSTEM.frequency_response(w)).max()
    assert hinf_distance(SYSTEM, model) == pytest.approx(expected, rel=1e-3)


def test_nothing_is_nearer_than_the_system_and_nothing_farther_than_an_unstable_model():
    assert h2_distance(SYSTEM, SYSTEM) < 1e-7
    assert hinf_distance(SYSTEM, SYSTEM) == response_distance(SYSTEM, SYSTEM, 2.0) == 0.0
    unstable = TransferFunction([1], [1, -1])
    assert h2_distance(SYSTEM, unstable) == hinf_distance(SYSTEM, unstable) == np.inf
    doubled = TransferFunction([4], [0.25, 0.7, 1], delay=1.0)
    for distance in (h2_distance, hinf_distance):
        assert distance(SYSTEM, doubled) == pytest.approx(1.0)
    assert response_distance(SYSTEM, doubled, 3.0) == pytest.approx(1.0)
