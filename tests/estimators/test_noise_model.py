"""Plant and noise by maximum likelihood: against white noise, dense covariance matrices and a general optimiser."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import cholesky, solve_triangular, toeplitz
from scipy.optimize import least_squares
from scipy.signal import lfilter

from ctid_cli import DelayProfile, HeldSignal, Record, Rivc, TransferFunction, identify, simulate
from ctid_cli.errors import DataError, OptionError
from ctid_cli.estimation.noise_search import joint_near
from ctid_cli.inference.covariance import condition_number
from ctid_cli.inference.fit import Status
from ctid_cli.inference.sensitivities import sensitivities
from ctid_cli.running.plan import build_plan
from ctid_cli.running.theory import least_variances
from ctid_cli.signals.noise import ArmaNoise
from ctid_cli.specification.load import load_spec

SYSTEM = TransferFunction([4.0], [1.0, 2.8, 4.0], 0.537)
KNOWN = {"poles": 2, "zeros": 0, "delay_bounds": (0.537, 0.537)}
SLOW = ((1.0, 0.2679), (1.0, -1.98, 0.9802))
FAST = ((1.0, 0.9), (1.0, -1.0, 0.2))


def record_of(noise=FAST, seed=0, n=300, *, missing=0, offset=0.0):
    rng = np.random.default_rng(seed)
    t = 0.1 * np.arange(n)
    signal = HeldSignal(t, np.repeat(rng.choice([-1.0, 1.0], n // 5), 5))
    x = simulate(SYSTEM, signal, t)
    y = x + offset + ArmaNoise(*noise, snr_db=15.0).generate(x, rng)
    y[rng.choice(n, missing, replace=False)] = np.nan
    return Record(t, y, signal)


@pytest.mark.parametrize("known_delay", [True, False])
def test_arma_of_no_order_is_white_noise(known_delay):
    options = replace(DelayProfile(**KNOWN) if known_delay else DelayProfile(2, 0, (0.0, 2.0)), covariance="white")
    record = record_of(((1.0,), (1.0,)))
    white, arma = options.fit(record), replace(options, noise_model="arma:0,0").fit(record)
    np.testing.assert_allclose(arma.theta, white.theta, rtol=1e-12)
    np.testing.assert_allclose(arma.covariance, white.covariance, rtol=1e-9)
    assert arma.noise.noise.innovation_variance == pytest.approx(white.cost, rel=1e-12)
    assert arma.prediction_fit(1) == pytest.approx(white.prediction_fit(1), rel=1e-12)
    assert np.isnan(arma.noise.test.p_value)


@pytest.mark.parametrize(("noise", "orders"), [(FAST, (2, 1)), (SLOW, (2, 1))], ids=["fast", "slow"])
def test_a_general_optimiser_of_the_dense_likelihood_finds_nothing_better(noise, orders):
    """Two records with missing samples and offsets; all parameters of plant and noise at once."""
    records = [record_of(noise, seed, 120 + 30 * seed, missing=12, offset=seed) for seed in (1, 2)]
    options = DelayProfile(**KNOWN, offset="estimate", noise_model="arma:{},{}".format(*orders))
    fit = options.fit(records)
    assert fit.status is Status.CONVERGED
    count = sum(record.valid.sum() for record in records)

    def scaled(theta):
        plant, (a1, a2, b0), offsets = theta[:5], theta[:3], theta[3:5]
        d, c = np.split(theta[plant.size :], [orders[0]])
        law, parts, logarithm = ArmaNoise((1.0, *c), (1.0, *d), innovation_variance=1.0), [], 0.0
        for record, offset in zip(records, offsets, strict=True):
            use = record.valid
            root = cholesky(toeplitz(law.autocovariance(np.arange(use.size)))[np.ix_(use, use)], lower=True)
            x = simulate(TransferFunction([b0], [1.0, a1, a2], 0.537), record.input, record.t)
            parts.append(solve_triangular(root, (record.y - x - offset)[use], lower=True))
            logarithm += 2 * np.log(np.diag(root)).sum()
        return np.concatenate(parts) * np.exp(logarithm / (2 * count))

    arma = fit.noise.noise
    theta = np.array([*fit.theta, *arma.denominator[1:], *arma.numerator[1:]])
    own = scaled(theta)
    assert fit.noise.deviance == pytest.approx(count * np.log(own @ own / count), abs=1e-6)
    scale = np.sqrt([*np.diag(fit.covariance), *np.diag(fit.noise.covariance)])
    found = least_squares(lambda z: scaled(theta + scale * z), np.zeros(theta.size), xtol=1e-12, ftol=1e-14)
    assert count * np.log(2.0 * found.cost / count) > fit.noise.deviance - 1e-4
    assert np.abs(found.x).max() < 0.02


@pytest.mark.parametrize("missing", [0, 30])
def test_predictions_on_the_own_record_are_those_of_the_fit(missing):
    record = record_of(missing=missing)
    found = identify([record], Rivc(**KNOWN, offset="estimate", noise_model="arma:2,1"))
    used, (errors,) = found.fit.used[0], found.fit.residuals
    assert np.isnan(found.predict(record)[~used]).all()
    for ahead in (1, 5):
        left = record.y[used] - found.predict(record, ahead)[used]
        spread = np.linalg.norm(record.y[used] - record.y[used].mean())
        expected = 100.0 * (1.0 - np.linalg.norm(left) / spread)
        assert found.fit.prediction_fit(ahead) == pytest.approx(expected, rel=1e-5)
    # The innovations are the one-step prediction errors over their standard deviations, which settle immediately.
    (innovations,) = found.fit.linear.residuals
    if not missing:
        np.testing.assert_allclose((record.y - found.predict(record))[50:], innovations[50:], atol=1e-4)
    # Long-horizon predictions equal the simulated output.
    np.testing.assert_allclose(found.predict(record, 200)[used][-50:], (record.y[used] - errors)[-50:], atol=1e-4)
    with pytest.raises(OptionError, match="ahead"):
        found.predict(record, 0)


def test_the_noise_model_is_chosen_and_increases_the_accuracy():
    found = identify([record_of(SLOW, n=600)], Rivc(2, 0, (0.0, 2.0)))
    assert found.fit.noise.chosen
    assert found.fit.noise.orders == (2, 1)
    errors = np.array([*SYSTEM.denominator[1:], *SYSTEM.numerator, SYSTEM.delay]) - found.fit.theta
    assert np.abs(errors / np.sqrt(np.diag(found.fit.covariance))).max() < 4
    assert (found.fit.noise.output_error_errors / np.sqrt(np.diag(found.fit.covariance)) > 5).all()
    assert found.tests[0].white
    assert found.fit.prediction_fit(1) > found.fit.prediction_fit(10) > found.fit.fit_percent
    assert found.criteria.parameters == 7
    assert condition_number(np.linalg.inv(found.uncertainty.covariance)) < 1e6


@pytest.mark.slow
def test_a_larger_plant_is_no_less_likely():
    """A record for which a further zero moves the minimum output error to a basin caused by the noise."""
    record, options = record_of(seed=4, n=150, offset=1.0), {"offset": "estimate", "noise_model": "arma:2,1"}
    fits = [DelayProfile(n, m, (0.0, 2.0), **options).fit(record) for n, m in ((1, 0), (2, 0), (2, 1))]
    deviances = [fit.noise.deviance for fit in fits]
    assert deviances[0] + 1e-4 > deviances[1] > deviances[2] - 1e-4


EXPERIMENT = """
experiment: noise
system:     {numerator: [4], denominator: [1, 2.8, 4], delay: 0.537}
excitation: {kind: prbs, stages: 6, clock_period: 0.3, amplitude: 1.0}
sampling:   {kind: regular, interval: 0.1, samples: 200}
noise:      {kind: arma, numerator: [1, 0.2679], denominator: [1, -1.98, 0.9802], innovation_variance: 1.0e-6}
estimators:
  one: {kind: rivc, poles: 2, zeros: 0, delay_bounds: [0, 2], noise_model: "arma:2,1"}
monte_carlo: {runs: 1, seed: 1}
"""


def test_rivc_in_an_experiment_has_the_bound_of_its_noise(tmp_path):
    """Bound by the dense covariance matrix, averaged over the data sets used by the theory."""
    (tmp_path / "noise.yaml").write_text(EXPERIMENT, encoding="utf-8")
    plan = build_plan(load_spec(tmp_path / "noise.yaml"))
    (cell,), (part,) = plan.data_cells, plan.estimators
    records = [cell.source.dataset(k).record for k in range(10)]
    assert type(part.estimator) is Rivc
    assert part.estimator.fit(records[0]).noise.orders == (2, 1)
    law, bounds = ArmaNoise(*SLOW, innovation_variance=1e-6), []
    for record in records:
        psi = sensitivities(SYSTEM, record.input, record.t, estimate_delay=True)[record.t >= 2.0 - 1e-9]
        inner = psi.T @ np.linalg.solve(toeplitz(law.autocovariance(np.arange(len(psi)))), psi)
        bounds.append(np.diag(np.linalg.inv(inner)))
    least = least_variances(plan, 0, 0)
    found = [least[name] for name in ("a1", "a2", "b0", "delay")]
    np.testing.assert_allclose(found, np.mean(bounds, axis=0), rtol=1e-6)


def test_a_plant_of_too_few_poles_is_detected():
    (warning,) = (
        text
        for text in identify([record_of(n=600)], Rivc(1, 0, (0.0, 2.0), noise_model="arma:2,1")).warnings
        if "Hausman" in text
    )
    assert "the model of the plant or of the noise is too small" in warning


def test_what_a_noise_model_does_not_go_with():
    record = record_of()
    shifted = Record(record.t + 0.03 * np.sin(np.arange(300)), record.y, record.input)
    with pytest.raises(DataError, match=r"irregular.*--noise white"):
        Rivc(**KNOWN).fit(shifted)
    with pytest.raises(OptionError, match="loss squares, not tukey"):
        DelayProfile(**KNOWN, loss="tukey", noise_model="auto")


class Plant(str):
    """A minimum that is the start of the next search."""

    start = None


class Lost:
    """Records of which no plant is found once their errors are whitened."""

    def used(self):
        return (np.ones(300, dtype=bool),)

    def errors(self, found):
        assert found == "the plant"
        return [lfilter([1.0], [1.0, -0.8], np.random.default_rng(3).standard_normal(300))]

    def whitened_by(self, noise):
        return self

    def local(self, *starts):
        return None


@pytest.mark.parametrize("orders", [None, (1, 0)])
def test_a_plant_that_is_not_found_under_the_noise_is_kept(orders):
    joint = joint_near(Lost(), Plant("the plant"), orders)
    assert joint.found == "the plant"
    assert joint.noise.noise.denominator[1] == pytest.approx(-0.8, abs=0.15)
