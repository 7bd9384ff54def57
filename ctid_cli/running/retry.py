"""Which stored failures are computed once more."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from ctid_cli.running.limits import Limits
from ctid_cli.storage.journal import Journal
from ctid_cli.storage.manifest import Key


@dataclass(frozen=True)
class Stock:
    """The estimates that a journal holds."""

    keys: frozenset[Key] = frozenset()
    #: Failures among them that are to be computed once more.
    again: frozenset[Key] = frozenset()

    @property
    def kept(self) -> frozenset[Key]:
        """Those that stay as they are."""
        return self.keys - self.again


def take_stock(log: Journal, retry: Collection[str], limits: Limits) -> Stock:
    """What a journal holds, where failures of some statuses are unwanted, and those that a limit no longer explains."""
    failures, again = log.failures(), set()
    if failures:
        before = {session["session"]: Limits.of(session) for session in log.sessions()}
        again = {
            key for key, status, session in failures if status in retry or limits.rose_since(before[session], status)
        }
    return Stock(frozenset(log.keys()), frozenset(again))
