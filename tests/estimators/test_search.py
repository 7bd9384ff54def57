"""Distance of fits from the least cost: at most that of the basin of the true system, in units of the noise."""

import numpy as np
import pytest

from ctid_cli import DelayProfile, HeldSignal, Prbs, Record, TransferFunction, simulate

#: Largest accepted excess ``N (S/S_min - 1)``.
LITTLE = 0.5
W, ZETA = 0.136, 0.178
CASES = {
    # One fast pole: the best pole at a wrong delay leads to a wrong minimum.
    "one pole": (TransferFunction([1.7], [1.0, 1.7], 4.35), 0.28, 203, 25.0, False),
    # Slow poles, and a zero: the cost has a kink at a sample between the true delay and another minimum.
    "across a kink": (TransferFunction([0.05, W * W], [1.0, 2 * ZETA * W, W * W], 8.0044), 0.17434, 382, 25.0, True),
    "two modes": (
        TransferFunction([2.0, 1.0], np.poly([-1 + 2j, -1 - 2j, -0.3 + 1j, -0.3 - 1j]).real, 6.3),
        *(0.25, 300),
        8.0,
        False,
    ),
    "a pair and two poles": (
        TransferFunction([3.0], np.poly([-0.2 + 1j, -0.2 - 1j, -0.5, -2]).real, 11.1),
        *(0.3, 250),
        15.0,
        True,
    ),
}


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("seed", range(2))
def test_no_fit_is_above_the_basin_of_the_true_system(name, seed):
    model, interval, samples, snr_db, regular = CASES[name]
    rng = np.random.default_rng(seed)
    t = interval * np.arange(samples)
    if not regular:
        t = np.concatenate(([0.0], np.cumsum(interval * rng.uniform(0.3, 1.7, samples - 1))))
    held = HeldSignal(t, Prbs(9, 3 * interval).generate(t, rng).at(t))
    x = simulate(model, held, t)
    y = x + rng.standard_normal(samples) * x.std() * 10 ** (-snr_db / 20)
    prepared = DelayProfile(model.order, model.numerator.size - 1, (0.0, 20.0)).prepare(Record(t, y, held))
    fit, least = prepared.fit(), prepared.laid_out.local((model.denominator, model.delay)).squared_error
    assert fit.count * (fit.cost * fit.count / least - 1.0) <= LITTLE
