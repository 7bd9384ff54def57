"""Copy a finished reproduction to results/published: tables, figures, what failed, and the environment that made them.

After ``make reproduce``: ``.venv/bin/python experiments/useful_redundancy/publish.py``.
"""

import argparse
import shutil
from collections.abc import Sequence
from pathlib import Path

from ctid_cli.reporting.failures import FAILING_COLUMNS, failing_estimates
from ctid_cli.reporting.layout import csv_text
from ctid_cli.reporting.publication import copy_figures, environment
from ctid_cli.reporting.results import experiments_in, read_results
from ctid_cli.reporting.study import load_study

#: Methods whose failures are not listed one by one: from most initial delays this one is meant to fail.
UNLISTED = ("existing",)


def main(arguments: Sequence[str] | None = None) -> None:
    """Parse the command line and copy."""
    parser = argparse.ArgumentParser(description="Publish a finished reproduction.")
    parser.add_argument("--results", type=Path, default=Path("results"))
    parser.add_argument("--out", type=Path, default=Path("results/published/useful_redundancy"))
    chosen = parser.parse_args(arguments)
    chosen.out.mkdir(parents=True, exist_ok=True)
    for suffix in ("md", "csv"):
        shutil.copyfile(chosen.results / f"useful_redundancy.{suffix}", chosen.out / f"tables.{suffix}")
    (chosen.out / "failures.csv").write_text(failures(chosen.results), encoding="utf-8")
    (chosen.out / "environment.json").write_text(
        environment(chosen.results, load_study().experiments), encoding="utf-8"
    )
    copy_figures(chosen.results / "useful_redundancy_figures", chosen.out / "figures")


def failures(results: Path) -> str:
    """Every data set that a listed method failed on, as CSV with a header, empty or not."""
    study = load_study()
    methods = [method for method in study.methods if method not in UNLISTED]
    found = [read_results(results, name) for name in study.experiments if name in experiments_in(results)]
    rows = failing_estimates(found, methods)
    return csv_text(rows, list(dict.fromkeys([*FAILING_COLUMNS, *(name for row in rows for name in row)])))


if __name__ == "__main__":
    main()
