"""Start-up of `ctid --help` against the smallest Typer application with four commands, in processor time.

Runs them alternately, each in a fresh interpreter, and prints the medians and their ratio. Exit code 1 if the ratio to
the trivial application with its default settings exceeds 1.5. The ratio to one with plain help, like ctid's, is printed
too; this comparison is stricter, since plain help avoids the import of rich.

    python benchmarks/bench_cli_startup.py [REPETITIONS]
"""

import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

from _timing import cpu_of_children

LIMIT = 1.5

TRIVIAL = """
import typer

app = typer.Typer({options})


@app.command()
def one(name: str) -> None:
    "First."


@app.command()
def two(name: str) -> None:
    "Second."


@app.command()
def three(name: str) -> None:
    "Third."


@app.command()
def four(name: str) -> None:
    "Fourth."


app()
"""


def measure(repetitions: int) -> dict[str, float]:
    """Return the median seconds of each application's help."""
    with tempfile.TemporaryDirectory() as folder:
        rich = Path(folder, "rich_help.py")
        rich.write_text(TRIVIAL.format(options=""))
        plain = Path(folder, "plain_help.py")
        plain.write_text(TRIVIAL.format(options="rich_markup_mode=None"))
        commands = {
            "ctid": [sys.executable, "-m", "ctid_cli.cli.main", "--help"],
            "trivial": [sys.executable, str(rich), "--help"],
            "trivial, plain help": [sys.executable, str(plain), "--help"],
        }
        for command in commands.values():  # fills the caches of compiled modules
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        times: dict[str, list[float]] = {name: [] for name in commands}
        for _ in range(repetitions):
            for name, command in commands.items():
                begun = cpu_of_children()
                subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
                times[name].append(cpu_of_children() - begun)
    return {name: statistics.median(values) for name, values in times.items()}


def main() -> None:
    """Measure the times, print them, and compare them with the limit."""
    repetitions = int(sys.argv[1]) if len(sys.argv) > 1 else 15
    medians = measure(repetitions)
    for name, value in medians.items():
        print(f"{name:20s} {1000 * value:6.0f} ms   ctid / this = {medians['ctid'] / value:.2f}")
    if medians["ctid"] > LIMIT * medians["trivial"]:
        sys.exit(f"`ctid --help` takes more than {LIMIT} times the trivial application")


if __name__ == "__main__":
    main()
