from __future__ import annotations

import hashlib
import random
import shutil
import sqlite3
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from ctid_cli.errors import DamageError, RefusedError, StorageError
from ctid_cli.storage.identity import Origin
from ctid_cli.storage.journal import Journal, Session, open_journal, read_journal
from ctid_cli.storage.manifest import Key, Outcome
from tests.storage.made_results import plan_of

ORIGIN = Origin("c0de", "a platform", (("python", "3.11.7"), ("numpy", "2.4")))
MANIFEST = plan_of(1).manifest()


def outcome(replicate: int, delay: float = 8.0) -> Outcome:
    return Outcome(Key("data", replicate, "estimator", "3"), {"status": "CONVERGED", "delay": delay}, 0.25)


def filled(path: Path, count: int = 3) -> Journal:
    log = open_journal(path)
    session = log.begin(MANIFEST, ORIGIN, "2026-11-21T04:00:00Z", {"host": "here"})
    log.add([outcome(k, 8.0 + k / 3) for k in range(count)], session)
    return log


def delays(log: Any) -> list[float]:
    return [row.content["delay"] for row in log.rows()]


def files(folder: Path) -> dict[str, str]:
    return {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in folder.iterdir()}


def test_what_was_added_is_read_back_exactly(tmp_path: Path) -> None:
    path = tmp_path / "journal.sqlite"
    log = filled(path)
    (first,) = log.sessions()
    second = log.begin(MANIFEST, ORIGIN, "2026-11-21T06:00:00Z", {})
    log.end(first.id, "2026-11-21T05:00:00Z", "finished")
    log.add([outcome(1, 5.0)._replace(seconds=float("inf"), cpu_seconds=0.5)], second)
    log.close()
    with read_journal(path) as read:
        assert read is not None
        assert (read.experiment(), read.manifest(), read.origins()) == ("toys", MANIFEST, (ORIGIN,))
        assert delays(read) == [8.0, 5.0, 26 / 3]
        assert [(row.seconds, row.cpu_seconds, row.session) for row in read.rows()] == [
            (0.25, None, first.id),
            (None, 0.5, second),
            (0.25, None, first.id),
        ]
        assert sorted(read.sessions(), key=lambda session: session.started) == [
            first._replace(stopped="2026-11-21T05:00:00Z", reason="finished"),
            Session(second, ORIGIN, "2026-11-21T06:00:00Z", None, None, {}),
        ]
        assert read.row(outcome(1).key) is not None
        assert read.row(outcome(9).key) is None


@pytest.mark.parametrize(("system", "locking"), [("unix", "normal"), ("unix-none", "exclusive")])
def test_commits_are_durable_also_on_a_file_system_without_shared_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, system: str, locking: str
) -> None:
    connect = sqlite3.connect

    def on_the_system(path: Path, **options: Any) -> sqlite3.Connection:
        return connect(f"{Path(path).as_uri()}?vfs={system}", uri=True, **options)

    with monkeypatch.context() as patch:
        patch.setattr(sqlite3, "connect", on_the_system)
        log = filled(tmp_path / "journal.sqlite")
        pragmas = ("journal_mode", "synchronous", "locking_mode")
        assert [log._connection.execute(f"PRAGMA {name}").fetchone()[0] for name in pragmas] == ["wal", 2, locking]
        log.close()
    with read_journal(tmp_path / "journal.sqlite") as read:
        assert len(delays(read)) == 3


def test_others_read_while_a_run_writes_each_as_it_was_when_they_began(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "mkdtemp", None)  # nothing is copied
    log = filled(tmp_path / "journal.sqlite")
    before = files(tmp_path)
    with read_journal(log.path, live=True) as early:
        assert len(delays(early)) == 3
        # The index in memory is shared with the writer, which is in this process.
        assert {**files(tmp_path), "journal.sqlite-shm": ""} == {**before, "journal.sqlite-shm": ""}
        log.add([outcome(3), outcome(4)], log.sessions()[0].id)
        with read_journal(log.path, live=True) as late:
            assert (len(delays(early)), len(delays(late))) == (3, 5)
    log.add([outcome(k) for k in range(5, 500)], log.sessions()[0].id)  # more than SQLite keeps in its log
    assert len(delays(log)) == 500
    log.close()
    assert [path.name for path in tmp_path.iterdir()] == ["journal.sqlite"]


@pytest.mark.parametrize("change", ["rename", "delete", "replace", "other journal", "other log"])
def test_nothing_is_acknowledged_in_a_folder_that_is_gone(tmp_path: Path, change: str) -> None:
    place, elsewhere = tmp_path / "toys", tmp_path / "old"
    place.mkdir()
    log = filled(place / "journal.sqlite")
    log.add([outcome(3)], log.sessions()[0].id)
    match change:
        case "rename":
            place.rename(elsewhere)
        case "delete":
            shutil.rmtree(place)
        case "replace":
            place.rename(elsewhere)
            shutil.copytree(elsewhere, place)
        case _:
            name = "journal.sqlite" if change == "other journal" else "journal.sqlite-wal"
            (place / name).rename(place / "kept")
            shutil.copyfile(place / "kept", place / name)
    with pytest.raises(StorageError, match=f"{place}.* was renamed, deleted or replaced while a run wrote to it"):
        log.add([outcome(4)], log.sessions()[0].id)
    log.close()


def test_reading_after_a_kill_finds_everything_and_changes_nothing(tmp_path: Path) -> None:
    log = filled(tmp_path / "journal.sqlite")
    dead = tmp_path / "dead"
    dead.mkdir()
    # Files as left by a killed process: most of the content is still in the write-ahead log.
    for name in ("journal.sqlite", "journal.sqlite-wal"):
        (dead / name).write_bytes((tmp_path / name).read_bytes())
    log.close()
    before = files(dead)
    with read_journal(dead / "journal.sqlite") as read:
        assert len(delays(read)) == 3
    assert files(dead) == before
    again = open_journal(dead / "journal.sqlite")
    assert len(delays(again)) == 3
    again.close()


def test_a_run_that_was_killed_when_it_had_just_begun_its_log_goes_on(tmp_path: Path) -> None:
    open_journal(tmp_path / "journal.sqlite").close()
    for name, content in {"wal": b"\x37\x7f\x06\x82" + bytes(28), "shm": bytes(32768)}.items():
        (tmp_path / f"journal.sqlite-{name}").write_bytes(content)
    with read_journal(tmp_path / "journal.sqlite") as read:
        assert read is None
    filled(tmp_path / "journal.sqlite").close()
    with read_journal(tmp_path / "journal.sqlite") as read:
        assert len(delays(read)) == 3


def test_what_cannot_be_stored_as_a_whole_is_not_stored(tmp_path: Path) -> None:
    log = filled(tmp_path / "journal.sqlite", count=1)
    log._connection.execute(
        "CREATE TRIGGER full BEFORE INSERT ON estimates WHEN new.replicate = 2 BEGIN SELECT raise(FAIL, 'full'); END"
    )
    with pytest.raises(StorageError, match="could not be written"):
        log.add([outcome(1), outcome(2)], log.sessions()[0].id)
    assert delays(log) == [8.0]
    log.close()


def test_new_estimates_and_a_new_plan_make_an_export_stale(tmp_path: Path) -> None:
    log = filled(tmp_path / "journal.sqlite")
    log.note_export("abc")
    log.begin(MANIFEST, ORIGIN, "later", {})
    assert log.exported() == "abc"
    log.add([outcome(7)], log.sessions()[0].id)
    assert log.exported() is None
    log.note_export("def")
    log.replan({**MANIFEST, "runs": 7})
    assert log.exported() is None
    log.close()


def test_a_changed_or_missing_estimate_is_found(tmp_path: Path) -> None:
    path = tmp_path / "journal.sqlite"
    filled(path).close()
    data = path.read_bytes()
    assert data.count(b'"delay":8.0,') == 1
    path.write_bytes(data.replace(b'"delay":8.0,', b'"delay":9.0,'))
    with read_journal(path) as read:
        assert read is not None
        read.check()
        with pytest.raises(StorageError, match=f"estimate {outcome(0).key.id} has changed"):
            delays(read)
    path.write_bytes(data)
    with sqlite3.connect(path) as connection:
        connection.execute("DELETE FROM estimates WHERE replicate = 1")
    connection.close()
    with pytest.raises(DamageError, match="3 estimates were written, 2 are there"):
        open_journal(path)


def everything(path: Path) -> Any:
    with read_journal(path) as log:
        assert log is not None
        log.check()
        return [*log.rows()], log.manifest(), log.sessions(), log.origins(), log.exported()


def test_no_flipped_bit_and_no_damaged_page_changes_what_is_read(tmp_path: Path) -> None:
    path = tmp_path / "journal.sqlite"
    filled(path, count=60).close()
    expected, intact, rng, found = everything(path), path.read_bytes(), random.Random(4), 0
    used = [k for k, byte in enumerate(intact) if byte]
    damages = [intact[:k] + bytes([intact[k] ^ 1 << rng.randrange(8)]) + intact[k + 1 :] for k in rng.sample(used, 250)]
    pages = range(0, len(intact), 4096)
    damages += [intact[:page] + b"\xa5" * 4096 + intact[page + 4096 :] for page in pages]
    damages += [intact[:page] for page in pages[1:]]
    for damage in damages:
        path.write_bytes(damage)
        try:
            assert everything(path) == expected
        except (StorageError, RefusedError):
            found += 1
    assert found > len(damages) - 50


def other_program(path: Path) -> None:
    with sqlite3.connect(path) as connection:
        connection.execute("CREATE TABLE meta (name, value)")
    connection.close()


def newer_format(path: Path) -> None:
    log = filled(path)
    log._connection.execute("PRAGMA user_version=6")
    log.close()


@pytest.mark.parametrize(
    ("make", "error", "said"),
    [
        (lambda path: path.write_bytes(b"not a database at all, only text\n" * 200), DamageError, "not a journal"),
        (lambda path: path.write_bytes(b"SQLite format 3\0"), DamageError, "not a journal"),
        (other_program, DamageError, "not a journal of ctid"),
        (newer_format, RefusedError, r"format 6; this ctid reads format 5.*--fresh"),
    ],
)
def test_other_files_are_not_taken_for_a_journal(
    tmp_path: Path, make: Callable[[Path], Any], error: type[Exception], said: str
) -> None:
    path = tmp_path / "journal.sqlite"
    make(path)
    before = path.read_bytes()
    with pytest.raises(error, match=said), read_journal(path):
        pass
    with pytest.raises(error):
        open_journal(path)
    # SQLite's header of 100 bytes describes how a file is written.
    assert path.read_bytes()[100:] == before[100:]


def test_no_journal_and_an_empty_one_are_the_same(tmp_path: Path) -> None:
    path = tmp_path / "journal.sqlite"
    for make in (lambda: None, path.touch, lambda: open_journal(path).close()):
        make()
        with read_journal(path) as read:
            assert read is None
