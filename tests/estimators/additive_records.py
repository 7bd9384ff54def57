"""The two published sums of submodels and a flexible beam, with seeded records, for the tests in this folder."""

import numpy as np
from scipy.signal import lfilter

from ctid_cli.filtering.loop import simulate_loop
from ctid_cli.filtering.simulate import simulate_additive
from ctid_cli.models.additive import AdditiveModel, Submodel, Term
from ctid_cli.models.controller import DiscreteController
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Loop, Record

INTERVAL = 0.05
MODE = Term(2, 0)


def modes(theta, delay=0.0):
    """Return second-order submodels without zeros: a1, a2, b0 of each."""
    return AdditiveModel.from_theta(theta, [MODE] * (len(theta) // 3), delay)


#: Eight poles in four modes (González et al., section 6.1): static gains and poles as printed.
FOUR_MODES = AdditiveModel(
    Submodel([gain], [1.0 / abs(pole) ** 2, -2.0 * pole.real / abs(pole) ** 2, 1.0])
    for gain, pole in ((3.0, -0.25 + 1.39j), (0.4, -0.15 + 3.16j), (0.2, -0.17 + 5.77j), (0.05, -0.5 + 9.99j))
)
#: The closed-loop example (section 6.2).
TWO_MODES = modes([0.25, 0.25, 3.0, 0.01, 0.025, 1.0])
PID = DiscreteController.from_pid(0.0115, 0.00725, 0.00454)
#: The modes of a flexible beam as printed (section 7), and the initial values of its identification.
BEAM = modes([0.0024, 0.023, 11.81, 2.33e-5, 1.65e-4, 0.159, 8.59e-7, 1.03e-5, 3.19e-4, 7.55e-7, 3.55e-6, 1.27e-4])


def open_record(system, n, noise, seed, *, interval=INTERVAL, hold="zoh", times=None):
    """Return a record of Gaussian input and white output noise with a standard deviation."""
    rng = np.random.default_rng(seed)
    t = interval * np.arange(n) if times is None else times
    u = HeldSignal(t, rng.standard_normal(n), hold)
    x = simulate_additive(system, u, t)
    return Record(t, x + noise * rng.standard_normal(n), u, noise_free=x)


def coloured_record(seed, n=2000):
    """Return a record of four modes with the published noise, whose power is largest at the first two."""
    rng = np.random.default_rng(seed)
    t = INTERVAL * np.arange(n)
    u = HeldSignal(t, rng.standard_normal(n))
    v = lfilter([1.0, 0.5], [1.0, -0.85], np.sqrt(0.02) * rng.standard_normal(n + 200))[200:]
    return Record(t, simulate_additive(FOUR_MODES, u, t) + v, u)


def beam_record(seed, noise=1e-5, periods=1):
    """Return two seconds of a multisine up to 500 Hz on a beam with a delay of four samples, its system and its noise.

    The first period begins at rest.
    """
    rng = np.random.default_rng(seed)
    n, rate = 8192, 4096.0
    spectrum = np.zeros(n // 2 + 1, complex)
    spectrum[1:1001] = np.exp(2j * np.pi * rng.uniform(size=1000))
    u = np.fft.irfft(spectrum, n)
    u /= u.std()
    t = np.arange(n * periods) / rate
    system = AdditiveModel(BEAM.submodels, 4 / rate)
    x = simulate_additive(system, HeldSignal(t, np.tile(u, periods)), t)[-n:]
    sigma = noise * np.sqrt(np.mean(x**2))
    return Record(t[:n], x + sigma * rng.standard_normal(n), HeldSignal(t[:n], u)), system, sigma


def loop_record(
    system, n, noise, seed, *, controller=PID, interval=INTERVAL, enters="controller", filter=([1.0], [1.0])
):
    """Return a record of Gaussian reference, with output noise in the loop."""
    rng = np.random.default_rng(seed)
    r = rng.standard_normal(n)
    v = noise * lfilter(*filter, rng.standard_normal(n))
    u, x = simulate_loop(system, controller, r, v, interval, enters)
    t = interval * np.arange(n)
    return Record(t, x + v, HeldSignal(t, u), noise_free=x, loop=Loop(r, controller, enters))


def disturbed(system, seed, by=0.05):
    """Return a start with every parameter off by up to a fraction."""
    change = np.random.default_rng(seed).uniform(-by, by, system.theta.size)
    return AdditiveModel.from_theta(system.theta * (1.0 + change), system.terms, system.delay)


def deviations(fit, system):
    """Return the errors of an estimate in its standard errors, with submodels sorted on both sides."""
    return (fit.additive.theta - system.sorted().theta) / np.sqrt(np.diag(fit.covariance))


def assert_parameters(fit, system, tolerance):
    """Assert equal parameters, relative to their sizes."""
    np.testing.assert_allclose(fit.additive.theta, system.sorted().theta, rtol=tolerance)
