"""Number of usable processors, parallel execution of compiled kernels on them, and one thread for linear algebra."""

import os
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, ContextDecorator
from threading import Lock
from typing import TYPE_CHECKING, Self, TypeVar

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController

Piece = TypeVar("Piece")
Result = TypeVar("Result")


def usable_processors() -> int:
    """Return the number of processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def in_threads(work: Callable[[Piece], Result], pieces: Sequence[Piece]) -> list[Result]:
    """Apply a function to each piece and return the results in order; work that releases the GIL runs in parallel."""
    threads = min(usable_processors(), len(pieces))
    if threads < 2:
        return [work(piece) for piece in pieces]
    from concurrent.futures import ThreadPoolExecutor

    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(work, pieces))


class _OneThread(ContextDecorator):
    """Holds linear algebra to one thread while any thread of the process is inside; also a decorator.

    The matrices of a search are small: the threads of a library of linear algebra would only wait for each other. The
    number of threads is that of the process, so it is restored when the last thread leaves.
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self._inside = 0
        self._controller: ThreadpoolController | None = None
        self._limit: AbstractContextManager[object] | None = None

    def __enter__(self) -> Self:
        with self._lock:
            if self._inside == 0:
                self._limit = self._found().limit(limits=1, user_api="blas")
            self._inside += 1
        return self

    def __exit__(self, *error: object) -> None:
        with self._lock:
            self._inside -= 1
            if self._inside == 0 and self._limit is not None:
                from threadpoolctl import OpenBLASController

                # Only the thread that has set the number could change it again, and another one may be the last.
                OpenBLASController.clear_controlling_thread(force=True)
                self._limit.__exit__(None, None, None)
                self._limit = None

    def _found(self) -> "ThreadpoolController":
        """Return the controller of the libraries that NumPy and SciPy have loaded; searching for them takes 30 ms."""
        if self._controller is None:
            import scipy.linalg  # noqa: F401  it loads a library of its own
            from threadpoolctl import ThreadpoolController

            self._controller = ThreadpoolController()
        return self._controller


#: ``with one_thread:`` or ``@one_thread``; nested and simultaneous uses count as one.
one_thread = _OneThread()
