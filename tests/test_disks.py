"""Files on read-only disks, links, and allowed file names."""

import sqlite3
from pathlib import Path

import pytest

from ctid_cli.errors import StorageError
from ctid_cli.running.engine import run_experiment
from ctid_cli.written_files import TAKEN, why_unusable, write_file
from tests.running.fakes import toy_plan


def test_a_file_is_replaced_as_a_whole_and_keeps_what_it_is(tmp_path):
    file, link = tmp_path / ("ä" * 120), tmp_path / "link"
    file.write_text("old")
    file.chmod(0o640)
    link.symlink_to(file)
    write_file(link, b"new")
    assert (file.read_text(), link.is_symlink(), file.stat().st_mode & 0o777) == ("new", True, 0o640)
    write_file(Path("/dev/null"), b"gone")
    assert Path("/dev/null").is_char_device()
    assert len(list(tmp_path.iterdir())) == 2


def test_a_read_only_disk_is_not_taken_for_damage(tmp_path, monkeypatch):
    run_experiment(toy_plan(runs=1), tmp_path / "toys", jobs=1, warm=lambda plan: None)
    assert {path.name for path in (tmp_path / "toys").iterdir()} <= set(TAKEN)
    connect = sqlite3.connect

    def read_only(path, **options):
        address = path if options.get("uri") else f"{Path(path).as_uri()}?mode=ro"
        return connect(address, **options | {"uri": True})

    monkeypatch.setattr(sqlite3, "connect", read_only)
    with pytest.raises(StorageError, match=r"could not be written \(attempt to write a readonly database\)") as raised:
        run_experiment(toy_plan(runs=2), tmp_path / "toys", jobs=1, warm=lambda plan: None)
    assert not any(word in str(raised.value) for word in ("repair", "--fresh", "damaged"))


LOST = "figures a/figures a/Figures/b x.aside-20260101T000000 tiny/journal.sqlite tiny/RUNS.h5 con a/nul.b COM1 tiny."
LOST += " a./b tiny.tmp tiny.shard-1-of-3 spec.yaml"


def test_names_under_which_results_would_be_lost():
    assert all(why_unusable(name) for name in LOST.split())
    assert not any(why_unusable(name) for name in ("quickstart", "a/b", "figures-2", "conical", "com10x", "x.2"))
