"""Requests to stop: an interrupt (Ctrl-C), a termination signal, a number of failures, a budget of time."""

import signal
import threading
import time
from types import FrameType, TracebackType
from typing import Any, Self

_SIGNALS = (signal.SIGINT, signal.SIGTERM)

#: Reasons that are no signals.
TIME_BUDGET, TOO_MANY_FAILURES, MACHINE = "time budget", "failures", "machine"


class StopRequest:
    """Notices requests to stop; signals, while it is entered.

    The first signal is only noted, so that what is in work can be finished and stored. The second ends the process at
    once, as if nobody had listened; the workers end with it, and the journal is made for that.
    """

    def __init__(self, *, failures: int | None = None, seconds: float | None = None) -> None:
        """Stop after failed estimates of this run, or after some time [s]."""
        self.failures = failures
        self._deadline = None if seconds is None else time.monotonic() + seconds
        self._reason: str | None = None
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Self:
        # Python hands signals to the main thread only; elsewhere whoever owns the main thread decides.
        if threading.current_thread() is threading.main_thread():
            for number in _SIGNALS:
                self._before[number] = signal.signal(number, self._note)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.ask(signal.Signals(number).name)
        for each in _SIGNALS:
            signal.signal(each, signal.SIG_DFL)

    def ask(self, reason: str) -> None:
        """Ask for a stop; the first reason counts."""
        self._reason = self._reason or reason

    def __call__(self) -> bool:
        """Return whether a stop was asked for."""
        return self.reason is not None

    @property
    def reason(self) -> str | None:
        """Name of the signal, another reason, or None."""
        if self._deadline is not None and time.monotonic() > self._deadline:
            self.ask(TIME_BUDGET)
        return self._reason
