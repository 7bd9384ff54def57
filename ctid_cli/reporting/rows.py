"""Table cells as data: percentages over estimates, with the published ones beside them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from ctid_cli.reporting.results import Results, lookup
from ctid_cli.reporting.study import InitialDelay, Study, StudyTable

#: Settings that are keys of every row, and their key path in a specification.
ALWAYS = {"snr_db": "noise.snr_db"}


@dataclass(frozen=True)
class Row:
    """One table cell: a percentage over the data sets of one setting.

    Parameters
    ----------
    table : int or str
        Number of the published table, or name of the experiment.
    experiment : str
        Experiment that fills the cell.
    sampling : str or None
        ``regular``, ``irregular``; None for a measured record.
    settings : mapping
        Swept fields and their values; None where a field belongs to another estimator.
    initial_delay : float, "random" or None
        Where the search started [s]; None for an estimator that needs no start.
    method : str
        Name of the estimator.
    n : int
        Data sets behind the percentage; 0 for a cell that was not run.
    failed : int
        How many of them ended in an error; they count as not converged.
    converged : int or None
        How many met the success rule; None where there is none.
    percent, low, high : float or None
        Percentage converged and its 95 % Wilson interval [%].
    published_percent : float or None
        Published percentage [%].
    median_seconds : float or None
        Median time of one estimate [s].
    estimator_settings : tuple of str
        The fields of ``settings`` that belong to the estimator: they label columns, the others label rows.
    """

    table: int | str
    experiment: str
    sampling: str | None
    settings: Mapping[str, Any]
    initial_delay: InitialDelay
    method: str
    n: int = 0
    failed: int = 0
    converged: int | None = 0
    percent: float | None = None
    low: float | None = None
    high: float | None = None
    published_percent: float | None = None
    median_seconds: float | None = None
    estimator_settings: tuple[str, ...] = field(default=(), compare=False)

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
        }


def experiment_rows(results: Results, table: int | str, fields: Mapping[str, str] | None = None) -> list[Row]:
    """Cells of one experiment: every combination of swept fields, estimator and start that was planned.

    Parameters
    ----------
    results : Results
        The experiment's results.
    table : int or str
        What the rows carry as their table.
    fields : mapping of str to str, optional
        Settings that become keys even where they are not swept, with their key path; default is the SNR.

    Returns
    -------
    list of Row
        In the order of the specification. Cells without an estimate have ``n`` 0.
    """
    manifest = results.manifest
    down, across = _swept(manifest["data_cells"]), _swept(manifest["estimators"])
    constant = {name: lookup(results.settings, path) for name, path in (fields or ALWAYS).items()}
    groups = results.summaries(["cell", "estimator", *across, "start"])
    counted = {tuple(group[name] for name in ("cell", "estimator", *across, "start")): group for group in groups}
    rows = []
    for cell in manifest["data_cells"]:
        for estimator in manifest["estimators"]:
            own = {name: estimator["swept"].get(name) for name in across}
            for start in estimator["starts"]:
                group = counted.get((cell["hash"], estimator["name"], *own.values(), start), {})
                rows.append(
                    Row(
                        table=table,
                        experiment=results.experiment,
                        sampling=results.sampling,
                        settings=constant | {name: cell["swept"].get(name) for name in down} | own,
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
                    )
                )
    return rows


def study_rows(study: Study, table: StudyTable, found: Mapping[str, Results | None]) -> list[Row]:
    """Cells of one published table: the published ones first, then what was run beyond them.

    Parameters
    ----------
    study : Study
        The study.
    table : StudyTable
        One of its tables.
    found : mapping of str to Results or None
        Results of the study's experiments, None for those that were not run.

    Returns
    -------
    list of Row
        Every published cell appears, run or not. Cells that were run with further values of a field, further
        estimators or further starts follow in the row order of their experiment.
    """
    rows: list[Row] = []
    random = table.initial_delays == ("random",)
    for name in dict.fromkeys(row.experiment for row in table.rows):
        results = found.get(name)
        ours = experiment_rows(results, table.number, study.fields) if results else []
        ours = [row for row in ours if (row.initial_delay == "random") == random]
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
    return [replace(row, settings={key: row.settings.get(key) for key in keys}) for row in rows]


def _swept(parts: list[dict[str, Any]]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(name for part in parts for name in part["swept"]))
