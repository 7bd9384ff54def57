"""What an experiment asks, in words: the system, what drives it, when it is sampled, who estimates, what counts."""

import inspect
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from ctid_cli.kinds import KINDS, resolve
from ctid_cli.reporting.figures.settings import documentation, unit_in
from ctid_cli.reporting.layout import number

#: Sections of a specification as headings, in the order of the page.
TITLES = {
    "system": "System",
    "signal": "Signal",
    "data": "Measured record",
    "excitation": "Input",
    "loop": "Loop",
    "sampling": "Sampling",
    "noise": "Noise",
    "disturbance": "Disturbance",
    "starts": "Starts",
}

#: What of a system is in its equation.
IN_EQUATION = ("numerator", "denominator", "additive")


class Option(NamedTuple):
    """A value of a specification."""

    name: str
    value: str
    unit: str
    meaning: str


class Part(NamedTuple):
    """A section of a specification, or an estimator."""

    title: str
    kind: str
    summary: str
    options: list[Option]


class Fraction(NamedTuple):
    """A fraction of polynomials as the signs, coefficients and powers of their terms."""

    numerator: list[tuple[str, str, int]]
    denominator: list[tuple[str, str, int]]
    #: Power of s that stands before the denominator.
    integrators: int


def parts(settings: Mapping[str, Any]) -> Iterator[Part]:
    """The data of an experiment, section by section."""
    for section, title in TITLES.items():
        content = settings.get(section)
        if isinstance(content, Mapping):
            yield _part(title, section, content)


def estimators(settings: Mapping[str, Any]) -> Iterator[Part]:
    """The estimators of an experiment."""
    for name, content in settings["estimators"].items():
        section = "estimator" if content.get("kind") in KINDS["estimator"] else "frequency_estimator"
        yield _part(name, section, content)


def _part(title: str, section: str, content: Mapping[str, Any]) -> Part:
    summary, docs = documentation(section, content)
    options = [
        Option(name, _text(value), *_unit_and_meaning(docs.get(name, "")))
        for name, value in content.items()
        if name != "kind" and value is not None and not (section == "system" and name in IN_EQUATION)
    ]
    return Part(title, str(content.get("kind") or ""), summary if content.get("kind") else "", options)


def _unit_and_meaning(text: str) -> tuple[str, str]:
    unit = unit_in(text)
    meaning = text.replace(f" [{unit or '-'}]", "", 1)
    return unit, meaning if not meaning or meaning.endswith(".") else f"{meaning}."


def _text(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{name.replace('_', ' ')} {_text(item)}" for name, item in value.items() if item is not None)
    if isinstance(value, list):
        return ("; " if any(isinstance(item, Mapping | list) for item in value) else ", ").join(map(_text, value))
    return str(value).lower() if isinstance(value, bool) else number(value, 15)


def equation(settings: Mapping[str, Any]) -> tuple[list[Fraction], bool] | None:
    """The fractions of a system whose equation is known, and whether there is a delay."""
    system = settings.get("system") or {}
    if "additive" in system:
        terms = [(item["numerator"], item["denominator"], item.get("integrators") or 0) for item in system["additive"]]
    elif "denominator" in system:
        terms = [(system["numerator"], system["denominator"], 0)]
    else:
        return None
    fractions = [Fraction(polynomial(above), polynomial(below), power) for above, below, power in terms]
    return fractions, bool(system.get("delay"))


def polynomial(coefficients: Sequence[float], digits: int = 15) -> list[tuple[str, str, int]]:
    """Sign, size and power of s of the terms of a polynomial in descending powers; a size of 1 is not written."""
    found: list[tuple[str, str, int]] = []
    for power, value in zip(range(len(coefficients) - 1, -1, -1), coefficients, strict=True):
        if value:
            sign = "−" if value < 0 else "+" if found else ""
            found.append((sign, "" if abs(value) == 1 and power else number(abs(float(value)), digits), power))
    return found or [("", "0", 0)]


def references(settings: Mapping[str, Any]) -> list[str]:
    """The articles whose methods the estimators are."""
    found: dict[str, None] = {}
    for content in settings["estimators"].values():
        for section in ("estimator", "frequency_estimator"):
            if content.get("kind") in KINDS[section]:
                text = inspect.getdoc(resolve(section, content["kind"])) or ""
                cited = re.search(r"^References\n-+\n(.*?)(?=\n\n\S[^\n]*\n-{3,}|\Z)", text, re.DOTALL | re.MULTILINE)
                found |= dict.fromkeys(" ".join(cited[1].replace("*", "").split()).split("\n") if cited else ())
    return list(found)
