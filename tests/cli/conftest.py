"""A command line inside the test, and a folder in which every command has been used once."""

import contextlib
import functools
import itertools
import pickle
import shlex
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from ctid_cli.identification import choose, identify
from ctid_cli.running import engine, job
from ctid_cli.running.workers import Ending
from tests.cli.json_schemas import validate_json
from tests.cli.records import SPECIFICATIONS, first_order, rows, tones, write


def remembered(function):
    """Return the function with its results by the content of its arguments, without callables such as a progress."""
    kept = {}

    @functools.wraps(function)
    def call(*arguments, **options):
        key = pickle.dumps((arguments, {name: value for name, value in options.items() if not callable(value)}))
        if key not in kept:
            kept[key] = function(*arguments, **options)
        return kept[key]

    return call


@pytest.fixture(scope="session", autouse=True)
def computed_once():
    """Compute each choice and each fit of a record once, for all commands: most tests use the same few records."""
    with pytest.MonkeyPatch.context() as patch:
        chosen = remembered(choose.choose)
        for module in (choose, identify):
            patch.setattr(module, "choose", chosen)
        patch.setattr(identify, "identify", remembered(identify.identify))
        yield


@pytest.fixture
def few_candidates(monkeypatch):
    """Let ``ctid check`` choose the fit that it suggests among few structures."""
    whole = choose.choose

    def chosen(records, given, unit):
        return whole(records, replace(given, poles=(1, 2), zeros=0, integrators=0), unit)

    monkeypatch.setattr(choose, "choose", chosen)


class Here:
    """Workers in this process: for tests of results, not of processes."""

    count = 1

    def __init__(self, count, limits):
        pass

    def results(self, jobs, stopping):
        for each in jobs:
            yield each, Ending([entry for entry in job.run_job(each) if not isinstance(entry, job.Begun)])

    def close(self):
        pass


@pytest.fixture(scope="module")
def without_workers():
    """Make runs compute in the process of the test."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(engine, "LocalWorkers", Here)
        yield


@pytest.fixture(scope="session")
def ctid():
    """Return a function to run a command: ``ctid("table 1 --out", folder, code=2)``; first words as in a shell.

    JSON that is printed is validated against its schema.
    """
    from ctid_cli.cli.main import app

    def call(command, *arguments, code=0):
        words = [*shlex.split(command), *map(str, arguments)]
        done = CliRunner().invoke(app, words)
        assert done.exit_code == code, f"exit code {done.exit_code}\n{done.stdout}\n{done.stderr}\n{done.exception!r}"
        assert "Traceback" not in done.output
        if done.stdout and ("--json" in words or "--format json" in " ".join(words)):
            validate_json(words[0], done.stdout)
        return done

    return call


@pytest.fixture(scope="session")
def used(tmp_path_factory, ctid):
    """Return a folder with specifications, their results, records, two fits and a track, made once."""
    folder = tmp_path_factory.mktemp("used")
    with pytest.MonkeyPatch.context() as patch, contextlib.chdir(folder):
        patch.setattr(engine, "LocalWorkers", Here)
        # Every estimate takes ten milliseconds, on every machine.
        ticks = itertools.count()
        patch.setattr(job, "_clocks", lambda: np.full(2, 0.01 * next(ticks)))
        for name, text in SPECIFICATIONS.items():
            (folder / f"{name}.yaml").write_text(text, encoding="utf-8")
        write("measured.csv", first_order())
        write("record.csv", rows(0, noise=0.05, offset=0.3), "t [s],u [V],y [mm]")
        write("other.csv", rows(1, noise=0.05, offset=0.3), "t [s],u [V],y [mm]")
        write("tones.csv", tones(), "t,y")
        ctid("run --quiet", *(f"{name}.yaml" for name in SPECIFICATIONS))
        for poles in (1, 2):
            ctid(
                f"fit record.csv --poles {poles} --zeros 0 --integrators 0 --delay 0:3 --offset estimate --out p{poles}"
            )
        ctid("track tones.csv --tones 2 --out track")
    return folder


@pytest.fixture
def home(used, monkeypatch):
    """Use the used folder as working directory; a test that writes there removes its files."""
    monkeypatch.chdir(used)
    return used


@pytest.fixture
def here(tmp_path, monkeypatch):
    """Use a new folder with the tiny and the measured experiment as working directory."""
    for name in ("tiny", "measured-tiny"):
        (tmp_path / f"{name}.yaml").write_text(SPECIFICATIONS[name], encoding="utf-8")
    write(tmp_path / "measured.csv", first_order())
    monkeypatch.chdir(tmp_path)
    return tmp_path


def contents(folder):
    """Return the bytes of every file in a folder."""
    return {path: path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}
