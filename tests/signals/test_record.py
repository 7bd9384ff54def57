"""Records: regularity, masks and refusals."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctid_cli.errors import DataError
from ctid_cli.signals import HeldSignal, Record, regular_interval

ONE = HeldSignal([0.0], [1.0])


def test_masked_samples_are_counted_and_marked():
    record = Record([0.0, 1.0, 2.5], [1.0, np.nan, 3.0], ONE)
    assert record.n_samples == 3
    assert record.duration == 2.5
    assert record.valid.tolist() == [True, False, True]
    assert record.interval is None


@given(st.floats(1e-6, 1e3), st.integers(2, 2000), st.floats(-1e4, 1e4))
def test_regular_clock_is_recognised(interval, samples, offset):
    start = offset * interval
    assert regular_interval(start + interval * np.arange(samples)) == pytest.approx(interval, rel=1e-9)


@given(st.integers(3, 500), st.floats(1e-5, 0.4), st.data())
def test_one_late_sample_makes_a_clock_irregular(samples, shift, data):
    late = data.draw(st.integers(1, samples - 2))
    t = np.arange(samples, dtype=float)
    t[late] += shift
    assert regular_interval(t) is None


def test_times_written_with_few_digits_are_still_regular():
    # A file with ten digits after the point, as loggers write them.
    t = np.round(np.arange(1000) / 300, 10)
    assert regular_interval(t) == pytest.approx(1 / 300, rel=1e-9)


def test_one_sample_has_no_interval():
    assert Record([0.0], [1.0], ONE).interval is None


def test_input_is_on_the_grid_only_if_every_break_is():
    t = 0.1 * np.arange(10)
    u = np.arange(10.0)
    assert Record.from_arrays(t, u, u).input_on_grid
    assert not Record(t, u, HeldSignal(t + 0.01, u)).input_on_grid
    assert not Record(t, u, HeldSignal(t[:-1], u[:-1])).input_on_grid
    irregular = np.append(t[:-1], 2.0)
    assert not Record.from_arrays(irregular, u, u).input_on_grid


def test_from_arrays_holds_the_input_as_told():
    record = Record.from_arrays([0.0, 1.0], [0.0, 2.0], [5.0, 6.0], hold="foh", name="pump")
    assert record.input.at(0.5) == 1.0
    assert record.name == "pump"


def test_record_never_changes():
    t, y = np.array([0.0, 1.0]), np.array([1.0, 2.0])
    record = Record(t, y, ONE)
    t[1], y[1] = 7.0, 7.0
    assert record.t[1] == 1.0
    assert record.y[1] == 2.0
    with pytest.raises(ValueError, match="read-only"):
        record.y[0] = 0.0


@pytest.mark.parametrize(
    ("t", "y", "message"),
    [
        ([], [], "pump: the record is empty"),
        ([0.0, 1.0], [1.0], "pump: times and outputs must be one-dimensional and of equal length"),
        ([0.0, np.nan], [1.0, 2.0], "pump: time of sample 1 is not a finite number"),
        (
            [0.0, 1.0, 1.0],
            [1.0, 2.0, 3.0],
            "pump: times must increase strictly; samples 1 and 2 are at 1 s and 1 s",
        ),
        ([0.0, 1.0], [1.0, np.inf], "pump: output of sample 1 is infinite"),
        ([0.0, 1.0], [np.nan, np.nan], "pump: no output sample is a finite number"),
    ],
)
def test_unusable_records_are_refused(t, y, message):
    with pytest.raises(DataError, match=message):
        Record(t, y, ONE, name="pump")
