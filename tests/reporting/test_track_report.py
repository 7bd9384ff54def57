"""What is said and written about a track."""

import io
import json

import h5py
import numpy as np
import pandas as pd
import pytest

from ctid_cli.frequency.flags import Flag
from ctid_cli.reporting.track_columns import flag_words, track_bytes, track_table
from ctid_cli.reporting.track_plot import track_drawing
from ctid_cli.reporting.track_report import track_object, track_text
from ctid_cli.reporting.track_summary import missing_lines, summarise, track_warnings
from ctid_cli.signals.sampled_signal import SampledSignal
from ctid_cli.tones.track import MissingLine, Track

ROWS = 40
HERTZ = np.column_stack((np.linspace(9.0, 11.0, ROWS), np.full(ROWS, 30.0)))


def make_track(flags=None, **known):
    flags = np.zeros(ROWS, np.uint16) if flags is None else flags
    omega = 2 * np.pi * HERTZ
    omega[(flags & int(Flag.GAP)) > 0] = np.nan
    amplitudes = np.full((ROWS, 2), [2.0, 0.5])
    return Track.of(0.1 * np.arange(ROWS), omega, flags, 0.1, amplitudes=amplitudes, **known)


@pytest.fixture(scope="module")
def chosen():
    t = 0.002 * np.arange(2000)
    y = 2 * np.sin(2 * np.pi * 10 * t) + 0.5 * np.sin(2 * np.pi * 30 * t)
    return SampledSignal(y, 0.002, 5.0, "string.csv", "y", "t", "s", "Pa", ("A note.",))


def some_invalid():
    flags = np.zeros(ROWS, np.uint16)
    flags[:10] = int(Flag.GAP)
    flags[10:12] = int(Flag.UNCERTAIN | Flag.COMPLEX_ROOTS)
    return flags


def test_summary_is_over_valid_rows():
    first, second = summarise(make_track(some_invalid()))
    assert first["frequency_hz"] == pytest.approx(np.median(HERTZ[12:, 0]))
    assert first["omega"] == pytest.approx(2 * np.pi * first["frequency_hz"])
    low, high = np.percentile(HERTZ[12:, 0], [16, 84])
    assert first["spread_hz"] == pytest.approx((high - low) / 2)
    assert (second["frequency_hz"], second["spread_hz"], second["amplitude"]) == (pytest.approx(30.0), 0.0, 0.5)
    assert first["valid_percent"] == pytest.approx(70.0)


def test_without_valid_rows_there_are_no_numbers(chosen):
    signal = chosen
    track = make_track(np.full(ROWS, int(Flag.UNCERTAIN), np.uint16))
    assert summarise(track)[0]["frequency_hz"] is None
    assert "No row is valid" in track_warnings(track)[0]
    assert "  -  " in track_text(signal, track)
    json.dumps(track_object(signal, track), allow_nan=False)


def test_warnings_name_the_reasons_the_most_frequent_first():
    words = track_warnings(make_track(some_invalid()))
    assert words[0] == "30 % of the rows are not valid."
    assert words[1].startswith("25 %: A sample")
    assert track_warnings(make_track()) == []


def test_text(chosen):
    text = track_text(chosen, make_track(some_invalid()))
    assert all(len(line) <= 100 for line in text.splitlines())
    for part in ("string.csv: 2000 samples", "A note.", "30.0000", "amplitude [Pa]", "70 %", "Warnings:", "from 5 to"):
        assert part in text


def test_csv_and_hdf5_hold_the_same():
    table = track_table(make_track(some_invalid()), 5.0)
    frame = pd.read_csv(io.BytesIO(track_bytes(table, "csv")), keep_default_na=True)
    assert list(frame.columns) == [
        "t",
        *("frequency_1_hz", "frequency_error_1_hz", "omega_1", "amplitude_1", "amplitude_error_1"),
        *("phase_1", "growth_1", "rate_1", "valid_1", "flags_1"),
        *("frequency_2_hz", "frequency_error_2_hz", "omega_2", "amplitude_2", "amplitude_error_2"),
        *("phase_2", "growth_2", "rate_2", "valid_2", "flags_2"),
    ]
    assert frame["t"].to_numpy() == pytest.approx(5.0 + 0.1 * np.arange(ROWS))
    assert frame["frequency_1_hz"][12:].to_numpy() == pytest.approx(HERTZ[12:, 0])
    assert frame["omega_1"][:10].isna().all()
    assert frame["flags_2"].fillna("").tolist() == ["gap"] * 10 + ["uncertain complex_roots"] * 2 + [""] * 28
    assert frame["valid_1"].tolist() == [0] * 12 + [1] * 28
    with h5py.File(io.BytesIO(track_bytes(table, "h5", "Pa"))) as store:
        units = {name: column.attrs.get("unit") for name, column in store.items()}
        assert (units["t"], units["omega_2"], units["frequency_1_hz"]) == ("s", "rad/s", "Hz")
        assert (units["amplitude_1"], units["amplitude_error_2"], units["valid_1"]) == ("Pa", "Pa", None)
        assert (units["frequency_error_1_hz"], units["phase_2"]) == ("Hz", "rad")
        assert (units["growth_1"], units["rate_1"], units["flags_1"]) == ("1/s", "Hz/s", None)
        assert list(store) == list(frame.columns)
        for name in frame.columns.drop(["flags_1", "flags_2"]):
            assert store[name][()] == pytest.approx(frame[name].to_numpy(), nan_ok=True)
        assert store["flags_1"].asstr()[()].tolist() == frame["flags_1"].fillna("").tolist()


def test_object_has_its_keys(chosen):
    content = track_object(chosen, make_track())
    assert content["method"] == "tone_windows"
    assert content["tones"][1]["frequency_hz"] == pytest.approx(30.0)
    assert set(content["settings"]) == {"interval", "kept_of", "filter_samples", "longest_window"}
    assert {"warnings", "notes", "chosen", "rows", "every", "missing"} <= content.keys()


def test_words_of_flags():
    assert flag_words(int(Flag.STARTING | Flag.GAP)) == "starting gap"


@pytest.mark.parametrize("tones", [1, 2, 7])
def test_figure(tones):
    flags = some_invalid()
    omega = 2 * np.pi * np.outer(1.0 + 0.01 * np.sin(np.arange(ROWS)), 10.0 * np.arange(1, tones + 1))
    track = Track.of(0.1 * np.arange(ROWS), omega, flags, 0.1, error=0.01 * omega, amplitudes=1.0 / omega)
    one, two = (track_drawing(track, 0.0, "Pa", "title").saved() for _ in range(2))
    assert one == two
    assert one.startswith(b"<?xml")
    assert b"#e4e4e4" in one  # the shade of what is not valid
    plain = Track.of(track.t, omega, np.zeros(ROWS, np.uint16), 0.1, amplitudes=1.0 / omega)
    assert b"#e4e4e4" not in track_drawing(plain, 0.0, None, "title").saved()


def test_figure_without_anything_valid():
    nothing = np.full((3, 2), np.nan)
    track = Track.of(np.arange(3.0), nothing, np.full(3, 2, np.uint16), 1.0)
    assert track_drawing(track, 0.0, None, "title").saved().startswith(b"<?xml")


def test_a_record_without_tones_has_a_text_a_file_and_a_figure(chosen):
    track = Track.of(np.arange(3.0), np.empty((3, 0)), np.zeros(3, np.uint16), 1.0)
    assert "No tone was asked for" in track_text(chosen, track)
    assert track_bytes(track_table(track, 0.0), "csv") == b"t\n0\n1\n2\n"
    assert track_drawing(track, 0.0, None, "title").saved().startswith(b"<?xml")


def test_the_error_of_the_mean_counts_common_samples_once():
    """One window as long as the record in all rows: the mean is as good as one row; windows apart: as sqrt(N) rows."""
    error = np.full((ROWS, 2), 2 * np.pi * 0.01)
    one = summarise(make_track(error=error, window=np.full((ROWS, 2), 0.1 * ROWS)))
    assert [tone["standard_error_hz"] for tone in one] == pytest.approx([0.01, 0.01])
    apart = summarise(make_track(error=error, window=np.full((ROWS, 2), 0.05)))
    assert apart[0]["standard_error_hz"] == pytest.approx(0.01 / np.sqrt(ROWS))
    # Half of the windows in common with each neighbour: the variance of the mean is twice as large.
    half = summarise(make_track(error=error, window=np.full((ROWS, 2), 0.2)))
    assert half[1]["standard_error_hz"] == pytest.approx(0.01 * np.sqrt(2 / ROWS))
    assert summarise(make_track())[0]["standard_error_hz"] is None


def test_tones_have_their_own_rows_that_are_not_valid(chosen):
    flags = np.zeros((ROWS, 2), np.uint16)
    flags[:20, 1] = int(Flag.ABSENT)
    flags[20:25, 1] = int(Flag.LINE_LEFT)
    track = make_track(error=np.full((ROWS, 2), 0.01))
    omega = track.omega.copy()
    omega[:20, 1] = np.nan
    track = Track.of(track.t, omega, flags, 0.1, error=track.error, amplitudes=track.amplitudes)
    first, second = summarise(track)
    assert (first["valid_percent"], second["valid_percent"]) == (100.0, 75.0)
    assert (second["begins"], second["ends"]) == (pytest.approx(2.0), pytest.approx(3.9))
    text = track_text(chosen, track)
    assert "25 % of the rows of tone 2 are not valid. 25 %: A further line" in text
    assert "of tone 1" not in text
    assert "from [s]" in text


@pytest.mark.parametrize(("accuracy", "bad"), [(None, [0, 1]), (0.011, [0, 0]), (0.005, [1, 1])])
def test_a_row_whose_standard_error_is_too_large_is_not_valid(accuracy, bad):
    hertz = np.full((ROWS, 2), 0.01)
    hertz[:, 1] = 0.031 if accuracy is None else 0.01
    track = make_track(error=2 * np.pi * hertz).of_accuracy(accuracy)
    late = slice(25, None)  # the first tone is above 10 Hz there
    assert (~track.valid[late]).mean(axis=0).tolist() == bad
    assert (track.flags[late] & int(Flag.INACCURATE) > 0).mean(axis=0).tolist() == bad
    assert track.of_accuracy(1.0).valid.all()
    assert make_track().of_accuracy(accuracy).valid.all()  # nothing is known to be too large


def test_lines_that_are_left_over_are_named_with_what_to_type():
    lines = (MissingLine(2 * np.pi * 85.0, 0.9, 0.1), MissingLine(2 * np.pi * 120.0, 0.25, 0.02))
    words = missing_lines(make_track(missing=lines))
    assert words == [
        "The tones leave lines at 85 Hz (amplitude 0.1, in 90 % of the rows) and 120 Hz (amplitude 0.02, in 25 % of "
        "the rows); ask for 4 tones to follow them too: --tones 4"
    ]
    assert missing_lines(make_track()) == []
