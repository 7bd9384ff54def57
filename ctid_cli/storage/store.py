"""Stored estimates: sealing them, and reading them back as a table, by id, or as counts."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic_core import from_json

from ctid_cli.errors import CtidError, StorageError, UsageError
from ctid_cli.storage import columns
from ctid_cli.storage import folder as place
from ctid_cli.storage.folder import SEALED, TIMINGS, InUseError
from ctid_cli.storage.identity import Origin, are_mixed
from ctid_cli.storage.journal import Journal
from ctid_cli.storage.journal_reader import FILE_NAME, JournalReader
from ctid_cli.storage.manifest import (
    Manifest,
    Slot,
    is_of_signal,
    planned_parts,
    row_columns,
    shard_of,
    shares_estimates,
    swept_names,
)
from ctid_cli.storage.packing import Packed, PackedTable, decoded, keys
from ctid_cli.storage.pieces import Pieces, Window
from ctid_cli.storage.planned import KeySet
from ctid_cli.storage.provenance import as_text
from ctid_cli.storage.stored import Stored, first_with
from ctid_cli.storage.timings import TimedTable, times_table
from ctid_cli.written_files import replace_file

if TYPE_CHECKING:
    import pandas as pd

    from ctid_cli.storage.sealed import OpenSealed

#: A data cell and an estimator by their hashes.
Part = tuple[str, str]


@dataclass(frozen=True)
class FoundEstimate:
    """One estimate among those of its plan."""

    folder: Path
    #: It alone.
    stored: Stored

    @cached_property
    def row(self) -> dict[str, Any]:
        """Its row."""
        return self.stored.every()[0]

    @cached_property
    def slot(self) -> Slot:
        """What it is of."""
        (key,), (block,) = keys(self.stored.table, 0, 1), self.stored.blocks
        return Slot(key, block.cell, block.estimator)


@dataclass(frozen=True)
class Progress:
    """How many estimates are asked for, are stored, and are stored as failures."""

    planned: int
    done: int
    failed: int

    @property
    def todo(self) -> int:
        """Estimates that are still to be computed."""
        return self.planned - self.done


@dataclass(frozen=True)
class GroupStatus(Progress):
    """Progress of one estimator on one data cell."""

    estimator: str
    cell: str
    swept: dict[str, Any]


@dataclass(frozen=True)
class ExperimentStatus(Progress):
    """Progress of an experiment."""

    experiment: str
    folder: Path
    left_aside: int | None
    mixed: bool
    running: dict[str, Any] | None
    groups: tuple[GroupStatus, ...]
    #: Which shard it is, of how many; None for all of an experiment.
    shard: tuple[int, int] | None = None


def seal(folder: Path, log: Journal) -> tuple[int, str]:
    """Write the estimates of the journal's plan to the sealed file, and their times to a table.

    Returns the number of estimates and the checksum of the file.
    """
    from ctid_cli.storage.sealed import verify_sealed, write_sealed

    present = _sealed_before(folder, log)
    if present is not None:
        return present
    target, safe = folder / SEALED, f"all {log.count()} estimates are safe in {log.path}"
    manifest = log.manifest()
    origins, table = _planned(log, folder)
    try:
        log.write_beside(TIMINGS, times_table(table, shared=shares_estimates(manifest)))
        checksum = replace_file(target, lambda path: write_sealed(manifest, origins, table, path))
    except OSError as error:
        log.require_in_place()
        reason = f"{target} could not be written ({error.strerror or error})"
        raise StorageError(f"{reason}; {safe}. Make room and run the same command again") from error
    if verify_sealed(target) != checksum:
        raise StorageError(f"{target} reads back otherwise than it was written; {safe}")
    log.mark_sealed(checksum)
    return table.count, checksum


def _sealed_before(folder: Path, log: JournalReader) -> tuple[int, str] | None:
    """What the journal was sealed to, if it and its times are there as they were written and nothing came after."""
    with suppress(CtidError):
        runs = _sealed_beside(folder, log)
        if runs is not None and runs.has_head and TIMINGS in log.files():
            return runs.table.count, runs.checksum
    return None


def read_stored(folder: Path) -> Stored:
    """The estimates of the latest plan of an experiment."""
    with _reading(folder) as log:
        if log is None:
            return read_sealed_alone(folder)
        if not log.is_large:
            log.check()
        if runs := _sealed_beside(folder, log):
            return _timed(runs, folder)
        log.check()
        return Stored(log.manifest(), *_planned(log))


@contextmanager
def _reading(folder: Path) -> Iterator[JournalReader | None]:
    """The journal of an experiment, checked, also during a run; None where there is the sealed file only."""
    with place.reading_journal(folder) as log:
        # There is a journal without a plan where the run was killed before it had planned anything.
        if log is None and not (folder / SEALED).exists():
            raise UsageError(f"there are no results in {folder}; 'ctid run' writes them")
        yield log


def _planned(log: JournalReader, folder: Path | None = None) -> tuple[tuple[Origin, ...], PackedTable]:
    """What a plan asks for, out of all that a journal holds, every row of which is compared with its checksum."""
    manifest, made = log.manifest(), set()
    log.require_complete()

    def rows() -> Iterator[Packed]:
        for estimator, cell, replicates in planned_parts(manifest):
            for row in log.rows_of(cell["hash"], estimator["hash"], replicates, estimator["starts"]):
                made.add((row.key.estimator_hash, row.origin))
                slot = Slot(row.key, cell, estimator)
                yield Packed(slot, from_json(row.result), row.seconds, row.cpu_seconds, row.session)

    table = PackedTable(manifest, rows(), Pieces(folder))
    return log.origins_of(made), table


def read_tracks(folder: Path) -> dict[str, dict[str, Any]]:
    """The stored frequencies over time of an experiment on a signal."""
    from ctid_cli.simulation.frequency_measures import unpack_track
    from ctid_cli.storage.sealed import read_sealed_tracks

    table = read_stored(folder).table
    if isinstance(table, PackedTable):
        return {name: unpack_track(track) for name, track in table.tracks.items()}
    return read_sealed_tracks(folder / SEALED)


def read_sealed_alone(folder: Path) -> Stored:
    """The estimates in the sealed file, whatever else there is."""
    from ctid_cli.storage.sealed import open_sealed

    return _timed(open_sealed(folder / SEALED), folder)


def _timed(runs: OpenSealed, folder: Path) -> Stored:
    return Stored(runs.manifest, runs.origins, TimedTable(runs.table, folder / TIMINGS))


def _sealed_beside(folder: Path, log: JournalReader) -> OpenSealed | None:
    """The sealed file of a journal, if that was sealed to it, and its times are what was written."""
    from ctid_cli.storage.sealed import open_sealed

    if log.sealed() is None or not (folder / SEALED).exists():
        return None
    try:
        runs = open_sealed(folder / SEALED)
    except StorageError as error:
        advice = f"{FILE_NAME} holds all estimates: 'ctid run' with the same specification seals them again"
        raise StorageError(f"{error}; {advice}") from error
    # Another file, however intact, is not what this journal was sealed to.
    if runs.checksum != log.sealed():
        return None
    noted, digest = log.files().get(TIMINGS), ""
    with suppress(OSError), (folder / TIMINGS).open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return runs if noted is None or digest in noted else None


def load_estimates(folder: Path) -> pd.DataFrame:
    """Estimates of the latest plan of an experiment as a table."""
    return estimates_table(read_stored(folder))


def estimates_table(
    stored: Stored, some: Sequence[Mapping[str, Any]] | None = None, swept: dict[str, Any] | None = None
) -> pd.DataFrame:
    """Stored estimates as a table, with the units of its columns.

    Of some of them, the types of swept fields are given, where not all estimates are there to tell them.
    """
    import pandas as pd

    rows = stored.rows() if some is None else some
    # Where there is no system, the columns of one would be empty.
    left_out = "systems" if is_of_signal(stored.manifest) else ""
    own = {column.name: column.dtype for column in row_columns(stored.manifest) if column.of != left_out}
    compared = {c.name: c.dtype for c in columns.COLUMNS if c.source == "truth" and c.of != left_out}
    types: dict[str, Any] = own | (swept or dict.fromkeys(swept_names(stored.manifest))) | compared
    frame = pd.DataFrame({name: pd.Series([row.get(name) for row in rows], dtype=of) for name, of in types.items()})
    frame.attrs["mixed"] = stored.mixed
    frame.attrs["units"] = {
        column.name: column.unit for column in columns.COLUMNS if column.unit and column.name in types
    }
    return frame


def find_estimate(results: Path, prefix: str) -> FoundEstimate:
    """Find one estimate among all experiments."""
    matches: dict[str, FoundEstimate] = {}
    in_use = ""
    for folder in place.experiment_folders(results):
        try:
            stored = read_stored(folder)
        except InUseError as error:
            in_use = f"; it may come later: {error}"
            continue
        for number in first_with(stored.table, prefix):
            (name,) = decoded(stored.table.read("id", number, number + 1))
            alone = Stored(stored.manifest, stored.origins, Window(stored.table, number, number + 1))
            matches.setdefault(name, FoundEstimate(folder, alone))
    if not matches:
        raise UsageError(f"no id in {results} begins with {prefix!r}{in_use}; 'ctid export' lists all ids")
    if len(matches) > 1:
        some = ", ".join(sorted(matches)[:5])
        raise UsageError(f"{len(matches)} estimates have an id that begins with {prefix!r}: {some}…; give more of it")
    return next(iter(matches.values()))


def spec_folder(folder: Path) -> Path | None:
    """Folder of the specification that an experiment was last run with."""
    with place.reading_journal(folder) as log:
        sessions = [] if log is None else log.sessions()
    return next((Path(entry["spec_folder"]) for entry in reversed(sessions) if "spec_folder" in entry), None)


def experiment_status(folder: Path) -> ExperimentStatus:
    """Count what is done and what is missing."""
    try:
        with _reading(folder) as log:
            if log is None:
                stored = read_sealed_alone(folder)
                return _status(folder, stored.manifest, *_counted(stored), None, stored.mixed, None)
            log.check()
            manifest, running = log.manifest(), _running(folder) if log.live else None
            if runs := _sealed_beside(folder, log):
                sealed = _timed(runs, folder)
                distinct = len(np.unique(sealed.column("id"))) if shares_estimates(manifest) else sealed.table.count
                done, failed, aside = *_counted(sealed), log.count() - distinct
            else:
                done, failed, aside = _counted_in(log, manifest)
            return _status(folder, manifest, done, failed, aside, are_mixed(log.origins()), running)
    except InUseError:
        # A run that is just beginning has nothing to read yet.
        running = _running(folder)
        name = str(running.get("experiment") or folder.name)
        return ExperimentStatus(0, 0, 0, name, folder, None, False, running, ())


def _counted(stored: Stored) -> tuple[Counter[Part], Counter[Part]]:
    """Estimates and failures of every data cell and estimator."""
    done: Counter[Part] = Counter()
    failed: Counter[Part] = Counter()
    for block in stored.blocks:
        part = (block.cell["hash"], block.estimator["hash"])
        done[part] = block.last - block.first
        failed[part] = int(stored.failures(np.arange(block.first, block.last)).sum())
    return done, failed


def _counted_in(log: JournalReader, manifest: Manifest) -> tuple[Counter[Part], Counter[Part], int]:
    """The same in a journal, and how many the plan does not ask for."""
    done: Counter[Part] = Counter()
    failed: Counter[Part] = Counter()
    planned, aside = KeySet.planned(manifest), 0
    for key, status in log.statuses():
        if key not in planned:
            aside += 1
            continue
        done[key.data_hash, key.estimator_hash] += 1
        failed[key.data_hash, key.estimator_hash] += status in columns.FAILURES
    return done, failed, aside


def _running(folder: Path) -> dict[str, Any]:
    """Who runs, how far it is, how fast, and when it will have ended at that speed."""
    running = place.who_runs(folder)
    if running is None:
        return {"pid": None, "host": None}
    about: dict[str, Any] = {"data_sets_per_second": None, "expected_end": None}
    with suppress(KeyError, TypeError, ValueError, OverflowError):
        present = datetime.now(UTC)
        elapsed = (present - datetime.fromisoformat(running["started"])).total_seconds()
        if running["done"] > 0 and elapsed > 0:
            speed = running["done"] / elapsed
            left = timedelta(seconds=(running["total"] - running["done"]) / speed)
            about = {"data_sets_per_second": speed, "expected_end": as_text(present + left)}
    return running | about


def _status(
    folder: Path,
    manifest: Manifest,
    done: Mapping[Part, int],
    failed: Mapping[Part, int],
    left_aside: int | None,
    mixed: bool,
    running: dict[str, Any] | None,
) -> ExperimentStatus:
    groups = []
    for estimator, cell, replicates in planned_parts(manifest):
        part = (cell["hash"], estimator["hash"])
        counts = (len(replicates) * len(estimator["starts"]), done.get(part, 0), failed.get(part, 0))
        groups.append(GroupStatus(*counts, estimator["name"], cell["hash"], {**cell["swept"], **estimator["swept"]}))
    counts = tuple(sum(getattr(group, name) for group in groups) for name in ("planned", "done", "failed"))
    name, found_groups, dealt = manifest["experiment"], tuple(groups), shard_of(manifest)
    shard = None if dealt is None else (dealt.number, dealt.of)
    return ExperimentStatus(*counts, name, folder, left_aside, mixed, running, found_groups, shard)
