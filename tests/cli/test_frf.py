"""``ctid frf``: from a file to a frequency response, or to one sentence."""

import json

import numpy as np
import pandas as pd
import pytest

from ctid_cli import HeldSignal, TransferFunction, simulate
from tests.cli.records import write

INTERVAL = 0.1


def answered(file, u, seed=0, header="t [s],u [V],y [mm]", times=None):
    t = INTERVAL * np.arange(u.size) if times is None else times
    y = simulate(TransferFunction([2.0], [1.0, 1.0]), HeldSignal(t, u), t)
    y = y + 0.1 * np.random.default_rng(seed + 100).standard_normal(t.size)
    return write(file, (t, u, y), header)


@pytest.fixture
def record(tmp_path):
    return answered(tmp_path / "record.csv", np.random.default_rng(0).standard_normal(1500))


def test_table_file_and_figure(ctid, record, tmp_path):
    out = tmp_path / "new"
    text = ctid("frf", record, "--out", out).stdout
    for part in ("record.csv: 1500 samples", "local polynomials", "--hold zoh", "gain [mm/V]", "coherence", "frf.svg"):
        assert part in text
    frame = pd.read_csv(out / "frf.csv")
    w = frame["frequency [rad/s]"]
    near = (w > 0.5) & (w < 2.0)
    true = 2.0 / np.hypot(1.0, w)
    bias = frame["hold_bias [mm/V]"]
    inside = (frame["gain_low [mm/V]"] - bias <= true) & (true <= frame["gain_high [mm/V]"] + bias)
    assert inside[near].mean() > 0.8
    assert (out / "frf.svg").read_bytes().startswith(b"<?xml")
    content = json.loads(ctid("frf", record, "--method", "welch", "--json", "--out", tmp_path / "welch").stdout)
    for name in ("gain_low", "gain_high", "phase", "phase_half_width"):
        assert set(content[name]) == {None}


def test_periods_and_realisations(ctid, tmp_path):
    once = [np.random.default_rng(k).standard_normal(200) for k in range(3)]
    files = [answered(tmp_path / f"{k}.csv", np.tile(u, 6), k) for k, u in enumerate(once)]
    out = ("--json", "--out", tmp_path / "out")
    content = json.loads(ctid("frf", files[0], *out).stdout)
    assert (content["method"], len(content["frequencies"])) == ("periodic", 99)
    assert content["units"] == {"time": "s", "input": "V", "output": "mm"}
    several = json.loads(ctid("frf", *files, *out).stdout)
    assert several["distortion"] is not None
    assert "realisations" in " ".join(several["notes"])
    assert several["written"] == [str(tmp_path / "out" / "frf.csv"), str(tmp_path / "out" / "frf.svg")]


def test_other_methods_and_units(ctid, tmp_path):
    u = np.random.default_rng(0).standard_normal(1500)
    file = answered(tmp_path / "ms.csv", u, header="t [ms],u,y")
    out = ("--out", tmp_path / "out")
    text = ctid("frf", file, "--method", "welch", *out).stdout
    assert "Welch" in text
    assert "rad/ms" in text
    assert "rad/s" not in text
    assert "17 lines" in ctid("frf", file, "--width", 8, *out).stdout
    irregular = answered(tmp_path / "any.csv", u, times=np.cumsum(np.random.default_rng(1).uniform(0.05, 0.15, u.size)))
    assert "the clock is irregular" in ctid("frf", irregular, *out).stdout


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--period", 1000), "hold no two periods of 1000"),
        (("--method", "periodic"), "does not repeat itself"),
        (("--width", 2), "--width must be"),
        (("--width", 8, "--segment", 100), "belong to different methods"),
        (("--method", "welch", "--period", 100), "--period belongs to --method periodic"),
        (("--from", 100, "--to", 100.5), "at least"),
    ],
)
def test_bad_options(ctid, record, tmp_path, options, words):
    out = tmp_path / "new"
    done = ctid("frf", record, *options, "--out", out, code=2)
    assert words in done.stderr
    assert done.stderr.count("\n") == 1
    assert not out.exists()
