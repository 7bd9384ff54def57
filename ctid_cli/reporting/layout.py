"""Formatting of numbers and tables as text."""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[str]], sides: str) -> str:
    """Return a table in Markdown, each column to the left (``l``) or to the right (``r``)."""
    first, *body = ("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |" for cells in (header, *rows))
    return "\n".join([first, "|" + "|".join(":--" if side == "l" else "--:" for side in sides) + "|", *body])


#: Special characters of LaTeX.
_LATEX = str.maketrans(
    {
        **{sign: f"\\{sign}" for sign in "&%$#_{}"},
        "\\": r"\textbackslash{}",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        "±": r"$\pm$",
    }
)


def latex(text: str) -> str:
    """Escape a text for LaTeX."""
    return text.translate(_LATEX)


#: A cell with more characters may be broken into lines.
WORDS = 32


def marked(text: str) -> str:
    """Escape a text, in which backquotes mark names and commands; a p-value and an interval are not broken."""
    kept = re.sub(r"\bp ([=<]) (?=\d)", "p\u00a0\\1\u00a0", text).replace(" -+ ", " ±\u00a0")
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", escape(kept))


def html_paragraphs(sentences: Sequence[str], style: str = "") -> str:
    """Return paragraphs; a text with line ends is preformatted, one that begins with a hyphen is a list item."""
    shown = []
    for text in sentences:
        if "\n" in text:
            shown.append(f"<pre>{escape(text)}</pre>")
        elif text.startswith("- "):
            shown.append(f"<ul><li>{marked(text[2:])}</li></ul>")
        else:
            shown.append(f'<p class="{style}">{marked(text)}</p>')
    return "\n".join(shown)


def html_table(lines: Sequence[Sequence[str]], sides: str) -> str:
    """Return header and rows as a table, each column left (l) or right (r); without header it is a list of pairs."""
    header, *rows = lines
    titled = any(header)
    sides = sides if titled else "l" * len(header)

    def cell(tag: str, side: str, text: str, more: str = "") -> str:
        words = ' class="words"' * (tag == "td" and side == "l" and len(text) > WORDS)
        look = ' style="text-align: right"' if side == "r" else ' style="text-align: left"'
        return f"<{tag}{words}{look}{more}>{marked(text)}</{tag}>"

    body = ["".join(cell("td", *each) for each in zip(sides, row, strict=True)) for row in rows]
    titles = "".join(cell("th", *each, ' scope="col"') for each in zip(sides, header, strict=True))
    head = f"<thead><tr>{titles}</tr></thead>" if titled else ""
    kind = "" if titled else ' class="pairs"'
    return f"<table{kind}>{head}<tbody>" + "\n".join(f"<tr>{row}</tr>" for row in body) + "</tbody></table>"


def picked(item: object, names: Iterable[str]) -> dict[str, Any]:
    """Return some attributes of an object, or values of a mapping, as data; None if a mapping lacks one."""
    return {name: item.get(name) if isinstance(item, Mapping) else getattr(item, name) for name in names}


def number(value: object, digits: int = 6) -> str:
    """Format a number; a dash if there is none."""
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.{digits}g}" if math.isfinite(value) else "-"
    return str(value)


def with_error(value: float, error: float) -> str:
    """Format a value and its standard error, both to the second digit of the error."""
    if not (math.isfinite(value) and math.isfinite(error) and error > 0):
        return f"{number(value)} ± {number(error, 2)}"
    digits = 2
    if abs(value) > error:
        digits += math.floor(math.log10(abs(value))) - math.floor(math.log10(error))
    return f"{_to_digits(value, digits)} ± {_to_digits(error, 2)}"


def _to_digits(value: float, digits: int) -> str:
    """Format a number with its trailing zeros: 0.0400, 2.0, 26, 130."""
    return written_out(f"{value:#.{digits}g}".removesuffix("."))


def written_out(text: str) -> str:
    """Format a number below a million without an exponent: 1300, not 1.3e+03."""
    return f"{float(text):.0f}" if "e+" in text and abs(float(text)) < 1e6 else text


def rate(speed: float) -> str:
    """Format a rate per second, or per minute if it is low."""
    return f"{speed:.2g}/s" if speed >= 0.1 else f"{60 * speed:.2g}/min"


def percent(value: float | None, n: int) -> str:
    """Format a percentage out of ``n``, with one decimal if ``n`` can resolve it."""
    if value is None or not math.isfinite(value):
        return "-"
    return f"{value:.1f}" if n > 100 else f"{value:.0f}"


def seconds(value: float | None) -> str:
    """Format a duration in a suitable unit."""
    if value is None or not math.isfinite(value):
        return "-"
    if value < 0.9995:
        return f"{1000 * value:.2g} ms" if value < 0.00995 else f"{1000 * value:.0f} ms"
    if value < 60:
        return f"{value:.2g} s" if value < 9.95 else f"{value:.0f} s"
    minutes, rest = divmod(round(value), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {rest} s"


def setting_title(key: str) -> str:
    """Return a swept field as the title of a column."""
    return "SNR" if key == "snr_db" else key


def setting_text(key: str, value: Any) -> str:
    """Return the value of a swept field, with its unit if the title has none."""
    return f"{number(value)} dB" if key == "snr_db" and value is not None else number(value)


def delay_label(initial_delay: float | str | None) -> str:
    """Return an initial delay as a column title."""
    if initial_delay is None:
        return "none"
    return initial_delay if isinstance(initial_delay, str) else f"{initial_delay:g} s"
