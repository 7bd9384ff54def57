"""Records: masks, grids, loops and refusals."""

from dataclasses import replace

import numpy as np
import pytest

from ctid_cli.errors import DataError
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Loop, Record, as_records

ONE = HeldSignal([0.0], [1.0])


class Proportional:
    """The minimum interface of a controller for a record."""

    numerator = (2.0,)
    denominator = (1.0,)


def test_input_is_on_the_grid_only_if_every_break_is():
    t = 0.1 * np.arange(10)
    u = np.arange(10.0)
    assert Record.from_arrays(t, u, u).input_on_grid
    assert not Record(t, u, HeldSignal(t + 0.01, u)).input_on_grid
    assert not Record(t, u, HeldSignal(t[:-1], u[:-1])).input_on_grid
    irregular = np.append(t[:-1], 2.0)
    assert not Record.from_arrays(irregular, u, u).input_on_grid


def test_a_record_is_what_it_was_made_of_and_never_changes():
    t, y, reference = 0.1 * np.arange(5), np.arange(5.0), np.arange(5.0)
    loop = Loop(reference, Proportional(), enters="input")
    record = Record(t, y, HeldSignal(t, y), name="pump", loop=loop)
    t[1], y[1], reference[1] = 7.0, 7.0, 7.0
    assert (record.t[1], record.y[1], record.input.at(0.1), record.loop.reference[1]) == (0.1, 1.0, 1.0, 1.0)
    for values in (record.y, record.input.values, record.loop.reference):
        with pytest.raises(ValueError, match="read-only"):
            values[0] = 0.0
    linear = Record.from_arrays([0.0, 1.0], [0.0, 2.0], [5.0, 6.0], hold="foh", name="pump")
    assert linear.input.at(0.5) == 1.0
    assert (linear.name, linear.loop) == ("pump", None)


@pytest.mark.parametrize(
    ("t", "y", "message"),
    [
        ([], [], "pump: the record is empty"),
        ([0.0, 1.0], [1.0], "pump: times and outputs must be one-dimensional and of equal length"),
        ([0.0, 1.0, 1.0], [1.0, 2.0, 3.0], "pump: sample 3: the time repeats 1 s after 1 s on sample 2; times must"),
        ([0.0, 1.0], [1.0, np.inf], "pump: sample 2: the output is infinite"),
    ],
)
def test_unusable_records_are_refused(t, y, message):
    with pytest.raises(DataError, match=message):
        Record(t, y, ONE, name="pump")


# --- closed loops ---------------------------------------------------------------------------------

T = 0.1 * np.arange(5)


def in_loop(t=T, u=T, hold="zoh", reference=(1.0, 2.0, 3.0, 4.0, 5.0), **more):
    return Record(
        t, np.ones(5), HeldSignal(u, np.ones(len(u)), hold), name="pump", loop=Loop(reference, Proportional(), **more)
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"reference": [1.0, 2.0]}, "pump: the reference has 2 values for 5 samples"),
        ({"reference": [1.0, np.nan, 1.0, 1.0, 1.0]}, "one finite number for each sample"),
        ({"reference": [[1.0] * 5]}, "one finite number for each sample"),
        ({"t": T**2, "u": T**2}, "pump: a closed loop needs a regular clock: its controller is discrete"),
        ({"hold": "foh"}, "pump: in a closed loop the input is held .zoh. from one sample to the next"),
        ({"u": T[:1]}, "pump: in a closed loop the input is held"),
        ({"u": T + 0.05}, "pump: in a closed loop the input is held"),
    ],
)
def test_impossible_loops_are_refused(options, message):
    with pytest.raises(DataError, match=message):
        in_loop(**options)


def noisy(seed=0, first=0, last=200, shift=0.0, step=1, quantum=0.0):
    """Return a part of a record, perhaps with shifted times, fewer samples, or an output in steps."""
    t, u = 0.1 * np.arange(200), np.repeat([0.0, 1.0, -1.0, 1.0], 50)
    y = u + 0.05 * np.random.default_rng(seed).standard_normal(200)
    y = quantum * np.round(y / quantum) if quantum else y
    part = slice(first, last, step)
    return Record.from_arrays(t[part] + shift, u[part], y[part], name=f"{seed}.csv")


@pytest.mark.parametrize(
    ("other", "common"),
    [
        ({}, 200),
        ({"shift": 33.3}, 200),
        ({"first": 60, "last": 120, "shift": -6.0}, 60),
        ({"first": 150, "shift": 1.7}, 50),
        ({"step": 3}, 67),
    ],
)
def test_copies_of_a_record_and_overlapping_records_are_refused(other, common):
    records = [noisy(1), noisy(), noisy(**other)]
    with pytest.raises(DataError, match=rf"records 2 \(0.csv\) and 3 \(0.csv\) have {common} of their samples"):
        as_records(records)


@pytest.mark.parametrize("quantum", [0.0, 0.1])
def test_repeated_experiments_and_neighbouring_parts_are_not_taken_as_copies(quantum):
    records = [noisy(seed, quantum=quantum) for seed in range(3)]
    parts = [noisy(5, last=100, quantum=quantum), noisy(5, first=99, quantum=quantum)]
    assert as_records([*records, *parts]) == [*records, *parts]
    reversed_input = replace(records[0], inputs=HeldSignal(records[0].t, -records[0].input.values))
    assert len(as_records([records[0], reversed_input])) == 2
