"""How a page is put together: chapters of sections in one template, with every text of others escaped."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, NamedTuple

import ctid_cli
from ctid_cli.reporting.document import Section, aligned_lines, pairs
from ctid_cli.reporting.figures.style import Drawing

if TYPE_CHECKING:
    from jinja2 import Template
    from markupsafe import Markup

#: Rows of a table that a page shows; the tables of ``ctid table`` have all of them.
ROWS = 200
#: A cell with more letters than these may be broken into lines.
WORDS = 32
#: A drawing as wide as a page of paper, 7.5 inch, has 52 rem on the screen.
REM_PER_POINT = 52.0 / (7.5 * 72.0)


class Chapter(NamedTuple):
    """Sections under one heading, which the contents of a page name."""

    title: str
    sections: Sequence[Section]

    @property
    def name(self) -> str:
        """Return the anchor of the chapter."""
        return re.sub(r"\W+", "-", self.title.lower())


def write_page(title: str, lead: str, chapters: Sequence[Chapter]) -> str:
    """Return a page as HTML that opens anywhere and loads nothing; empty chapters are left out."""
    known = [chapter for chapter in chapters if chapter.sections]
    return _template().render(version=ctid_cli.__version__, title=title, lead=lead, chapters=known)


@cache
def _template() -> Template:
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    folder = FileSystemLoader(Path(__file__).parent / "templates")
    environment = Environment(
        loader=folder, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters["marked"] = _marked
    environment.globals |= {"row_limit": ROWS, "paragraphs": _paragraphs, "table": _table, "drawn": _drawn}
    return environment.get_template("page.html")


def _marked(text: str) -> Markup:
    """Escape a text, in which backquotes mark names and commands."""
    from markupsafe import Markup, escape

    return Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", str(escape(text))))


def _paragraphs(sentences: Sequence[str], style: str = "") -> Markup:
    """Return paragraphs; a text with line ends is drawn already, one that begins with a hyphen is an item of a list."""
    from markupsafe import Markup

    shown = []
    for text in sentences:
        if "\n" in text:
            shown.append(Markup("<pre>{}</pre>").format(text))
        elif text.startswith("- "):
            shown.append(Markup("<ul><li>{}</li></ul>").format(_marked(text[2:])))
        else:
            shown.append(Markup('<p class="{}">{}</p>').format(style, _marked(text)))
    return Markup("\n").join(shown)


def _table(section: Section) -> Markup:
    """Return the first rows of a table; one without titles of its columns is a list of pairs."""
    from markupsafe import Markup

    (header, *rows), sides = aligned_lines(section)
    titles = [Markup('<th scope="col" class="{}">{}</th>').format(*pair) for pair in zip(sides, header, strict=True)]
    head = Markup("<thead><tr>{}</tr></thead>").format(Markup("").join(titles)) if any(header) else ""
    body = []
    for row in rows[:ROWS]:
        looks = ["words" if side == "l" and len(text) > WORDS else side for side, text in zip(sides, row, strict=True)]
        cells = [
            Markup('<td class="{}" data-title="{}">{}</td>').format(look, name, _marked(text))
            for look, name, text in zip(looks, header, row, strict=True)
        ]
        body.append(Markup("<tr>{}</tr>").format(Markup("").join(cells)))
    kind = "" if any(header) else "pairs"
    return Markup('<table class="{}">{}<tbody>{}</tbody></table>').format(kind, head, Markup("\n").join(body))


def _drawn(drawing: Drawing | bytes, name: str) -> Markup:
    return inline(drawing if isinstance(drawing, bytes) else drawing.laid_out_once(), name)


def inline(svg: bytes, name: str) -> Markup:
    """Return a drawing as part of a page; its names get a prefix, since those of all drawings are the same."""
    from markupsafe import Markup

    text = svg.decode("utf-8")
    drawn = text[text.index("<svg") :]
    drawn = re.sub(r'\bid="', f'id="{name}-', drawn)
    drawn = re.sub(r'href="#', f'href="#{name}-', drawn).replace("url(#", f"url(#{name}-")
    # The drawing's own description holds nothing but addresses of vocabularies.
    drawn = re.sub(r"<metadata>.*?</metadata>", "", drawn, flags=re.DOTALL)
    # All drawings at one scale, so that their letters have one size.
    width = re.search(r'<svg [^>]*?width="([\d.]+)pt"', drawn)
    scale = f' style="max-width: {float(width[1]) * REM_PER_POINT:.4g}rem"' if width else ""
    return Markup(drawn.replace("<svg ", f'<svg role="img"{scale} ', 1))


def shown(word: str) -> str:
    """Return a word without its folder: a page is sent to others, and names no folder of this machine."""
    return PurePath(word).name if PurePath(word).is_absolute() else word


def shown_command(command: str | None) -> str:
    """Return a command without folders of this machine."""
    return shlex.join(map(shown, shlex.split(command or "")))


def provenance(origin: Iterable[Sequence[str]], command: str | None) -> list[Section]:
    """Return what a result was made from, and the command that makes it again."""
    again = ["The same again, in the folder that it was given in:", shown_command(command) + "\n"] if command else []
    return [Section(frame=pairs(origin)), Section(sentences=again)]


def citation(bibtex: str) -> list[Section]:
    """Return what to cite."""
    return [Section(sentences=["ctid, and what this result used of others:", bibtex])]


def sections_of(markdown: str) -> list[Section]:
    """Read published Markdown: headings, paragraphs and tables."""
    import pandas as pd

    found: list[Section] = []
    for part in filter(None, re.split(r"\n\s*\n", markdown.strip())):
        lines = part.splitlines()
        if lines[0].startswith("|") and len(lines) > 1:
            header, _, *rows = ([cell.strip() for cell in _cells(line)] for line in lines)
            found.append(Section(frame=pd.DataFrame(rows, columns=header)))
        elif lines[0].startswith("#"):
            found.append(Section(lines[0].lstrip("# "), [" ".join(lines[1:])] if lines[1:] else []))
        else:
            found.append(Section(sentences=[" ".join(lines)]))
    return found


def _cells(line: str) -> list[str]:
    return [cell.replace("\\|", "|") for cell in re.split(r"(?<!\\)\|", line.strip())[1:-1]]
