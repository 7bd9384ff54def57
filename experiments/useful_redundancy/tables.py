"""Published tables of the study: its four tables, failed data sets, and statistics of the searches."""

import pandas as pd

from ctid_cli.reporting.document import Section, Table
from ctid_cli.reporting.measures import ALWAYS
from ctid_cli.reporting.results import Results, lookup
from ctid_cli.reporting.study import last_part
from ctid_cli.reporting.study_table import build_tables
from ctid_cli.studies.catalogue import StudyResults

#: Methods whose failures are not listed, because they fail from most initial delays by design.
UNLISTED = ("existing",)

#: Text above the table of the searches.
SEARCHES = """\
How the searches went: estimates within 1 % of the true delay, and how many of the searches ended there before they were
refined on unfiltered data; searches that switched the filter at least once, and the most switches of one."""


def markdown(found: StudyResults) -> list[Section]:
    """Return the tables for readers."""
    return build_tables([], found.out).sections()


def cells(found: StudyResults) -> str:
    """Return the tables as numbers."""
    return build_tables([], found.out).write("csv") + "\n"


def failures(results: Results) -> pd.DataFrame:
    """Return estimates that did not meet the success rule, with the data to reproduce them."""
    estimates = _with_settings(results)
    estimates = estimates[(estimates["converged"] == False) & ~estimates["method"].isin(UNLISTED)]  # noqa: E712
    return estimates.assign(sampling=results.sampling, seed=results.manifest["seed"])


def _with_settings(results: Results) -> pd.DataFrame:
    """Return the estimates with the settings that are columns of tables, swept or not."""
    estimates = results.estimates.rename(columns={"estimator": "method"})
    constant = {name: lookup(results.settings, path) for name, path in ALWAYS.items() if name not in estimates}
    return estimates.assign(**constant)


def searches(results: Results) -> pd.DataFrame:
    """Return the share of successes of each estimator and SNR, also before refinement, and its switches."""
    within = lookup(results.settings, "success.delay_relative_error")
    estimates = _with_settings(results)
    estimates["max_delay_step"] = estimates.get("max_delay_step")
    found = estimates["search_delay"].notna()
    estimates["ended"] = (100.0 * ((estimates["search_delay"] / estimates["true_delay"] - 1).abs() < within)).where(
        found
    )
    estimates["switched"] = (estimates["switches"] > 0).where(found)
    groups = estimates.groupby(["experiment", "snr_db", "method", "max_delay_step"], sort=False, dropna=False)
    frame = groups["converged"].agg(["size", "mean"]).set_axis(["n", "percent"], axis=1)
    frame["percent"] *= 100.0
    frame["search_percent"] = groups["ended"].mean()
    frame["switched"], frame["most_switches"] = groups["switched"].sum(min_count=1), groups["switches"].max()
    return frame.assign(median_seconds=groups["seconds"].median()).reset_index()


def searches_table(found: StudyResults) -> list[Section]:
    """Return the share of successes for readers."""
    rows = pd.concat([searches(results) for results in found.experiments.values()], ignore_index=True)
    searched = rows["search_percent"].notna()
    shown = pd.DataFrame({"experiment": rows["experiment"].map(last_part), "SNR": rows["snr_db"].map("{:g} dB".format)})
    steps = rows["max_delay_step"].map("{:g} s".format, na_action="ignore").astype(object).fillna("")
    shown = shown.assign(method=rows["method"], **{"longest step": steps}, n=rows["n"])
    shown["converged"] = rows["percent"].map("{:.0f} %".format)
    shown["search alone"] = rows["search_percent"].map("{:.0f} %".format).where(searched, "")
    shown["switched"] = rows["switched"].map(str).where(searched, "")
    shown["most"] = rows["most_switches"].map(str).where(searched, "")
    shown = shown.assign(time=rows["median_seconds"].map("{:.2g} s".format))
    return [Section("", [SEARCHES], Table.of_frame(shown))]
