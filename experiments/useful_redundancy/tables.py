"""What is published of the study: its four tables, and every data set on which a method failed."""

from collections.abc import Iterator
from typing import Any

from ctid_cli.reporting.layout import write_reports
from ctid_cli.reporting.percentages import ALWAYS
from ctid_cli.reporting.results import Results, lookup
from ctid_cli.reporting.tables import build_tables
from ctid_cli.studies.catalogue import StudyResults

#: Methods whose failures are not listed one by one: from most initial delays this one is meant to fail.
UNLISTED = ("existing",)


def markdown(found: StudyResults) -> str:
    """The tables for people."""
    return write_reports(build_tables([], found.out, "md"), "md") + "\n"


def cells(found: StudyResults) -> str:
    """The tables as numbers."""
    return write_reports(build_tables([], found.out), "csv") + "\n"


def failures(results: Results) -> Iterator[dict[str, Any]]:
    """Estimates that did not meet the success rule, each with what is needed to make it again."""
    constant = {name: lookup(results.settings, path) for name, path in ALWAYS.items()}
    constant |= {"sampling": results.sampling, "seed": results.manifest["seed"]}
    for row in results.rows:
        if row["converged"] is False and row["estimator"] not in UNLISTED:
            yield constant | row | {"method": row["estimator"]}
