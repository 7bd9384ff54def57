"""Result protocol: the interface of every printed result, and the renderers of its sections."""

from __future__ import annotations

import html
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
class Section:
    """One part of a result: a title, sentences, a table, and a figure, each of them optional."""

    title: str = ""
    sentences: Sequence[str] = ()
    frame: pd.DataFrame | None = None
    #: Format of the numbers of a column, such as ``.2f``; ``.6g`` by default.
    formats: Mapping[str, str] = field(default_factory=dict)
    #: Lines that are never wrapped, such as paths and commands.
    lines: Sequence[str] = ()
    #: Sentences below the table, on the meaning of its columns.
    notes: Sequence[str] = ()
    #: A figure to draw, or an SVG file.
    drawing: Drawing | bytes | None = None
    caption: str = ""

    @classmethod
    def table(cls, rows: Iterable[object], columns: Sequence[Column], **parts: Any) -> Section:
        """Return a table of objects or mappings; columns without any value are left out."""
        import pandas as pd

        keys = [column.key for column in columns]
        frame = pd.DataFrame([picked(row, keys).values() for row in rows], columns=[each.header for each in columns])
        formats = {column.header: column.form for column in columns}
        return cls(frame=frame.dropna(axis=1, how="all"), formats=formats, **parts)


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

    def to_frame(self) -> pd.DataFrame:
        """Return the main table of the result; one row of its content if there is none."""
        import pandas as pd

        frames = [section.frame for section in self.sections() if section.frame is not None]
        return frames[0] if frames else pd.DataFrame([self.content()])

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
            frame = self.to_frame().copy()
            for name, values in frame.select_dtypes(["object", "str"]).items():
                held = values.map(lambda value: isinstance(value, list | dict)).astype(bool)
                frame[name] = values.mask(held, values[held].map(json.dumps))
            return str(frame.to_csv(index=_is_named(frame), lineterminator="\n")).rstrip("\n")
        return RENDERERS[form](self.sections())

    def _repr_html_(self) -> str:
        return self.write("html")


def pairs(rows: Iterable[Sequence[str]]) -> pd.DataFrame:
    """Return labels and texts as a table without titles, which is rendered as a list."""
    import pandas as pd

    return pd.DataFrame(rows, columns=["", ""])


def cell(value: Any, form: str = ".6g") -> str:
    """Return a cell of a table as text: a number in its format, a dash if there is none."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return written_out(format(value, form)) if math.isfinite(value) else "-"
    return "-" if value is None else str(value)


def _is_named(frame: pd.DataFrame) -> bool:
    return frame.index.name is not None


def aligned_lines(section: Section) -> tuple[list[list[str]], str]:
    """Return header and rows of a table as texts, and the side of each column: texts left (l), numbers right (r)."""
    assert section.frame is not None
    frame = section.frame.reset_index() if _is_named(section.frame) else section.frame
    columns, sides = [], ""
    for name, values in frame.items():
        form = section.formats.get(str(name), ".6g")
        columns.append([str(name), *(cell(value, form) for value in values.tolist())])
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
        parts += [_text_table(*aligned_lines(section), columns)] if section.frame is not None else []
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
        if section.frame is not None:
            (header, *rows), sides = aligned_lines(section)
            blocks.append(markdown_table(header, rows, sides))
        blocks += section.notes
    return "\n\n".join(blocks)


def render_latex(sections: Iterable[Section]) -> str:
    """Render tables in LaTeX (booktabs), with titles and sentences as comments."""
    blocks: list[str] = []
    for section in sections:
        comments = [*([section.title] if section.title else []), *section.sentences, *section.lines]
        blocks += [f"% {line}" for text in comments for line in text.splitlines()]
        blocks += [_latex_table(*aligned_lines(section))] if section.frame is not None else []
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
        blocks += [html_table(*aligned_lines(section))] if section.frame is not None else []
        blocks.append(html_paragraphs(section.notes))
    return "\n".join(filter(None, blocks))


RENDERERS: Mapping[str, Callable[[Iterable[Section]], str]] = {
    "text": render_text,
    "md": render_markdown,
    "latex": render_latex,
    "html": render_html,
}
