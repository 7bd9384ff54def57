"""``ctid track``: from a file to frequencies, or to one sentence."""

import json

import numpy as np
import pandas as pd
import pytest
from scipy.io import wavfile

T = 0.002 * np.arange(3000)


def signal(seed=0):
    rng = np.random.default_rng(seed)
    y = 1.5 * np.sin(2 * np.pi * 12.0 * T) + np.sin(2 * np.pi * 19.0 * T + 1.0)
    return y + 0.05 * rng.standard_normal(T.size)


def write(file, t, y, header="t,y"):
    lines = [header, *(f"{a:.9g},{b:.9g}" for a, b in zip(t, y, strict=True))]
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return file


@pytest.fixture
def record(tmp_path):
    return write(tmp_path / "record.csv", T, signal())


def test_table_track_and_figure(ctid, record, tmp_path):
    out = tmp_path / "new"
    text = ctid("track", record, "--tones", 2, "--out", out).stdout
    for part in ("record.csv: 3000 samples", "frequency [Hz]", "±", "Windows of", "track.svg"):
        assert part in text
    frame = pd.read_csv(out / "track.csv")
    valid = frame[frame["valid_1"] == 1]
    assert valid["frequency_1_hz"].median() == pytest.approx(12.0, abs=0.02)
    assert valid["omega_2"].median() == pytest.approx(2 * np.pi * 19.0, rel=1e-3)
    assert valid["amplitude_1"].median() == pytest.approx(1.5, rel=0.02)
    assert (out / "track.svg").read_bytes().startswith(b"<?xml")


def test_json_and_hdf5(ctid, record, tmp_path):
    out = tmp_path / "new"
    options = ("--tones", 2, "--every", 0.05, "--json", "--hdf5")
    options = (*options, "--out", out)
    done = ctid("track", record, *options)
    content = json.loads(done.stdout)
    assert content["method"] == "tone_windows"
    assert [tone["frequency_hz"] for tone in content["tones"]] == pytest.approx([12.0, 19.0], abs=0.05)
    assert content["every"] == pytest.approx(0.05, rel=0.1)
    assert content["written"] == [str(out / name) for name in ("track.h5", "track.svg", "track.json")]
    assert (out / "track.h5").is_file()
    assert json.loads(ctid("track", record, *options).stdout) == content


def test_units_windows_and_rates(ctid, tmp_path):
    common = ("--tones", 2, "--json", "--out", tmp_path / "out")
    expected = pytest.approx([12.0, 19.0], abs=0.05)

    def found(*arguments):
        content = json.loads(ctid("track", *arguments, *common).stdout)
        return content, [tone["frequency_hz"] for tone in content["tones"]]

    content, hertz = found(write(tmp_path / "ms.csv", 1e3 * T, signal(), "t [ms],y"), "--from", 1000, "--to", 5000)
    assert hertz == expected
    assert (content["start"], content["samples"]) == (pytest.approx(1.0), 2001)
    wavfile.write(tmp_path / "a.wav", 500, (8000 * signal()).astype(np.int16))
    assert found(tmp_path / "a.wav")[1] == expected
    assert found(write(tmp_path / "b.csv", np.arange(3000), signal(), "number,y"), "--rate", 500)[1] == expected
    assert found(tmp_path / "b.csv", "--interval", 0.002, "--window", 1.0)[0]["settings"]["longest_window"] == (
        pytest.approx(1.0, rel=0.05)
    )


def test_missing_samples_are_flagged(ctid, tmp_path):
    y = signal()
    y[1000:1400] = np.nan
    keep = np.isfinite(y)
    content = json.loads(
        ctid(
            *("track", write(tmp_path / "gap.csv", T[keep], y[keep]), "--tones", 2, "--json"),
            *("--out", tmp_path),
        ).stdout
    )
    assert content["missing"] == 400
    frame = pd.read_csv(tmp_path / "track.csv")
    inside = frame[(frame["t"] > T[1100]) & (frame["t"] < T[1300])]
    assert len(inside)
    assert (inside["valid_1"] == 0).all()
    assert inside["flags_1"].str.contains("gap").all()


@pytest.mark.parametrize(
    ("t", "y", "options", "message"),
    [
        (T, np.zeros(T.size), (), "is constant (0)"),
        (T, np.full(T.size, 4.0), (), "constant"),
        (T[:5], signal()[:5], (), "too few"),
        (T, np.random.default_rng(1).standard_normal(T.size), ("--tones", "auto"), "no tone stands out"),
        (T**1.1, signal(), (), "clock is not regular"),
        (T, signal(), ("--tones", 65), "--tones must be a number from 0 to 64, or auto"),
        (T, signal(), ("--every", -1), "--every"),
        (T, signal(), ("--window", 1000), "the longest window must be from"),
        (T, signal(), ("--rate", 0), "--rate"),
        (T, signal(), ("--rate", 5, "--interval", 2), "one of them"),
        (T, signal(), ("--signal", "z"), "'z'"),
        (T, signal(), ("--from", 100), "no sample lies"),
        (T, signal(), ("--from", 0.1, "--to", 0.11), "--from and --to leave 6 samples, from 0.1 to 0.11 s; there must"),
        (T, signal(), ("--from", "nan"), "--from must be an instant"),
        (T, signal(), ("--to", "inf"), "--to must be an instant"),
        (T, signal(), ("--from", 1e308), "no sample lies"),
        (T, signal(), ("--to", -1e308), "no sample lies"),
        (T, signal(), ("--window", 1e308), "the longest window must be from"),
        (T, signal(), ("--rate", 1e-320), "--rate must be a positive number"),
        (T, 1e200 * signal(), (), "give it in a unit in which it is between"),
        (T, np.where(np.random.default_rng(1).random(T.size) < 0.005, signal(), np.nan), (), "too few"),
    ],
)
def test_mistakes_are_one_sentence(ctid, tmp_path, t, y, options, message):
    file = write(tmp_path / "bad.csv", t, y)
    tones = () if "--tones" in options else ("--tones", 2)
    done = ctid("track", file, *tones, "--out", tmp_path / "out", *options, code=2)
    assert message in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("every", [50, 1e308])
def test_rows_farther_apart_than_the_record_is_long_are_one(ctid, record, tmp_path, every):
    done = ctid("track", record, "--tones", 2, "--every", every, "--out", tmp_path)
    assert len(pd.read_csv(tmp_path / "track.csv")) == 1
    # A slow machine may be told how far the record has been read.
    assert {line.split(": ")[0] for line in done.stderr.splitlines()} <= {record.name}


def test_many_single_samples_may_be_missing(ctid, tmp_path):
    y = np.where(np.random.default_rng(1).random(T.size) < 0.6, signal(), np.nan)
    out = tmp_path / "out"
    content = json.loads(ctid("track", write(tmp_path / "a.csv", T, y), "--tones", 2, "--json", "--out", out).stdout)
    assert [tone["frequency_hz"] for tone in content["tones"]] == pytest.approx([12.0, 19.0], abs=0.02)
    assert content["method"] == "tone_windows"


@pytest.mark.parametrize("name", ["track.csv", "track.svg", "track.json"])
def test_the_record_is_not_overwritten(ctid, tmp_path, name):
    file = write(tmp_path / name, T, signal())
    before = file.read_bytes()
    done = ctid("track", file, "--tones", 2, "--out", tmp_path, code=2)
    assert "would be overwritten" in done.stderr
    assert file.read_bytes() == before


def test_an_output_that_cannot_be_written(ctid, record, tmp_path):
    (tmp_path / "file").write_text("", encoding="utf-8")
    done = ctid("track", record, "--tones", 2, "--out", tmp_path / "file" / "deeper", code=6)
    assert "cannot be written" in done.stderr


def test_an_unknown_unit_of_time(ctid, tmp_path):
    file = write(tmp_path / "a.csv", T, signal(), "t [fortnights],y")
    assert "fortnights" in ctid("track", file, "--tones", 1, code=2).stderr


def test_a_page_is_made_of_a_track_and_its_record(ctid, record, tmp_path):
    out = tmp_path / "new"
    ctid("track", record, "--tones", 2, "--out", out)
    assert ctid("report", out / "track.json").stdout == f"{out / 'track.html'}\n"
    text = (out / "track.html").read_text(encoding="utf-8")
    assert "Tones of record.csv" in text
    assert "ctid track record.csv --tones 2" in text
    assert str(tmp_path) not in text
    elsewhere = record.rename(tmp_path / "elsewhere.csv")
    assert "--record FILE" in ctid("report", out / "track.json", code=2).stderr
    ctid("report", out / "track.json", "--record", elsewhere)
    assert "no validation record" in ctid("report", out / "track.json", "--validate", elsewhere, code=2).stderr
    assert "of one record" in ctid("report", out / "track.json", *(2 * ["--record", elsewhere]), code=2).stderr


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--tones", "many"), "--tones must be a number from 0 to 64, or auto, not 'many'"),
        (("--tones", -1), "--tones must be a number from 0 to 64"),
        (("--tones", 65), "--tones must be a number from 0 to 64"),
        (("--tones", 2, "--accuracy", 0), "--accuracy must be a positive number of hertz"),
    ],
)
def test_what_cannot_be_asked_for(ctid, record, tmp_path, options, message):
    assert message in ctid("track", record, *options, "--out", tmp_path / "out", code=2).stderr
    assert not (tmp_path / "out").exists()
