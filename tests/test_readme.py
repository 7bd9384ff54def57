"""The README's commands, Python code and experiment run in an empty folder, with the output that it shows."""

import contextlib
import io
import re
import shlex
from pathlib import Path

import pytest
from typer.testing import CliRunner

from ctid_cli.cli.main import app
from ctid_cli.running import engine
from tests.cli.conftest import Here

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
COMMANDS = [shlex.split(line, comments=True)[1:] for line in re.findall(r"^    (ctid .*)$", README, re.MULTILINE)]


def blocks(language):
    return re.findall(rf"^```{language}\n(.*?)^```", README, re.DOTALL | re.MULTILINE)


@pytest.fixture(scope="module")
def printed(tmp_path_factory):
    """Return the output of each command by its words, and the folder in which all were run in order."""
    folder = tmp_path_factory.mktemp("readme")
    (specification,) = blocks("yaml")
    (folder / "study.yaml").write_text(specification, encoding="utf-8")
    outputs = {}
    with pytest.MonkeyPatch.context() as patch, contextlib.chdir(folder):
        patch.setattr(engine, "LocalWorkers", Here)
        for words in COMMANDS:
            done = CliRunner().invoke(app, words)
            assert done.exit_code == 0, f"ctid {' '.join(words)}\n{done.output}"
            outputs[" ".join(words)] = done.stdout
    return folder, outputs


def test_it_is_short():
    assert len(README.splitlines()) <= 110
    sentence = README.split("\n\n")[1]
    assert len(sentence.split()) <= 20
    assert len([line for line in blocks("python")[0].splitlines() if line]) <= 8
    assert len(blocks("yaml")[0].splitlines()) <= 12


@pytest.mark.slow
def test_the_commands_write_what_the_python_example_reads(printed):
    folder, outputs = printed
    assert {words.split()[0] for words in outputs} == {"init", "check", "fit", "report", "run", "table"}
    assert (folder / "measured-example.csv").is_file()
    assert (folder / "fit.html").stat().st_size > 10_000


@pytest.mark.slow
def test_the_table_is_the_one_shown(printed):
    """Processor times differ, and an estimate at the limit of the success rule may differ on another processor."""
    shown = blocks("text")[1].splitlines()
    table = printed[1]["table study"].splitlines()[: len(shown)]
    assert [line.split()[:4] for line in table[:4]] == [line.split()[:4] for line in shown[:4]]
    rows = {line[:21].strip(): line for line in table[5:]}
    for line in shown[5:]:
        percent, wanted = (int(re.search(r"(\d+) +\[", text)[1]) for text in (rows[line[:21].strip()], line))
        assert abs(percent - wanted) <= 10


@pytest.mark.slow
def test_the_python_example_prints_what_is_shown(printed):
    with contextlib.chdir(printed[0]), contextlib.redirect_stdout(io.StringIO()) as out:
        exec(blocks("python")[0], {})
    assert out.getvalue() == blocks("text")[0]


def test_linked_files_exist():
    links = re.findall(r"\]\(([^)#:]+)\)", README)
    assert links
    for link in links:
        assert (ROOT / link).exists(), link


def test_named_configs_exist():
    names = set(re.findall(r"configs/[\w/]+\.yaml", README))
    assert names == {"configs/quickstart.yaml"}
    assert all((ROOT / name).is_file() for name in names)


NUMBERS = [
    ("useful_redundancy/searches.md", r"case2-regular \| (?:5|15) dB \| existing .*?\| (\d+) %", ["37", "32"]),
    ("useful_redundancy/searches.md", r"case2-regular \| (?:5|15) dB \| delay_profile \|  \| (\d+)", ["100", "100"]),
    (
        "coverage/coverage.md",
        r"ARMA noise \| (?:sandwich, t|white \(misused\)) \| delay \| 1.3 \| ([\d.]+)",
        ["95.0", "77.2"],
    ),
    (
        "additive/claims.md",
        r"MSE of clsrivc / MSE of additive, g1_a2, .*? \| (.*?) \|",
        ["2.798 ± 0.194; theory 2.574"],
    ),
]


@pytest.mark.parametrize(("file", "pattern", "numbers"), NUMBERS, ids=[numbers[0] for *_, numbers in NUMBERS])
def test_numbers_are_those_of_the_published_results(file, pattern, numbers):
    text = (ROOT / "results" / "published" / file).read_text(encoding="utf-8")
    assert re.findall(pattern, text) == numbers
