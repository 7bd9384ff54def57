"""Running an experiment: compute what is missing, store it as it comes, seal it at the end.

The same call starts, resumes and re-verifies an experiment. Only this process writes; workers return results. An
estimate is reported as done after the journal has it safely.
"""

from __future__ import annotations

import itertools
import math
import time
import warnings
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ctid_cli.errors import DataError, MachineError, StorageError, UsageError
from ctid_cli.processors import usable_processors
from ctid_cli.running import events
from ctid_cli.running.cell_precision import CellPrecision, as_needed, stored_precisions
from ctid_cli.running.custom_check import check_components
from ctid_cli.running.dispatch import GivenUp, Slow, Unable, run_jobs
from ctid_cli.running.executor import Computed, Executor
from ctid_cli.running.hindrances import advice
from ctid_cli.running.job import Job
from ctid_cli.running.key_set import KeySet
from ctid_cli.running.limits import WATCHES_PROCESSES, Limits
from ctid_cli.running.origins import current_origin
from ctid_cli.running.pool import LokyPool
from ctid_cli.running.retry import Stock, take_stock
from ctid_cli.running.stopping import MACHINE, TOO_MANY_FAILURES, StopAt, StopRequest
from ctid_cli.running.todo import Todo
from ctid_cli.storage import folder as place
from ctid_cli.storage.columns import FAILURES
from ctid_cli.storage.export import seal
from ctid_cli.storage.identity import Origin, canonical_text, now, session_info
from ctid_cli.storage.journal import EXPORT, FILE_NAME, Journal, open_journal
from ctid_cli.storage.manifest import Key, Outcome, Slot, assemble
from ctid_cli.storage.merge import keep_readable as keep_readable_of

if TYPE_CHECKING:
    from ctid_cli.running.cells import Plan

#: Finished estimates are committed after this time [s], or when there are this many of them.
COMMIT_SECONDS = 0.2
COMMIT_ESTIMATES = 200
#: So many of the estimates that were given up are named at the end.
CULPRITS = 3

_EXIT_CODES = {"SIGINT": 130, "SIGTERM": 143, MACHINE: MachineError.exit_code}
#: Exit code after any other stop.
STOPPED = 5


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
    #: Estimates that the machine did not let finish, and what was in their way.
    given_up: int = 0
    hindrance: str = ""
    #: Estimator and replicate of the first of them.
    culprits: tuple[str, ...] = ()

    @property
    def missing(self) -> int:
        """Estimates that are still to be computed."""
        return self.planned - self.reused - self.computed

    @property
    def exit_code(self) -> int:
        """What a command should answer: 0 if everything is stored, 130 or 143 after a signal, 5 after another stop.

        8 where the machine stood in the way.
        """
        return 0 if self.stopped_by is None else _EXIT_CODES.get(self.stopped_by, STOPPED)

    def machine_error(self) -> MachineError:
        """What to say where the machine stood in the way."""
        text = f"{self.experiment}: the machine did not let estimates finish, {self.missing} are missing"
        if self.culprits:
            more = ", …" if self.given_up > len(self.culprits) else ""
            text += f" ({', '.join(self.culprits)}{more})"
        return MachineError(f"{text}: {self.hindrance}. What helps: {advice(self.hindrance)}. The same command goes on")


def run_experiment(
    plan: Plan,
    folder: Path,
    *,
    jobs: int | None = None,
    on_event: events.OnEvent = events.ignore,
    fresh: bool = False,
    keep_readable: bool = False,
    allow_mixed: bool = False,
    stop: StopAt | None = None,
    warm: Callable[[], float] | None = None,
    executor: Callable[[Limits], Executor] | None = None,
    retry: Collection[str] = (),
) -> RunSummary:
    """Compute the missing estimates of a plan and seal all of them.

    An executor is made for the limits that it is to watch; by default `jobs` processes on this machine. Stored failures
    of a status in `retry` are computed again; so are those that exceeded a limit which is higher now.
    """
    begun = time.monotonic()
    origin = current_origin(plan)
    limits = Limits.of(plan.spec.canonical())
    if limits.of_processes and not WATCHES_PROCESSES:
        raise UsageError("limits.cpu_seconds and limits.memory_mb need Linux; use wall_seconds, which works everywhere")
    with StopRequest(stop) as stopping, ExitStack() as stack:
        found = _look(plan, folder, origin, retry, fresh=fresh, allow_mixed=allow_mixed)
        todo = Todo(found.plan, found.stock)
        if todo.data_sets:
            on_event(events.KernelsCompiling())
            on_event(events.KernelsCompiled(warm() if warm else _compile_kernels(plan)))
            if not check_components(plan, limits, stopping, lambda text: on_event(events.Warned(text))):
                _check_first_records(todo)
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
            on_event(events.Warned(f"{plan.experiment}: {kept}"))
        workers = jobs or usable_processors()
        computing = executor(limits) if executor else LokyPool(workers, limits)
        stack.callback(computing.close)
        if found.state is None or log.state() != found.state:
            found = _Found(as_needed(plan, log), take_stock(log, retry, limits))
        run = _Run(found.plan, folder, log, found.stock, origin, on_event, computing)
        stack.callback(place.retract, folder)
        run.start({"jobs": workers, "limits": asdict(limits)})
        run.compute(stopping)
        while run.needs_more() and not stopping():
            run.compute(stopping)
        return run.finish(stopping.reason, moved, begun)


class _Run:
    """One run, from the first entry in the journal to the sealed file."""

    def __init__(
        self,
        plan: Plan,
        folder: Path,
        log: Journal,
        stock: Stock,
        origin: Origin,
        on_event: events.OnEvent,
        executor: Executor,
    ) -> None:
        self.plan, self.folder, self.log, self.origin = plan, folder, log, origin
        self.on_event, self.executor = on_event, executor
        #: What is stored, which grows.
        self.stock = stock
        self.computed = self.done = self.total = self.failures = self.given_up = 0
        self.hindrance = ""
        self.culprits: tuple[str, ...] = ()
        self.precision: tuple[CellPrecision, ...] = ()
        self.started = now()
        self._lay_out()

    def _lay_out(self) -> None:
        """Where the estimates of the plan belong, and what there is to compute."""
        self.manifest = self.plan.manifest()
        self.planned = KeySet.planned(self.manifest)
        self.cells: dict[str, list[Mapping[str, Any]]] = defaultdict(list)
        self.estimators: dict[str, list[Mapping[str, Any]]] = defaultdict(list)
        for parts, known in ((self.manifest["data_cells"], self.cells), (self.manifest["estimators"], self.estimators)):
            for part in parts:
                known[part["hash"]].append(part)
        ready = _ready(self.plan, self.folder, self.stock)
        # What this run has computed by now was not there when it began.
        estimates, reused = ready.estimates + self.computed, ready.reused - self.computed
        self.ready = replace(ready, estimates=estimates, reused=reused)
        self.todo = Todo(self.plan, self.stock)
        self.total += self.todo.data_sets

    def start(self, circumstances: dict[str, Any]) -> None:
        spec = self.plan.spec
        canonical = canonical_text(spec.canonical())
        with _writing(self.folder):
            for name, text in ((place.SPEC, spec.text), (place.CANONICAL, canonical)):
                self.log.write_beside(name, text.encode())
        info = session_info(spec.text, spec.folder) | circumstances
        self.session = self.log.begin(self.manifest, self.origin, self.started, info)
        self._announce()
        self.on_event(self.ready)

    def needs_more(self) -> bool:
        """Whether the finished block leaves data cells that are not known well enough; plan their next one."""
        self.precision = stored_precisions(self.manifest, self.log)
        needed = tuple(cell.needed for cell in self.precision)
        if needed in ((), self.plan.replicates):
            return False
        self.plan = self.plan.with_replicates(needed)
        self._lay_out()
        self.log.replan(self.manifest)
        self.on_event(events.BlockDone(self.total, self.precision))
        return True

    def compute(self, stopping: StopRequest) -> None:
        self.unfinished: dict[tuple[str, int], int] = {}
        batch: list[Outcome] = []
        since = time.monotonic()
        told = False
        try:
            for item in run_jobs(self._handed_out(), self.executor, stopping):
                if stopping() and not told:
                    told = True
                    self.on_event(events.Stopping(stopping.reason or ""))
                if isinstance(item, Computed):
                    batch += item.outcomes
                elif item is not None:
                    self._note(item, stopping)
                late = time.monotonic() - since >= COMMIT_SECONDS
                if batch and (late or len(batch) >= COMMIT_ESTIMATES):
                    self._commit(batch)
                    batch = []
                    if self.failures >= (stopping.at.failures or math.inf):
                        stopping.ask(TOO_MANY_FAILURES)
                if late:
                    since = time.monotonic()
            if batch:
                self._commit(batch)
        except BaseException:
            self.executor.stop()
            raise

    def _handed_out(self) -> Iterator[Job]:
        for job in self.todo.jobs():
            self.unfinished[job.cell.hash, job.replicate] = len(job.wanted)
            yield job

    def _slots(self, key: Key) -> Iterator[Slot]:
        """Where an estimate belongs: two names of the same estimator share it."""
        for estimator in self.estimators[key.estimator_hash]:
            for cell in self.cells[key.data_hash]:
                if key.start in estimator["starts"] and key.replicate < cell["replicates"]:
                    yield Slot(key, cell, estimator)

    def _note(self, item: events.WorkerDied | GivenUp | Slow | Unable, stopping: StopRequest) -> None:
        """Take note of what is not a result."""
        match item:
            case events.WorkerDied():
                self.on_event(item)
            case GivenUp():
                self.given_up += len(item.keys)
                self.hindrance = item.reason
                names = tuple(f"{self._name(key)} on replicate {key.replicate}" for key in item.keys)
                self.culprits = (self.culprits + names)[:CULPRITS]
                self.on_event(events.GivenUp(names, item.reason))
            case Slow():
                self.on_event(events.Slow(item.key.id, self._name(item.key), item.key.replicate, item.seconds))
            case Unable():
                self.hindrance = item.reason
                stopping.ask(MACHINE)

    def _name(self, key: Key) -> str:
        return str(next(self._slots(key)).estimator["name"])

    def _commit(self, batch: Sequence[Outcome]) -> None:
        self.log.add(batch, self.session)
        for outcome in batch:
            self.stock.note(outcome.key, outcome.result["status"])
        self.failures += sum(outcome.result["status"] in FAILURES for outcome in batch)
        for data_set, found in groupby(batch, key=lambda outcome: outcome.key[:2]):
            outcomes = list(found)
            self.unfinished[data_set] -= len(outcomes)
            if not self.unfinished[data_set]:
                del self.unfinished[data_set]
                self.done += 1
            self.computed += len(outcomes)
            rows = tuple(
                assemble(slot, self.manifest, outcome.result, outcome.seconds, outcome.cpu_seconds)
                for outcome in outcomes
                for slot in self._slots(outcome.key)
            )
            self.on_event(events.EstimatesDone(self.done, self.total, rows))
        self._announce()

    def _announce(self) -> None:
        place.announce(self.folder, self.plan.experiment, self.started, self.done, self.total)

    def finish(self, reason: str | None, moved: Path | None, begun: float) -> RunSummary:
        self.on_event(events.Sealed(self.folder / EXPORT, *seal(self.folder, self.log)))
        failed = self.planned.count_in(self.stock.failed)
        missing = self.ready.estimates - self.computed
        reason = reason or (MACHINE if self.given_up else None)
        stopped, ended = now(), "finished" if not missing else reason or "unfinished"
        counts = {
            "planned": len(self.planned),
            "reused": self.ready.reused,
            "computed": self.computed,
            "failed": failed,
        }
        self.log.end(self.session, stopped, ended)
        return RunSummary(
            experiment=self.plan.experiment,
            folder=self.folder,
            **counts,
            left_aside=self.ready.left_aside,
            mixed=len(self.log.origins()) > 1,
            moved_aside=moved,
            seconds=time.monotonic() - begun,
            stopped_by=reason if missing else None,
            precision=self.precision,
            given_up=self.given_up,
            hindrance=self.hindrance,
            culprits=self.culprits,
        )


def preview(
    plan: Plan, folder: Path, *, fresh: bool = False, allow_mixed: bool = False, retry: Collection[str] = ()
) -> events.PlanReady:
    """What a run would do, without doing or writing anything."""
    found = _look(plan, folder, current_origin(plan), retry, fresh=fresh, allow_mixed=allow_mixed)
    needed = found.plan
    if len(found.stock.keys):
        return _ready(needed, folder, found.stock)
    # Of a million data sets, counting is quicker than naming.
    counts = (needed.data_sets, needed.data_sets * needed.distinct_each, 0, 0)
    return events.PlanReady(plan.experiment, folder, *counts, at_most=plan.monte_carlo.get("at_most"))


def _ready(plan: Plan, folder: Path, stock: Stock) -> events.PlanReady:
    """What there is to do, in numbers."""
    planned = KeySet.planned(plan.manifest())
    stored, again = planned.count_in(stock.keys), planned.count_in(stock.again)
    reused = stored - again
    counts = (Todo(plan, stock).data_sets, len(planned) - reused, reused, len(stock.keys) - stored)
    at_most = plan.monte_carlo.get("at_most")
    return events.PlanReady(plan.experiment, folder, *counts, at_most=at_most, again=again)


@dataclass(frozen=True)
class _Found:
    """A plan as far as it is decided by what is stored, and that."""

    plan: Plan
    stock: Stock
    #: State of the journal that tells it.
    state: str | None = None


def _look(
    plan: Plan,
    folder: Path,
    origin: Origin,
    retry: Collection[str],
    *,
    fresh: bool,
    allow_mixed: bool,
) -> _Found:
    """What there is in a folder that a plan may be run into."""
    if fresh or not folder.exists():
        return _Found(plan, Stock())
    with place.lock(folder, shared=True):
        place.check_free(folder, plan.manifest(), origin, allow_mixed=allow_mixed)
        with place.reading_journal(folder) as log:
            if log is None:
                return _Found(plan, Stock())
            stock = take_stock(log, retry, Limits.of(plan.spec.canonical()))
            return _Found(as_needed(plan, log), stock, log.state())


def _check_first_records(todo: Todo) -> None:
    """Refuse a plan whose first data sets no estimator can use, before anything is written.

    One record in a thousand that cannot be used is a result; the very first one is a mistake in the specification.
    """
    for job in itertools.takewhile(lambda job: not job.replicate, todo.jobs()):
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                data = job.cell.dataset(job.replicate)
                for estimator in {id(cell): cell for _, cell, _ in job.wanted}.values():
                    estimator.estimator.prepare(data.record)
        except DataError:
            raise
        except Exception:
            # Any other failure is for the worker to record, with its place in the code.
            continue


def _compile_kernels(plan: Plan) -> float:
    from ctid_cli.estimation.compilation import compile_kernels
    from ctid_cli.signals.sampling import RegularSampling
    from ctid_cli.simulation.components import CustomEstimation
    from ctid_cli.simulation.frequency_measures import FrequencyEstimation, SignalSource

    source = plan.data_cells[0].source
    if not isinstance(source, SignalSource):
        ours = [cell.estimator for cell in plan.estimators if not isinstance(cell.estimator, CustomEstimation)]
        clocks = [
            (getattr(cell.source, "sampling", None), getattr(cell.source, "loop", None)) for cell in plan.data_cells
        ]
        # A clock that is not known before the data are read is taken as regular.
        kinds = {(isinstance(clock, RegularSampling | None), loop is not None) for clock, loop in clocks}
        return sum(compile_kernels(ours, regular=regular, closed=closed) for regular, closed in sorted(kinds))
    begun = time.perf_counter()
    for cell in plan.estimators:
        if isinstance(cell.estimator, FrequencyEstimation):
            cell.estimator.compile(source.sampling.interval)
    return time.perf_counter() - begun


@contextmanager
def _writing(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        reason = error.strerror or error
        raise StorageError(f"{folder} cannot be written ({reason}); stored estimates are untouched") from error
