"""What must hold of the study's results."""

from collections.abc import Iterator

from ctid_cli.reporting.comparison import compare
from ctid_cli.reporting.percentages import study_rows
from ctid_cli.reporting.results import Results
from ctid_cli.reporting.study import load_study
from ctid_cli.studies.claims import Claim, within

#: Methods that must find the delay nearly always, wherever they start, and in how many of 100 data sets [%].
RELIABLE = ("redundancy", "delay_profile")
ALWAYS = 99.0


def reaches_the_paper(results: Results) -> Iterator[Claim]:
    """Ours converges as often as the published method was published to, in every cell."""
    study, found = load_study(), {results.experiment: results}
    rows = [row for table in study.tables.values() for row in study_rows(study, table, found)]
    rows = [row for row in rows if row["experiment"] == results.experiment]
    against = compare(rows, None, study).decisive
    if against:
        lower = sum(cell["mismatch"] for cell in against)
        shown = f"{lower} of {len(against)}; the lowest is {min(cell['percent'] for cell in against):.1f} %"
        name = "cells of redundancy below the paper, beyond chance"
        yield within(name, lower, high=0, shown=shown)


def always_converges(results: Results) -> Iterator[Claim]:
    """The methods with redundant filters and those without an initial delay converge from everywhere."""
    for name in RELIABLE:
        judged = [row["converged"] for row in results.rows if row["estimator"] == name]
        if judged:
            percent = 100.0 * sum(judged) / len(judged)
            shown = f"{percent:.2f} % of {len(judged)}"
            yield within(f"{name} converges", percent, low=ALWAYS, shown=shown)
