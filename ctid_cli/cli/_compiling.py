"""One sentence on stderr while numerical routines are compiled."""

import threading
import time
from typing import Any

import typer
from numba.core import event

#: Compilation that takes longer than this in all is announced [s].
SILENT = 2.0
ANNOUNCEMENT = "ctid: compiling numerical routines, up to 20 s; this happens once after an installation or an update"


class CompilationNotice(event.Listener):
    """Announces compilation, once, when it has taken some time; what is loaded from the cache on disk is no event."""

    def __init__(self) -> None:
        self._left = SILENT
        self._depth = 0
        self._began = 0.0
        self._timer: threading.Timer | None = None
        self._announced = False

    def on_start(self, event: Any) -> None:
        """Begin to wait; of the functions that a compiled one calls nothing is counted twice."""
        # Under Numba's lock, as is the end: of all threads only one compiles.
        self._depth += 1
        if self._depth == 1 and not self._announced:
            self._began = time.monotonic()
            self._timer = threading.Timer(max(self._left, 0.0), self._announce)
            self._timer.daemon = True
            self._timer.start()

    def on_end(self, event: Any) -> None:
        """Count the time that a function has taken."""
        self._depth -= 1
        if self._depth == 0 and self._timer is not None:
            self._timer.cancel()
            self._timer.join()
            self._timer = None
            self._left -= time.monotonic() - self._began

    def _announce(self) -> None:
        self._announced = True
        typer.echo(ANNOUNCEMENT, err=True)
