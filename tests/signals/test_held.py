"""Held signals: values at any instant, and refusals; regular clocks."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctid_cli.errors import DataError
from ctid_cli.signals.held import HeldSignal, regular_interval


@pytest.mark.parametrize(
    ("hold", "values"),
    [("zoh", [0.0, 2.0, 2.0, 4.0, 4.0, -1.0, -1.0]), ("foh", [0.0, 2.0, 3.0, 4.0, 1.5, -1.0, -1.0])],
)
def test_values_between_the_breaks_before_and_after(hold, values):
    signal = HeldSignal([0.0, 1.0, 3.0], [2.0, 4.0, -1.0], hold)
    assert signal.at([-0.1, 0.0, 0.5, 1.0, 2.0, 3.0, 100.0]).tolist() == values


def test_an_edge_and_a_sample_of_one_name_are_one_instant():
    # Equal instants with different rounding: some of the coarse ones precede the fine ones.
    coarse, fine = 0.3 * np.arange(400), 0.1 * np.arange(1200)
    assert (coarse < fine[::3]).any()
    signal = HeldSignal(fine, np.arange(1200.0))
    assert np.array_equal(signal.at(coarse), np.arange(0.0, 1200.0, 3.0))
    signal = HeldSignal(coarse, np.arange(400.0))
    assert np.array_equal(signal.at(fine), np.repeat(np.arange(400.0), 3))


@pytest.mark.parametrize(
    ("t", "values", "hold", "message"),
    [
        ([], [], "zoh", "one equal, non-zero length"),
        ([0.0, 1.0], [1.0], "zoh", "one equal, non-zero length"),
        ([0.0, 1.0], [1.0, np.nan], "zoh", "not a finite number"),
        ([0.0, np.inf], [1.0, 2.0], "zoh", "missing or not finite"),
        ([0.0, 2.0, 1.0], [1.0, 2.0, 3.0], "zoh", "goes back to 1 s after 2 s on sample 2"),
        ([0.0, 1.0, 2.5], [1.0, 2.0, 3.0], "band-limited", "needs a regular clock"),
        ([0.0], [1.0], "cubic", "hold must be 'zoh', 'foh' or 'band-limited', not 'cubic'"),
    ],
)
def test_unusable_signals_are_refused(t, values, hold, message):
    with pytest.raises(DataError, match=message):
        HeldSignal(t, values, hold)


# --- regular clocks -------------------------------------------------------------------------------


@given(st.integers(3, 500), st.floats(1e-5, 0.4), st.data())
def test_one_late_sample_makes_a_clock_irregular(samples, shift, data):
    late = data.draw(st.integers(1, samples - 2))
    t = np.arange(samples, dtype=float)
    t[late] += shift
    assert regular_interval(t) is None
