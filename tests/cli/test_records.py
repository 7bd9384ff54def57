"""``ctid frf`` and ``ctid track`` on files of any clock, unit and format."""

import json

import numpy as np
import pandas as pd
import pytest
from scipy.io import wavfile

from ctid_cli import HeldSignal, TransferFunction, simulate
from tests.cli.records import tones, write

T, Y = tones().T


def response_record(file, u, seed=0, header="t [s],u [V],y [mm]", times=None):
    """Write the response of 2 / (p + 1), with noise."""
    t = 0.1 * np.arange(u.size) if times is None else times
    y = simulate(TransferFunction([2.0], [1.0, 1.0]), HeldSignal(t, u), t)
    return write(file, (t, u, y + 0.1 * np.random.default_rng(seed + 100).standard_normal(t.size)), header)


def test_periods_realisations_and_units(ctid, tmp_path):
    once = [np.random.default_rng(k).standard_normal(200) for k in range(3)]
    files = [response_record(tmp_path / f"{k}.csv", np.tile(u, 6), k, "t [ms],u,y") for k, u in enumerate(once)]
    content = json.loads(ctid("frf --json --out", tmp_path, files[0]).stdout)
    assert (content["method"], len(content["frequencies"]), content["distortion"]) == ("periodic", 99, None)
    assert content["units"] == {"time": "ms", "input": "in", "output": "out"}
    several = json.loads(ctid("frf --json --out", tmp_path, *files).stdout)
    assert several["distortion"] is not None
    assert "realisations" in " ".join(several["notes"])
    text = ctid("frf --width 8 --out", tmp_path, files[0]).stdout
    assert "17 lines" in text
    assert "rad/ms" in text
    irregular = np.cumsum(np.random.default_rng(1).uniform(0.05, 0.15, 1200))
    file = response_record(tmp_path / "any.csv", np.tile(once[0], 6), times=irregular)
    assert "the clock is irregular" in ctid("frf --out", tmp_path, file).stdout


def unusual(folder):
    """Write the two tones in another unit of time, as sound, without times, and with single samples missing."""
    number, keep = np.arange(T.size), np.random.default_rng(1).random(T.size) < 0.6
    wavfile.write(folder / "sound.wav", 500, (8000 * Y).astype(np.int16))
    write(folder / "ms.csv", (1e3 * T, Y), "t [ms],y")
    write(folder / "numbered.csv", (number, Y), "number,y")
    write(folder / "some.csv", (T, np.where(keep, Y, np.nan)), "t,y")


@pytest.mark.parametrize(
    ("command", "expected"),
    [
        ("track sound.wav", {"interval": 0.002}),
        ("track ms.csv --from 1000 --to 5000", {"start": 1.0, "samples": 2001}),
        ("track numbered.csv --rate 500 --hdf5", {"interval": 0.002}),
        ("track numbered.csv --interval 0.002 --every 0.05", {"every": 0.05}),
        ("track some.csv --accuracy 0.5", {"samples": 3000, "accuracy_hz": 0.5}),
        ("track some.csv --every 1e308", {"rows": 1}),
    ],
)
def test_tones_are_found(ctid, tmp_path, monkeypatch, command, expected):
    monkeypatch.chdir(tmp_path)
    unusual(tmp_path)
    content = json.loads(ctid(f"{command} --tones 2 --json --out new").stdout)
    assert [tone["frequency_hz"] for tone in content["tones"]] == pytest.approx([12.0, 19.0], abs=0.05)
    assert {key: content[key] for key in expected} == pytest.approx(expected, rel=0.1)
    table = "new/track.h5" if "--hdf5" in command else "new/track.csv"
    assert content["written"] == [table, "new/track.svg", "new/track.json"]
    if table.endswith("csv"):
        assert len(pd.read_csv(table)) == content["rows"]
