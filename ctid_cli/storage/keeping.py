"""Keeping what can be read of damaged results: it is copied from the folder that was moved aside into a new journal."""

from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from ctid_cli.errors import CtidError
from ctid_cli.storage.estimates import Estimates
from ctid_cli.storage.export import open_export
from ctid_cli.storage.identity import Origin, now
from ctid_cli.storage.journal import Journal, Row, Session, new_id, read_journal
from ctid_cli.storage.manifest import Key, Manifest, Outcome, slots
from ctid_cli.storage.sqlite_file import EXPORT, FILE_NAME


@dataclass(frozen=True)
class Kept:
    """What was kept of a folder that was moved aside."""

    planned: int
    #: Estimates out of its journal, and out of ``runs.h5``.
    from_journal: int
    from_export: int

    def __str__(self) -> str:
        text = f"{self.from_journal + self.from_export} of {self.planned} estimates could be read and are kept"
        return f"{text}, {self.from_export} of them from {EXPORT}" if self.from_export else text


def keep_readable(aside: Path, log: Journal, plan: Manifest, origin: Origin, *, allow_mixed: bool = False) -> Kept:
    """Copy what can be read of a folder that was moved aside into a new journal.

    Row by row: what SQLite still reads of the old journal and agrees with its checksum; where a row is lost, that of
    ``runs.h5`` if this is whole. Results of other code or arithmetic are left out unless they may be mixed.
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
    """Yield the rows of a journal that can be read, each with its run."""
    with suppress(CtidError), read_journal(aside / FILE_NAME) as old:
        for key in keys if old is not None else ():
            # Whatever a damaged page hides, the other rows are worth reading.
            with suppress(CtidError, ValueError):
                assert old is not None
                if (row := old.row(key)) is not None:
                    yield row, old.session(row.session)


def _exported(aside: Path) -> Iterator[tuple[Row, Session]]:
    """Yield the estimates of ``runs.h5``, if it is whole; of several origins it does not say which an estimate has."""
    with suppress(CtidError):
        export = open_export(aside / EXPORT)
        export.verify()
        if len(export.origins) == 1:
            session = Session(new_id(), export.origins[0], now(), None, None, {"kept_from": str(aside / EXPORT)})
            for key, result in Estimates(export).by_key():
                yield Row.of(Outcome(key, result, None), session.id), session
