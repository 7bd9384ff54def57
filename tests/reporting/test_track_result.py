"""Text and files of a track."""

import io
import json

import h5py
import numpy as np
import pandas as pd
import pytest

from ctid_cli.canonical import plain
from ctid_cli.frequency.flags import Flag
from ctid_cli.reporting.column_file import csv_bytes, hdf5_bytes
from ctid_cli.reporting.track_result import TrackResult
from ctid_cli.signals.sampled_signal import SampledSignal
from ctid_cli.tones.track import Track
from tests.tones.made_tracks import HERTZ, ROWS, coming_later, make_track, some_invalid


@pytest.fixture(scope="module")
def chosen():
    t = 0.002 * np.arange(2000)
    y = 2 * np.sin(2 * np.pi * 10 * t) + 0.5 * np.sin(2 * np.pi * 30 * t)
    return SampledSignal(y, 0.002, 5.0, "string.csv", "y", "t", "s", "Pa", ("A note.",))


@pytest.mark.parametrize(
    "track",
    [
        pytest.param(make_track(some_invalid()), id="gaps"),
        pytest.param(coming_later(), id="a tone that comes later"),
        pytest.param(make_track(np.full(ROWS, int(Flag.UNCERTAIN), np.uint16)), id="nothing valid"),
        pytest.param(Track.of(np.arange(3.0), np.empty((3, 0)), np.zeros(3, np.uint16), 1.0), id="no tone"),
    ],
)
def test_printed(chosen, track, snapshot):
    result = TrackResult(track, chosen)
    assert result.summary() == snapshot
    json.dumps(plain(result.content()), allow_nan=False)
    assert result.drawing().saved().startswith(b"<?xml")


def test_an_amplitude_that_falls_is_said_to(chosen):
    track = make_track(np.zeros(ROWS, np.uint16))
    track.amplitudes[:, 1] = np.where(np.arange(ROWS) < 20, 4.0, 1.0)
    assert "The amplitude of tone 2 falls from 4 to 1 Pa." in TrackResult(track, chosen).summary()


def test_csv_and_hdf5_hold_the_same(chosen):
    table = TrackResult(make_track(some_invalid()), chosen).main_table()
    frame = pd.read_csv(io.BytesIO(csv_bytes(table)), keep_default_na=True)
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
    with h5py.File(io.BytesIO(hdf5_bytes(table))) as store:
        units = {name: column.attrs.get("unit") for name, column in store.items()}
        assert (units["t"], units["omega_2"], units["frequency_1_hz"]) == ("s", "rad/s", "Hz")
        assert (units["amplitude_1"], units["amplitude_error_2"], units["valid_1"]) == ("Pa", "Pa", None)
        assert (units["frequency_error_1_hz"], units["phase_2"]) == ("Hz", "rad")
        assert (units["growth_1"], units["rate_1"], units["flags_1"]) == ("1/s", "Hz/s", None)
        assert list(store) == list(frame.columns)
        for name in frame.columns.drop(["flags_1", "flags_2"]):
            assert store[name][()] == pytest.approx(frame[name].to_numpy(), nan_ok=True)
        assert store["flags_1"].asstr()[()].tolist() == frame["flags_1"].fillna("").tolist()
