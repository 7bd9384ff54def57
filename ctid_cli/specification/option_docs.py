"""What the docstring of an option dataclass says about each option: the one source of schema, help and messages."""

from __future__ import annotations

import inspect
import re
from dataclasses import dataclass


@dataclass(frozen=True)
class OptionDoc:
    """The text about an option in the section Parameters of a class."""

    text: str = ""

    @property
    def unit(self) -> str:
        """The first unit in square brackets; none for a number without a unit."""
        found = re.search(r"\[([^\]]+)\]", self.text)
        return "" if found is None or found[1] == "-" else found[1]


def option_docs(target: type) -> dict[str, OptionDoc]:
    """The text about every option of a class, by its name."""
    text = inspect.getdoc(target) or ""
    section = re.search(r"^Parameters\n-+\n(.*?)(?=\n\n\S[^\n]*\n-{3,}|\Z)", text, re.DOTALL | re.MULTILINE)
    docs: dict[str, OptionDoc] = {}
    for entry in re.split(r"\n(?=\S)", section[1] if section else ""):
        head, _, body = entry.partition("\n")
        plain = re.sub(r":[a-z]+:`~?(?:[\w.]+\.)?(\w+)`", r"\1", body).replace("``", "")
        for name in head.partition(" : ")[0].split(", "):
            docs[name] = OptionDoc(" ".join(plain.split()))
    return docs
