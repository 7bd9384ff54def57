"""Percentages and other measures of the estimates of an experiment, each with its Monte Carlo error.

Keys of a row
-------------
- ``table``, ``experiment``, ``sampling``; one key per swept field; ``initial_delay``: where the search started [s],
  ``"random"``, or None for an estimator that needs no start; ``method``: name of the estimator.
- ``n``: data sets; ``failed``: those without a result.
- Of percentages: ``converged``; ``percent`` with its 95 % Wilson interval ``low`` and ``high`` [%];
  ``published_percent`` [%]; ``median_seconds`` and ``median_cpu_seconds``: median wall and processor time of one
  estimate [s]. Of frequencies of a signal: ``median_settling_time`` and ``median_settling_after_step`` of the slowest
  tone [s], missing where half of the data sets or more never settled; ``median_rms_1 …`` [rad/s]; ``false_alarms`` of
  all data sets.
- Of measures: ``measure``, as it was asked for; ``parameter``: what it is about, None for the estimate as a whole, the
  status where failures are counted; ``unit``; ``value`` with its Monte Carlo standard error ``error`` and 95 % interval
  from ``low`` to ``high``; None where the data sets do not tell; ``without_value``: data sets without what is measured,
  with those that failed. Distances and fits count them as infinitely bad, other measures leave them out
  (``counted_in``).
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from ctid_cli.arrays import Array, IntArray
from ctid_cli.errors import UsageError
from ctid_cli.inference.fit import Status
from ctid_cli.inference.monte_carlo import MEASURES, Measure, Measured, quantile, requested, wilson_interval
from ctid_cli.reporting.estimate import Units
from ctid_cli.reporting.model_measures import distance_of, distances, pole_estimates, system_of
from ctid_cli.reporting.parameter_errors import ParameterEstimates, estimates_by_group, least_variances
from ctid_cli.reporting.results import Group, Results, lookup
from ctid_cli.simulation.frequency_measures import base_name
from ctid_cli.storage.columns import reserved_names
from ctid_cli.storage.estimates import CLOCKS, Estimates
from ctid_cli.storage.manifest import is_of_signal, true_values
from ctid_cli.text import did_you_mean, listed

if TYPE_CHECKING:
    import pandas as pd

Row = dict[str, Any]

#: Columns of percentages, with their types.
COUNTED = {
    **dict.fromkeys(("n", "failed"), "int64"),
    "converged": "Int64",
    **dict.fromkeys(("percent", "low", "high", "published_percent", "median_seconds", "median_cpu_seconds"), "float64"),
}
#: Settings that are keys of every row, and their key path in a specification.
ALWAYS = {"snr_db": "noise.snr_db"}
#: Statuses of estimates with which nothing is wrong.
SUCCESSES = {Status.CONVERGED.name, Status.LEAST_SQUARES.name, "VALID"}
#: What is measured where the specification does not say.
DEFAULT = ("bias", "rmse")
#: What the measures of frequencies begin with in rows.
OF_FREQUENCIES = ("median_settling", "median_rms", "false_alarms")

#: A parameter or status, what was measured of it, its unit, and how many estimates have no value.
Found = tuple[str | None, Measured, str, int]


# --- which groups there are -----------------------------------------------------------------------------------------


def labelled_groups(
    results: Results, table: int | str | None = None, fields: Mapping[str, str] | None = None
) -> Iterator[tuple[Group, Row]]:
    """Yield every combination of swept fields, estimator and start that was planned, with the keys of all its rows."""
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


def settings_of(rows: Iterable[Iterable[str]]) -> list[str]:
    """Return the keys of swept fields; none has a reserved name, but initial parameters are told apart by theirs."""
    others = reserved_names().difference(["start"])
    names = dict.fromkeys(key for row in rows for key in row)
    return [name for name in names if name not in others and not name.startswith(OF_FREQUENCIES)]


# --- percentages ----------------------------------------------------------------------------------------------------


def percentage_frame(
    results: Results, table: int | str | None = None, fields: Mapping[str, str] | None = None
) -> pd.DataFrame:
    """Return how often the estimators of an experiment converged, a row for each group that was planned."""
    import pandas as pd

    groups, labels = zip(*labelled_groups(results, table, fields), strict=True)
    members = results.groups()
    numbers = np.full(len(results.stored), -1)
    for k, group in enumerate(groups):
        if group in members:
            numbers[members[group].places] = k
    frame = pd.DataFrame(list(labels), dtype=object).join(_counted(results.stored, numbers, len(groups)))
    return frame.join(_frequencies(results.stored, numbers)) if is_of_signal(results.manifest) else frame


def _counted(stored: Estimates, numbers: IntArray, groups: int) -> pd.DataFrame:
    """Return counts, percentages and median times of groups, from the number of the group of each estimate."""
    import pandas as pd

    columns = {"failed": stored.failures, "converged": stored.judged, **{name: stored.column(name) for name in CLOCKS}}
    found = pd.DataFrame(columns).groupby(numbers)
    hits = found["converged"].agg(["size", "count", "sum"])
    n, converged = hits["size"], hits["sum"].where(hits["count"] == hits["size"])
    counts = pd.DataFrame(
        {"n": n, "failed": found["failed"].sum(), "converged": converged, "percent": 100 * converged / n}
    )
    ends = [
        wilson_interval(int(k), int(n)) if k == k else (math.nan, math.nan) for n, k in zip(n, converged, strict=True)
    ]
    counts[["low", "high"]] = 100 * np.reshape(ends, (-1, 2))
    for clock in CLOCKS:
        counts[f"median_{clock}"] = found[clock].median()
    return with_types(counts.reindex(range(groups)))


def with_types(frame: pd.DataFrame) -> pd.DataFrame:
    """Return the counts of cells in their types and order, zero where nothing was run."""
    counts = frame.reindex(columns=[*COUNTED])
    empty = counts["n"].isna()
    for name in ("n", "failed", "converged"):
        counts[name] = counts[name].mask(empty, 0)
    counts = counts.astype(COUNTED)
    return frame.drop(columns=[*COUNTED], errors="ignore").join(counts)


def _frequencies(stored: Estimates, numbers: IntArray) -> pd.DataFrame:
    """Return medians of the measures of frequencies; what does not exist counts as later or larger than all else."""
    import pandas as pd

    if not stored.has("measures"):
        return pd.DataFrame()
    names = list(map(str, stored.export.parts("measures")))
    every = pd.DataFrame(stored.column("measures"), columns=names)
    late, found = every.fillna(math.inf), {}
    for base in ("settling_time", "settling_after_step"):
        if own := [name for name in names if base_name(name)[0] == base]:
            found[f"median_{base}"] = late[own].max(axis=1).groupby(numbers).median()
    for name in names:
        if base_name(name)[0] == "rms":
            found[f"median_{name}"] = late[name].groupby(numbers).median()
    medians = pd.DataFrame(found).replace(math.inf, math.nan)
    if "false_alarms" in every:
        medians["false_alarms"] = every["false_alarms"].groupby(numbers).sum(min_count=1)
    return medians


# --- measures -------------------------------------------------------------------------------------------------------


def measure_rows(results: Results, names: Sequence[str]) -> list[Row]:
    """Return measures by name, of every combination of swept fields, estimator and start that was planned."""
    for name in names:
        _require_measurable(name, results)
    source, rows = _Measuring(results), []
    for group, labels in labelled_groups(results):
        members = results.groups().get(group, results.stored.part(0, 0))
        counts = {"n": len(members), "failed": int(members.failures.sum())}
        for name in dict.fromkeys(names):
            measure = measure_of(name, results)
            found = source.found(name, measure, group, members) if members else [(None, Measured(), measure.unit, 0)]
            rows += [
                labels
                | {"parameter": parameter, "measure": name, "unit": unit, **measured._asdict()}
                | counts
                | {"without_value": without}
                for parameter, measured, unit, without in found
            ]
    return rows


def counted_in(row: Mapping[str, Any]) -> int:
    """Return the number of data sets that the value of a row is computed from."""
    measure = MEASURES.get(row["measure"].partition(":")[0])
    infinite = measure is not None and measure.source in ("distance", "fresh_fit_percent")
    return int(row["n"] - (0 if infinite else row["without_value"]))


def measure_of(name: str, results: Results) -> Measure:
    """Return the measure that a name asks for: one of ctid's, or a custom one of the specification."""
    contents = results.manifest["data_cells"][0]["content"].get("custom_measures") or {}
    custom = {
        own: Measure(f"median of {content['kind']}", content["unit"], "custom_measures", quantile)
        for own, content in contents.items()
    }
    return requested(name, custom)


def asked_measures(results: Results) -> list[str]:
    """Return the names of the measures that the specification asks for."""
    return [one if isinstance(one, str) else one["name"] for one in results.settings.get("measures") or ()]


def default_measures(results: Results) -> Sequence[str]:
    """Return what the specification asks for; without a success rule bias and root mean square error; else nothing."""
    asked = asked_measures(results)
    measurable = not results.settings.get("success") and any(map(true_values, results.manifest["data_cells"]))
    return asked or (DEFAULT if measurable else ())


def _require_measurable(name: str, results: Results) -> None:
    """Refuse a measure of what these results do not have."""
    measure, argument, where = measure_of(name, results), name.partition(":")[2], results.experiment
    true = [name for cell in results.manifest["data_cells"] for name in true_values(cell)]
    if measure.source == "errors" and not true:
        others = ", ".join(k for k, item in MEASURES.items() if item.source in ("converged", "status", "cpu_seconds"))
        raise UsageError(f"{where}: {name} needs true values, and only a simulated system has them; use {others}")
    if measure.source == "errors" and argument and argument not in (*true, "poles"):
        hint = did_you_mean(argument, true) or "."
        known = f"There are {listed(true)}, and poles for those of the model"
        raise UsageError(f"{where}: {name} is about no parameter of the system{hint} {known}")
    if measure.source == "converged" and not results.settings.get("success"):
        reason = "needs a rule by which an estimate counts as converged, and the specification has no success section"
        raise UsageError(f"{where}: {name} {reason}; use {', '.join(DEFAULT)}")
    if name == "fresh_fit" and name not in asked_measures(results):
        advice = "add 'measures: [fresh_fit]' to the specification, and run it again"
        raise UsageError(f"{where}: {name} is computed while the experiment runs; {advice}")


@dataclass(frozen=True)
class _Measuring:
    """What the measures of an experiment are computed from, read when it is first needed."""

    results: Results

    @cached_property
    def estimates(self) -> dict[Group, ParameterEstimates]:
        return {one.group: one for one in estimates_by_group(self.results)}

    @cached_property
    def bounds(self) -> dict[Group, dict[str, float]]:
        return least_variances(self.results)

    @cached_property
    def cells(self) -> dict[str, Mapping[str, Any]]:
        return {cell["hash"]: cell for cell in self.results.manifest["data_cells"]}

    @cached_property
    def statuses(self) -> list[str]:
        known = {status.decode() for status in np.unique(self.results.stored.column("status")).tolist()}
        return sorted(known - SUCCESSES) or ["FAILED"]

    def found(self, name: str, measure: Measure, group: Group, rows: Estimates) -> Iterator[Found]:
        """Yield a measure of the estimates of one group: of each parameter, of each status, or of the whole."""
        if measure.source == "errors":
            yield from self._of_errors(name, measure, group, rows)
        elif measure.source == "status":
            status = rows.column("status")
            for each in self.statuses:
                yield each, measure.compute(status == each.encode()), measure.unit, 0
        elif measure.source == "distance":
            base, _, argument = name.partition(":")
            values = distances(system_of(self.cells[group.cell], name), rows, distance_of(base, argument))
            yield None, measure.compute(values), measure.unit, int(np.isinf(values).sum())
        elif measure.source == "converged":
            hits = np.zeros(0, dtype=bool) if rows.converged is None else rows.converged
            yield None, measure.compute(hits), measure.unit, len(rows) - hits.size
        else:
            values = _known_values(name, measure, rows)
            lacking = len(rows) - values.size
            if measure.source == "fresh_fit_percent":
                # Where there is no model, it fits infinitely badly.
                values = np.append(values, np.full(lacking, -np.inf))
            yield None, measure.compute(values), measure.unit, lacking

    def _of_errors(self, name: str, measure: Measure, group: Group, rows: Estimates) -> Iterator[Found]:
        """Yield a measure of the errors of every parameter, of one, or of the poles."""
        base, _, argument = name.partition(":")
        estimates = self.estimates[group]
        if argument == "poles":
            estimates = pole_estimates(estimates, system_of(self.cells[group.cell], name), rows)
        bounds = self.bounds.get(group, {}) if base == "efficiency" else {}
        for k, parameter in enumerate(estimates.names):
            if argument in ("", "poles", parameter):
                sample = estimates.sample(k, bounds.get(parameter, math.nan))
                sample = sample.with_widths() if measure.of_widths else sample
                own = parameter_unit(parameter, estimates.names)
                unit = {"": own, "^2": f"({own})^2"}.get(measure.unit, measure.unit)
                yield parameter, measure.compute(sample), unit, estimates.runs - sample.errors.size


def _known_values(name: str, measure: Measure, rows: Estimates) -> Array:
    """Return finite values of a column, or of one part of the column of custom measures."""
    if not rows.has(measure.source):
        return np.zeros(0)
    values = rows.column(measure.source)
    if measure.source == "custom_measures":
        names = rows.export.parts("custom_measures")
        values = values[:, names.index(name)] if name in names else np.zeros(0)
    return np.asarray(values[np.isfinite(values)])


def parameter_unit(name: str, names: Sequence[str]) -> str:
    """Return the unit of one of the parameters of a system; ``-`` of those that are not known here."""
    if name.startswith("pole_"):
        return "rad/s"
    if re.fullmatch(r"[ab]\d+|delay", name):
        poles, coefficients = (sum(other[0] == letter and other != "delay" for other in names) for letter in "ab")
        return Units().of(name, poles, coefficients - 1)
    return Units().of_submodel(name) if re.fullmatch(r"g\d+_[ab]\d+", name) else "-"
