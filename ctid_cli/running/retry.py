"""Which stored estimates stay as they are, and which failures are computed once more."""

from __future__ import annotations

from collections.abc import Collection, Container
from dataclasses import dataclass, field

from ctid_cli.running.key_set import KeySet
from ctid_cli.running.limits import Limits
from ctid_cli.storage.columns import FAILURES
from ctid_cli.storage.journal import JournalReader
from ctid_cli.storage.manifest import Key


@dataclass(frozen=True)
class Stock(Container[Key]):
    """The estimates that a journal holds; in it are those that stay as they are."""

    keys: KeySet = field(default_factory=KeySet)
    #: Failures among them, and those of these that are to be computed once more.
    failed: KeySet = field(default_factory=KeySet)
    again: KeySet = field(default_factory=KeySet)

    def __contains__(self, key: object) -> bool:
        return key in self.keys and key not in self.again

    def note(self, key: Key, status: str) -> None:
        """Note that an estimate was stored."""
        self.keys.add(key)
        self.again.discard(key)
        (self.failed.add if status in FAILURES else self.failed.discard)(key)


def take_stock(log: JournalReader, retry: Collection[str], limits: Limits) -> Stock:
    """What a journal holds, where failures of some statuses are unwanted, and those that a limit no longer explains."""
    stock, before = Stock(), {session.id: Limits.of(session.info) for session in log.sessions()}

    for row in log.rows():
        key, status = row.key, row.status
        stock.keys.add(key)
        if status in FAILURES:
            stock.failed.add(key)
            if status in retry or limits.rose_since(before[row.session], status):
                stock.again.add(key)
    return stock
