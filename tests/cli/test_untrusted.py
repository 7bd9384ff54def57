"""What a specification, a record or a results file of somebody else must not do."""

import os

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from ctid_cli.cli.main import app
from ctid_cli.errors import DataError, RefusedError, SpecError, UsageError
from ctid_cli.signals.array_file import read_array_table
from ctid_cli.signals.measurement import read_measurement
from ctid_cli.signals.record import Record
from ctid_cli.specification.load import load_spec
from ctid_cli.storage.export import write_runs
from ctid_cli.storage.journal import open_journal
from tests.storage.made_results import ORIGIN, SPEC, outcomes_of, plan_of

MEASURED = """\
experiment: measured
data:        {file: %s}
estimators:
  known:     {kind: srivc, poles: 1, zeros: 0, svf_cutoff: 2.0}
"""
ROWS = "".join(f"{0.1 * k:.1f},{(-1) ** (k // 3)},{k % 5}\n" for k in range(40))


#: Exit codes of the documentation but that of internal errors.
CODES = (0, 2, 3, 4, 5, 6, 7)
COMMANDS = ("check", "fit", "track", "status", "table", "show", "export", "validate", "run --dry-run")
WITH_OUT = ("status", "table", "show", "export")


def asked(*arguments):
    """Exit code of a command, which ends in a documented way."""
    done = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    assert done.exit_code in CODES
    assert "Traceback" not in done.output
    return done.exit_code


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


def test_instants_from_a_file_elsewhere(inside):
    file = specification(inside, "none.csv")
    sampled = "sampling: {kind: irregular, file: ../outside.csv}"
    simulated = f"system: {{numerator: [1], denominator: [1, 1]}}\nexcitation: {{kind: step}}\n{sampled}\n"
    file.write_text("\n".join(simulated if "data:" in line else line for line in MEASURED.splitlines()))
    with pytest.raises(SpecError, match=r"sampling.file: lies outside the folder.*--allow-outside"):
        load_spec(file)
    assert load_spec(file, allow_outside=True).sampling.sha256
    (inside.parent / "outside.csv").write_text("t,rooster\n0,1\nsecret,2\n")
    with pytest.raises(SpecError, match="'ctid check' says what is wrong") as refused:
        load_spec(file, allow_outside=True)
    assert "secret" not in str(refused.value)


@pytest.mark.parametrize("command", COMMANDS)
def test_a_name_that_no_file_can_have(command, inside, monkeypatch):
    monkeypatch.chdir(inside)
    name = "9" * 500
    options = {"fit": ["--poles", "1", "--zeros", "0"], "track": ["--tones", "1"]}.get(command, [])
    assert asked(*command.split(), name, *options) == 2
    if command in WITH_OUT:
        assert asked(*command.split(), "tiny", "--out", name) in (2, 3)


@pytest.mark.parametrize("name", ["/dev/zero", "/dev/stdin", "pipe.csv", "link.csv", "."])
def test_what_is_no_ordinary_file(name, inside, monkeypatch):
    monkeypatch.chdir(inside)
    os.mkfifo("pipe.csv")
    (inside / "link.csv").symlink_to("/dev/zero")
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
    with pytest.raises(DataError, match=r"names no columns|more than 1000000 bytes|not a text file"):
        read_measurement(inside / "record.csv")


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


@pytest.fixture
def stored(inside):
    """A folder of results."""
    place = inside / "results" / "toys"
    place.mkdir(parents=True)
    manifest, log = plan_of(1).manifest(), open_journal(place / "journal.sqlite")
    log.add(outcomes_of(manifest), log.begin(manifest, ORIGIN, "now", {}))
    write_runs(place, log)
    log.close()
    return place


@pytest.mark.parametrize("name", ["journal.sqlite", "spec.yaml", "running.json.tmp", "figures", "report.html", "toys"])
def test_nothing_is_written_through_a_link_that_lies_in_the_results(name, inside, stored, monkeypatch):
    monkeypatch.chdir(inside)
    (inside / "toys.yaml").write_text(yaml.safe_dump(SPEC))
    elsewhere = inside / "elsewhere"
    command = {"figures": ["figure", "toys"], "report.html": ["report", "toys"]}.get(name, ["run", "toys.yaml"])
    if name in ("toys", "figures"):
        elsewhere.mkdir()
    else:
        elsewhere.write_text("" if name == "journal.sqlite" else "mine")
    place = stored if name == "toys" else stored / name
    if command[0] == "run":
        stored.rename(inside / "away")
        if name != "toys":
            stored.mkdir()
    place.symlink_to(elsewhere)
    done = CliRunner().invoke(app, command)
    assert done.exit_code == RefusedError.exit_code, done.output
    assert "leads to" in done.stderr or "is a link, and results are written into their folder alone" in done.stderr
    assert list(elsewhere.iterdir()) == [] if elsewhere.is_dir() else elsewhere.read_text() in ("", "mine")
