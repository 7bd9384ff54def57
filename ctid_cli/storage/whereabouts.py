"""Whether files are still where they were opened: a run that goes on in a folder that is gone must not say "stored"."""

import os
from contextlib import suppress
from pathlib import Path

from ctid_cli.errors import StorageError


class Whereabouts:
    """Files of one folder, as they lay when this was made."""

    def __init__(self, *files: Path) -> None:
        self._folder = files[0].parent
        self._found = {path: _identity(path) for path in (self._folder, *files) if path.exists()}
        self._descriptor = os.open(self._folder, os.O_RDONLY)

    def check(self) -> None:
        """Refuse to go on if a path leads elsewhere by now."""
        for path, found in self._found.items():
            if _identity(path) != found:
                raise StorageError(self._lost(path))

    def close(self) -> None:
        """Let go of the folder."""
        with suppress(OSError):
            os.close(self._descriptor)

    def _lost(self, path: Path) -> str:
        advice = "Nothing that was computed since is counted as stored. Bring it back to go on, or run anew"
        now = None
        with suppress(OSError):
            # Linux knows the present name of an open folder.
            now = os.readlink(f"/proc/self/fd/{self._descriptor}")
        if path != self._folder or now is None or now == str(self._folder.resolve()):
            return f"{path} was deleted or replaced while a run wrote to it. {advice}"
        if now.endswith(" (deleted)"):
            return f"{self._folder} was deleted while a run wrote to it. {advice}"
        return f"{self._folder} was renamed while a run wrote to it; it is {now} now. {advice}"


def _identity(path: Path) -> tuple[int, int] | None:
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_dev, found.st_ino
