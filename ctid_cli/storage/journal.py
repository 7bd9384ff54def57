"""The live log of an experiment: an SQLite file that only the process of the run writes.

What a commit has acknowledged survives the death of the process and of the machine (write-ahead log, full
synchronisation), and is where the path says: a folder that was renamed, replaced or deleted is noticed before. The file
holds every estimate ever computed in the folder, also those that later plans leave aside, and one line for each run
with everything that does not belong among the results: times, host, command.

Nothing that is read is trusted: every row carries a checksum, and a tally over those of all estimates tells that none
is missing. Others may read while the run writes: each sees the file as it was when it began to read.
"""

import hashlib
import itertools
import json
import math
import sqlite3
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from ctid_cli.canonical import canonical_json
from ctid_cli.storage.identity import Origin
from ctid_cli.storage.journal_reader import (
    APPLICATION,
    CHECKED,
    ERRORS,
    FILE_NAME,
    FORMAT,
    KEY,
    SEALED,
    TALLY,
    JournalReader,
    Row,
    Tally,
    format_of,
    refuse,
    row_digest,
)
from ctid_cli.storage.manifest import Manifest, Outcome
from ctid_cli.storage.whereabouts import Whereabouts
from ctid_cli.written_files import write_file

__all__ = ["FILE_NAME", "Journal", "open_journal"]

_FILES = "CREATE TABLE files (name TEXT, sha256 TEXT, checksum TEXT, PRIMARY KEY (name, sha256)) WITHOUT ROWID"
_SCHEMA = (
    "CREATE TABLE meta (name TEXT PRIMARY KEY, value TEXT NOT NULL, checksum TEXT) WITHOUT ROWID",
    "CREATE TABLE origins (number INTEGER PRIMARY KEY, code_version TEXT, platform TEXT, packages TEXT, checksum TEXT)",
    """CREATE TABLE sessions (
        number INTEGER PRIMARY KEY, started TEXT, stopped TEXT, reason TEXT, info TEXT, checksum TEXT)""",
    """CREATE TABLE estimates (
        data_hash TEXT, replicate INTEGER, estimator_hash TEXT, start TEXT,
        result TEXT NOT NULL, checksum TEXT NOT NULL, seconds REAL, session INTEGER NOT NULL, origin INTEGER,
        cpu_seconds REAL,
        PRIMARY KEY (data_hash, replicate, estimator_hash, start)) WITHOUT ROWID""",
    _FILES,
)
#: From each format to the next: in the first a run had one origin, whatever its estimators, the second has no CPU time,
#: in the third only estimates have a checksum, of what they are and not of how long they took.
_UPGRADES = (
    (
        "ALTER TABLE estimates ADD COLUMN origin INTEGER",
        "UPDATE estimates SET origin = (SELECT origin FROM sessions WHERE number = session)",
        "ALTER TABLE sessions DROP COLUMN origin",
    ),
    ("ALTER TABLE estimates ADD COLUMN cpu_seconds REAL",),
    (*(f"ALTER TABLE {table} ADD COLUMN checksum TEXT" for table in ("meta", "origins", "sessions")), _FILES),
)


class Journal(JournalReader):
    """A journal that is open for writing."""

    def __init__(self, connection: sqlite3.Connection, path: Path) -> None:
        super().__init__(connection, path)
        #: Where its files lay when it was opened, and the estimates in it.
        self._whereabouts: Whereabouts | None = None
        self._tally = Tally()
        #: Numbers of the present run's origins by estimator.
        self._origins: dict[str, int] = {}

    def write_beside(self, name: str, data: bytes) -> None:
        """Write a file beside the journal, if it is not there already."""
        # Noted first: whenever the run is killed, the file holds something that is known.
        with self._transaction():
            self._insert("files", name, hashlib.sha256(data).hexdigest())
        path = self.path.parent / name
        if not path.exists() or path.read_bytes() != data:
            write_file(path, data)

    def begin(self, manifest: Manifest, origins: Mapping[str, Origin], started: str, info: dict[str, Any]) -> int:
        """Note that a run begins, and where the estimates of each estimator will come from."""
        with self._transaction():
            self._replan(manifest)
            known = {origin: number for number, origin in self.known_origins().items()}
            for estimator, origin in origins.items():
                if origin not in known:
                    number = known[origin] = self._next("origins")
                    self._insert("origins", number, *_origin_row(origin))
                self._origins[estimator] = known[origin]
            session = self._next("sessions")
            self._insert("sessions", session, started, None, None, canonical_json(info))
        return session

    def replan(self, manifest: Manifest) -> None:
        """Note that the plan of the present run has changed."""
        with self._transaction():
            self._replan(manifest)

    def _replan(self, manifest: Manifest) -> None:
        # Not sorted: the order of swept fields and starts is that of the specification.
        text = json.dumps(manifest, allow_nan=False)
        if self._meta("manifest") != text:
            self._insert("meta", "manifest", text)
            self._connection.execute("DELETE FROM meta WHERE name = ?", (SEALED,))

    def add(self, outcomes: Iterable[Outcome], session: int) -> None:
        """Store estimates, in place of earlier ones if there are any; when this returns, they are safe."""
        rows = []
        for key, result, seconds, cpu_seconds in outcomes:
            times = _finite(seconds), _finite(cpu_seconds)
            rows.append(Row(key, canonical_json(result), "", *times, session, self._origins[key.estimator_hash]))
        with self._transaction():
            tally = self._add(rows)
        self._tally = tally

    def restore(
        self,
        manifest: Manifest,
        origins: Mapping[int, Origin],
        sessions: Mapping[int, Sequence[Any]],
        rows: Iterable[Row],
    ) -> None:
        """Fill an empty journal with what was saved of another."""
        with self._transaction():
            self._replan(manifest)
            for number, origin in origins.items():
                self._insert("origins", number, *_origin_row(origin))
            for number, session in sessions.items():
                self._insert("sessions", number, *session)
            tally = self._add(rows)
        self._tally = tally

    def _add(self, rows: Iterable[Row]) -> Tally:
        tally = Tally(self._tally.count, self._tally.mark)
        for row in rows:
            checksum = row.digest()
            # What it replaces is not counted any more.
            where = " AND ".join(f"{name} = ?" for name in KEY.split(", "))
            query = f"SELECT checksum FROM estimates WHERE {where}"
            for (earlier,) in self._connection.execute(query, row.key).fetchall():
                tally.add(earlier, -1)
            tally.add(checksum)
            values = (*row.key, row.result, checksum, row.seconds, row.session, row.origin, row.cpu_seconds)
            self._connection.execute("INSERT OR REPLACE INTO estimates VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)", values)
        self._connection.execute("DELETE FROM meta WHERE name = ?", (SEALED,))
        self._insert("meta", TALLY, str(tally))
        return tally

    def mark_sealed(self, checksum: str) -> None:
        """Note that the sealed file holds the present estimates of the present plan."""
        with self._transaction():
            self._insert("meta", SEALED, checksum)

    def end(self, session: int, stopped: str, reason: str) -> None:
        """Note that a run ends."""
        with self._transaction() as connection:
            query = "SELECT number, started, info FROM sessions WHERE number = ?"
            number, started, info = connection.execute(query, (session,)).fetchone()
            self._insert("sessions", number, started, stopped, reason, info)

    def require_in_place(self) -> None:
        """Refuse to go on in a file that its path does not lead to any more."""
        if self._whereabouts is not None:
            self._whereabouts.check()

    def prepare(self) -> None:
        """Check everything before anything is added, and remember where the files are."""
        self._tally = self.require_all() if self._format else Tally()
        if self._format < FORMAT:
            with self._transaction():
                self._upgrade()
        self._whereabouts = Whereabouts(self.path, self.path.with_name(f"{self.path.name}-wal"))

    def _upgrade(self) -> None:
        """Bring a journal of an older format, or an empty one, to the present one."""
        execute, old = self._connection.execute, self._format
        for statement in itertools.chain(*_UPGRADES[old - 1 :]) if old else _SCHEMA:
            execute(statement)
        execute(f"PRAGMA application_id={APPLICATION}")
        execute(f"PRAGMA user_version={FORMAT}")
        self._format = FORMAT
        if old < CHECKED:
            for table in ("meta", "origins", "sessions"):
                for *row, _ in execute(f"SELECT * FROM {table}").fetchall():
                    self._insert(table, *row)
            self._insert("meta", TALLY, str(self._tally))

    def close(self) -> None:
        """Close the file; closing cannot lose what was acknowledged, so it does not complain."""
        with suppress(sqlite3.Error):
            self._connection.close()
        if self._whereabouts is not None:
            self._whereabouts.close()

    def _insert(self, table: str, *row: Any) -> None:
        """Store a row and its checksum, in place of one with the same key."""
        marks = ", ".join("?" * (len(row) + 1))
        self._connection.execute(f"INSERT OR REPLACE INTO {table} VALUES ({marks})", (*row, row_digest(table, *row)))

    def _next(self, table: str) -> int:
        (number,) = self._connection.execute(f"SELECT coalesce(max(number), 0) + 1 FROM {table}").fetchone()
        return int(number)

    @contextmanager
    def _transaction(self) -> Iterator[sqlite3.Connection]:
        # The connection commits, or rolls back what an exception has left undone.
        with self._guard(writing=True), self._connection as connection:
            connection.execute("BEGIN IMMEDIATE")
            yield connection
        self.require_in_place()


def open_journal(path: Path) -> Journal:
    """Open a journal for writing, and make it if there is none."""
    with ExitStack() as stack:
        try:
            connection = sqlite3.connect(path, isolation_level=None, timeout=0.0)
            stack.callback(connection.close)
            _set_up(connection)
            if connection.execute("SELECT 1 FROM sqlite_master LIMIT 1").fetchone():
                format_of(connection, path)
            log = Journal(connection, path)
            log.prepare()
        except (OSError, *ERRORS) as error:
            refuse(path, error, writing=True)
        stack.pop_all()
        return log


def _set_up(connection: sqlite3.Connection) -> None:
    """Make commits durable, and let others read meanwhile where the file system has shared memory for it."""
    for locking in ("NORMAL", "EXCLUSIVE"):
        connection.execute(f"PRAGMA locking_mode={locking}")
        if connection.execute("PRAGMA journal_mode=WAL").fetchone() == ("wal",):
            break
    connection.execute("PRAGMA synchronous=FULL")


def _origin_row(origin: Origin) -> tuple[str, str, str]:
    return origin.code_version, origin.platform, canonical_json(origin.packages)


def _finite(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else float(value)
