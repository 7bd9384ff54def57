"""What is published of the study: its four tables, and every data set on which a method failed."""

from __future__ import annotations

from typing import Any

from ctid_cli.reporting.layout import csv_text, write_reports
from ctid_cli.reporting.percentages import ALWAYS
from ctid_cli.reporting.results import lookup
from ctid_cli.reporting.tables import build_tables
from ctid_cli.studies.catalogue import StudyResults

#: Methods whose failures are not listed one by one: from most initial delays this one is meant to fail.
UNLISTED = ("existing",)
#: Columns of the list of failures.
COLUMNS = (
    *("experiment", "sampling", "snr_db", "method", "initial_delay", "start_delay", "replicate", "seed"),
    *("delay", "true_delay", "status", "id"),
)


def markdown(found: StudyResults) -> str:
    """The tables for people."""
    return write_reports(build_tables([], found.out, "md"), "md") + "\n"


def cells(found: StudyResults) -> str:
    """The tables as numbers."""
    return write_reports(build_tables([], found.out), "csv") + "\n"


def failures(found: StudyResults) -> str:
    """Estimates that did not meet the success rule, each with what is needed to make it again."""
    failing: list[dict[str, Any]] = []
    for results in found.experiments.values():
        constant = {name: lookup(results.settings, path) for name, path in ALWAYS.items()}
        constant |= {"sampling": results.sampling, "seed": results.manifest["seed"]}
        for row in results.rows:
            if row["converged"] is False and row["estimator"] not in UNLISTED:
                content = constant | row | {"method": row["estimator"]}
                failing.append({name: content[name] for name in COLUMNS})
    return csv_text(failing, COLUMNS)
