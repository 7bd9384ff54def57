"""Construction of a page: chapters of sections in one template, with all external text escaped."""

from __future__ import annotations

import re
import shlex
from abc import abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any, NamedTuple

import ctid_cli
from ctid_cli.reporting.document import Result, Section, Table, aligned_lines
from ctid_cli.reporting.figures.style import Drawing
from ctid_cli.reporting.layout import html_paragraphs, html_table

if TYPE_CHECKING:
    from jinja2 import Template
    from markupsafe import Markup

#: Most rows of a table on a page; the tables of ``ctid table`` have all of them.
ROWS = 200
#: A drawing as wide as a page of paper, 7.5 inch, is 52 rem wide on the screen.
REM_PER_POINT = 52.0 / (7.5 * 72.0)


class Chapter(NamedTuple):
    """Sections under one heading, listed in the contents of a page."""

    title: str
    sections: Sequence[Section]

    @property
    def name(self) -> str:
        """Anchor of the chapter."""
        return re.sub(r"\W+", "-", self.title.lower())


def write_page(title: str, lead: str, chapters: Sequence[Chapter]) -> str:
    """Return a self-contained HTML page; empty chapters are left out."""
    known = [chapter for chapter in chapters if chapter.sections]
    return _template().render(version=ctid_cli.__version__, title=title, lead=lead, chapters=known)


@cache
def _template() -> Template:
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    folder = FileSystemLoader(Path(__file__).parent / "templates")
    environment = Environment(
        loader=folder, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.globals |= {"row_limit": ROWS, "paragraphs": _paragraphs, "table": _table, "drawn": _drawn}
    return environment.get_template("page.html")


def _paragraphs(sentences: Sequence[str], style: str = "") -> Markup:
    from markupsafe import Markup

    return Markup(html_paragraphs(sentences, style))


def _table(table: Table) -> Markup:
    """Return the first rows of a table."""
    from markupsafe import Markup

    lines, sides = aligned_lines(table)
    return Markup(html_table(lines[: ROWS + 1], sides))


def _drawn(drawing: Drawing | bytes, name: str) -> Markup:
    return inline(drawing if isinstance(drawing, bytes) else drawing.saved(), name)


def inline(svg: bytes, name: str) -> Markup:
    """Return a drawing as part of a page; its identifiers get a prefix, since those of all drawings are the same."""
    from markupsafe import Markup

    text = svg.decode("utf-8")
    drawn = text[text.index("<svg") :]
    drawn = re.sub(r'\bid="', f'id="{name}-', drawn)
    drawn = re.sub(r'href="#', f'href="#{name}-', drawn).replace("url(#", f"url(#{name}-")
    # The drawing's own description contains only addresses of vocabularies.
    drawn = re.sub(r"<metadata>.*?</metadata>", "", drawn, flags=re.DOTALL)
    # All drawings have one scale, so that their letters have one size.
    width = re.search(r'<svg [^>]*?width="([\d.]+)pt"', drawn)
    scale = f' style="max-width: {float(width[1]) * REM_PER_POINT:.4g}rem"' if width else ""
    return Markup(drawn.replace("<svg ", f'<svg role="img"{scale} ', 1))


def shown(word: str) -> str:
    """Return a word without its folder: pages are sent to others, and show no folder of this machine."""
    return PurePath(word).name if PurePath(word).is_absolute() else word


def shown_command(command: str | None) -> str:
    """Return a command without folders of this machine."""
    return shlex.join(map(shown, shlex.split(command or "")))


class PagedResult(Result):
    """A result of a record that has a page: content, diagnostics, and how to reproduce it."""

    @property
    @abstractmethod
    def fine(self) -> str:
        """Sentence in place of warnings."""

    @abstractmethod
    def page_head(self) -> tuple[str, str]:
        """Return the title of the page, and its first sentence."""

    @abstractmethod
    def chapters(self) -> Iterable[Chapter]:
        """Return the chapters of the page."""

    @abstractmethod
    def cited(self) -> Sequence[str]:
        """Return keys of ``citations.bib``."""

    def page(self, stored: Mapping[str, Any]) -> str:
        """Return the page as HTML, with the origin stored in the file of the result."""
        warnings = [f"- {text}" for text in stored["warnings"]] or [self.fine]
        words = ["ctid, and the articles on the methods of this result:", bibtex("ctid", *self.cited())]
        chapters = [
            Chapter("Warnings", [Section(sentences=warnings)]),
            *self.chapters(),
            Chapter("Provenance", _provenance(stored)),
            Chapter("How to cite", [Section(sentences=words)]),
        ]
        return write_page(*self.page_head(), chapters)


def bibtex(*keys: str) -> str:
    """Return entries of ``citations.bib``."""
    text = Path(__file__).parents[1].joinpath("citations.bib").read_text(encoding="utf-8")
    found = {key: entry for entry, key in re.findall(r"(?ms)^(@\w+\{(\w+),.*?^\})", text)}
    return "\n\n".join(found[key] for key in keys).replace("VERSION", ctid_cli.__version__)


def _provenance(stored: Mapping[str, Any]) -> list[Section]:
    """Return the data of a result, and the command that reproduces it."""
    sources = [("record", each) for each in stored.get("records", [stored.get("record")])]
    sources += [("validation record", stored["validation"])] if stored.get("validation") else []
    rows = [("ctid", str(stored["ctid"]))]
    for label, each in sources:
        if each["path"] is None:
            rows.append((label, "its samples are in the file"))
            continue
        how = [f"{key} {each[key]}" for key in ("hold", "interval", "from", "to") if each.get(key) is not None]
        columns = [(role, name if isinstance(name, list) else [name]) for role, name in each["columns"].items() if name]
        how += [f"{role} {name!r}" for role, names in columns for name in names]
        rows += [(label, ", ".join([shown(each["path"]), *how])), ("its SHA-256", each["sha256"])]
    rows.append(("checksum of the file", str(stored.get("checksum", ""))))
    command = shown_command(stored["command"]) + "\n"
    again = ["Command, to be run in the same folder:", command] if stored["command"] else []
    return [Section(table=Table.of_pairs(rows)), Section(sentences=again)]


def sections_of(markdown: str) -> list[Section]:
    """Read published Markdown: headings, paragraphs and tables."""
    found: list[Section] = []
    for part in filter(None, re.split(r"\n\s*\n", markdown.strip())):
        lines = part.splitlines()
        if lines[0].startswith("|") and len(lines) > 1:
            header, _, *rows = ([cell.strip() for cell in _cells(line)] for line in lines)
            found.append(Section(table=Table.of_lines(header, rows)))
        elif lines[0].startswith("#"):
            found.append(Section(lines[0].lstrip("# "), [" ".join(lines[1:])] if lines[1:] else []))
        else:
            found.append(Section(sentences=[" ".join(lines)]))
    return found


def _cells(line: str) -> list[str]:
    return [cell.replace("\\|", "|") for cell in re.split(r"(?<!\\)\|", line.strip())[1:-1]]
