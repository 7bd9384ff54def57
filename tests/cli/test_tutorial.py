"""The commands of docs/tutorial.md run, and print what it shows.

Its record may not be copied into the project: the commands run on the example that ``ctid init measured`` writes. Where
the variable CTID_PT326 names a folder with pt326_est.csv and pt326_val.csv, the numbers are compared too.
"""

import contextlib
import io
import os
import re
import shlex
import shutil
from itertools import pairwise
from pathlib import Path

import pytest

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "tutorial.md").read_text(encoding="utf-8")
EXAMPLE = Path(__file__).resolve().parents[2] / "ctid_cli" / "templates" / "measured-example.csv"
CONSOLE = re.findall(r"^```console\n\$ (.*?)\n(.*?)^```$", PAGE, re.DOTALL | re.MULTILINE)
(CODE,) = re.findall(r"^```py\n(.*?)^```$", PAGE, re.DOTALL | re.MULTILINE)
(PRINTED,) = re.findall(r"^```text\n(.*?)^```$", PAGE, re.DOTALL | re.MULTILINE)
PT326 = os.environ.get("CTID_PT326")


def run_all(ctid):
    """What the commands and the lines of Python print, with what the page shows of it."""
    assert [shlex.split(command)[:2] for command, _ in CONSOLE] == [
        ["ctid", name] for name in ("check", "fit", "fit", "report")
    ]
    for command, shown in CONSOLE:
        yield ctid(*shlex.split(command)[1:]).stdout, shown
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        exec(CODE, {})
    yield printed.getvalue(), PRINTED


def test_the_commands_run_on_the_example_of_the_project(ctid, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    head, *rows = EXAMPLE.read_text(encoding="utf-8").splitlines()
    for name, part in (("est", rows[:250]), ("val", rows[250:400])):
        Path(f"pt326_{name}.csv").write_text("\n".join([head, *part]), encoding="utf-8")
    *_, (page, _), (steps, shown) = run_all(ctid)
    assert page == "heater.html\n"
    assert Path("heater.html").read_bytes() == Path("two_poles/fit.html").read_bytes()
    assert len(steps.splitlines()) == len(shown.splitlines())
    assert sorted(path.name for path in Path("one_pole").iterdir()) == ["fit.json", "fit.svg"]


@pytest.mark.skipif(PT326 is None, reason="CTID_PT326 names no folder with the record")
def test_what_is_shown_is_what_is_printed(ctid, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("est", "val"):
        shutil.copy(Path(str(PT326)) / f"pt326_{name}.csv", tmp_path)
    for printed, shown in run_all(ctid):
        lines = [line for line in shown.splitlines() if line != "..."]
        places = [printed.splitlines().index(line) for line in lines]
        assert all(one < other for one, other in pairwise(places))
