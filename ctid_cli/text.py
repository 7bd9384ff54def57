"""How messages are put together, in every layer: enumerations, paragraphs, hints at names that are nearly right."""

import difflib
import os
import textwrap
from collections.abc import Iterable
from importlib import import_module
from typing import Any

#: Columns of a paragraph.
WIDTH = 100


def listed(words: Iterable[object]) -> str:
    """Return words as a sentence lists them: ``a, b and c``, each once."""
    *first, end = dict.fromkeys(map(str, words))
    return f"{', '.join(first)} and {end}" if first else end


def count(n: int, noun: str) -> str:
    """A number of things."""
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


def probability(p: float) -> str:
    """A p-value: of a tiny one the digits mean nothing, and of none there is a dash."""
    if p != p:
        return "p = -"
    return f"p = {p:.2g}" if p >= 1e-4 else "p < 0.0001"


def wrapped(text: str, indent: str = "", hanging: str | None = None, width: int = WIDTH) -> str:
    """Return a paragraph, with another indent for all lines but the first if one is given."""
    return textwrap.fill(
        text,
        width,
        initial_indent=indent,
        subsequent_indent=indent if hanging is None else hanging,
        break_long_words=False,
        break_on_hyphens=False,
    )


def closest(word: str, known: Iterable[str]) -> str | None:
    """Return the known name that was probably meant, whatever its capitals."""
    names = {name.lower(): name for name in reversed(list(known))}
    near = difflib.get_close_matches(word.lower(), list(names), n=1)
    return names[near[0]] if near else None


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Return the end of a sentence that asks for the known name that was probably meant; empty where none is near."""
    near = closest(word, known)
    return f"; did you mean {near!r}?" if near else ""


class Shown:
    """A result that shows itself: as text, as a table of pandas, as a figure, and in a notebook."""

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
        # By name: results know nothing of the layer that shows them.
        return import_module("ctid_cli.reporting.result_views").result_of(self)

    def _repr_html_(self) -> str:
        return str(self._result().write("html"))
