"""What a specification, a record or a results file of somebody else must not do."""

import io
import json
import os
import shutil

import h5py
import numpy as np
import pytest
from typer.testing import CliRunner

from ctid_cli.cli.main import app
from ctid_cli.errors import DataError, RefusedError, SpecError, StorageError, UsageError
from ctid_cli.running.engine import run_experiment
from ctid_cli.signals.csv_file import read_csv_table
from ctid_cli.signals.mat_file import read_mat_table
from ctid_cli.signals.measurement import read_measurement
from ctid_cli.signals.record import Record
from ctid_cli.specification.load import load_spec
from tests.faults.conftest import STORED, TINY
from tests.faults.harness import COMMANDS, asked, resealed
from tests.running.fakes import FakePlan
from tests.storage.sealed_images import read_sealed

MEASURED = """\
experiment: measured
data:        {file: %s}
estimators:
  known:     {kind: srivc, poles: 1, zeros: 0, svf_cutoff: 2.0}
"""
ROWS = "".join(f"{0.1 * k:.1f},{(-1) ** (k // 3)},{k % 5}\n" for k in range(40))


@pytest.fixture
def inside(tmp_path):
    """A folder for a specification, beside a record that is not in it."""
    (tmp_path / "outside.csv").write_text("t,u,y\n" + ROWS)
    (tmp_path / "inside").mkdir()
    return tmp_path / "inside"


def specification(folder, file):
    path = folder / "spec.yaml"
    path.write_text(MEASURED % file)
    return path


@pytest.mark.parametrize("way", ["dots", "absolute", "link", "linked folder"])
def test_data_outside_the_folder_of_the_specification(way, inside):
    (inside / "link.csv").symlink_to(inside.parent / "outside.csv")
    (inside / "folder").symlink_to(inside.parent)
    name = {
        "dots": "../outside.csv",
        "absolute": str(inside.parent / "outside.csv"),
        "link": "link.csv",
        "linked folder": "folder/outside.csv",
    }[way]
    file = specification(inside, name)
    with pytest.raises(SpecError, match=r"outside the folder.*--allow-outside"):
        load_spec(file)
    assert load_spec(file, allow_outside=True).measured is not None


def test_data_below_the_folder_of_the_specification(inside, monkeypatch):
    (inside / "below").mkdir()
    (inside / "below" / "record.csv").write_text("t,u,y\n" + ROWS)
    monkeypatch.chdir(inside)
    assert load_spec(specification(inside, "below/record.csv").relative_to(inside)).measured is not None


def test_what_the_system_says_of_a_process_is_not_repeated(inside):
    file = specification(inside, "/proc/self/environ")
    with pytest.raises(SpecError) as refused:
        load_spec(file, allow_outside=True)
    assert "PATH" not in str(refused.value)
    assert "empty" in str(refused.value)


def test_nothing_of_a_file_elsewhere_is_repeated(inside):
    (inside.parent / "outside.csv").write_text("rooster:x:0,u,y\n0,1,secret\n1,2,3\n")
    for content, own in (("rooster:x:0,u,y\n0,1,secret\n", True), (None, False)):
        file = specification(inside, "record.csv" if own else "../outside.csv")
        if content:
            (inside / "record.csv").write_text(content)
        with pytest.raises(SpecError) as refused:
            load_spec(file, allow_outside=True)
        assert ("rooster" in str(refused.value) or "secret" in str(refused.value)) == own
    assert "'ctid check' says what is wrong" in str(refused.value)
    assert asked("validate", inside / ("x" * 300)) == 2


@pytest.mark.parametrize("command", [name for name in COMMANDS if name != "schema"])
def test_a_name_that_no_file_can_have(command, inside, monkeypatch):
    monkeypatch.chdir(inside)
    name = "9" * 500
    options = {"fit": ["--poles", "1", "--zeros", "0"], "track": ["--tones", "1"]}.get(command, [])
    assert asked(*command.split(), name, *options) == 2
    if "--out" in COMMANDS[command] and command != "run --dry-run":
        assert asked(*command.split(), "tiny", "--out", name) in (2, 3)


@pytest.mark.parametrize("name", ["/dev/zero", "/dev/stdin", "pipe.csv", "link.csv", "."])
def test_what_is_no_ordinary_file(name, inside, monkeypatch):
    monkeypatch.chdir(inside)
    os.mkfifo("pipe.csv")
    (inside / "link.csv").symlink_to("/dev/zero")
    for read in (read_csv_table, read_mat_table, read_measurement):
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


def test_messages_do_not_steer_the_terminal(inside):
    file = specification(inside, "none.csv")
    file.write_text(file.read_text() + '"\\e[2J": 1\n"\\u202e": 2\n')
    done = CliRunner().invoke(app, ["validate", str(file)])
    assert done.exit_code == 2
    assert "\x1b" not in done.output
    assert "\u202e" not in done.output
    assert "\\x1b[2J" in done.stderr


@pytest.mark.parametrize("header", ["," * 20_000, "x" * 2_000_000, "t\0,u,y"])
def test_first_lines_that_name_no_columns(header, inside):
    (inside / "record.csv").write_text(header + "\n" + ROWS)
    with pytest.raises(DataError, match=r"first line has|not a text file"):
        read_csv_table(inside / "record.csv")


@pytest.mark.parametrize(
    ("column", "factor"),
    [("u", 1e307), ("u", 1e-301), ("y", 1e307), ("y", 1e-302), ("t", 1e-300), ("t", 1e300)],
)
def test_numbers_that_cannot_be_computed_with(column, factor, inside):
    t = 0.1 * np.arange(60)
    signals = {"t": t, "u": np.sign(np.sin(5 * t) + 0.1), "y": np.cos(t)}
    signals[column] = signals[column] * factor
    with pytest.raises(DataError, match=r"in a unit in which it is"):
        Record.from_arrays(*signals.values())
    rows = "\n".join(",".join(map(repr, map(float, row))) for row in zip(*signals.values(), strict=True))
    (inside / "record.csv").write_text(f"t,u,y\n{rows}\n")
    for command in ("check", "fit --poles 1 --zeros 0", "track --tones 1 --signal u"):
        if column == "y" and "track" in command:
            continue
        name, *options = command.split()
        assert asked(name, inside / "record.csv", *options) == 2


@pytest.mark.parametrize("rows", ["0,1,1", "0,1,1\n1,1,1", "0,0,0\n1,0,0\n2,0,0\n3,0,0", "0,1,2\n1e-20,0,1\n1,1,1"])
def test_records_that_show_nothing(rows, inside):
    (inside / "record.csv").write_text(f"t,u,y\n{rows}\n")
    assert asked("check", inside / "record.csv") in (0, 2)


@pytest.mark.parametrize("runs", ["1000000000", "1e9", "9" * 30])
def test_more_data_sets_than_anybody_computes(runs, inside):
    file = specification(inside, "none.csv")
    file.write_text(f"{file.read_text()}monte_carlo: {{runs: {runs}, seed: 1}}\n")
    with pytest.raises(SpecError, match=r"at most 1000000|whole number"):
        load_spec(file)


def test_sweeps_that_multiply(inside):
    lists = f"[{', '.join(str(k / 10) for k in range(1, 1002))}]"
    text = f"""\
experiment: many
system: {{numerator: [1], denominator: [1, 1]}}
excitation: {{kind: prbs, stages: 6, clock_period: 1.0, amplitude: 1.0}}
sampling: {{kind: regular, interval: 0.1, samples: 400}}
noise: {{kind: white, snr_db: {lists}}}
estimators: {{one: {{kind: srivc, poles: 1, zeros: 0, svf_cutoff: {lists}}}}}
monte_carlo: {{runs: 1, seed: 1}}
"""
    (inside / "many.yaml").write_text(text)
    with pytest.raises(SpecError, match=r"1001 data cells and 1001 estimators .* at most 1000000"):
        load_spec(inside / "many.yaml")


def changed(image, change):
    """A sealed file with a change and right checksums."""
    stream = io.BytesIO(image[512:])
    with h5py.File(stream, "r+") as file:
        change(file)
    return resealed(stream.getvalue())


def _plan(change):
    def within(file):
        plan = json.loads(bytes(file["manifest"][()]))
        change(plan)
        del file["manifest"]
        file["manifest"] = np.array(json.dumps(plan).encode())

    return within


def _column(name, values):
    def within(file):
        del file["estimates"][name]
        if values is not None:
            file["estimates"][name] = values

    return within


def _huge(file):
    del file["estimates"]["delay"]
    file["estimates"].create_dataset("delay", shape=(10**12,), dtype="f8", chunks=(1000,))


CHANGES = {
    "nothing": lambda file: None,
    "a shorter column": _column("delay", np.zeros(1)),
    "text for numbers": _column("delay", np.array([b"text"] * 6)),
    "numbers for text": _column("status", np.zeros(6)),
    "a link to another file": _column("delay", h5py.ExternalLink("/etc/passwd", "/x")),
    "a link within": _column("delay", h5py.SoftLink("/estimates/cost")),
    "8 TB": _huge,
    "no plan": _plan(dict.clear),
    "1e9 data sets": _plan(lambda plan: plan["data_cells"][0].update(replicates=10**9)),
    "a name outside": _plan(lambda plan: plan.update(experiment="../../etc/passwd")),
    "no data cells": _plan(lambda plan: plan.update(data_cells=[])),
}


@pytest.mark.parametrize("case", CHANGES)
def test_results_with_right_checksums_and_wrong_content(case, sealed_images, tmp_path):
    path = tmp_path / "runs.h5"
    path.write_bytes(changed(sealed_images[-1], CHANGES[case]))
    if case == "nothing":
        assert read_sealed(path).results
        return
    with pytest.raises(StorageError, match=r"cannot be read"):
        read_sealed(path)


@pytest.mark.parametrize("name", ["journal.sqlite", "timings.csv", "spec.yaml", "provenance", "running.json.tmp"])
def test_a_run_writes_through_no_link_that_lies_in_its_folder(name, tmp_path):
    place, elsewhere = tmp_path / "toys", tmp_path / "elsewhere"
    place.mkdir()
    mine = "" if name == "journal.sqlite" else "mine"  # what is no journal is refused as that
    elsewhere.write_text(mine)
    (place / name).symlink_to(elsewhere)
    with pytest.raises(RefusedError, match=r"is a link, and results are written into their folder alone"):
        run_experiment(FakePlan(), place, jobs=1, warm=lambda plan: None)
    assert elsewhere.read_text() == mine
    assert [path.name for path in place.iterdir()] == [name]


@pytest.mark.parametrize("name", ["figures", "report.html", "run"])
def test_no_link_in_the_results_leads_out_of_them(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    elsewhere, place = tmp_path / "elsewhere", tmp_path / "results" / "tiny"
    elsewhere.mkdir()
    place.parent.mkdir()
    if name == "run":
        (tmp_path / "tiny.yaml").write_text(TINY)
        place.symlink_to(elsewhere)
    else:
        shutil.copytree(STORED / "system", place)
        (place / name).symlink_to(elsewhere)
    experiment = "tiny.yaml" if name == "run" else json.loads((place / "spec.canonical.json").read_text())["experiment"]
    (place.parent / experiment).exists() or name == "run" or place.rename(place.parent / experiment)
    command = {"figures": "figure", "report.html": "report", "run": "run"}[name]
    done = CliRunner().invoke(app, [command, experiment])
    assert done.exit_code == RefusedError.exit_code, done.output
    assert "leads to" in done.stderr
    assert list(elsewhere.iterdir()) == []
