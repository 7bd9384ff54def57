"""Work that may crash or never end, in a process of its own: libraries in C do not survive every damaged file."""

import faulthandler
import multiprocessing
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from ctid_cli.temporary import TemporaryFolder


@contextmanager
def done_apart(work: Callable[[Path], None], patience: float) -> Iterator[Path | None]:
    """The folder that the work has written its answer to; None if it crashed, or took longer than this [s]."""
    with TemporaryFolder() as folder, warnings.catch_warnings():
        # The process does nothing but this, so that threads of others do not matter.
        warnings.simplefilter("ignore", DeprecationWarning)
        process = multiprocessing.get_context("fork").Process(target=_quietly, args=(work, folder))
        process.start()
        process.join(patience)
        if process.is_alive():
            process.kill()
            process.join()
        yield folder if process.exitcode == 0 else None


def _quietly(work: Callable[[Path], None], folder: Path) -> None:
    # That it crashes is expected, and nothing to tell.
    faulthandler.disable()
    work(folder)
