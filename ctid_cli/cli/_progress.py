"""Progress of a command on stderr, and its end by Ctrl-C."""

from __future__ import annotations

import os
import select
import shutil
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from types import TracebackType
from typing import TYPE_CHECKING, Any, ClassVar, NoReturn, Self

import typer

from ctid_cli import written_files
from ctid_cli.errors import ExitCode
from ctid_cli.progress import Steps, listening, report
from ctid_cli.reporting.layout import rate, seconds
from ctid_cli.text import listed

if TYPE_CHECKING:
    from ctid_cli.running.engine import Progress as RunProgress

#: Seconds without output after which a command shows what it does, and between two lines if stderr is no terminal.
SILENT, LINE_EVERY = 2.0, 10.0
#: Seconds between two updates of the status line.
REDRAWN = 0.25
#: Seconds from Ctrl-C to the end of a command that does not react, such as compiled code.
PATIENCE = 0.6
COMPILING = "compiling numerical routines, once after an installation or an update"
#: What a command does before the first step: it loads modules.
STARTING = "starting"
#: Commands that store results as they come.
STORING = ("run", "reproduce", "merge")


class Display:
    """The steps in progress on stderr: a status line on a terminal, otherwise occasional lines."""

    def __init__(self, name: str, steps: Steps) -> None:
        self._name, self._steps, self._stream = name, steps, sys.stderr
        # There is no stream if the caller has closed it.
        self._live = self._stream is not None and self._stream.isatty() and os.environ.get("TERM") != "dumb"
        self._begun = time.monotonic()
        self._due = self._begun + SILENT
        self._shown, self._started = "", False
        self._lock = threading.RLock()

    def tick(self, now: float) -> None:
        """Show what is done, if it is time."""
        text = _what(self._steps)
        self._started |= bool(text)
        if now < self._due:
            return
        text = text or ("computing" if self._started else STARTING)
        passed = f" ({seconds(now - self._begun)})"
        with self._lock:
            if self._live:
                if not isinstance(sys.stderr, _Clearing):
                    sys.stdout, sys.stderr = _Clearing(sys.stdout, self), _Clearing(sys.stderr, self)
                line = f"{self._name}: {text}"
                width = shutil.get_terminal_size().columns - len(passed) - 1
                line = line if len(line) <= width else f"{line[: width - 1]}…"
                self._shown = line
                self._put(f"\r{line}{passed}\x1b[K")
            elif text != self._shown:
                self._shown, self._due = text, now + (SILENT if text == STARTING else LINE_EVERY)
                self._put(f"{self._name}: {text}{passed}\n")

    def clear(self) -> None:
        """Remove the status line for other output."""
        with self._lock:
            if self._live and self._shown:
                self._put("\r\x1b[K")
                self._shown, self._due = "", time.monotonic() + SILENT

    def postpone(self) -> None:
        """Count the time without output from now on."""
        self._due = time.monotonic() + SILENT

    def close(self) -> None:
        """Remove the status line for good."""
        self.clear()
        if isinstance(sys.stdout, _Clearing) and isinstance(sys.stderr, _Clearing):
            sys.stdout, sys.stderr = sys.stdout.stream, sys.stderr.stream

    def _put(self, text: str) -> None:
        with suppress(OSError, ValueError, AttributeError):
            self._stream.write(text)
            self._stream.flush()


class _Clearing:
    """A standard stream; the status line is removed before anything is written."""

    def __init__(self, stream: Any, display: Display) -> None:
        self.stream, self._display = stream, display

    def write(self, text: str) -> int:
        self._display.clear()
        return int(self.stream.write(text))

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


def _what(steps: Steps) -> str:
    """Return what is done, as text."""
    # Numba, if it is imported, compiles within this lock.
    compiler = sys.modules.get("numba.core.compiler_lock")
    lock = getattr(compiler, "global_compiler_lock", None)
    return COMPILING if lock is not None and lock.is_locked() else str(steps)


class Watch:
    """A thread that shows what a command does, and ends the command after Ctrl-C if it does not react.

    Python handles signals between two instructions of the main thread, which may be seconds apart in compiled code;
    some libraries turn the interruption into another error, or lose it.
    """

    current: ClassVar[Watch | None] = None
    #: Whether this process runs the command only, and may be ended.
    owns_process: ClassVar[bool] = False

    def __init__(self, command: str, *, quiet: bool = False) -> None:
        self._command, self._quiet = command, quiet
        self._stack = ExitStack()
        self._ends = float("inf")
        self._ending = threading.Lock()
        self.interrupted = False

    def __enter__(self) -> Self:
        Watch.current, self._before = self, Watch.current
        written_files.written.clear()
        self.display = Display(f"ctid {self._command}", self._stack.enter_context(listening()))
        self._stack.callback(self.display.close)
        self._wake, self._woken = os.pipe()
        os.set_blocking(self._woken, False)
        self._thread = threading.Thread(target=self._watch, name="ctid-progress", daemon=True)
        self._thread.start()
        self._stack.callback(self._stop)
        # A process in the background of a script ignores SIGINT.
        if self.owns_process and signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
            self._stack.callback(signal.set_wakeup_fd, signal.set_wakeup_fd(self._woken, warn_on_full_buffer=False))
            self._stack.callback(signal.signal, signal.SIGINT, signal.signal(signal.SIGINT, self._interrupt))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        Watch.current = self._before
        if self.interrupted and isinstance(error, KeyboardInterrupt):
            self._end()
        self._stack.close()
        if isinstance(error, KeyboardInterrupt):
            typer.echo(self._sentence(), err=True)
            raise typer.Exit(ExitCode.INTERRUPTED) from None

    def _interrupt(self, number: int, frame: Any) -> NoReturn:
        self.interrupted = True
        # In a callback from C, Python would print the error that it drops.
        sys.unraisablehook = lambda unraisable: None
        raise KeyboardInterrupt

    def _stop(self) -> None:
        os.write(self._woken, b"\0")
        self._thread.join()
        os.close(self._wake)
        os.close(self._woken)

    def _watch(self) -> None:
        """Show progress until the command ends."""
        while True:
            wait = min(REDRAWN, max(self._ends - time.monotonic(), 0.0))
            if select.select([self._wake], [], [], wait)[0]:
                received = os.read(self._wake, 512)
                if 0 in received:
                    return
                if signal.SIGINT in received and signal.getsignal(signal.SIGINT) == self._interrupt:
                    self._ends = min(self._ends, time.monotonic() + PATIENCE)
            if time.monotonic() >= self._ends:
                self._end()
            if not self._quiet and self._ends == float("inf"):
                self.display.tick(time.monotonic())

    def _end(self) -> NoReturn:
        """End the process at once: the end of the interpreter may take a second."""
        self._ending.acquire()
        written_files.remove_unfinished()
        self.display.clear()
        os.write(2, f"{self._sentence()}\n".encode())
        os._exit(ExitCode.INTERRUPTED)

    def _sentence(self) -> str:
        """Return what was interrupted, and what remains."""
        if self._command in STORING:
            return "ctid: interrupted; what was stored is complete, and the same command continues"
        names = listed(path.name for path in written_files.written) if written_files.written else "nothing"
        return f"ctid: interrupted; {names} {'were' if len(written_files.written) > 1 else 'was'} written"


@contextmanager
def interruptible() -> Iterator[None]:
    """Raise KeyboardInterrupt in place of the error that a library has made of it."""
    try:
        yield
    except Exception:
        if Watch.current is not None and Watch.current.interrupted:
            raise KeyboardInterrupt from None
        raise


class RunReport:
    """Prints the messages of a run, and reports its data sets."""

    def __init__(self, name: str, *, quiet: bool) -> None:
        self._name, self._quiet, self._begun = name, quiet, 0.0

    def __call__(self, progress: RunProgress) -> None:
        """Print and report."""
        if self._quiet:
            return
        if progress.message:
            self._say(progress.message)
        if progress.precision:
            from ctid_cli.reporting.status_result import block_sentence

            self._say(block_sentence(progress.precision))
        if not self._begun:
            # The first message marks the start of the run.
            self._begun = time.monotonic()
            return
        done, total = progress.done, progress.total
        speed = done / max(time.monotonic() - self._begun, 1e-9)
        note = f"{rate(speed)}, {progress.failed} failed"
        report("data set", done, total, f"{note}, ETA {seconds((total - done) / speed)}" if 0 < done < total else note)
        if progress.stored and done == total:
            self._say(f"{done}/{total} data sets, {note}")

    def _say(self, text: str) -> None:
        typer.echo(f"{self._name}: {text}", err=True)
