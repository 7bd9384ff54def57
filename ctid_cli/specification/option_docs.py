"""What the docstring of an option dataclass or section says about each option: the source of schema, help, messages."""

import inspect
import re
from functools import cache


@cache
def option_docs(target: type) -> dict[str, str]:
    """The text about every option of a class and its bases, by name: the section Parameters of their docstrings."""
    docs: dict[str, str] = {}
    for base in reversed(target.__mro__):
        text = inspect.cleandoc(base.__dict__.get("__doc__") or "")
        section = re.search(r"^Parameters\n-+\n(.*?)(?=\n\n\S[^\n]*\n-{3,}|\Z)", text, re.DOTALL | re.MULTILINE)
        for entry in re.split(r"\n(?=\S)", section[1]) if section else ():
            head, _, body = entry.partition("\n")
            plain = re.sub(r":[a-z]+:`~?(?:[\w.]+\.)?(\w+)`", r"\1", body).replace("``", "")
            docs |= dict.fromkeys(head.partition(" : ")[0].split(", "), " ".join(plain.split()))
    return docs
