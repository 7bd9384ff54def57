"""What is said and written about a track."""

import io
import json

import h5py
import numpy as np
import pandas as pd
import pytest

from ctid_cli.canonical import plain
from ctid_cli.frequency.flags import Flag
from ctid_cli.reporting.column_file import frame_bytes, hdf5_bytes
from ctid_cli.reporting.track_plot import track_drawing
from ctid_cli.reporting.track_result import TrackResult, flag_names
from ctid_cli.signals.sampled_signal import SampledSignal
from ctid_cli.tones.summary import summarise
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


def coming_later():
    """Tones of which one is there for a part, with a line left over."""
    flags = np.zeros((ROWS, 2), np.uint16)
    flags[:20, 1] = int(Flag.ABSENT)
    flags[20:25, 1] = int(Flag.UNRESOLVED)
    lines = (MissingLine(2 * np.pi * 85.0, 0.9, 0.1), MissingLine(2 * np.pi * 120.0, 0.25, 0.02))
    track = make_track(error=np.full((ROWS, 2), 0.01), window=np.full((ROWS, 2), 0.2))
    omega = track.omega.copy()
    omega[:20, 1] = np.nan
    parts = {"error": track.error, "amplitudes": track.amplitudes, "window": track.window, "missing": lines}
    return Track.of(track.t, omega, flags, 0.1, **parts)


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


def test_a_summary_is_over_valid_rows():
    first, second = summarise(make_track(some_invalid()))
    assert first.frequency_hz == pytest.approx(np.median(HERTZ[12:, 0]))
    assert first.omega == pytest.approx(2 * np.pi * first.frequency_hz)
    low, high = np.percentile(HERTZ[12:, 0], [16, 84])
    assert first.spread_hz == pytest.approx((high - low) / 2)
    assert (second.frequency_hz, second.spread_hz, second.amplitude) == (pytest.approx(30.0), 0.0, 0.5)
    assert first.valid_percent == pytest.approx(70.0)
    _, later = summarise(coming_later())
    assert (later.valid_percent, later.begins, later.ends) == (75.0, pytest.approx(2.0), pytest.approx(3.9))


def test_csv_and_hdf5_hold_the_same(chosen):
    table = TrackResult(make_track(some_invalid()), chosen).to_frame()
    frame = pd.read_csv(io.BytesIO(frame_bytes(table)), keep_default_na=True)
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


def test_names_of_flags():
    assert flag_names(np.array([int(Flag.STARTING | Flag.GAP), 0], np.uint16)).tolist() == ["starting gap", ""]


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


def test_the_error_of_the_mean_counts_common_samples_once():
    """One window as long as the record in all rows: the mean is as good as one row; windows apart: as sqrt(N) rows."""
    error = np.full((ROWS, 2), 2 * np.pi * 0.01)
    one = summarise(make_track(error=error, window=np.full((ROWS, 2), 0.1 * ROWS)))
    assert [tone.standard_error_hz for tone in one] == pytest.approx([0.01, 0.01])
    apart = summarise(make_track(error=error, window=np.full((ROWS, 2), 0.05)))
    assert apart[0].standard_error_hz == pytest.approx(0.01 / np.sqrt(ROWS))
    # Half of the windows in common with each neighbour: the variance of the mean is twice as large.
    half = summarise(make_track(error=error, window=np.full((ROWS, 2), 0.2)))
    assert half[1].standard_error_hz == pytest.approx(0.01 * np.sqrt(2 / ROWS))
    assert np.isnan(summarise(make_track())[0].standard_error_hz)


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
