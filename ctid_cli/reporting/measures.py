"""Percentages and other measures of the estimates of an experiment, each with its Monte Carlo error.

Keys of a row
-------------
- ``table``, ``experiment``, ``sampling``; one key per swept field; ``initial_delay``: start of the search [s],
  ``"random"``, or None for an estimator without a start; ``method``: name of the estimator.
- ``n``: data sets; ``failed``: those without a result.
- For percentages: ``converged``; ``percent`` with its 95 % Wilson interval ``low`` and ``high`` [%];
  ``published_percent`` [%]; ``median_seconds`` and ``median_cpu_seconds``: median wall and processor time of one
  estimate [s]. For frequencies of a signal: ``median_settling_time`` and ``median_settling_after_step`` of the slowest
  tone [s], missing if half of the data sets or more never settled; ``median_rms_1 …`` [rad/s]; ``false_alarms`` of
  all data sets.
- For measures: ``measure``, its name; ``parameter``, None for the estimate as a whole, the
  status if failures are counted; ``unit``; ``value`` with its Monte Carlo standard error ``error`` and 95 % interval
  from ``low`` to ``high``; None if it cannot be estimated; ``without_value``: data sets without a value,
  including those that failed. Distances and fits count them as infinitely bad, other measures leave them out
  (``counted_in``).
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import UsageError
from ctid_cli.inference.fit import Status
from ctid_cli.inference.monte_carlo import MEASURES, Measure, Measured, Sample, quantile, requested, total
from ctid_cli.inference.units import Units
from ctid_cli.models.several_inputs import is_delay
from ctid_cli.reporting.results import Results, lookup
from ctid_cli.running.theory import least_variances
from ctid_cli.simulation.frequency_measures import MEASURE_UNITS, base_name
from ctid_cli.storage.columns import COUNTS, OF_MEASURES, reserved_names
from ctid_cli.storage.estimates import CLOCKS
from ctid_cli.storage.estimation_errors import distances, places_of, pole_errors, system_of
from ctid_cli.storage.manifest import is_of_signal, true_values
from ctid_cli.storage.truth import coefficients_of
from ctid_cli.text import did_you_mean, listed

if TYPE_CHECKING:
    import pandas as pd

Row = dict[str, Any]

#: Settings that are keys of every row, and their key path in a specification.
ALWAYS = {"snr_db": "noise.snr_db"}
#: Statuses of successful estimates.
SUCCESSES = {Status.CONVERGED.name, Status.LEAST_SQUARES.name, "VALID"}
#: Default measures.
DEFAULT = ("bias", "rmse")
#: Measures for which an estimate without a value counts as infinitely bad.
INFINITE = [name for name, item in MEASURES.items() if item.source in ("distance", "fresh_fit_percent")]
#: Prefixes of the measures of frequencies in rows.
OF_FREQUENCIES = ("median_settling", "median_rms", "false_alarms")


def records_of(frame: pd.DataFrame) -> list[Row]:
    """Return the rows of a frame, None where there is no value."""
    rows: Any = frame.astype(object).where(frame.notna(), None).to_dict("records")
    return list(rows)


def parts_of(frame: pd.DataFrame, *keys: Any) -> Iterator[tuple[Any, pd.DataFrame]]:
    """Yield the rows of each group, in the order of their appearance."""
    yield from frame.groupby([*keys], sort=False, dropna=False)


# --- planned groups -------------------------------------------------------------------------------------------------


def label_frame(
    results: Results, table: int | str | None = None, fields: Mapping[str, str] | None = None
) -> pd.DataFrame:
    """Return the keys of all rows of each planned combination of swept fields, estimator and start."""
    import pandas as pd

    manifest = results.manifest
    down, across = results.swept("data_cells"), results.swept("estimators")
    fields = fields or ({} if is_of_signal(manifest) else ALWAYS)
    constant = {name: lookup(results.settings, path) for name, path in fields.items()}
    # Several sets of initial parameters are identified by their names, initial delays by their values.
    given = {label for label, delay in manifest["starts"].items() if delay is None and label != "none"}
    rows = []
    for cell, estimator, start in results.groups.itertuples(index=False, name=None):
        data, part = manifest["data_cells"][cell], manifest["estimators"][estimator]
        rows.append(
            {"table": table or results.experiment, "experiment": results.experiment, "sampling": results.sampling}
            | constant
            | {name: data["swept"].get(name) for name in down}
            | ({"start": start if start in given else None} if len(given) > 1 else {})
            | {name: part["swept"].get(name) for name in across}
            | {"initial_delay": manifest["starts"].get(start), "method": part["name"]}
        )
    return pd.DataFrame(rows, dtype=object)


def settings_of(names: Iterable[Any]) -> list[str]:
    """Return the keys of swept fields: all names but reserved ones; ``start`` is that of initial parameters."""
    others = reserved_names().difference(["start"])
    return [name for name in names if name not in others and not name.startswith(OF_FREQUENCIES)]


# --- one table of measures --------------------------------------------------------------------------------------------


def measure_frame(results: Results, names: Sequence[str]) -> pd.DataFrame:
    """Return measures by name, of every planned combination of swept fields, estimator and start, by its number."""
    for name in names:
        _require_measurable(name, results)
    return _measure_frame(results, {name: measure_of(name, results) for name in names}, label_frame(results))


def _measure_frame(results: Results, measures: Mapping[str, Measure], labels: pd.DataFrame) -> pd.DataFrame:
    """Return measures with the labels of their groups, and the counts of data sets."""
    import pandas as pd

    failures = pd.Series(results.stored.failures).groupby(results.numbers).agg(["size", "sum"])
    failures = failures.reindex(labels.index, fill_value=0)
    found = pd.concat([_measured(results, *item) for item in measures.items()]).sort_index(kind="stable")
    counts = pd.DataFrame({"n": failures["size"], "failed": failures["sum"]}).loc[found.index]
    return pd.concat(
        [labels.loc[found.index], found.drop(columns="without_value"), counts, found["without_value"]], axis=1
    )


def percentage_frame(
    results: Results, table: int | str | None = None, fields: Mapping[str, str] | None = None
) -> pd.DataFrame:
    """Return the percentages of convergence, and other measures of whole estimates, side by side.

    There is a row for each planned group.
    """
    measures = {"percent": MEASURES["percent"], **_medians(results)}
    long = _measure_frame(results, measures, label_frame(results, table, fields))
    first = long[long["measure"] == "percent"]
    values = {name: long.loc[long["measure"] == name, "value"] for name in measures}
    converged = (first["value"] * first["n"] / 100).round()
    frame = with_types(first.drop(columns=[*OF_MEASURES]).assign(converged=converged, **values))
    return frame[sorted(frame, key=lambda name: str(name).startswith(OF_FREQUENCIES))]


def _medians(results: Results) -> dict[str, Measure]:
    """Return the other measures of whole estimates in tables: times, and stored measures of frequencies."""
    clocks = {name: Measure("median time of one estimate", "s", name, quantile) for name in CLOCKS}
    measured = list(map(str, results.tracks))
    bases = {base_name(name)[0] for name in measured}
    slowest = [base for base in ("settling_time", "settling_after_step") if base in bases]
    names = [*slowest, *(name for name in measured if base_name(name)[0] == "rms")]
    medians = clocks | {name: Measure(name, MEASURE_UNITS[base_name(name)[0]], "measures", quantile) for name in names}
    found = {f"median_{name}": measure for name, measure in medians.items()}
    alarms = {"false_alarms": Measure("false alarms of all data sets", "-", "measures", total)}
    return found | (alarms if "false_alarms" in bases else {})


def with_types(frame: pd.DataFrame) -> pd.DataFrame:
    """Return the counts of cells in their types and order, zero where nothing was run."""
    counts = frame.reindex(columns=[*COUNTS])
    empty = counts["n"].fillna(0) == 0
    for name in ("n", "failed", "converged"):
        counts[name] = counts[name].mask(empty, 0)
    counts = counts.astype(COUNTS)
    return frame.drop(columns=[*COUNTS], errors="ignore").join(counts)


def _measured(results: Results, name: str, measure: Measure) -> pd.DataFrame:
    """Return one measure of every planned group, a row for each parameter or status."""
    import pandas as pd

    values = values_of(results, name, measure)
    bounds = _bounds(results) if name.partition(":")[0] == "efficiency" else {}
    truths = [true_values(cell) for cell in results.manifest["data_cells"]]
    keys, rows = ["group", "parameter"], []
    columns = {key: values[key].to_numpy() for key in ("value", "standard_error", "quantile") if key in values}
    # Numbers in the order of appearance; slices of arrays, since a table for each of many groups would take seconds.
    places = places_of(np.asarray(values.groupby(keys, sort=False, dropna=False).ngroup(), dtype=np.intp))
    for (group, parameter), at in zip(values[keys].drop_duplicates().to_numpy(), places.values(), strict=True):
        own = {key: column[at] for key, column in columns.items()}
        found = measured_of(own, measure, bounds.get(group, {}).get(parameter, math.nan))
        unit = measure.unit
        if measure.source == "errors":
            of_parameter = parameter_unit(parameter, [*truths[results.place(group)[0]]])
            unit = {"": of_parameter, "^2": f"({of_parameter})^2"}.get(unit, unit)
        rows.append((group, parameter, unit, *found, int((~np.isfinite(own["value"])).sum())))
    rows += [
        (group, None, measure.unit, *Measured(), 0) for group in set(results.groups.index).difference(values["group"])
    ]
    names = ["group", "parameter", "unit", *Measured._fields, "without_value"]
    frame = pd.DataFrame(rows, columns=names).astype(dict.fromkeys(Measured._fields, "float64"))
    frame.insert(2, "measure", name)
    return frame.set_index("group")


def measured_of(columns: Mapping[str, Array], measure: Measure, bound: float = math.nan) -> Measured:
    """Return a measure of the known values of one group."""
    known = ~np.isnan(columns["value"])
    own = {key: column[known] for key, column in columns.items()}
    if measure.source == "errors":
        return measure.compute(Sample(own["value"], own["standard_error"], bound, own["quantile"]))
    return measure.compute(own["value"])


def _bounds(results: Results) -> dict[int, dict[str, float]]:
    """Return the variances of the parameters of each group by theory, if they are known."""
    if results.plan is None:
        return {}
    return {k: least_variances(results.plan, *place) for k, *place in results.groups.iloc[:, :2].itertuples()}


def values_of(results: Results, name: str, measure: Measure) -> pd.DataFrame:
    """Return the values of the estimates in a measure: ``group``, ``parameter``, ``replicate`` and ``value``.

    For errors, also ``standard_error`` and ``quantile``. NaN marks an estimate without a value.
    """
    import pandas as pd

    stored, numbers = results.stored, results.numbers
    if measure.source == "errors":
        return _errors_for(results, name, measure)
    values = np.full(len(stored), np.nan)
    estimates = pd.DataFrame({"group": numbers, "parameter": None, "replicate": stored.column("replicate")})
    match measure.source:
        case "status":
            status = np.char.decode(stored.column("status"))
            counted = sorted({*status.tolist()} - SUCCESSES) or ["FAILED"]
            return pd.concat([estimates.assign(parameter=one, value=1.0 * (status == one)) for one in counted])
        case "distance":
            for group in np.unique(numbers).tolist():
                system = system_of(results.manifest["data_cells"][results.place(group)[0]], name)
                values[numbers == group] = distances(system, results.members(group), name)
        case "converged":
            # A group with an estimate to which no rule applies is left out.
            satisfied = pd.Series(stored.satisfied)
            values = satisfied.mask(satisfied.isna().groupby(numbers).transform("any")).to_numpy()
        case "measures":
            # With several tones the last one to settle counts; one that never settles is later than all others.
            measured = map(str, results.tracks)
            tones = [tone for tone in measured if name.removeprefix("median_") in (tone, base_name(tone)[0])]
            values = results.tracks[tones].fillna(math.inf).max(axis=1).to_numpy()
        case "custom_measures":
            parts = stored.export.parts("custom_measures") if stored.has("custom_measures") else []
            values = stored.column("custom_measures")[:, parts.index(name)] if name in parts else values
        case source:
            values = stored.column(source) if stored.has(source) else values
            if source == "fresh_fit_percent" and stored.has(source):
                # Without a model, the fit to a fresh data set is infinitely bad.
                values = np.where(np.isfinite(values), values, -np.inf)
    return estimates.assign(value=values)


def _errors_for(results: Results, name: str, measure: Measure) -> pd.DataFrame:
    """Return the errors of every parameter, of one, or of the poles."""
    import pandas as pd

    argument, errors = name.partition(":")[2], results.errors
    if argument == "poles":
        cells = [results.manifest["data_cells"][k] for k in results.groups["cell"]]
        groups = np.unique(results.numbers).tolist()
        errors = pd.concat([pole_errors(k, system_of(cells[k], name), results.members(k)) for k in groups])
    elif argument:
        errors = errors[errors["parameter"] == argument]
    if measure.of_widths:
        return errors.assign(value=errors["value"].where(errors["standard_error"].notna()))
    return errors


def counted_in(rows: pd.DataFrame) -> pd.Series:
    """Return the number of data sets from which each value is computed."""
    infinite = rows["measure"].str.partition(":")[0].isin(INFINITE)
    return rows["n"] - rows["without_value"].where(~infinite, 0)


def measure_of(name: str, results: Results) -> Measure:
    """Return the measure with a name: one of ctid's, or a custom one of the specification."""
    contents = results.manifest["data_cells"][0]["content"].get("custom_measures") or {}
    custom = {
        own: Measure(f"median of {content['kind']}", content["unit"], "custom_measures", quantile)
        for own, content in contents.items()
    }
    return requested(name, custom)


def requested_measures(results: Results) -> list[str]:
    """Return the names of the measures in the specification."""
    return [one if isinstance(one, str) else one["name"] for one in results.settings.get("measures") or ()]


def default_measures(results: Results) -> Sequence[str]:
    """Return the measures of the specification; without a success rule bias and RMSE; else nothing."""
    named = requested_measures(results)
    measurable = not results.settings.get("success") and results.is_simulated
    return named or (DEFAULT if measurable else ())


def _require_measurable(name: str, results: Results) -> None:
    """Refuse a measure that these results do not have."""
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
    if name == "fresh_fit" and name not in requested_measures(results):
        advice = "add 'measures: [fresh_fit]' to the specification, and run it again"
        raise UsageError(f"{where}: {name} is computed while the experiment runs; {advice}")


def parameter_unit(name: str, names: Sequence[str]) -> str:
    """Return the unit of a parameter of a system; ``-`` if it is not known here."""
    if name.startswith("pole_"):
        return "rad/s"
    if is_delay(name):
        return Units().of("delay", 0, 0)
    several = any(is_delay(other) and other != "delay" for other in names)
    own, separator, bare = name.rpartition("_") if several else ("", "", name)
    if re.fullmatch(r"[ab]\d+", bare):
        # A common denominator has no prefix.
        poles = coefficients_of(f"{own}{separator}a", names) or coefficients_of("a", names)
        return Units().of(bare, poles, coefficients_of(f"{own}{separator}b", names) - 1)
    return Units().of_submodel(name) if re.fullmatch(r"g\d+_[ab]\d+", name) else "-"
