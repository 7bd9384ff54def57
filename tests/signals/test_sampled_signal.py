"""A signal with its clock, from all kinds of files."""

import sys

import numpy as np
import pytest
from scipy.io import wavfile

from ctid_cli.errors import DataError
from ctid_cli.signals.sampled_signal import read_sampled_signal

Y = np.round(np.sin(0.3 * np.arange(50)), 6)


def write(file, columns, header):
    rows = zip(*columns, strict=True)
    file.write_text("\n".join([header, *(",".join(f"{v:.9g}" for v in row) for row in rows)]) + "\n", encoding="utf-8")
    return file


def test_named_columns_and_units(tmp_path):
    file = write(tmp_path / "a.csv", (np.arange(50.0), Y, 2 * Y), "clock [ms],left,right (mV)")
    with pytest.raises(DataError, match=r"option time.*--interval"):
        read_sampled_signal(file, signal="left")
    with pytest.raises(DataError, match="option signal"):
        read_sampled_signal(file, time="clock")
    signal = read_sampled_signal(file, time="clock", signal="right")
    assert signal.samples == pytest.approx(2 * Y)
    assert (signal.time_unit, signal.unit, signal.time) == ("ms", "mV", "clock [ms]")
    assert signal.in_seconds().interval == pytest.approx(1e-3)
    with pytest.raises(DataError, match="'middle'"):
        read_sampled_signal(file, time="clock", signal="middle")
    with pytest.raises(DataError, match="both"):
        read_sampled_signal(file, time="left", signal="left")


def test_a_file_without_times(tmp_path):
    file = write(tmp_path / "a.csv", (Y,), "y")
    with pytest.raises(DataError, match="--interval"):
        read_sampled_signal(file)
    signal = read_sampled_signal(file, interval=0.25)
    assert (signal.interval, signal.start, signal.time) == (0.25, 0.0, None)
    assert read_sampled_signal(write(tmp_path / "one.csv", (Y[1:2],), "y"), interval=0.25).samples.tolist() == [Y[1]]
    with pytest.raises(DataError, match="the clock is at most 1e-30; give it in a unit"):
        read_sampled_signal(file, interval=1e-30)
    with pytest.raises(ValueError, match="interval"):
        read_sampled_signal(file, interval=0.0)


def test_missing_samples_and_missing_lines(tmp_path):
    keep = np.setdiff1d(np.arange(50), [10, 11, 30])
    y = Y.copy()
    y[20] = np.nan
    signal = read_sampled_signal(write(tmp_path / "a.csv", (0.1 * keep, y[keep]), "t,y"))
    assert np.flatnonzero(np.isnan(signal.samples)).tolist() == [10, 11, 20, 30]
    assert signal.missing == 4
    assert "3 instants" in signal.notes[0]
    assert signal.samples[[0, 9, 12, 49]] == pytest.approx(Y[[0, 9, 12, 49]])


def test_an_irregular_clock_is_refused_unless_one_is_given(tmp_path):
    t = 0.1 * np.arange(50)
    t[25] += 0.02
    file = write(tmp_path / "a.csv", (t, Y), "t,y")
    with pytest.raises(DataError, match=r"a.csv:27: the clock is not regular.*--interval"):
        read_sampled_signal(file)
    assert "not used" in read_sampled_signal(file, interval=0.1).notes[0]


def test_times_of_day_are_refused_unless_a_clock_is_given(tmp_path):
    file = tmp_path / "a.csv"
    file.write_text("time,y\n" + "".join(f"12:00:{k:02d},{y:.9g}\n" for k, y in enumerate(Y)))
    with pytest.raises(DataError, match=r"a.csv:2: .* a date or a time of day.*--interval SECONDS or --rate HERTZ"):
        read_sampled_signal(file)
    assert read_sampled_signal(file, interval=0.1).samples == pytest.approx(Y)


def test_most_lines_may_be_missing_from_a_regular_clock(tmp_path):
    kept = np.flatnonzero(np.random.default_rng(0).random(2000) < 0.3)
    file = write(tmp_path / "a.csv", (0.1 * kept, np.sin(0.01 * kept)), "t,y")
    signal = read_sampled_signal(file)
    assert signal.interval == pytest.approx(0.1)
    assert np.flatnonzero(np.isfinite(signal.samples)).tolist() == (kept - kept[0]).tolist()
    few = kept[::30]
    with pytest.raises(DataError, match=rf"the file has only {few.size + 1}; use a part"):
        read_sampled_signal(write(tmp_path / "b.csv", (0.1 * np.append(few, few[-1] + 1), np.append(few, 0.0)), "t,y"))


def test_a_window(tmp_path):
    file = write(tmp_path / "a.csv", (2.0 + 0.1 * np.arange(50), Y), "t,y")
    signal = read_sampled_signal(file, start=2.5, stop=3.0)
    assert signal.start == pytest.approx(2.5)
    assert signal.samples == pytest.approx(Y[5:11])


def test_sound(tmp_path):
    file = tmp_path / "a.wav"
    stereo = np.column_stack((Y, 0.5 * Y))
    wavfile.write(file, 8000, np.round(32767 * stereo).astype(np.int16))
    first, second = read_sampled_signal(file), read_sampled_signal(file, signal="channel 2")
    assert first.interval == 1 / 8000
    assert first.samples == pytest.approx(Y, abs=1e-4)
    assert second.samples == pytest.approx(0.5 * Y, abs=1e-4)
    assert "2 channels" in first.notes[0]
    wavfile.write(file, 8000, np.round(128 + 127 * Y).astype(np.uint8))
    assert read_sampled_signal(file).samples == pytest.approx(Y, abs=0.02)
    file.write_bytes(b"RIFF no sound at all")
    with pytest.raises(DataError, match="WAV"):
        read_sampled_signal(file)


def test_other_refusals(tmp_path):
    with pytest.raises(DataError, match="does not exist"):
        read_sampled_signal(tmp_path / "none.csv")
    with pytest.raises(DataError, match="no sample of signal 'y'"):
        read_sampled_signal(write(tmp_path / "a.csv", (np.arange(9.0), np.full(9, np.nan)), "t,y"))


def test_without_soundfile_it_is_said_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "soundfile", None)
    (tmp_path / "a.flac").write_bytes(b"fLaC")
    with pytest.raises(
        DataError,
        match=r"FLAC files are read with .* pip install 'ctid\[sound\]', or",
    ):
        read_sampled_signal(tmp_path / "a.flac")
