"""ARMA noise by exact likelihood: against dense covariance matrices, known coefficients and direct simulation."""

import numpy as np
import pytest
from scipy.linalg import toeplitz
from scipy.optimize import approx_fprime

from ctid_cli.errors import OptionError
from ctid_cli.inference.innovations import (
    SampledNoise,
    Whitener,
    all_arma,
    coefficient_slopes,
    fit_arma,
    restricted_dispersion,
    sampled,
    steps_of,
)
from ctid_cli.inference.noise_estimate import hausman, orders_of
from ctid_cli.signals.noise import ArmaNoise

SLOW = ArmaNoise((1.0, 0.2679), (1.0, -1.98, 0.9802), innovation_variance=1.0)
FAST = ArmaNoise((1.0, 0.9), (1.0, -1.0, 0.2), innovation_variance=1.0)
MOVING = ArmaNoise((1.0, 0.5, -0.3, 0.2), (1.0,), innovation_variance=1.0)
WHITE = ArmaNoise((1.0,), (1.0,), innovation_variance=1.0)


def drawn(noise, count, seed=0):
    return noise.generate(np.empty(count), np.random.default_rng(seed))


def deviance(noise, v, use):
    """Return ``-2 ln L`` with the variance eliminated, by the dense covariance matrix."""
    covariance = toeplitz(noise.autocovariance(np.arange(use.size)))[np.ix_(use, use)]
    return v.size * np.log(v @ np.linalg.solve(covariance, v) / v.size) + np.linalg.slogdet(covariance)[1]


@pytest.mark.parametrize("noise", [SLOW, FAST, MOVING, WHITE], ids=["slow", "fast", "moving", "white"])
@pytest.mark.parametrize("missing", [0, 40])
def test_whitening_is_that_of_the_dense_covariance_matrix(noise, missing):
    rng = np.random.default_rng(1)
    use = np.ones(150, dtype=bool)
    use[rng.choice(150, missing, replace=False)] = False
    covariance = toeplitz(noise.autocovariance(np.arange(150)))[np.ix_(use, use)]
    columns = rng.standard_normal((use.sum(), 3))
    white = SampledNoise(noise, steps_of(use)).whitened(columns)
    expected = np.linalg.solve(np.linalg.cholesky(covariance), columns)
    np.testing.assert_allclose(white, expected, rtol=1e-6, atol=1e-8 * np.abs(expected).max())
    whitener = Whitener(noise, 1)
    pieces = [whitener(columns[rows, 0][None].copy(), steps_of(use)[rows]) for rows in (slice(0, 41), slice(41, None))]
    np.testing.assert_allclose(np.hstack(pieces)[0], white[:, 0], rtol=1e-12)
    assert whitener.logarithm == pytest.approx(np.linalg.slogdet(covariance)[1], abs=1e-6)


@pytest.mark.parametrize(("noise", "orders"), [(SLOW, (2, 1)), (FAST, (2, 1)), (MOVING, (0, 3)), (WHITE, (0, 0))])
def test_the_likelihood_is_greatest(noise, orders):
    use = np.ones(400, dtype=bool)
    use[100:120] = False
    v = drawn(noise, 400)[use]
    fit = fit_arma([v], [steps_of(use)], orders)
    assert fit.orders == orders
    assert fit.deviance == pytest.approx(deviance(fit.noise, v, use), abs=1e-5)

    def at(coefficients):
        d, c = np.split(coefficients, [orders[0]])
        return deviance(ArmaNoise((1.0, *c), (1.0, *d), innovation_variance=1.0), v, use)

    if sum(orders):
        estimate = np.array([*fit.noise.denominator[1:], *fit.noise.numerator[1:]])
        gram = coefficient_gram(fit, v, use)
        errors, alone = np.sqrt(np.diag(np.linalg.inv(gram))), 1.0 / np.sqrt(np.diag(gram))
        # The deviance rises by one from its minimum if one coefficient alone changes by this error.
        assert np.abs(approx_fprime(estimate, at, 1e-4 * alone) * alone).max() < 0.02
        true = np.array([*noise.denominator[1:], *noise.numerator[1:]])
        assert np.abs((estimate - true) / errors).max() < 4


def coefficient_gram(fit, v, use):
    slopes = coefficient_slopes(fit.noise, [v], [steps_of(use)])
    return slopes.T @ slopes / np.exp(fit.deviance / fit.samples)


def test_slopes_by_the_coefficients_are_differences():
    v, use = drawn(FAST, 200), np.ones(200, dtype=bool)
    slopes = coefficient_slopes(FAST, [v], [steps_of(use)])

    def scaled(d1, d2, c1):
        noise = ArmaNoise((1.0, c1), (1.0, d1, d2), innovation_variance=1.0)
        whitener = Whitener(noise, 1)
        return whitener(v[None].copy(), steps_of(use))[0] * np.exp(whitener.logarithm / 400)

    for k, h in enumerate(1e-6 * np.eye(3)):
        at = np.array([-1.0, 0.2, 0.9])
        np.testing.assert_allclose(slopes[:, k], (scaled(*at + h) - scaled(*at - h)) / 2e-6, atol=1e-5)


def test_restricted_covariance_is_that_of_dense_matrices():
    """AR(1): the least criterion over a fine grid of the coefficient."""
    rng = np.random.default_rng(6)
    psi = np.column_stack((np.ones(60), np.cumsum(rng.standard_normal(60))))
    v = drawn(ArmaNoise((1.0,), (1.0, -0.8), innovation_variance=1.0), 60)
    fit = fit_arma([v], [steps_of(np.ones(60, dtype=bool))], (1, 0))
    found = restricted_dispersion(fit.noise, [psi], [v], [steps_of(np.ones(60, dtype=bool))])

    def dense(pole):
        inverse = np.linalg.inv(toeplitz(pole ** np.arange(60)) / (1.0 - pole**2))
        gram = psi.T @ inverse @ psi
        rest = v - psi @ np.linalg.solve(gram, psi.T @ inverse @ v)
        square = float(rest @ inverse @ rest)
        criterion = 58 * np.log(square) - np.linalg.slogdet(inverse)[1] + np.linalg.slogdet(gram)[1]
        return criterion, square / 58 * np.linalg.inv(gram)

    poles = np.linspace(0.3, 0.99, 2000)
    best = min((dense(pole) for pole in poles), key=lambda each: each[0])[1]
    np.testing.assert_allclose(found.covariance, best, rtol=0.01)
    criteria = np.array([dense(pole)[0] for pole in poles])
    # Along z = artanh(pole), two standard deviations raise the criterion by about 4.
    z, least = np.arctanh(poles), criteria.argmin()
    inside = (criteria < criteria[least] + 0.01) & (np.abs(z - z[least]) < 0.2)
    deviation = (z[inside][-1] - z[inside][0]) / 2 / 0.1
    (slope,) = np.gradient([np.log(dense(pole)[1][0, 0]) for pole in np.tanh(z[least] + np.array([-0.01, 0, 0.01]))])[
        1:2
    ]
    change = found.variation[1][0, 0] / found.covariance[0, 0]
    assert abs(change) == pytest.approx(deviation * slope / 0.01, rel=0.05)


def test_two_records_share_one_noise():
    """The joint deviance is that of a block-diagonal covariance matrix; one record twice has the same coefficients."""
    v = drawn(FAST, 300)
    steps = steps_of(np.ones(300, dtype=bool))
    one, two = fit_arma([v], [steps], (2, 1)), fit_arma([v, v], [steps, steps], (2, 1))
    np.testing.assert_allclose(two.noise.denominator, one.noise.denominator, rtol=1e-4)
    assert two.deviance == pytest.approx(2 * one.deviance, abs=1e-6)


def test_orders_of_least_bic():
    """A model fits at least as well as those that it contains, and the true orders are usually chosen."""
    found = []
    for seed in range(3):
        v = drawn(FAST, 1000, seed)
        fits = all_arma([v], [steps_of(np.ones(1000, dtype=bool))], {})
        assert len(fits) == 16
        assert all(fits[p, q].deviance <= fits[p - 1, q].deviance + 0.01 for p, q in fits if p)
        found.append(min(fits.values(), key=lambda fit: fit.bic).orders)
    assert found.count((2, 1)) >= 2


def test_predictions_across_missing_samples_are_conditional_means():
    use = np.ones(60, dtype=bool)
    use[[30, 31, 45]] = False
    v, covariance = drawn(FAST, 60)[use], toeplitz(FAST.autocovariance(np.arange(60)))
    places = np.flatnonzero(use)
    (noise,) = sampled(FAST, [use])
    for ahead in (1, 3):
        predicted = noise.predicted(v, ahead)
        for k in (5, 28, 30, 32, 50):
            known = places <= places[k] - ahead
            weights = np.linalg.solve(covariance[np.ix_(places[known], places[known])], v[known])
            assert predicted[k] == pytest.approx(covariance[places[k], places[known]] @ weights, abs=1e-9)


def test_hausman_has_its_level_and_leaves_out_what_is_not_gained():
    rng = np.random.default_rng(0)
    efficient = np.array([[2.0, 0.5, 0.1], [0.5, 1.0, 0.2], [0.1, 0.2, 3.0]])
    extra = np.array([[1.0, 0.4, 0.0], [0.4, 1.0, 0.0], [0.0, 0.0, 0.0]])
    root = np.linalg.cholesky(extra[:2, :2])
    p_values = []
    for _ in range(2000):
        found = hausman(np.append(root @ rng.standard_normal(2), 0.0), efficient + extra, efficient, 1e6)
        p_values.append(found.p_value)
    assert found.freedom == 2
    # Four standard deviations of a binomial.
    assert np.mean(np.array(p_values) < 0.05) == pytest.approx(0.05, abs=4 * np.sqrt(0.05 * 0.95 / 2000))
    assert hausman(np.ones(3), efficient, efficient, 10.0).freedom == 0


@pytest.mark.parametrize("text", ["arma", "arma:9,1", "arma:1", "arma:a,b", "ar:2", "AUTO", ""])
def test_noise_models_that_are_none(text):
    with pytest.raises(OptionError, match=r"white, auto or arma:P,Q with P poles and Q zeros, 0 to 8"):
        orders_of(text)
