"""``running.json``: who runs in a folder, for those who find it locked, and how many estimates were reported there.

It is removed when a run ends. What a killed run leaves tells how many estimates the journal holds at least: SQLite
drops the end of a damaged write-ahead log without a word.
"""

import json
import os
import platform
from contextlib import suppress
from pathlib import Path
from typing import Any

RUNNING = "running.json"


def announce(folder: Path, experiment: str, started: str, done: int, total: int, stored: int = 0) -> None:
    """Say who runs, how many data sets of how many are done, and how many estimates the journal holds."""
    running = {"experiment": experiment, "pid": os.getpid(), "host": platform.node()}
    running |= {"started": started, "done": done, "total": total, "stored": stored}
    # A courtesy to readers, written over and over: neither worth a synchronisation nor worth failing for.
    with suppress(OSError):
        temporary = folder / f"{RUNNING}.tmp"
        temporary.write_text(json.dumps(running), encoding="utf-8")
        temporary.replace(folder / RUNNING)


def retract(folder: Path) -> None:
    """Take back what was announced, unless another process announced it."""
    running = who_runs(folder)
    if running is not None and (running["pid"], running["host"]) == (os.getpid(), platform.node()):
        with suppress(OSError):
            (folder / RUNNING).unlink(missing_ok=True)


def who_runs(folder: Path) -> dict[str, Any] | None:
    """Return what the run that writes to a folder says about itself."""
    try:
        running = json.loads((folder / RUNNING).read_text(encoding="utf-8"))
        return running if isinstance(running, dict) and {"pid", "host"} <= running.keys() else None
    except (OSError, ValueError):
        return None


def reported(folder: Path) -> int:
    """Return how many estimates were reported as stored by a run that has not ended; 0 where nothing says so."""
    stored = (who_runs(folder) or {}).get("stored")
    return stored if isinstance(stored, int) else 0
