"""Progress of a run on the terminal: a bar, or occasional lines in log files."""

from __future__ import annotations

import sys
import threading
import time
from typing import TYPE_CHECKING, Any, Self

import typer

from ctid_cli.reporting.layout import rate, seconds
from ctid_cli.text import count

if TYPE_CHECKING:
    from rich.progress import Progress, ProgressColumn, TaskID

    from ctid_cli.running.engine import Progress as RunProgress

#: Seconds between two lines if stderr is not a terminal.
LINE_EVERY = 10.0
#: Seconds before the bar of a single record appears: most finish sooner.
BAR_AFTER = 1.0
#: Seconds before a fit shows its elapsed time.
TIME_AFTER = 2.0


class _Progress:
    """A bar on stderr, once it is started."""

    def __init__(self, name: str) -> None:
        self.name = name
        self._began = self._last = time.monotonic()
        self._bar: Progress | None = None
        self._task: TaskID | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def _start(self, total: int, *columns: ProgressColumn, **fields: Any) -> None:
        from rich.progress import BarColumn, TextColumn, TimeRemainingColumn

        shown = (TextColumn("{task.description}"), BarColumn(bar_width=20), *columns, TimeRemainingColumn())
        self._show(self.name.rpartition("/")[2], *shown, total=total, **fields)

    def _show(self, text: str, *columns: ProgressColumn, transient: bool = False, **fields: Any) -> None:
        from rich.console import Console
        from rich.progress import Progress

        self._bar = Progress(*columns, console=Console(stderr=True), transient=transient)
        self._task = self._bar.add_task(text, **fields)
        self._bar.start()

    def _update(self, done: int, **fields: Any) -> None:
        """Move the bar, if there is one."""
        if self._bar is not None and self._task is not None:
            self._bar.update(self._task, completed=done, **fields)

    def _is_time(self) -> bool:
        """Return whether a line is due if no bar is drawn."""
        return self._bar is None and time.monotonic() - self._last >= LINE_EVERY

    def _say(self, text: str) -> None:
        self._last = time.monotonic()
        line = f"{self.name}: {text}"
        if self._bar is not None:
            self._bar.console.print(line, markup=False, highlight=False)
        else:
            typer.echo(line, err=True)


class RecordProgress(_Progress):
    """Progress over a record, or over draws of its noise; nothing is shown if it finishes at once."""

    def __init__(self, name: str, what: str = "the record") -> None:
        super().__init__(name)
        self.what = what

    def __call__(self, done: int, total: int) -> None:
        """Show the number of samples done."""
        if sys.stderr.isatty():
            if self._bar is None and time.monotonic() - self._began > BAR_AFTER:
                from rich.progress import TaskProgressColumn

                self._start(total, TaskProgressColumn())
            self._update(done)
        elif self._is_time():
            self._say(f"{100 * done / total:.0f} % of {self.what} done")


class FitProgress(RecordProgress):
    """Elapsed time of a fit, on a terminal and if it takes long; then the draws of a bootstrap."""

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
        """Show the number of draws done."""
        if done == 1:
            self._stop_time()
        super().__call__(done, total)

    def _show_time(self) -> None:
        from rich.progress import SpinnerColumn, TextColumn, TimeElapsedColumn

        shown = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
        self._show(self._fitting, *shown, transient=True)

    def _stop_time(self) -> None:
        self._timer.cancel()
        if self._timer.ident is not None:
            self._timer.join()
        super().__exit__()
        self._bar = None


class Reporter(_Progress):
    """Shows the progress of one run on stderr."""

    def __init__(self, name: str, *, quiet: bool = False) -> None:
        super().__init__(name)
        self._quiet = quiet
        #: The first message marks the start of the run.
        self._ready = False

    def __call__(self, progress: RunProgress) -> None:
        """Show the progress of the run."""
        if self._quiet:
            return
        if progress.message:
            self._say(progress.message)
        if progress.precision:
            from ctid_cli.reporting.status_result import block_sentence

            self._say(block_sentence(progress.precision))
        if not self._ready:
            self._begin(progress.total)
        elif progress.stored:
            self._advance(progress)
        else:
            self._update(progress.done, total=progress.total)

    def _begin(self, total: int) -> None:
        self._ready = True
        self._began = self._last
        if total and sys.stderr.isatty():
            from rich.progress import MofNCompleteColumn, TextColumn

            rate = TextColumn("data sets, {task.fields[rate]}, {task.fields[failed]} failed, ETA")
            self._start(total, MofNCompleteColumn(), rate, rate="-", failed=0)

    def _advance(self, progress: RunProgress) -> None:
        done, total, failed = progress.done, progress.total, progress.failed
        speed = done / max(time.monotonic() - self._began, 1e-9)
        self._update(done, total=total, rate=rate(speed), failed=failed)
        if self._is_time() or (self._bar is None and done == total):
            left = f", ETA {seconds((total - done) / speed)}" if 0 < done < total else ""
            self._say(f"{done}/{total} data sets, {rate(speed)}, {failed} failed{left}")
