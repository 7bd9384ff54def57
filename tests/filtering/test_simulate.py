"""Simulation against other simulators, high-precision arithmetic and closed forms."""

import mpmath as mp
import numpy as np
import pytest
from scipy import signal

from ctid_cli.errors import DataError
from ctid_cli.filtering.simulate import simulate
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal

STEP = 0.01
SYSTEMS = {
    "first order": ([3.0], [1.0, 2.0]),
    "second order": ([2.0], [0.25, 0.7, 1.0]),
    "four poles, right-half-plane zero": ([-6400.0, 1600.0], [1.0, 5.0, 408.0, 416.0, 1600.0]),
    "integrator": ([1.0], [1.0, 3.0, 0.0]),
    "triple pole": ([1.0, 2.0], [1.0, 6.0, 12.0, 8.0]),
    "biproper": ([2.0, 1.0, 1.0], [1.0, 1.0, 5.0]),
    "unstable": ([1.0], [1.0, -0.2, 1.0]),
}


def on_fine_grid(seed, hold):
    """Return an irregular input, a delay and irregular instants, all multiples of one small step."""
    rng = np.random.default_rng(seed)
    breaks = np.cumsum(rng.integers(1, 60, 25))
    delay = int(rng.integers(1, 300))
    instants = np.sort(rng.choice(np.arange(breaks[-1] + delay + 200), 80, replace=False))
    values = rng.standard_normal(breaks.size)
    return breaks, values, delay, instants, HeldSignal(STEP * breaks, values, hold)


@pytest.mark.parametrize("hold", ["zoh", "foh"])
@pytest.mark.parametrize("name", SYSTEMS)
def test_equals_another_simulator_on_a_grid_that_holds_everything(name, hold):
    # The discretisation is exact: every instant, edge and delay is a multiple of its step.
    numerator, denominator = SYSTEMS[name]
    breaks, values, delay, instants, held = on_fine_grid(1, hold)
    fine = np.arange(instants[-1] - breaks[0] - delay + 2)
    if hold == "zoh":
        u = values[np.searchsorted(breaks - breaks[0], fine, side="right") - 1]
    else:
        u = np.interp(fine, breaks - breaks[0], values)
    _, x, _ = signal.lsim((numerator, denominator), u, STEP * fine, interp=hold == "foh")
    position = instants - breaks[0] - delay
    expected = np.where(position < 0, 0.0, x[np.maximum(position, 0)])
    result = simulate(TransferFunction(numerator, denominator, STEP * delay), held, STEP * instants)
    assert np.abs(result - expected).max() <= 1e-9 * np.abs(expected).max()
    assert (result[position < 0] == 0.0).all()


@pytest.mark.parametrize("regular", [True, False])
@pytest.mark.parametrize("name", SYSTEMS)
def test_a_delay_moves_the_input(name, regular):
    # G exp(-s tau) u(t) = G u(t - tau), for delays of whole intervals and others.
    rng = np.random.default_rng(2)
    t = 0.1 * np.arange(200.0) if regular else np.cumsum(rng.uniform(0.02, 0.2, 200))
    held = HeldSignal(t, rng.standard_normal(200))
    for delay in (0.0, 0.7, 0.73, 3.14159):
        delayed = simulate(TransferFunction(*SYSTEMS[name], delay), held, t)
        moved = simulate(TransferFunction(*SYSTEMS[name]), HeldSignal(held.t + delay, held.values, held.hold), t)
        assert np.abs(delayed - moved).max() <= 1e-10 * np.abs(moved).max()


def elementary_responses(kind, hold):
    """Return the coefficients and start times of the steps and ramps whose sum is the held signal."""
    rng = np.random.default_rng(5)
    breaks = (
        np.concatenate(([0.0], np.cumsum(rng.uniform(0.001, 300, 12)))) if kind == "irregular" else 37.5 * np.arange(24)
    )
    values = rng.standard_normal(breaks.size)
    if hold == "zoh":
        steps, ramps = np.diff(values, prepend=0.0), np.zeros(breaks.size)
    else:
        slopes = np.append(np.diff(values) / np.diff(breaks), 0.0)
        steps, ramps = np.where(np.arange(breaks.size) == 0, values[0], 0.0), np.diff(slopes, prepend=0.0)
    times = np.sort(rng.uniform(0, breaks[-1] + 100, 15)) if kind == "irregular" else breaks
    return HeldSignal(breaks, values, hold), steps, ramps, times


def superposed(step_response, ramp_response, held, steps, ramps, times, delay):
    """Return the sum of delayed step and ramp responses."""
    out = []
    for time in times:
        total = mp.mpf(0)
        for begin, step, ramp in zip(held.t, steps, ramps, strict=True):
            since = mp.mpf(float(time)) - mp.mpf(delay) - mp.mpf(float(begin))
            if since > 0:
                total += mp.mpf(float(step)) * step_response(since) if step else 0
                total += mp.mpf(float(ramp)) * ramp_response(since) if ramp else 0
        out.append(float(mp.re(total)))
    return np.array(out)


STIFF = {
    "real poles": -np.logspace(-3, 3, 12),
    "well damped pairs": np.outer(np.logspace(-3, 3, 6), np.exp([0.55j * np.pi, -0.55j * np.pi])).ravel(),
    "lightly damped pairs": np.outer(np.logspace(-3, 3, 6), [-0.01 + 1j, -0.01 - 1j]).ravel(),
}


def horner(coefficients, point):
    """Return value and derivative of a polynomial."""
    value, slope = mp.mpf(0), mp.mpf(0)
    for coefficient in coefficients:
        slope = slope * point + value
        value = value * point + coefficient
    return value, slope


def newton(coefficients, root):
    """Return the exact root of rounded coefficients next to a root of the exact ones."""
    for _ in range(8):
        value, slope = horner(coefficients, root)
        root -= value / slope
    assert abs(horner(coefficients, root)[0]) < mp.mpf(10) ** -40 * abs(root * horner(coefficients, root)[1])
    return root if root.imag else root.real


@pytest.mark.parametrize("kind", ["regular", "irregular"])
@pytest.mark.parametrize("hold", ["zoh", "foh"])
@pytest.mark.parametrize("zeros", [0, 5])
@pytest.mark.parametrize("name", STIFF)
def test_stiff_systems_of_order_twelve_equal_partial_fractions_in_high_precision(name, zeros, hold, kind):
    denominator = np.poly(STIFF[name]).real
    numerator = denominator[-1] * (np.poly(-np.logspace(-2, 2, 5)) if zeros else np.ones(1))
    held, steps, ramps, times = elementary_responses(kind, hold)
    with mp.workdps(50):
        a = [mp.mpf(float(c)) for c in denominator]
        b = [mp.mpf(float(c)) for c in numerator]
        poles = [newton(a, mp.mpc(complex(pole))) for pole in STIFF[name]]
        residues = [horner(b, p)[0] / horner(a, p)[1] for p in poles]
        # A pole and its conjugate contribute conjugate terms: half of the exponentials suffice.
        terms = [(p, r * (2 if p.imag else 1)) for p, r in zip(poles, residues, strict=True) if p.imag >= 0]

        def step_response(s):
            return sum(r / p * (mp.exp(p * s) - 1) for p, r in terms)

        def ramp_response(s):
            return sum(r / p**2 * (mp.exp(p * s) - 1 - p * s) for p, r in terms)

        expected = superposed(step_response, ramp_response, held, steps, ramps, times, 1.234)
    result = simulate(TransferFunction(numerator, denominator, 1.234), held, times)
    assert np.abs(result - expected).max() <= 1e-8 * np.abs(expected).max()


@pytest.mark.parametrize("kind", ["regular", "irregular"])
@pytest.mark.parametrize("hold", ["zoh", "foh"])
@pytest.mark.parametrize(("multiplicity", "tolerance"), [(2, 1e-12), (4, 1e-12), (12, 1e-8)])
@pytest.mark.parametrize("pole", [1.0, 0.02])
def test_repeated_poles_equal_the_incomplete_gamma_function(pole, multiplicity, tolerance, hold, kind):
    # The step response of w^n/(s + w)^n is P(n, w t), its integral t P(n, w t) - n/w P(n + 1, w t).
    held, steps, ramps, times = elementary_responses(kind, hold)

    def step_response(s):
        return mp.gammainc(multiplicity, 0, pole * s, regularized=True)

    def ramp_response(s):
        return s * step_response(s) - multiplicity / pole * mp.gammainc(multiplicity + 1, 0, pole * s, regularized=True)

    with mp.workdps(30):
        expected = superposed(step_response, ramp_response, held, steps, ramps, times, 1.234)
    model = TransferFunction([pole**multiplicity], np.poly(np.full(multiplicity, -pole)), 1.234)
    assert np.abs(simulate(model, held, times) - expected).max() <= tolerance * np.abs(expected).max()


def test_gain_without_poles_passes_the_input_on():
    held = HeldSignal([0.0, 1.0, 3.0], [2.0, 4.0, -1.0], "foh")
    times = np.array([0.2, 0.5, 1.5, 5.0])
    assert simulate(TransferFunction([6.0], [2.0], 0.5), held, times).tolist() == [0.0, 6.0, 12.0, -3.0]


def test_inputs_that_end_early_keep_their_last_value():
    # First-order response to a unit step: 1 - exp(-t), also if breaks repeat the value.
    times = np.array([0.5, 3.0, 40.0])
    for breaks in ([0.0], [0.0, 0.1, 0.7]):
        x = simulate(TransferFunction([1.0], [1.0, 1.0]), HeldSignal(breaks, np.ones(len(breaks))), times)
        np.testing.assert_allclose(x, 1 - np.exp(-times), rtol=1e-13)


def test_more_zeros_than_poles_are_refused():
    with pytest.raises(DataError, match="more zeros than poles"):
        simulate(TransferFunction([1.0, 0.0, 0.0], [1.0, 1.0]), HeldSignal([0.0], [1.0]), [1.0])


@pytest.mark.parametrize("times", [[1.0, 0.5, 2.0], [1.0, 1.0], [0.0, np.nan]])
def test_instants_that_do_not_increase_are_refused(times):
    with pytest.raises(DataError, match="increase"):
        simulate(TransferFunction([1.0], [1.0, 1.0]), HeldSignal([0.0], [1.0]), times)
