"""How far a job is: a file that its worker writes and the run reads, so that nothing is lost with the worker.

What is written survives the process that wrote it, however that ended, and a stopped process cannot hold up its reader.
"""

from __future__ import annotations

import pickle
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO


def write_entry(file: BinaryIO, entry: Any) -> None:
    """Append an entry to the file of a job."""
    pickle.dump(entry, file, pickle.HIGHEST_PROTOCOL)
    file.flush()


class ProgressReader:
    """Reads what is new in the file of a job, entry by entry."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._read = 0

    def news(self) -> list[Any]:
        """Entries that came since the last call."""
        entries = []
        # A worker may have been stopped, or have died, in the midst of an entry.
        with suppress(FileNotFoundError, EOFError, pickle.UnpicklingError), self.path.open("rb") as file:
            file.seek(self._read)
            while True:
                entries.append(pickle.load(file))
                self._read = file.tell()
        return entries
