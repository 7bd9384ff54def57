"""Stored estimates: sealing them, and reading them back as a table, by id, or as counts."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ctid_cli.errors import StorageError, UsageError
from ctid_cli.storage import journal
from ctid_cli.storage.folder import (
    SEALED,
    TIMINGS,
    InUseError,
    experiment_folders,
    lock,
    no_results,
    reading_journal,
    require_experiment,
    who_runs,
    write_safely,
)
from ctid_cli.storage.manifest import (
    FAILURES,
    Key,
    Manifest,
    Slot,
    assemble,
    is_additive,
    is_of_signal,
    slots,
    swept_names,
    true_delay,
    true_parameters,
)
from ctid_cli.storage.summary import is_converged
from ctid_cli.storage.version import Origin

if TYPE_CHECKING:
    import pandas as pd

_TEXT_COLUMNS = ("id", "experiment", "estimator", "kind", "cell", "start", "status", "message")
_FLOAT_COLUMNS = (
    "start_delay",
    "delay",
    "cost",
    "fit_percent",
    "validation_fit_percent",
    "condition_number",
    "seconds",
    "true_delay",
)
_COLUMNS = (
    *("id", "experiment", "estimator", "kind", "cell", "replicate", "start", "initial_delay", "start_delay", "status"),
    *("message", "delay", "numerator", "denominator", "parameters", "standard_errors", "cost", "fit_percent"),
    *("validation_fit_percent", "iterations", "condition_number", "seconds"),
)


#: Columns of an experiment on a signal.
_SIGNAL_COLUMNS = (
    *("id", "experiment", "estimator", "kind", "cell", "replicate", "status", "message", "measures", "seconds"),
)


@dataclass(frozen=True)
class Stored:
    """The stored estimates of one plan."""

    manifest: Manifest
    origins: tuple[Origin, ...]
    results: Mapping[Key, dict[str, Any]]
    #: Time that each took [s], by key.
    seconds: Mapping[Key, float | None]

    def slots(self) -> list[Slot]:
        """Places of the stored estimates, in the order of the sealed file."""
        return [slot for slot in slots(self.manifest) if slot.key in self.results]

    def row(self, slot: Slot) -> dict[str, Any]:
        """The estimate row of one place, with ``true_delay`` and ``converged``."""
        row = assemble(slot, self.manifest, self.results[slot.key], self.seconds.get(slot.key))
        delay, parameters = self._truths[slot.key.data_hash]
        converged = is_converged(row, self.manifest["success"], delay, parameters)
        return row | {"converged": converged, "true_delay": delay}

    @cached_property
    def _truths(self) -> dict[str, tuple[float | None, dict[str, float] | None]]:
        """True delay [s] and true parameters of every data cell."""
        return {cell["hash"]: (true_delay(cell), true_parameters(cell)) for cell in self.manifest["data_cells"]}

    def rows(self) -> list[dict[str, Any]]:
        """All estimate rows, in the order of the sealed file."""
        return [self.row(slot) for slot in self.slots()]


@dataclass(frozen=True)
class FoundEstimate:
    """One estimate in full."""

    folder: Path
    row: dict[str, Any]
    data: dict[str, Any]
    estimator: dict[str, Any]
    seed: int | None
    origins: tuple[Origin, ...]


@dataclass(frozen=True)
class GroupStatus:
    """Progress of one estimator on one data cell."""

    estimator: str
    cell: str
    swept: dict[str, Any]
    planned: int
    done: int
    todo: int
    failed: int


@dataclass(frozen=True)
class ExperimentStatus:
    """Progress of an experiment."""

    experiment: str
    folder: Path
    planned: int
    done: int
    todo: int
    failed: int
    left_aside: int | None
    mixed: bool
    running: dict[str, Any] | None
    groups: tuple[GroupStatus, ...]


def seal(folder: Path, log: journal.Journal) -> tuple[int, str]:
    """Write the estimates of the journal's plan to the sealed file, and their times to a table.

    Returns the number of estimates and the checksum of the file.
    """
    from ctid_cli.storage.sealed import seal_image, verify_sealed

    manifest, entries, origins = log.manifest(), log.entries(), log.origins()
    planned = list(dict.fromkeys(slot.key for slot in slots(manifest) if slot.key in entries))
    used = {entries[key].origin for key in planned}
    results = {key: entries[key].result for key in planned}
    image, checksum, count = seal_image(manifest, [origins[number] for number in sorted(used)], results)
    times = io.StringIO()
    table = csv.writer(times, lineterminator="\n")
    table.writerow(("id", "seconds", "session"))
    table.writerows((key.id, entries[key].seconds, entries[key].session) for key in planned)
    target = folder / SEALED
    try:
        write_safely(folder / TIMINGS, times.getvalue().encode())
        write_safely(target, image)
    except OSError as error:
        reason = error.strerror or error
        raise StorageError(
            f"{target} could not be written ({reason}); all {len(entries)} estimates are safe in {log.path}."
            " Make room and run the same command again"
        ) from error
    if verify_sealed(target) != checksum:
        raise StorageError(f"{target} reads back otherwise than it was written; all estimates are safe in {log.path}")
    log.mark_sealed(checksum)
    return count, checksum


def read_stored(folder: Path) -> Stored:
    """The estimates of the latest plan of an experiment."""
    require_experiment(folder)
    try:
        with lock(folder, shared=True, patience=0.2), reading_journal(folder) as log:
            if log is not None and (log.sealed() is None or not (folder / SEALED).exists()):
                entries, origins = log.entries(), log.origins()
                manifest = log.manifest()
                used = {entries[slot.key].origin for slot in slots(manifest) if slot.key in entries}
                return Stored(
                    manifest,
                    tuple(origins[number] for number in sorted(used)),
                    {key: entry.result for key, entry in entries.items()},
                    {key: entry.seconds for key, entry in entries.items()},
                )
    except InUseError:
        if not (folder / SEALED).exists():
            raise
    if not (folder / SEALED).exists():
        # The run was killed before it had planned anything.
        raise no_results(folder)
    return _read_sealed(folder)


def read_tracks(folder: Path) -> dict[str, dict[str, Any]]:
    """The stored frequencies over time of an experiment on a signal."""
    from ctid_cli.simulation.frequency_measures import unpack_track
    from ctid_cli.storage.sealed import read_sealed_tracks

    stored = read_stored(folder)
    packed = {key.id: result["track"] for key, result in stored.results.items() if result.get("track") is not None}
    if packed:
        return {name: unpack_track(track) for name, track in packed.items()}
    return read_sealed_tracks(folder / SEALED) if (folder / SEALED).exists() else {}


def _read_sealed(folder: Path) -> Stored:
    from ctid_cli.storage.sealed import read_sealed

    try:
        runs = read_sealed(folder / SEALED)
    except StorageError as error:
        if (folder / journal.FILE_NAME).exists():
            advice = f"{journal.FILE_NAME} holds all estimates: 'ctid run' with the same specification seals them again"
            raise StorageError(f"{error}; {advice}") from error
        raise
    times = _read_times(folder / TIMINGS)
    return Stored(runs.manifest, runs.origins, runs.results, {key: times.get(key.id) for key in runs.results})


def _read_times(path: Path) -> dict[str, float]:
    # Times are extra: results without them, copied from elsewhere, are complete.
    try:
        with path.open(encoding="utf-8", newline="") as file:
            return {row["id"]: float(row["seconds"]) for row in csv.DictReader(file) if row.get("seconds")}
    except (OSError, ValueError, KeyError):
        return {}


def load_estimates(folder: Path) -> pd.DataFrame:
    """Estimates of the latest plan of an experiment as a table."""
    import pandas as pd

    stored = read_stored(folder)
    rows = stored.rows()
    frame = pd.DataFrame(index=pd.RangeIndex(len(rows)))
    own = [name for name in _COLUMNS if name != "parameters" or is_additive(stored.manifest)]
    last = ["converged", "true_delay"]
    if is_of_signal(stored.manifest):
        own, last = list(_SIGNAL_COLUMNS), ["converged"]
    for name in (*own, *swept_names(stored.manifest), *last):
        frame[name] = _column(name, [row.get(name) for row in rows])
    frame.attrs["mixed"] = len(stored.origins) > 1
    return frame


def _column(name: str, values: list[Any]) -> pd.Series[Any]:
    import pandas as pd

    if name == "converged":
        return pd.Series(values, dtype="boolean")
    if name == "replicate":
        return pd.Series(values, dtype="int64")
    if name == "iterations":
        return pd.Series(values, dtype="Int64")
    if name in _FLOAT_COLUMNS:
        return pd.Series(values, dtype="float64")
    if name in _TEXT_COLUMNS:
        return pd.Series(values, dtype="str")
    if name in _COLUMNS or name == "measures":
        return pd.Series(values, dtype="object")
    return pd.Series(values)


def find_estimate(results: Path, prefix: str) -> FoundEstimate:
    """Find one estimate among all experiments."""
    matches: dict[str, FoundEstimate] = {}
    in_use = ""
    for folder in experiment_folders(results):
        try:
            stored = read_stored(folder)
        except InUseError as error:
            in_use = f"; it may come later: {error}"
            continue
        for slot in stored.slots():
            if slot.key.id.startswith(prefix) and slot.key.id not in matches:
                matches[slot.key.id] = FoundEstimate(
                    folder,
                    stored.row(slot),
                    dict(slot.cell["content"]),
                    dict(slot.estimator["content"]),
                    stored.manifest["seed"],
                    stored.origins,
                )
    if not matches:
        raise UsageError(
            f"no estimate in {results} has an id that begins with {prefix!r}{in_use}; 'ctid export' lists all ids"
        )
    if len(matches) > 1:
        some = ", ".join(sorted(matches)[:5])
        raise UsageError(f"{len(matches)} estimates have an id that begins with {prefix!r}: {some}…; give more of it")
    return next(iter(matches.values()))


def spec_folder(folder: Path) -> Path | None:
    """Folder of the specification that an experiment was last run with."""
    with lock(folder, shared=True), reading_journal(folder) as log:
        sessions = [] if log is None else log.sessions()
    return Path(sessions[-1]["spec_folder"]) if sessions else None


def experiment_status(folder: Path) -> ExperimentStatus:
    """Count what is done and what is missing."""
    require_experiment(folder)
    left_aside: int | None = None
    running: dict[str, Any] | None = None
    try:
        with lock(folder, shared=True, patience=0.2), reading_journal(folder) as log:
            if log is not None:
                statuses, manifest = log.statuses(), log.manifest()
                planned = {slot.key for slot in slots(manifest)}
                left_aside = len(statuses.keys() - planned)
                return _status(folder, manifest, statuses, left_aside, len(log.origins()) > 1, None)
    except InUseError:
        running = who_runs(folder) or {"pid": None, "host": None}
        if not (folder / SEALED).exists():
            name = str(running.get("experiment") or folder.name)
            return ExperimentStatus(name, folder, 0, 0, 0, 0, None, False, running, ())
    if not (folder / SEALED).exists():
        raise no_results(folder)
    stored = _read_sealed(folder)
    statuses = {key: str(result["status"]) for key, result in stored.results.items()}
    return _status(folder, stored.manifest, statuses, left_aside, len(stored.origins) > 1, running)


def _status(
    folder: Path,
    manifest: Manifest,
    statuses: Mapping[Key, str],
    left_aside: int | None,
    mixed: bool,
    running: dict[str, Any] | None,
) -> ExperimentStatus:
    counts: dict[tuple[str, str, str], list[int]] = {}
    swept: dict[tuple[str, str, str], dict[str, Any]] = {}
    for slot in slots(manifest):
        group = (slot.estimator["name"], slot.key.estimator_hash, slot.key.data_hash)
        swept.setdefault(group, {**slot.cell["swept"], **slot.estimator["swept"]})
        count = counts.setdefault(group, [0, 0, 0])
        status = statuses.get(slot.key)
        count[0] += 1
        count[1] += status is not None
        count[2] += status in FAILURES
    groups = tuple(
        GroupStatus(name, cell, swept[name, estimator, cell], planned, done, planned - done, failed)
        for (name, estimator, cell), (planned, done, failed) in counts.items()
    )
    planned, done = sum(group.planned for group in groups), sum(group.done for group in groups)
    failed = sum(group.failed for group in groups)
    return ExperimentStatus(
        manifest["experiment"], folder, planned, done, planned - done, failed, left_aside, mixed, running, groups
    )
