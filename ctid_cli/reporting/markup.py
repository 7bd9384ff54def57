"""Sentences and tables as HTML, with every text of others escaped."""

import re
from collections.abc import Sequence
from html import escape

#: A cell with more letters than these may be broken into lines.
WORDS = 32


def marked(text: str) -> str:
    """Escape a text, in which backquotes mark names and commands."""
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", escape(text))


def paragraphs(sentences: Sequence[str], style: str = "") -> str:
    """Return paragraphs; a text with line ends is drawn already, one that begins with a hyphen is an item of a list."""
    shown = []
    for text in sentences:
        if "\n" in text:
            shown.append(f"<pre>{escape(text)}</pre>")
        elif text.startswith("- "):
            shown.append(f"<ul><li>{marked(text[2:])}</li></ul>")
        else:
            shown.append(f'<p class="{style}">{marked(text)}</p>')
    return "\n".join(shown)


def table(lines: Sequence[Sequence[str]], sides: str) -> str:
    """Return header and rows as a table, each column left (l) or right (r); without titles it is a list of pairs."""
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
