"""What is said and written about a track."""

import io
import json

import h5py
import numpy as np
import pandas as pd
import pytest

from ctid_cli.frequency.automatic import choose_settings
from ctid_cli.frequency.flags import Flag
from ctid_cli.frequency.record_track import RecordTrack
from ctid_cli.reporting.track_plot import track_drawing
from ctid_cli.reporting.track_report import (
    flag_words,
    summarise,
    track_bytes,
    track_object,
    track_table,
    track_text,
    track_warnings,
)
from ctid_cli.signals.sampled_signal import SampledSignal

ROWS = 40
HERTZ = np.column_stack((np.linspace(9.0, 11.0, ROWS), np.full(ROWS, 30.0)))


def make_track(flags=None):
    flags = np.zeros(ROWS, np.uint16) if flags is None else flags
    omega = 2 * np.pi * HERTZ
    omega[(flags & int(Flag.GAP)) > 0] = np.nan
    return RecordTrack(0.1 * np.arange(ROWS), omega, flags, 0.1 * omega, np.full((ROWS, 2), [2.0, 0.5]), 0.1)


@pytest.fixture(scope="module")
def chosen():
    t = 0.002 * np.arange(2000)
    y = 2 * np.sin(2 * np.pi * 10 * t) + 0.5 * np.sin(2 * np.pi * 30 * t)
    signal = SampledSignal(y, 0.002, 5.0, "string.csv", "y", "t", "s", "Pa", ("A note.",))
    return signal, choose_settings(y, 0.002, 2)


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
    signal, settings = chosen
    track = make_track(np.full(ROWS, int(Flag.UNCERTAIN), np.uint16))
    assert summarise(track)[0]["frequency_hz"] is None
    assert "No row is valid" in track_warnings(track, settings)[0]
    assert "  -  " in track_text(signal, settings, track)
    json.dumps(track_object(signal, settings, track, []), allow_nan=False)


def test_warnings_name_the_reasons_the_most_frequent_first(chosen):
    words = track_warnings(make_track(some_invalid()), chosen[1])
    assert words[0] == "30 % of the rows are not valid."
    assert words[1].startswith("25 %: A sample")
    assert track_warnings(make_track(), chosen[1]) == []


def test_text(chosen):
    text = track_text(*chosen, make_track(some_invalid()))
    assert all(len(line) <= 100 for line in text.splitlines())
    for part in ("string.csv: 2000 samples", "A note.", "30.0000", "amplitude [Pa]", "70 %", "Warnings:", "from 5 to"):
        assert part in text


def test_csv_and_hdf5_hold_the_same():
    table = track_table(make_track(some_invalid()), 5.0)
    frame = pd.read_csv(io.BytesIO(track_bytes(table, "csv")), keep_default_na=True)
    assert list(frame.columns) == [
        *("t", "omega_1", "omega_2", "frequency_1_hz", "frequency_2_hz"),
        *("amplitude_1", "amplitude_2", "valid", "flags"),
    ]
    assert frame["t"].to_numpy() == pytest.approx(5.0 + 0.1 * np.arange(ROWS))
    assert frame["frequency_1_hz"][12:].to_numpy() == pytest.approx(HERTZ[12:, 0])
    assert frame["omega_1"][:10].isna().all()
    assert frame["flags"].fillna("").tolist() == ["gap"] * 10 + ["uncertain complex_roots"] * 2 + [""] * 28
    assert frame["valid"].tolist() == [0] * 12 + [1] * 28
    with h5py.File(io.BytesIO(track_bytes(table, "h5", "Pa"))) as store:
        units = {name: column.attrs.get("unit") for name, column in store.items()}
        assert (units["t"], units["omega_2"], units["frequency_1_hz"]) == ("s", "rad/s", "Hz")
        assert (units["amplitude_1"], units["valid"]) == ("Pa", None)
        assert list(store) == list(frame.columns)
        for name in frame.columns[:-1]:
            assert store[name][()] == pytest.approx(frame[name].to_numpy(), nan_ok=True)
        assert store["flags"].asstr()[()].tolist() == frame["flags"].fillna("").tolist()


def test_object_has_its_keys(chosen):
    content = track_object(*chosen, make_track(), [])
    assert content["method"] == "esprit"
    assert content["tones"][1]["frequency_hz"] == pytest.approx(30.0)
    assert content["settings"]["estimator"]["tones"] == 2
    assert {"warnings", "notes", "chosen", "rows", "every", "missing"} <= content.keys()


def test_words_of_flags():
    assert flag_words(int(Flag.STARTING | Flag.GAP)) == "starting gap"


@pytest.mark.parametrize("tones", [1, 2, 7])
def test_figure(tones):
    flags = some_invalid()
    omega = 2 * np.pi * np.outer(1.0 + 0.01 * np.sin(np.arange(ROWS)), 10.0 * np.arange(1, tones + 1))
    track = RecordTrack(0.1 * np.arange(ROWS), omega, flags, omega, 1.0 / omega, 0.1)
    one, two = (track_drawing(track, 0.0, "Pa", "title").saved() for _ in range(2))
    assert one == two
    assert one.startswith(b"<?xml")
    assert b"#e4e4e4" in one  # the shade of what is not valid
    plain = RecordTrack(track.t, omega, np.zeros(ROWS, np.uint16), omega, 1.0 / omega, 0.1)
    assert b"#e4e4e4" not in track_drawing(plain, 0.0, None, "title").saved()


def test_figure_without_anything_valid():
    nothing = np.full((3, 2), np.nan)
    track = RecordTrack(np.arange(3.0), nothing, np.full(3, 2, np.uint16), nothing, nothing, 1.0)
    assert track_drawing(track, 0.0, None, "title").saved().startswith(b"<?xml")
