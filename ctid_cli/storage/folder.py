"""Folder of one experiment: its files, its lock, and when writing is refused.

The files are ``spec.yaml`` (the user's text), ``journal.sqlite`` (the live log) and ``runs.h5`` (the estimates of the
latest plan).
"""

import fcntl
import os
import re
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path

from ctid_cli.errors import DamageError, RefusedError, StorageError
from ctid_cli.storage.identity import Origin, origin_differences
from ctid_cli.storage.journal import JournalReader, read_journal
from ctid_cli.storage.manifest import Manifest
from ctid_cli.storage.sqlite_file import EXPORT, FILE_NAME, SPEC, who_runs
from ctid_cli.written_files import TAKEN, is_leftover

#: Time to wait for a reading command to release the folder [s].
PATIENCE = 2.0
_ASIDE = re.compile(r"\.aside-\d{8}T\d{6}(-\d+)?$")
ELSEWHERE = (
    "choose another results folder (--out), or --fresh to move the old results aside, with --keep-readable to take "
    "over what can be read"
)


class InUseError(RefusedError):
    """Another process holds the folder's lock."""


@contextmanager
def lock(folder: Path, *, shared: bool = False, patience: float = PATIENCE) -> Iterator[None]:
    """Hold the folder's lock; the operating system releases it when the process ends for any reason."""
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError as error:
        raise StorageError(f"{folder} cannot be opened: {error.strerror}") from error
    try:
        deadline = time.monotonic() + patience
        while True:
            try:
                fcntl.flock(descriptor, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
                if not _is_open(folder, descriptor):
                    raise InUseError(f"{folder} was moved by another process just now; run the command again")
                break
            except BlockingIOError:
                _wait(folder, deadline)
            except OSError as error:
                advice = (
                    "on a file system of a network give --out a folder on a disk of this machine, and copy the results"
                )
                raise StorageError(f"{folder} cannot be locked ({error.strerror}); {advice}") from error
        if not shared:
            _refuse_links(folder)
        yield
    finally:
        # Errors on closing are ignored: nothing was written to the lock file.
        with suppress(OSError):
            os.close(descriptor)


def _refuse_links(folder: Path) -> None:
    """Refuse to write through links to other places."""
    for path in folder.iterdir():
        if path.is_symlink() and (path.name in TAKEN or is_leftover(path.name)):
            raise RefusedError(f"{path} is a link, and results are written into their folder alone; remove it")


def _is_open(folder: Path, descriptor: int) -> bool:
    try:
        return os.path.samestat(os.stat(folder), os.fstat(descriptor))
    except OSError:
        return False


def clear(folder: Path) -> None:
    """Remove incomplete files of killed runs; this process holds the lock, so no other process is writing."""
    for path in folder.glob(".*"):
        if is_leftover(path.name) and path.name[1:].startswith((SPEC, EXPORT)):
            with suppress(OSError):
                path.unlink()


def _wait(folder: Path, deadline: float) -> None:
    """Wait a moment for the process that holds a folder, unless the deadline has passed."""
    if time.monotonic() > deadline:
        running = who_runs(folder)
        owner = f"process {running['pid']} on {running['host']}" if running else "another process"
        raise InUseError(f"{folder} is in use by {owner}; wait until it ends") from None
    time.sleep(0.05)


def check_free(folder: Path, manifest: Manifest, origin: Origin | None, advice: str = ELSEWHERE) -> None:
    """Refuse a locked folder that must not be extended; without an origin, estimates of any origin are accepted."""
    with with_recovery_advice(folder), read_journal(folder / FILE_NAME) as log:
        if log is None:
            if (folder / EXPORT).exists():
                why = f"{EXPORT} without the {FILE_NAME} it was made from, so nothing can be added to it"
                raise RefusedError(f"{folder} holds {why}; {advice}")
            return
        if log.experiment() != manifest["experiment"]:
            other = f"the experiment {log.experiment()!r}, not {manifest['experiment']!r}"
            raise RefusedError(f"{folder} holds {other}; {advice}")
        cells = {cell["hash"] for cell in manifest["data_cells"]}
        for data, made in sorted(log.made()):
            if origin is not None and data in cells and made != origin:
                differences = origin_differences(made, origin, "then", "now")
                ways = "use --fresh to move them aside and compute all anew, or --allow-mixed to add to them, which is "
                what = f"{folder} holds results of other code or arithmetic ({differences})"
                raise RefusedError(f"{what}; {ways}recorded")


@contextmanager
def reading_journal(folder: Path) -> Iterator[JournalReader | None]:
    """Read the folder's journal, also during a run; if it is damaged, state what is safe."""
    deadline = time.monotonic() + PATIENCE
    with with_recovery_advice(folder), ExitStack() as stack:
        while not (found := _opened(folder, stack)):
            # A run is opening or closing the journal.
            _wait(folder, deadline)
        yield found[0]


def _opened(folder: Path, stack: ExitStack) -> tuple[JournalReader | None] | None:
    """Return the journal, if it exists; None while another process is opening or closing it."""
    with ExitStack() as tried:
        live = False
        try:
            tried.enter_context(lock(folder, shared=True, patience=0.0))
        except InUseError:
            live = True
        try:
            log = tried.enter_context(read_journal(folder / FILE_NAME, live=live))
        except StorageError as error:
            if isinstance(error, DamageError) or not live:
                raise
            return None
        if live and log is None:
            return None
        stack.push(tried.pop_all())
        return (log,)


@contextmanager
def writing(folder: Path) -> Iterator[None]:
    """Add to a write error in a folder that no data are lost."""
    try:
        yield
    except OSError as error:
        what = f"{error.filename or folder} cannot be written ({error.strerror or error})"
        raise StorageError(f"{what}; stored estimates are untouched, and the same command goes on") from error


@contextmanager
def with_recovery_advice(folder: Path) -> Iterator[None]:
    """Add to a report of damage which data are safe."""
    try:
        yield
    except DamageError as error:
        start = "'ctid verify' says what is damaged; 'ctid run --fresh --keep-readable' with the same specification"
        cure = f"{start} moves {folder} aside, keeps the estimates that can be read and computes the rest"
        raise DamageError(f"{error}. {cure}") from error


def move_aside(folder: Path) -> Path | None:
    """Rename a folder without deleting anything."""
    if not folder.exists():
        return None
    inside = [path for path in experiment_folders(folder) if path != folder]
    if inside:
        names = ", ".join(str(path) for path in inside)
        raise RefusedError(f"{folder} cannot be moved aside, because other experiments lie inside it: {names}")
    with lock(folder):
        stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%S")
        target = folder.with_name(f"{folder.name}.aside-{stamp}")
        number = 1
        while target.exists():
            number += 1
            target = folder.with_name(f"{folder.name}.aside-{stamp}-{number}")
        try:
            folder.rename(target)
        except OSError as error:
            raise StorageError(f"{folder} cannot be moved aside: {error.strerror}") from error
    return target


def experiment_folders(results: Path) -> list[Path]:
    """Return the folders of experiments in a results folder, at any depth."""
    found = []
    for path, folders, files in os.walk(results):
        folders[:] = sorted(name for name in folders if not _ASIDE.search(name))
        if FILE_NAME in files or EXPORT in files:
            found.append(Path(path))
    return sorted(found)
