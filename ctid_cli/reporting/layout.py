"""Aligned text and Markdown tables, and how numbers look in them."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence

#: Width of paragraphs.
WIDTH = 100


def text_table(header: Sequence[str], rows: Sequence[Sequence[str]], align: str) -> str:
    """Columns padded with blanks, with a rule under the header.

    Parameters
    ----------
    header : sequence of str
        Column titles.
    rows : sequence of sequence of str
        Cells; each row has as many as the header.
    align : str
        One letter per column: ``l`` or ``r``.

    Returns
    -------
    str
        The table, lines without trailing blanks, no final newline.

    Examples
    --------
    >>> print(text_table(["start", "%"], [["0 s", "95"], ["random", "5"]], "lr"))
    start    %
    ----------
    0 s     95
    random   5
    """
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
    """A Markdown table.

    Parameters
    ----------
    header : sequence of str
        Column titles.
    rows : sequence of sequence of str
        Cells; each row has as many as the header.
    align : str
        One letter per column: ``l`` or ``r``.

    Returns
    -------
    str
        The table, no final newline.

    Examples
    --------
    >>> print(markdown_table(["start", "%"], [["0 s", "95"]], "lr"))
    | start | % |
    |:--|--:|
    | 0 s | 95 |
    """
    sides = "|" + "|".join(":--" if side == "l" else "--:" for side in align) + "|"

    def line(cells: Sequence[str]) -> str:
        return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"

    return "\n".join([line(header), sides, *(line(row) for row in rows)])


def number(value: object, digits: int = 6) -> str:
    """A number for people; a dash where there is none.

    Parameters
    ----------
    value : object
        Number, text, or None.
    digits : int, default 6
        Significant digits.

    Returns
    -------
    str
        Text.

    Examples
    --------
    >>> number(7.99987654), number(float("nan")), number(None), number("random")
    ('7.99988', '-', '-', 'random')
    """
    if value is None:
        return "-"
    if isinstance(value, bool | str):
        return str(value)
    if isinstance(value, int | float):
        return f"{value:.{digits}g}" if math.isfinite(value) else "-"
    return str(value)


def with_error(value: float, error: float) -> str:
    """A value and its standard error, both to the second digit of the error.

    Parameters
    ----------
    value, error : float
        In any unit.

    Returns
    -------
    str
        Text.

    Examples
    --------
    >>> with_error(7.99912345, 0.00123), with_error(-823265000.0, 160000000.0)
    ('7.9991 ± 0.0012', '-8.2e+08 ± 1.6e+08')
    """
    if not (math.isfinite(value) and math.isfinite(error) and error > 0):
        return f"{number(value)} ± {number(error, 2)}"
    digits = 2
    if abs(value) > error:
        digits += math.floor(math.log10(abs(value))) - math.floor(math.log10(error))
    return f"{value:#.{digits}g} ± {error:#.2g}"


def count(n: int, noun: str) -> str:
    """A number of things.

    Parameters
    ----------
    n : int
        How many.
    noun : str
        One of them.

    Returns
    -------
    str
        Text.

    Examples
    --------
    >>> count(1, "data set"), count(20, "data set")
    ('1 data set', '20 data sets')
    """
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


def percent(value: float | None, n: int) -> str:
    """A percentage out of ``n``; one decimal where ``n`` can resolve it.

    Parameters
    ----------
    value : float or None
        Percentage [%].
    n : int
        What it is a percentage of; without a decimal, 199 of 200 would print as 100.

    Returns
    -------
    str
        Text without the sign.

    Examples
    --------
    >>> percent(95.0, 20), percent(99.5, 200), percent(None, 0)
    ('95', '99.5', '-')
    """
    if value is None or not math.isfinite(value):
        return "-"
    return f"{value:.1f}" if n > 100 else f"{value:.0f}"


def interval(low: float | None, high: float | None, n: int) -> str:
    """A confidence interval in percent.

    Parameters
    ----------
    low, high : float or None
        Ends [%].
    n : int
        What they are a percentage of.

    Returns
    -------
    str
        ``[low, high]``, or a dash.

    Examples
    --------
    >>> interval(76.4, 99.1, 20)
    '[76, 99]'
    """
    return "-" if low is None or high is None else f"[{percent(low, n)}, {percent(high, n)}]"


def seconds(value: float | None) -> str:
    """A duration in a unit that fits.

    Parameters
    ----------
    value : float or None
        Duration [s].

    Returns
    -------
    str
        For example ``35 ms`` or ``1.2 s``.

    Examples
    --------
    >>> seconds(0.0351), seconds(1.234), seconds(754.0), seconds(None)
    ('35 ms', '1.2 s', '12 min 34 s', '-')
    """
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
    """An initial delay as a column title.

    Parameters
    ----------
    initial_delay : float, "random" or None
        Initial delay [s].

    Returns
    -------
    str
        Text.

    Examples
    --------
    >>> delay_label(3.0), delay_label("random"), delay_label(None)
    ('3 s', 'random', 'none')
    """
    if initial_delay is None:
        return "none"
    return initial_delay if isinstance(initial_delay, str) else f"{initial_delay:g} s"


def wrapped(text: str, indent: str = "", hanging: int = 0) -> list[str]:
    """Lines of a paragraph of `WIDTH` columns.

    Parameters
    ----------
    text : str
        The paragraph; blanks inside it are kept.
    indent : str, default ""
        What every line begins with.
    hanging : int, default 0
        Further blanks before all lines but the first.

    Returns
    -------
    list of str
        The lines; words are never broken.

    Examples
    --------
    >>> wrapped("- one", "  ", 2)
    ['  - one']
    """
    return textwrap.wrap(
        text,
        WIDTH,
        initial_indent=indent,
        subsequent_indent=indent + " " * hanging,
        break_long_words=False,
        break_on_hyphens=False,
    )
