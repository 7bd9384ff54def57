"""Claims on the study's results."""

from collections.abc import Iterator

import pandas as pd

from ctid_cli.reporting.comparison_result import tested
from ctid_cli.reporting.results import Results
from ctid_cli.reporting.study import find_study
from ctid_cli.reporting.study_table import study_frame
from ctid_cli.studies.claims import Claim, within

#: Method whose percentages must not be below the published ones. The existing method depends on details that are not
#: printed.
OURS = "redundancy"
#: Methods that must find the delay nearly always, from any start, and in how many of 100 data sets [%].
RELIABLE = ("redundancy", "delay_profile")
ALWAYS = 99.0


def reaches_the_paper(results: Results) -> Iterator[Claim]:
    """Test that our method converges as often as the published one, in every cell."""
    study, found = find_study(), {results.experiment: results}
    rows = pd.concat([study_frame(study, table, found) for table in study.tables.values()], ignore_index=True)
    ours = rows[(rows["experiment"] == results.experiment) & (rows["method"] == OURS) & (rows["n"] > 0)]
    ours = ours.dropna(subset=["published_percent", "converged"])
    if len(ours):
        published = (ours["published_percent"].astype(float) * study.published_data_sets / 100).round()
        cells = tested(ours.assign(reference_n=study.published_data_sets, reference_converged=published))
        lower = int((cells["differs"] & (cells["percent"] < cells["reference_percent"])).sum())
        shown = f"{lower} of {len(cells)}; the lowest is {cells['percent'].min():.1f} %"
        yield within(f"cells of {OURS} below the paper, beyond chance", lower, high=0, shown=shown)


def always_converges(results: Results) -> Iterator[Claim]:
    """Test that methods with redundant filters, or without an initial delay, converge from everywhere."""
    estimates = results.estimates
    for name in RELIABLE:
        own = estimates.loc[estimates["estimator"] == name, "converged"]
        if len(own):
            percent = 100.0 * own.sum() / len(own)
            shown = f"{percent:.2f} % of {len(own)}"
            yield within(f"{name} converges", percent, low=ALWAYS, shown=shown)
