"""Result protocol: the interface of every printed result, and the renderers of its sections."""

from __future__ import annotations

import csv
import html
import io
import itertools
import json
import math
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple

from ctid_cli.canonical import plain
from ctid_cli.reporting.layout import html_paragraphs, html_table, latex, markdown_table, picked, written_out
from ctid_cli.text import WIDTH, wrapped

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from ctid_cli.reporting.figures.style import Drawing

#: Forms in which a result is written to stdout.
Format = Literal["text", "json", "md", "csv", "html", "latex"]
#: Tools to which a model is exported.
Tool = Literal["control", "matlab", "scipy"]


#: Width of the labels of a list in text.
LABEL = 16


class Column(NamedTuple):
    """A quantity of a result: its key in JSON and its unit, and its title and format in tables."""

    key: str
    #: Name of the column of a file, if it is not ``key``.
    title: str = ""
    form: str = ".6g"
    unit: str = ""

    @property
    def name(self) -> str:
        """Name of the column of a file: the key with the unit."""
        return f"{self.key} [{self.unit}]" if self.unit else self.key

    @property
    def header(self) -> str:
        """Title of the column of a table."""
        return self.title or self.name


@dataclass(frozen=True, eq=False)
class Table:
    """Titles and columns of a table; pandas is imported only for ``to_frame``.

    A column is a sequence of plain values, None where there is none, or an array.
    """

    titles: Sequence[str]
    columns: Sequence[Any]
    #: Format of the numbers of a column by its title, such as ``.2f``; ``.6g`` by default.
    formats: Mapping[str, str] = field(default_factory=dict)
    #: Whether the first column identifies the rows: it is the index of the DataFrame.
    is_named: bool = False
    #: Units of the columns by title, if they are known: ``attrs["units"]`` of the DataFrame.
    units: Mapping[str, str | None] | None = None

    @classmethod
    def of(cls, rows: Iterable[object], columns: Sequence[Column]) -> Table:
        """Return a table of objects or mappings; columns without any value are left out."""
        found = [picked(row, [column.key for column in columns]) for row in rows]
        values = {column: _plain_column([row[column.key] for row in found]) for column in columns}
        shown = [column for column, own in values.items() if not all(map(_is_missing, own))]
        formats = {column.header: column.form for column in shown}
        return cls([column.header for column in shown], [values[column] for column in shown], formats)

    @classmethod
    def of_rows(cls, rows: Sequence[Mapping[str, Any]], *, is_named: bool = False) -> Table:
        """Return a table with a column for each key that any of the rows has."""
        titles = list(dict.fromkeys(key for row in rows for key in row))
        return cls(titles, [_plain_column([row.get(title) for row in rows]) for title in titles], is_named=is_named)

    @classmethod
    def of_columns(cls, columns: Mapping[str, Any], **about: Any) -> Table:
        """Return a table of columns by title."""
        return cls(list(columns), list(columns.values()), **about)

    @classmethod
    def of_frame(cls, frame: pd.DataFrame, formats: Mapping[str, str] | None = None) -> Table:
        """Return a table with the columns of a DataFrame, whose index is the first of them if it has a name."""
        is_named = frame.index.name is not None
        shown = frame.reset_index() if is_named else frame
        columns = [values.astype(object).where(values.notna(), None).tolist() for _, values in shown.items()]
        return cls(list(map(str, shown)), columns, formats or {}, is_named)

    @classmethod
    def of_lines(cls, titles: Sequence[str], lines: Iterable[Sequence[Any]], **about: Any) -> Table:
        """Return a table of lines with a value for each title."""
        found = list(lines)
        return cls(titles, [[line[k] for line in found] for k in range(len(titles))], **about)

    @classmethod
    def of_pairs(cls, lines: Iterable[Sequence[str]]) -> Table:
        """Return labels and texts as a table without titles, which is rendered as a list."""
        return cls.of_lines(["", ""], lines)

    def __len__(self) -> int:
        return len(self.columns[0]) if self.columns else 0

    @property
    def values(self) -> list[list[Any]]:
        """Columns as lists of plain values."""
        return [column if isinstance(column, list) else column.tolist() for column in self.columns]

    def to_frame(self) -> pd.DataFrame:
        """Return the table as a DataFrame."""
        import pandas as pd

        frame = pd.DataFrame(dict(zip(self.titles, self.columns, strict=True)))
        if self.units is not None:
            frame.attrs["units"] = self.units
        return frame.set_index(self.titles[0]) if self.is_named else frame

    def to_csv(self) -> str:
        """Return the table as CSV; an empty field for no value, JSON for a list or an object."""
        columns = [[_csv_field(value) for value in own] for own in self.values]
        return csv_text([self.titles, *zip(*columns, strict=True)])


def csv_text(rows: Iterable[Iterable[Any]]) -> str:
    """Return lines of CSV."""
    file = io.StringIO()
    csv.writer(file, lineterminator="\n").writerows(rows)
    return file.getvalue()


def _csv_field(value: Any) -> Any:
    return json.dumps(value) if isinstance(value, list | dict) else None if _is_missing(value) else value


def _is_missing(value: Any) -> bool:
    """Return whether a value is None or not a number."""
    return value is None or (isinstance(value, float) and math.isnan(value))


def _plain_column(values: Iterable[Any]) -> list[Any]:
    """Return values as plain data; integers as floats if there are also floats, or none for some rows."""
    plain = [value.item() if hasattr(value, "item") else value for value in values]
    kinds = {type(value) for value in plain}
    if int in kinds and len(kinds) > 1 and kinds <= {int, float, type(None)}:
        return [None if value is None else float(value) for value in plain]
    return plain


@dataclass(frozen=True, eq=False)
class Section:
    """One part of a result: a title, sentences, a table, and a figure, each of them optional."""

    title: str = ""
    sentences: Sequence[str] = ()
    table: Table | None = None
    #: Lines that are never wrapped, such as paths and commands.
    lines: Sequence[str] = ()
    #: Sentences below the table, on the meaning of its columns.
    notes: Sequence[str] = ()
    #: A figure to draw, or an SVG file.
    drawing: Drawing | bytes | None = None
    caption: str = ""


class Result(ABC):
    """A result that commands print and Python functions return: numbers, and their presentation.

    Subclasses are frozen dataclasses of numbers. ``content`` is the JSON of ``--format json``; all other forms are
    rendered from ``sections``.
    """

    #: Name and version of the JSON object, such as ``ctid-check-1``; empty for rows of a table, and for files of
    #: results, which contain their kind and format.
    schema: ClassVar[str] = ""

    @abstractmethod
    def sections(self) -> Sequence[Section]:
        """Return the parts to show, in order."""

    @abstractmethod
    def content(self) -> Any:
        """Return the result as plain data for JSON."""

    def json_content(self) -> Any:
        """Return the content with the name and version of its schema."""
        content = self.content()
        return {"schema": self.schema, **content} if self.schema and isinstance(content, dict) else content

    def main_table(self) -> Table:
        """Return the main table of the result; one row of its content if there is none."""
        tables = [section.table for section in self.sections() if section.table is not None]
        return tables[0] if tables else Table.of_rows([self.content()])

    def to_frame(self) -> pd.DataFrame:
        """Return the main table of the result as a DataFrame."""
        return self.main_table().to_frame()

    def plot(self) -> Figure:
        """Draw the main figure of the result."""
        from ctid_cli.reporting.figures.style import Drawing

        return next(each.drawing.figure() for each in self.sections() if isinstance(each.drawing, Drawing))

    def summary(self) -> str:
        """Return the result as text."""
        return self.write("text")

    def write(self, form: Format = "text", columns: int | None = None) -> str:
        """Return the result in one of the forms; text is wrapped to the columns of a terminal, if they are given."""
        if form == "json":
            return json.dumps(plain(self.json_content()), indent=1, allow_nan=False)
        if form == "text":
            return render_text(self.sections(), columns)
        if form == "csv":
            return self.main_table().to_csv().rstrip("\n")
        return RENDERERS[form](self.sections())

    def _repr_html_(self) -> str:
        return self.write("html")


def cell(value: Any, form: str = ".6g") -> str:
    """Return a cell of a table as text: a number in its format, a dash if there is none."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return written_out(format(value, form)) if math.isfinite(value) else "-"
    return "-" if value is None else str(value)


def aligned_lines(table: Table) -> tuple[list[list[str]], str]:
    """Return header and rows of a table as texts, and the side of each column: texts left (l), numbers right (r)."""
    columns, sides = [], ""
    for title, values in zip(table.titles, table.values, strict=True):
        form = table.formats.get(title, ".6g")
        columns.append([title, *(cell(value, form) for value in values)])
        sides += "r" if all(map(_is_number, columns[-1][1:])) else "l"
    return [list(row) for row in zip(*columns, strict=True)], sides


def _is_number(text: str) -> bool:
    """Return whether a cell is a number, with its error, interval or unit, but no sentence."""
    begins = text[:1].isdigit() or (text[:1] in "-+[±" and text[1:2].isdigit())
    return text in ("", "-") or (begins and not re.search("[A-Za-z]{6}", text))


def render_text(sections: Iterable[Section], columns: int | None = None) -> str:
    """Render sections as text, wrapped at the page width or a narrower terminal, tables with aligned columns."""
    width = WIDTH if columns is None else min(WIDTH, columns)
    blocks = []
    for section in sections:
        parts = [_paragraph(section.title, width)] if section.title else []
        parts += [*(_paragraph(sentence, width) for sentence in section.sentences), *section.lines]
        parts += [_text_table(*aligned_lines(section.table), columns)] if section.table is not None else []
        parts += [_paragraph(note, width) for note in section.notes]
        blocks += ["\n".join(parts)] if parts else []
    return "\n\n".join(blocks)


def _paragraph(sentence: str, width: int) -> str:
    """Wrap a sentence; one that begins with a hyphen gets a hanging indent, one with line ends is left unchanged."""
    if "\n" in sentence:
        return sentence
    return wrapped(sentence, hanging="  " if sentence.startswith("- ") else "", width=width)


def _text_table(lines: list[list[str]], sides: str, columns: int | None = None) -> str:
    if not any(lines[0]):
        width, hanging = min(WIDTH, columns or WIDTH), " " * (LABEL + 1)
        return "\n".join(wrapped(f"{label:{LABEL}} {text}", "", hanging, width) for label, text in lines[1:])
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    # A smaller gap between columns may make them fit.
    gap = 1 if columns and _width(widths, 1) <= columns < _width(widths, 2) else 2
    blocks = []
    for part in _parts(widths, _key_count(lines[1:], sides), gap, columns):
        formats = [f"{'<' if sides[k] == 'l' else '>'}{widths[k]}" for k in part]
        header, *body = ((" " * gap).join(map(format, (row[k] for k in part), formats)).rstrip() for row in lines)
        blocks.append("\n".join([header, "-" * _width([widths[k] for k in part], gap), *body]))
    return "\n\n".join(blocks)


def _key_count(rows: Sequence[Sequence[str]], sides: str) -> int:
    """Return the number of first columns that identify all rows; if none do, of those before the first number."""
    # An empty cell repeats the one above it.
    keys = ["" for _ in rows]
    for k, column in enumerate(zip(*rows, strict=True)):
        filled: Iterator[str] = itertools.accumulate(column, lambda above, own: own or above)
        keys = [f"{before}\n{own}" for before, own in zip(keys, filled, strict=True)]
        if len({*keys}) == len(keys):
            return k + 1
    return max(1, sides.find("r", 1))


def _parts(widths: Sequence[int], key_count: int, gap: int, columns: int | None) -> Iterator[list[int]]:
    """Yield the columns of each part of a table that fits a terminal; those that identify rows are in every part."""
    keys = list(range(key_count))
    part = keys
    for k in range(len(keys), len(widths)):
        if columns and part != keys and _width([widths[i] for i in (*part, k)], gap) > columns:
            yield part
            part = keys
        part = [*part, k]
    yield part


def _width(widths: Sequence[int], gap: int) -> int:
    return sum(widths) + gap * (len(widths) - 1)


def render_markdown(sections: Iterable[Section]) -> str:
    """Render sections as Markdown."""
    blocks: list[str] = []
    for section in sections:
        blocks += [f"### {section.title}"] if section.title else []
        blocks += [*section.sentences, *section.lines]
        if section.table is not None:
            (header, *rows), sides = aligned_lines(section.table)
            blocks.append(markdown_table(header, rows, sides))
        blocks += section.notes
    return "\n\n".join(blocks)


def render_latex(sections: Iterable[Section]) -> str:
    """Render tables in LaTeX (booktabs), with titles and sentences as comments."""
    blocks: list[str] = []
    for section in sections:
        comments = [*([section.title] if section.title else []), *section.sentences, *section.lines]
        blocks += [f"% {line}" for text in comments for line in text.splitlines()]
        blocks += [_latex_table(*aligned_lines(section.table))] if section.table is not None else []
        blocks += [f"% {line}" for text in section.notes for line in text.splitlines()]
    return "\n\n".join(blocks)


def _latex_table(lines: list[list[str]], sides: str) -> str:
    header, *body = (" & ".join(map(latex, row)) + r" \\" for row in lines)
    rules = [f"\\begin{{tabular}}{{{sides}}}", r"\toprule", header, r"\midrule"]
    return "\n".join([*rules, *body, r"\bottomrule", r"\end{tabular}"])


def render_html(sections: Iterable[Section]) -> str:
    """Render titles, sentences and tables as HTML, for a notebook."""
    blocks: list[str] = []
    for section in sections:
        blocks += [f"<h4>{html.escape(section.title)}</h4>"] if section.title else []
        blocks.append(html_paragraphs([*section.sentences, *section.lines]))
        blocks += [html_table(*aligned_lines(section.table))] if section.table is not None else []
        blocks.append(html_paragraphs(section.notes))
    return "\n".join(filter(None, blocks))


RENDERERS: Mapping[str, Callable[[Iterable[Section]], str]] = {
    "text": render_text,
    "md": render_markdown,
    "latex": render_latex,
    "html": render_html,
}
