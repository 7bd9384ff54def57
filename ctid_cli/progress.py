"""Progress of computations: the steps that are in progress, reported to listeners.

Computations report their steps; without a listener that costs a fraction of a microsecond. To see them from Python:

>>> from ctid_cli.progress import listening, report
>>> with listening(print):
...     report("structure", 5, 12)
structure 5 of 12
"""

from collections.abc import Callable, Collection, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from contextvars import ContextVar
from functools import wraps
from typing import NamedTuple, ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")


class Step(NamedTuple):
    """A step in progress: what is done, with its number and the number of all such steps if there are several."""

    what: str
    number: int = 0
    total: int = 0
    #: Details of the step; they are no reason for a new one.
    note: str = ""

    def __str__(self) -> str:
        text = f"{self.what} {self.number} of {self.total}" if self.total else self.what
        return ", ".join(filter(None, (text, self.note)))


class Steps:
    """The steps in progress, outermost first."""

    def __init__(self) -> None:
        self.steps: list[Step] = []
        self.listeners: list[Callable[[Steps], object]] = []
        #: Number of steps outside of the innermost `doing`, which reports inside of it leave as they are.
        self._outside = 0

    def __str__(self) -> str:
        # The list may be changed by another thread.
        texts = [text for text in map(str, [*self.steps]) if text]
        return ": ".join(filter(None, (*texts[:1], ", ".join(texts[1:]))))

    def report(self, step: Step) -> None:
        """Put a step in the place of the former one of this kind, and of those within it."""
        kept = self._outside
        while kept < len(self.steps) and self.steps[kept].what != step.what:
            kept += 1
        self.steps[kept:] = [step]
        self._notify()

    def _notify(self) -> None:
        for listener in self.listeners:
            listener(self)

    @contextmanager
    def doing(self, what: str) -> Iterator[None]:
        """Add a step, and remove it with all that are within it."""
        before, outside = self._outside, len(self.steps)
        self.steps.append(Step(what))
        self._outside = outside + 1
        try:
            if what:
                self._notify()
            yield
        finally:
            del self.steps[outside:]
            self._outside = before


_heard: ContextVar[Steps | None] = ContextVar("heard", default=None)


@contextmanager
def listening(*listeners: Callable[[Steps], object]) -> Iterator[Steps]:
    """Call functions with the steps in progress, whose string says what is done, after each change; yield the steps."""
    steps = _heard.get() or Steps()
    token = _heard.set(steps)
    before, steps.listeners = steps.listeners, [*steps.listeners, *listeners]
    try:
        yield steps
    finally:
        steps.listeners = before
        _heard.reset(token)


def calling(function: Callable[[int, int], object] | None, what: str) -> AbstractContextManager[object]:
    """Call a function, unless it is None, with the number and the total of each reported step of one kind."""
    if function is None:
        return nullcontext()

    def listener(steps: Steps) -> None:
        last = steps.steps[-1]
        if last.what == what:
            function(last.number, last.total)

    return listening(listener)


def report(what: str, number: int = 0, total: int = 0, note: str = "") -> None:
    """Report a step, which ends with the next one of its kind, or with the step around it."""
    steps = _heard.get()
    if steps is not None:
        steps.report(Step(what, number, total, note))


def doing(what: str) -> AbstractContextManager[None]:
    """Report a step that lasts as long as the context; without a text it only ends the steps within it."""
    steps = _heard.get()
    return nullcontext() if steps is None else steps.doing(what)


def reported(what: str) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """Report the calls of a function as a step."""

    def decorated(function: Callable[P, T]) -> Callable[P, T]:
        @wraps(function)
        def wrapper(*given: P.args, **named: P.kwargs) -> T:
            with doing(what):
                return function(*given, **named)

        return wrapper

    return decorated


def each(what: str, items: Collection[T]) -> Iterator[T]:
    """Yield items, and report each as a step."""
    with doing(""):
        for number, item in enumerate(items, 1):
            report(what, number, len(items))
            yield item
