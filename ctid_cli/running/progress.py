"""How far a job is: a file that its worker writes and the run reads, so that nothing is lost with the worker.

What is written survives the process that wrote it, however that ended, and a stopped process cannot hold up its reader.
"""

from __future__ import annotations

import os
import pickle
import struct
from pathlib import Path
from typing import Any

_LENGTH = struct.Struct("<Q")


class ProgressWriter:
    """Makes the file of a job, which must not be there yet, and appends entries to it."""

    def __init__(self, path: str) -> None:
        self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND | os.O_CLOEXEC, 0o600)

    def write(self, entry: Any) -> None:
        """Add an entry."""
        data = pickle.dumps(entry, pickle.HIGHEST_PROTOCOL)
        data = _LENGTH.pack(len(data)) + data
        while data:
            data = data[os.write(self._descriptor, data) :]

    def close(self) -> None:
        """Close the file."""
        os.close(self._descriptor)


class ProgressReader:
    """Reads what is new in the file of a job, entry by entry."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._read = 0
        self._rest = b""

    def news(self) -> list[Any]:
        """Entries that came since the last call."""
        try:
            with self.path.open("rb") as file:
                file.seek(self._read)
                data = file.read()
        except FileNotFoundError:
            return []
        self._read += len(data)
        # A worker may have been stopped, or have died, in the midst of an entry.
        self._rest += data
        entries = []
        while len(self._rest) >= _LENGTH.size:
            end = _LENGTH.size + _LENGTH.unpack_from(self._rest)[0]
            if len(self._rest) < end:
                break
            entries.append(pickle.loads(self._rest[_LENGTH.size : end]))
            self._rest = self._rest[end:]
        return entries
