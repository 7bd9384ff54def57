"""Relay loops: equations satisfied by their signals, and the theoretical limit cycle."""

import numpy as np
import pytest

from ctid_cli.errors import DataError
from ctid_cli.filtering.loop import simulate_loop
from ctid_cli.filtering.simulate import simulate
from ctid_cli.models.controller import Relay
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal


@pytest.mark.parametrize("delay", [0.0, 0.3, 0.37])
@pytest.mark.parametrize("enters", ["controller", "input"])
def test_every_signal_satisfies_its_equation(delay, enters):
    model, h = TransferFunction([2.0], [0.25, 0.7, 1.0], delay), 0.1
    rng = np.random.default_rng(1)
    r, v = 0.3 * rng.standard_normal(500), 0.1 * rng.standard_normal(500)
    u, x = simulate_loop(model, Relay(1.5, hysteresis=0.4, bias=0.2), r, v, h, enters)
    np.testing.assert_allclose(x, simulate(model, HeldSignal(h * np.arange(500), u), h * np.arange(500)), atol=1e-10)
    error, value = (r if enters == "controller" else 0.0) - x - v, 1.5
    switched = 0
    for k in range(500):
        before = value
        value = 1.5 if error[k] > 0.4 else -1.5 if error[k] < -0.4 else value
        switched += value != before
        assert u[k] == pytest.approx(0.2 + value + (r[k] if enters == "input" else 0.0))
    assert switched > 10


def test_the_limit_cycle_is_that_of_a_first_order_system_with_delay():
    """The limit cycle is exact: after a switch the output continues for the delay, then turns until it has crossed."""
    gain, T, delay, h = 2.0, 1.5, 0.5, 0.001
    zeros = np.zeros(40_000)
    u, x = simulate_loop(TransferFunction([gain], [T, 1.0], delay), Relay(1.0, hysteresis=0.1), zeros, zeros, h)
    switches = np.flatnonzero(np.diff(u[20_000:])) * h
    half = delay + T * np.log((gain + (gain - (gain - 0.1) * np.exp(-delay / T))) / (gain - 0.1))
    np.testing.assert_allclose(np.diff(switches), half, atol=2 * h)
    np.testing.assert_allclose(x[20_000:].max(), gain - (gain - 0.1) * np.exp(-delay / T), atol=2 * h)


def test_a_model_that_acts_at_once_is_refused():
    with pytest.raises(DataError, match="a relay needs a model without direct feedthrough"):
        simulate_loop(TransferFunction([1.0, 2.0], [1.0, 1.0]), Relay(1.0), np.zeros(9), np.zeros(9), 0.1)
