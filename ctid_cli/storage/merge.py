"""Merging shards into one set of results, and recovering readable rows of damaged results.

Source folders are not changed. Rows are copied with their times, and with all data of the runs that computed them, in
one transaction: if there is any conflict, nothing is written. The export depends on the rows only, so it has the bytes
of a single run's export.
"""

import re
import shutil
from collections import defaultdict
from collections.abc import Container, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from math import inf
from pathlib import Path

from ctid_cli.errors import CtidError, RefusedError, UsageError
from ctid_cli.progress import each
from ctid_cli.storage import folder as folders
from ctid_cli.storage.estimates import Estimates
from ctid_cli.storage.export import open_export, write_runs
from ctid_cli.storage.identity import Origin, now, origin_differences
from ctid_cli.storage.journal import Journal, JournalReader, Row, Session, new_id, open_journal, read_journal
from ctid_cli.storage.manifest import Key, Manifest, Outcome, Shard, owner, shard_of, slots, whole
from ctid_cli.storage.sqlite_file import EXPORT, FILE_NAME, SPEC

#: Statuses of estimates that exceeded a limit, and the limits in order of precedence.
LIMITED = ("TIMEOUT", "MEMORY")
LIMITS = ("wall_seconds", "cpu_seconds", "memory_mb")
#: Maximum number of estimates named in an error message.
NAMED = 5
_SHARD = re.compile(r"\.shard-\d+-of-\d+$")


@dataclass(frozen=True)
class Merged:
    """Result of a merge."""

    experiment: str
    folder: Path
    sources: int
    planned: int
    stored: int
    #: Number of estimates that are new in the folder, or exceeded a limit there.
    new: int
    mixed: bool
    checksum: str
    #: Description of what is missing; empty if complete.
    missing: str


def find_sources(paths: Iterable[Path]) -> list[Path]:
    """Return the folders to merge: given folders of experiments, and all shards below other folders."""
    found: dict[Path, Path] = {}
    for path in paths:
        if (path / FILE_NAME).exists():
            inside = [path]
        else:
            inside = [folder for folder in folders.experiment_folders(path) if _SHARD.search(folder.name)]
        if not inside:
            raise UsageError(f"there are no results of shards in {path}; 'ctid run --shard 1/3' writes the first of 3")
        found |= {folder.resolve(): folder for folder in inside}
    return list(found.values())


def merge_all(
    sources: Iterable[Path], out: Path, *, allow_mixed: bool = False, partial: bool = False
) -> Iterator[Merged]:
    """Merge the folders of each experiment into the folder of its name."""
    experiments: dict[str, list[Path]] = defaultdict(list)
    for folder in sources:
        experiments[_plan_of(folder)["experiment"]].append(folder)
    for name, places in experiments.items():
        yield merge(places, out / name, allow_mixed=allow_mixed, partial=partial)


def merge(sources: Iterable[Path], target: Path, *, allow_mixed: bool = False, partial: bool = False) -> Merged:
    """Merge folders of one experiment into a target, which may already hold some of the estimates."""
    others = [folder for folder in sources if not (target.exists() and folder.samefile(target))]
    if not others:
        raise UsageError(f"there is nothing to merge into {target} but itself")
    plans = {folder: _plan_of(folder) for folder in others}
    # A fixed order, independent of the order on the command line.
    others.sort(key=lambda folder: (shard_of(plans[folder]) or Shard(0, 0), str(folder)))
    plan = _common_plan([(folder, plans[folder]) for folder in others])
    keys = dict.fromkeys(slot.key for slot in slots(plan))
    with _new_folder(target), folders.lock(target):
        folders.check_free(target, plan, None, "merge into another folder (--out)")
        with folders.with_recovery_advice(target):
            log = open_journal(target / FILE_NAME)
        with closing(log):
            taken = _Taken(target, log, plan, keys, allow_mixed=allow_mixed)
            with log.transaction():
                for folder in each("folder", others):
                    with _reading(folder) as other:
                        other.check()
                        log.add_rows(taken.new_rows(folder, other))
                taken.require_no_conflict()
                there = {row.key for row in log.rows()}
                lacking = [key for key in keys if key not in there]
                missing = _missing(plan, [shard_of(plans[folder]) for folder in others], lacking)
                if missing and not partial:
                    raise RefusedError(f"{plan['experiment']}: {missing}. --partial merges what there is")
                log.note_plan(plan)
            with folders.writing(target):
                log.write_spec((others[0] / SPEC).read_bytes())
            count, checksum = write_runs(target, log)
            mixed = len(log.origins()) > 1
    new = len(taken.changed)
    return Merged(plan["experiment"], target, len(others), len(keys), count, new, mixed, checksum, missing)


@contextmanager
def _reading(folder: Path) -> Iterator[JournalReader]:
    with folders.lock(folder, shared=True), folders.reading_journal(folder) as log:
        if log is None:
            raise UsageError(f"there is no {FILE_NAME} with results in {folder}, which a merge reads")
        yield log


def _plan_of(folder: Path) -> Manifest:
    with _reading(folder) as log:
        return log.manifest()


def _common_plan(plans: Sequence[tuple[Path, Manifest]]) -> Manifest:
    """Return the common plan of all folders."""
    first, plan = plans[0][0], whole(plans[0][1])
    for folder, found in plans[1:]:
        other = whole(found)
        if other != plan:
            ours, theirs = plan["spec"], other["spec"]
            sections = [name for name in ours | theirs if ours.get(name) != theirs.get(name)]
            where = f" ({', '.join(sections)} differ)" if sections else ""
            raise RefusedError(
                f"{first} and {folder} are of different specifications{where}; run their shards again "
                "with the same specification and options, which computes only what is new"
            )
    return plan


@contextmanager
def _new_folder(target: Path) -> Iterator[None]:
    """Create a folder; if the enclosed code fails, remove it again unless it existed before."""
    made = not target.exists()
    try:
        with folders.writing(target):
            target.mkdir(parents=True, exist_ok=True)
        yield
    except BaseException:
        if made:
            shutil.rmtree(target, ignore_errors=True)
        raise


class _Taken:
    """Rows and runs copied from several folders into a journal in one transaction."""

    def __init__(
        self, target: Path, log: Journal, plan: Manifest, planned: Container[Key], *, allow_mixed: bool
    ) -> None:
        self._log, self._planned, self._allow_mixed = log, planned, allow_mixed
        #: Folder and data of each run of the journal, by id.
        self._places = {session.id: (target, session) for session in log.sessions()}
        cells = {cell["hash"] for cell in plan["data_cells"]}
        self._origins = {origin: target for data, origin in log.made() if data in cells}
        self._conflicts: list[tuple[Key, Path, Path]] = []
        #: Estimates that are new, or exceeded a limit before.
        self.changed: set[Key] = set()

    def new_rows(self, folder: Path, other: JournalReader) -> Iterator[Row]:
        """Yield the rows of a folder to store, and record their runs."""
        sessions = {session.id: session for session in other.sessions()}
        for row in other.rows():
            if row.key not in self._planned:
                continue
            session, present = sessions[row.session], self._log.row(row.key)
            self._require_origin(folder, session.origin)
            if present is None or self._is_better(row, session, present, folder):
                if row.session not in self._places:
                    self._places[self._log.note_session(session)] = (folder, session)
                self.changed.add(row.key)
                yield row

    def _require_origin(self, folder: Path, origin: Origin) -> None:
        """Refuse results of another code version or processor than the rest."""
        if self._allow_mixed or origin in self._origins or not self._origins:
            self._origins.setdefault(origin, folder)
            return
        other, where = next(iter(self._origins.items()))
        differences = origin_differences(other, origin, "there", "here")
        raise RefusedError(
            f"{where} and {folder} were computed by other code or arithmetic ({differences}); run one of "
            "them with --fresh where the other was run, or merge with --allow-mixed, which tables note"
        )

    def _is_better(self, row: Row, session: Session, present: Row, folder: Path) -> bool:
        """Return whether a row replaces the present one, which exceeded a limit; record conflicts."""
        if row.result == present.result:
            return False
        where, of_present = self._places[present.session]
        if row.status in LIMITED or present.status in LIMITED:
            return _rank(row, session) > _rank(present, of_present)
        self._conflicts.append((row.key, where, folder))
        return False

    def require_no_conflict(self) -> None:
        """Refuse conflicts, naming the estimates that differ."""
        if self._conflicts:
            key, one, other = self._conflicts[0]
            count = len(self._conflicts)
            others = ", ".join(key.id for key, _, _ in self._conflicts[1:NAMED])
            more = f"; {count - 1} more differ too: {others}{', …' if count > NAMED else ''}" if others else ""
            raise RefusedError(
                f"estimate {key.id} differs between {one} and {other}; 'ctid export --id {key.id}' prints "
                f"each, and --fresh computes one of the folders anew{more}"
            )


def _rank(row: Row, session: Session) -> tuple[bool, list[float], str]:
    """Return the rank of a row of an estimate that exceeded a limit: a result first, then higher limits."""
    limits = session.info.get("limits") or {}
    allowed = [inf if (limit := limits.get(name)) is None else float(limit) for name in LIMITS]
    return row.status not in LIMITED, allowed, row.result


def _missing(plan: Manifest, shards: Sequence[Shard | None], keys: Sequence[Key]) -> str:
    """Describe what is missing, by shard if all folders have the same number of shards; empty if complete."""
    dealings = {0 if shard is None else shard.of for shard in shards}
    if not keys or len(dealings) > 1 or 0 in dealings:
        return f"{len(keys)} estimates are missing" if keys else ""
    (of,) = dealings
    cells = [cell["hash"] for cell in plan["data_cells"]]
    places = {cell: number for number, cell in enumerate(cells)}
    lacking = {owner(places[key.data_hash], key.replicate, len(cells), of) for key in keys}
    again = "give their folders too, or the same 'ctid run' of them again"
    return f"{len(keys)} estimates of {shards_text(lacking, of)} are missing: {again}"


def shards_text(numbers: Iterable[int], of: int) -> str:
    """Return shards as text, with numbers in the form of job arrays: ``shards 1-3,7 of 9``."""
    runs: list[list[int]] = []
    for number in sorted(numbers):
        if runs and runs[-1][-1] == number - 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    text = ",".join(f"{run[0]}-{run[-1]}" if len(run) > 1 else str(run[0]) for run in runs)
    return f"{'shard' if text.isdigit() else 'shards'} {text} of {of}"


# --- recovery of readable results from a damaged folder that was moved aside ------------------------------------------


@dataclass(frozen=True)
class Kept:
    """Result of recovering a folder that was moved aside."""

    planned: int
    #: Number of estimates from its journal, and from ``runs.h5``.
    from_journal: int
    from_export: int

    def __str__(self) -> str:
        text = f"{self.from_journal + self.from_export} of {self.planned} estimates could be read and are kept"
        return f"{text}, {self.from_export} of them from {EXPORT}" if self.from_export else text


def keep_readable(aside: Path, log: Journal, plan: Manifest, origin: Origin, *, allow_mixed: bool = False) -> Kept:
    """Copy all readable estimates of a folder that was moved aside into a new journal.

    Each row comes from the old journal if SQLite can read it and its checksum is right, otherwise from ``runs.h5`` if
    that file is intact. Results of other code or arithmetic are left out unless mixing is allowed.
    """
    keys = dict.fromkeys(slot.key for slot in slots(plan))
    kept, noted = set[Key](), set[str]()

    def chosen(found: Iterator[tuple[Row, Session]]) -> Iterator[Row]:
        for row, session in found:
            if row.key in keys and row.key not in kept and (allow_mixed or session.origin == origin):
                if session.id not in noted:
                    noted.add(log.note_session(session))
                kept.add(row.key)
                yield row

    with log.transaction():
        log.note_plan(plan)
        log.add_rows(chosen(_readable(aside, keys)))
        from_journal = len(kept)
        if from_journal < len(keys):
            log.add_rows(chosen(_exported(aside)))
    return Kept(len(keys), from_journal, len(kept) - from_journal)


def _readable(aside: Path, keys: Iterable[Key]) -> Iterator[tuple[Row, Session]]:
    """Yield the readable rows of a journal, each with its run."""
    with suppress(CtidError), read_journal(aside / FILE_NAME) as old:
        for key in keys if old is not None else ():
            # A damaged page must not stop the other rows from being read.
            with suppress(CtidError, ValueError):
                assert old is not None
                if (row := old.row(key)) is not None:
                    yield row, old.session(row.session)


def _exported(aside: Path) -> Iterator[tuple[Row, Session]]:
    """Yield the estimates of ``runs.h5`` if it is intact and of a single origin (origins of rows are not stored)."""
    with suppress(CtidError):
        export = open_export(aside / EXPORT)
        export.verify()
        if len(export.origins) == 1:
            session = Session(new_id(), export.origins[0], now(), None, None, {"kept_from": str(aside / EXPORT)})
            for key, result in Estimates(export).by_key():
                yield Row.of(Outcome(key, result, None), session.id), session
