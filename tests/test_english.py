"""Comments, docstrings, messages and pages use standard English terms."""

import io
import re
import tokenize
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

#: Pattern of what must not be written, to what is written instead.
INSTEAD = {
    r"\bfloors?\b": "layer",
    r"\bhouse\b|\bcorridors?\b": "package, module, pipeline",
    r"\brooms?\b": "space, margin",
    r"\bstrangers?\b": "untrusted input, third-party",
    r"\bof one's own\b|\bown components?\b": "custom",
    r"\bguilty\b": "caused by",
    r"\bso many\b": "n, count, the number of",
    r"\b(?:somebody|anybody|nobody|whoever)\b": "the user, another program, an unused default",
    r"\bin one go\b": "atomically, at once",
    r"\bhonest(?:y|ly)?\b": "correct, coverage",
    r"\bwhose failure\b": "failure classification",
    r"\bsecond looks?\b": "re-check",
    r"\bholes?\b": "gap",
    r"\bThe same, (?:for|with|in|as)\b": "the name of the thing again",
}
#: Technical terms that contain such words.
ALLOWED = re.compile(r"noise[ _]floor|room for|np\.floor|math\.floor", re.IGNORECASE)
#: Python 3.11 has a whole f-string as one STRING; later versions have its parts.
TEXTS = {tokenize.COMMENT, tokenize.STRING, getattr(tokenize, "FSTRING_MIDDLE", tokenize.STRING)}


def words_of(path):
    """Yield line numbers and texts of a page, or of the comments and strings of a module."""
    text = path.read_text(encoding="utf-8")
    if path.suffix != ".py":
        yield from enumerate(text.splitlines(), 1)
        return
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type in TEXTS:
            for offset, line in enumerate(token.string.splitlines()):
                yield token.start[0] + offset, line


def files():
    yield from (ROOT / "docs").glob("*.md")
    yield from (ROOT / name for name in ("README.md", "CONTRIBUTING.md"))
    yield from (ROOT / "ctid_cli").rglob("*.py")


def found(pattern, line):
    return re.search(pattern, ALLOWED.sub("", line), re.IGNORECASE)


@pytest.fixture(scope="module")
def lines():
    return [(f"{path.relative_to(ROOT)}:{number}", line) for path in files() for number, line in words_of(path)]


@pytest.mark.parametrize("pattern", INSTEAD)
def test_standard_terms(lines, pattern):
    hits = [f"{place}: {line.strip()}" for place, line in lines if found(pattern, line)]
    assert not hits, f"write {INSTEAD[pattern]!r} instead:\n" + "\n".join(hits)


def test_the_patterns_find_and_allow():
    assert found(r"\bfloors?\b", "every floor of the package")
    assert not found(r"\bfloors?\b", "above the noise floor, np.floor(x)")
