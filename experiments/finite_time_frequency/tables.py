"""Published tables of the study: all measures as numbers, and tables for readers."""

from collections.abc import Sequence
from functools import partial

import pandas as pd

from ctid_cli.reporting.document import Section, Table
from ctid_cli.reporting.layout import number
from ctid_cli.reporting.results import Results
from ctid_cli.studies.catalogue import StudyResults

from . import as_printed
from .figures import DERIVED
from .measures import BANDS, READINGS, efficiency, is_derived, recovery, residuals, settling

#: Titles of the experiments of the paper.
TITLES = {
    "two-tones": "Section VI-A, sin 2t + cos 3t, no noise (figure 1)",
    "harmonic": "Section VI-B, sin 2t + sin 3t disturbed by 0.25 sin 15t (figure 2)",
    "random": "Section VI-B, sin 2t + sin 3t, noise uniform in ±0.2 (figure 3)",
    "step": "Section VI-C, step of both frequencies at 30 s, no noise (figure 4)",
}
#: Formats of the columns that hold numbers.
RMS = "rms error, 80 to 90 s"
FORMATS = {
    **dict.fromkeys(("rms w1", "rms w2", RMS, "standard deviation"), ".2g"),
    **dict.fromkeys(("valid [%]", "valid, off by 0.05 [s]", "false alarms"), ".3g"),
}


def tables(found: StudyResults) -> list[Section]:
    """Return the tables for readers."""
    text = "`observer`, `filter` and `filter_gradient` are derived, not the published algorithms: the equations of the "
    text += "two comparators of the paper were not to be had. Frequencies and errors in rad/s, times in s."
    parts = [Section(sentences=[text])]
    for name, title in TITLES.items():
        if name in found:
            parts += [Section(title), *paper_tables(found[name])]
    beyond = {"recovery": recovery_table, "recovery-in-noise": noisy_recovery_table, "efficiency": efficiency_table}
    parts += [write(found[name]) for name, write in beyond.items() if name in found]
    return [*parts, Section("The formulas as they are printed", table=Table.of_frame(as_printed.table()))]


def named(estimator: str) -> str:
    """Return the label of an estimator in the tables."""
    return f"`{estimator}`, {DERIVED}" if is_derived(estimator) else f"`{estimator}`"


def times(values: pd.Series, digits: int = 2) -> pd.Series:
    """Return times [s] as text; infinite ones in words."""
    return values.map(f"{{:.{digits}f}}".format).mask(values.isna(), "never")


def across(rows: pd.DataFrame, key: str, order: Sequence[object], columns: Sequence[str], title: str) -> pd.DataFrame:
    """Return some columns for each value of a key, by estimator, derived ones last."""
    wide = rows.pivot(index="estimator", columns=key, values=list(columns))
    found = wide[[(column, value) for value in order for column in columns]]
    derived = rows.drop_duplicates("estimator").sort_values("derived", kind="stable")["estimator"]
    return found.loc[derived].set_axis([title.format(value, column) for column, value in found], axis=1)


def paper_tables(results: Results) -> list[Section]:
    """Return settling times and errors of one experiment of the paper, one table for each reading of the step."""
    settled, left = settling(results), residuals(results)
    pieces = settled["piece"].unique().tolist()
    several, bands = len(pieces) > 1, [f"within_{band:g}" for band in BANDS]
    window, runs = results.settings["success"]["window"], left["data_sets"].max()
    explained = (
        f"Time until both errors are below a band to stay{', each piece from its beginning' if several else ''}, to "
        f"0.01 s; root-mean-square errors over {window[0]:g} to {window[1]:g} s "
        f"({f'medians of {runs} data sets, ' if runs > 1 else ''}last columns: share of valid estimates, and how long "
        "one was called valid with an error above 0.05). Whole records: error of the one estimate."
    )
    after = {"jump": "Phase w(t) t, as printed: it jumps. ", "continuous": "Phase the integral of w(t). "}
    settled[bands] = settled[bands].apply(times)
    written = []
    for reading, own in left.groupby("reading", sort=False):
        of_reading = settled[settled["reading"] == reading]
        table = across(own, "tone", [1, 2], ["rms"], "rms w{0}")
        within = across(of_reading, "piece", pieces, bands, "{1}, {0}" if several else "{1}")
        within.columns = [name.replace("within_", "within " if f"{BANDS[0]:g}" in name else "") for name in within]
        first = own.groupby("estimator")["valid_share"].first()
        wrong = of_reading.drop_duplicates("estimator").set_index("estimator")["valid_but_off_by_0.05"]
        table = within.reindex(table.index).join(table).assign(**{"valid [%]": first, "valid, off by 0.05 [s]": wrong})
        table = table.rename(index=named).reset_index()
        written.append(Section("", [after.get(reading, "") + explained], Table.of_frame(table, FORMATS)))
    return written


def recovery_table(results: Results) -> Section:
    """Return recovery times of the frequencies after a step without noise."""
    rows = recovery(results)
    rows["median"] = times(rows["median"], 3)
    table = across(rows, "reading", READINGS, ["median"], "{0} [s]").rename(index=named).reset_index()
    text = "Time from the step until both errors are below 1e-6, to stay to the end, 60 s after the step."
    return Section("Beyond the paper: recovery from the step without noise", [text], Table.of_frame(table))


def noisy_recovery_table(results: Results) -> Section:
    """Return recovery times of the frequencies after a step in noise."""
    rows = recovery(results)
    text = (
        f"White Gaussian noise of standard deviation 0.11547, {rows['data_sets'].max()} data sets for each reading. "
        "Time from the step until both errors are below 0.02, to stay to the end, 60 s after the step. False alarms "
        "over all data sets; rms error: median of the worse tone."
    )
    shown = pd.DataFrame({"median [s]": times(rows["median"]), "longest [s]": times(rows["longest"])})
    shown = shown.assign(**{"never": rows["never"].map(str), "false alarms": rows["false_alarms"], RMS: rows["rms"]})
    table = across(shown.join(rows[["estimator", "reading", "derived"]]), "reading", READINGS, [*shown], "{0}: {1}")
    table.columns = [name if name.endswith(": median [s]") else name.partition(": ")[2] for name in table]
    table = table.rename(index=named).reset_index()
    return Section("Beyond the paper: recovery from the step in noise", [text], Table.of_frame(table, FORMATS))


def efficiency_table(results: Results) -> Section:
    """Return errors over the Cramer-Rao bound, including the bias."""
    rows = efficiency(results)
    bounds = " and ".join(number(bound, 3) for bound in rows.drop_duplicates("tone")["bound"])
    text = (
        f"{rows['data_sets'][0]} data sets. The Cramer-Rao bound is that of Gaussian noise of the same variance: "
        f"standard deviations of {bounds} rad/s. ± is one standard deviation of the Monte Carlo; valid: mean share of "
        "the 20 s, for whole records share of the data sets."
    )
    shown = pd.DataFrame({"rms error / bound": _pairs(rows, "ratio", 3, 2), "bias": _pairs(rows, "bias", 2, 1)})
    shown["standard deviation"] = rows["deviation"]
    table = across(shown.join(rows[["estimator", "tone", "derived"]]), "tone", [1, 2], [*shown], "w{0}: {1}")
    table.columns = [name if name.endswith("bound") else name.partition(": ")[2] for name in table]
    valid = rows.drop_duplicates("estimator").set_index("estimator")["valid_share"]
    table = table.assign(**{"valid [%]": valid}).rename(index=named).reset_index()
    return Section(
        "Beyond the paper: errors after 20 s of the noise of section VI-B", [text], Table.of_frame(table, FORMATS)
    )


def _pairs(rows: pd.DataFrame, name: str, digits: int, of_error: int) -> pd.Series:
    """Return values with their Monte Carlo errors as text."""
    values, errors = rows[name], rows[f"{name}_error"]
    return values.map(partial(number, digits=digits)) + " ± " + errors.map(partial(number, digits=of_error))
