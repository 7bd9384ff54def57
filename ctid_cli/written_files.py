"""Atomic writing of files, and allowed names of experiments."""

import itertools
import os
import re
import stat
from collections import deque
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

#: Other file names in the folder of an experiment; nested experiments must not have such a name.
TAKEN = (
    *("journal.sqlite", "journal.sqlite-wal", "journal.sqlite-shm", "journal.sqlite-journal", "runs.h5", "spec.yaml"),
    *("running.json", "figures", "report.html"),
)
#: Pattern of experiment names; parts are folders.
EXPERIMENT = r"(?!.*\.\.)(?=.{1,200}\Z)[A-Za-z0-9][A-Za-z0-9._-]*(?:/[A-Za-z0-9][A-Za-z0-9._-]*)*"
#: Device names on Windows, with any suffix.
_DEVICES = re.compile(r"(con|prn|aux|nul|com[0-9]|lpt[0-9])(\.|$)", re.IGNORECASE)
_SHARD = re.compile(r"\.shard-\d+-of-\d+$")
_TEMPORARY = ".tmp"
_numbers = itertools.count(1)
#: The last files that this process has completely written, and those that it is writing.
written: deque[Path] = deque(maxlen=100)
_unfinished: set[Path] = set()


def write_file(path: Path, data: bytes | memoryview | Iterable[bytes]) -> None:
    """Replace a file atomically: readers, and a crash or a full disk at any moment, find the old or the new content."""
    # Links are kept, and special files such as /dev/stdout are written directly.
    path = Path(os.path.realpath(path))
    before = path.stat().st_mode if path.exists() else None
    if before is not None and not stat.S_ISREG(before):
        _write(path, data)
        return
    temporary = path.with_name(f".{path.name[:40]}-{os.getpid()}-{next(_numbers)}{_TEMPORARY}")
    _unfinished.add(temporary)
    try:
        # Never write to a file of another program.
        temporary.touch(exist_ok=False)
        _write(temporary, data)
        if before is not None:
            temporary.chmod(stat.S_IMODE(before))
        temporary.replace(path)
        written.append(path)
    except BaseException:
        # Other threads write other files.
        _remove(temporary)
        raise
    finally:
        _unfinished.discard(temporary)
    descriptor = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        with suppress(OSError):
            os.close(descriptor)


def remove_unfinished() -> None:
    """Remove the files that this process is writing, before it ends."""
    for path in [*_unfinished]:
        _remove(path)


def _remove(path: Path) -> None:
    with suppress(OSError):
        path.unlink(missing_ok=True)


def _write(path: Path, data: bytes | memoryview | Iterable[bytes]) -> None:
    with path.open("wb") as file:
        for part in [data] if isinstance(data, bytes | memoryview) else data:
            file.write(part)
        file.flush()
        if stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            os.fsync(file.fileno())


def is_leftover(name: str) -> bool:
    """Return whether a file was left behind by a killed process."""
    return name.endswith(_TEMPORARY)


def why_unusable(name: str) -> str | None:
    """Return why a name is not allowed for an experiment, as the end of a sentence; None if it is allowed."""
    for part in name.split("/"):
        low = part.lower()
        if low in TAKEN or is_leftover(low):
            return f"{part!r} is the name of a file or folder that lies beside results"
        if ".aside-" in low:
            return "'.aside-' marks older results that --fresh has moved aside"
        if _SHARD.search(low):
            return f"{part!r} is how the results of a shard are called"
        if _DEVICES.match(part):
            return f"{part!r} is the name of a device on Windows"
        if part.endswith("."):
            return f"{part!r} ends with a dot, which Windows drops"
    return None
