"""Whatever is wrong with what the user gives: one clear message, exit 2, nothing written or changed."""

import re
import shutil
import sqlite3

import pytest


def content(folder):
    return {path: path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}


@pytest.fixture
def refused(ctid, tmp_path):
    """Run a specification that must be refused and return the message."""

    def call(file, *arguments, code=2, command="run"):
        before = content(tmp_path)
        out = () if command == "validate" else ("--out", tmp_path / "results")
        done = ctid(command, file, *arguments, *out, code=code)
        assert content(tmp_path) == before
        assert done.stdout == ""
        return done.stderr

    return call


def change(file, old, new):
    text = file.read_text(encoding="utf-8")
    assert old in text
    file.write_text(text.replace(old, new), encoding="utf-8")
    return file


SPEC = {
    "misspelt key": ("clock_period: 0.2", "clok_period: 0.2", ["tiny.yaml:3:", "clok_period", "clock_period"]),
    "unknown section": ("monte_carlo:", "monte_karlo:", ["tiny.yaml:10:1", "monte_carlo"]),
    "number as text": ("interval: 0.1", "interval: fast", ["tiny.yaml:4:", "sampling.interval", "number"]),
    "fraction of samples": ("samples: 400", "samples: 400.5", ["tiny.yaml:4:", "sampling.samples", "whole number"]),
    "record shorter than the delay": ("samples: 400", "samples: 3", ["tiny.yaml:7:", "delay_bounds", "0.2 s"]),
    "zeros not below poles": ("poles: 1, zeros: 0, delay_b", "poles: 1, zeros: 1, delay_b", ["tiny.yaml:7:", "zeros"]),
    "reversed bounds": ("delay_bounds: [0, 2]", "delay_bounds: [2, 0]", ["tiny.yaml:7:", "delay_bounds"]),
    "bounds beyond the record": ("delay_bounds: [0, 2]", "delay_bounds: [0, 60]", ["delay"]),
    "unstable system": ("denominator: [1, 2]", "denominator: [1, -2]", ["tiny.yaml:2:", "system", "stable"]),
    "two estimators of one name": ("  known:  ", "  search: ", ["tiny.yaml:8:3", "search", "line 7"]),
    "no estimators": (
        "  known:     {kind: srivc, poles: 1, zeros: 0, delay: 0.35, svf_cutoff: 2.0}\n",
        "  known:     {kind: srivk, poles: 1, zeros: 0}\n",
        ["tiny.yaml:8:", "srivk", "srivc"],
    ),
}


@pytest.mark.parametrize("case", SPEC)
def test_specification(case, tiny, refused):
    old, new, expected = SPEC[case]
    message = refused(change(tiny, old, new))
    for part in expected:
        assert part in message
    # every line begins with its place, as editors and terminals expect it
    assert all(re.match(rf"{re.escape(str(tiny))}:\d+:\d+: ", line) for line in message.splitlines())


def test_fewer_samples_than_parameters(tiny, refused):
    change(tiny, "delay: 0.35", "delay: 0.0")
    change(tiny, "delay_bounds: [0, 2]", "delay_bounds: [0, 0.05]")
    change(tiny, "[0.3, {uniform: [0.2, 0.5]}]", "[0]")
    message = refused(change(tiny, "samples: 400", "samples: 2"))
    assert "samples" in message
    assert "parameters" in message


def test_all_mistakes_at_once_also_over_several_files(tiny, tmp_path, refused):
    other = tmp_path / "other.yaml"
    shutil.copy(tiny, other)
    change(tiny, "clock_period: 0.2", "clok_period: 0.2")
    change(tiny, "interval: 0.1", "interval: -1")
    change(other, "seed: 1", "seed: one")
    message = refused(tiny, other)
    for part in ("tiny.yaml:3:", "tiny.yaml:4:", "other.yaml:10:"):
        assert part in message
    assert message == refused(tiny, other, command="validate")


def test_missing_specification(tmp_path, refused):
    assert "nowhere.yaml" in refused(tmp_path / "nowhere.yaml")


def test_a_specification_that_is_no_yaml(tiny, refused):
    tiny.write_text("experiment: [", encoding="utf-8")
    assert "tiny.yaml:1:" in refused(tiny)


def test_the_same_experiment_twice(tiny, tmp_path, refused):
    other = tmp_path / "other.yaml"
    shutil.copy(tiny, other)
    assert "both describe the experiment 'tiny'" in refused(tiny, other)


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("noise.snr=5", ["--set", "noise.snr", "snr_db"]),
        ("noise", ["noise"]),
        ("monte_carlo.runs=0", ["runs"]),
    ],
)
def test_override(tiny, refused, override, expected):
    message = refused(tiny, "--set", override)
    for part in expected:
        assert part in message


RECORDS = {
    "empty": (lambda lines: lines[:1], ["record.csv"]),
    "time that does not increase": (
        lambda lines: [*lines[:5], lines[4], *lines[5:]],
        ["record.csv:6", "increase"],
    ),
    "fewer samples than parameters": (lambda lines: lines[:3], ["samples"]),
    "constant input": (
        lambda lines: [lines[0], *(f"{line.split(',')[0]},1,{line.split(',')[2]}" for line in lines[1:])],
        ["the input 'u' is constant"],
    ),
    "no finite output": (
        lambda lines: [lines[0], *(line.rsplit(",", 1)[0] + ",nan" for line in lines[1:])],
        ["finite"],
    ),
    "text in a number's place": (lambda lines: [*lines[:3], "0.2,x,1", *lines[4:]], ["record.csv:4", "'x'"]),
    "missing column": (lambda lines: ["t,u,z", *lines[1:]], ["record.csv", "'y'"]),
}


@pytest.mark.parametrize("case", RECORDS)
def test_record(case, measured, tmp_path, refused):
    edit, expected = RECORDS[case]
    file = tmp_path / "record.csv"
    file.write_text("\n".join(edit(file.read_text(encoding="utf-8").splitlines())) + "\n", encoding="utf-8")
    if "samples" in case:
        change(measured, ", estimation_samples: 200", "")
    message = refused(measured)
    for part in expected:
        assert part in message


def test_missing_record(measured, tmp_path, refused):
    (tmp_path / "record.csv").unlink()
    message = refused(measured)
    assert "record.csv" in message
    assert "measured.yaml:2:" in message


def test_a_folder_with_another_experiment_is_refused(done, tiny, tmp_path, refused):
    shutil.copytree(done / "measured-tiny", tmp_path / "results" / "tiny")
    message = refused(tiny, code=3)
    assert "'measured-tiny'" in message
    assert "--fresh" in message


@pytest.mark.parametrize("command", ["run", "table", "status", "export"])
def test_results_of_a_newer_format_are_refused(command, done, tiny, tmp_path, ctid):
    shutil.copytree(done / "tiny", tmp_path / "results" / "tiny")
    with sqlite3.connect(tmp_path / "results" / "tiny" / "journal.sqlite") as connection:
        connection.execute("PRAGMA user_version = 99")
    connection.close()
    before = content(tmp_path)
    message = ctid(command, tiny if command == "run" else "tiny", "--out", tmp_path / "results", code=3).stderr
    assert "99" in message
    assert content(tmp_path) == before


def test_slow_sampling_is_a_warning(tiny, ctid):
    change(tiny, "denominator: [1, 2]", "denominator: [1, 80]")
    warning = ctid("validate", tiny).stderr
    assert "warning" in warning
    assert "sampling" in warning


@pytest.mark.parametrize(
    "arguments",
    [
        ("run",),
        ("run", "x.yaml", "--jobs", "0"),
        ("run", "x.yaml", "--runs", "some"),
        ("table", "--format", "html"),
        ("export",),
        ("shwo", "abc"),
    ],
)
def test_usage(ctid, arguments, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    message = ctid(*arguments, code=2).stderr
    assert "Error" in message
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "arguments",
    [
        ("run", "x.yaml", "--jobs", "2", "-j", "3"),
        ("table", "--format", "md", "--format=md"),
        ("check", "x.csv", "--time", "a", "--time", "b"),
    ],
)
def test_an_option_that_would_keep_its_last_value_only(ctid, arguments):
    assert re.search(r"^Error: --\w+ is given twice\.$", ctid(*arguments, code=2).stderr, re.MULTILINE)


@pytest.mark.parametrize("arguments", [("show", "ffff"), ("export", "tiny"), ("status", "tiny"), ("table", "9")])
def test_what_does_not_exist(ctid, arguments, tmp_path):
    ctid(*arguments, "--out", tmp_path / "nothing", code=2)
    assert list(tmp_path.iterdir()) == []
