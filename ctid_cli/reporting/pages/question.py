"""Question of an experiment: the equation of its system, and the articles on its estimators."""

import inspect
import re
from collections.abc import Mapping, Sequence
from typing import Any

from ctid_cli.kinds import KINDS, resolve
from ctid_cli.reporting.layout import number

SUPERSCRIPTS = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")


def formula_of(settings: Mapping[str, Any]) -> str:
    """Return the transfer function of a system with a known equation, else an empty text."""
    system = settings.get("system") or {}
    if "additive" in system:
        terms = [(item["numerator"], item["denominator"], item.get("integrators") or 0) for item in system["additive"]]
    elif "denominator" in system:
        terms = [(system["numerator"], system["denominator"], 0)]
    else:
        return ""
    return formula(terms, delayed=bool(system.get("delay")))


def formula(terms: Sequence[tuple[Sequence[float], Sequence[float], int]], *, delayed: bool, digits: int = 15) -> str:
    """Return a sum of fractions, each with its poles at the origin, as one line."""
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
    """Return the articles on the methods of the estimators."""
    found: dict[str, None] = {}
    for content in settings["estimators"].values():
        for section in ("estimator", "frequency_estimator"):
            if content.get("kind") in KINDS[section]:
                text = inspect.getdoc(resolve(section, content["kind"])) or ""
                cited = re.search(r"^References\n-+\n(.*?)(?=\n\n\S[^\n]*\n-{3,}|\Z)", text, re.DOTALL | re.MULTILINE)
                found |= dict.fromkeys(" ".join(cited[1].replace("*", "").split()).split("\n") if cited else ())
    return list(found)
