"""Merging: what several folders hold of one experiment, as if one run had computed it.

The folders that are merged are only read. Rows go over with their times, and the runs that computed them with all that
is known of these. The sealed file comes from the rows alone, so that it has the bytes of a single run's.
"""

import json
import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from itertools import islice
from math import inf
from pathlib import Path
from typing import Any, Self

from ctid_cli.canonical import canonical_json
from ctid_cli.errors import RefusedError, StorageError, UsageError
from ctid_cli.storage import folder as place
from ctid_cli.storage.identity import Origin, are_mixed
from ctid_cli.storage.journal import Journal, open_journal
from ctid_cli.storage.journal_reader import FILE_NAME, JournalReader, Row
from ctid_cli.storage.manifest import Key, Manifest, Outcome, shard_of, slots, whole
from ctid_cli.storage.pieces import ROWS
from ctid_cli.storage.shards import Shard, owner, ranges
from ctid_cli.storage.store import seal

#: What a session is called, apart from what is known of it.
_OF_SESSION = ("session", "started", "stopped", "reason")
#: Statuses of estimates that exceeded a limit, and the limits, of which the first counts first.
LIMITED = ("TIMEOUT", "MEMORY")
LIMITS = ("wall_seconds", "cpu_seconds", "memory_mb")
_SHARD = re.compile(r"\.shard-\d+-of-\d+$")


@dataclass(frozen=True, eq=False)
class Source:
    """What one folder holds."""

    folder: Path
    manifest: Manifest
    entries: Mapping[Key, Row]
    sessions: Sequence[Mapping[str, Any]]
    #: Where the entries come from, by the number that they have.
    origins: Mapping[int, Origin]

    @classmethod
    def of(cls, folder: Path, log: JournalReader, plan: Manifest) -> Self:
        """What a journal holds of a plan."""
        planned, entries = {slot.key for slot in slots(whole(plan))}, log.entries()
        chosen = {key: entries[key] for key in entries if key in planned}
        return cls(folder, plan, chosen, log.sessions(), log.known_origins())

    def origin_of(self, entry: Row) -> Origin:
        """Where an entry comes from."""
        return self.origins[entry.origin]

    @property
    def shard(self) -> Shard | None:
        """Which shard it is."""
        return shard_of(self.manifest)


@dataclass(frozen=True)
class Merged:
    """What a merge has made."""

    experiment: str
    folder: Path
    sources: int
    planned: int
    stored: int
    #: Estimates that were not in the folder before, or exceeded a limit there.
    new: int
    mixed: bool
    checksum: str
    #: What is not there, in words.
    missing: tuple[str, ...]


def find_sources(paths: Iterable[Path]) -> list[Path]:
    """The folders that are meant: of experiments as they are given, of all shards below others."""
    found: dict[Path, Path] = {}
    for path in paths:
        if (path / FILE_NAME).exists():
            inside = [path]
        else:
            inside = [folder for folder in place.experiment_folders(path) if _SHARD.search(folder.name)]
        if not inside:
            raise UsageError(f"there are no results of shards in {path}; 'ctid run --shard 1/3' writes the first of 3")
        found |= {folder.resolve(): folder for folder in inside}
    return list(found.values())


@contextmanager
def _reading(folder: Path) -> Iterator[JournalReader]:
    with place.lock(folder, shared=True), place.reading_journal(folder) as log:
        if log is None:
            raise UsageError(f"there is no {FILE_NAME} with results in {folder}, which a merge reads")
        yield log


def read_source(folder: Path) -> Source:
    """What a folder holds of its latest plan, each row compared with its checksum."""
    with _reading(folder) as log:
        log.check()
        return Source.of(folder, log, log.manifest())


def merge_all(
    folders: Iterable[Path], out: Path, *, allow_mixed: bool = False, partial: bool = False
) -> Iterator[Merged]:
    """Merge folders, those of each experiment into the one of its name."""
    experiments: dict[str, list[Path]] = defaultdict(list)
    for folder in folders:
        with _reading(folder) as log:
            experiments[log.experiment()].append(folder)
    for name, places in experiments.items():
        yield merge(map(read_source, places), out / name, allow_mixed=allow_mixed, partial=partial)


def merge(sources: Iterable[Source], target: Path, *, allow_mixed: bool = False, partial: bool = False) -> Merged:
    """Merge folders of one experiment into another one, which may hold some of its estimates already."""
    # In the same order whatever the order they are named in.
    read = sorted(sources, key=lambda source: (source.shard or Shard(0, 0), str(source.folder)))
    read = [source for source in read if not (target.exists() and source.folder.samefile(target))]
    if not read:
        raise UsageError(f"there is nothing to merge into {target} but itself")
    plan = _common_plan(read)
    present = _present(target, plan, read, allow_mixed=allow_mixed)
    if not allow_mixed:
        _check_origins([*present, *read])
    new = _new_entries(present, read)
    planned = {slot.key for slot in slots(plan)}
    known = {key for source in present for key in source.entries}
    missing = tuple(_missing(plan, read, planned - known - new.keys()))
    if missing and not partial:
        raise RefusedError(f"{plan['experiment']}: {'; '.join(missing)}. --partial merges what there is")
    with _writing(target):
        target.mkdir(parents=True, exist_ok=True)
    with place.lock(target), closing(open_journal(target / FILE_NAME)) as log:
        if known != planned & log.keys():
            raise place.InUseError(f"{target} was changed by another process just now; run the command again")
        with _writing(target):
            for name in (place.SPEC, place.CANONICAL):
                log.write_beside(name, (read[0].folder / name).read_bytes())
        log.replan(plan)
        for source in read:
            _take_over(source, {key: entry for key, (own, entry) in new.items() if own is source}, plan, log)
        count, checksum = seal(target, log)
        mixed = are_mixed(log.origins())
    return Merged(plan["experiment"], target, len(read), len(planned), count, len(new), mixed, checksum, missing)


def _common_plan(read: Sequence[Source]) -> Manifest:
    """The plan that all folders are of."""
    first = read[0]
    plan = whole(first.manifest)
    for source in read[1:]:
        other = whole(source.manifest)
        if other != plan:
            ours, theirs = first.manifest["spec"], source.manifest["spec"]
            sections = [name for name in ours | theirs if ours.get(name) != theirs.get(name)]
            where = f" ({', '.join(sections)} differ)" if sections else ""
            raise RefusedError(
                f"{first.folder} and {source.folder} are of different specifications{where}; run their shards again "
                "with the same specification and options, which computes only what is new"
            )
    return plan


def _present(target: Path, plan: Manifest, read: Sequence[Source], *, allow_mixed: bool) -> list[Source]:
    """What the folder that is merged into holds of the plan."""
    if not target.exists():
        return []
    origins = {key.estimator_hash: source.origin_of(entry) for source in read for key, entry in source.entries.items()}
    with place.lock(target, shared=True):
        if origins:
            place.check_free(target, plan, origins, allow_mixed=allow_mixed)
        with place.reading_journal(target) as log:
            return [] if log is None else [Source.of(target, log, plan)]


def _check_origins(sources: Sequence[Source]) -> None:
    """Refuse what other code or another processor has computed than the rest."""
    seen: dict[str, tuple[Origin, Path]] = {}
    for source in sources:
        made = {(key.estimator_hash, source.origin_of(entry)) for key, entry in source.entries.items()}
        for estimator, origin in sorted(made):
            # All share what makes their data; those of one estimator share what makes the estimates too.
            other, folder = seen.get(estimator) or next(iter(seen.values()), (origin, source.folder))
            if other.shared != origin.shared or (estimator in seen and other != origin):
                pairs = place.origin_differences(other, origin)
                differences = "; ".join(f"{name} {left} and {right}" for name, left, right in pairs)
                raise RefusedError(
                    f"{folder} and {source.folder} were computed by other code or arithmetic ({differences}); run one "
                    "of them with --fresh where the other was run, or merge with --allow-mixed, which tables will say"
                )
            seen.setdefault(estimator, (origin, source.folder))


def _new_entries(present: Sequence[Source], read: Sequence[Source]) -> dict[Key, tuple[Source, Row]]:
    """What is to be stored, and where it comes from."""
    found: dict[Key, tuple[Source, Row]] = {}
    for source in (*present, *read):
        for key, entry in source.entries.items():
            other, stored = found.setdefault(key, (source, entry))
            if stored.result == entry.result or stored.content == entry.content:
                continue
            if any(one.content["status"] in LIMITED for one in (stored, entry)):
                found[key] = max(found[key], (source, entry), key=_rank)
            else:
                raise RefusedError(
                    f"estimate {key.id} is one thing in {other.folder} and another in {source.folder}; 'ctid show "
                    f"{key.id}' prints each, and --fresh computes one of the folders anew"
                )
    ours = set(map(id, present))
    return {key: value for key, value in found.items() if id(value[0]) not in ours}


def _rank(found: tuple[Source, Row]) -> tuple[bool, list[float], str]:
    """Which of two is better, where one exceeded a limit: a result, or else what had the higher limits."""
    source, entry = found
    session = next((one for one in source.sessions if one["session"] == entry.session), {})
    limits = session.get("limits") or {}
    allowed = [inf if (limit := limits.get(name)) is None else float(limit) for name in LIMITS]
    return entry.content["status"] not in LIMITED, allowed, canonical_json(entry.content)


def _missing(plan: Manifest, read: Sequence[Source], keys: set[Key]) -> Iterator[str]:
    """What is not there, by shard where all folders are of the same dealing."""
    dealt = {source.shard.of for source in read if source.shard is not None}
    if not keys:
        return
    if len(dealt) != 1 or any(source.shard is None for source in read):
        yield f"{len(keys)} estimates are missing"
        return
    (of,) = dealt
    cells = [cell["hash"] for cell in plan["data_cells"]]
    places = {cell: number for number, cell in enumerate(cells)}
    lacking = Counter(owner(places[key.data_hash], key.replicate, len(cells), of) for key in keys)
    given = {source.shard.number for source in read if source.shard is not None}
    if absent := lacking.keys() - given:
        number = sum(lacking[shard] for shard in absent)
        what = "is not among the folders" if len(absent) == 1 else "are not among the folders"
        yield f"{_shards(absent, of)} {what} ({number} estimates)"
    if unfinished := lacking.keys() & given:
        number, one = sum(lacking[shard] for shard in unfinished), len(unfinished) == 1
        again = f"{'lacks' if one else 'lack'} {number} estimates, which the same 'ctid run' again computes"
        yield f"{_shards(unfinished, of)} {again}"


def _shards(numbers: Iterable[int], of: int) -> str:
    """Some shards in words, with numbers as a job array takes them."""
    text = ranges(numbers)
    return f"{'shard' if text.isdigit() else 'shards'} {text} of {of}"


def _take_over(source: Source, entries: Mapping[Key, Row], plan: Manifest, log: Journal) -> None:
    """Store estimates of a folder, run by run, with what is known of the runs that computed them."""
    for run in source.sessions:
        own = {key: entry for key, entry in entries.items() if entry.session == run["session"]}
        if own:
            info = {name: value for name, value in run.items() if name not in _OF_SESSION}
            origins = {key.estimator_hash: source.origin_of(e) for key, e in own.items()}
            number = log.begin(plan, origins, run["started"], info)
            outcomes = (Outcome(key, e.content, e.seconds, e.cpu_seconds) for key, e in own.items())
            while some := list(islice(outcomes, ROWS)):
                log.add(some, number)
            if run["stopped"] is not None:
                log.end(number, run["stopped"], run["reason"])
            with _writing(log.path.parent):
                _copy_provenance(source.folder, run["session"], log, number)


def _copy_provenance(source: Path, session: int, log: Journal, number: int) -> None:
    """Keep what is known of a run, under its new number."""
    (log.path.parent / place.PROVENANCE).mkdir(exist_ok=True)
    # One that was killed has left nothing but its line in the journal.
    for file in (source / place.PROVENANCE).glob(f"{session:04d}-*.json"):
        try:
            content = json.loads(file.read_text(encoding="utf-8")) | {"session": number}
        except (ValueError, TypeError) as error:
            raise StorageError(f"{file} cannot be read or is damaged ({error})") from error
        name = f"{number:04d}-{file.name.partition('-')[2]}"
        text = json.dumps(content, indent=2, ensure_ascii=False)
        log.write_beside(f"{place.PROVENANCE}/{name}", f"{text}\n".encode())


@contextmanager
def _writing(target: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise StorageError(
            f"{error.filename or target}: {error.strerror or error}; the same merge again goes on"
        ) from error
