"""Text of messages, used in every layer: lists, paragraphs, and suggestions for misspelt names."""

import difflib
import os
import textwrap
from collections.abc import Iterable, Sequence
from importlib import import_module
from typing import Any

#: Columns of a paragraph.
WIDTH = 100


def listed(words: Iterable[object]) -> str:
    """Return words as a list in a sentence: ``a, b and c``, without duplicates."""
    *first, end = dict.fromkeys(map(str, words))
    return f"{', '.join(first)} and {end}" if first else end


def span(values: Sequence[float], digits: int) -> str:
    """Return the least and the largest of several values, as ``1.96 to 2.1``."""
    low, high = (f"{value:.{digits}g}" for value in (min(values), max(values)))
    return low if low == high else f"{low} to {high}"


def count(n: int, noun: str) -> str:
    """Return a number with a noun in singular or plural."""
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


def probability(p: float) -> str:
    """Return a p-value as text: a bound if it is tiny, a dash if it is missing."""
    if p != p:
        return "p = -"
    return f"p = {p:.2g}" if p >= 1e-4 else "p < 0.0001"


def wrapped(text: str, indent: str = "", hanging: str | None = None, width: int = WIDTH) -> str:
    """Return a paragraph wrapped to a width, optionally with another indent after the first line."""
    return textwrap.fill(
        text,
        width,
        initial_indent=indent,
        subsequent_indent=indent if hanging is None else hanging,
        break_long_words=False,
        break_on_hyphens=False,
    )


def closest(word: str, known: Iterable[str]) -> str | None:
    """Return the known name closest to a word, ignoring case."""
    names = {name.lower(): name for name in reversed(list(known))}
    near = difflib.get_close_matches(word.lower(), list(names), n=1)
    return names[near[0]] if near else None


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Return a suggestion of the closest known name as the end of a sentence; empty if no name is close."""
    near = closest(word, known)
    return f"; did you mean {near!r}?" if near else ""


class Shown:
    """A result with a text summary, a pandas table, a figure, and a notebook display."""

    def summary(self) -> str:
        """Return the result as text: the tables that the commands print."""
        return str(self._result().summary())

    def to_frame(self) -> Any:
        """Return the main table of the result as a DataFrame: parameters of a fit, instants of a track."""
        return self._result().to_frame()

    def plot(self, path: str | os.PathLike[str] | None = None) -> Any:
        """Return the main figure of the result as a Matplotlib figure, saved to a file if one is named."""
        figure = self._result().plot()
        if path is not None:
            figure.savefig(path)
        return figure

    def _result(self) -> Any:
        # Imported by name: results do not depend on the reporting layer.
        return import_module("ctid_cli.reporting.result_views").result_of(self)

    def _repr_html_(self) -> str:
        return str(self._result().write("html"))
