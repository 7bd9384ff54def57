"""Table cells as plain rows: percentages over the data sets of one setting, with the published ones beside them.

Keys of a row
-------------
- ``table``, ``experiment``, ``sampling``; one key per swept field; ``initial_delay``: where the search started [s],
  ``"random"``, or None for an estimator that needs no start; ``method``: name of the estimator.
- ``n``, ``failed``, ``converged``; ``percent`` with its 95 % Wilson interval ``low`` and ``high`` [%];
  ``published_percent`` [%]; ``median_seconds``: median time of one estimate [s].
- Of frequencies of a signal: ``median_settling_time`` and ``median_settling_after_step`` of the slowest tone [s], None
  where half of the data sets or more never settled; ``median_rms_1 …`` [rad/s]; ``false_alarms`` of all data sets.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from statistics import median
from typing import Any

from ctid_cli.reporting.results import Results, lookup
from ctid_cli.reporting.study import Study, StudyTable
from ctid_cli.simulation.frequency_measures import base_name, measure_names
from ctid_cli.storage.columns import reserved_names
from ctid_cli.storage.manifest import is_of_signal

Row = dict[str, Any]

#: Settings that are keys of every row, and their key path in a specification.
ALWAYS = {"snr_db": "noise.snr_db"}

#: What stands in a cell that was not run.
NOTHING = {
    "n": 0,
    "failed": 0,
    "converged": 0,
    "percent": None,
    "low": None,
    "high": None,
    "published_percent": None,
    "median_seconds": None,
}


def measures_of(rows: Iterable[Mapping[str, Any]]) -> list[str]:
    """Keys of the measured frequencies."""
    names = dict.fromkeys(key for row in rows for key in row if key not in NOTHING)
    return [name for name in names if name == "false_alarms" or name.startswith(("median_settling", "median_rms"))]


def settings_of(rows: Iterable[Mapping[str, Any]]) -> list[str]:
    """Keys of the swept fields; none of them has a reserved name, but initial parameters are told apart by theirs."""
    rows = list(rows)
    others = reserved_names().difference(["start"]).union(measures_of(rows))
    return list(dict.fromkeys(key for row in rows for key in row if key not in others))


def experiment_rows(
    results: Results, table: int | str | None = None, fields: Mapping[str, str] | None = None
) -> list[Row]:
    """Cells of one experiment: every combination of swept fields, estimator and start that was planned."""
    manifest = results.manifest
    down, across = results.swept("data_cells"), results.swept("estimators")
    always = {} if is_of_signal(manifest) else ALWAYS
    constant = {name: lookup(results.settings, path) for name, path in (fields or always).items()}
    # Several sets of initial parameters are told apart by their names, as initial delays are by their values.
    given = {label for label, delay in manifest["starts"].items() if delay is None and label != "none"}
    by = ["cell", "estimator", *across, "start"]
    counted = {tuple(group.pop(name) for name in by): group for group in results.summaries(by)}
    measured = _measured(results, by)
    lacking = dict.fromkeys(name for found in measured.values() for name in found)
    rows = []
    for cell, estimator in itertools.product(manifest["data_cells"], manifest["estimators"]):
        own = {name: estimator["swept"].get(name) for name in across}
        for start in estimator["starts"]:
            place = (cell["hash"], estimator["name"], *own.values(), start)
            rows.append(
                {"table": table or results.experiment, "experiment": results.experiment, "sampling": results.sampling}
                | constant
                | {name: cell["swept"].get(name) for name in down}
                | ({"start": start if start in given else None} if len(given) > 1 else {})
                | own
                | {"initial_delay": manifest["starts"].get(start), "method": estimator["name"], **NOTHING}
                | counted.get(place, {})
                | measured.get(place, lacking)
            )
    return rows


def study_rows(study: Study, table: StudyTable, found: Mapping[str, Results | None]) -> list[Row]:
    """Cells of one published table, published or run."""
    rows: list[Row] = []
    fields, random = list(study.fields), table.initial_delays == ("random",)
    for name, experiment in study.experiments.items():
        published = {
            (method, *line.settings.values(), delay): value
            for line in table.rows
            if line.experiment == name
            for method, values in line.published.items()
            for delay, value in zip(table.initial_delays, values, strict=True)
        }
        results = found.get(name) if published else None
        ours: dict[tuple[Any, ...], list[Row]] = {}
        for row in experiment_rows(results, table.number, study.fields) if results else []:
            if row["initial_delay"] is None or (row["initial_delay"] == "random") == random:
                place = (row["method"], *(row[field] for field in fields), row["initial_delay"])
                ours.setdefault(place, []).append(row | {"published_percent": published.get(place)})
        for place, value in published.items():
            method, *settings, delay = place
            empty = {"table": table.number, "experiment": name, "sampling": experiment.sampling}
            empty |= dict(zip(fields, settings, strict=True))
            empty |= {"initial_delay": delay, "method": method, **NOTHING, "published_percent": value}
            rows += ours.pop(place, [empty])
        rows += itertools.chain(*ours.values())
    # Every row of a table carries the same keys, in the same order.
    blank = dict.fromkeys(["table", "experiment", "sampling", *settings_of(rows)])
    return _ordered(study, table, [blank | row for row in rows])


def _ordered(study: Study, table: StudyTable, rows: list[Row]) -> list[Row]:
    """Rows by experiment, published settings and method, each in the order of the study."""

    def settings(row: Row) -> tuple[Any, ...]:
        return tuple(row[field] for field in study.fields)

    experiments = list(dict.fromkeys(row.experiment for row in table.rows))
    known = list(dict.fromkeys([*(tuple(r.settings.values()) for r in table.rows), *map(settings, rows)]))
    methods = list(dict.fromkeys([*study.methods, *(row["method"] for row in rows)]))

    def place(row: Row) -> tuple[int, int, int]:
        return experiments.index(row["experiment"]), known.index(settings(row)), methods.index(row["method"])

    return sorted(rows, key=place)


def pooled_rows(study: Study, table: StudyTable, rows: Sequence[Row], options: Sequence[str] = ()) -> list[Row]:
    """Each method, with each combination of its swept options, over all cells of a published table.

    There is no interval: cells of one row share their data sets, so their estimates are not independent trials. The
    published percentage is the mean over the cells that have estimates, or over all cells where none has [%].
    """
    import numpy as np
    import pandas as pd

    places = {(row.experiment, *row.settings.values()) for row in table.rows}
    frame = pd.DataFrame(
        [
            row | {"startless": row["initial_delay"] is None}
            for row in rows
            if (row["experiment"], *(row[field] for field in study.fields)) in places
            and row["initial_delay"] in (None, *table.initial_delays)
        ]
    )
    known = {name: {row[name] for row in rows} - {None} for name in options}
    pooled = []
    for key, group in frame.groupby(["method", "startless", *options], sort=False, dropna=False):
        method, startless, *own = key
        run = group[(group["n"] > 0) & group["converged"].notna()]
        n, converged = int(run["n"].sum()), int(run["converged"].sum())
        published = (group if run.empty else run)["published_percent"].astype(float).mean()
        pooled.append(
            {
                "method": method,
                **{name: value for name, value in zip(options, own, strict=True) if value in known[name]},
                "cells": len(places) * (1 if startless else len(table.initial_delays)),
                "cells_run": len(run),
                "n": n,
                "converged": converged,
                "percent": 100 * converged / n if n else None,
                "published_percent": None if np.isnan(published) else float(published),
                "seconds": run["median_seconds"].dropna().tolist(),
            }
        )
    return pooled


def _measured(results: Results, by: Sequence[str]) -> dict[tuple[Any, ...], dict[str, float | None]]:
    """What the estimates of a group measured together, where they are frequencies of a signal."""
    groups: dict[tuple[Any, ...], list[Mapping[str, float | None]]] = {}
    for row in results.rows:
        if "measures" in row:
            groups.setdefault(tuple(row.get(name) for name in by), []).append(row["measures"] or {})
    names = measure_names(one for group in groups.values() for one in group)
    return {place: _together(group, names) for place, group in groups.items()}


def _together(group: Sequence[Mapping[str, float | None]], names: Sequence[str]) -> dict[str, float | None]:
    """Medians over data sets, where what does not exist counts as later or larger than all else."""
    found: dict[str, float | None] = {}
    for base in ("settling_time", "settling_after_step"):
        own = [name for name in names if base_name(name)[0] == base]
        if own:
            found[f"median_{base}"] = _median(max(_or_infinite(one, name) for name in own) for one in group)
    for name in names:
        if base_name(name)[0] == "rms":
            found[f"median_{name}"] = _median(_or_infinite(one, name) for one in group)
    if "false_alarms" in names:
        alarms = [alarm for one in group if (alarm := one.get("false_alarms")) is not None]
        found["false_alarms"] = sum(alarms) if alarms else None
    return found


def _or_infinite(measures: Mapping[str, float | None], name: str) -> float:
    value = measures.get(name)
    return math.inf if value is None else value


def _median(values: Iterable[float]) -> float | None:
    middle = median(values)
    return middle if math.isfinite(middle) else None
