"""Saving what can be read of damaged results into a new folder; the old one is only read.

Estimates come from the pages of the journal, each compared with its checksum, whatever else is damaged there, and from
the sealed file if that is intact. What is missing then, `ctid run` computes again.
"""

import hashlib
import json
import sys
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ctid_cli.canonical import canonical_json
from ctid_cli.errors import CtidError, RefusedError, StorageError
from ctid_cli.storage import folder as place
from ctid_cli.storage.carving import Value, carved_records
from ctid_cli.storage.folder import CANONICAL, PROVENANCE, SEALED, SPEC, TIMINGS
from ctid_cli.storage.foreign import read_json, require_manifest
from ctid_cli.storage.identity import Origin
from ctid_cli.storage.journal import open_journal
from ctid_cli.storage.journal_reader import FILE_NAME, Row, read_journal, row_digest
from ctid_cli.storage.manifest import Key, Manifest, Slot, shard_of, slots
from ctid_cli.storage.packing import CLOCKS, keys, results
from ctid_cli.storage.provenance import canonical_text, now
from ctid_cli.storage.store import read_sealed_alone, seal
from ctid_cli.storage.stored import Stored


@dataclass
class Salvage:
    """What can be read of damaged results."""

    manifest: Manifest | None = None
    rows: dict[Key, Row] = field(default_factory=dict)
    origins: dict[int, Origin] = field(default_factory=dict)
    #: Runs by number: when they started and stopped, why, and what they noted.
    sessions: dict[int, list[Any]] = field(default_factory=dict)
    files: dict[str, set[str]] = field(default_factory=dict)

    def missing(self) -> list[Slot]:
        """Places of the latest plan whose estimate is not there."""
        return [] if self.manifest is None else [slot for slot in slots(self.manifest) if slot.key not in self.rows]


@dataclass(frozen=True)
class Repair:
    """What was saved, and where."""

    experiment: str
    folder: Path
    #: The new folder.
    saved_in: Path
    planned: int
    #: Estimates of the latest plan, and others.
    saved: int
    left_aside: int
    #: Estimates that ``ctid run`` will compute again.
    missing: tuple[Slot, ...]


def salvage(folder: Path) -> Salvage:
    """All that is intact in a folder."""
    found = Salvage()
    with suppress(CtidError), read_journal(folder / FILE_NAME) as log:
        # Of several plans among the pages, this is the latest.
        found.manifest = None if log is None else log.manifest()
    if (folder / FILE_NAME).exists():
        for record in carved_records(folder / FILE_NAME):
            _sort(record, found)
    # An estimate whose origin is lost cannot be compared with others.
    found.rows = {key: row for key, row in found.rows.items() if row.origin in found.origins}
    with suppress(CtidError):
        _add_sealed(read_sealed_alone(folder), found)
    return found


def _sort(record: list[Value], found: Salvage) -> None:
    """Put a record of a journal where it belongs, if it is what was written."""
    # An estimate of format 2 has no processor time.
    if len(record) in (9, 10):
        key, (result, checksum, seconds, session, origin, *cpu) = record[:4], record[4:]
        values = (result, checksum, _real(seconds), _real(*cpu or [None]), session, origin)
        row = Row(Key(*key), *values)  # type: ignore[arg-type]
        with suppress(TypeError, ValueError):
            if row.is_intact() and (row.key not in found.rows or found.rows[row.key].session < row.session):
                found.rows[row.key] = row
        return
    for table, width in (("meta", 2), ("origins", 4), ("sessions", 5), ("files", 2)):
        # Before format 4 these rows had no checksum.
        checked = len(record) == width + 1 and record[-1] == row_digest(table, *record[:-1])
        if checked or (len(record) == width and table != "files"):
            with suppress(TypeError, ValueError, KeyError):
                _take(table, record[:width], found)


def _take(table: str, row: list[Any], found: Salvage) -> None:
    match table, row:
        case "meta", ["manifest", text]:
            found.manifest = found.manifest or require_manifest(read_json(text))
        case "origins", [int(number), code, machine, packages]:
            found.origins.setdefault(number, Origin.of(code, machine, json.loads(packages)))
        case "sessions", [int(number), started, stopped, reason, info]:
            if isinstance(json.loads(info), dict) and (number not in found.sessions or stopped):
                found.sessions[number] = [started, stopped, reason, info]
        case "files", [name, sha256]:
            found.files.setdefault(name, set()).add(sha256)


def _real(value: Value) -> float | None:
    # SQLite stores whole numbers of a REAL column as integers.
    return float(value) if isinstance(value, int | float) else None


def _add_sealed(runs: Stored, found: Salvage) -> None:
    """Add what only the sealed file still holds."""
    if found.manifest is None:
        found.manifest = runs.manifest
    elif found.manifest["experiment"] != runs.manifest["experiment"]:
        return
    numbers = {origin: number for number, origin in found.origins.items()}
    by_estimator = {estimator: origin for origin in runs.origins for estimator in origin.estimators}
    table, count = runs.table, runs.table.count
    wall, cpu = ([None if time != time else time for time in table.read(clock).tolist()] for clock in CLOCKS)
    stored = zip(keys(table, 0, count), results(table, 0, count), wall, cpu, strict=True)
    for key, result, seconds, cpu_seconds in stored:
        origin = by_estimator.get(key.estimator_hash) or (runs.origins[0] if len(runs.origins) == 1 else None)
        if key in found.rows or origin is None:
            continue
        if origin not in numbers:
            numbers[origin] = max(numbers.values(), default=0) + 1
            found.origins[numbers[origin]] = origin
        found.rows[key] = Row(key, canonical_json(result), "", seconds, cpu_seconds, 0, numbers[origin])


def repair(folder: Path, results: Path) -> Repair:
    """Save what can be read of an experiment into a results folder."""
    with place.lock(folder, shared=True):
        found = salvage(folder)
        if found.manifest is None or not found.rows:
            lost = "what was planned" if found.manifest is None else "a single estimate"
            raise StorageError(f"nothing of {folder} can be saved: neither {FILE_NAME} nor {SEALED} tells {lost}")
        shard, name = shard_of(found.manifest), found.manifest["experiment"]
        target = results / (shard.folder(name) if shard else name)
        if target.exists():
            raise RefusedError(f"{target} exists; choose another folder with --to")
        try:
            target.mkdir(parents=True)
            with place.lock(target):
                _write(found, found.manifest, folder, target)
        except OSError as error:
            reason = error.strerror or error
            raise StorageError(f"{target} could not be written ({reason}); {folder} is untouched") from error
    planned = {slot.key for slot in slots(found.manifest)}
    saved = len(planned & found.rows.keys())
    counts = (len(planned), saved, len(found.rows) - saved)
    return Repair(found.manifest["experiment"], folder, target, *counts, tuple(found.missing()))


def _write(found: Salvage, manifest: Manifest, folder: Path, target: Path) -> None:
    """The new folder: journal, sealed file, specification and provenance."""
    number = max(found.sessions, default=0) + 1
    latest = {} if number == 1 else json.loads(found.sessions[number - 1][-1])
    info = {name: latest[name] for name in ("spec", "spec_folder") if name in latest}
    info |= {"argv": sys.argv, "repaired_from": str(folder.resolve())}
    sessions = found.sessions | {number: [now(), now(), "repaired", canonical_json(info)]}
    texts = {CANONICAL: canonical_text(manifest["spec"]).encode()}
    if "spec" in latest:
        texts[SPEC] = latest["spec"].encode()
    for name in found.files.keys() - texts.keys() - {TIMINGS}:
        with suppress(OSError):
            data = (folder / name).read_bytes()
            if hashlib.sha256(data).hexdigest() in found.files[name]:
                texts[name] = data
    (target / PROVENANCE).mkdir()
    log = open_journal(target / FILE_NAME)
    try:
        log.restore(manifest, found.origins, sessions, found.rows.values())
        for name, data in texts.items():
            log.write_beside(name, data)
        seal(target, log)
    finally:
        log.close()
