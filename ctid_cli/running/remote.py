"""What a worker of dask does: prove that it is of the same code and arithmetic, then compute jobs.

A job is computed by a process of loky below the worker, as on one machine: the same limits are watched, a death is put
down to the same estimate, and the worker itself survives it.
"""

from __future__ import annotations

import dataclasses
import hashlib
import multiprocessing
import pickle
import platform
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ctid_cli.running.executor import Done, Lost, Message
from ctid_cli.running.limits import Limits
from ctid_cli.running.pool import LokyPool
from ctid_cli.storage.identity import Origin, origin_of
from ctid_cli.temporary import TemporaryFolder

#: How often a worker looks whether its job is still wanted, and tells what is finished of it [s].
TICK, TELL = 0.1, 1.0

_of_thread = threading.local()
#: Files that were sent along, by the hash of their content.
_files: dict[str, Path] = {}
_folder: TemporaryFolder | None = None


def files_of(source: Any) -> dict[str, str]:
    """Files that data sets are made from: hash of the content to path."""
    found: dict[str, str] = {}
    if dataclasses.is_dataclass(source):
        if getattr(source, "file", None) and getattr(source, "sha256", None):
            found[str(source.sha256)] = str(source.file)  # type: ignore[union-attr, unused-ignore]
        for part in dataclasses.fields(source):
            found |= files_of(getattr(source, part.name))
    return found


def identify(packed: bytes, contents: Mapping[str, bytes]) -> tuple[str, Origin]:
    """Name of this machine, and where estimates would come from here; keeps files for the jobs that follow."""
    global _folder
    _, parts = pickle.loads(packed)
    for sha256, content in contents.items():
        if sha256 not in _files:
            _folder = _folder or TemporaryFolder()
            _files[sha256] = _folder.path / sha256
            _files[sha256].write_bytes(content)
    return platform.node(), origin_of(*parts)


def compute_here(packed: bytes, limits: Limits, alone: bool, topic: str) -> None:
    """Compute a job, and tell the run what becomes of it.

    That goes by events, at once: results of tasks stay with their worker until they are asked for, and die with it.
    """
    _, job = pickle.loads(packed)
    source = _located(job.cell.source)
    if source is not job.cell.source:
        job = dataclasses.replace(job, cell=dataclasses.replace(job.cell, source=source))
    # Python forbids children to daemons, which could not end them; those of ours end with their parent by themselves.
    multiprocessing.current_process()._config["daemon"] = False  # type: ignore[attr-defined]
    # Workers with several threads have one process below each.
    pools: dict[Limits, LokyPool] = _of_thread.__dict__.setdefault("pools", {})
    pool = pools.get(limits) or pools.setdefault(limits, LokyPool(1, limits))
    pool.submit(job, alone=alone)
    messages: list[Message] = []
    over, when = False, time.monotonic()
    while not over:
        messages += pool.collect(TICK)
        if _is_abandoned():
            pool.stop()
            return
        over = any(isinstance(message, Done | Lost) for message in messages)
        if over or (messages and time.monotonic() - when >= TELL):
            _tell(topic, messages)
            messages, when = [], time.monotonic()


def _tell(topic: str, messages: list[Message]) -> None:
    """Tell the run what has happened in the present task; the messages do not name the job."""
    from distributed import get_worker

    worker, nameless = get_worker(), [dataclasses.replace(message, job=None) for message in messages]  # type: ignore[arg-type]
    worker.log_event(topic, {"task": worker.get_current_task(), "messages": pickle.dumps(nameless)})


def _located(source: Any) -> Any:
    """A source whose files are read from where they are on this machine."""
    if not dataclasses.is_dataclass(source) or isinstance(source, type):
        return source
    changes: dict[str, Any] = {}
    for part in dataclasses.fields(source):
        value = getattr(source, part.name)
        found = _located(value)
        if found is not value:
            changes[part.name] = found
    sha256 = getattr(source, "sha256", None)
    if sha256 in _files and not _holds(Path(source.file), str(sha256)):  # type: ignore[attr-defined]
        changes["file"] = str(_files[str(sha256)])
    return dataclasses.replace(source, **changes) if changes else source


def _holds(path: Path, sha256: str) -> bool:
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest() == sha256
    except OSError:
        return False


def _is_abandoned() -> bool:
    """Whether nobody waits for the present task any more: the run was stopped, or its process is gone."""
    from distributed import get_worker

    worker = get_worker()
    task = worker.state.tasks.get(worker.get_current_task())
    return task is None or task.state not in ("executing", "long-running")
