"""The lock of a folder on file systems without locks."""

from __future__ import annotations

import errno
import fcntl
import os
from pathlib import Path
from typing import NoReturn

import pytest

from ctid_cli.errors import StorageError
from ctid_cli.storage import folder


def test_a_file_system_without_locks_is_refused_with_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(descriptor: int, operation: int) -> NoReturn:
        raise OSError(errno.EBADF, "Bad file descriptor")

    monkeypatch.setattr(fcntl, "flock", refuse)
    advice = r"cannot be locked \(Bad file descriptor\); on a file system of a network give --out a folder on a disk"
    with pytest.raises(StorageError, match=advice), folder.lock(tmp_path):
        pass


def test_a_close_that_is_interrupted_has_closed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    close, closed = os.close, list[int]()

    def interrupted(descriptor: int) -> NoReturn:
        close(descriptor)
        closed.append(descriptor)
        raise InterruptedError(errno.EINTR, "Interrupted system call")

    with monkeypatch.context() as patch:
        patch.setattr(os, "close", interrupted)
        with folder.lock(tmp_path):
            pass
    assert len(closed) == 1
    with folder.lock(tmp_path):
        pass
