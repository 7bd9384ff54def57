"""Folders for as long as they are needed; the next process that needs one clears those of killed processes."""

import contextlib
import fcntl
import os
import shutil
import tempfile
import time
from pathlib import Path

_PREFIX = "ctid-running-"
#: The file whose lock says that the folder is in use; a folder without it is not ours to clear.
_IN_USE = ".in-use"
#: A folder may be without its lock while it is made [s].
_YOUNG = 60.0


class TemporaryFolder:
    """A folder of this process, removed with everything in it when it is closed or forgotten."""

    def __init__(self) -> None:
        _clear_abandoned()
        self._made = tempfile.TemporaryDirectory(prefix=_PREFIX, ignore_cleanup_errors=True)
        self.path = Path(self._made.name)
        self._lock = (self.path / _IN_USE).open("wb")
        _locked(self._lock.fileno())

    def close(self) -> None:
        """Remove the folder."""
        self._made.cleanup()
        self._lock.close()

    def __enter__(self) -> Path:
        return self.path

    def __exit__(self, *error: object) -> None:
        self.close()


def _locked(descriptor: int) -> bool:
    """Whether the lock is ours now."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def _clear_abandoned() -> None:
    """Remove the folders of processes that ended without doing so."""
    for folder in Path(tempfile.gettempdir()).glob(f"{_PREFIX}*"):
        # What cannot be read or is gone by now belongs to somebody else.
        with contextlib.suppress(OSError), (folder / _IN_USE).open("rb") as mark:
            if time.time() - os.fstat(mark.fileno()).st_mtime > _YOUNG and _locked(mark.fileno()):
                shutil.rmtree(folder, ignore_errors=True)
