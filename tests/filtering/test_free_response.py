"""Free responses: against matrix exponentials, and their sensitivities against differences."""

import numpy as np
import pytest
from scipy.linalg import companion, expm

from ctid_cli.filtering.submodels import free_response, free_response_size
from ctid_cli.models.additive import AdditiveModel, Term

#: Degrees, then a_1 … a_n, b_0 … b_m of each submodel in turn.
SUMS = {
    "real pole": ([Term(1, 0)], [0.7, 2.0]),
    "third order, biproper": ([Term(3, 3)], [0.8, 0.35, 0.1, 1.0, 0.3, -0.05, 0.2]),
    "two modes": ([Term(2, 0), Term(2, 1)], [0.1, 0.25, 2.0, 0.01, 0.05, 0.4, 0.02]),
    "drive": ([Term(2, 0), Term(1, 1, 1)], [0.1, 0.25, 2.0, 0.6, 0.3, 0.1]),
    "rigid body": ([Term(2, 0), Term(0, 0, 2), Term(1, 1)], [0.1, 0.25, 2.0, 0.03, 0.7, 2.0, 0.4]),
    "three integrators": ([Term(1, 1, 3)], [0.7, 0.002, 0.001]),
    "gain": ([Term(1, 0), Term(0, 0), Term(2, 0)], [0.7, 2.0, 5.0, 0.1, 0.25, 2.0]),
}
ALL_SUMS = pytest.mark.parametrize(("terms", "theta"), SUMS.values(), ids=SUMS.keys())
#: Any instants.
ELAPSED = np.array([0.0, 0.01, 0.5, 0.7, 1.9, 4.0, 11.3])


def initial(terms):
    return np.random.default_rng(3).standard_normal(free_response_size(terms))


def by_exponentials(theta, free, terms):
    """Return the impulse response of C/(p^l A) of each submodel, from its companion matrix."""
    total = np.zeros(ELAPSED.size)
    for part in AdditiveModel.from_theta(theta, terms).submodels:
        n = part.order
        if not n:
            continue
        c, free = free[:n], free[n:]
        whole = np.append(part.denominator, np.zeros(part.integrators)) / part.denominator[0]
        matrix = companion(whole)
        total += [c[::-1] @ expm(matrix * t)[:, 0] / part.denominator[0] for t in ELAPSED]
    return total


@ALL_SUMS
def test_response_is_that_of_the_matrix_exponential(terms, theta):
    theta, free = np.array(theta), initial(terms)
    x, _, by_free = free_response(theta, free, terms, ELAPSED)
    expected = by_exponentials(theta, free, terms)
    np.testing.assert_allclose(x, expected, atol=1e-11 * np.abs(expected).max())
    # The response is linear in its free parameters.
    np.testing.assert_allclose(by_free @ free, x, atol=1e-12 * np.abs(expected).max())


def test_repeated_poles_are_the_limit_of_separate_ones():
    # C/A with A = (1 + p)^2 and C = 1 + p: exp(-t).
    theta, free = np.array([2.0, 1.0, 1.0]), np.ones(2)
    x, by_theta, by_free = free_response(theta, free, [Term(2, 0)], ELAPSED)
    np.testing.assert_allclose(x, np.exp(-ELAPSED), atol=1e-13)
    near, near_theta, near_free = free_response(theta + np.array([1e-4, 0, 0]), free, [Term(2, 0)], ELAPSED)
    for one, other in ((x, near), (by_theta, near_theta), (by_free, near_free)):
        np.testing.assert_allclose(one, other, atol=1e-3)
