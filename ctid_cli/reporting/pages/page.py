"""How a page is put together: a template filled with reports and figures, with every text of others escaped."""

import re
import shlex
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any, NamedTuple

from ctid_cli.reporting.figures.style import Drawing
from ctid_cli.reporting.layout import Report, Table

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup

#: Rows of a table that a page shows; the tables of ``ctid table`` have all of them.
ROWS = 200
#: A drawing as wide as a page of paper, 7.5 inch, has 52 rem on the screen.
REM_PER_POINT = 52.0 / (7.5 * 72.0)


def written(template: str, **content: Any) -> str:
    """A page from one of the templates, each of which extends ``base.html``."""
    return _environment().get_template(template).render(content)


@cache
def _environment() -> "Environment":
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    folder = FileSystemLoader(Path(__file__).parent / "templates")
    environment = Environment(
        loader=folder, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.tests["table"] = lambda item: isinstance(item, Table)
    environment.filters["marked"] = _marked
    environment.globals["row_limit"] = ROWS
    return environment


def _marked(text: str) -> "Markup":
    """A text in which backquotes mark names."""
    from markupsafe import Markup, escape

    return Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", str(escape(text))))


def inline(svg: bytes, name: str) -> "Markup":
    """A drawing as part of a page; its names get a prefix, since those of all drawings are the same."""
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


class Chapter(NamedTuple):
    """Figures of one thing, and what to know of them."""

    name: str
    title: str
    figures: Sequence[Mapping[str, Any]]
    notes: Sequence[str] = ()


def figure(drawing: Drawing, name: str, caption: str) -> dict[str, Any]:
    """A drawing with what it shows."""
    return {"svg": inline(drawing.laid_out_once(), name), "caption": caption, "command": ""}


def shown(word: str) -> str:
    """A page is sent to others: nothing in it names a folder of this machine."""
    return PurePath(word).name if PurePath(word).is_absolute() else word


def shown_command(command: str | None) -> str:
    """A command without folders of this machine."""
    return shlex.join(map(shown, shlex.split(command or "")))


def report_of(markdown: str) -> Report:
    """Markdown as the house writes it: headings, paragraphs and tables."""
    blocks: list[list[str | Table]] = []
    for part in re.split(r"\n\s*\n", markdown.strip()):
        lines = part.splitlines()
        if lines[0].startswith("|") and len(lines) > 1:
            header, rule, *rows = ([cell.strip() for cell in _cells(line)] for line in lines)
            blocks.append([Table(header, rows, "".join("r" if cell.endswith("-:") else "l" for cell in rule))])
        elif lines[0].startswith("#"):
            blocks.append(["### " + lines[0].lstrip("# ")])
            blocks += [[" ".join(lines[1:])]] if lines[1:] else []
        else:
            blocks.append([" ".join(lines)])
    return Report(blocks)


def _cells(line: str) -> list[str]:
    return [cell.replace("\\|", "|") for cell in re.split(r"(?<!\\)\|", line.strip())[1:-1]]
