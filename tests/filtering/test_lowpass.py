"""Low-pass filtering of a record: the filter itself, and that it commutes with the system."""

import numpy as np
import pytest
from scipy import signal

from ctid_cli.filtering.lowpass import Lowpass
from ctid_cli.filtering.simulate import simulate
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record

CASE_1 = TransferFunction([2.0], [0.25, 0.7, 1.0], 0.33)


def record(hold="zoh", regular=True, n=1000):
    rng = np.random.default_rng(0)
    t = 0.05 * np.arange(n) if regular else np.cumsum(rng.uniform(0.01, 0.09, n))
    u = rng.standard_normal(n)
    u[0] = 0.0
    held = HeldSignal(t, u, hold)
    return Record(t, simulate(CASE_1, held, t), held, name="a record")


@pytest.mark.parametrize("hold", ["zoh", "foh"])
@pytest.mark.parametrize("order", [1, 2, 10])
def test_filter_commutes_with_the_system_on_a_regular_clock(order, hold):
    # G L u = L G u: both are linear and time-invariant on the samples (a linear hold must start at zero).
    filtered = Lowpass(0.5, order).apply(record(hold))
    assert filtered.input.hold == hold
    expected = simulate(CASE_1, filtered.input, filtered.t)
    np.testing.assert_allclose(filtered.y, expected, atol=1e-12 * np.abs(expected).max())


@pytest.mark.parametrize("order", [1, 2, 5, 20])
@pytest.mark.parametrize("cutoff", [0.2, 6.0, 60.0])
def test_samples_on_a_regular_clock_are_those_of_the_bilinear_transform(order, cutoff):
    y = np.random.default_rng(order).standard_normal(3000)
    filtered = Lowpass(cutoff, order).apply(Record.from_arrays(0.05 * np.arange(3000), y, y))
    sections = signal.butter(order, cutoff, fs=2 * np.pi / 0.05, output="sos")
    expected = signal.sosfilt(sections, y)
    for found in (filtered.y, filtered.input.values):
        np.testing.assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max())


def test_irregular_records_pass_through_the_analogue_filter():
    # The filtered input is the exact response at the samples, and the filtered output that of the interpolated one.
    r = record(regular=False)
    filtered = Lowpass(0.5, 3).apply(r)
    model = Lowpass(0.5, 3).model
    assert filtered.input.hold == "foh"
    np.testing.assert_array_equal(filtered.input.values, simulate(model, r.input, r.t))
    np.testing.assert_array_equal(filtered.y, simulate(model, HeldSignal(r.t, r.y, "foh"), r.t))
    # The system suppresses the rest of the error: smooth signals are close to the lines between their samples.
    error = simulate(CASE_1, filtered.input, r.t) - filtered.y
    assert np.abs(error).max() < 2e-3 * np.abs(filtered.y).max()


def test_cutoff_beyond_the_clock_is_refused():
    with pytest.raises(ValueError, match=r"70 rad/s is not below half the sampling frequency, 62\.83\d* rad/s"):
        Lowpass(70.0).apply(record())
    Lowpass(70.0).apply(record(regular=False))  # no such limit where the filter is an analogue one


@pytest.mark.parametrize(
    ("cutoff", "order", "message"),
    [
        (0.0, 2, "must be a positive frequency in rad/s, not 0.0"),
        (np.inf, 2, "must be a positive frequency"),
        (1.0, 0, "order must be an integer from 1 to 20, not 0"),
        (1.0, 2.5, "order must be an integer from 1 to 20, not 2.5"),
    ],
)
def test_impossible_filters_are_refused(cutoff, order, message):
    with pytest.raises(ValueError, match=message):
        Lowpass(cutoff, order)
