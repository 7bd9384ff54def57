"""What is published of the study: its four tables, data sets on which a method failed, and how the searches went."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from ctid_cli.reporting.layout import markdown_table
from ctid_cli.reporting.measures import ALWAYS
from ctid_cli.reporting.results import Results, lookup
from ctid_cli.reporting.study_table import build_tables
from ctid_cli.studies.catalogue import StudyResults, last_part

#: Methods whose failures are not listed one by one: from most initial delays this one is meant to fail.
UNLISTED = ("existing",)

#: What stands above the table of the searches.
SEARCHES = """\
How the searches went: estimates within 1 % of the true delay, and how many of the searches ended there before they were
refined on unfiltered data; searches that switched the filter at least once, and the most switches of one."""


def markdown(found: StudyResults) -> str:
    """The tables for people."""
    return build_tables([], found.out).write("md") + "\n"


def cells(found: StudyResults) -> str:
    """The tables as numbers."""
    return build_tables([], found.out).write("csv") + "\n"


def failures(results: Results) -> Iterator[dict[str, Any]]:
    """Estimates that did not meet the success rule, each with what is needed to make it again."""
    constant = {name: lookup(results.settings, path) for name, path in ALWAYS.items()}
    constant |= {"sampling": results.sampling, "seed": results.manifest["seed"]}
    for row in results.rows:
        if row["converged"] is False and row["estimator"] not in UNLISTED:
            yield constant | row | {"method": row["estimator"]}


def searches(results: Results) -> Iterator[dict[str, Any]]:
    """Of each estimator of an experiment and SNR: its share of successes, before refinement too, and its switches."""
    within = lookup(results.settings, "success.delay_relative_error")
    groups: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for row in results.rows:
        snr = row.get("snr_db", lookup(results.settings, "noise.snr_db"))
        groups.setdefault((snr, row["estimator"], row.get("max_delay_step")), []).append(row)
    for (snr, method, step), rows in groups.items():
        found = [row for row in rows if row.get("search_delay") is not None]
        ends = [abs(row["search_delay"] / row["true_delay"] - 1) < within for row in found]
        switches = [row["switches"] for row in found]
        yield {
            "experiment": results.experiment,
            "snr_db": snr,
            "method": method,
            "max_delay_step": step,
            "n": len(rows),
            "percent": 100.0 * float(np.mean([bool(row["converged"]) for row in rows])),
            "search_percent": 100.0 * float(np.mean(ends)) if found else None,
            "switched": sum(count > 0 for count in switches) if found else None,
            "most_switches": max(switches) if found else None,
            "median_seconds": float(np.median([row["seconds"] for row in rows])),
        }


def searches_markdown(found: StudyResults) -> str:
    """The same for people."""
    header = [
        "experiment",
        "SNR",
        "method",
        "longest step",
        "n",
        "converged",
        "search alone",
        "switched",
        "most",
        "time",
    ]
    body = [
        [
            last_part(row["experiment"]),
            f"{row['snr_db']:g} dB",
            row["method"],
            "" if row["max_delay_step"] is None else f"{row['max_delay_step']:g} s",
            str(row["n"]),
            f"{row['percent']:.0f} %",
            *(
                ["", "", ""]
                if row["search_percent"] is None
                else [f"{row['search_percent']:.0f} %", str(row["switched"]), str(row["most_switches"])]
            ),
            f"{row['median_seconds']:.2g} s",
        ]
        for results in found.experiments.values()
        for row in searches(results)
    ]
    return f"{SEARCHES}\n\n{markdown_table(header, body, 'lrlrrrrrrr')}\n"
