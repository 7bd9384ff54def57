"""Records of the two benchmark systems, for the tests in this folder."""

import numpy as np

from ctid_cli.filtering.simulate import simulate
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.excitation import Prbs
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.noise import WhiteNoise, stream
from ctid_cli.signals.record import Record

CASE_1 = TransferFunction([2.0], [0.25, 0.7, 1.0], 8.0)
#: The system of Rao and Garnier: a right-half-plane zero, two frequencies a decade apart.
CASE_2 = TransferFunction([-6400.0, 1600.0], [1.0, 5.0, 408.0, 416.0, 1600.0], 8.0)
SVF_CUTOFF = {CASE_1: 1.0, CASE_2: 25.0}


def make_record(model=CASE_1, *, seed=1, replicate=0, snr_db=None, regular=True, n=None, clock_period=None):
    """Return a data set with exactly known input; without a signal-to-noise ratio there is no noise."""
    interval, low, high, samples = (0.05, 0.01, 0.09, 4000) if model.order <= 2 else (0.01, 0.01, 0.05, 8000)
    n = n or samples
    if regular:
        t = interval * np.arange(n)
    else:
        steps = stream(seed, "sampling", replicate).uniform(low, high, n - 1)
        t = np.concatenate(([0.0], np.cumsum(steps)))
    clock = clock_period or (interval if regular else 0.5)
    held = Prbs(stages=10, clock_period=clock).generate(t, stream(seed, "input", replicate))
    if regular and clock == interval:
        held = HeldSignal(t, held.at(t))
    x = simulate(model, held, t)
    y = x if snr_db is None else x + WhiteNoise(snr_db=snr_db).generate(x, stream(seed, "noise", replicate))
    return Record(t, y, held, noise_free=x)


def theta_of(model):
    """Return the parameters (a1 ... an, b0 ... bm)."""
    return np.concatenate((model.denominator[1:], model.numerator))


def assert_same_model(model, expected, tolerance):
    """Assert equal coefficients and delay, relative to their sizes."""
    np.testing.assert_allclose(model.denominator, expected.denominator, rtol=tolerance)
    np.testing.assert_allclose(model.numerator, expected.numerator, rtol=tolerance)
    np.testing.assert_allclose(model.delay, expected.delay, rtol=tolerance)
