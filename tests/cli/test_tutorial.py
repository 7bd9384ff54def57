"""The commands of docs/tutorial.md run on the converter's record, with the output shown on the page."""

import contextlib
import io
import re
import shlex
import shutil
from itertools import pairwise
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8")
CONSOLE = [
    command.split("\n", 1)
    for block in re.findall(r"^```console\n\$ (.*?)^```$", PAGE, re.DOTALL | re.MULTILINE)
    for command in block.split("\n$ ")
]
CODE, PRINTED = re.search(r"^```py\n(.*?)^```$.*?^```text\n(.*?)^```$", PAGE, re.DOTALL | re.MULTILINE).groups()


def digits_of(line):
    """Return a line with its numbers to three digits, which do not depend on the processor."""
    return re.sub(r"-?\d+\.\d+(?:e[-+]\d+)?", lambda number: f"{float(number[0]):.3g}", " ".join(line.split()))


def compare(printed, shown):
    """Assert that the shown lines are printed, in their order."""
    lines = [digits_of(line) for line in printed.splitlines()]
    places = [lines.index(digits_of(line)) for line in shown.splitlines() if line != "..."]
    assert all(one < other for one, other in pairwise(places))


@pytest.mark.slow
def test_what_is_shown_is_what_is_printed(ctid, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copy(ROOT / "configs" / "measured" / "buck_converter.csv", tmp_path)
    names = [shlex.split(command)[1] for command, _ in CONSOLE]
    assert names == ["check", "fit", "fit", "compare", "report"]
    for command, shown in CONSOLE:
        compare(ctid(*shlex.split(command)[1:]).stdout, shown)
    with contextlib.redirect_stdout(io.StringIO()) as out:
        exec(CODE, {})
    compare(out.getvalue(), PRINTED)
    assert Path("converter.html").read_bytes() == Path("two_poles/fit.html").read_bytes()
