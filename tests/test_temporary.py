"""Folders of a running process: gone with it, or cleared by the next one."""

import os
import signal
import subprocess
import sys
import tempfile

import pytest

from ctid_cli.temporary import TemporaryFolder


@pytest.fixture(autouse=True)
def place(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


def killed(place):
    """A process that had a folder and was killed; its folder, made long ago."""
    code = "from ctid_cli.temporary import TemporaryFolder as T; folder = T(); print(folder.path, flush=True); input()"
    with subprocess.Popen(
        [sys.executable, "-c", code],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "TMPDIR": str(place)},
    ) as process:
        folder = process.stdout.readline().strip()
        os.utime(f"{folder}/.in-use", (0, 0))
        TemporaryFolder().close()
        assert os.path.isdir(folder)  # it is still in use
        process.send_signal(signal.SIGKILL)
    return folder


def test_a_folder_goes_with_its_block(place):
    with TemporaryFolder() as folder:
        (folder / "file").write_text("x")
    assert list(place.iterdir()) == []


def test_what_a_killed_process_left_is_cleared_and_nothing_else(place):
    left = killed(place)
    other = place / "ctid-running-notes"
    other.mkdir()
    (other / "mine").write_text("kept")
    TemporaryFolder().close()
    assert not os.path.exists(left)
    assert (other / "mine").read_text() == "kept"


def test_a_folder_that_is_just_made_is_left_alone(place):
    made = place / "ctid-running-new"
    made.mkdir()
    (made / ".in-use").touch()
    TemporaryFolder().close()
    assert made.exists()
