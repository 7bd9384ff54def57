"""Aligned text and Markdown tables, and how numbers look in them."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence

#: Width of paragraphs.
WIDTH = 100


def text_table(header: Sequence[str], rows: Sequence[Sequence[str]], align: str) -> str:
    """Columns padded with blanks, with a rule under the header."""
    widths = [max(len(row[k]) for row in [header, *rows]) for k in range(len(header))]

    def line(cells: Sequence[str]) -> str:
        padded = [
            cell.ljust(width) if side == "l" else cell.rjust(width)
            for cell, width, side in zip(cells, widths, align, strict=True)
        ]
        return "  ".join(padded).rstrip()

    rule = "-" * (sum(widths) + 2 * (len(widths) - 1))
    return "\n".join([line(header), rule, *(line(row) for row in rows)])


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]], align: str) -> str:
    """A Markdown table."""
    sides = "|" + "|".join(":--" if side == "l" else "--:" for side in align) + "|"

    def line(cells: Sequence[str]) -> str:
        return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"

    return "\n".join([line(header), sides, *(line(row) for row in rows)])


def number(value: object, digits: int = 6) -> str:
    """A number for people; a dash where there is none."""
    if value is None:
        return "-"
    if isinstance(value, bool | str):
        return str(value)
    if isinstance(value, int | float):
        return f"{value:.{digits}g}" if math.isfinite(value) else "-"
    return str(value)


def with_error(value: float, error: float) -> str:
    """A value and its standard error, both to the second digit of the error."""
    if not (math.isfinite(value) and math.isfinite(error) and error > 0):
        return f"{number(value)} ± {number(error, 2)}"
    digits = 2
    if abs(value) > error:
        digits += math.floor(math.log10(abs(value))) - math.floor(math.log10(error))
    return f"{value:#.{digits}g} ± {error:#.2g}"


def count(n: int, noun: str) -> str:
    """A number of things."""
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


def percent(value: float | None, n: int) -> str:
    """A percentage out of ``n``; one decimal where ``n`` can resolve it."""
    if value is None or not math.isfinite(value):
        return "-"
    return f"{value:.1f}" if n > 100 else f"{value:.0f}"


def interval(low: float | None, high: float | None, n: int) -> str:
    """A confidence interval in percent."""
    return "-" if low is None or high is None else f"[{percent(low, n)}, {percent(high, n)}]"


def seconds(value: float | None) -> str:
    """A duration in a unit that fits."""
    if value is None or not math.isfinite(value):
        return "-"
    if value < 0.9995:
        return f"{1000 * value:.2g} ms" if value < 0.00995 else f"{1000 * value:.0f} ms"
    if value < 60:
        return f"{value:.2g} s" if value < 9.95 else f"{value:.0f} s"
    minutes, rest = divmod(round(value), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {rest} s"


def delay_label(initial_delay: float | str | None) -> str:
    """An initial delay as a column title."""
    if initial_delay is None:
        return "none"
    return initial_delay if isinstance(initial_delay, str) else f"{initial_delay:g} s"


def wrapped(text: str, indent: str = "", hanging: int = 0) -> list[str]:
    """Lines of a paragraph of `WIDTH` columns."""
    return textwrap.wrap(
        text,
        WIDTH,
        initial_indent=indent,
        subsequent_indent=indent + " " * hanging,
        break_long_words=False,
        break_on_hyphens=False,
    )
