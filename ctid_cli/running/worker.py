"""Worker processes: how they are set up, what they do with a job, and how they end with their parent."""

import ctypes
import faulthandler
import os
import pickle
import signal
import sys
import threading
import time
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ctid_cli.running.job import Began, run_job
from ctid_cli.running.limits import Usage, usage
from ctid_cli.running.progress import write_entry

_PR_SET_PDEATHSIG = 1


@dataclass(frozen=True)
class Received:
    """A worker has got a job; what happens now is of the job's making."""

    process: int


@dataclass(frozen=True)
class Mark:
    """What begins, and what the process has used up to then."""

    began: Began
    used: Usage | None


def compute(path: str, packed: bytes) -> None:
    """Compute a job, and write what comes of it to its file; nothing is to be done where that is there already."""
    try:
        Path(path).touch(exist_ok=False)
    except FileExistsError:
        return
    with open(path, "ab") as progress:
        write_entry(progress, Received(os.getpid()))
        # Code of one's own is imported here.
        _, job, limits = pickle.loads(packed)
        for entry in run_job(job, limits):
            write_entry(progress, Mark(entry, usage("self")) if isinstance(entry, Began) else entry)


def call(path: str, packed: bytes) -> Any:
    """What a function answers."""
    _, function, given = pickle.loads(packed)
    return function(*given)


def initialise(parent: int) -> None:
    """Set up a new worker process.

    The parent alone decides what an interrupt means, so the worker ignores it. A worker must not outlive its parent,
    however the parent died: Linux can be asked to see to that, elsewhere a thread looks now and then.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    # What an estimator of one's own prints must not stand between the lines of an answer.
    sys.stdout = sys.stderr
    # Estimators report through their status; warnings of several workers at once would only garble the terminal.
    warnings.simplefilter("ignore")
    faulthandler.disable()
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:
            os._exit(1)
    else:
        threading.Thread(target=_watch, args=(parent,), daemon=True).start()


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(1.0)
    os._exit(1)
