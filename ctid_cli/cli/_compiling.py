"""Notice on stderr while numerical routines are compiled."""

import threading
import time
from typing import Any

import typer
from numba.core import event

#: Total time of compilation from which it is announced [s].
SILENT = 2.0
ANNOUNCEMENT = "ctid: compiling numerical routines, up to 20 s; each once after an installation or an update"


class CompilationNotice(event.Listener):
    """Announces compilation, once, when it takes long; loading from the cache on disk causes no event."""

    def __init__(self) -> None:
        self._left = SILENT
        self._depth = 0
        self._began = 0.0
        self._timer: threading.Timer | None = None
        self._announced = False

    def on_start(self, event: Any) -> None:
        """Start to measure; functions called by a compiled one are not counted twice."""
        # Numba's lock is held here and at the end: only one thread compiles at a time.
        self._depth += 1
        if self._depth == 1 and not self._announced:
            self._began = time.monotonic()
            self._timer = threading.Timer(max(self._left, 0.0), self._announce)
            self._timer.daemon = True
            self._timer.start()

    def on_end(self, event: Any) -> None:
        """Add the time of a function."""
        self._depth -= 1
        if self._depth == 0 and self._timer is not None:
            self._timer.cancel()
            self._timer.join()
            self._timer = None
            self._left -= time.monotonic() - self._began

    def _announce(self) -> None:
        self._announced = True
        typer.echo(ANNOUNCEMENT, err=True)
