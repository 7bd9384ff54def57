"""Workers of dask.distributed, on this machine or on many, as an executor.

Jobs go to chosen workers, few at a time, through dask's own futures: which worker has what is known here, so that the
death of one is seen at once and costs the jobs it had, which are computed by others. No worker gets a job before it has
shown that it has the same code, packages and arithmetic as this process.
"""

from __future__ import annotations

import logging
import pickle
import queue
import time
import uuid
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ctid_cli.errors import DataError, MachineError, RefusedError, UsageError
from ctid_cli.running.executor import Done, Lost, Message
from ctid_cli.running.job import Job
from ctid_cli.running.limits import Limits
from ctid_cli.running.origins import current_origin
from ctid_cli.running.pool import cause_of, packed
from ctid_cli.running.remote import compute_here, files_of, identify
from ctid_cli.storage.identity import origin_differences
from ctid_cli.storage.manifest import Key

if TYPE_CHECKING:
    from ctid_cli.running.cells import Plan

#: Jobs that a worker has ready for each of its threads, beside the one in work.
AHEAD = 1
#: How often it is asked which workers there are [s], and how long one is waited for.
LOOK = 0.5
PATIENCE = 120.0
ANSWER = 10.0
#: So often may workers die of a job before the machine is said not to let it finish.
DEATHS = 3


@dataclass
class _Task:
    """A job that a worker has."""

    job: Job
    future: Any


@dataclass
class _Remote:
    """A worker that has shown what it is."""

    address: str
    threads: int
    #: What it has, by the keys of dask, in the order in which it takes them.
    tasks: dict[str, _Task] = field(default_factory=dict)

    @property
    def room(self) -> int:
        return self.threads * (1 + AHEAD) - len(self.tasks)


class DaskExecutor:
    """Computes jobs with the workers of a scheduler, or with those of a cluster of its own."""

    def __init__(
        self, plan: Plan, limits: Limits, scheduler: str | None, workers: int, tell: Callable[[str], None]
    ) -> None:
        self._limits, self._tell = limits, tell
        self._cluster, self._client = _connect(scheduler, workers)
        self._place = scheduler or "this machine"
        parts = [plan.data_cells[0].source, *(cell.estimator for cell in plan.estimators)]
        self._origin = current_origin(plan)
        self._question = packed(parts), _contents([cell.source for cell in plan.data_cells])
        self._remotes: dict[str, _Remote] = {}
        #: Which worker has a task.
        self._where: dict[str, _Remote] = {}
        #: Workers that were asked what they are, and those that may not take part.
        self._asked: dict[str, Any] = {}
        self._refused: dict[str, str] = {}
        #: What workers tell, and futures that are done, after all that was told of them.
        self._news: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._topic = f"ctid-{uuid.uuid4().hex}"
        self._client.subscribe_topic(self._topic, lambda event: self._news.put(event[1]))
        self._held: list[tuple[Job, bool]] = []
        self._deaths: Counter[Key] = Counter()
        self._messages: list[Message] = []
        self._looked = float("-inf")
        #: Since when there is no worker.
        self._deserted: float | None = None
        try:
            self._wait()
        except BaseException:
            self.close()
            raise

    def _wait(self) -> None:
        """Wait for the first worker."""
        deadline = time.monotonic() + PATIENCE
        while not self._remotes:
            self._look()
            if self._refused and not self._asked and not self._remotes:
                raise RefusedError(f"no worker of {self._place} may take part: {next(iter(self._refused.values()))}")
            if time.monotonic() > deadline:
                raise MachineError(f"{self._place} has no worker; start some with: dask worker {self._place}")
            time.sleep(0.05)

    @property
    def room(self) -> int:
        """How many further jobs it would begin, or keep ready, now."""
        free = sum(max(remote.room, 0) for remote in self._remotes.values()) - len(self._held)
        # A run without anything in work would end.
        idle = not self._held and not self._where
        return max(free, int(idle))

    def submit(self, job: Job, *, alone: bool = False) -> None:
        """Take a job."""
        remote = max(self._remotes.values(), key=lambda one: one.room / one.threads, default=None)
        if remote is None or remote.room <= 0:
            self._held.append((job, alone))
            return
        try:
            content = packed(job)
        except Exception as error:
            self._messages.append(Lost(job, *cause_of(error)))
            return
        future = self._client.submit(compute_here, content, self._limits, alone, self._topic, **_only(remote.address))
        remote.tasks[future.key] = _Task(job, future)
        self._where[future.key] = remote
        future.add_done_callback(self._news.put)

    def collect(self, seconds: float) -> list[Message]:
        """What has happened since the last call."""
        messages, self._messages = self._messages, []
        self._spread()
        with suppress(queue.Empty):
            messages += self._heard(self._news.get(timeout=seconds))
            while True:
                messages += self._heard(self._news.get_nowait())
        if time.monotonic() - self._looked >= LOOK:
            messages += self._look()
            self._require_workers()
        held, self._held = self._held, []
        for job, alone in held:
            self.submit(job, alone=alone)
        return messages

    def _spread(self) -> None:
        """Give idle workers, for which there was no other job, what busy ones were to do next."""
        idle = sum(remote.threads for remote in self._remotes.values() if not remote.tasks)
        busy = [remote for remote in self._remotes.values() if len(remote.tasks) > remote.threads] if idle else []
        for remote in busy[:idle]:
            task = self._forget(next(reversed(remote.tasks)))
            # If it was begun in this moment, the worker gives it up.
            self._client.cancel([task.future], force=True)
            self._held.append((task.job, False))

    def _forget(self, key: str) -> _Task:
        """A task that is over, or to be done elsewhere."""
        return self._where.pop(key).tasks.pop(key)

    def _heard(self, news: Any) -> list[Message]:
        """What became of a job, or of the first of its estimates."""
        remote = self._where.get(news["task"] if isinstance(news, dict) else news.key)
        if remote is None:
            return []
        if isinstance(news, dict):
            job, messages = remote.tasks[news["task"]].job, pickle.loads(news["messages"])
            if any(isinstance(message, Done | Lost) for message in messages):
                self._forget(news["task"])
            return [replace(message, job=job) for message in messages]
        job = self._forget(news.key).job
        if news.status == "error":
            return [Lost(job, *cause_of(news.exception()))]
        return [Lost(job, "chance", "it was given up") if news.status == "finished" else self._bereaved(job)]

    def _bereaved(self, job: Job, at_work: bool = True) -> Message:
        """A job whose worker is gone; what it had not begun did not kill it."""
        self._deaths[job.keys[0]] += at_work
        if self._deaths[job.keys[0]] < DEATHS:
            return Lost(job, "chance", "its worker is gone")
        return Lost(job, "machine", f"{DEATHS} workers died of it, one after another")

    def _look(self) -> list[Message]:
        """See which workers there are now."""
        self._looked = time.monotonic()
        try:
            present: dict[str, int] = self._client.nthreads()
        except Exception as error:
            raise MachineError(f"{self._place} does not answer any more ({error})") from error
        lost: list[Message] = []
        for address in self._remotes.keys() - present.keys():
            gone = self._remotes.pop(address)
            self._tell(f"worker {address} is gone; others take over its {len(gone.tasks)} jobs")
            tasks = [self._forget(key) for key in list(gone.tasks)]
            self._client.cancel([task.future for task in tasks], force=True)
            lost += [self._bereaved(task.job, number < gone.threads) for number, task in enumerate(tasks)]
        known = self._remotes.keys() | self._asked.keys() | self._refused.keys()
        for address in present.keys() - known:
            self._asked[address] = self._client.submit(identify, *self._question, **_only(address))
        for address, future in list(self._asked.items()):
            if address not in present:
                del self._asked[address]
            elif future.done():
                del self._asked[address]
                self._judge(address, future, present[address])
        return lost

    def _judge(self, address: str, future: Any, threads: int) -> None:
        """Let a worker take part, or not."""
        if future.status != "finished":
            reason = f"worker {address} cannot be used: {future.exception()}"
        else:
            try:
                host, origin = future.result(timeout=ANSWER)
            except TimeoutError:
                # It died with its answer; if it did not, it is asked once more.
                return
            pairs = origin_differences(self._origin, origin)
            if not pairs:
                self._remotes[address] = _Remote(address, threads)
                return
            differences = "; ".join(dict.fromkeys(f"{name} {here} here, {there} there" for name, here, there in pairs))
            reason = f"worker {address} on {host} is of other code or arithmetic ({differences})"
        self._refused[address] = reason
        self._tell(f"{reason}; it gets no work")

    def _require_workers(self) -> None:
        if self._remotes or self._asked:
            self._deserted = None
            return
        self._deserted = self._deserted or time.monotonic()
        if time.monotonic() - self._deserted > PATIENCE:
            raise MachineError(f"{self._place} has no worker left; what was finished is stored, the same run goes on")

    def stop(self) -> None:
        """Abandon what is in work at once; workers elsewhere notice by themselves."""
        with suppress(Exception):
            tasks = [task for remote in self._remotes.values() for task in remote.tasks.values()]
            self._client.cancel([task.future for task in tasks], force=True)
        for key in list(self._where):
            self._forget(key)
        self._held.clear()

    def close(self) -> None:
        """Leave the scheduler, and end a cluster of one's own."""
        self.stop()
        for part in (self._client, self._cluster):
            if part is not None:
                with suppress(Exception):
                    part.close()


def _connect(scheduler: str | None, workers: int) -> tuple[Any, Any]:
    """A cluster of one's own, if no scheduler is given, and a client."""
    try:
        import dask
        import distributed
    except ImportError:
        raise UsageError("--backend dask needs dask.distributed; install it with: pip install 'ctid[dask]'") from None
    cluster = None
    if scheduler is None:
        # What its workers log when one of them is killed says nothing that is not said here.
        for name in ("distributed", "tornado"):
            logging.getLogger(name).setLevel(logging.CRITICAL)
        settings = {"distributed.worker.daemon": False, "distributed.comm.timeouts.connect": "30s"}
        with dask.config.set(settings):
            cluster = distributed.LocalCluster(  # type: ignore[no-untyped-call]
                n_workers=workers,
                threads_per_worker=1,
                processes=True,
                memory_limit=0,
                dashboard_address=None,
                silence_logs=logging.CRITICAL,
            )
    try:
        client = distributed.Client(cluster or scheduler, timeout=10, set_as_default=False)  # type: ignore[no-untyped-call]
    except (OSError, ValueError, TimeoutError) as error:
        advice = "start one with: dask scheduler"
        raise UsageError(f"no scheduler of dask answers at {scheduler} ({error}); {advice}") from None
    return cluster, client


def _only(address: str) -> dict[str, Any]:
    """Options of a task that is for one worker."""
    return {"workers": [address], "allow_other_workers": False, "pure": False}


def _contents(sources: Sequence[Any]) -> dict[str, bytes]:
    """The files that data sets are made from, by hash, to be sent along."""
    found: dict[str, str] = {}
    for source in sources:
        found |= files_of(source)
    try:
        return {sha256: Path(path).read_bytes() for sha256, path in found.items()}
    except OSError as error:
        raise DataError(f"{error.filename}: the file cannot be read: {error.strerror}") from error
