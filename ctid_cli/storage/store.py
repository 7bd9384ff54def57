"""Stored estimates: sealing them, and reading them back as a table, by id, or as counts."""

from __future__ import annotations

import csv
import hashlib
import io
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from functools import cached_property
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ctid_cli.errors import StorageError, UsageError
from ctid_cli.storage import columns, journal
from ctid_cli.storage import folder as place
from ctid_cli.storage.folder import SEALED, TIMINGS, InUseError
from ctid_cli.storage.identity import Origin, are_mixed, gathered
from ctid_cli.storage.manifest import (
    Key,
    Manifest,
    Slot,
    assemble,
    is_of_signal,
    row_columns,
    shard_of,
    slots,
    swept_names,
    true_values,
)
from ctid_cli.storage.provenance import as_text
from ctid_cli.storage.summary import is_converged
from ctid_cli.written_files import write_file

if TYPE_CHECKING:
    import pandas as pd

    from ctid_cli.storage.sealed import SealedRuns


#: Columns of the table of times.
CLOCKS = ("seconds", "cpu_seconds")


@dataclass(frozen=True)
class Stored:
    """The stored estimates of one plan."""

    manifest: Manifest
    origins: tuple[Origin, ...]
    results: Mapping[Key, dict[str, Any]]
    #: Time that each took [s], by key, and processor time.
    seconds: Mapping[Key, float | None]
    cpu_seconds: Mapping[Key, float | None] = field(default_factory=dict)

    @property
    def mixed(self) -> bool:
        """Whether several versions of the code, or platforms, computed what is compared here."""
        return are_mixed(self.origins)

    def slots(self) -> list[Slot]:
        """Places of the stored estimates, in the order of the sealed file."""
        return [slot for slot in slots(self.manifest) if slot.key in self.results]

    def row(self, slot: Slot) -> dict[str, Any]:
        """The estimate row of one place, with ``true_delay`` and ``converged``."""
        times = (self.seconds.get(slot.key), self.cpu_seconds.get(slot.key))
        row = assemble(slot, self.manifest, self.results[slot.key], *times)
        true = self._truths[slot.key.data_hash]
        converged = is_converged(row, self.manifest["success"], true)
        return row | {"converged": converged, "true_delay": true.get("delay")}

    @cached_property
    def _truths(self) -> dict[str, dict[str, float]]:
        """True values by name of every data cell."""
        return {cell["hash"]: true_values(cell) for cell in self.manifest["data_cells"]}

    def rows(self) -> list[dict[str, Any]]:
        """All estimate rows, in the order of the sealed file."""
        return [self.row(slot) for slot in self.slots()]


@dataclass(frozen=True)
class FoundEstimate:
    """One estimate among those of its plan."""

    folder: Path
    stored: Stored
    slot: Slot

    @cached_property
    def row(self) -> dict[str, Any]:
        """Its row."""
        return self.stored.row(self.slot)


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


def seal(folder: Path, log: journal.Journal) -> tuple[int, str]:
    """Write the estimates of the journal's plan to the sealed file, and their times to a table.

    Returns the number of estimates and the checksum of the file.
    """
    from ctid_cli.storage.sealed import seal_image, verify_sealed

    manifest, entries = log.manifest(), log.entries()
    stored = _planned(manifest, entries)
    image, checksum, count = seal_image(manifest, stored.origins, stored.results)
    times = _times_table({key: entries[key] for key in stored.results})
    target, safe = folder / SEALED, f"all {len(entries)} estimates are safe in {log.path}"
    try:
        log.write_beside(TIMINGS, times)
        write_file(target, image)
    except OSError as error:
        log.require_in_place()
        reason = f"{target} could not be written ({error.strerror or error})"
        raise StorageError(f"{reason}; {safe}. Make room and run the same command again") from error
    if verify_sealed(target) != checksum:
        raise StorageError(f"{target} reads back otherwise than it was written; {safe}")
    log.mark_sealed(checksum)
    return count, checksum


def read_stored(folder: Path) -> Stored:
    """The estimates of the latest plan of an experiment."""
    with _reading(folder) as log:
        if log is None:
            return read_sealed_alone(folder)
        if log.sealed() is not None and (folder / SEALED).exists():
            stored, checksum = _read_sealed_beside(folder, log)
            # Another file, however intact, is not what this journal was sealed to.
            if checksum == log.sealed():
                return stored
        return _planned(log.manifest(), log.entries())


@contextmanager
def _reading(folder: Path) -> Iterator[journal.Journal | None]:
    """The journal of an experiment, checked, also during a run; None where there is the sealed file only."""
    with place.reading_journal(folder) as log:
        # There is a journal without a plan where the run was killed before it had planned anything.
        if log is not None:
            log.check()
        elif not (folder / SEALED).exists():
            raise UsageError(f"there are no results in {folder}; 'ctid run' writes them")
        yield log


def _planned(manifest: Manifest, entries: Mapping[Key, journal.Entry]) -> Stored:
    """What a plan asks for, out of all that a journal holds."""
    planned = {slot.key: entries[slot.key] for slot in slots(manifest) if slot.key in entries}
    return Stored(
        manifest,
        gathered((key.estimator_hash, entry.origin) for key, entry in planned.items()),
        {key: entry.result for key, entry in planned.items()},
        {key: entry.seconds for key, entry in planned.items()},
        {key: entry.cpu_seconds for key, entry in planned.items()},
    )


def read_tracks(folder: Path) -> dict[str, dict[str, Any]]:
    """The stored frequencies over time of an experiment on a signal."""
    from ctid_cli.simulation.frequency_measures import unpack_track
    from ctid_cli.storage.sealed import read_sealed_tracks

    stored = read_stored(folder)
    packed = {key.id: result["track"] for key, result in stored.results.items() if result.get("track") is not None}
    if packed:
        return {name: unpack_track(track) for name, track in packed.items()}
    return read_sealed_tracks(folder / SEALED) if (folder / SEALED).exists() else {}


def read_sealed_alone(folder: Path) -> Stored:
    """The estimates in the sealed file, whatever else there is."""
    from ctid_cli.storage.sealed import read_sealed

    return _with_times(read_sealed(folder / SEALED), _times_of(folder))


def _read_sealed_beside(folder: Path, log: journal.Journal) -> tuple[Stored, str]:
    """The sealed file of a journal, with its times if they are what was written, and its checksum."""
    from ctid_cli.storage.sealed import read_sealed

    try:
        runs = read_sealed(folder / SEALED)
    except StorageError as error:
        advice = f"{journal.FILE_NAME} holds all estimates: 'ctid run' with the same specification seals them again"
        raise StorageError(f"{error}; {advice}") from error
    times, noted = _times_of(folder), log.files().get(TIMINGS)
    if noted is not None and hashlib.sha256(times).hexdigest() not in noted:
        entries = log.entries()
        times = _times_table({key: entries[key] for key in runs.results})
    return _with_times(runs, times), runs.checksum


def _times_of(folder: Path) -> bytes:
    # Times are extra: results without them, copied from elsewhere, are complete.
    try:
        return (folder / TIMINGS).read_bytes()
    except OSError:
        return b""


def _with_times(runs: SealedRuns, table: bytes) -> Stored:
    times = _read_times(table)
    columns_of_times = ({key: times.get((key.id, name)) for key in runs.results} for name in CLOCKS)
    return Stored(runs.manifest, runs.origins, runs.results, *columns_of_times)


def _times_table(entries: Mapping[Key, journal.Entry]) -> bytes:
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(("id", *CLOCKS, "session"))
    for key, entry in entries.items():
        table.writerow((key.id, entry.seconds, entry.cpu_seconds, entry.session))
    return text.getvalue().encode()


def _read_times(table: bytes) -> dict[tuple[str, str], float]:
    try:
        rows = list(csv.DictReader(io.StringIO(table.decode())))
        return {(row["id"], name): float(row[name]) for row in rows for name in CLOCKS if row.get(name)}
    except (ValueError, KeyError, csv.Error):
        return {}


def load_estimates(folder: Path) -> pd.DataFrame:
    """Estimates of the latest plan of an experiment as a table."""
    return estimates_table(read_stored(folder))


def estimates_table(stored: Stored) -> pd.DataFrame:
    """Stored estimates as a table, with the units of its columns."""
    import pandas as pd

    rows = stored.rows()
    # Where there is no system, the columns of one would be empty.
    left_out = "systems" if is_of_signal(stored.manifest) else ""
    own = {column.name: column.dtype for column in row_columns(stored.manifest) if column.of != left_out}
    compared = {c.name: c.dtype for c in columns.COLUMNS if c.source == "truth" and c.of != left_out}
    types = own | dict.fromkeys(swept_names(stored.manifest)) | compared
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
        for slot in stored.slots():
            if slot.key.id.startswith(prefix) and slot.key.id not in matches:
                matches[slot.key.id] = FoundEstimate(folder, stored, slot)
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
            if log is not None:
                statuses, manifest = log.statuses(), log.manifest()
                left_aside = len(statuses.keys() - {slot.key for slot in slots(manifest)})
                running = _running(folder) if log.live else None
                return _status(folder, manifest, statuses, left_aside, are_mixed(log.origins()), running)
    except InUseError:
        # A run that is just beginning has nothing to read yet.
        running = _running(folder)
        name = str(running.get("experiment") or folder.name)
        return ExperimentStatus(0, 0, 0, name, folder, None, False, running, ())
    stored = read_sealed_alone(folder)
    statuses = {key: str(result["status"]) for key, result in stored.results.items()}
    return _status(folder, stored.manifest, statuses, None, stored.mixed, None)


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
    statuses: Mapping[Key, str],
    left_aside: int | None,
    mixed: bool,
    running: dict[str, Any] | None,
) -> ExperimentStatus:
    groups = []
    for _, members in groupby(slots(manifest), lambda slot: (id(slot.estimator), slot.key.data_hash)):
        wanted = list(members)
        found = [statuses[slot.key] for slot in wanted if slot.key in statuses]
        failed = sum(status in columns.FAILURES for status in found)
        slot = wanted[0]
        counts = (len(wanted), len(found), failed)
        groups.append(GroupStatus(*counts, slot.estimator["name"], slot.key.data_hash, slot.swept))
    counts = tuple(sum(getattr(group, name) for group in groups) for name in ("planned", "done", "failed"))
    name, found_groups, part = manifest["experiment"], tuple(groups), shard_of(manifest)
    shard = None if part is None else (part.number, part.of)
    return ExperimentStatus(*counts, name, folder, left_aside, mixed, running, found_groups, shard)
