"""Table cells as plain rows: percentages over the data sets of one setting, with the published ones beside them.

Keys of a row
-------------
- ``table``, ``experiment``, ``sampling``; one key per swept field; ``initial_delay``: where the search started [s],
  ``"random"``, or None for an estimator that needs no start; ``method``: name of the estimator.
- ``n``, ``failed``, ``converged``; ``percent`` with its 95 % Wilson interval ``low`` and ``high`` [%];
  ``published_percent`` [%]; ``median_seconds`` and
  ``median_cpu_seconds``: median wall and processor time of one estimate [s].
- Of frequencies of a signal: ``median_settling_time`` and ``median_settling_after_step`` of the slowest tone [s], None
  where half of the data sets or more never settled; ``median_rms_1 …`` [rad/s]; ``false_alarms`` of all data sets.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ctid_cli.inference.monte_carlo import wilson_interval
from ctid_cli.reporting.results import Group, Results, lookup
from ctid_cli.reporting.study import Place, Study, StudyTable
from ctid_cli.simulation.frequency_measures import base_name, measure_names
from ctid_cli.storage.columns import COUNTS, reserved_names
from ctid_cli.storage.estimates import CLOCKS, Estimates
from ctid_cli.storage.manifest import is_of_signal

if TYPE_CHECKING:
    import pandas as pd

Row = dict[str, Any]

#: Settings that are keys of every row, and their key path in a specification.
ALWAYS = {"snr_db": "noise.snr_db"}

#: What stands in a cell that was not run.
NOTHING = {
    **dict.fromkeys(("n", "failed", "converged"), 0),
    **dict.fromkeys(("percent", "low", "high", "published_percent", "median_seconds", "median_cpu_seconds")),
}


def measures_of(rows: Iterable[Mapping[str, Any]]) -> list[str]:
    """Keys of the measured frequencies."""
    names = dict.fromkeys(key for row in rows for key in row if key not in NOTHING)
    return [name for name in names if name == "false_alarms" or name.startswith(("median_settling", "median_rms"))]


def time_of(row: Mapping[str, Any]) -> float | None:
    """The time of one estimate that tables show: that of the processor, or of the clock where only that is stored."""
    known = (row.get("median_cpu_seconds"), row["median_seconds"])
    return next((float(time) for time in known if time is not None and not math.isnan(time)), None)


def settings_of(rows: Iterable[Mapping[str, Any]]) -> list[str]:
    """Keys of the swept fields; none of them has a reserved name, but initial parameters are told apart by theirs."""
    rows = list(rows)
    others = reserved_names().difference(["start"]).union(measures_of(rows))
    return list(dict.fromkeys(key for row in rows for key in row if key not in others))


def labelled_groups(
    results: Results, table: int | str | None = None, fields: Mapping[str, str] | None = None
) -> Iterator[tuple[Group, Row]]:
    """Every combination of swept fields, estimator and start that was planned, with the keys that all its rows have."""
    manifest = results.manifest
    down, across = results.swept("data_cells"), results.swept("estimators")
    fields = fields or ({} if is_of_signal(manifest) else ALWAYS)
    constant = {name: lookup(results.settings, path) for name, path in fields.items()}
    # Several sets of initial parameters are told apart by their names, as initial delays are by their values.
    given = {label for label, delay in manifest["starts"].items() if delay is None and label != "none"}
    for cell, estimator in itertools.product(manifest["data_cells"], manifest["estimators"]):
        own = {name: estimator["swept"].get(name) for name in across}
        for start in estimator["starts"]:
            yield (
                Group(cell["hash"], estimator["name"], tuple(own.values()), start),
                {"table": table or results.experiment, "experiment": results.experiment, "sampling": results.sampling}
                | constant
                | {name: cell["swept"].get(name) for name in down}
                | ({"start": start if start in given else None} if len(given) > 1 else {})
                | own
                | {"initial_delay": manifest["starts"].get(start), "method": estimator["name"]},
            )


def experiment_rows(
    results: Results, table: int | str | None = None, fields: Mapping[str, str] | None = None
) -> list[Row]:
    """Cells of one experiment."""
    counts = {group: _counted(rows) for group, rows in results.groups().items()}
    measured = _measured(results)
    lacking = dict.fromkeys(itertools.chain(*measured.values()))
    return [
        labels | NOTHING | counts.get(group, {}) | measured.get(group, lacking)
        for group, labels in labelled_groups(results, table, fields)
    ]


def _counted(rows: Estimates) -> Row:
    """Counts and percentages of a group of estimates, and the medians of their times."""
    n, converged = len(rows), rows.converged
    row: Row = dict.fromkeys(COUNTS) | {"n": n, "failed": int(rows.failures.sum())}
    for clock in CLOCKS:
        times = rows.column(clock)
        known = times[np.isfinite(times)]
        row[f"median_{clock}"] = float(np.median(known)) if known.size else None
    if converged is not None:
        k = int(converged.sum())
        low, high = wilson_interval(k, n)
        row |= {"converged": k, "percent": 100 * k / n, "low": 100 * low, "high": 100 * high}
    return row


def study_rows(study: Study, table: StudyTable, found: Mapping[str, Results]) -> list[Row]:
    """Cells of one published table, published or run: by sampling, settings and method in the order of the study."""
    random = table.initial_delays == ("random",)
    ours: dict[Place, list[Row]] = {}
    for name in table.experiments:
        for row in experiment_rows(found[name], table.number, study.fields) if name in found else ():
            if row["initial_delay"] is None or (row["initial_delay"] == "random") == random:
                ours.setdefault(_place(study, row), []).append(row)
    rows: list[Row] = []
    places = list(dict.fromkeys([*table.published, *ours]))
    for place in places:
        experiment, settings, method, delay = place
        empty = {"table": table.number, "experiment": experiment, "sampling": study.experiments[experiment]["sampling"]}
        empty |= dict(zip(study.fields, settings, strict=True))
        empty |= {"initial_delay": delay, "method": method, **NOTHING}
        rows += (row | {"published_percent": table.published.get(place)} for row in ours.get(place, [empty]))
    experiments, settings_order, methods = ([*dict.fromkeys(column)] for column in [*zip(*places, strict=True)][:3])
    # Methods with an experiment of their own stand beside the others.
    samplings = [study.experiments[name]["sampling"] for name in experiments]
    order = samplings, settings_order, [*dict.fromkeys([*study.methods, *methods])]

    def position(row: Row) -> list[int]:
        own = (row["sampling"], *_place(study, row)[1:3])
        return [known.index(value) for known, value in zip(order, own, strict=True)]

    # Every row of a table carries the same keys, in the same order.
    blank = dict.fromkeys(["table", "experiment", "sampling", *settings_of(rows)])
    return [blank | row for row in sorted(rows, key=position)]


def _place(study: Study, row: Row) -> Place:
    settings = tuple(row[field] for field in study.fields)
    return Place(row["experiment"], settings, row["method"], row["initial_delay"])


def pooled_rows(study: Study, table: StudyTable, rows: Sequence[Row], options: Sequence[str] = ()) -> list[Row]:
    """Each method, with each combination of its swept options, over all cells of a published table.

    There is no interval: cells of one row share their data sets, so their estimates are not independent trials. The
    published percentage is the mean over the cells that have estimates, or over all cells where none has [%].
    """
    import pandas as pd

    places = {place[:2] for place in table.published}
    count = len({(study.experiments[experiment]["sampling"], settings) for experiment, settings in places})
    shown = [row for row in rows if _place(study, row)[:2] in places]
    shown = [row for row in shown if row["initial_delay"] in (None, *table.initial_delays)]
    frame = pd.DataFrame([row | {"startless": row["initial_delay"] is None} for row in shown])
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
                "cells": count * (1 if startless else len(table.initial_delays)),
                "cells_run": len(run),
                "n": n,
                "converged": converged,
                "percent": 100 * converged / n if n else None,
                "published_percent": None if np.isnan(published) else float(published),
                "seconds": [time for _, row in run.iterrows() if (time := time_of(dict(row))) is not None],
            }
        )
    return pooled


def _measured(results: Results) -> dict[Group, dict[str, float | None]]:
    """What the estimates of a group measured together, where they are frequencies of a signal."""
    import pandas as pd

    if not is_of_signal(results.manifest):
        return {}
    groups = {group: [one or {} for one in rows.values("measures")] for group, rows in results.groups().items()}
    names = measure_names(one for rows in groups.values() for one in rows)
    return {group: _together(pd.DataFrame(rows, columns=names).astype(float)) for group, rows in groups.items()}


def _together(group: pd.DataFrame) -> dict[str, float | None]:
    """Medians over data sets, where what does not exist counts as later or larger than all else."""
    names, late = list(map(str, group)), group.fillna(math.inf)
    medians: dict[str, float] = {}
    for base in ("settling_time", "settling_after_step"):
        own = [name for name in names if base_name(name)[0] == base]
        if own:
            medians[f"median_{base}"] = late[own].max(axis=1).median()
    medians |= {f"median_{name}": late[name].median() for name in names if base_name(name)[0] == "rms"}
    found: dict[str, float | None] = {k: float(v) if math.isfinite(v) else None for k, v in medians.items()}
    if "false_alarms" in group:
        alarms = group["false_alarms"]
        found["false_alarms"] = float(alarms.sum()) if alarms.notna().any() else None
    return found
