"""Text files of programs and people: content read, and exact messages about refused files."""

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctid_cli.errors import DataError
from ctid_cli.signals import text_file
from ctid_cli.signals.measurement import read_held_signal, read_measurement, read_record

#: Content of most files below.
T, U, Y = (0.0, 0.5, 1.0), (1.0, -1.5, 2.0), (0.25, np.nan, 3.0)
COMMA = "Numbers were read with decimal commas."
ANSI = "The file is not UTF-8; it was read as Windows-1252."
POINTS = "t{0}u{0}y\n0{0}1{0}0.25\n0.5{0}-1.5{0}\n1{0}2{0}3\n"
COMMAS = "t{0}u{0}y\n0{0}1{0}0,25\n0,5{0}-1,5{0}\n1{0}2{0}3\n"

#: Kind: content, notes.
READ = {
    "commas": (POINTS.format(","), ()),
    "semicolons, decimal commas": (COMMAS.format(";"), (COMMA,)),
    "tabs, decimal commas": (COMMAS.format("\t"), (COMMA,)),
    "blanks": ("t u y\n0  1  0.25\n0.5 -1.5 nan\n1\t2 3\n", ()),
    "commas, quoted decimal commas": ('t,u,y\n"0","1","0,25"\n"0,5","-1,5",""\n"1","2","3"\n', (COMMA,)),
    "UTF-8 with its mark": (POINTS.format(",").encode("utf-8-sig"), ()),
    "UTF-16": (POINTS.format(",").encode("utf-16"), ()),
    "Windows-1252": ("t [s],u [°C],y\n0,1,.25\n0.5,-1.5,\n1,2,3".encode("cp1252"), (ANSI,)),
    "CRLF, no end of the last line": (POINTS.format(",").replace("\n", "\r\n").rstrip(), ()),
    "CR": (POINTS.format(",").replace("\n", "\r"), ()),
    "units in brackets": ("time [s],u (V),y [mm]\n0,1,0.25\n0.5,-1.5,\n1,2,3\n", ()),
    "units behind slashes": ("t/s,u/V,y / mm\n0,1,0.25\n0.5,-1.5,\n1,2,3\n", ()),
    "units between blanks": ("t [s] u [V] y [mm]\n0 1 0.25\n0.5 -1.5 nan\n1 2 3\n", ()),
    "units in a second line": (
        "t;u;y\n[s];(V);mm\n0;1;0.25\n0.5;-1.5;\n1;2;3\n",
        ("Line 2 was taken as the units of the columns.",),
    ),
    "comments above": ("# pump 3\n% 2 Hz\n\n" + POINTS.format(","), ()),
    "names in a comment": ("# pump 3\n# t u y\n0 1 0.25\n0.5 -1.5 nan\n1 2 3\n", ()),
    "separators at the ends": ("t,u,y,\n0,1,0.25,,\n0.5,-1.5,,,\n1,2,3,\n", ()),
    "blank lines": ("t,u,y\n0,1,0.25\n\n0.5,-1.5,NA\n,,\n1,2,3\n\n", ()),
    "dates": (
        "Timestamp,u,y\n2024-02-29T23:59:59.5Z,1,0.25\n2024-03-01 00:00Z,-1.5,\n2024-03-01T02:00:00.5+02:00,2,3\n",
        ("Times are in seconds after 2024-02-29T23:59:59.5Z.",),
    ),
    "last line cut": (
        POINTS.format(",") + "1.5,2",
        ("Line 5, the last, breaks off before its last field; it was left out.",),
    ),
    "text that is not used": (
        "note,t,u,y\nstart,0,1,0.25\na;b,0.5,-1.5,\n5.1,1,2,3\n",
        ("Column 'note' is not used.",),
    ),
}

TOGETHER = "which is a number with a decimal point, unlike the first 50 lines; write all with one decimal sign"
NAMES = "The first line that is no comment must name the columns, separated by commas, semicolons, tabs or blanks"
THREE = f"and nothing else; a record needs a time, an input and an output. {NAMES}"
FOUR = "'t', 'a', 'b', 'c'"
ONE = "; say which one (option time, --time NAME)"
WHICH = ". Say which one is the input (option input, --input NAME)"
SIX = "the line has 6 fields where line 1 names 3"
COMMAS_TWICE = "; numbers with decimal commas need another separator, such as the semicolon"
COMMENT = "which is a comment; move comments above the names of the columns, or delete them"
QUOTE = "a quotation mark is opened and never closed; export the file anew, or correct the line"
GAPS = "; only the output may have gaps"
EMPTY = "; missing samples are NaN, or empty fields of a file"
STRICTLY = "on line 3; times must increase strictly"
INSTANT = "every sample needs its instant"
NO_TEXT = "this is not a text file in UTF-8, or in UTF-16 with a byte order mark"
KINDS = "records are read from text (.csv, .txt), MATLAB files (.mat) and HDF5 files (.h5)"
DATE = "which is a date or a time of day; write times as 2024-03-01T12:30:00.5, or as seconds since the first sample"
DAY = "2023-02-2"
NO_DAY = f"column 't' holds '{DAY}9T12:00', which is not a date and a time of day like {DAY}8T12:00"
MARKS = "which is a number with separators between its digits; write it with digits and one decimal sign"
NUMBER = "which is not a number; leave the field empty if the sample is missing"
NO_NAMES = ":1: the first line names no columns; it must name them, for example t,u,y"
HUGE = "give it in a unit in which it is between"
#: Kind: content, the message after the file name.
REFUSED = {
    "empty": ("", ":1: the file is empty; its first line must name the columns"),
    "header only": ("t,u,y\n", ":2: the file has a header and no data"),
    "no header": ("0,1,2\n1,1,2\n", NO_NAMES),
    "nameless": (",,\n0,1,2\n", ":1: the first line names no columns; it must name them, for example t,u,y"),
    "one column": ("y\n0\n1\n", f":1: the file has 'y' {THREE}"),
    "names twice": ("t,u,u,y\n0,1,2,3\n", ":1: 2 columns are called 'u'; rename all but one"),
    "two times": ("t [s],t (h),u,y\n0,1,2,3\n", f":1: 't [s]' and 't (h)' may all be the time{ONE}"),
    "unknown names": ("t,a,b,c\n0,1,2,3\n", f":1: no column is called 'u' or 'input'; the file has {FOUR}{WHICH}"),
    "word": ("t,u,y\n0,1,2\n\n1,one,2\n", f":4: column 'u' holds 'one', {NUMBER}"),
    "thousands mark": ("t;u;y\n0;1;2\n1;1.000,5;2\n", f":3: column 'u' holds '1.000,5', {MARKS}"),
    "other decimal sign": ("t;u;y\n0;1,5;2,5\n1;1.5;2\n", f":3: column 'u' holds '1.5', {TOGETHER}"),
    "decimal commas between commas": ("t,u,y\n0,0,1,5,2,5\n0,5,1,5,2,5\n", f":2: {SIX}{COMMAS_TWICE}"),
    "too many fields": ("t;u;y\n0;1;2\n1;1;2;7\n", ":3: the line has 4 fields where line 1 names 3"),
    "comment between": ("t,u,y\n0,1,2\n# pause\n1,1,2\n", f":3: column 't' holds '# pause', {COMMENT}"),
    "dates": ("t,u,y\n1.3.2024 12:00:00,1,2\n", f":2: column 't' holds '1.3.2024 12:00:00', {DATE}"),
    "date that does not exist": (f"t,u,y\n{DAY}8T12:00,1,2\n{DAY}9T12:00,1,2\n", f":3: {NO_DAY}"),
    "open quotation mark": ('t,u,y\n0,1,"2\n1,1,2\n', f":2: {QUOTE}"),
    "time missing": ("t,u,y\n0,1,2\n,1,2\n", f":3: time 't' is missing or not finite; {INSTANT} [s]"),
    "time by position": (
        "b,u,c\n2,1,0\n1,1,1\n",
        ":3: time 'b' goes back to 1 s after 2 s on line 2; times must increase strictly. 'b' was taken as the time by "
        "its position; if it is not, name the right one (option time, --time NAME)",
    ),
    "time repeated": ("t [ms],u,y\n0,1,2\n5,1,2\n5,1,2\n", f":4: time 't [ms]' repeats 5 ms after 5 ms {STRICTLY}"),
    "time going back": ("t,u,y\n0,1,2\n1,1,2\n\n0.5,1,2\n", f":5: time 't' goes back to 0.5 s after 1 s {STRICTLY}"),
    "input missing": ("t,u,y\n0,1,2\n1,nan,2\n", f":3: input 'u' is missing or not finite{GAPS}"),
    "output infinite": ("t,u,y\n0,1,2\n1,1,-inf\n", f":3: output 'y' is infinite{EMPTY}"),
    "no output": ("t,u,y\n0,1,\n1,1,nan\n", ":2: no sample of output 'y' is a finite number"),
    "huge numbers": ("t,u,y\n0,1,2\n1,1e300,2\n", f":3: input 'u' reaches 1e+300; {HUGE} 1e-60 and 1e+60"),
    "no text": (
        b"\x89PNG\r\n\x1a\n\x00\x00", f": {NO_TEXT}; {KINDS}"),
}  # fmt: skip


@pytest.mark.parametrize("kind", READ)
def test_one_record_in_many_ways(write, kind):
    content, notes = READ[kind]
    found = read_measurement(write(content))
    assert (found.record.t.tolist(), found.record.input.values.tolist()) == (list(T), list(U))
    assert np.array_equal(found.record.y, Y, equal_nan=True)
    assert found.notes == notes
    if kind.startswith("units"):
        assert (found.time_unit, found.input_unit, found.output_unit) == ("s", "V", "mm")


@pytest.mark.parametrize("kind", REFUSED)
def test_each_refusal_says_where_and_what_to_do(write, kind):
    content, message = REFUSED[kind]
    path = write(content)
    with pytest.raises(DataError) as error:
        read_measurement(path)
    assert str(error.value) == f"{path}{message}"


@pytest.mark.slow
def test_a_word_and_a_field_too_many_are_found_far_down(write):
    rows = [f"{k},1,{k}" for k in range(200_000)]
    for row, message in (("190000,1,off", "column 'y' holds 'off'"), ("190000,1,2,5", "the line has 4 fields")):
        with pytest.raises(DataError, match=rf":190002: {message}"):
            read_record(write("\n".join(["t,u,y", *rows[:190_000], row, *rows[190_001:]])))


@given(st.lists(st.tuples(st.floats(-1e9, 1e9), st.floats(-1e59, 1e59) | st.just(float("nan"))), min_size=1))
def test_written_numbers_come_back_exactly(tmp_path_factory, rows):
    path = tmp_path_factory.mktemp("roundtrip") / "record.csv"
    rows = [*rows, (1.0, 1.0)]  # at least one finite output
    path.write_text("t,u,y\n" + "".join(f"{k},{u!r},{y!r}\n" for k, (u, y) in enumerate(rows)))
    record = read_record(path)
    assert np.array_equal(record.input.values, [u for u, _ in rows])
    assert np.array_equal(record.y, [y for _, y in rows], equal_nan=True)


@given(
    st.lists(st.floats(-1e9, 1e9), min_size=6, max_size=12),
    st.sampled_from(["{!r}", "{:.18e}", "{:.25f}", "{:+.3g}", "{:.0f}."]),
    st.sampled_from([",", ";", "\t", "  "]),
)
def test_a_small_file_is_read_like_a_large_one(tmp_path_factory, values, form, separator):
    rows = list(zip(values[::2], values[1::2], strict=False))
    lines = [separator.join(["t", "u", "y"])]
    lines += [separator.join([f"{k}", form.format(u), form.format(y)]) for k, (u, y) in enumerate(rows)]
    path = tmp_path_factory.mktemp("small") / "record.csv"
    path.write_text("\n".join(lines))
    table = text_file.read_text_table(path)
    small = table.read(("t", "u", "y"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(text_file, "_plain_numbers", lambda *_: None)
        large = table.read(("t", "u", "y"))
    for name, column in small.values.items():
        assert column.tobytes() == large.values[name].tobytes()
        assert column.strides == large.values[name].strides


def test_offsets_are_removed_only_when_asked(write):
    path = write("t,u,y\n0,1,10\n1,3,\n2,5,20\n")
    assert read_record(path).y[0] == 10.0
    record = read_record(path, offset="remove")
    assert record.input.values.tolist() == [-2.0, 0.0, 2.0]
    assert record.y[[0, 2]].tolist() == [-5.0, 5.0]
    with pytest.raises(ValueError, match="offset must be 'none' or 'remove', not 'yes'"):
        read_record(path, offset="yes")


def test_seconds_are_expected_unless_the_unit_is_named(write):
    path = write("t [ms],u,y\n0,1,2\n5,2,3\n")
    for read in (read_record, read_held_signal):
        with pytest.raises(DataError, match=r":1: the time 't \[ms\]' is in ms, and seconds are expected; convert"):
            read(path)
    assert read_record(path, time="t [ms]").t.tolist() == [0.0, 5.0]


def test_hdf5_has_a_data_set_for_each_column(tmp_path):
    path = tmp_path / "rig.h5"
    with h5py.File(path, "w") as file:
        for name, values, unit in (("t", T, "s"), ("u", U, "V"), ("y", Y, "mm")):
            file.create_dataset(name, data=values).attrs["unit"] = unit
        file["note"] = "pump 3"
    found = read_measurement(path)
    assert np.array_equal(found.record.y, Y, equal_nan=True)
    assert (found.time_unit, found.input_unit, found.output_unit) == ("s", "V", "mm")
    with pytest.raises(DataError, match=r"rig\.h5: data set 'note' does not hold numbers"):
        read_measurement(path, input="note")
    with h5py.File(path, "r+") as file:
        file["z"] = h5py.ExternalLink("other.h5", "z")
    with pytest.raises(DataError, match=r"rig\.h5: 'z' in it is a link to another place"):
        read_measurement(path)
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(DataError, match=r"this is not an HDF5 file, or a damaged one; save each column as a data set"):
        read_measurement(path)


def test_a_missing_file(tmp_path):
    for name in ("absent.csv", "absent.mat", "absent.h5"):
        with pytest.raises(DataError, match="does not exist; relative names start at "):
            read_measurement(tmp_path / name)
