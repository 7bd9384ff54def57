"""Table cells as data: percentages over estimates, with the published ones beside them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from statistics import median
from typing import Any

from ctid_cli.reporting.results import Results, lookup
from ctid_cli.reporting.study import InitialDelay, Study, StudyTable
from ctid_cli.simulation.frequency_measures import base_name, measure_names
from ctid_cli.storage.manifest import is_of_signal

#: Settings that are keys of every row, and their key path in a specification.
ALWAYS = {"snr_db": "noise.snr_db"}


@dataclass(frozen=True)
class Row:
    """One table cell: a percentage over the data sets of one setting."""

    table: int | str
    experiment: str
    sampling: str | None
    settings: Mapping[str, Any]
    #: Where the search started [s]; None for an estimator that needs no start.
    initial_delay: InitialDelay
    method: str
    n: int = 0
    failed: int = 0
    converged: int | None = 0
    #: Percentage converged and its 95 % Wilson interval [%].
    percent: float | None = None
    low: float | None = None
    high: float | None = None
    #: Published percentage [%].
    published_percent: float | None = None
    #: Median time of one estimate [s].
    median_seconds: float | None = None
    estimator_settings: tuple[str, ...] = field(default=(), compare=False)
    #: Of frequencies of a signal: ``median_settling_time`` and ``median_settling_after_step`` of the slowest tone [s],
    #: None where half of the data sets or more never settled; ``median_rms_1 …`` [rad/s]; ``false_alarms`` of all data
    #: sets together.
    measures: Mapping[str, float | None] | None = None

    def as_dict(self) -> dict[str, Any]:
        """The row of ``ctid table --format json``: swept fields are keys of their own."""
        return {
            "table": self.table,
            "experiment": self.experiment,
            "sampling": self.sampling,
            **self.settings,
            "initial_delay": self.initial_delay,
            "method": self.method,
            "n": self.n,
            "failed": self.failed,
            "converged": self.converged,
            "percent": self.percent,
            "low": self.low,
            "high": self.high,
            "published_percent": self.published_percent,
            "median_seconds": self.median_seconds,
            **(self.measures or {}),
        }


def experiment_rows(results: Results, table: int | str, fields: Mapping[str, str] | None = None) -> list[Row]:
    """Cells of one experiment: every combination of swept fields, estimator and start that was planned."""
    manifest = results.manifest
    down, across = _swept(manifest["data_cells"]), _swept(manifest["estimators"])
    always = {} if is_of_signal(manifest) else ALWAYS
    constant = {name: lookup(results.settings, path) for name, path in (fields or always).items()}
    # Several sets of initial parameters are told apart by their names, as initial delays are by their values.
    given = {label for label, delay in manifest["starts"].items() if delay is None and label != "none"}
    groups = results.summaries(["cell", "estimator", *across, "start"])
    measured = _measured(results, ["cell", "estimator", *across, "start"])
    counted = {tuple(group[name] for name in ("cell", "estimator", *across, "start")): group for group in groups}
    rows = []
    for cell in manifest["data_cells"]:
        for estimator in manifest["estimators"]:
            own = {name: estimator["swept"].get(name) for name in across}
            for start in estimator["starts"]:
                named = {"start": start if start in given else None} if len(given) > 1 else {}
                place = (cell["hash"], estimator["name"], *own.values(), start)
                group = counted.get(place, {})
                rows.append(
                    Row(
                        table=table,
                        experiment=results.experiment,
                        sampling=results.sampling,
                        settings=constant | {name: cell["swept"].get(name) for name in down} | named | own,
                        initial_delay=manifest["starts"].get(start),
                        method=estimator["name"],
                        n=group.get("n", 0),
                        failed=group.get("failed", 0),
                        converged=group.get("converged", 0),
                        percent=group.get("percent"),
                        low=group.get("low"),
                        high=group.get("high"),
                        median_seconds=group.get("median_seconds"),
                        estimator_settings=across,
                        measures=measured.get(place),
                    )
                )
    return rows


def study_rows(study: Study, table: StudyTable, found: Mapping[str, Results | None]) -> list[Row]:
    """Cells of one published table, published or run."""
    rows: list[Row] = []
    random = table.initial_delays == ("random",)
    for name in dict.fromkeys(row.experiment for row in table.rows):
        results = found.get(name)
        ours = experiment_rows(results, table.number, study.fields) if results else []
        ours = [row for row in ours if row.initial_delay is None or (row.initial_delay == "random") == random]
        placed: set[int] = set()
        for published in table.rows:
            if published.experiment != name:
                continue
            for method, values in published.published.items():
                for initial_delay, value in zip(table.initial_delays, values, strict=True):
                    matching = [
                        k
                        for k, row in enumerate(ours)
                        if row.method == method
                        and row.initial_delay == initial_delay
                        and all(row.settings[field] == setting for field, setting in published.settings.items())
                    ]
                    placed.update(matching)
                    rows += [replace(ours[k], published_percent=value) for k in matching]
                    if not matching:
                        rows.append(
                            Row(
                                table=table.number,
                                experiment=name,
                                sampling=study.experiments[name].sampling,
                                settings=dict(published.settings),
                                initial_delay=initial_delay,
                                method=method,
                                published_percent=value,
                            )
                        )
        rows += [row for k, row in enumerate(ours) if k not in placed]
    # Every row of a table carries the same keys.
    keys = list(dict.fromkeys(key for row in rows for key in row.settings))
    rows = [replace(row, settings={key: row.settings.get(key) for key in keys}) for row in rows]
    return _ordered(study, table, rows)


@dataclass(frozen=True)
class PooledRow:
    """One method's percentage over all cells of a published table.

    There is no interval: cells of one row share their data sets, so their estimates are not independent trials.
    """

    method: str
    settings: Mapping[str, Any]
    cells: int
    cells_run: int
    n: int
    converged: int
    #: 100 converged / n [%].
    percent: float | None
    #: Mean of the published percentages of the cells that have estimates, or of all cells where none has [%].
    published_percent: float | None
    #: Range of the cells' median times of one estimate [s].
    least_seconds: float | None
    greatest_seconds: float | None


def pooled_rows(study: Study, table: StudyTable, rows: Sequence[Row]) -> list[PooledRow]:
    """Each method over all cells of a published table."""
    places = {(row.experiment, *(row.settings[field] for field in study.fields)) for row in table.rows}
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        own = tuple((key, row.settings[key]) for key in row.estimator_settings if row.settings[key] is not None)
        published = (row.experiment, *(row.settings[field] for field in study.fields)) in places
        if published and (row.initial_delay is None or row.initial_delay in table.initial_delays):
            groups.setdefault((row.method, row.initial_delay is None, own), []).append(row)
    pooled = []
    for (method, startless, own), group in groups.items():
        run = [row for row in group if row.n and row.converged is not None]
        n, converged = sum(row.n for row in run), sum(row.converged or 0 for row in run)
        published_values = [row.published_percent for row in run or group if row.published_percent is not None]
        times = [row.median_seconds for row in run if row.median_seconds is not None]
        pooled.append(
            PooledRow(
                method=method,
                settings=dict(own),
                cells=len(places) * (1 if startless else len(table.initial_delays)),
                cells_run=len(run),
                n=n,
                converged=converged,
                percent=100 * converged / n if n else None,
                published_percent=sum(published_values) / len(published_values) if published_values else None,
                least_seconds=min(times, default=None),
                greatest_seconds=max(times, default=None),
            )
        )
    return pooled


def _ordered(study: Study, table: StudyTable, rows: list[Row]) -> list[Row]:
    def setting(settings: Mapping[str, Any]) -> tuple[Any, ...]:
        return tuple(settings[field] for field in study.fields)

    experiments = list(dict.fromkeys(row.experiment for row in table.rows))
    settings = list(dict.fromkeys([*(setting(r.settings) for r in table.rows), *(setting(r.settings) for r in rows)]))
    methods = list(dict.fromkeys([*study.methods, *(row.method for row in rows)]))

    def place(row: Row) -> tuple[int, int, int]:
        return experiments.index(row.experiment), settings.index(setting(row.settings)), methods.index(row.method)

    return sorted(rows, key=place)


def _measured(results: Results, by: Sequence[str]) -> dict[tuple[Any, ...], dict[str, float | None]]:
    """What the estimates of a group measured together, where they are frequencies of a signal."""
    groups: dict[tuple[Any, ...], list[Mapping[str, float | None]]] = {}
    for row in results.rows:
        if "measures" in row:
            groups.setdefault(tuple(row.get(name) for name in by), []).append(row["measures"] or {})
    # Every row of a table carries the same keys.
    names = measure_names(one for group in groups.values() for one in group)
    return {place: _together(group, names) for place, group in groups.items()}


def _together(group: Sequence[Mapping[str, float | None]], names: Sequence[str]) -> dict[str, float | None]:
    found: dict[str, float | None] = {}
    for base in ("settling_time", "settling_after_step"):
        own = [name for name in names if base_name(name)[0] == base]
        if own:
            found[f"median_{base}"] = _median([_slowest([one.get(name) for name in own]) for one in group])
    for name in names:
        if base_name(name)[0] == "rms":
            values = [one.get(name) for one in group]
            found[f"median_{name}"] = _median([math.inf if value is None else value for value in values])
    alarms = [one["false_alarms"] for one in group if one.get("false_alarms") is not None]
    if "false_alarms" in names:
        found["false_alarms"] = sum(alarm for alarm in alarms if alarm is not None) if alarms else None
    return found


def _slowest(times: Sequence[float | None]) -> float:
    return max(math.inf if time is None else time for time in times)


def _median(values: Sequence[float]) -> float | None:
    """Median of values of which some are infinite, because they do not exist."""
    middle = median(values)
    return middle if math.isfinite(middle) else None


def _swept(parts: list[dict[str, Any]]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(name for part in parts for name in part["swept"]))
