"""Published tables of the study: all errors as numbers, and selected tables for readers."""

from collections.abc import Iterable, Sequence
from functools import partial

import numpy as np
import pandas as pd

from ctid_cli.reporting.document import Section, Table
from ctid_cli.reporting.layout import number
from ctid_cli.reporting.results import Results
from ctid_cli.reporting.study import last_part
from ctid_cli.reporting.table_result import pivot
from ctid_cli.studies.catalogue import StudyResults

from .measures import errors_of, groups_of, is_misused, ratios

#: Numbers of samples shown in the text, out of all.
SIZES = 6
#: Experiments on coverage.
COVERING = ("coverage-open-loop", "coverage-closed-loop")
TITLES = {
    "open-loop": "Open loop, section 6.1 (figure 3)",
    "closed-loop": "Closed loop, section 6.2 (figure 4)",
    "closed-loop-coloured": "Closed loop with coloured noise",
    "flexible-beam": "Flexible beam, SIMULATED stand-in (figure 6)",
}


def coverage(results: Results) -> pd.DataFrame:
    """Return the coverage of 95 % intervals."""
    misused = {name: "yes" if is_misused(results, name) else "no" for name in results.settings["estimators"]}
    return errors_of(results).assign(misused=lambda frame: frame["estimator"].map(misused))


def unfinished(results: Results) -> pd.DataFrame:
    """Return every estimate that failed or did not converge, with the data to reproduce it."""
    samples = {cell["hash"]: cell["content"]["sampling"]["samples"] for cell in results.manifest["data_cells"]}
    estimates = results.estimates
    samples = estimates["cell"].map(samples)
    return estimates.assign(samples=samples, seed=results.manifest["seed"])[estimates["status"] != "CONVERGED"]


def tables(found: StudyResults) -> list[Section]:
    """Return the tables for readers."""
    parts = []
    for name, title in TITLES.items():
        if name not in found:
            continue
        results = found[name]
        parts += [Section(title), Section(table=Table.of_frame(convergence_table(results)))]
        if name in ("open-loop", "closed-loop"):
            said = "N times the mean-square error; in brackets its ratio to theory."
            parts.append(Section("", [said], Table.of_frame(error_table(results))))
            said = "Mean-square error over that of the sum of submodels, ± standard error."
            parts += [Section("", [said]), *(Section(table=Table.of_frame(table)) for table in ratio_tables(results))]
        elif name == "closed-loop-coloured":
            said = "Bias in standard deviations of one estimate; in brackets in standard errors."
            parts.append(Section("", [said], Table.of_frame(bias_table(results))))
        else:
            parts.append(Section("", ["Estimates and truth over all data sets."], Table.of_frame(beam_table(results))))
    covering = [found[name] for name in COVERING if name in found]
    if covering:
        parts.append(Section("Coverage of 95 % intervals [%]", table=Table.of_frame(coverage_table(covering))))
    return parts


def some(sizes: Iterable[int]) -> list[int]:
    """Return a few numbers of samples, including the least and the greatest."""
    ordered = sorted(set(sizes))
    return [ordered[k] for k in np.unique(np.linspace(0, len(ordered) - 1, SIZES).round().astype(int))]


def convergence_table(results: Results) -> pd.DataFrame:
    """Return counts of unsuccessful estimates; all estimates with a value count in the tables below."""
    titles = {"runs": "estimates", "not_converged": "not converged", "failed": "failed", "valueless": "without a value"}
    sums = groups_of(results).groupby("estimator", sort=False)[[*titles]].sum()
    return sums.rename(columns=titles).reset_index()


def error_table(results: Results) -> pd.DataFrame:
    """Return N times the mean-square error at a few numbers of samples."""
    parts = []
    for _, own in errors_of(results).groupby("estimator", sort=False):
        shown = own[own["samples"].isin(some(own["samples"]))].assign(N=lambda frame: frame["samples"].astype(str))
        pairs = zip(shown["n_mse"], shown["ratio"], strict=True)
        cells = [f"{number(value, 3)} ({number(ratio, 3)})" for value, ratio in pairs]
        last = own[own["samples"] == own["samples"].max()].assign(N="theory")
        parts += [shown.assign(text=cells), last.assign(text=last["theory"].map(partial(number, digits=4)))]
    return pivot(pd.concat(parts), ["estimator", "N"], "parameter", ["text"], "-")


def ratio_tables(results: Results) -> list[pd.DataFrame]:
    """Return paired ratios at a few numbers of samples, one table for each other estimator."""
    written = []
    for estimator, own in ratios(results).groupby("estimator", sort=False):
        title = f"{estimator}: N"
        shown = own[own["samples"].isin(some(own["samples"]))]
        pairs = zip(shown["ratio"], shown["standard_error"], strict=True)
        shown = shown.assign(**{title: shown["samples"].astype(str), "text": [f"{r:.2f} ± {e:.2f}" for r, e in pairs]})
        last = own.drop_duplicates("parameter")
        last = last.assign(**{title: "theory", "text": last["theory"].map("{:.3f}".format)})
        written.append(pivot(pd.concat([shown, last]), [title], "parameter", ["text"]))
    return written


def bias_table(results: Results) -> pd.DataFrame:
    """Return biases, one line for each estimator."""
    errors = errors_of(results).fillna({"bias_per_deviation": 0.0, "bias_per_error": 0.0})
    pairs = zip(errors["bias_per_deviation"], errors["bias_per_error"], strict=True)
    return pivot(errors.assign(text=[f"{a:+.2f} ({b:+.1f})" for a, b in pairs]), ["estimator"], "parameter", ["text"])


def beam_table(results: Results) -> pd.DataFrame:
    """Return mean and scatter of each parameter of the beam."""
    errors = errors_of(results).dropna(subset="bias")
    return pd.DataFrame(
        {
            "parameter": errors["parameter"],
            "true": errors["true"].map(partial(number, digits=4)),
            "mean estimate": (errors["true"] + errors["bias"]).map(partial(number, digits=4)),
            "standard deviation": errors["deviation"].map(partial(number, digits=2)),
            "n": errors["counted"],
        }
    )


def coverage_table(experiments: Sequence[Results]) -> pd.DataFrame:
    """Return coverage with its interval, one line for each parameter."""
    found = pd.concat([coverage(results) for results in experiments])
    ends = zip(found["low"], found["high"], strict=True)
    return pd.DataFrame(
        {
            "experiment": found["experiment"].map(last_part),
            "formula": found["estimator"] + found["misused"].map({"yes": " (misused)", "no": ""}),
            "parameter": found["parameter"],
            "covered": found["coverage"].map(partial(number, digits=3)),
            "95 % interval": ["-" if low != low else f"{low:.1f} to {high:.1f}" for low, high in ends],
            "standard error / scatter": found["error_ratio"].map(partial(number, digits=3)),
            "n": found["counted"],
        }
    )
