"""Files: what is read, and that every refusal names the file and the line."""

import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctid_cli.errors import DataError
from ctid_cli.signals.measurement import read_held_signal, read_record


@pytest.fixture
def write(tmp_path):
    def to_file(text, name="pump.csv"):
        path = tmp_path / name
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return to_file


# --- what is read ---------------------------------------------------------------------------------


def test_columns_become_a_record(write):
    record = read_record(write("t,u,y\n0,1,0.5\n0.1,1e-3,-2E1\n0.2,-1,3\n"))
    assert record.t.tolist() == [0.0, 0.1, 0.2]
    assert record.input.values.tolist() == [1.0, 0.001, -1.0]
    assert record.y.tolist() == [0.5, -20.0, 3.0]
    assert record.input.hold == "zoh"
    assert record.input_on_grid
    assert record.name.endswith("pump.csv")


def test_columns_are_chosen_by_name_and_others_ignored(write):
    path = write("note,valve [%],seconds,level\nfirst,5,0,1\nsecond,6,1,2\n")
    record = read_record(path, time="seconds", input="valve [%]", output="level", hold="foh")
    assert record.input.at(0.5) == 5.5
    assert record.y.tolist() == [1.0, 2.0]


def test_gaps_of_the_output_are_masked(write):
    record = read_record(write("t,u,y\n0,1,2\n1,1,\n2,1,NaN\n3,1,nan\n4,1,NA\n5,1\n6,1,8\n"))
    assert record.valid.tolist() == [True, False, False, False, False, False, True]
    assert record.n_samples == 7


@pytest.mark.parametrize(
    "text",
    [
        "t,u,y\r\n0,1,2\r\n1,3,4\r\n",
        "\ufefft,u,y\n0,1,2\n1,3,4",
        " t , u , y \n 0 , 1 , 2 \n 1 , 3 , 4 \n",
        '"t","u","y"\n"0","1","2"\n"1","3","4"\n',
        "t,u,y\n0,1,2\n\n1,3,4\n\n\n",
        "t,u,y,\n0,1,2,\n1,3,4,\n",
        "t,u,y\n0,1,2,\n1,3,4,\n",
    ],
    ids=[
        "windows",
        "byte order mark",
        "spaces",
        "quotes",
        "blank lines",
        "end commas",
        "end commas below the header",
    ],
)
def test_ways_of_writing_the_same_file(write, text):
    record = read_record(write(text))
    assert record.t.tolist() == [0.0, 1.0]
    assert record.input.values.tolist() == [1.0, 3.0]
    assert record.y.tolist() == [2.0, 4.0]


def test_numbers_are_not_held_as_text(write):
    # The peak of a hundred thousand rows read as text is above 40 MB.
    path = write("t,u,y\n" + "".join(f"{k},{k % 7},{0.5 * k}\n" for k in range(100_000)))
    read_record(path)
    tracemalloc.start()
    record = read_record(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert record.n_samples == 100_000
    assert peak < 20e6


def test_a_word_among_many_numbers_is_still_found(write):
    rows = [f"{k},1,{k}" for k in range(300_000)]
    rows[290_000] = "290000,1,off"
    with pytest.raises(DataError, match=r":290002: column 'y' holds 'off', which is not a number"):
        read_record(write("\n".join(["t,u,y", *rows])))


@given(st.lists(st.tuples(st.floats(-1e9, 1e9), st.floats(-1e59, 1e59) | st.just(float("nan"))), min_size=1))
def test_written_numbers_come_back_exactly(tmp_path_factory, rows):
    path = tmp_path_factory.mktemp("roundtrip") / "record.csv"
    rows = [*rows, (1.0, 1.0)]  # at least one finite output
    path.write_text("t,u,y\n" + "".join(f"{k},{u!r},{y!r}\n" for k, (u, y) in enumerate(rows)))
    record = read_record(path)
    assert np.array_equal(record.input.values, [u for u, _ in rows])
    assert np.array_equal(record.y, [y for _, y in rows], equal_nan=True)


def test_offsets_are_removed_only_when_asked(write):
    path = write("t,u,y\n0,1,10\n1,3,\n2,5,20\n")
    assert read_record(path).y[0] == 10.0
    record = read_record(path, offset="remove")
    assert record.input.values.tolist() == [-2.0, 0.0, 2.0]
    assert record.y[[0, 2]].tolist() == [-5.0, 5.0]


def test_input_alone(write):
    signal = read_held_signal(write("t,u\n0,1\n0.5,2\n"), hold="foh")
    assert signal.at(0.25) == 1.5


# --- what is refused ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", ":1: the file is empty; its first line must name the columns"),
        ("t,u,y\n", ":2: the file has a header and no data"),
        ("t,u,y\n,,\n\n", ":2: the file has a header and no data"),
        ("t\n0\n1\n", ":1: there is no column 'u'; the file has 't'"),
        ("t,u,Y\n0,1,2\n", ":1: there is no column 'y'; the file has 't', 'u', 'Y'. Did you mean 'Y'?"),
        ("time,u,y\n0,1,2\n", ":1: there is no column 't'; the file has 'time', 'u', 'y'"),
        ("t;u;y\n0;1;2\n", "Its columns seem to be separated by semicolons; separate them by commas"),
        ("t;u;y\n0;1;2\n1;1,5;2,5\n", "semicolons; separate them by commas, and write numbers with decimal points"),
        ("# 100 Hz\nt,u,y\n0,1,2\n", ":1: there is no column 't'; the file has '# 100 Hz'. The first line must name"),
        ("# Logger\n# 100 Hz\nt,u,y\n0,1,2\n", ":1: The first line must name the columns, and is '# Logger'; delete"),
        ("t,u,y\n(s),(V),(V)\n0,1,2\n", ":2: column 't' holds '(s)', which is not a number; only the first line"),
        ("t,u,y\n2024-03-01T12:00:00,1,2\n", "which is a date or a time of day; write times as numbers"),
        ("t,u,y\n12:00:01,1,2\n", "which is a date or a time of day; write times as numbers"),
        ("t\tu\ty\n0\t1\t2\n", "Its columns seem to be separated by tabs; separate them by commas"),
        ("0,1,2\n1,1,2\n", ":1: the first line holds numbers; it must name the columns, for example t,u,y"),
        ("t,u,y\n0,1,2\n1,one,2\n", ":3: column 'u' holds 'one', which is not a number"),
        ('t,u,y\n0,1,2\n\n1,1,"2,5"\n', ":4: column 'y' holds '2,5', which is not a number"),
        ("t,u,y\n0,1,2\n1,1,2,7\n", ":3: the line has 4 fields where those before it have 3"),
        (
            "t,u,y\n0,1,2\n1,1,2\n1,1,2\n",
            ":4: time 't' repeats 1 s after 1 s on line 3; times must increase strictly",
        ),
        ("t,u,y\n0,1,2\n1,1,2\n\n0.5,1,2\n", ":5: time 't' goes back to 0.5 s after 1 s on line 3"),
        ("t,u,y\n0,1,2\n,1,2\n", ":3: time 't' is missing or not finite"),
        ("t,u,y\n0,1,2\ninf,1,2\n", ":3: time 't' is missing or not finite"),
        ("t,u,y\n0,1,2\n1,nan,2\n", ":3: input 'u' is missing or not finite"),
        ("t,u,y\n0,1,2\n1,inf,2\n", ":3: input 'u' is missing or not finite"),
        ("t,u,y\n0,1,2\n1,1,-inf\n", ":3: output 'y' is infinite"),
        ("t,u,y\n0,1,\n1,1,nan\n", ":2: no sample of the output 'y' is a finite number"),
        (b"t,u,y\n0,1,\xff\xfe\n", ": this is not a text file in UTF-8"),
        (b"\x89PNG\r\n\x1a\n\x00\x00", ": this is not a text file in UTF-8"),
        ('t,u,y\n0,1,"2\n1,1,2\n', ": this is not a comma-separated file"),
    ],
)
def test_unusable_files_are_refused_with_their_line(write, text, message):
    path = write(text)
    with pytest.raises(DataError) as error:
        read_record(path)
    assert str(error.value).startswith(f"{path}:")
    assert message in str(error.value)


def test_missing_file_is_refused(tmp_path):
    with pytest.raises(DataError, match=r"absent\.csv: does not exist; relative names start at "):
        read_record(tmp_path / "absent.csv")
    with pytest.raises(DataError, match="is not a file"):
        read_record(tmp_path)


def test_unknown_hold_and_offset_are_refused(write):
    path = write("t,u,y\n0,1,2\n")
    with pytest.raises(ValueError, match="hold must be 'zoh' or 'foh' or 'band-limited', not 'cubic'"):
        read_record(path, hold="cubic")
    with pytest.raises(ValueError, match="offset must be 'none' or 'remove', not 'yes'"):
        read_record(path, offset="yes")


def test_importing_signals_does_not_import_pandas():
    import subprocess
    import sys

    code = "import sys, ctid_cli.signals; sys.exit('pandas' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
