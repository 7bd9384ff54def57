"""What an experiment asks, in words: the system, what drives it, when it is sampled, who estimates, what counts."""

import inspect
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from ctid_cli.kinds import KINDS, resolve
from ctid_cli.reporting.document import Section
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

SUPERSCRIPTS = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")
#: What of a system is in its equation.
IN_EQUATION = ("numerator", "denominator", "additive")


def parts(settings: Mapping[str, Any]) -> Iterator[Section]:
    """Return the data of an experiment, section by section."""
    for section, title in TITLES.items():
        content = settings.get(section)
        if isinstance(content, Mapping):
            yield _part(title, section, content)


def estimators(settings: Mapping[str, Any]) -> Iterator[Section]:
    """Return the estimators of an experiment."""
    for name, content in settings["estimators"].items():
        section = "estimator" if content.get("kind") in KINDS["estimator"] else "frequency_estimator"
        yield _part(name, section, content)


def _part(title: str, section: str, content: Mapping[str, Any]) -> Section:
    """Return a section of a specification with a table of its options; custom components have no documented ones."""
    import pandas as pd

    kind = str(content.get("kind") or "")
    summary, docs = documentation(section, content)
    options = [
        (name, _text(value), *_unit_and_meaning(docs.get(name, "")))
        for name, value in content.items()
        if name != "kind" and value is not None and not (section == "system" and name in IN_EQUATION)
    ]
    frame = pd.DataFrame(options, columns=["option", "value", "unit", "meaning"]) if options else None
    if frame is not None and not frame["meaning"].any():
        frame = frame[["option", "value"]]
    named = f"{title} ({kind})" if kind not in ("", title) else title
    return Section(named, [summary] if kind and summary else [], frame)


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


def formula_of(settings: Mapping[str, Any]) -> str:
    """Return the transfer function of a system whose equation is known, else an empty text."""
    system = settings.get("system") or {}
    if "additive" in system:
        terms = [(item["numerator"], item["denominator"], item.get("integrators") or 0) for item in system["additive"]]
    elif "denominator" in system:
        terms = [(system["numerator"], system["denominator"], 0)]
    else:
        return ""
    return formula(terms, delayed=bool(system.get("delay")))


def formula(terms: Sequence[tuple[Sequence[float], Sequence[float], int]], *, delayed: bool, digits: int = 15) -> str:
    """Return a sum of fractions, each with poles at the origin besides, as one line."""
    shown = []
    for numerator, denominator, integrators in terms:
        above, below = _bracketed(polynomial(numerator, digits)), _bracketed(polynomial(denominator, digits))
        shown.append(f"{above} / {f'[{_power(integrators)} {below}]' if integrators else below}")
    text = " + ".join(shown)
    if delayed:
        text = f"[{text}] e^(−τ s)" if len(shown) > 1 else f"{text} · e^(−τ s)"
    return f"G(s) = {text}"


def _bracketed(text: str) -> str:
    return f"({text})" if " " in text else text


def polynomial(coefficients: Sequence[float], digits: int = 15) -> str:
    """Return a polynomial in descending powers of s; coefficients of 1 are not written."""
    text = ""
    for power, value in zip(range(len(coefficients) - 1, -1, -1), coefficients, strict=True):
        if value:
            size = "" if abs(value) == 1 and power else number(abs(float(value)), digits)
            sign = " − " if value < 0 else " + "
            text += f"{sign if text else sign.strip(' +')}{' '.join(filter(None, (size, _power(power))))}"
    return text or "0"


def _power(power: int) -> str:
    """Return a power of s, with a superscript."""
    return "" if power == 0 else "s" if power == 1 else f"s{str(power).translate(SUPERSCRIPTS)}"


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
