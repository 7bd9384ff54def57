"""Claims on the study's results."""

from collections.abc import Iterator

import pandas as pd

from ctid_cli.reporting.comparison_result import compare
from ctid_cli.reporting.results import Results
from ctid_cli.reporting.study import find_study
from ctid_cli.reporting.study_table import study_frame
from ctid_cli.studies.claims import Claim, within

#: Methods that must find the delay nearly always, from any start, and in how many of 100 data sets [%].
RELIABLE = ("redundancy", "delay_profile")
ALWAYS = 99.0


def reaches_the_paper(results: Results) -> Iterator[Claim]:
    """Test that our method converges as often as the published one, in every cell."""
    study, found = find_study(), {results.experiment: results}
    rows = pd.concat([study_frame(study, table, found) for table in study.tables.values()], ignore_index=True)
    against = compare(rows[rows["experiment"] == results.experiment], None, study).decisive
    if len(against):
        lower = int(against["mismatch"].sum())
        shown = f"{lower} of {len(against)}; the lowest is {against['percent'].min():.1f} %"
        name = "cells of redundancy below the paper, beyond chance"
        yield within(name, lower, high=0, shown=shown)


def always_converges(results: Results) -> Iterator[Claim]:
    """Test that methods with redundant filters, or without an initial delay, converge from everywhere."""
    estimates = results.estimates
    for name in RELIABLE:
        judged = estimates.loc[estimates["estimator"] == name, "converged"]
        if len(judged):
            percent = 100.0 * judged.sum() / len(judged)
            shown = f"{percent:.2f} % of {len(judged)}"
            yield within(f"{name} converges", percent, low=ALWAYS, shown=shown)
