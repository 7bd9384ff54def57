"""How answers look: aligned text, Markdown or LaTeX, and how numbers are written in it."""

import csv
import html
import io
import itertools
import json
import math
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from ctid_cli.text import count as count  # for those who draw
from ctid_cli.text import wrapped

Lines = Sequence[Sequence[str]]


@dataclass(frozen=True)
class Table:
    """Texts in columns under a header, each column to the left (``l``) or to the right (``r``)."""

    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    align: str

    def draw(self, style: str = "text") -> str:
        """Columns padded with blanks and a rule under the header, or ``md``, ``html``, or ``latex`` with booktabs."""
        return _TABLES[style]([self.header, *self.rows], self.align)


@dataclass(frozen=True)
class Report:
    """What a command answers: for people blocks of paragraphs and tables, for programs records."""

    #: A paragraph that begins with ``### `` is a heading; what holds line ends is drawn already.
    blocks: Sequence[Sequence[str | Table]]
    records: Sequence[Mapping[str, Any]] = ()
    #: Remarks, never wrapped because they hold commands.
    notes: Sequence[str] = field(default=())

    def draw(self, style: str = "text") -> str:
        """The report for people, as text, as Markdown (``md``), or its tables in LaTeX with the rest as comments."""
        notes = [f"Note: {note}" for note in self.notes]
        if style == "text":
            blocks = ["\n".join(map(_drawn, block)) for block in self.blocks if block]
            return "\n\n".join([*blocks, "\n".join(notes)] if notes else blocks)
        items, paragraph = [*itertools.chain(*self.blocks), *notes], _PARAGRAPHS[style]
        return "\n\n".join(item.draw(style) if isinstance(item, Table) else paragraph(item) for item in items)


def _text_table(lines: Lines, align: str) -> str:
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    sides = [f"{'<' if side == 'l' else '>'}{width}" for side, width in zip(align, widths, strict=True)]
    header, *body = ("  ".join(map(format, cells, sides)).rstrip() for cells in lines)
    return "\n".join([header, "-" * (sum(widths) + 2 * (len(widths) - 1)), *body])


def _markdown_table(lines: Lines, align: str) -> str:
    header, *body = ("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |" for cells in lines)
    return "\n".join([header, "|" + "|".join(":--" if side == "l" else "--:" for side in align) + "|", *body])


def _html_table(lines: Lines, align: str) -> str:
    sides = ["left" if side == "l" else "right" for side in align]
    return "<table>" + "\n".join(f"<tr>{''.join(map(_html_cell, cells, sides))}</tr>" for cells in lines) + "</table>"


def _html_cell(text: str, side: str) -> str:
    return f'<td style="text-align: {side}">{html.escape(text)}</td>'


def _latex_table(lines: Lines, align: str) -> str:
    header, *body = (" & ".join(map(latex, cells)) + r" \\" for cells in lines)
    rules = [f"\\begin{{tabular}}{{{align}}}", r"\toprule", header, r"\midrule"]
    return "\n".join([*rules, *body, r"\bottomrule", r"\end{tabular}"])


#: How a table is drawn in each style, and a paragraph in those that are not plain text.
_TABLES = {"text": _text_table, "md": _markdown_table, "html": _html_table, "latex": _latex_table}
_PARAGRAPHS: Mapping[str, Callable[[str], str]] = {
    "md": str,
    "html": lambda text: f"<p>{html.escape(text.removeprefix('### '))}</p>",
    "latex": lambda text: textwrap.indent(text.removeprefix("### "), "% "),
}
#: What LaTeX would read as something else.
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
    """A text for LaTeX."""
    return text.translate(_LATEX)


def _drawn(item: str | Table) -> str:
    if isinstance(item, Table):
        return item.draw()
    return item if "\n" in item else wrapped(item.removeprefix("### "))


def write_reports(reports: Sequence[Report], style: str) -> str:
    """Reports as ``text``, ``md``, ``latex``, ``csv`` or ``json``."""
    records = [record for report in reports for record in report.records]
    if style == "json":
        return json.dumps(records, indent=1, allow_nan=False)
    if style == "csv":
        return csv_text(records).rstrip("\n")
    return "\n\n\n".join(report.draw(style) for report in reports)


def csv_text(rows: Iterable[Mapping[str, Any]], columns: Iterable[str] | None = None) -> str:
    """Rows as CSV: an empty field where a row lacks a column, JSON for lists and mappings."""
    rows = [
        {key: json.dumps(value) if isinstance(value, dict | list) else value for key, value in row.items()}
        for row in rows
    ]
    names = list(dict.fromkeys(key for row in rows for key in row) if columns is None else columns)
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, names, restval="", lineterminator="\n", extrasaction="ignore")
    writer.writeheader()
    writer.writerows(rows)
    return buffer.getvalue()


def picked(item: object, names: Iterable[str]) -> dict[str, Any]:
    """Some attributes of an object, as data."""
    return {name: getattr(item, name) for name in names}


def number(value: object, digits: int = 6) -> str:
    """A number for people; a dash where there is none."""
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.{digits}g}" if math.isfinite(value) else "-"
    return str(value)


def with_error(value: float, error: float) -> str:
    """A value and its standard error, both to the second digit of the error."""
    if not (math.isfinite(value) and math.isfinite(error) and error > 0):
        return f"{number(value)} ± {number(error, 2)}"
    digits = 2
    if abs(value) > error:
        digits += math.floor(math.log10(abs(value))) - math.floor(math.log10(error))
    return f"{_to_digits(value, digits)} ± {_to_digits(error, 2)}"


def _to_digits(value: float, digits: int) -> str:
    """A number with its trailing zeros: 0.0400, 2.0, 26, 130; as 1.3e+07 where it has many digits that say nothing."""
    text = f"{value:#.{digits}g}".removesuffix(".")
    return f"{float(text):.0f}" if "e+" in text and abs(value) < 1e6 else text


def rate(speed: float) -> str:
    """How many there are in a second, or in a minute where these are few."""
    return f"{speed:.2g}/s" if speed >= 0.1 else f"{60 * speed:.2g}/min"


def percent(value: float | None, n: int) -> str:
    """A percentage out of ``n``; one decimal where ``n`` can resolve it."""
    if value is None or not math.isfinite(value):
        return "-"
    return f"{value:.1f}" if n > 100 else f"{value:.0f}"


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


def setting_title(key: str) -> str:
    """Return a swept field as the title of a column."""
    return "SNR" if key == "snr_db" else key


def setting_text(key: str, value: Any) -> str:
    """Return the value of a swept field, with its unit where the title does not say it."""
    return f"{number(value)} dB" if key == "snr_db" and value is not None else number(value)


def delay_label(initial_delay: float | str | None) -> str:
    """An initial delay as a column title."""
    if initial_delay is None:
        return "none"
    return initial_delay if isinstance(initial_delay, str) else f"{initial_delay:g} s"
