"""A command that compiles functions says so: once, on stderr, and only if there is a delay."""

import pytest
import typer

from ctid_cli.cli import _compiling
from ctid_cli.cli._common import ComputingCommand
from ctid_cli.cli._compiling import ANNOUNCEMENT, CompilationNotice
from ctid_cli.cli.main import app

#: Commands that show, move or describe files, and need not load Numba.
STORED = {"status", "export", "verify", "merge", "init"}


class Clock:
    """Simulated clock and timers: each compilation takes six seconds."""

    def __init__(self):
        self.now = 0.0
        self.waits = []

    def __call__(self, wait, action):
        self.waits.append(wait)
        if wait < 6.0:
            action()
        return self

    def start(self):
        self.now += 6.0

    def cancel(self):
        pass

    join = cancel


@pytest.mark.parametrize(
    ("silent", "waits", "times"), [(2.0, [2.0], 1), (10.0, [10.0, 4.0], 1), (99.0, [99.0, 93.0, 87.0], 0)]
)
def test_one_sentence_when_compilation_takes_long_in_all(silent, waits, times, monkeypatch, capsys):
    clock = Clock()
    monkeypatch.setattr(_compiling.threading, "Timer", clock)
    monkeypatch.setattr(_compiling.time, "monotonic", lambda: clock.now)
    monkeypatch.setattr(_compiling, "SILENT", silent)
    notice = CompilationNotice()
    for _ in range(3):
        # A function that calls another one is compiled after it.
        notice.on_start(None)
        notice.on_start(None)
        notice.on_end(None)
        notice.on_end(None)
    assert clock.waits == waits
    assert capsys.readouterr() == ("", times * f"{ANNOUNCEMENT}\n")


def test_every_command_that_computes_tells_it():
    commands = typer.main.get_group(app).commands
    assert {name for name, command in commands.items() if not isinstance(command, ComputingCommand)} == STORED
