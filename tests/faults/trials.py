"""Runs of toy estimators that faults are put into, and what must be true of their folders afterwards."""

from __future__ import annotations

import errno
import json
import multiprocessing
import numbers
import os
import shutil
import signal
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import pandas as pd

from ctid_cli.cli import _common
from ctid_cli.errors import CtidError
from ctid_cli.running import engine, events
from ctid_cli.running.executor import Computed, Done, Message
from ctid_cli.running.job import Job
from ctid_cli.running.origins import current_origins
from ctid_cli.storage.store import experiment_status, load_estimates
from ctid_cli.storage.verify import WRONG, verify
from ctid_cli.temporary import TemporaryFolder
from tests.running.fakes import FakePlan, Toy, outcomes_of

#: Seconds after which a trial counts as one that hangs.
PATIENCE = 60.0
Found = list[tuple[str, str]]
#: Columns that say how long something took.
TIMES = ["seconds", "cpu_seconds"]
#: All that lies in the folder of a finished run.
FILES = {"spec.yaml", "spec.canonical.json", "journal.sqlite", "runs.h5", "timings.csv", "provenance"}


class Inline:
    """An executor that computes in this process: the fault is in what is stored, not in who computes."""

    room = 1

    def __init__(self) -> None:
        self._messages: list[Message] = []

    def submit(self, job: Job, *, alone: bool = False) -> None:
        """Compute a job."""
        self._messages += [Computed(job, outcomes_of(job)), Done(job)]

    def collect(self, seconds: float) -> list[Message]:
        """What came of it."""
        messages, self._messages = self._messages, []
        return messages

    def stop(self) -> None:
        """Nothing is at work."""

    def close(self) -> None:
        """Nothing is kept."""


def plan(runs: int = 2) -> Any:
    """Data sets of two cells with an estimator that fails once."""
    return FakePlan(Toy(), Toy(order=3, mischief="raise", at=1), runs=runs)


def hasten() -> None:
    """Leave out what takes most of the time of a small run and is always the same: the identity of its results."""
    origin = next(iter(current_origins(plan()).values()))
    engine.COMMIT_SECONDS = 0.0
    engine.current_origins = lambda plan: {cell.hash: origin for cell in plan.estimators}  # type: ignore[assignment]


def run(folder: Path, say: Callable[[str], object] = lambda text: None, toys: Any = None, **options: Any) -> Any:
    """Run it; ids are said as they are acknowledged."""

    def report(event: events.Event) -> None:
        if isinstance(event, events.EstimatesDone):
            say(" ".join(str(row["id"]) for row in event.rows))

    options = {"executor": lambda limits: Inline()} | options
    return engine.run_experiment(toys or plan(), folder, on_event=report, warm=lambda: 0.0, **options)


class Reference:
    """What an undisturbed run gives."""

    def __init__(self, folder: Path, toys: Any = None) -> None:
        self.plan = toys or plan()
        run(folder, toys=self.plan)
        self.bytes = (folder / "runs.h5").read_bytes()
        self.frame = load_estimates(folder).set_index("id").drop(columns=TIMES)

    def judge(self, folder: Path, acknowledged: Sequence[str], *, thoroughly: bool = False) -> Found:
        """What is wrong with a folder that a fault was in, before and after the run goes on."""
        wrong = self.read(folder, acknowledged, thoroughly=thoroughly)
        try:
            run(folder, toys=self.plan)
        except Exception:
            return [*wrong, ("traceback", "going on: " + traceback.format_exc())]
        if (folder / "runs.h5").read_bytes() != self.bytes:
            wrong.append(("differing", "runs.h5 is another one"))
        if names := {path.name for path in folder.iterdir()} - FILES:
            wrong.append(("left", f"left in the folder: {sorted(names)}"))
        return wrong

    def read(self, folder: Path, acknowledged: Sequence[str], *, thoroughly: bool = False) -> Found:
        """Compare what can be read with what is right."""
        try:
            frame = load_estimates(folder)
            done = experiment_status(folder).done
            found = verify(folder).findings if thoroughly else ()
            findings = [str(finding) for finding in found if finding.state in WRONG]
        except CtidError as error:
            return [("lost", f"not readable: {error}")] if acknowledged else []
        except Exception:
            return [("traceback", "reading: " + traceback.format_exc())]
        wrong = self.compare(frame)
        if done != len(frame):
            wrong.append(("wrong", f"status says {done}, {len(frame)} are there"))
        if findings:
            wrong.append(("wrong", f"verify says: {findings}"))
        if lost := set(acknowledged) - set(frame["id"]):
            wrong.append(("lost", f"{len(lost)} of {len(acknowledged)}"))
        return wrong

    def compare(self, frame: pd.DataFrame) -> Found:
        """Compare estimates that were read with those that are right."""
        found = frame.set_index("id").drop(columns=TIMES)
        if not set(found.index) <= set(self.frame.index) or found.index.has_duplicates:
            return [("wrong", "estimates that were never computed, or twice the same")]
        right = self.frame.loc[found.index, found.columns]
        other = (found.map(_text) != right.map(_text)).any()
        return [("wrong", f"other values of {list(other[other].index)}")] if other.any() else []


def _text(value: object) -> str:
    # A column in which nothing is known may have another type.
    if value is None or value is pd.NA or value != value:
        return ""
    return repr(float(value)) if isinstance(value, numbers.Real) else repr(value)


class Started:
    """Work in a process of its own, and what it says."""

    def __init__(self, work: Callable[[Callable[[str], object]], None]) -> None:
        context = multiprocessing.get_context("fork")
        self._ours, theirs = context.Pipe(duplex=False)
        self.process = context.Process(target=_work, args=(work, theirs))
        self.process.start()
        theirs.close()
        self.said: list[str] = []
        self.wrong: Found = []
        self._over = False

    def listen(self, seconds: float) -> bool:
        """Hear what it says next; whether it said something within this time."""
        if self._over or not self._ours.poll(seconds):
            return False
        try:
            kind, text = self._ours.recv()
        except (EOFError, OSError):
            self._over = True
            return False
        if kind == "said":
            self.said += text.split()
        else:
            self.wrong.append((kind, text))
        return True

    def end(self, patience: float = PATIENCE, killed: Sequence[int] = (signal.SIGKILL,)) -> tuple[list[str], Found]:
        """All that it said, and what must not have become of it; it may have died of some signals."""
        deadline = time.monotonic() + patience
        while not self._over and time.monotonic() < deadline:
            self.listen(max(deadline - time.monotonic(), 0.0))
        if not self._over:
            self.wrong.append(("hang", f"not over after {patience:g} s"))
            self.process.kill()
        self.process.join()
        if self.process.exitcode not in (0, *(-number for number in killed)):
            self.wrong.append(("traceback", f"the process ended with {self.process.exitcode}"))
        self._ours.close()
        return self.said, self.wrong


def apart(work: Callable[[Callable[[str], object]], None]) -> tuple[list[str], Found]:
    """What work said in a process of its own, whatever became of that, and what must not have become of it."""
    return Started(work).end()


def apart_found(judge: Callable[[], Found]) -> Found:
    """What was found wrong in a process of its own, and what must not have become of that."""
    said, wrong = apart(lambda say: say(json.dumps(judge()).replace(" ", "\0")))
    entries = json.loads(" ".join(said).replace("\0", " ") or "[]")
    return [*wrong, *((what, text) for what, text in entries)]


def _work(work: Callable[[Callable[[str], object]], None], connection: Connection) -> None:
    os.setpgid(0, 0)
    try:
        work(lambda text: connection.send(("said", text)))
    except CtidError as error:
        if not str(error) or "Traceback" in str(error):
            connection.send(("traceback", f"message: {error}"))
    except OSError as error:
        # What the commands make a message of.
        if error.errno not in _common._OF_THE_DISK and "temporary directory" not in str(error):
            connection.send(("traceback", traceback.format_exc()))
    except BaseException:
        connection.send(("traceback", traceback.format_exc()))


class Place:
    """A folder for one trial after the other, emptied each time; what else appears beside it was left behind."""

    def __init__(self) -> None:
        # In memory where there is such a folder: thousands of synchronisations wear a disk out and test nothing more.
        shared = Path("/dev/shm")
        self.top = Path(tempfile.mkdtemp(prefix="trials-", dir=shared if os.access(shared, os.W_OK) else None))
        self.temporary = self.top / "tmp"
        self.folder = self.top / "results" / "toys"
        self.empty()
        tempfile.tempdir = str(self.temporary)

    def empty(self) -> Path:
        """Begin anew."""
        for path in (self.temporary, self.folder.parent):
            shutil.rmtree(path, ignore_errors=True)
            path.mkdir()
        return self.folder

    def left(self) -> Found:
        """What lies where nothing should, after a later process has cleared what it may."""
        for mark in self.temporary.glob("*/.in-use"):
            os.utime(mark, (0, 0))
        TemporaryFolder().close()
        names = [path.name for path in (*self.temporary.iterdir(), *self.folder.parent.iterdir())]
        names = [name for name in names if name != self.folder.name]
        return [("left", f"left beside the folder: {names}")] if names else []

    def close(self) -> None:
        """Remove all of it."""
        tempfile.tempdir = None
        shutil.rmtree(self.top, ignore_errors=True)


def errors_of(*names: str) -> dict[str, int]:
    """Numbers of errors by name."""
    return {name: getattr(errno, name) for name in names}
