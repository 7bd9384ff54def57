"""Messages about invalid values, and option texts from docstrings."""

import inspect
import re
from collections.abc import Collection, Iterable, Mapping
from functools import cache
from typing import Any

from pydantic import ValidationError
from pydantic_core import ErrorDetails, InitErrorDetails, PydanticCustomError

from ctid_cli.specification.yaml_source import KEY, KeyPath
from ctid_cli.text import did_you_mean

#: Key path inside a section, and the problem there.
Violation = tuple[KeyPath, str]

#: Prefix of the tags of unions, which pydantic puts into error locations; no text from YAML contains it.
TAG = "\0"
#: Prefix of a tag that ends with the other forms allowed there.
HINT = TAG + ";"

#: Message for every pydantic error type that can occur in a specification.
SENTENCES = {
    "bool_type": "must be true or false, not {shown}",
    "float_type": "must be a number{unit}, not {shown}",
    "finite_number": "must be a number{unit} that is finite, not {shown}",
    "int_type": "must be a whole number{unit}, not {shown}",
    "string_type": "must be a text, not {shown}",
    "string_too_short": "must not be empty",
    "literal_error": "must be one of {allowed}, not {shown}",
    "greater_than": "must be a number{unit} above {gt:.15g}, not {shown}",
    "greater_than_equal": "must be a number{unit} of at least {ge:.15g}, not {shown}",
    "less_than": "must be a number{unit} below {lt:.15g}, not {shown}",
    "less_than_equal": "must be a number{unit} of at most {le:.15g}, not {shown}",
    "list_type": "must be a list, not {shown}{meaning}",
    "dict_type": "must be a mapping, not {shown}{meaning}",
    "too_short": "must be a list of at least {min_length}, not {shown}{meaning}",
    "too_long": "must be a list of at most {max_length}, not {shown}{meaning}",
    "model_type": "must be a mapping with the keys {keys}, not {shown}",
    "extra_forbidden": "there is no such key here{near} allowed: {keys}",
    "decimal_comma": "there is no such key here; if it is a part of a number, write a decimal point, as in 0.5",
    "no_colon": "there is no such key here; write a colon after {word}",
    "missing": "is missing; add it{meaning}",
    "no_kind": "must be one of {allowed}, not {shown}",
    "kind_missing": "is missing; allowed: {allowed}",
    "no_form": "must be {allowed}, not {shown}",
}


def wrong(message: str) -> PydanticCustomError:
    """Return an error with a given message for the user."""
    return PydanticCustomError("said", "{message}", {"message": message})


def several_wrong(title: str, problems: Iterable[Violation]) -> ValidationError:
    """Return one validation error with several problems."""
    details = [InitErrorDetails(type=wrong(message), loc=path, input=None) for path, message in problems]
    return ValidationError.from_exception_data(title, details)


def explained(error: ErrorDetails, descriptions: Mapping[str, str]) -> Violation:
    """Return the place and message of a pydantic error in a section with the given field descriptions."""
    parts = [str(part) for part in error["loc"]]
    path = tuple(part for part in error["loc"] if not str(part).startswith(TAG))
    kind, value, context = error["type"], error["input"], error.get("ctx", {})
    path, kind, value, context = _specific(path, kind, value, context, descriptions)
    if kind not in SENTENCES:
        return path, error["msg"]
    if kind in ("missing", "extra_forbidden", "decimal_comma", "no_colon"):
        path = (*path, KEY)
    words = _words(path, descriptions) | {"shown": shown(value)} | context
    if kind == "literal_error":
        words["allowed"] = context["expected"].replace(" or ", ", ")
    hints = [tag.removeprefix(TAG) for tag in parts if tag.startswith(HINT)]
    return path, SENTENCES[kind].format(**words) + _hint(kind, value, words) + "".join(hints)


def _specific(
    path: KeyPath, kind: str, value: Any, context: dict[str, Any], known: Collection[str]
) -> tuple[KeyPath, str, Any, dict[str, Any]]:
    """Return place, type, value and context for the message, which replace those of pydantic if they are too vague."""
    if kind == "no_kind" and not isinstance(value, Mapping):
        text = f"a mapping with a 'kind' (one of {context['allowed']})"
        each = "; several kinds are several experiments, each with a file" if isinstance(value, list) else ""
        return path, "no_form", value, {"allowed": f"{text}{each}"}
    if kind == "no_kind":
        return (*path, "kind"), "no_kind" if "kind" in value else "kind_missing", value.get("kind"), context
    if kind == "extra_forbidden" and value is None and str(path[-1]).isdigit():
        return path, "decimal_comma", value, context
    if kind == "extra_forbidden" and (word := str(path[-1]).partition(" ")[0]) in known:
        return path, "no_colon", value, {"word": word}
    if kind == "float_type" and type(value) is int:
        # An integer outside the range of floating-point numbers.
        return path, "finite_number", float("inf"), context
    return path, kind, value, context


def _words(path: KeyPath, descriptions: Mapping[str, str]) -> dict[str, Any]:
    """Return the words that a message may use about a field and about the others of its section."""
    field = str(path[0]) if path else ""
    description = descriptions.get(field, "")
    unit = re.search(r" \[[^\]-][^\]]*\]", description)
    return {
        "unit": unit[0] if unit else "",
        "meaning": f": {description}" if description else "",
        "keys": ", ".join(descriptions),
        "near": did_you_mean(field, descriptions) or ";",
    }


def _hint(kind: str, value: Any, words: Mapping[str, Any]) -> str:
    """Return a suggestion for a value as the end of a message, if one can be guessed."""
    if kind in ("float_type", "int_type") and isinstance(value, (list, tuple)):
        return "; this key cannot be swept"
    if kind == "float_type" and isinstance(value, str) and re.fullmatch(r"[-+]?[0-9]+,[0-9]+", value):
        return f"; write a decimal point: {value.replace(',', '.')}"
    if kind == "float_type" and isinstance(value, str) and re.match(r"\s*[-+]?\.?[0-9]", value):
        return "; write it without quotes, underscores or a unit"
    if kind == "int_type" and isinstance(value, float) and value.is_integer() and abs(value) < 2**63:
        return f"; write {int(value)}"
    if kind == "string_type" and isinstance(value, (bool, int, float)):
        return f"; write it in quotes: '{shown(value)}'"
    if kind in ("literal_error", "no_kind") and isinstance(value, str):
        return did_you_mean(value, words["allowed"].replace("'", "").split(", "))
    return ""


@cache
def option_docs(target: type) -> dict[str, str]:
    """Return the description of every option of a class, from the Parameters sections of its bases and itself."""
    docs: dict[str, str] = {}
    for base in reversed(target.__mro__):
        text = inspect.cleandoc(base.__dict__.get("__doc__") or "")
        section = re.search(r"^Parameters\n-+\n(.*?)(?=\n\n\S[^\n]*\n-{3,}|\Z)", text, re.DOTALL | re.MULTILINE)
        for entry in re.split(r"\n(?=\S)", section[1]) if section else ():
            head, _, body = entry.partition("\n")
            plain = re.sub(r":[a-z]+:`~?(?:[\w.]+\.)?(\w+)`", r"\1", body).replace("``", "")
            docs |= dict.fromkeys(head.partition(" : ")[0].split(", "), " ".join(plain.split()))
    return docs


def shown(value: Any) -> str:
    """Return a description of a YAML value for messages."""
    if value is None:
        return "nothing (null)"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return f"the text {value if len(value) <= 40 else value[:37] + '...'!r}"
    if isinstance(value, (list, tuple)):
        return f"a list of {len(value)}" if value else "an empty list"
    if isinstance(value, Mapping):
        return "a mapping"
    return repr(value)
