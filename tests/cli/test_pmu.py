"""``ctid track --pmu`` and ``ctid check pmu``: from a mains record to synchrophasors, or to one sentence."""

import json

import numpy as np
import pandas as pd
import pytest

T = np.arange(2000) / 2000.0


@pytest.fixture
def mains(tmp_path):
    phases = [325.0 * np.cos(2 * np.pi * 59.9 * T + 0.2 - 2 * np.pi * k / 3) for k in range(3)]
    file = tmp_path / "mains.csv"
    frame = pd.DataFrame({"t [s]": T, **{f"v{k} [V]": phase for k, phase in zip("abc", phases, strict=True)}})
    frame.to_csv(file, index=False)
    return file


def test_columns_figure_and_summary(ctid, mains, tmp_path):
    out = tmp_path / "new"
    text = ctid("track", mains, "--signal", "va", "--pmu", 60, "--out", out).stdout
    text = " ".join(text.split())
    for part in ("mains.csv: 2000 samples of 'va'", "Class P at 60 Hz, 60 reports a second", "frequency [Hz]"):
        assert part in text
    frame = pd.read_csv(out / "synchrophasors.csv")
    assert frame["frequency_hz"].to_numpy() == pytest.approx(59.9, abs=1e-6)
    assert frame["magnitude"].to_numpy() == pytest.approx(325 / np.sqrt(2), rel=1e-6)
    assert frame["angle"].to_numpy() == pytest.approx(0.2 - 2 * np.pi * 0.1 * frame["t"].to_numpy(), abs=1e-6)
    assert (frame["valid"] == 1).all()
    assert (out / "synchrophasors.svg").read_bytes().startswith(b"<?xml")


def test_three_phases_as_json(ctid, mains, tmp_path):
    options = ("--signal", "va,vb,vc", "--pmu", 60, "--pmu-class", "M", "--reporting-rate", 30, "--json")
    content = json.loads(ctid("track", mains, *options, "--out", tmp_path, "--format", "h5").stdout)
    assert content["signals"] == ["va", "vb", "vc"]
    assert (content["performance_class"], content["reporting_rate"]) == ("M", 30)
    assert content["frequency_hz"]["median"] == pytest.approx(59.9, abs=1e-6)
    assert content["written"] == [str(tmp_path / "synchrophasors.h5"), str(tmp_path / "synchrophasors.svg")]


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (("--pmu", 60, "--tones", 2), "--tones does not go together with --pmu"),
        (("--pmu", 60, "--window", 2), "--window does not go together with --pmu"),
        (("--pmu", 60, "--every", 2), "--every does not go together with --pmu"),
        (("--pmu", 60, "--method", "drem_window"), "--method does not go together with --pmu"),
        (("--pmu-class", "M"), "--pmu-class belongs to synchrophasors; add --pmu 50 or --pmu 60"),
        (("--reporting-rate", 50), "--reporting-rate belongs to synchrophasors"),
        (("--pmu", 55), "50 or 60 Hz, not 55"),
        (("--pmu", 50, "--signal", "va", "--reporting-rate", 60), "at 50 Hz the standard has 10, 25, 50 and 100"),
        (("--pmu", 50, "--signal", "va,vb"), "--signal names 2 signals"),
        (("--pmu", 50, "--signal", "va,vb,vx"), "vx"),
        (("--pmu", 50, "--signal", "va,vb,va"), "--signal va,vb,va names one signal twice"),
        (("--pmu", 50, "--signal", "va", "--to", 0.03), "there is no reporting instant"),
        (("--pmu", 50, "--signal", "va", "--rate", 400), "600 Hz"),
    ],
)
def test_mistakes_end_in_one_sentence(ctid, mains, tmp_path, options, sentence):
    done = ctid("track", mains, *options, "--out", tmp_path, code=2)
    assert sentence in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert not (tmp_path / "synchrophasors.csv").exists()


def test_missing_samples_are_told_and_there_is_no_page(ctid, mains, tmp_path):
    lines = mains.read_text(encoding="utf-8").splitlines()
    holes = tmp_path / "holes.csv"
    holes.write_text("\n".join([*lines[:30], *lines[33:]]) + "\n", encoding="utf-8")
    text = ctid("track", holes, "--signal", "va", "--pmu", 60, "--out", tmp_path).stdout
    assert "missing: 3 samples of 'va'" in " ".join(text.split())
    refused = ctid("report", tmp_path / "synchrophasors.csv", code=2).stderr
    assert "is neither a fit nor a track" in refused


def test_the_record_is_not_overwritten(ctid, mains):
    record = mains.rename(mains.parent / "synchrophasors.csv")
    before = record.read_bytes()
    done = ctid("track", record, "--signal", "va", "--pmu", 60, "--out", record.parent, code=2)
    assert "would be overwritten" in done.stderr
    assert record.read_bytes() == before


def test_check_pmu(ctid, tmp_path):
    done = ctid("check", "pmu", "--nominal", 60, "--rate", 1920, "--out", tmp_path, "--strict")
    assert done.stdout.startswith("PASS: class P at 60 Hz, 60 reports a second: all 28 limits are kept.")
    assert "harmonics up to the 15th" in done.stdout
    frame = pd.read_csv(tmp_path / "check_pmu.csv")
    assert frame["passed"].all()
    assert set(frame.columns) == {"test", "quantity", "unit", "worst", "limit", "passed", "condition", "source"}
    content = json.loads(ctid("check", "pmu", "--nominal", 60, "--rate", 1920, "--json").stdout)
    assert content["passed"]
    assert [row["worst"] for row in content["limits"]] == pytest.approx(list(frame["worst"]))
    assert "720 Hz" in ctid("check", "pmu", "--nominal", 60, "--rate", 600, code=2).stderr
    assert "50 or 60" in ctid("check", "pmu", "--nominal", 55, code=2).stderr
