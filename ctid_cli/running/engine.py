"""Running an experiment: compute what is missing, store it as it comes, export it at the end.

The same call starts, resumes and re-verifies an experiment. Only this process writes; workers return results. An
estimate is reported as done after the journal has it safely.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

from ctid_cli.errors import MachineError, RefusedError, StorageError
from ctid_cli.processors import usable_processors
from ctid_cli.running.first_data import check_first_data, compile_kernels
from ctid_cli.running.job import Job
from ctid_cli.running.limits import Limits, advice
from ctid_cli.running.plan import Plan, current_origin
from ctid_cli.running.precision import CellPrecision, as_needed, stored_precisions
from ctid_cli.running.states import States
from ctid_cli.running.stopping import MACHINE, TOO_MANY_FAILURES, StopAt, StopRequest
from ctid_cli.running.suspects import Course, GivenUp, Slow, Suspected
from ctid_cli.running.workers import LocalWorkers
from ctid_cli.storage import announcement
from ctid_cli.storage import folder as place
from ctid_cli.storage.columns import FAILURES
from ctid_cli.storage.export import write_runs
from ctid_cli.storage.identity import Origin, canonical_text, now, session_info
from ctid_cli.storage.journal import Journal, open_journal
from ctid_cli.storage.keeping import keep_readable as keep_readable_of
from ctid_cli.storage.manifest import Key, Outcome
from ctid_cli.storage.sqlite_file import FILE_NAME

#: Finished estimates are committed after this time [s], or when there are this many of them.
COMMIT_SECONDS = 0.2
COMMIT_ESTIMATES = 200
#: Estimates given up that are named at the end.
CULPRITS = 3

_EXIT_CODES = {"SIGINT": 130, "SIGTERM": 143, MACHINE: MachineError.exit_code}
#: Exit code after any other stop.
STOPPED = 5


class Workload(NamedTuple):
    """What a run has to do."""

    data_sets: int
    estimates: int
    #: Stored ones that stay, failures among those to compute, and stored ones of other plans.
    reused: int
    again: int
    left_aside: int
    #: Most data sets of a data cell, where it gets as many as a precision needs.
    at_most: int | None = None

    def __str__(self) -> str:
        text = f"{_count(self.estimates, 'estimate')} of {_count(self.data_sets, 'data set')} to compute"
        text += f", {self.again} of them once more" if self.again else ""
        text += f", {self.reused} already stored" if self.reused else ""
        text += f", {self.left_aside} stored ones set aside" if self.left_aside else ""
        more = f", then in blocks until they are enough, {self.at_most} data sets of a cell at most"
        return text + more if self.at_most is not None and self.estimates else text


class Progress(NamedTuple):
    """How far a run is; it is told when what it tells of is safely stored."""

    #: Data sets, and estimates of this run that failed.
    done: int
    total: int
    failed: int
    #: Estimates that were stored since the last call.
    stored: Sequence[Key] = ()
    #: What else happened, as a sentence; empty for nothing.
    message: str = ""
    #: How well the data cells are known, where a block of data sets has just been finished.
    precision: tuple[CellPrecision, ...] = ()


def _ignore(progress: Progress) -> None:
    """Take no notice."""


@dataclass(frozen=True)
class RunSummary:
    """How a run ended."""

    experiment: str
    folder: Path
    planned: int
    reused: int
    computed: int
    failed: int
    left_aside: int
    mixed: bool
    moved_aside: Path | None
    #: Duration [s].
    seconds: float
    stopped_by: str | None
    #: How well each data cell is known; empty where the number of data sets was given.
    precision: tuple[CellPrecision, ...] = ()
    #: Estimator and replicate of estimates that the machine did not let finish, and what was in their way.
    given_up: tuple[str, ...] = ()
    hindrance: str = ""

    @property
    def missing(self) -> int:
        """Estimates that are still to be computed."""
        return self.planned - self.reused - self.computed

    @property
    def exit_code(self) -> int:
        """Exit code of a command: 0 if everything is stored, 130 or 143 after a signal, 5 after another stop.

        8 where the machine stood in the way.
        """
        return 0 if self.stopped_by is None else _EXIT_CODES.get(self.stopped_by, STOPPED)

    def machine_error(self) -> MachineError:
        """Return what to say where the machine stood in the way."""
        text = f"{self.experiment}: the machine did not let estimates finish, {self.missing} are missing"
        if self.given_up:
            more = ", …" if len(self.given_up) > CULPRITS else ""
            text += f" ({', '.join(self.given_up[:CULPRITS])}{more})"
        return MachineError(f"{text}: {self.hindrance}. What helps: {advice(self.hindrance)}. The same command goes on")


def run_experiment(
    plan: Plan,
    folder: Path,
    *,
    jobs: int | None = None,
    progress: Callable[[Progress], object] = _ignore,
    warn: Callable[[str], object] = warnings.warn,
    fresh: bool = False,
    keep_readable: bool = False,
    allow_mixed: bool = False,
    stop: StopAt | None = None,
    retry: Collection[str] = (),
    dask: str | None = None,
    warm: Callable[[Plan], object] = compile_kernels,
) -> RunSummary:
    """Compute the missing estimates of a plan and export all of them.

    They are computed by `jobs` processes of this machine, or by the workers of the dask scheduler at an address. Stored
    failures of a status in `retry` are computed again; so are those that exceeded a limit which is higher now.
    """
    begun = time.monotonic()
    stopping = StopRequest(stop)
    origin, limits = current_origin(plan), Limits.of(plan.spec.canonical())
    limits.require_support()
    found = _look(plan, folder, origin, retry, limits, fresh=fresh, allow_mixed=allow_mixed)
    missing = found.states.missing(found.plan)
    if any(lacking.any() for lacking in missing):
        # Until workers are at work, a signal ends the process as it ends any other.
        warm(plan)
        check_first_data(plan, found.states.jobs(found.plan, missing, {}), limits, warn)
    with ExitStack() as stack:
        workers: Any
        if dask is None:
            workers = LocalWorkers(jobs or usable_processors(), limits)
        else:
            from ctid_cli.running.dask_cluster import DaskWorkers

            workers = DaskWorkers(dask, plan, origin, limits)
        stack.callback(workers.close)
        stack.enter_context(stopping)
        moved = place.move_aside(folder) if fresh else None
        with _writing(folder):
            folder.mkdir(parents=True, exist_ok=True)
        stack.enter_context(place.lock(folder))
        # Another run may have come between.
        place.check_free(folder, plan.manifest(), origin, allow_mixed=allow_mixed, known=found.state)
        place.clear(folder)
        with place.saying_what_is_safe(folder):
            log = open_journal(folder / FILE_NAME)
        stack.callback(log.close)
        if moved is not None and keep_readable:
            kept = keep_readable_of(moved, log, plan.manifest(), origin, allow_mixed=allow_mixed)
            warn(f"{plan.experiment}: {kept}")
        if found.state is None or log.state() != found.state:
            found = _Found(as_needed(plan, log), States.read(log, retry, limits))
        run = _Run(found, folder, log, origin, progress)
        stack.callback(announcement.retract, folder)
        run.start({"jobs": workers.count, "limits": asdict(limits)})
        run.compute(workers, limits, stopping)
        while not stopping() and run.needs_more():
            run.compute(workers, limits, stopping)
        return run.finish(stopping.reason, moved, begun)


class _Run:
    """One run, from the first entry in the journal to ``runs.h5``."""

    def __init__(
        self,
        found: _Found,
        folder: Path,
        log: Journal,
        origin: Origin,
        progress: Callable[[Progress], object],
    ) -> None:
        self.plan, self.states, _ = found
        self.folder, self.log, self.origin, self.progress = folder, log, origin, progress
        self.computed = self.done = self.total = self.failures = 0
        self.given_up: tuple[str, ...] = ()
        self.hindrance = ""
        self.precision: tuple[CellPrecision, ...] = ()
        #: Latest time of an estimate by data cell and estimator [s], and estimates left of the data sets in work.
        self.seconds: dict[tuple[str, str], float] = {}
        self.unfinished: dict[tuple[str, int], int] = {}
        self.started = now()
        self._lay_out()

    def _lay_out(self) -> None:
        """Find what of the plan is to be computed."""
        self.manifest = self.plan.manifest()
        self.names = {part["hash"]: part["name"] for part in self.manifest["estimators"]}
        self.missing = self.states.missing(self.plan)
        self.work = _workload(self.plan, self.states, self.missing)
        self.total = self.done + self.work.data_sets

    def start(self, circumstances: dict[str, Any]) -> None:
        spec = self.plan.spec
        canonical = canonical_text(spec.canonical())
        with _writing(self.folder):
            for name, text in ((place.SPEC, spec.text), (place.CANONICAL, canonical)):
                self.log.write_beside(name, text.encode())
        info = session_info(spec.text, spec.folder) | circumstances
        self.session = self.log.begin(self.manifest, self.origin, self.started, info)
        self._tell(message=str(self.work))

    def needs_more(self) -> bool:
        """Return whether the finished block leaves data cells that are not known well enough; plan their next one."""
        self.precision = stored_precisions(self.manifest, self.log)
        needed = tuple(cell.needed for cell in self.precision)
        if needed in ((), self.plan.replicates):
            return False
        self.plan = self.plan.with_replicates(needed)
        self._lay_out()
        self.log.replan(self.manifest)
        self._tell(precision=self.precision)
        return True

    def compute(self, workers: Any, limits: Limits, stopping: StopRequest) -> None:
        """Compute what is missing: store it and tell of it, in whichever order it comes."""
        batch: list[Outcome] = []
        since = time.monotonic()
        told = False
        course = Course(self._jobs(), workers, limits, stopping)
        with closing(course.events()) as events:
            try:
                for event in events:
                    if stopping() and not told:
                        told = True
                        what = "waiting for what is in work; once more to stop at once"
                        self._tell(message=f"stopping ({stopping.reason}): {what}")
                    if isinstance(event, list):
                        batch += event
                    elif event is not None:
                        self._note(event, stopping)
                    if batch and (time.monotonic() - since >= COMMIT_SECONDS or len(batch) >= COMMIT_ESTIMATES):
                        batch = self._commit(batch)
                        since = time.monotonic()
                        if self.failures >= (stopping.at.failures or math.inf):
                            stopping.ask(TOO_MANY_FAILURES)
            except (MachineError, RefusedError):
                # A cluster that is gone does not take with it what it has finished.
                self._commit(batch)
                raise
        self._commit(batch)

    def _jobs(self) -> Iterator[Job]:
        for job in self.states.jobs(self.plan, self.missing, self.seconds):
            self.unfinished[job.cell.hash, job.replicate] = len(job.wanted)
            yield job

    def _note(self, event: Suspected | GivenUp | Slow, stopping: StopRequest) -> None:
        """Tell of what is not a result."""
        match event:
            case Suspected():
                what = f"{_count(len(event.keys), 'estimate')} again, each in a process of its own"
                self._tell(message=f"a worker process died; computing {what}")
            case Slow():
                took = f"{self._name(event.key)} has been in work for {event.seconds / 60:.0f} min"
                self._tell(message=f"{took}; limits.wall_seconds would end what takes longer than it says")
            case GivenUp():
                names = tuple(map(self._name, event.keys))
                self.given_up += names
                self.hindrance = event.reason
                if names:
                    what = f"{_count(len(names), 'estimate')} given up, not stored ({', '.join(names[:CULPRITS])})"
                    self._tell(message=f"{what}: {event.reason}")
                else:
                    stopping.ask(MACHINE)

    def _name(self, key: Key) -> str:
        return f"{self.names[key.estimator_hash]} on replicate {key.replicate}"

    def _commit(self, batch: list[Outcome]) -> list[Outcome]:
        """Store estimates, then tell of them; nothing is left of the batch."""
        if not batch:
            return batch
        self.log.add(batch, self.session)
        for outcome in batch:
            key, status = outcome.key, outcome.result["status"]
            self.states.note(key, status)
            self.failures += status in FAILURES
            self.seconds[key.data_hash, key.estimator_hash] = outcome.seconds or 0.0
            data_set = key.data_hash, key.replicate
            self.unfinished[data_set] -= 1
            if not self.unfinished[data_set]:
                del self.unfinished[data_set]
                self.done += 1
        self.computed += len(batch)
        self._tell(stored=[outcome.key for outcome in batch])
        return []

    def _tell(self, **what: Any) -> None:
        counts = self.done, self.total, self.states.stored
        announcement.announce(self.folder, self.plan.experiment, self.started, *counts)
        self.progress(Progress(self.done, self.total, self.failures, **what))

    def finish(self, reason: str | None, moved: Path | None, begun: float) -> RunSummary:
        write_runs(self.folder, self.log)
        counts = self.states.counts(self.plan)
        missing = counts.planned - counts.reused
        reason = reason or (MACHINE if self.given_up else None)
        stopped, ended = now(), "finished" if not missing else reason or "unfinished"
        told = {
            "planned": counts.planned,
            "reused": counts.reused - self.computed,
            "computed": self.computed,
            "failed": counts.failed,
        }
        self.log.end(self.session, stopped, ended)
        return RunSummary(
            experiment=self.plan.experiment,
            folder=self.folder,
            **told,
            left_aside=self.work.left_aside,
            mixed=len(self.log.origins()) > 1,
            moved_aside=moved,
            seconds=time.monotonic() - begun,
            stopped_by=reason if missing else None,
            precision=self.precision,
            given_up=self.given_up,
            hindrance=self.hindrance,
        )


def preview(
    plan: Plan, folder: Path, *, fresh: bool = False, allow_mixed: bool = False, retry: Collection[str] = ()
) -> Workload:
    """Return what a run would do, without doing or writing anything."""
    limits = Limits.of(plan.spec.canonical())
    found = _look(plan, folder, current_origin(plan), retry, limits, fresh=fresh, allow_mixed=allow_mixed)
    return _workload(found.plan, found.states, found.states.missing(found.plan))


def _workload(plan: Plan, states: States, missing: Sequence[Any]) -> Workload:
    counts = states.counts(plan)
    stored = counts.reused + counts.again
    data_sets, at_most = sum(int(lacking.sum()) for lacking in missing), plan.monte_carlo.get("at_most")
    return Workload(
        data_sets, counts.planned - counts.reused, counts.reused, counts.again, states.stored - stored, at_most
    )


class _Found(NamedTuple):
    """A plan as far as it is decided by what is stored, and that."""

    plan: Plan
    states: States
    #: State of the journal that tells it.
    state: str | None = None


def _look(
    plan: Plan,
    folder: Path,
    origin: Origin,
    retry: Collection[str],
    limits: Limits,
    *,
    fresh: bool,
    allow_mixed: bool,
) -> _Found:
    """Read what there is in a folder that a plan may be run into."""
    if fresh or not folder.exists():
        return _Found(plan, States())
    with place.lock(folder, shared=True):
        place.check_free(folder, plan.manifest(), origin, allow_mixed=allow_mixed)
        with place.reading_journal(folder) as log:
            if log is None:
                return _Found(plan, States())
            return _Found(as_needed(plan, log), States.read(log, retry, limits), log.state())


@contextmanager
def _writing(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        reason = error.strerror or error
        raise StorageError(f"{folder} cannot be written ({reason}); stored estimates are untouched") from error


def _count(n: int, noun: str) -> str:
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"
