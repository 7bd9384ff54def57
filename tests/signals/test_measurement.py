"""Measured files: columns by name, units as labels, windows, and clear messages about unusable ones."""

import pytest

from ctid_cli.errors import DataError
from ctid_cli.signals.measurement import read_measurement

# --- accepted files -------------------------------------------------------------------------------


def test_columns_by_name_with_or_without_their_unit(write):
    path = write("note,valve [%],clock [min],level\na,5,0,1\nb,6,1,2\n")
    for valve in ("valve", "valve [%]"):
        measurement = read_measurement(path, time="clock", input=valve, output="level")
        assert (measurement.input, measurement.input_unit, measurement.time_unit) == ("valve [%]", "%", "min")
        assert measurement.record.y.tolist() == [1.0, 2.0]
    assert measurement.notes == ("Column 'note' is not used.",)


def test_three_columns_are_taken_by_position_and_a_note_says_so(write):
    path = write("when,valve,level\n0,5,1\n1,6,2\n")
    measurement = read_measurement(path)
    assert (measurement.time, measurement.input, measurement.output) == ("when", "valve", "level")
    assert measurement.notes == (
        "Columns were taken by their position: 'when' as the time, 'valve' as the input and 'level' as the output.",
    )
    # known columns are not assigned twice
    partly = read_measurement(write("level,valve,t\n1,5,0\n2,6,1\n"), output="level")
    assert (partly.time, partly.input, partly.output) == ("t", "valve", "level")
    assert partly.notes == ("Columns were taken by their position: 'valve' as the input.",)


def test_a_window_is_in_the_time_of_the_record(write):
    path = write("t,u,y\n" + "".join(f"{100 + k},{k},{k * k}\n" for k in range(10)))
    measurement = read_measurement(path, start=102.5, stop=106)
    assert measurement.record.t.tolist() == [103.0, 104.0, 105.0, 106.0]
    assert measurement.record.y.tolist() == [9.0, 16.0, 25.0, 36.0]
    assert measurement.record.input.t.tolist() == [103.0, 104.0, 105.0, 106.0]
    assert (measurement.start, measurement.stop) == (102.5, 106)
    assert measurement.notes[0].startswith("Only the 4 of 10 samples from 103 to 106 s are used")
    assert read_measurement(path, start=100, stop=109).notes == ()


def test_what_is_wrong_outside_the_window_does_not_matter(write):
    path = write("t,u,y\n0,1,2\n1,1,2\n2,nan,inf\n")
    assert read_measurement(path, stop=1).record.n_samples == 2
    with pytest.raises(DataError, match=r"pump\.csv:4: input 'u' is missing"):
        read_measurement(path, start=1)


# --- refused files --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "options", "message"),
    [
        ("t,u,y\n0,1,2\n1,1,2\n", {"input": "valv"}, ":1: there is no column 'valv'; the file has 't', 'u', 'y'"),
        ("t,u [V],u [mV],y\n0,1,2,3\n", {"input": "u"}, "'u [V]' and 'u [mV]' are all called 'u'; give the name with"),
        ("t,valve,y\n0,1,2\n", {"input": "Valv"}, "Did you mean 'valve'?"),
        ("t,u,y\n0,1,2\n", {"input": "y", "output": "y"}, ":1: 'y' cannot be both the input and the output"),
        ("t,u,y\n0,1,2\n", {"input": "y"}, ":1: no other column is called 'y' or 'output'; the file has 't', 'u', 'y'"),
        ("t,inputs_1,b,c\n0,1,2,3\n", {}, "Did you mean 'inputs_1'?"),
        ("t,u,y\n0,1,2\n1,1,2\n", {"start": 5}, ": no sample lies after 5 s; the record runs from 0 to 1 s"),
        ("t,u,y\n0,1,2\n1,1,2\n", {"start": 1, "stop": 0}, "the window from 1 to 0 s ends before it begins"),
        ("t,u,y\n0,1,2\n1,1,\n2,1,\n", {"start": 1}, ":3: no sample of output 'y' is a finite number"),
    ],
)
def test_one_sentence_with_file_and_line(write, text, options, message):
    path = write(text)
    with pytest.raises(DataError) as error:
        read_measurement(path, **options)
    assert str(error.value).startswith(f"{path}:")
    assert message in str(error.value)
    assert "\n" not in str(error.value)
