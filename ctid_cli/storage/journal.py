"""The live log of an experiment: an SQLite file that only the process of the run writes.

What a commit has acknowledged survives the death of the process and of the machine (write-ahead log, full
synchronisation). The file holds every estimate ever computed in the folder, also those that later plans leave aside,
and one line for each run with everything that does not belong among the results: times, host, command.
"""

import hashlib
import itertools
import json
import shutil
import sqlite3
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ctid_cli.canonical import canonical_json
from ctid_cli.errors import StorageError
from ctid_cli.storage.columns import FAILURES
from ctid_cli.storage.foreign import read_json, require_manifest
from ctid_cli.storage.identity import Origin, gathered
from ctid_cli.storage.manifest import Key, Manifest, Outcome, refuse_newer

FILE_NAME = "journal.sqlite"
#: Raised by one whenever an older ctid could misread the file.
FORMAT = 3
#: Marks an SQLite file as a journal of ctid ("ctid" in ASCII).
APPLICATION = 0x63746964

_SCHEMA = (
    "CREATE TABLE meta (name TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID",
    "CREATE TABLE origins (number INTEGER PRIMARY KEY, code_version TEXT, platform TEXT, packages TEXT)",
    "CREATE TABLE sessions (number INTEGER PRIMARY KEY, started TEXT, stopped TEXT, reason TEXT, info TEXT)",
    """CREATE TABLE estimates (
        data_hash TEXT, replicate INTEGER, estimator_hash TEXT, start TEXT,
        result TEXT NOT NULL, checksum TEXT NOT NULL, seconds REAL, session INTEGER NOT NULL, origin INTEGER,
        cpu_seconds REAL,
        PRIMARY KEY (data_hash, replicate, estimator_hash, start)) WITHOUT ROWID""",
)
#: From each format to the next: in the first a run had one origin, whatever its estimators, the second has no CPU time.
_UPGRADES = (
    (
        "ALTER TABLE estimates ADD COLUMN origin INTEGER",
        "UPDATE estimates SET origin = (SELECT origin FROM sessions WHERE number = session)",
        "ALTER TABLE sessions DROP COLUMN origin",
    ),
    ("ALTER TABLE estimates ADD COLUMN cpu_seconds REAL",),
)
_SEALED = "sealed"
#: Columns of the identity of an estimate.
_KEY = "data_hash, replicate, estimator_hash, start"
#: In format 1 it is the run that has the origin.
_WITH_RUNS = "FROM estimates JOIN sessions ON session = number"


@dataclass(frozen=True)
class Entry:
    """A stored estimate."""

    result: dict[str, Any]
    #: Time it took, and processor time [s].
    seconds: float | None
    cpu_seconds: float | None
    session: int
    origin: Origin


class Journal:
    """An open journal."""

    def __init__(self, connection: sqlite3.Connection, path: Path) -> None:
        self._connection = connection
        self.path = path
        #: Numbers of the present run's origins by estimator.
        self._origins: dict[str, int] = {}

    def experiment(self) -> str:
        """Name of the experiment."""
        return str(self.manifest()["experiment"])

    def manifest(self) -> Manifest:
        """The plan of the latest run."""
        with self._guard("read"):
            return require_manifest(read_json(self._meta("manifest") or ""))

    def sealed(self) -> str | None:
        """Checksum of the sealed file, or None if estimates came after it."""
        return self._meta(_SEALED)

    def origins(self) -> tuple[Origin, ...]:
        """Where the stored estimates come from."""
        return gathered((estimator, origin) for _, estimator, origin in self.made())

    def made(self) -> set[tuple[str, str, Origin]]:
        """Data cells and estimators of the stored estimates, and where these come from."""
        known = self._known_origins()
        rows = self._rows(f"SELECT DISTINCT data_hash, estimator_hash, origin {_WITH_RUNS}")
        return {(data, estimator, known[origin]) for data, estimator, origin in rows}

    def _known_origins(self) -> dict[int, Origin]:
        rows = self._rows("SELECT number, code_version, platform, packages FROM origins")
        with self._guard("read"):
            return {number: Origin.of(code, machine, json.loads(packages)) for number, code, machine, packages in rows}

    def sessions(self) -> list[dict[str, Any]]:
        """Every run that has written here, the oldest first."""
        rows = self._rows("SELECT info, number, started, stopped, reason FROM sessions ORDER BY number")
        names = ("session", "started", "stopped", "reason")
        with self._guard("read"):
            return [dict(zip(names, values, strict=True)) | json.loads(info) for info, *values in rows]

    def keys(self) -> set[Key]:
        """Which estimates are stored."""
        return {Key(*row) for row in self._rows(f"SELECT {_KEY} FROM estimates")}

    def statuses(self) -> dict[Key, str]:
        """Status of every stored estimate."""
        rows = self._rows(f"SELECT json_extract(result, '$.status'), {_KEY} FROM estimates")
        return {Key(*parts): status for status, *parts in rows}

    def failures(self) -> list[tuple[Key, str, int]]:
        """Every stored failure: its status, and the run that it comes from."""
        marks = ", ".join("?" * len(FAILURES))
        chosen = f"json_extract(result, '$.status') AS status, session, {_KEY}"
        rows = self._rows(f"SELECT {chosen} FROM estimates WHERE status IN ({marks})", *FAILURES)
        return [(Key(*parts), status, session) for status, session, *parts in rows]

    def entries(self) -> dict[Key, Entry]:
        """Every stored estimate, each compared with its checksum."""
        found, origins = {}, self._known_origins()
        with self._guard("read"):
            # A file that is only read keeps its format.
            columns = {name for _, name, *_ in self._connection.execute("PRAGMA table_info(estimates)")}
            cpu = "cpu_seconds" if "cpu_seconds" in columns else "NULL"
            chosen = f"result, checksum, seconds, {cpu}, session, origin, {_KEY}"
            rows = self._connection.execute(f"SELECT {chosen} {_WITH_RUNS}")
            for result, checksum, seconds, cpu_seconds, session, origin, *parts in rows:
                key = Key(*parts)
                if _checksum(key, result) != checksum:
                    raise StorageError(f"{self.path} is damaged: estimate {key.id} has changed since it was written")
                found[key] = Entry(json.loads(result), seconds, cpu_seconds, session, origins[origin])
        return found

    def check(self) -> None:
        """Refuse a file that SQLite finds damaged."""
        found = self._rows("PRAGMA quick_check(1)")
        if found != [("ok",)]:
            raise StorageError(f"{self.path} is damaged: {found[0][0] if found else 'no answer'}")

    def begin(self, manifest: Manifest, origins: Mapping[str, Origin], started: str, info: dict[str, Any]) -> int:
        """Note that a run begins, and where the estimates of each estimator will come from."""
        with self._transaction() as connection:
            self._replan(manifest)
            known = {origin: number for number, origin in self._known_origins().items()}
            for estimator, origin in origins.items():
                if origin not in known:
                    row = (origin.code_version, origin.platform, canonical_json(origin.packages))
                    cursor = connection.execute(
                        "INSERT INTO origins (code_version, platform, packages) VALUES (?, ?, ?)", row
                    )
                    known[origin] = int(cursor.lastrowid or 0)
                self._origins[estimator] = known[origin]
            cursor = connection.execute(
                "INSERT INTO sessions (started, info) VALUES (?, ?)", (started, canonical_json(info))
            )
            return int(cursor.lastrowid or 0)

    def replan(self, manifest: Manifest) -> None:
        """Note that the plan of the present run has changed."""
        with self._transaction():
            self._replan(manifest)

    def _replan(self, manifest: Manifest) -> None:
        # Not sorted: the order of swept fields and starts is that of the specification.
        text = json.dumps(manifest, allow_nan=False)
        if self._meta("manifest") != text:
            self._set_meta("manifest", text)
            self._connection.execute("DELETE FROM meta WHERE name = ?", (_SEALED,))

    def add(self, outcomes: Iterable[Outcome], session: int) -> None:
        """Store estimates, in place of earlier ones if there are any; when this returns, they are safe."""
        rows = []
        for key, result, seconds, cpu_seconds in outcomes:
            text = canonical_json(result)
            origin = self._origins[key.estimator_hash]
            rows.append((*key, text, _checksum(key, text), seconds, session, origin, cpu_seconds))
        with self._transaction() as connection:
            connection.executemany("INSERT OR REPLACE INTO estimates VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)", rows)
            connection.execute("DELETE FROM meta WHERE name = ?", (_SEALED,))

    def mark_sealed(self, checksum: str) -> None:
        """Note that the sealed file holds the present estimates of the present plan."""
        with self._transaction():
            self._set_meta(_SEALED, checksum)

    def end(self, session: int, stopped: str, reason: str) -> None:
        """Note that a run ends."""
        with self._transaction() as connection:
            connection.execute(
                "UPDATE sessions SET stopped = ?, reason = ? WHERE number = ?", (stopped, reason, session)
            )

    def close(self) -> None:
        """Close the file; closing cannot lose what was acknowledged, so it does not complain."""
        with suppress(sqlite3.Error):
            self._connection.close()

    def _rows(self, query: str, *values: str) -> list[Any]:
        with self._guard("read"):
            return self._connection.execute(query, values).fetchall()

    def _meta(self, name: str) -> str | None:
        rows = self._rows("SELECT value FROM meta WHERE name = ?", name)
        return str(rows[0][0]) if rows else None

    def _set_meta(self, name: str, value: str) -> None:
        self._connection.execute("INSERT OR REPLACE INTO meta VALUES (?, ?)", (name, value))

    @contextmanager
    def _transaction(self) -> Iterator[sqlite3.Connection]:
        # The connection commits, or rolls back what an exception has left undone.
        with self._guard("write"), self._connection as connection:
            connection.execute("BEGIN IMMEDIATE")
            yield connection

    @contextmanager
    def _guard(self, action: str) -> Iterator[None]:
        try:
            yield
        except (sqlite3.Error, ValueError) as error:
            if action == "write":
                message = f"{self.path} could not be written ({error}); all that was reported as done is safe in it"
            else:
                message = f"{self.path} is damaged or not a journal ({error})"
            raise StorageError(message) from error


def open_journal(path: Path) -> Journal:
    """Open a journal for writing, and make it if there is none."""
    with ExitStack() as stack:
        try:
            connection = sqlite3.connect(path, isolation_level=None, timeout=0.0)
            stack.callback(connection.close)
            for setting in ("locking_mode=EXCLUSIVE", "journal_mode=WAL", "synchronous=FULL"):
                connection.execute(f"PRAGMA {setting}")
            new = not connection.execute("SELECT 1 FROM sqlite_master LIMIT 1").fetchone()
            if new or _format(connection, path) < FORMAT:
                connection.execute("BEGIN IMMEDIATE")
                upgrades = () if new else _UPGRADES[_format(connection, path) - 1 :]
                for statement in _SCHEMA if new else itertools.chain(*upgrades):
                    connection.execute(statement)
                connection.execute(f"PRAGMA application_id={APPLICATION}")
                connection.execute(f"PRAGMA user_version={FORMAT}")
                connection.execute("COMMIT")
        except sqlite3.Error as error:
            raise StorageError(f"{path} is damaged or no journal, or cannot be written ({error})") from error
        stack.pop_all()
        return Journal(connection, path)


@contextmanager
def read_journal(path: Path) -> Iterator[Journal | None]:
    """Open a journal for reading without touching its file.

    After a kill, acknowledged estimates stand in the write-ahead log beside the file. Reading them in place would make
    SQLite move them, so in that case a copy is read; refusing a folder must not change it.
    """
    if not path.exists():
        yield None
        return
    log = path.with_name(path.name + "-wal")
    with ExitStack() as stack:
        try:
            if log.exists() and log.stat().st_size:
                copy = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="ctid-"))) / FILE_NAME
                shutil.copyfile(path, copy)
                shutil.copyfile(log, copy.with_name(copy.name + "-wal"))
                connection = sqlite3.connect(copy, isolation_level=None)
            else:
                address = f"{path.resolve().as_uri()}?mode=ro&immutable=1"
                connection = sqlite3.connect(address, uri=True, isolation_level=None)
            stack.callback(connection.close)
            planned = connection.execute("SELECT 1 FROM sqlite_master LIMIT 1").fetchone()
            if planned:
                _format(connection, path)
                planned = connection.execute("SELECT 1 FROM meta WHERE name = 'manifest'").fetchone()
        except (sqlite3.Error, OSError) as error:
            raise StorageError(f"{path} cannot be read, is damaged or not a journal ({error})") from error
        yield Journal(connection, path) if planned else None


def _format(connection: sqlite3.Connection, path: Path) -> int:
    """Format of a journal; other files, and newer formats, are refused."""
    (application,) = connection.execute("PRAGMA application_id").fetchone()
    (written_by,) = connection.execute("PRAGMA user_version").fetchone()
    if application != APPLICATION:
        raise StorageError(f"{path} is an SQLite file, but not a journal of ctid")
    refuse_newer(path, written_by, FORMAT)
    return int(written_by)


def _checksum(key: Key, result: str) -> str:
    return hashlib.sha256("\n".join([*map(str, key), result]).encode()).hexdigest()[:32]
