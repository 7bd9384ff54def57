"""Results on disks that are full, read-only or gone, and under names that would lose them."""

from __future__ import annotations

import errno
import os
import sqlite3
import tempfile
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from ctid_cli.cli._common import guarded
from ctid_cli.errors import StorageError
from ctid_cli.running.engine import run_experiment
from ctid_cli.written_files import TAKEN, why_unusable, write_file
from tests.running.fakes import toy_plan

ROOT = Path(__file__).resolve().parents[2]
PLAN = toy_plan(runs=1)


def ctid(*arguments: object) -> tuple[int, str]:
    from ctid_cli.cli.main import app

    done = CliRunner().invoke(app, [str(argument) for argument in arguments])
    return done.exit_code, done.output


def fill_the_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("storage") / "results"
    run_experiment(PLAN, place / "toys", jobs=1, warm=lambda plan: None)
    return place


@pytest.mark.parametrize("style", ["csv", "json"])
def test_a_full_disk_keeps_the_old_file(out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, style: str) -> None:
    file = tmp_path / "old.csv"
    file.write_text("what was there")
    fill_the_disk(monkeypatch)
    code, text = ctid("export", "toys", "--format", style, "--out", out, "--file", file)
    assert (code, f"{file} cannot be written: No space left on device" in text) == (6, True), text
    assert file.read_text() == "what was there"
    assert os.listdir(tmp_path) == ["old.csv"]


def test_a_file_is_replaced_as_a_whole_and_keeps_what_it_is(tmp_path: Path) -> None:
    file, link = tmp_path / ("ä" * 120), tmp_path / "link"
    file.write_text("old")
    file.chmod(0o640)
    link.symlink_to(file)
    write_file(link, b"new")
    assert (file.read_text(), link.is_symlink(), file.stat().st_mode & 0o777) == ("new", True, 0o640)
    write_file(Path("/dev/null"), b"gone")
    assert Path("/dev/null").is_char_device()
    assert len(os.listdir(tmp_path)) == 2


def test_a_disk_without_room_for_temporary_files_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def none(*arguments: Any) -> str:
        raise FileNotFoundError(errno.ENOENT, "No usable temporary directory found in ['/tmp']")

    monkeypatch.setattr(tempfile, "gettempdir", none)

    def failing() -> None:
        tempfile.mkdtemp()

    with pytest.raises(Exception) as raised:
        guarded(failing)()
    assert getattr(raised.value, "exit_code", None) == StorageError.exit_code
    text = capsys.readouterr().err
    assert "No usable temporary directory" in text
    assert "unexpected" not in text


def test_a_read_only_disk_is_not_taken_for_damage(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    connect = sqlite3.connect

    def read_only(path: Any, **options: Any) -> sqlite3.Connection:
        address = path if options.get("uri") else f"{Path(path).as_uri()}?mode=ro"
        return connect(address, **options | {"uri": True})

    monkeypatch.setattr(sqlite3, "connect", read_only)
    with pytest.raises(StorageError) as raised:
        run_experiment(toy_plan(runs=2), out / "toys", jobs=1, warm=lambda plan: None)
    text = str(raised.value)
    assert "could not be written (attempt to write a readonly database)" in text
    assert not any(word in text for word in ("repair", "--fresh", "damaged"))
    assert ctid("table", "toys", "--out", out)[0] == 0


@pytest.mark.parametrize(
    "name",
    [
        *("figures", "a/figures", "a/Figures/b", "x.aside-20260101T000000", "tiny/journal.sqlite"),
        *("tiny/RUNS.h5", "con", "a/nul.b", "COM1", "tiny.", "a./b", "tiny.tmp", "tiny.shard-1-of-3", "spec.yaml"),
    ],
)
def test_names_under_which_results_would_be_lost_are_refused(tmp_path: Path, name: str) -> None:
    text = (ROOT / "configs" / "quickstart.yaml").read_text(encoding="utf-8")
    file = tmp_path / "experiment.yaml"
    file.write_text(text.replace("experiment: quickstart", f"experiment: {name}"), encoding="utf-8")
    code, answer = ctid("validate", file)
    assert code == 2
    assert f"experiment: {name!r} cannot be used here: " in answer


def test_every_file_of_a_run_is_a_name_that_is_taken(out: Path) -> None:
    assert {path.name for path in (out / "toys").iterdir()} <= set(TAKEN)
    assert [why_unusable(name) for name in ("quickstart", "a/b", "figures-2", "conical", "com10x", "x.2")] == [None] * 6
