"""Execution of an experiment: compute missing estimates, store them as they arrive, and export at the end.

The same call starts, resumes and verifies an experiment. Only this process writes; workers return results. An estimate
is reported as done after it is durable in the journal.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from ctid_cli.errors import MachineError, RefusedError
from ctid_cli.inference.monte_carlo import CellPrecision
from ctid_cli.processors import usable_processors
from ctid_cli.running.job import Job
from ctid_cli.running.limits import MACHINE, PATIENCE, TOO_MANY_FAILURES, Limits, StopRequest, advice
from ctid_cli.running.plan import Plan, current_origin
from ctid_cli.running.states import States, Workload, as_needed, data_sets, jobs_of, stored_precisions
from ctid_cli.running.suspects import NAMED, JobQueue
from ctid_cli.running.workers import LocalWorkers
from ctid_cli.storage import folder as folders
from ctid_cli.storage.columns import FAILURES
from ctid_cli.storage.export import write_runs
from ctid_cli.storage.identity import Origin, now, session_info
from ctid_cli.storage.journal import Journal, open_journal
from ctid_cli.storage.manifest import Key, Outcome
from ctid_cli.storage.merge import keep_readable as keep_readable_of
from ctid_cli.storage.sqlite_file import FILE_NAME, announce, retract

#: Finished estimates are committed after this time [s], or at this number.
COMMIT_SECONDS = 0.2
COMMIT_ESTIMATES = 200

_EXIT_CODES = {"SIGINT": 130, "SIGTERM": 143, MACHINE: MachineError.exit_code}
#: Exit code after any other stop.
STOPPED = 5


class Progress(NamedTuple):
    """Progress of a run; reported after the results are stored durably."""

    #: Finished data sets, all data sets, and failed estimates of this run.
    done: int
    total: int
    failed: int
    #: Estimates stored since the last call.
    stored: Sequence[Key] = ()
    #: Any other event as a sentence; empty if none.
    message: str = ""
    #: Precision of the data cells, after a block of data sets has been finished.
    precision: tuple[CellPrecision, ...] = ()


@dataclass(frozen=True)
class RunSummary:
    """Result of a run."""

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
    #: Settings of the previous run, as in its plan; None if there are no earlier results.
    former: dict[str, Any] | None = None
    #: Precision of each data cell; empty if the number of data sets was given.
    precision: tuple[CellPrecision, ...] = ()
    #: Estimator and replicate of estimates that could not be finished for lack of resources, and the cause.
    given_up: tuple[str, ...] = ()
    cause: str = ""

    @property
    def missing(self) -> int:
        """Number of estimates still to compute."""
        return self.planned - self.reused - self.computed

    @property
    def exit_code(self) -> int:
        """Exit code: 0 if everything is stored, 130 or 143 after a signal, 8 for lack of resources, else 5."""
        return 0 if self.stopped_by is None else _EXIT_CODES.get(self.stopped_by, STOPPED)

    def machine_error(self) -> MachineError:
        """Return the error of a run that the machine had not the resources to finish."""
        text = f"{self.experiment}: this machine could not finish all estimates, {self.missing} are missing"
        if self.given_up:
            more = ", …" if len(self.given_up) > NAMED else ""
            text += f" ({', '.join(self.given_up[:NAMED])}{more})"
        return MachineError(f"{text}: {self.cause}. What helps: {advice(self.cause)}. The same command goes on")


def compile_kernels(plan: Plan) -> None:
    """Compile the kernels of a plan, or load them from the disk cache, so that each is compiled only once."""
    from ctid_cli.estimation import compilation
    from ctid_cli.signals.sampling import RegularSampling
    from ctid_cli.simulation.components import CustomEstimation
    from ctid_cli.simulation.frequency_measures import FrequencyEstimation, SignalSource

    source, estimators = plan.data_cells[0].source, [cell.estimator for cell in plan.estimators]
    if isinstance(source, SignalSource):
        for estimator in estimators:
            if isinstance(estimator, FrequencyEstimation):
                estimator.compile(source.sampling.interval)
        return
    ours = [estimator for estimator in estimators if not isinstance(estimator, CustomEstimation)]
    clocks = [(getattr(cell.source, "sampling", None), getattr(cell.source, "loop", None)) for cell in plan.data_cells]
    # A clock that is unknown before the data are read is taken as regular.
    for regular, closed in {(isinstance(clock, RegularSampling | None), loop is not None) for clock, loop in clocks}:
        compilation.compile_kernels(ours, regular=regular, closed=closed)


def run_experiment(
    plan: Plan,
    folder: Path,
    *,
    jobs: int | None = None,
    progress: Callable[[Progress], object] = lambda progress: None,
    fresh: bool = False,
    keep_readable: bool = False,
    allow_mixed: bool = False,
    stop: StopRequest | None = None,
    retry: Collection[str] = (),
    dask: str | None = None,
    warm: Callable[[Plan], object] = compile_kernels,
) -> RunSummary:
    """Compute the missing estimates of a plan and export all estimates.

    They are computed by `jobs` processes on this machine, or by the workers of the dask scheduler at an address. Stored
    failures with a status in `retry` are computed again; so are failures that exceeded a limit which is now higher.
    """
    begun = time.monotonic()
    stopping = stop or StopRequest()
    origin, limits = current_origin(plan), Limits.of(plan.spec.canonical())
    limits.require_support()
    with ExitStack() as stack:
        workers: Any
        if dask is None:
            workers = LocalWorkers(jobs or usable_processors(), limits)
        else:
            from ctid_cli.running.dask_cluster import DaskWorkers

            workers = DaskWorkers(dask, plan, origin, limits)
        stack.callback(workers.close)
        moved = folders.move_aside(folder) if fresh else None
        with folders.writing(folder):
            folder.mkdir(parents=True, exist_ok=True)
        stack.enter_context(folders.lock(folder))
        folders.check_free(folder, plan.manifest(), None if allow_mixed else origin)
        folders.clear(folder)
        with folders.with_recovery_advice(folder):
            log = open_journal(folder / FILE_NAME)
        stack.callback(log.close)
        kept = ""
        if moved is not None and keep_readable:
            kept = f"{keep_readable_of(moved, log, plan.manifest(), origin, allow_mixed=allow_mixed)}"
        states, plan = States.read(log, retry, limits), as_needed(plan, log)
        work = states.workload(plan)
        if work.estimates:
            # Until jobs are submitted, a signal ends the process at once.
            warm(plan)
        stack.enter_context(stopping)
        former = log.manifest()["spec"] if states.stored else None
        run = _Run(plan, states, work, folder, log, progress)
        stack.callback(retract, folder)
        run.start(origin, {"jobs": workers.count, "limits": asdict(limits)}, kept)
        more = True
        while more:
            run.compute(workers, limits, stopping)
            more = not stopping() and run.needs_more()
        return replace(run.finish(stopping.reason, moved, begun), former=former)


class _Run:
    """One run, from its first journal entry to ``runs.h5``."""

    def __init__(
        self,
        plan: Plan,
        states: States,
        work: Workload,
        folder: Path,
        log: Journal,
        progress: Callable[[Progress], object],
    ) -> None:
        self.plan, self.states, self.work = plan, states, work
        self.folder, self.log, self.progress = folder, log, progress
        self.computed = self.done = self.failures = 0
        self.total = work.data_sets
        self.given_up: list[str] = []
        self.cause = ""
        self.precision: tuple[CellPrecision, ...] = ()
        #: Number of unfinished estimates of each data set in progress.
        self.unfinished: dict[tuple[str, int], int] = {}
        self.started = now()

    def start(self, origin: Origin, circumstances: dict[str, Any], kept: str) -> None:
        """Record the start of the run, and report its workload."""
        with folders.writing(self.folder):
            self.log.write_spec(self.plan.spec.text.encode())
        info = session_info(self.plan.spec.text) | circumstances
        self.session = self.log.begin(self.plan.manifest(), origin, self.started, info)
        self._report(message=str(self.work))
        if kept:
            self._report(message=kept)

    def needs_more(self) -> bool:
        """Return whether data cells need more data sets after the finished block; if so, plan their next block."""
        self.precision = stored_precisions(self.plan.manifest(), self.log)
        needed = tuple(cell.needed for cell in self.precision)
        if needed in ((), self.plan.replicates):
            return False
        self.plan = replace(self.plan, replicates=needed)
        self.total = self.done + data_sets(self.states.missing(self.plan))
        self.log.replan(self.plan.manifest())
        self._report(precision=self.precision)
        return True

    def compute(self, workers: Any, limits: Limits, stopping: StopRequest) -> None:
        """Compute missing estimates, and store and report them in order of arrival."""
        batch: list[Outcome] = []
        since = time.monotonic()
        announced = False
        queue = JobQueue(self._jobs(), workers, limits, stopping, lambda message: self._report(message=message))
        with closing(queue.outcomes()) as found:
            try:
                for outcomes in found:
                    if stopping() and not announced:
                        announced = True
                        what = f"running estimates have {PATIENCE:g} s; a second signal stops at once"
                        self._report(message=f"stopping ({stopping.reason}): {what}")
                    batch += outcomes
                    if batch and (time.monotonic() - since >= COMMIT_SECONDS or len(batch) >= COMMIT_ESTIMATES):
                        batch = self._commit(batch)
                        since = time.monotonic()
                        if self.failures >= (stopping.failures or math.inf):
                            stopping.request(TOO_MANY_FAILURES)
            except (MachineError, RefusedError):
                # Estimates that a lost cluster has finished are stored.
                self._commit(batch)
                raise
        self._commit(batch)
        self.given_up += queue.given_up
        self.cause = queue.cause or self.cause
        if queue.is_stuck:
            stopping.request(MACHINE)

    def _jobs(self) -> Iterator[Job]:
        for job in jobs_of(self.plan, self.states.missing(self.plan)):
            self.unfinished[job.cell.hash, job.replicate] = len(job.wanted)
            yield job

    def _commit(self, batch: list[Outcome]) -> list[Outcome]:
        """Store estimates, report them, and return an empty batch."""
        if not batch:
            return batch
        self.log.add(batch, self.session)
        for outcome in batch:
            key, status = outcome.key, outcome.result["status"]
            self.states.note(key, status)
            self.failures += status in FAILURES
            data_set = key.data_hash, key.replicate
            self.unfinished[data_set] -= 1
            if not self.unfinished[data_set]:
                del self.unfinished[data_set]
                self.done += 1
        self.computed += len(batch)
        self._report(stored=[outcome.key for outcome in batch])
        return []

    def _report(self, **what: Any) -> None:
        counts = self.done, self.total, self.states.stored
        announce(self.folder, self.plan.experiment, self.started, *counts)
        self.progress(Progress(self.done, self.total, self.failures, **what))

    def finish(self, reason: str | None, moved: Path | None, begun: float) -> RunSummary:
        """Write ``runs.h5``, and record how the run ended."""
        write_runs(self.folder, self.log)
        left = self.states.workload(self.plan)
        reason = reason or (MACHINE if self.given_up else None)
        self.log.end(self.session, now(), "finished" if not left.estimates else reason or "unfinished")
        return RunSummary(
            experiment=self.plan.experiment,
            folder=self.folder,
            planned=left.reused + left.estimates,
            reused=left.reused - self.computed,
            computed=self.computed,
            failed=left.failed,
            left_aside=self.work.left_aside,
            mixed=len(self.log.origins()) > 1,
            moved_aside=moved,
            seconds=time.monotonic() - begun,
            stopped_by=reason if left.estimates else None,
            precision=self.precision,
            given_up=tuple(self.given_up),
            cause=self.cause,
        )


def preview(
    plan: Plan, folder: Path, *, fresh: bool = False, allow_mixed: bool = False, retry: Collection[str] = ()
) -> Workload:
    """Return the workload of a run without computing or writing anything."""
    if fresh or not folder.exists():
        return States().workload(plan)
    with folders.lock(folder, shared=True):
        folders.check_free(folder, plan.manifest(), None if allow_mixed else current_origin(plan))
        with folders.reading_journal(folder) as log:
            states = States.read(log, retry, Limits.of(plan.spec.canonical()))
            return states.workload(as_needed(plan, log))
