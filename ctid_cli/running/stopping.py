"""Requests to stop: an interrupt (Ctrl-C), a termination signal, or an event set by the caller."""

import os
import signal
import threading
from types import FrameType, TracebackType
from typing import Any, Self

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class StopRequest:
    """Notices requests to stop while it is entered.

    The first signal is only noted, so that what is finished can be stored. The second ends the process at once, as if
    nobody had listened; the workers end with it, and the journal is made for that.
    """

    def __init__(self, event: threading.Event | None = None) -> None:
        self._event = event
        self._signal: signal.Signals | None = None
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
        if self._signal is None:
            self._signal = signal.Signals(number)
            return
        signal.signal(number, signal.SIG_DFL)
        os.kill(os.getpid(), number)

    def __call__(self) -> bool:
        """Whether a stop was asked for."""
        return self._signal is not None or (self._event is not None and self._event.is_set())

    @property
    def reason(self) -> str | None:
        """Name of the signal, ``"stop"`` for the caller's event, or None."""
        if self._signal is not None:
            return self._signal.name
        return "stop" if self() else None
