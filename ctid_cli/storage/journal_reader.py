"""Reading the journal: nothing is trusted before it is compared with its checksum."""

import hashlib
import json
import shutil
import sqlite3
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import numpy as np

from ctid_cli.errors import DamageError, StorageError
from ctid_cli.storage.foreign import read_json, require_manifest
from ctid_cli.storage.identity import Origin, gathered
from ctid_cli.storage.manifest import Key, Manifest, refuse_newer
from ctid_cli.storage.pieces import ROWS, ranges
from ctid_cli.temporary import TemporaryFolder

FILE_NAME = "journal.sqlite"
#: Raised by one whenever an older ctid could misread the file.
FORMAT = 4
#: Marks an SQLite file as a journal of ctid ("ctid" in ASCII).
APPLICATION = 0x63746964

#: More estimates than these are compared one by one only where they are read, and by `ctid verify`.
LARGE = 100_000
#: First format in which every row has a checksum over all of it.
CHECKED = 4
SEALED, TALLY = "sealed", "tally"
#: Columns of the identity of an estimate.
KEY = "data_hash, replicate, estimator_hash, start"
#: In format 1 it is the run that has the origin.
_WITH_RUNS = "estimates JOIN sessions ON session = number"
#: What keeps SQLite from reading or writing a file that is in order; all else that it reports is damage.
_HINDRANCES = ("READONLY", "CANTOPEN", "FULL", "IOERR", "PERM", "AUTH", "BUSY", "LOCKED", "NOMEM", "PROTOCOL")
#: What damage can cause while it is read.
ERRORS = (sqlite3.Error, ValueError, TypeError, KeyError, IndexError, OverflowError)
#: What a row is written as for its checksum: made once, and rows hold no other rows, because there are many of them.
_ROW_TEXT = json.JSONEncoder(default=repr, check_circular=False).encode
#: How long a reader waits for a moment at which the file can be read [s].
_READER_PATIENCE = 2.0
#: Bytes at the beginning of a write-ahead log.
_LOG_HEADER = 32


class Row(NamedTuple):
    """An estimate as it is stored."""

    key: Key
    result: str
    checksum: str
    seconds: float | None
    cpu_seconds: float | None
    session: int
    origin: int

    def is_intact(self) -> bool:
        """Whether it is what was written; before format 4 times, runs and origins had no checksum."""
        if self.checksum == self.digest():
            return True
        return self.checksum == _text_digest("\n".join([*map(str, self.key), self.result]))

    @property
    def content(self) -> dict[str, Any]:
        """Its result; as a text it takes a fifth of the memory."""
        found: dict[str, Any] = json.loads(self.result)
        return found

    def digest(self) -> str:
        """Checksum of all of it."""
        return row_digest("estimates", *self.key, self.result, *self[3:])


@dataclass
class Tally:
    """How many estimates there are, and all their checksums in one number, whatever their order."""

    count: int = 0
    mark: int = 0

    def add(self, checksum: str, count: int = 1) -> None:
        """Count an estimate, or with -1 count it no more."""
        self.count += count
        self.mark ^= int(checksum, 16)

    def add_all(self, checksums: str) -> None:
        """Count estimates, whose checksums stand one behind the other."""
        halves = np.frombuffer(bytes.fromhex(checksums), dtype=">u8").reshape(-1, 2)
        self.count += len(halves)
        self.mark ^= int.from_bytes(np.bitwise_xor.reduce(halves, axis=0).astype(">u8").tobytes(), "big")

    def __str__(self) -> str:
        return f"{self.count} {self.mark:032x}"


class JournalReader:
    """An open journal, as far as it is read."""

    def __init__(self, connection: sqlite3.Connection, path: Path, *, live: bool = False) -> None:
        self._connection = connection
        self.path = path
        #: Whether a run is writing to it while it is read.
        self.live = live
        (self._format,) = connection.execute("PRAGMA user_version").fetchone()

    def experiment(self) -> str:
        """Name of the experiment."""
        return str(self.manifest()["experiment"])

    def manifest(self) -> Manifest:
        """The plan of the latest run."""
        with self._guard():
            return require_manifest(read_json(self._meta("manifest") or ""))

    def sealed(self) -> str | None:
        """Checksum of the sealed file, or None if estimates came after it."""
        return self._meta(SEALED)

    def state(self) -> str | None:
        """What changes with everything that a run writes; None before format 4."""
        tally = self._meta(TALLY)
        return None if tally is None else f"{tally} {self._rows('SELECT max(number) FROM sessions')[0][0]}"

    def origins(self) -> tuple[Origin, ...]:
        """Where the stored estimates come from."""
        return gathered((estimator, origin) for _, estimator, origin in self.made())

    def made(self) -> set[tuple[str, str, Origin]]:
        """Data cells and estimators of the stored estimates, and where these come from."""
        known = self.known_origins()
        rows = self._rows(f"SELECT DISTINCT data_hash, estimator_hash, origin FROM {self._estimates}")
        return {(data, estimator, known[origin]) for data, estimator, origin in rows}

    @property
    def _estimates(self) -> str:
        return "estimates" if self._format > 1 else _WITH_RUNS

    def known_origins(self) -> dict[int, Origin]:
        """Where estimates may come from, by number."""
        rows = self._checked("origins", "number, code_version, platform, packages")
        with self._guard():
            return {number: Origin.of(code, machine, json.loads(packages)) for number, code, machine, packages in rows}

    def sessions(self) -> list[dict[str, Any]]:
        """Every run that has written here, the oldest first."""
        names = ("session", "started", "stopped", "reason")
        rows = self._checked("sessions", "number, started, stopped, reason, info")
        with self._guard():
            return [dict(zip(names, values, strict=True)) | json.loads(info) for *values, info in rows]

    def keys(self) -> set[Key]:
        """Which estimates are stored."""
        found = {Key(*row) for row in self._rows(f"SELECT {KEY} FROM estimates")}
        self._require_count(len(found))
        return found

    def entries(self) -> dict[Key, Row]:
        """Every stored estimate, for many of them without checksums, and with keys whose texts are those of others."""
        known = self.known_origins()
        with self._guard():
            # An origin that is lost is damage.
            rows = (row for row in self.rows() if known[row.origin])
            return {(key := _shared(row.key)): row._replace(key=key, checksum="") for row in rows}

    def rows(self) -> Iterator[Row]:
        """Every stored estimate, compared with its checksum; at the end, all of them with their tally."""
        tally = Tally()
        with self._guard():
            for values in self._connection.execute(f"SELECT {self._selected} FROM {self._estimates}"):
                row = self._intact(Row(Key(*values[:4]), *values[4:]))
                tally.add(row.checksum)
                yield row
        self._require(tally)

    def _require(self, tally: Tally) -> None:
        """Refuse estimates that are not all that were written."""
        self._require_count(tally.count)
        if self._meta(TALLY) not in (None, str(tally)):
            raise DamageError(f"{self.path} is damaged: its estimates are not those that were written")

    @property
    def _selected(self) -> str:
        # A file that is only read keeps its format.
        cpu = "cpu_seconds" if self._format > 2 else "NULL"
        return f"{KEY}, result, estimates.checksum, seconds, {cpu}, session, origin"

    def _require_count(self, count: int) -> None:
        stored = self._meta(TALLY)
        # Before format 4 nobody counted.
        if stored is None and self._format < CHECKED:
            return
        written = "an unknown number of" if stored is None else stored.split()[0]
        if written != str(count):
            raise DamageError(f"{self.path} is damaged: {written} estimates were written, {count} are there")

    def check(self, *, fully: bool = False) -> None:
        """Refuse a file that SQLite finds damaged; fully, compare indices with tables too."""
        found = self._rows(f"PRAGMA {'integrity' if fully else 'quick'}_check(1)")
        if found != [("ok",)]:
            raise DamageError(f"{self.path} is damaged: {found[0][0] if found else 'no answer'}")

    def files(self) -> dict[str, set[str]]:
        """SHA-256 of everything that was ever written to the files beside the journal, by name."""
        noted: dict[str, set[str]] = {}
        for name, sha256 in self._checked("files", "name, sha256") if self._format >= CHECKED else ():
            noted.setdefault(name, set()).add(sha256)
        return noted

    def _rows(self, query: str, *values: str) -> list[Any]:
        with self._guard():
            return self._connection.execute(query, values).fetchall()

    def _checked(self, table: str, columns: str, where: str = "", *values: str) -> list[Any]:
        """Rows of a table, compared with their checksums; it is read whole, so that ``columns`` are all but that."""
        if self._format < CHECKED:
            return self._rows(f"SELECT {columns} FROM {table} {where}", *values)
        rows = self._rows(f"SELECT {columns}, checksum FROM {table} {where}", *values)
        for *row, checksum in rows:
            if row_digest(table, *row) != checksum:
                raise DamageError(f"{self.path} is damaged: {table} {row[0]!r} has changed since it was written")
        return [row for *row, _ in rows]

    def _meta(self, name: str) -> str | None:
        rows = self._checked("meta", "name, value", "WHERE name = ?", name)
        return str(rows[0][1]) if rows else None

    @contextmanager
    def _guard(self, *, writing: bool = False) -> Iterator[None]:
        try:
            yield
        except ERRORS as error:
            refuse(self.path, error, writing=writing)

    def count(self) -> int:
        """How many estimates are stored."""
        stored = self._meta(TALLY)
        return int(stored.split()[0]) if stored is not None else int(self._rows("SELECT count(*) FROM estimates")[0][0])

    @property
    def is_large(self) -> bool:
        """Whether it would take seconds to compare every estimate with its checksum."""
        return self.count() > LARGE

    def mean_seconds(self) -> float | None:
        """Mean time of an estimate [s]; None where none is known."""
        ((mean,),) = self._rows("SELECT avg(seconds) FROM estimates")
        return None if mean is None else float(mean)

    def rows_of(
        self, data_hash: str, estimator_hash: str, replicates: Sequence[int], starts: Sequence[str]
    ) -> Iterator[Row]:
        """Those of an estimator on a data cell that are stored, in this order, compared with their checksums."""
        # SQLite keeps to the order of a cross join, and looks each of them up.
        given = "json_each(?) AS replicates CROSS JOIN json_each(?) AS starts"
        where = "data_hash = ? AND replicate = replicates.value AND estimator_hash = ? AND start = starts.value"
        query = f"SELECT {self._selected} FROM {given} CROSS JOIN {self._estimates} WHERE {where}"
        for first, last in ranges(len(replicates)):
            some = json.dumps(list(replicates[first:last])), json.dumps(list(starts))
            with self._guard():
                for row in self._connection.execute(query, (*some, data_hash, estimator_hash)):
                    yield self._intact(Row(Key(*row[:4]), *row[4:]))

    def _intact(self, row: Row) -> Row:
        if not row.is_intact():
            raise DamageError(f"{self.path} is damaged: estimate {row.key.id} has changed since it was written")
        return row

    def statuses(self) -> Iterator[tuple[Key, str]]:
        """Status of every stored estimate, of few compared with its checksum."""
        if self.is_large:
            yield from ((key, status) for key, status, _ in self.stock())
            return
        for row in self.rows():
            yield row.key, row.content["status"]

    def stock(self) -> Iterator[tuple[Key, str, int]]:
        """Every stored estimate with its status and the run that it comes from, its numbers not taken apart.

        What is told of is all that was written; whether each is as it was written is asked when it is read.
        """
        if self._format < CHECKED:
            for row in self.rows():
                yield row.key, row.content["status"], row.session
            return
        tally = Tally()
        chosen = f"SELECT {KEY}, json_extract(result, '$.status'), session, checksum FROM estimates"
        with self._guard():
            found = self._connection.execute(chosen)
            while some := found.fetchmany(ROWS):
                tally.add_all("".join([row[-1] for row in some]))
                for row in some:
                    yield Key(*row[:4]), row[4], row[5]
        self._require(tally)

    def require_complete(self) -> Tally:
        """Refuse a file that lacks some of what was written; what has changed is noticed where it is read."""
        tally = Tally()
        for (checksums,) in self._rows("SELECT group_concat(checksum, '') FROM estimates GROUP BY data_hash"):
            with self._guard():
                tally.add_all(checksums)
        self._require(tally)
        return tally

    def require_all(self) -> Tally:
        """The same, and of few estimates also one in which any has changed."""
        if self._format < CHECKED or not self.is_large:
            for _ in self.rows():
                pass
        return self.require_complete()

    def origins_of(self, made: Iterable[tuple[str, int]]) -> tuple[Origin, ...]:
        """The origins that estimators and numbers of origins mean."""
        known = self.known_origins()
        with self._guard():
            return gathered((estimator, known[origin]) for estimator, origin in made)


@contextmanager
def read_journal(path: Path, *, live: bool = False) -> Iterator[JournalReader | None]:
    """Open a journal for reading without touching its files, ``live`` while a run writes to it."""
    if not path.exists():
        yield None
        return
    with ExitStack() as stack:
        try:
            address = stack.enter_context(_readable(path, live=live))
            connection = sqlite3.connect(address, uri=True, isolation_level=None, timeout=_READER_PATIENCE)
            stack.callback(connection.close)
            # All that is read from here on is of one moment.
            connection.execute("BEGIN")
            planned = connection.execute("SELECT 1 FROM sqlite_master LIMIT 1").fetchone()
            if planned:
                format_of(connection, path)
                planned = connection.execute("SELECT 1 FROM meta WHERE name = 'manifest'").fetchone()
                if not planned and connection.execute("SELECT 1 FROM sessions").fetchone():
                    raise DamageError(f"{path} is damaged: it holds no plan")
            log = JournalReader(connection, path, live=live)
        except (OSError, *ERRORS) as error:
            refuse(path, error)
        yield log if planned else None


@contextmanager
def _readable(path: Path, *, live: bool) -> Iterator[str]:
    """An address at which SQLite reads a journal and changes nothing.

    After a kill, acknowledged estimates stand in the write-ahead log beside the file. SQLite reads it in place if its
    index is there, however stale; else a copy is read. A file that nobody writes to and that has no log needs no locks.
    """
    log, index = (path.with_name(f"{path.name}-{end}") for end in ("wal", "shm"))
    # A log that was only begun holds nothing, and SQLite does not get on with its index.
    empty = not log.exists() or log.stat().st_size <= _LOG_HEADER
    if live or (index.exists() and not empty):
        yield f"{path.resolve().as_uri()}?mode=ro&readonly_shm=1"
    elif empty:
        yield f"{path.resolve().as_uri()}?mode=ro&immutable=1"
    else:
        with TemporaryFolder() as folder:
            copy = folder / path.name
            shutil.copyfile(path, copy)
            shutil.copyfile(log, copy.with_name(log.name))
            yield copy.as_uri()


def refuse(path: Path, error: Exception, *, writing: bool = False) -> NoReturn:
    """Say what keeps a journal from being read or written."""
    name = getattr(error, "sqlite_errorname", "") or ""
    reason = (error.strerror if isinstance(error, OSError) else None) or error
    if writing and name not in ("SQLITE_CORRUPT", "SQLITE_NOTADB"):
        safe = "all that was reported as done is safe in it"
        raise StorageError(f"{path} could not be written ({reason}); {safe}") from error
    if isinstance(error, OSError) or name.removeprefix("SQLITE_").startswith(_HINDRANCES):
        raise StorageError(f"{path} cannot be read ({reason})") from error
    raise DamageError(f"{path} is damaged or not a journal ({error})") from error


def format_of(connection: sqlite3.Connection, path: Path) -> int:
    """Format of a journal; other files, and newer formats, are refused."""
    (application,) = connection.execute("PRAGMA application_id").fetchone()
    (written_by,) = connection.execute("PRAGMA user_version").fetchone()
    if application != APPLICATION:
        raise DamageError(f"{path} is an SQLite file, but not a journal of ctid")
    refuse_newer(path, written_by, FORMAT)
    return int(written_by)


def _shared(key: Key) -> Key:
    """A key whose texts are those of others."""
    return Key(sys.intern(key.data_hash), key.replicate, sys.intern(key.estimator_hash), sys.intern(key.start))


def row_digest(table: str, *values: object) -> str:
    """Checksum of a row."""
    return _text_digest(_ROW_TEXT([table, *values]))


def _text_digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:32]
