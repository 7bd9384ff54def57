"""Tables of the published study with our percentages and those of the article, and tables by name."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from ctid_cli.errors import UsageError
from ctid_cli.reporting.document import Section, Table
from ctid_cli.reporting.layout import delay_label, number, seconds
from ctid_cli.reporting.measures import percentage_frame, records_of, settings_of, with_types
from ctid_cli.reporting.results import (
    Results,
    differences,
    experiments_in,
    find_results,
    out_option,
    read_results,
    shown_path,
)
from ctid_cli.reporting.study import Study, StudyTable, data_folder, find_study
from ctid_cli.reporting.surprises import surprises
from ctid_cli.reporting.table_result import (
    NOT_RUN,
    RULE,
    TIME,
    TableResult,
    experiment_table,
    joined,
    labels_of,
    measure_table,
    named,
    notes_of,
    percent_text,
    pivot,
    time_of,
)
from ctid_cli.specification.load import load_spec
from ctid_cli.storage.columns import COUNTS
from ctid_cli.storage.folder import InUseError
from ctid_cli.text import did_you_mean, listed

#: Lines of every cell of the table.
LINES = ("%", "95 %", "published", "time")


def build_tables(
    names: Sequence[str], out: Path, *, committed: bool = False, measures: Sequence[str] = ()
) -> TableResult:
    """Return the requested tables; committed ones replace those that were not run, if allowed."""
    study, tables = find_study(), []
    if measures:
        names = [results.experiment for results in experiments(names, out, "--measure")]
    for name in names or [study.name]:
        study_name, _, number = name.rpartition("/")
        if measures:
            results = read_results(out, name)
            tables.append(measure_table(results, measures, [*notes_of(results, out), *surprises(results)]))
        elif name == study.name:
            tables += [study_table(study, k, out, committed=committed) for k in study.tables]
        elif number.isdigit() and study_name in ("", study.name):
            if int(number) not in study.tables:
                raise UsageError(f"{study.name} has no table {number}; it has {', '.join(map(str, study.tables))}")
            tables.append(study_table(study, int(number), out, committed=committed))
        else:
            results = _results_called(name, study, out)
            tables.append(experiment_table(results, [*notes_of(results, out), *surprises(results)]))
    return joined(tables)


def experiments(names: Sequence[str], out: Path, option: str) -> list[Results]:
    """Return the results of the experiments of an option."""
    if not names:
        raise UsageError(f"{option} needs the name of an experiment: ctid table NAME {option} …")
    return [read_results(out, name) for name in names]


def _results_called(name: str, study: Study, out: Path) -> Results:
    results = find_results(out, name)
    if results is None:
        known = [*map(str, study.tables), study.name, *experiments_in(out)]
        hint = did_you_mean(name, known) or "."
        wrong = f"{name!r} is neither a table nor an experiment with results in the folder {out}{hint}"
        raise UsageError(f"{wrong} Known: {', '.join(known)}")
    return results


def study_table(study: Study, number: int, out: Path, *, committed: bool = False) -> TableResult:
    """Return one published table with our percentages, as far as its experiments were run."""
    table = study.tables[number]
    notes: list[str] = []
    known: set[str] = set()
    found: dict[str, Results] = {}
    for name in table.experiments:
        results, estimators, remarks = _results_of(study, name, out)
        if results is not None:
            found[name] = results
        known |= estimators
        notes += remarks
    frame, file = study_frame(study, table, found), committed_tables() if committed and not found else None
    if file is not None:
        every = read_tables(file)
        frame = every[every["table"] == number].reset_index(drop=True)
        remark = made_by(file.parent)
        notes.insert(0, f"these are the committed results of {shown_path(file)}" + (f", {remark}" if remark else ""))
    published = set(table.published["method"])
    if missing := [method for method in study.methods if known and method in published - known]:
        which = ", ".join(missing)
        notes.append(f"no experiment has the estimator {which} yet; its rows show the published values only")
    options = [*dict.fromkeys(name for results in found.values() for name in results.swept("estimators"))]
    return TableResult(records_of(frame), study_sections(study, table, frame, options), notes)


def _results_of(study: Study, name: str, out: Path) -> tuple[Results | None, set[str], list[str]]:
    """Return the results of one experiment, its actual and expected estimators, and remarks."""
    config = data_folder("configs") / study.experiments[name]["config"]
    specification = load_spec(config).canonical()
    command = f"ctid run {shown_path(config)}{out_option(out)}"
    try:
        results = find_results(out, name)
    except InUseError as error:
        return None, set(), [f"{name} has no stored results yet: {error}"]
    if results is None:
        return None, set(), [f"{name} was not run. To fill its rows:\n  {command}"]
    estimators = results.settings["estimators"].keys() | specification["estimators"].keys()
    departures = _departures(results, specification, set(study.fields.values()), command)
    return results, estimators, [*departures, *notes_of(results, out)]


def _departures(results: Results, specification: Mapping[str, Any], shown: set[str], command: str) -> Iterator[str]:
    """Yield the differences of results from the published specification."""
    absent = [method for method in specification["estimators"] if method not in results.settings["estimators"]]
    if absent:
        which = f"the estimator {', '.join(absent)} of its specification"
        yield f"{results.experiment} was run without {which}; to add it:\n  {command}"
    if changed := differences(results.settings, specification, shown):
        yield f"{results.experiment} was run with other settings than the published ones: {'; '.join(changed)}"


# --- rows -----------------------------------------------------------------------------------------------------------


def study_frame(study: Study, table: StudyTable, found: Mapping[str, Results]) -> pd.DataFrame:
    """Return the cells of a published table, published or run, by sampling, settings and method in their order."""
    keys, random = ["experiment", *study.fields, "method", "initial_delay"], table.initial_delays == ("random",)
    own = [percentage_frame(found[name], table.number, study.fields) for name in table.experiments if name in found]
    cells = [table.published]
    if own:
        # Estimates without a start are in the tables of fixed and of random starts.
        ours = pd.concat(own, ignore_index=True).drop(columns="published_percent")
        ours = ours[ours["initial_delay"].isna() | ((ours["initial_delay"] == "random") == random)]
        all_run = ours.merge(table.published, on=keys, how="left")
        cells = [table.published.merge(ours, on=keys, how="left"), all_run[all_run["published_percent"].isna()]]
    frame = pd.concat([each for each in cells if len(each)], ignore_index=True)
    frame["table"] = table.number
    frame["sampling"] = frame["experiment"].map({name: one["sampling"] for name, one in study.experiments.items()})
    first, last = ["table", "experiment", "sampling"], ["initial_delay", "method", *COUNTS]
    others = [name for name in settings_of(frame) if name not in first]
    return _sorted(study, with_types(frame))[[*first, *others, *last]]


def _sorted(study: Study, frame: pd.DataFrame) -> pd.DataFrame:
    """Return rows by sampling, settings and method, also for methods from different experiments."""
    orders = {name: frame[name].unique().tolist() for name in ("sampling", *study.fields)}
    orders["method"] = [*dict.fromkeys([*study.methods, *frame["method"]])]
    places = pd.DataFrame({name: frame[name].map(order.index) for name, order in orders.items()})
    return frame.loc[places.sort_values([*places], kind="stable").index].reset_index(drop=True)


# --- presentation ---------------------------------------------------------------------------------------------------


def study_sections(study: Study, table: StudyTable, frame: pd.DataFrame, options: Sequence[str] = ()) -> list[Section]:
    """Return a published table, the pool of all its cells, and the meaning of its columns."""
    published = f"Published: {study.published_data_sets} data sets, {study.citation}."
    foot = f"{RULE} {TIME}. {published}"
    if startless := frame["method"][frame["initial_delay"].isna()].unique().tolist():
        shown = "one estimate per data set, shown under every initial delay"
        foot += f" {listed(startless)} {'was' if len(startless) == 1 else 'were'} given no initial delay: {shown}."
    methods = frame["method"].unique()
    legend = "; ".join(f"{name}: {study.methods[name]}" for name in methods if name in study.methods) + "."
    pooled = pooled_frame(study, table, frame, options)
    return [
        Section(f"Table {table.number}. {table.title}", [f"Counted: {study.success}."]),
        Section(table=Table.of_frame(_lines_by_delay(frame))),
        Section("", ["All cells of the table together:"], Table.of_frame(pooled.drop(columns="converged"))),
        Section(notes=[foot, legend]),
    ]


def _lines_by_delay(frame: pd.DataFrame) -> pd.DataFrame:
    """Return initial delays across, and for each method a line for each of ``LINES``."""
    rows, startless = records_of(frame), frame["initial_delay"].isna()
    labels = frame[["sampling"]].join(labels_of(frame, "method").drop(columns="initial delay", errors="ignore"))
    place = labels.agg("\n".join, axis=1) + startless.astype(str)
    texts = {
        "%": [percent_text(row) if row["n"] else "-" for row in rows],
        "95 %": ["" if row["low"] is None else f"{row['low']:.0f}-{row['high']:.0f}" for row in rows],
        "published": ["" if row["published_percent"] is None else number(row["published_percent"]) for row in rows],
        "time": [seconds(time_of(row)) if row["n"] else "" for row in rows],
    }
    delays = sorted(set(frame["initial_delay"].dropna()), key=lambda delay: (isinstance(delay, str), delay))
    titles = [delay_label(delay) for delay in delays or [None]]
    # An estimate without a start is shown under every initial delay.
    under = [
        titles if none else [delay_label(delay)] for delay, none in zip(frame["initial_delay"], startless, strict=True)
    ]
    sizes = place.map(frame["n"].groupby(place).agg(_sizes))
    cells = labels.assign(n=sizes, under=pd.Series(under, labels.index), **texts)
    keys = [*labels, "n"]
    one_line_each = cells.explode("under").set_index([*keys, "under"])[[*LINES]].stack()
    assert isinstance(one_line_each, pd.Series)
    long = one_line_each.rename_axis([*keys, "under", "line"]).rename("text").reset_index()
    lines = pivot(long, [*keys, "line"], "under", ["text"])[[*keys, "line", *titles]]
    lines = lines[(lines[titles] != "").any(axis=1)].reset_index(drop=True)
    # A label equal to the one above is left out, as in a printed table.
    repeated = lines[keys].eq(lines[keys].shift()).cummin(axis=1)
    lines[keys] = lines[keys].mask(repeated, "")
    return lines.rename(columns={"line": "initial delay"})


def _sizes(counts: pd.Series) -> str:
    """Return the least and the greatest number of data sets that were run."""
    run = counts[counts > 0]
    return "-".join(dict.fromkeys([str(run.min()), str(run.max())])) if len(run) else "0"


def pooled_frame(study: Study, table: StudyTable, frame: pd.DataFrame, options: Sequence[str] = ()) -> pd.DataFrame:
    """Return each method, with each combination of its swept options, over all cells of a published table.

    There is no interval: cells of one row share their data sets, so their estimates are not independent trials. The
    published percentage is the mean over the cells with estimates, or over all cells if none has any [%].
    """
    places = table.published[["experiment", *study.fields]].drop_duplicates()
    samplings = places["experiment"].map({name: one["sampling"] for name, one in study.experiments.items()})
    cells = len(places.assign(experiment=samplings).drop_duplicates())
    shown = frame.merge(places, on=[*places])
    startless = shown["initial_delay"].isna()
    shown = shown.assign(startless=startless)[startless | shown["initial_delay"].isin(table.initial_delays)]
    pooled = []
    for _, group in shown.groupby(["method", "startless", *options], sort=False, dropna=False):
        run = group[(group["n"] > 0) & group["converged"].notna()]
        first, n, converged = records_of(group)[0], int(run["n"].sum()), int(run["converged"].sum())
        planned = cells * (1 if first["startless"] else len(table.initial_delays))
        published = (group if run.empty else run)["published_percent"].astype(float).mean()
        pooled.append(
            {
                "method": named(first["method"], first, options),
                "cells": str(planned) if len(run) == planned else f"{len(run)} of {planned}",
                "n": n,
                "converged": converged,
                "percent": f"{100 * converged / n:.1f}" if n else NOT_RUN,
                "published": "" if published != published else f"{published:.1f}",
                "time": _span(time_of(row) for row in records_of(run)),
            }
        )
    return pd.DataFrame(pooled)


def _span(times: Iterable[float | None]) -> str:
    """Return the range of the median times of cells."""
    known = [time for time in times if time is not None]
    return " to ".join(dict.fromkeys(map(seconds, (min(known), max(known))))) if known else ""


# --- committed tables -----------------------------------------------------------------------------------------------


def committed_tables() -> Path | None:
    """Return the file of the committed tables, None if there is none."""
    file = find_study().published / "tables.csv"
    return file if file.is_file() else None


def read_tables(file: Path) -> pd.DataFrame:
    """Read tables that ``ctid table --format csv`` wrote."""
    frame: pd.DataFrame = pd.read_csv(file, dtype="str")
    texts = ["experiment", "sampling", "method", "initial_delay"]
    frame = frame.astype(dict.fromkeys(frame.columns.difference(texts), "float64"))
    delays = pd.to_numeric(frame["initial_delay"], errors="coerce").astype(object)
    frame["initial_delay"] = delays.where(delays.notna(), frame["initial_delay"])
    return frame.astype(dict.fromkeys(("table", "n", "failed"), "int64") | {"converged": "Int64"})


def environment_of(published: Path) -> dict[str, Any] | None:
    """Return the commit and the sessions of the published results in a folder; None if there are none."""
    try:
        content: dict[str, Any] = json.loads((published / "environment.json").read_text(encoding="utf-8"))
    except OSError:
        return None
    return content


def made_by(published: Path) -> str:
    """Return the code that computed the published results in a folder, as a participle clause; empty if unknown."""
    environment = environment_of(published)
    return f"computed at commit {environment['commit'][:12]}" if environment else ""
