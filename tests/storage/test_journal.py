from __future__ import annotations

import hashlib
import random
import shutil
import sqlite3
import tempfile
from pathlib import Path
from typing import Any

import pytest

from ctid_cli.errors import DamageError, RefusedError, StorageError
from ctid_cli.storage.identity import Origin
from ctid_cli.storage.journal import Journal, open_journal
from ctid_cli.storage.journal_reader import Tally, read_journal
from ctid_cli.storage.manifest import Key, Outcome
from tests.running.fakes import FakePlan

ORIGIN = Origin("c0de", "a platform", (("python", "3.11.7"), ("numpy", "2.4")))
ORIGINS = {"estimator": ORIGIN}
MANIFEST = FakePlan(runs=1).manifest()  # type: ignore[arg-type]


def outcome(replicate: int, delay: float = 8.0) -> Outcome:
    return Outcome(Key("data", replicate, "estimator", "3"), {"status": "CONVERGED", "delay": delay}, 0.25)


def filled(path: Path, count: int = 3) -> Journal:
    log = open_journal(path)
    session = log.begin(MANIFEST, ORIGINS, "2026-11-21T04:00:00Z", {"host": "here"})
    log.add([outcome(k, 8.0 + k / 3) for k in range(count)], session)
    return log


def before_format_4(log: Journal) -> None:
    """Take away what older formats did not have."""
    rows = list(log.rows())
    for table in ("meta", "origins", "sessions"):
        log._connection.execute(f"ALTER TABLE {table} DROP COLUMN checksum")
    for row in rows:
        text = "\n".join([*map(str, row.key), row.result])
        values = (hashlib.sha256(text.encode()).hexdigest()[:32], row.key.replicate)
        log._connection.execute("UPDATE estimates SET checksum = ? WHERE replicate = ?", values)
    for statement in ("DROP TABLE files", "DELETE FROM meta WHERE name = 'tally'", "PRAGMA user_version=3"):
        log._connection.execute(statement)


def files(folder: Path) -> dict[str, str]:
    return {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in folder.iterdir()}


def test_checksums_are_counted_one_by_one_or_together() -> None:
    checksums = [hashlib.sha256(bytes([k])).hexdigest()[:32] for k in range(9)]
    one, all_at_once = Tally(), Tally()
    for checksum in checksums:
        one.add(checksum)
    all_at_once.add_all("".join(checksums))
    assert str(one) == str(all_at_once)


def test_the_state_changes_with_everything_a_run_writes(tmp_path: Path) -> None:
    log = filled(tmp_path / "journal.sqlite")
    states = [log.state()]
    for step in (
        lambda: log.add([outcome(3, 1.0)], 1),
        lambda: log.add([outcome(3, 2.0)], 1),
        lambda: log.begin(MANIFEST, ORIGINS, "2026-11-21T06:00:00Z", {}),
    ):
        step()
        states.append(log.state())
    log.close()
    assert None not in states
    assert len(set(states)) == 4
    with read_journal(tmp_path / "journal.sqlite") as read:
        assert read is not None
        assert read.state() == states[-1]


def test_what_was_added_is_read_back_exactly(tmp_path: Path) -> None:
    path = tmp_path / "journal.sqlite"
    log = filled(path)
    log.end(1, "2026-11-21T05:00:00Z", "finished")
    log.close()
    with read_journal(path) as read:
        assert read is not None
        assert read.experiment() == "toys"
        assert read.manifest() == MANIFEST
        assert read.origins() == (ORIGIN,)
        assert read.origins()[0].estimators == ("estimator",)
        entries = read.entries()
        assert {key.replicate: entry.content["delay"] for key, entry in entries.items()} == {
            0: 8.0,
            1: 25 / 3,
            2: 26 / 3,
        }
        assert read.keys() == set(entries) == set(dict(read.statuses()))
        assert read.sessions() == [
            {
                "session": 1,
                "started": "2026-11-21T04:00:00Z",
                "stopped": "2026-11-21T05:00:00Z",
                "reason": "finished",
                "host": "here",
            }
        ]


def test_settings_that_make_commits_durable(tmp_path: Path) -> None:
    log = filled(tmp_path / "journal.sqlite")
    pragmas = ("journal_mode", "synchronous", "locking_mode")
    assert [log._connection.execute(f"PRAGMA {name}").fetchone()[0] for name in pragmas] == ["wal", 2, "normal"]
    log.close()


def test_a_file_system_without_shared_memory_gives_the_same_guarantee(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    connect = sqlite3.connect

    def without(path: Path, **options: Any) -> sqlite3.Connection:
        # SQLite's "unix-none" has no shared memory, as some network file systems.
        return connect(f"{Path(path).as_uri()}?vfs=unix-none", uri=True, **options)

    with monkeypatch.context() as patch:
        patch.setattr(sqlite3, "connect", without)
        log = filled(tmp_path / "journal.sqlite")
        pragmas = ("journal_mode", "synchronous", "locking_mode")
        assert [log._connection.execute(f"PRAGMA {name}").fetchone()[0] for name in pragmas] == ["wal", 2, "exclusive"]
        log.close()
    with read_journal(tmp_path / "journal.sqlite") as read:
        assert read is not None
        assert len(read.entries()) == 3


def test_others_read_while_a_run_writes_each_as_it_was_when_they_began(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "mkdtemp", None)  # nothing is copied
    log = filled(tmp_path / "journal.sqlite")
    before = files(tmp_path)
    with read_journal(log.path, live=True) as early:
        assert early is not None
        assert len(dict(early.statuses())) == 3
        # The index in memory is shared with the writer, which is in the same process here.
        assert {**files(tmp_path), "journal.sqlite-shm": ""} == {**before, "journal.sqlite-shm": ""}
        log.add([outcome(3), outcome(4)], 1)
        with read_journal(log.path, live=True) as late:
            assert late is not None
            assert (len(early.entries()), len(late.entries())) == (3, 5)
    log.add([outcome(k) for k in range(5, 500)], 1)  # more than SQLite keeps in its log
    assert len(log.entries()) == 500
    log.close()
    assert [path.name for path in tmp_path.iterdir()] == ["journal.sqlite"]


@pytest.mark.parametrize("change", ["rename", "delete", "replace", "other journal", "other log"])
def test_nothing_is_acknowledged_in_a_folder_that_is_gone(tmp_path: Path, change: str) -> None:
    place, elsewhere = tmp_path / "toys", tmp_path / "old"
    place.mkdir()
    log = filled(place / "journal.sqlite")
    log.add([outcome(3)], 1)
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
    words = {"rename": f"renamed .* it is {elsewhere} now", "delete": "toys was deleted", "replace": f"{elsewhere} now"}
    with pytest.raises(StorageError, match=words.get(change, "was deleted or replaced")):
        log.add([outcome(4)], 1)
    log.close()


def test_reading_after_a_kill_finds_everything_and_changes_nothing(tmp_path: Path) -> None:
    log = filled(tmp_path / "journal.sqlite")
    dead = tmp_path / "dead"
    dead.mkdir()
    # The files as a killed process leaves them: most of the content is still in the write-ahead log.
    for name in ("journal.sqlite", "journal.sqlite-wal"):
        (dead / name).write_bytes((tmp_path / name).read_bytes())
    log.close()
    before = files(dead)
    with read_journal(dead / "journal.sqlite") as read:
        assert read is not None
        assert len(read.entries()) == 3
    assert files(dead) == before
    again = open_journal(dead / "journal.sqlite")
    assert len(again.entries()) == 3
    again.close()


def test_a_run_that_was_killed_when_it_had_just_begun_its_log_goes_on(tmp_path: Path) -> None:
    log = open_journal(tmp_path / "journal.sqlite")
    log.close()
    for name, content in {"wal": b"\x37\x7f\x06\x82" + bytes(28), "shm": bytes(32768)}.items():
        (tmp_path / f"journal.sqlite-{name}").write_bytes(content)
    with read_journal(tmp_path / "journal.sqlite") as read:
        assert read is None
    filled(tmp_path / "journal.sqlite").close()
    with read_journal(tmp_path / "journal.sqlite") as read:
        assert read is not None
        assert len(read.entries()) == 3


def test_an_estimate_that_is_added_again_takes_the_place_of_the_first(tmp_path: Path) -> None:
    log = filled(tmp_path / "journal.sqlite", count=2)
    log.add([outcome(1, 5.0), outcome(2)], 1)
    log.close()
    with read_journal(log.path) as read:
        assert read is not None
        assert [entry.content["delay"] for entry in read.entries().values()] == [8.0, 5.0, 8.0]


def test_what_cannot_be_stored_as_a_whole_is_not_stored(tmp_path: Path) -> None:
    log = filled(tmp_path / "journal.sqlite", count=1)
    log._connection.execute(
        "CREATE TRIGGER full BEFORE INSERT ON estimates WHEN new.replicate = 2 BEGIN SELECT raise(FAIL, 'full'); END"
    )
    with pytest.raises(StorageError, match="could not be written"):
        log.add([outcome(1), outcome(2)], 1)
    assert log.keys() == {outcome(0).key}
    log.close()


def test_the_seal_is_broken_by_new_estimates_and_by_a_new_plan(tmp_path: Path) -> None:
    log = filled(tmp_path / "journal.sqlite")
    log.mark_sealed("abc")
    assert log.sealed() == "abc"
    log.begin(MANIFEST, ORIGINS, "later", {})
    assert log.sealed() == "abc"
    log.add([outcome(7)], 2)
    assert log.sealed() is None
    log.mark_sealed("def")
    log.begin({**MANIFEST, "runs": 7}, ORIGINS, "later", {})
    assert log.sealed() is None
    log.close()


def test_a_changed_estimate_is_found_by_its_checksum(tmp_path: Path) -> None:
    path = tmp_path / "journal.sqlite"
    filled(path).close()
    data = path.read_bytes()
    assert data.count(b'"delay":8.0,') == 1
    path.write_bytes(data.replace(b'"delay":8.0,', b'"delay":9.0,'))
    with read_journal(path) as read:
        assert read is not None
        read.check()
        with pytest.raises(StorageError, match=f"estimate {outcome(0).key.id} has changed"):
            read.entries()


def test_no_flipped_bit_changes_what_is_read(tmp_path: Path) -> None:
    path = tmp_path / "journal.sqlite"
    log = filled(path, count=40)
    expected = log.entries(), log.manifest(), log.sessions(), log.origins(), log.keys()
    log.close()
    intact, rng, found = path.read_bytes(), random.Random(4), 0
    used = [k for k, byte in enumerate(intact) if byte]
    for position in rng.sample(used, 250):
        path.write_bytes(intact[:position] + bytes([intact[position] ^ 1 << rng.randrange(8)]) + intact[position + 1 :])
        try:
            with read_journal(path) as read:
                assert read is not None
                assert (read.entries(), read.manifest(), read.sessions(), read.origins(), read.keys()) == expected
        except (StorageError, RefusedError):
            found += 1
    assert found > 200


def test_an_estimate_that_is_missing_or_doubled_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "journal.sqlite"
    log = filled(path, count=5)
    log._connection.execute("DELETE FROM estimates WHERE replicate = 3")
    log.close()
    with read_journal(path) as read:
        assert read is not None
        read.check()
        for reading in (read.keys, lambda: [*read.statuses()], read.entries, read.require_all):
            with pytest.raises(DamageError, match="5 estimates were written, 4 are there"):
                reading()
    with pytest.raises(DamageError, match="5 estimates were written, 4 are there"):
        open_journal(path)


def test_every_damaged_page_is_reported_as_damage(tmp_path: Path) -> None:
    path = tmp_path / "journal.sqlite"
    log = filled(path, count=300)
    expected = log.entries()
    log.close()
    intact = path.read_bytes()
    found = 0
    for page in range(0, len(intact), 4096):
        path.write_bytes(intact[:page] + b"\xa5" * 4096 + intact[page + 4096 :])
        try:
            with read_journal(path) as read:
                assert read is not None
                read.check()
                assert (read.experiment(), read.manifest(), read.origins()) == ("toys", MANIFEST, {1: ORIGIN})
                assert read.entries() == expected
        except StorageError:
            found += 1
    assert found == len(intact) // 4096


@pytest.mark.parametrize("content", [b"not a database at all, only text\n" * 200, b"SQLite format 3\0"])
def test_other_files_are_not_taken_for_a_journal(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "journal.sqlite"
    path.write_bytes(content)
    with pytest.raises(StorageError, match="journal"), read_journal(path):
        pass
    with pytest.raises(StorageError):
        open_journal(path)
    assert path.read_bytes() == content


def test_another_programs_database_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "journal.sqlite"
    with sqlite3.connect(path) as connection:
        connection.execute("CREATE TABLE meta (name, value)")
    connection.close()
    with pytest.raises(StorageError, match="not a journal of ctid"), read_journal(path):
        pass


def test_a_newer_format_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "journal.sqlite"
    log = filled(path)
    log._connection.execute("PRAGMA user_version=5")
    log.close()
    with pytest.raises(RefusedError, match="format 5; this ctid reads formats up to 4"), read_journal(path):
        pass


def test_no_journal_and_an_empty_one_are_the_same(tmp_path: Path) -> None:
    path = tmp_path / "journal.sqlite"
    with read_journal(path) as read:
        assert read is None
    path.touch()
    with read_journal(path) as read:
        assert read is None
    open_journal(path).close()
    with read_journal(path) as read:
        assert read is None


def test_a_journal_without_processor_times_is_read_and_goes_on(tmp_path: Path) -> None:
    path = tmp_path / "journal.sqlite"
    log = filled(path, count=2)
    before_format_4(log)
    log._connection.execute("ALTER TABLE estimates DROP COLUMN cpu_seconds")
    log._connection.execute("PRAGMA user_version=2")
    log.close()
    before = path.read_bytes()
    with read_journal(path) as read:
        assert read is not None
        assert [(entry.seconds, entry.cpu_seconds) for entry in read.entries().values()] == [(0.25, None)] * 2
    assert path.read_bytes() == before
    log = open_journal(path)
    session = log.begin(MANIFEST, ORIGINS, "2026-11-21T06:00:00Z", {})
    log.add([outcome(7)._replace(cpu_seconds=0.125)], session)
    assert sorted(entry.cpu_seconds or 0.0 for entry in log.entries().values()) == [0.0, 0.0, 0.125]
    log.close()
