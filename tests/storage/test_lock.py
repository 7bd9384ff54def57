"""The lock of a folder where there are no locks."""

from __future__ import annotations

import errno
import fcntl
import os
from pathlib import Path
from typing import NoReturn

import pytest

from ctid_cli.errors import StorageError
from ctid_cli.storage import folder
from ctid_cli.storage.journal import open_journal


def test_a_network_file_system_is_named_with_what_to_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(descriptor: int, operation: int) -> NoReturn:
        raise OSError(errno.EBADF, "Bad file descriptor")

    monkeypatch.setattr(fcntl, "flock", refuse)
    monkeypatch.setattr(folder, "file_system", lambda place: "nfs4")
    advice = r"lies on a file system of type nfs4.*--out a folder on a disk of this"
    with pytest.raises(StorageError, match=advice), folder.lock(tmp_path):
        pass
    monkeypatch.setattr(folder, "file_system", lambda place: "ext4")
    with pytest.raises(StorageError, match=r"cannot be locked \(Bad file descriptor\)$"), folder.lock(tmp_path):
        pass


def test_the_file_system_is_that_of_the_nearest_mount(tmp_path: Path) -> None:
    mounts = tmp_path / "mounts"
    mounts.write_text("a / ext4 rw 0 0\nb /home nfs4 rw 0 0\nc /home/a\\040b tmpfs rw 0 0\n")
    assert [folder.file_system(Path(place), mounts) for place in ("/", "/home/x/y", "/home/a b/c")] == [
        "ext4",
        "nfs4",
        "tmpfs",
    ]
    assert folder.file_system(Path("/"), tmp_path / "none") == ""


def test_a_close_that_is_interrupted_has_closed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    close, closed = os.close, list[int]()

    def interrupted(descriptor: int) -> NoReturn:
        close(descriptor)
        closed.append(descriptor)
        raise InterruptedError(errno.EINTR, "Interrupted system call")

    log = open_journal(tmp_path / "journal.sqlite")
    with monkeypatch.context() as patch:
        patch.setattr(os, "close", interrupted)
        with folder.lock(tmp_path):
            pass
        log.close()
    assert len(closed) == 2
    with folder.lock(tmp_path):
        pass
