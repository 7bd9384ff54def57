"""Help, start-up, and unexpected errors."""

import errno
import re
import subprocess
import sys
from pathlib import Path

import pytest
import typer

import ctid_cli
from ctid_cli import __version__
from ctid_cli.cli.main import app
from ctid_cli.errors import ExitCode
from ctid_cli.reporting import study_table

EXAMPLE = Path(ctid_cli.__file__).parent / "templates" / "measured-example.csv"
COMMANDS = typer.main.get_group(app).commands

#: Modules that may be imported before a command needs them: half a second each would be longer than the work.
HELP = (
    "from ctid_cli.cli.main import app\ntry: app(['--help'])\nexcept SystemExit: pass",
    {"numpy", "scipy", "pandas", "numba", "h5py", "joblib", "pydantic", "rich"},
)
WORKER = (
    "import importlib, pkgutil, ctid_cli.estimators as package\n"
    "import ctid_cli.running.job, ctid_cli.running.workers, ctid_cli.simulation.dataset\n"
    "for module in pkgutil.iter_modules(package.__path__, 'ctid_cli.estimators.'):\n"
    "    importlib.import_module(module.name)",
    {*("scipy." + name for name in ("signal", "stats", "optimize", "special", "fft", "linalg", "io"))}
    | {"pandas", "h5py", "pydantic", "typer", "rich", "matplotlib"},
)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself_and_its_options_in_80_columns(ctid, command):
    summary = re.search(rf"^  {command} +([A-Z].*)$", ctid("--help").stdout, re.MULTILINE)[1]
    # A longer one would be truncated.
    assert summary.endswith(".")
    assert not summary.endswith("...")
    lines = ctid(f"{command} --help").stdout.splitlines()
    assert f" {command} " in lines[0]
    assert max(map(len, lines)) <= 80
    for line in lines:
        option = re.match(r"^  (-\w, )?--[\w-]+(  +(\S.*))?$", line)
        assert option is None or option.group(2) is None or option.group(3)


def test_version(ctid):
    assert ctid("--version").stdout == f"ctid {__version__}\n"


@pytest.mark.parametrize(("code", "slow"), [HELP, WORKER], ids=["help", "worker"])
def test_nothing_slow_is_imported(code, slow):
    check = f"{code}\nimport sys; found = {slow!r} & set(sys.modules); assert not found, found"
    subprocess.run([sys.executable, "-c", check], check=True, capture_output=True, timeout=120)


def test_a_fit_prints_before_it_loads_what_draws(tmp_path):
    """Typer itself imports pydantic, so that only what ctid needs it for is tested."""
    slow = {"pandas", "matplotlib", "rich", "jinja2", "h5py", "ctid_cli.specification", "ctid_cli.simulation"}
    slow |= {f"scipy.{name}" for name in ("signal", "stats", "optimize")}
    arguments = ["fit", str(EXAMPLE), "--poles", "1", "--zeros", "0", "--delay", "0:20"]
    code = f"""
import sys
from ctid_cli.cli.main import app
from ctid_cli.reporting.figures.style import Drawing
Drawing.saved = lambda drawing: sys.exit(f"imported: {{ {slow!r} & set(sys.modules) }}")
app({arguments!r})
"""
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=300, check=False
    )
    assert "std error" in done.stdout
    assert done.stderr.splitlines()[-1] == "imported: set()"
    assert [file.name for file in tmp_path.iterdir()] == ["fit.json"]


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (ZeroDivisionError("nobody expected this"), ExitCode.INTERNAL),
        (OSError(errno.EBADF, "bad descriptor"), ExitCode.INTERNAL),
        (OSError(errno.ENOSPC, "no space left", "journal"), ExitCode.STORAGE),
        (FileNotFoundError(errno.ENOENT, "No usable temporary directory found in ['/tmp']"), ExitCode.STORAGE),
        (OSError(errno.ENAMETOOLONG, "too long", "9" * 500), ExitCode.BAD_INPUT),
        (KeyboardInterrupt(), ExitCode.INTERRUPTED),
    ],
)
def test_errors_of_the_program_and_of_the_machine(ctid, monkeypatch, tmp_path, snapshot, error, code):
    def broken(*_, **__):
        raise error

    monkeypatch.setattr(study_table, "build_tables", broken)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "results").mkdir()
    message = ctid("table tiny", code=code).stderr
    assert re.sub(r"error-[\d-]+\.txt", "error-(time).txt", message) == snapshot
    # Details of program errors are in the folder of the results.
    reports = [path.read_text(encoding="utf-8") for path in (tmp_path / "results").iterdir()]
    assert len(reports) == (code == ExitCode.INTERNAL)
    assert all("Traceback" in report and str(error) in report for report in reports)
