"""Measures of the estimates of an experiment, each with its Monte Carlo error: what tables, figures and pages read.

Keys of a row
-------------
- ``table``, ``experiment``, ``sampling``, one key per swept field, ``initial_delay``, ``method``: as in percentages.
- ``measure``: as it was asked for; ``parameter``: what it is about, None for the estimate as a whole, the status where
  failures are counted; ``unit``.
- ``value`` with its Monte Carlo standard error ``error`` and 95 % interval from ``low`` to ``high``; None where the
  data sets do not tell.
- ``n``: data sets; ``failed``: those without a result; ``without_value``: those without what is measured, with those
  that failed. Distances and fits count them as infinitely bad, other measures leave them out (``counted_in``).
"""

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import UsageError
from ctid_cli.inference.fit import Status
from ctid_cli.inference.monte_carlo import MEASURES, Measure, Measured, quantile, requested
from ctid_cli.reporting.estimate import Units
from ctid_cli.reporting.model_measures import distance_of, distances, pole_estimates, system_of
from ctid_cli.reporting.parameter_errors import ParameterEstimates, estimates_by_group, least_variances
from ctid_cli.reporting.percentages import Row, labelled_groups
from ctid_cli.reporting.results import Results
from ctid_cli.storage.estimates import Estimates
from ctid_cli.storage.manifest import true_values
from ctid_cli.text import did_you_mean, listed

#: Statuses of estimates with which nothing is wrong.
SUCCESSES = {Status.CONVERGED.name, Status.LEAST_SQUARES.name, "VALID"}
#: What is measured where the specification does not say.
DEFAULT = ("bias", "rmse")

#: A parameter or status, what was measured of it, its unit, and how many estimates have no value.
Found = tuple[str | None, Measured, str, int]


def measure_rows(results: Results, names: Sequence[str], first: int | None = None) -> list[Row]:
    """Measures by name, of every combination of swept fields, estimator and start that was planned.

    ``first``: from so many data sets of each only.
    """
    for name in names:
        _require_measurable(name, results)
    groups = results.groups()
    of_errors = any(measure_of(name, results).source == "errors" for name in names)
    estimates = {one.group: one for one in estimates_by_group(results)} if of_errors else {}
    known = {status.decode() for status in np.unique(results.stored.column("status")).tolist()}
    statuses = sorted(known - SUCCESSES) or ["FAILED"]
    bounds = least_variances(results) if any(name.startswith("efficiency") for name in names) else {}
    cells = {cell["hash"]: cell for cell in results.manifest["data_cells"]}
    rows = []
    for group, labels in labelled_groups(results):
        members = groups.get(group, results.stored.part(0, 0))
        if first is not None:
            members = members.chosen(members.column("replicate") < first)
        counts = {"n": len(members), "failed": int(members.failures.sum())}
        for name in dict.fromkeys(names):
            measure, argument = measure_of(name, results), name.partition(":")[2]
            found: Iterable[Found]
            if not members:
                found = [(None, Measured(), measure.unit, 0)]
            elif measure.source == "distance":
                system = system_of(cells[group.cell], name)
                far = distances(system, members, distance_of(name.partition(":")[0], argument))
                found = [(None, measure.compute(far), measure.unit, int(np.isinf(far).sum()))]
            elif measure.source == "errors":
                own = estimates[group] if first is None else estimates[group].first(first)
                if argument == "poles":
                    own = pole_estimates(own, system_of(cells[group.cell], name), members)
                found = _of_errors(measure, own, argument, bounds.get(group, {}))
            else:
                found = _of_estimates(name, measure, members, statuses)
            rows += [
                labels
                | {"parameter": parameter, "measure": name, "unit": unit, **measured._asdict()}
                | counts
                | {"without_value": without}
                for parameter, measured, unit, without in found
            ]
    return rows


def counted_in(row: Row) -> int:
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
    """What the specification asks for; bias and root mean square error where it has no success rule; else nothing."""
    asked = asked_measures(results)
    measurable = not results.settings.get("success") and any(map(true_values, results.manifest["data_cells"]))
    return asked or (DEFAULT if measurable else ())


def _require_measurable(name: str, results: Results) -> None:
    """Refuse a measure of what these results do not have."""
    measure, settings = measure_of(name, results), results.settings
    true = [name for cell in results.manifest["data_cells"] for name in true_values(cell)]
    argument = name.partition(":")[2]
    if measure.source == "errors" and not true:
        others = ", ".join(
            key for key, item in MEASURES.items() if item.source in ("converged", "status", "cpu_seconds")
        )
        reason = "needs true values, and only a simulated system has them"
        raise UsageError(f"{results.experiment}: {name} {reason}; use {others}")
    if measure.source == "errors" and argument and argument not in (*true, "poles"):
        hint = did_you_mean(argument, true) or "."
        known = f"There are {listed(true)}, and poles for those of the model"
        raise UsageError(f"{results.experiment}: {name} is about no parameter of the system{hint} {known}")
    if measure.source == "converged" and not settings.get("success"):
        reason = "needs a rule by which an estimate counts as converged, and the specification has no success section"
        raise UsageError(f"{results.experiment}: {name} {reason}; use {', '.join(DEFAULT)}")
    if name == "fresh_fit" and name not in asked_measures(results):
        advice = "add 'measures: [fresh_fit]' to the specification, and run it again"
        raise UsageError(f"{results.experiment}: {name} is computed while the experiment runs; {advice}")


def _of_errors(
    measure: Measure, estimates: ParameterEstimates, argument: str, bounds: Mapping[str, float]
) -> Iterator[Found]:
    """A measure of every parameter, or of one."""
    for k, name in enumerate(estimates.names):
        if argument in ("", "poles", name):
            sample = estimates.sample(k, bounds.get(name, math.nan))
            sample = sample.with_widths() if measure.of_widths else sample
            own = parameter_unit(name, estimates.names)
            unit = {"": own, "^2": f"({own})^2"}.get(measure.unit, measure.unit)
            yield name, measure.compute(sample), unit, estimates.runs - sample.errors.size


def parameter_unit(name: str, names: Sequence[str]) -> str:
    """Unit of one of the parameters of a system; ``-`` of those that are not known here."""
    if name.startswith("pole_"):
        return "rad/s"
    if re.fullmatch(r"[ab]\d+|delay", name):
        poles, coefficients = (sum(other[0] == letter and other != "delay" for other in names) for letter in "ab")
        return Units().of(name, poles, coefficients - 1)
    return Units().of_submodel(name) if re.fullmatch(r"g\d+_[ab]\d+", name) else "-"


def _custom_values(name: str, rows: Estimates) -> Array:
    """Finite values of a custom measure."""
    names = rows.export.parts("custom_measures") if rows.has("custom_measures") else []
    values = rows.column("custom_measures")[:, names.index(name)] if name in names else np.zeros(0)
    return np.asarray(values[np.isfinite(values)])


def _of_estimates(name: str, measure: Measure, rows: Estimates, statuses: Sequence[str]) -> Iterator[Found]:
    """A measure of what an estimate has one of."""
    if measure.source == "status":
        found = rows.column("status")
        for status in statuses:
            yield status, measure.compute(found == status.encode()), measure.unit, 0
        return
    values: Array
    if measure.source == "custom_measures":
        values = _custom_values(name, rows)
    elif measure.source == "converged":
        values = np.zeros(0, dtype=bool) if rows.converged is None else rows.converged  # type: ignore[assignment]
    else:
        values = rows.column(measure.source) if rows.has(measure.source) else np.zeros(0)
        values = values[np.isfinite(values)]
    lacking = len(rows) - len(values)
    if measure.source == "fresh_fit_percent":
        # Where there is no model, it fits infinitely badly.
        values = np.append(values, np.full(lacking, -np.inf))
    yield None, measure.compute(values), measure.unit, lacking
