"""Best model of a structure: systems are found, and no structure is worse than one that it contains."""

import numpy as np
import pytest

from ctid_cli.estimation.optimum import best_model
from ctid_cli.estimation.optimum.search import Ending
from ctid_cli.filtering.filter_data import filter_data
from ctid_cli.filtering.simulate import simulate
from ctid_cli.models.additive import AdditiveModel, Submodel
from ctid_cli.models.factoring import unfactored
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record
from tests.estimation.optimum.systems import best, nearest, random_model, record_of


@pytest.mark.parametrize(
    ("n", "m", "delay", "regular"), [(1, 0, 1.3, True), (2, 0, 0.0, False), (3, 1, 0.7, True), (4, 3, 0.0, True)]
)
def test_a_system_without_noise_is_found(n, m, delay, regular):
    rng = np.random.default_rng(10 * n + m)
    model = random_model(rng, n, m, delay)
    record = record_of(model, rng, samples=400, regular=regular, offset=1.5)
    options = {"delays": (0.0, 3.0) if delay else (0.0, 0.0), "offset": True}
    found = best([filter_data(record)], n, m, **options)
    assert found.ending.optimal
    assert 1 <= found.agree <= found.tried
    np.testing.assert_allclose(found.denominator, model.denominator, rtol=1e-6)
    np.testing.assert_allclose(found.numerator, model.numerator, rtol=1e-6)
    np.testing.assert_allclose([found.delay, found.trends[0, 0]], [delay, 1.5], rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("seed", range(2))
def test_no_structure_is_worse_than_one_that_it_contains(seed):
    rng = np.random.default_rng(seed)
    record = record_of(random_model(rng, 3, 1), rng, samples=120, noise=1.0)
    options = {"free_response": bool(seed % 2)}
    least = {(n, m): best([filter_data(record)], n, m, **options).squared_error for n in range(1, 4) for m in range(n)}
    for (n, m), error in least.items():
        for smaller in ((n - 1, m - 1), (n, m - 1), (n - 1, m)):
            if smaller in least:
                assert error <= least[smaller] * (1 + 1e-6)


@pytest.mark.parametrize("seed", [1, 2])
def test_a_mode_that_hardly_decays_is_found_between_the_others_of_the_noise(seed):
    modes = AdditiveModel([Submodel([1.0], [1.0, 1.2, 1.0]), Submodel([0.004], [5.05**-2, 2e-4 / 5.05, 1.0])])
    model = unfactored(modes)
    data = filter_data(record_of(model, np.random.default_rng(seed), samples=240, noise=0.1))
    expected = nearest([data], 4, 2, starts=[(model.denominator, 0.0)]).squared_error
    assert best([data], 4, 2).squared_error <= expected * (1 + 1e-9)


def test_a_superfluous_pole_runs_to_infinity():
    # A lag cannot correct an output one sample too early.
    rng = np.random.default_rng(4)
    record = record_of(TransferFunction([0.8], [1.0, 0.8]), rng, noise=0.02)
    early = Record.from_arrays(record.t[:-1], record.input.values[:-1], record.y[1:])
    one, two = (best([filter_data(early)], n, 0) for n in (1, 2))
    assert two.poles_at_infinity == 1
    assert two.squared_error == pytest.approx(one.squared_error, rel=1e-9)
    assert two.denominator.size == 2


def test_an_integrating_drive_at_rest_is_next_to_the_set():
    rng = np.random.default_rng(12)
    t = np.arange(400.0)
    u = np.repeat(rng.choice([-1.0, 1.0], 20), 20)
    x = simulate(TransferFunction([1.0], [8.0, 1.0, 0.0]), HeldSignal(t, u), t)
    noise = 0.01 * x.std() * rng.standard_normal(t.size)
    found = best([filter_data(Record.from_arrays(t, u, x + noise))], 2, 0)
    # Three parameters also fit noise; the slowest pole is not zero.
    assert found.squared_error <= 1.001 * (noise @ noise)
    np.testing.assert_allclose(found.denominator[1], 0.125, rtol=0.02)
    assert found.ending is Ending.AT_BOUND
    assert [name for name, *_ in found.box.limits_met(found.held_poles)] == ["slowest"]


@pytest.mark.parametrize("seed", [2, 14, 41])
def test_a_lightly_damped_pair_is_found_without_a_smaller_model_that_shows_it(seed):
    # With this noise no single pole leads there, and the cost has a minimum at every peak of the noise.
    rng = np.random.default_rng(seed)
    w, zeta = np.exp(rng.uniform(np.log((0.05, 0.005)), np.log((5.0, 0.5))))
    denominator = [1.0, 2 * zeta * w, w * w]
    record = record_of(TransferFunction([w * w], denominator), rng, samples=200, noise=(0.1, 1.0, 5.0)[seed % 3])
    found = best([filter_data(record)], 2, 0, free_response=True)
    options = {"free_response": True, "starts": [(denominator, 0.0)]}
    assert found.squared_error <= nearest([filter_data(record)], 2, 0, **options).squared_error * (1 + 1e-9)


@pytest.mark.parametrize("seed", [11, 60])
def test_a_delay_is_found_across_a_kink(seed):
    # A pole as fast as the clock: the cost has a minimum in each interval of the delay.
    rng = np.random.default_rng(seed)
    hold, t = int(rng.integers(1, 6)), np.arange(120.0)
    held = HeldSignal(t, np.repeat(rng.choice([-1.0, 1.0], 120 // hold + 1), hold)[:120])
    pole = rng.uniform(0.4, 1.2)
    model = TransferFunction([pole], [1.0, pole], rng.uniform(2, 8))
    record = Record(t, simulate(model, held, t), held)
    found = best([filter_data(record)], 1, 0, delays=(0.0, 12.0))
    assert found.delay == pytest.approx(model.delay, abs=1e-6)


@pytest.mark.parametrize(("delay", "free_response"), [(0.0, False), (0.7, True)])
def test_a_long_record_is_searched_by_a_part_of_it(monkeypatch, delay, free_response):
    rng = np.random.default_rng(9)
    data = filter_data(record_of(random_model(rng, 3, 1, delay), rng, samples=1500, noise=0.3, regular=delay == 0.0))
    options = {"delays": (0.0, 2 * delay), "free_response": free_response}
    whole = best([data], 3, 1, **options)
    monkeypatch.setattr(best_model, "LONG", 1000)
    monkeypatch.setattr(best_model, "PART", 400)
    part = best([data], 3, 1, **options)
    assert part.squared_error == pytest.approx(whole.squared_error, rel=1e-9)
    assert part.evaluations < 0.2 * whole.evaluations


def test_a_part_that_tells_too_little_is_not_trusted(monkeypatch):
    # A fast start and a long slow end: the most active part does not contain the slow pole.
    rng = np.random.default_rng(1)
    t = np.arange(3000.0)
    u = np.where(t < 300, np.repeat(rng.choice([-1.0, 1.0], 1000), 3), 1.0)
    model = TransferFunction([0.5, 0.004], [1.0, 0.502, 0.001])
    record = Record(t, simulate(model, HeldSignal(t, u), t) + 1e-3 * rng.standard_normal(t.size), HeldSignal(t, u))
    whole = best([filter_data(record)], 2, 1)
    monkeypatch.setattr(best_model, "LONG", 1000)
    monkeypatch.setattr(best_model, "PART", 200)
    part = best([filter_data(record)], 2, 1)
    assert part.squared_error <= whole.squared_error * (1 + 1e-6)
