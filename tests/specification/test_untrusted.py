"""Untrusted specifications and records must not read elsewhere, reveal what they read, or run for ever."""

import os

import numpy as np
import pytest

from ctid_cli.errors import DataError, SpecError, UsageError
from ctid_cli.signals.array_file import read_array_table
from ctid_cli.signals.measurement import read_measurement
from ctid_cli.signals.record import Record
from ctid_cli.specification.load import load_spec

MEASURED = """\
experiment: measured
data:        {file: %s}
estimators:
  known:     {kind: srivc, poles: 1, zeros: 0, svf_cutoff: 2.0}
"""
SIMULATED = """\
experiment: many
system: {numerator: [1], denominator: [1, 1]}
excitation: {kind: prbs, stages: 6, clock_period: 1.0, amplitude: 1.0}
sampling: %s
noise: {kind: white, snr_db: %s}
estimators: {one: {kind: srivc, poles: 1, zeros: 0, svf_cutoff: %s}}
monte_carlo: {runs: %s, seed: 1}
"""
REGULAR = "{kind: regular, interval: 0.1, samples: 400}"
ROWS = "".join(f"{0.1 * k:.1f},{(-1) ** (k // 3)},{k % 5}\n" for k in range(40))


@pytest.fixture
def inside(tmp_path):
    """Return a folder for a specification, next to a record outside it, with links to that record."""
    (tmp_path / "outside.csv").write_text("t,u,y\n" + ROWS)
    (tmp_path / "inside" / "below").mkdir(parents=True)
    (tmp_path / "inside" / "link.csv").symlink_to(tmp_path / "outside.csv")
    (tmp_path / "inside" / "folder").symlink_to(tmp_path)
    (tmp_path / "inside" / "below" / "record.csv").write_text("t,u,y\n" + ROWS)
    return tmp_path / "inside"


def specification(folder, file):
    path = folder / "spec.yaml"
    path.write_text(MEASURED % file)
    return path


@pytest.mark.parametrize("name", ["../outside.csv", "{inside}/../outside.csv", "link.csv", "folder/outside.csv"])
def test_data_outside_the_folder_of_the_specification(name, inside):
    file = specification(inside, name.format(inside=inside))
    with pytest.raises(SpecError, match=r"outside the folder.*--allow-outside"):
        load_spec(file)
    assert load_spec(file, allow_outside=True).measured is not None


def test_data_below_the_folder_of_the_specification(inside, monkeypatch):
    monkeypatch.chdir(inside)
    assert load_spec(specification(inside, "below/record.csv").relative_to(inside)).measured is not None


@pytest.mark.parametrize(
    ("name", "repeated"), [("record.csv", True), ("../outside.csv", False), ("/proc/self/environ", False)]
)
def test_nothing_of_a_file_elsewhere_is_repeated(inside, name, repeated):
    for file in (inside / "record.csv", inside.parent / "outside.csv"):
        file.write_text("rooster:x:0,u,y\n0,1,secret\n")
    with pytest.raises(SpecError) as refused:
        load_spec(specification(inside, name), allow_outside=True)
    assert any(word in str(refused.value) for word in ("rooster", "secret", "PATH")) == repeated


def test_instants_from_a_file_elsewhere(inside):
    file = inside / "spec.yaml"
    file.write_text(SIMULATED % ("{kind: irregular, file: ../outside.csv}", 10, 2, 1))
    with pytest.raises(SpecError, match=r"sampling.file: lies outside the folder.*--allow-outside"):
        load_spec(file)
    assert load_spec(file, allow_outside=True).sampling.sha256
    (inside.parent / "outside.csv").write_text("t,rooster\n0,1\nsecret,2\n")
    with pytest.raises(SpecError, match="'ctid check' says what is wrong") as refused:
        load_spec(file, allow_outside=True)
    assert "secret" not in str(refused.value)


@pytest.mark.parametrize("name", ["/dev/zero", "/dev/stdin", "pipe.csv", "device.csv", "."])
def test_what_is_no_ordinary_file(name, inside, monkeypatch):
    monkeypatch.chdir(inside)
    os.mkfifo("pipe.csv")
    (inside / "device.csv").symlink_to("/dev/zero")
    for read in (read_array_table, read_measurement):
        with pytest.raises(DataError, match=r"is not a file|are not read"):
            read(name)
    with pytest.raises(UsageError, match=r"is not a file|is a folder"):
        load_spec(inside / name)


def test_messages_repeat_little_of_a_file(inside):
    secret = "password-" + "x" * 40
    (inside / "record.csv").write_text(f"t,u,y\n0,1,{secret}\n1,2,3\n")
    with pytest.raises(DataError, match=r"record.csv:2: column 'y' holds a text of 49 characters") as refused:
        read_measurement(inside / "record.csv")
    assert secret not in str(refused.value)


@pytest.mark.parametrize(
    ("column", "factor"), [("u", 1e307), ("u", 1e-301), ("y", 1e307), ("y", 1e-302), ("t", 1e-300), ("t", 1e300)]
)
def test_numbers_that_cannot_be_computed_with(column, factor):
    t = 0.1 * np.arange(60)
    signals = {"t": t, "u": np.sign(np.sin(5 * t) + 0.1), "y": np.cos(t)}
    signals[column] = signals[column] * factor
    with pytest.raises(DataError, match=r"in a unit in which it is"):
        Record.from_arrays(*signals.values())


THOUSAND = f"[{', '.join(str(k / 10) for k in range(1, 1002))}]"


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ((REGULAR, 10, 2, "1000000000"), "at most 1000000"),
        ((REGULAR, 10, 2, "1e9"), "whole number"),
        ((REGULAR, 10, 2, "9" * 30), "at most 1000000"),
        ((REGULAR, THOUSAND, THOUSAND, 1), "1001 data cells and 1001 estimators .* at most 1000000"),
    ],
)
def test_too_large_experiments_are_refused(values, said, inside):
    (inside / "many.yaml").write_text(SIMULATED % values)
    with pytest.raises(SpecError, match=said):
        load_spec(inside / "many.yaml")
