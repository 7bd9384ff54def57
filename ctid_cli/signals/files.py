"""Checks of untrusted files: ordinary files only, of bounded size, in allowed folders."""

import hashlib
import os
import stat
from pathlib import Path

from ctid_cli.errors import DataError

#: Maximum size of a data file [bytes]; ten million samples with all digits need less.
MAX_FILE_BYTES = 2_000_000_000
#: Maximum number of values of an array in a file, whatever its header declares.
MAX_VALUES = 100_000_000
#: Maximum number of characters from a file, and of names, in a message.
MAX_LETTERS, MAX_NAMES = 24, 20

#: Paths of transferred copies of files, by the SHA-256 of their content.
COPIES: dict[str, str] = {}


def require_file(path: str | os.PathLike[str], empty: str = " the file is empty") -> str:
    """Refuse anything but an ordinary file before it is opened: reading a pipe or a device may never end.

    System files on processes and devices report size zero, so they are refused as empty.
    """
    file = os.fspath(path)
    try:
        found = os.stat(path)
    except (OSError, ValueError) as error:  # a name with a zero byte is a ValueError
        reason = error.strerror if isinstance(error, PermissionError) else "does not exist"
        raise DataError(f"{file}: {reason}; relative names start at {Path.cwd()}") from None
    if not stat.S_ISREG(found.st_mode):
        kind = "a folder" if stat.S_ISDIR(found.st_mode) else "a pipe, a socket or a device"
        raise DataError(f"{file}: is not a file but {kind}; relative names start at {Path.cwd()}")
    if found.st_size == 0:
        raise DataError(f"{file}:{empty}")
    if found.st_size > MAX_FILE_BYTES:
        size = f"{found.st_size} bytes are too many; at most {MAX_FILE_BYTES} are read"
        raise DataError(f"{file}: {size}; cut the record, or save every second sample")
    return file


def require_values(what: str, count: int) -> None:
    """Refuse an array whose header declares more memory than any record needs."""
    if count > MAX_VALUES:
        raise DataError(f"{what} claims to hold {count} values; at most {MAX_VALUES} are read")


def is_inside(path: str | os.PathLike[str], folder: Path) -> bool:
    """Return whether a file lies in a folder or below it, after following links."""
    try:
        return Path(path).resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError, ValueError):  # circular links, a zero byte
        return False


def quoted(text: str) -> str:
    """Return text from a file in a form for messages: short, on one line."""
    return repr(text) if len(text) <= MAX_LETTERS else f"a text of {len(text)} characters"


def file_sha256(path: str) -> str:
    """Return the content hash of a file."""
    if not Path(path).exists():
        raise DataError(f"{path}: there is no such file; paths are relative to the folder of the specification")
    require_file(path)
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise DataError(f"{path}: the file cannot be read: {error.strerror or error}") from None
