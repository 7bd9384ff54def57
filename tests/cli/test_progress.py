"""Progress of commands that take long, and their end by Ctrl-C."""

import io
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter

from ctid_cli.cli import _progress
from ctid_cli.cli._progress import Display, Watch, interruptible
from ctid_cli.inference.uncertainty import DRAW, estimate_uncertainty
from ctid_cli.progress import Steps, calling, doing, each, listening, report, reported

ROOT = str(Path(__file__).resolve().parents[2])


def test_steps_in_progress_are_joined_from_the_outermost_to_the_innermost():
    @reported("fitting the model")
    def fit():
        for _ in each("structure", "ab"):
            for k in range(2):
                report("start", k + 1, 2)

    said = []
    with listening(lambda steps: said.append(str(steps))) as steps:
        with doing("reading r.csv"):
            report("", note="7 lines")
        fit()
        assert not str(steps)
    places = [f"{k} of 2{start}" for k in (1, 2) for start in ("", ", start 1 of 2", ", start 2 of 2")]
    starts = [f"fitting the model: structure {place}" for place in places]
    assert list(dict.fromkeys(said)) == ["reading r.csv", "reading r.csv: 7 lines", "fitting the model", *starts]


def test_an_error_ends_the_steps_around_it():
    @reported("division")
    def divide():
        report("digit", 1, 9)
        return 1 / 0

    with listening() as steps:
        with pytest.raises(ZeroDivisionError):
            divide()
        assert not str(steps)


def test_a_function_is_called_for_the_steps_of_its_kind_only():
    rng = np.random.default_rng(0)
    psi, residuals = rng.standard_normal((200, 2)), lfilter([1.0], [1.0, -0.5], rng.standard_normal(200))
    calls, others = [], []
    with listening(lambda steps: others.append(steps.steps[-1].what)), calling(lambda *n: calls.append(n), DRAW):
        estimate_uncertainty([psi], [residuals], "bootstrap", 3)
    assert calls == [(1, 3), (2, 3), (3, 3)]
    assert others == ["standard errors", *3 * [DRAW]]


class Terminal(io.StringIO):
    """A stream that is a terminal."""

    def isatty(self):
        return True


@pytest.fixture
def shown(monkeypatch):
    """Return a function that shows steps on a stream at some seconds, and returns what was written."""
    monkeypatch.setattr(_progress, "SILENT", 2.0)
    monkeypatch.setattr(_progress.time, "monotonic", lambda: 0.0)
    monkeypatch.setattr(_progress.shutil, "get_terminal_size", lambda: os.terminal_size((40, 24)))
    monkeypatch.setenv("TERM", "xterm")

    def show(stream, *texts):
        monkeypatch.setattr(sys, "stderr", stream)
        steps = Steps()
        display = Display("ctid fit", steps)
        for now, text in texts:
            with steps.doing(text):
                display.tick(now)
        return display

    return show


def test_lines_in_a_log_file_two_seconds_after_the_start_and_ten_after_the_last(shown):
    stream = io.StringIO()
    shown(stream, (1.9, "a"), (2.0, "b"), (3.0, "c"), (11.9, "d"), (12.0, "b"), (13.0, "e")).close()
    assert stream.getvalue() == "ctid fit: b (2 s)\nctid fit: e (13 s)\n"


def test_a_line_on_a_terminal_is_cut_and_precedes_other_output(shown, monkeypatch):
    stream, output = Terminal(), io.StringIO()
    monkeypatch.setattr(sys, "stdout", output)
    display = shown(stream, (1.0, "a"), (2.0, "b"), (3.0, "c" * 99))
    lines = ["ctid fit: b (2 s)", f"ctid fit: {'c' * 22}… (3 s)"]
    assert stream.getvalue() == "".join(f"\r{line}\x1b[K" for line in lines)
    print("result")
    assert output.getvalue() == "result\n"
    assert stream.getvalue().endswith("\r\x1b[K")
    display.close()
    assert (sys.stdout, sys.stderr) == (output, stream)


def test_compilation_is_named(shown, monkeypatch):
    from numba.core import compiler_lock

    stream = io.StringIO()
    with compiler_lock.global_compiler_lock:
        shown(stream, (2.0, "fitting"))
    assert stream.getvalue() == f"ctid fit: {_progress.COMPILING} (2 s)\n"


@pytest.mark.parametrize("quiet", [False, True])
def test_a_command_shows_its_steps_unless_it_is_quiet(quiet, monkeypatch):
    shown = threading.Event()
    monkeypatch.setattr(Display, "tick", lambda *_: shown.set())
    with Watch("run", quiet=quiet):
        assert shown.wait(0.6 if quiet else 60.0) is not quiet


def test_an_interruption_that_a_library_turns_into_an_error_remains_one(monkeypatch):
    @interruptible()
    def read():
        raise ValueError

    for interrupted, error in ((False, ValueError), (True, KeyboardInterrupt)):
        monkeypatch.setattr(Watch, "current", SimpleNamespace(interrupted=interrupted))
        with pytest.raises(error):
            read()


#: A command that writes one file, and is interrupted in compiled code while it writes another.
WRITING = """
import hashlib, pathlib, signal
from ctid_cli.cli._progress import Watch
from ctid_cli.written_files import write_file

def parts():
    yield b"half"
    print("writing", flush=True)
    hashlib.pbkdf2_hmac("sha256", b"", b"", 2_000_000_000)

signal.signal(signal.SIGINT, signal.default_int_handler)
Watch.owns_process = True
with Watch("fit"):
    write_file(pathlib.Path("fit.json"), b"whole")
    write_file(pathlib.Path("fit.svg"), parts())
"""


def test_ctrl_c_ends_compiled_code_and_leaves_complete_files_only(tmp_path):
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(
        [sys.executable, "-c", WRITING], cwd=tmp_path, env=os.environ | {"PYTHONPATH": ROOT}, **pipes
    ) as process:
        assert process.stdout.readline() == "writing\n"
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (130, "ctid: interrupted; fit.json was written\n")
    assert [path.name for path in tmp_path.iterdir()] == ["fit.json"]
