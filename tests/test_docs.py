"""What the documentation's Python examples print is what the pages show."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
EXAMPLE = re.compile(r"^```python\n(.*?)^```$.*?^```text\n(.*?)^```$", re.DOTALL | re.MULTILINE)
PAGES = [page.name for page in sorted((ROOT / "docs").glob("*.md")) if "```python" in page.read_text(encoding="utf-8")]


def test_examples_are_found():
    assert "useful-redundancy.md" in PAGES


@pytest.mark.parametrize("page", PAGES)
def test_examples_print_what_is_shown(page):
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    examples = EXAMPLE.findall(text)
    assert len(examples) == text.count("```python")
    for code, shown in examples:
        done = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT, timeout=300
        )
        assert done.stdout == shown
