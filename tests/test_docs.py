"""The documentation's Python examples print what the pages show."""

import contextlib
import dataclasses
import io
import json
import re
from pathlib import Path

import pytest

from ctid_cli.kinds import KINDS, classes
from ctid_cli.models.controller import ContinuousPid, Relay
from ctid_cli.signals.sampling import InstantsFile
from ctid_cli.specification.messages import option_docs

ROOT = Path(__file__).resolve().parents[1]
EXAMPLE = re.compile(r"^```python\n(.*?)^```$.*?^```text\n(.*?)^```$", re.DOTALL | re.MULTILINE)
PAGES = [page.name for page in sorted((ROOT / "docs").glob("*.md")) if "```python" in page.read_text(encoding="utf-8")]


def test_examples_are_found():
    assert {"custom-components.md", "track.md"} <= set(PAGES)


#: Pages whose examples choose a structure, or noise models.
LONG = ("noise.md", "tutorial.md")


@pytest.mark.parametrize("page", [pytest.param(page, marks=[pytest.mark.slow] * (page in LONG)) for page in PAGES])
def test_examples_print_what_is_shown(page):
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    examples = EXAMPLE.findall(text)
    assert len(examples) == text.count("```python")
    for code, shown in examples:
        with contextlib.chdir(ROOT), contextlib.redirect_stdout(io.StringIO()) as out:
            exec(code, {"__name__": "__main__"})
        assert out.getvalue() == shown


def keys_of(schema):
    """Yield the keys of all objects of a JSON Schema."""
    parts = schema if isinstance(schema, list) else schema.values() if isinstance(schema, dict) else []
    if isinstance(schema, dict):
        yield from schema.get("properties", {})
    for part in parts:
        yield from keys_of(part)


@pytest.mark.parametrize("file", sorted((ROOT / "docs" / "schemas").glob("*.json")), ids=lambda file: file.stem)
def test_every_key_of_printed_json_is_documented(file):
    pages = (page.read_text(encoding="utf-8") for page in (ROOT / "docs").glob("*.md"))
    code = " ".join(re.findall(r"`([^`\n]+)`", "\n".join(pages)))
    assert {*keys_of(json.loads(file.read_text(encoding="utf-8")))} <= {*re.findall(r"\w+", code)}


#: Sources of the tables of docs/signals.md.
SIGNALS = [
    (kind, target)
    for section in ("excitation", "sampling", "noise")
    for kind, target in {name: classes(section)[name] for name in KINDS[section]}.items()
] + [("file", InstantsFile), ("continuous_pid", ContinuousPid), ("relay", Relay)]


def options_of(target):
    for option in dataclasses.fields(target):
        if option.name not in ("sha256", "input_record"):
            unit = re.search(r" \[[^\]]+\]", option_docs(target)[option.name])
            default = "" if option.default in (dataclasses.MISSING, None) else f" = {option.default}"
            yield f"`{option.name}`{unit[0] if unit else ''}{default}"


@pytest.mark.parametrize(("kind", "target"), SIGNALS, ids=[kind for kind, _ in SIGNALS])
def test_the_tables_of_signals_are_made_from_the_classes(kind, target):
    """On failure, the message contains the expected row."""
    summary = target.__doc__.strip().splitlines()[0].replace("``", "`")
    row = f"| `{kind}` | {summary} | {', '.join(options_of(target))} |"
    assert row in (ROOT / "docs" / "signals.md").read_text(encoding="utf-8").splitlines()
