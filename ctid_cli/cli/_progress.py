"""How a run looks on the terminal: a bar for people, a line now and then for log files."""

from __future__ import annotations

import json
import re
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, Self

import typer

from ctid_cli.reporting.layout import count, rate, seconds
from ctid_cli.reporting.precision_words import block_sentence

if TYPE_CHECKING:
    from rich.progress import Progress, ProgressColumn, TaskID

    from ctid_cli.running.events import Event

#: Seconds between two lines where stderr is not a terminal.
LINE_EVERY = 10.0
#: Seconds before the bar of a single record appears: most are done sooner.
BAR_AFTER = 1.0
#: Seconds before a fit shows how long it takes.
TIME_AFTER = 2.0


class _Progress:
    """A bar on stderr, from when it is started."""

    def __init__(self, name: str, clock: Callable[[], float] = time.monotonic) -> None:
        self.name = name
        self._clock = clock
        self._began = self._last = clock()
        self._bar: Progress | None = None
        self._task: TaskID | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def _start(self, total: int, *columns: ProgressColumn, **fields: Any) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

        shown = (TextColumn("{task.description}"), BarColumn(bar_width=20), *columns, TimeRemainingColumn())
        self._bar = Progress(*shown, console=Console(stderr=True))
        self._task = self._bar.add_task(self.name.rpartition("/")[2], total=total, **fields)
        self._bar.start()

    def _update(self, done: int, **fields: Any) -> None:
        """Move the bar, if there is one."""
        if self._bar is not None and self._task is not None:
            self._bar.update(self._task, completed=done, **fields)

    def _is_time(self) -> bool:
        """Whether a line is due where no bar is drawn."""
        return self._bar is None and self._clock() - self._last >= LINE_EVERY

    def _say(self, text: str) -> None:
        self._last = self._clock()
        line = f"{self.name}: {text}"
        if self._bar is not None:
            self._bar.console.print(line, markup=False, highlight=False)
        else:
            typer.echo(line, err=True)


class RecordProgress(_Progress):
    """How far a record is done, or draws of its noise; nothing for what is done at once."""

    def __init__(self, name: str, what: str = "the record") -> None:
        super().__init__(name)
        self.what = what

    def __call__(self, done: int, total: int) -> None:
        """Show that so many of all samples are done."""
        if sys.stderr.isatty():
            if self._bar is None and self._clock() - self._began > BAR_AFTER:
                from rich.progress import TaskProgressColumn

                self._start(total, TaskProgressColumn())
            self._update(done)
        elif self._is_time():
            self._say(f"{100 * done / total:.0f} % of {self.what}")


class FitProgress(RecordProgress):
    """The time that a fit has taken, on a terminal and where it is not done at once; then the draws of a bootstrap."""

    def __init__(self, samples: int) -> None:
        super().__init__("bootstrap", "the draws")
        self._fitting = f"fitting {count(samples, 'sample')}"
        self._timer = threading.Timer(TIME_AFTER, self._show_time)

    def __enter__(self) -> Self:
        if sys.stderr.isatty():
            self._timer.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._stop_time()

    def __call__(self, done: int, total: int) -> None:
        """Show that so many of all draws are done."""
        if done == 1:
            self._stop_time()
        super().__call__(done, total)

    def _show_time(self) -> None:
        from rich.console import Console
        from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

        shown = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
        self._bar = Progress(*shown, console=Console(stderr=True), transient=True)
        self._bar.add_task(self._fitting)
        self._bar.start()

    def _stop_time(self) -> None:
        self._timer.cancel()
        if self._timer.ident is not None:
            self._timer.join()
        super().__exit__()
        self._bar = None


class Reporter(_Progress):
    """Shows the events of one run on stderr."""

    failed = done = 0

    def __call__(self, event: Event) -> None:
        """Show one event."""
        from ctid_cli.running import events

        match event:
            case events.PlanReady():
                self._plan(event)
            case events.Warned():
                self._say(f"warning: {event.text}")
            case events.EstimatesDone():
                self._advance(event)
            case events.BlockDone():
                self._say(block_sentence(event.precision))
                self._update(self.done, total=event.total)
            case events.WorkerDied():
                what = count(event.estimates, "estimate")
                self._say(f"a worker process died ({event.reason}); computing {what} once more")
            case events.Slow():
                what = f"{event.estimator} on replicate {event.replicate} has been at work for {seconds(event.seconds)}"
                self._say(f"{what}; limits.wall_seconds would end what takes longer than it says")
            case events.GivenUp():
                what = f"{count(event.estimates, 'estimate')} given up, not stored ({event.names[0]}"
                self._say(f"{what}{', …' if event.estimates > 1 else ''}): {event.reason}")
            case events.Stopping():
                self._say(f"stopping ({event.reason}): storing what is finished; once more to stop at once")

    def _plan(self, event: Any) -> None:
        parts = [f"{count(event.estimates, 'estimate')} of {count(event.data_sets, 'data set')} to compute"]
        if event.again:
            parts.append(f"{event.again} of them once more")
        if event.reused:
            parts.append(f"{event.reused} already stored")
        if event.left_aside:
            parts.append(f"{event.left_aside} stored ones set aside")
        if event.at_most is not None and event.estimates:
            parts.append(f"then in blocks until they are enough, {event.at_most} data sets of a cell at most")
        self._say(", ".join(parts))
        self._began = self._last
        if event.data_sets and sys.stderr.isatty():
            from rich.progress import MofNCompleteColumn, TextColumn

            rate = TextColumn("data sets, {task.fields[rate]}, {task.fields[failed]} failed, ETA")
            self._start(event.data_sets, MofNCompleteColumn(), rate, rate="-", failed=0)

    def _advance(self, event: Any) -> None:
        from ctid_cli.storage.columns import FAILURES

        self.done = event.done
        self.failed += sum(row["status"] in FAILURES for row in event.rows)
        speed = event.done / max(self._clock() - self._began, 1e-9)
        self._update(event.done, rate=rate(speed), failed=self.failed)
        if self._is_time() or (self._bar is None and event.done == event.total):
            left = f", ETA {seconds((event.total - event.done) / speed)}" if 0 < event.done < event.total else ""
            self._say(f"{event.done}/{event.total} data sets, {rate(speed)}, {self.failed} failed{left}")


def json_lines(event: Event) -> list[str]:
    """An event as JSON objects, one per line; a data set gives one object per estimate."""
    from ctid_cli.reporting.estimate import as_object
    from ctid_cli.running import events

    if isinstance(event, events.EstimatesDone):
        return [json.dumps({"event": "estimate", **as_object(row)}, allow_nan=False) for row in event.rows]
    # PlanReady is "plan", KernelsCompiling "kernels_compiling".
    name = re.sub("(?<=.)([A-Z])", r"_\1", type(event).__name__).lower().removesuffix("_ready")
    return [json.dumps({"event": name, **asdict(event)}, default=str, allow_nan=False)]
