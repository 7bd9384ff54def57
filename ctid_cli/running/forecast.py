"""What a large run will take, told before it begins."""

from __future__ import annotations

from dataclasses import dataclass

from ctid_cli.running.events import PlanReady
from ctid_cli.storage.folder import reading_journal

#: A run of more estimates than these is asked about first.
LARGE = 100_000
#: What an estimate takes on disk: in the journal, the sealed file and the table of times.
BYTES = 1300.0


@dataclass(frozen=True)
class Forecast:
    """How long a run will take, from what was stored so far, and how much disk."""

    estimates: int
    bytes: float
    #: With so many processes; None where nothing is known of these estimates.
    seconds: float | None
    #: Estimates that this is known from.
    known_from: int


def forecast(ready: PlanReady, jobs: int, *, fresh: bool = False) -> Forecast:
    """What the estimates that are still to be computed will take."""
    count, mean = 0, None
    if ready.folder.exists() and not fresh:
        with reading_journal(ready.folder) as log:
            if log is not None:
                count, mean = log.count(), log.mean_seconds()
    seconds = None if mean is None else ready.estimates * mean / jobs
    return Forecast(ready.estimates, ready.estimates * BYTES, seconds, count)
