"""Result of ``ctid export --id``: one stored estimate in full."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

from ctid_cli.inference.intervals import BIASED, NORMAL, UncertainValue
from ctid_cli.kinds import KINDS
from ctid_cli.reporting.document import Column, Result, Section, Table
from ctid_cli.reporting.estimate import PARAMETER, parameter_rows, parameters
from ctid_cli.reporting.layout import delay_label, number, seconds
from ctid_cli.simulation.frequency_measures import MEASURE_UNITS, base_name, measure_names
from ctid_cli.storage.estimates import as_object

if TYPE_CHECKING:
    from ctid_cli.storage.estimates import Estimates
    from ctid_cli.storage.manifest import Slot


@dataclass(frozen=True, eq=False)
class EstimateResult(Result):
    """One stored estimate: parameters with their uncertainty, status and origin."""

    schema = "ctid-estimate-1"

    #: This estimate only.
    stored: Estimates

    @cached_property
    def row(self) -> dict[str, Any]:
        """All that is stored of it."""
        return next(self.stored.rows())

    @cached_property
    def slot(self) -> Slot:
        """Its place in the plan."""
        return self.stored.slot(0)

    @property
    def parameters(self) -> list[UncertainValue]:
        """Parameters with their uncertainty."""
        estimator = self.slot.estimator
        # A custom estimator may use the name for something else.
        ours = estimator["kind"] in KINDS["estimator"]
        return parameters(self.row, estimator["content"].get("delay_bounds") if ours else None)

    def content(self) -> dict[str, Any]:
        """Return the estimate for JSON, with its parameters, data and settings."""
        return as_object(self.row) | {
            "parameters": parameter_rows(self.parameters),
            "data": self.slot.cell["content"],
            "settings": self.slot.estimator["content"],
            "seed": self.stored.manifest["seed"],
            "origins": [origin._asdict() for origin in self.stored.origins],
        }

    def sections(self) -> list[Section]:
        """Return identification, numbers, data and settings of the estimate."""
        row, seed = self.row, self.stored.manifest["seed"]
        head = [f"{row['estimator']} ({row['kind']}), data set {row['replicate']}{_start(row)}"]
        head.append(f"{row['status']}: {row['message']}")
        head += [row["marks"]] * bool(row.get("marks"))
        if row.get("converged") is not None:
            head.append("It meets the success rule." if row["converged"] else "It does not meet the success rule.")
        numbers = [self._fitted(), _facts(row)]
        if "measures" in row:
            columns = Column("measure"), Column("value"), Column("unit")
            numbers = [Section(table=Table.of(_measures(row), columns), notes=[f"Time: {_times(row)}."])]
        data = f"Data (cell {row['cell']}, seed {seed}, data set {row['replicate']})"
        return [
            Section(f"Estimate {row['id']} of {row['experiment']}", head),
            *numbers,
            Section(data, _settings(self.slot.cell["content"])),
            Section("Estimator", _settings(self.slot.estimator["content"])),
        ]

    def main_table(self) -> Table:
        """Return one row for each parameter, or measure of frequencies."""
        rows = _measures(self.row) if "measures" in self.row else parameter_rows(self.parameters)
        return Table.of_rows(rows)

    def _fitted(self) -> Section:
        """Return the parameters of a model, and the meaning of their names and intervals."""
        row = self.row
        notes = [f"True delay: {number(row['true_delay'])} s."] if row.get("true_delay") is not None else []
        if not self.parameters:
            return Section(notes=notes)
        return Section(
            table=Table.of(self.parameters, PARAMETER),
            notes=[" ".join([*_conventions([one.name for one in self.parameters]), _interval(row)]), *notes],
        )


def _conventions(names: Collection[str]) -> list[str]:
    """Return the meaning of the names of parameters."""
    if not any(name.startswith("g") for name in names):
        return ["Monic denominator, descending powers."]
    lines = ["g1: submodel of the least natural frequency; g1_a2: coefficient of p^2 in its denominator (ends in 1)."]
    if "a1" in names:
        lines.append("a1, b0: all submodels as one fraction with a monic denominator, descending powers.")
    return lines


def _facts(row: Mapping[str, Any]) -> Section:
    """Return the quality of fit, and details of the computation."""
    facts = {"fit": f"{number(row['fit_percent'])} % of the data that it was estimated from"}
    if row.get("validation_fit_percent") is not None:
        facts["validation fit"] = f"{number(row['validation_fit_percent'])} %"
    facts |= {name: number(value) for name, value in (row.get("custom_measures") or {}).items()}
    facts |= {
        "cost": f"{number(row['cost'])} (output unit)^2, mean squared output error",
        "iterations": number(row["iterations"]),
        "condition number": number(row["condition_number"], 3),
        "time": _times(row),
    }
    return Section(table=Table.of_pairs(facts.items()))


def _measures(row: Mapping[str, Any]) -> list[dict[str, str]]:
    """Return the measures of the frequencies of a signal."""
    measures = row["measures"] or {}
    return [
        {
            "measure": name,
            "value": number(measures[name], 8 if name.startswith("omega") else 4),
            "unit": MEASURE_UNITS[base_name(name)[0]],
        }
        for name in measure_names([measures])
    ]


def _times(row: Mapping[str, Any]) -> str:
    cpu = row.get("cpu_seconds")
    return seconds(row["seconds"]) + (f" ({seconds(cpu)} of processor time)" if cpu is not None else "")


def _settings(content: Mapping[str, Any]) -> list[str]:
    return ["\n".join(f"  {key}: {json.dumps(value, ensure_ascii=False)}" for key, value in content.items())]


def _interval(row: Mapping[str, Any]) -> str:
    """Return the formula of intervals."""
    formula, freedom = row.get("covariance"), row.get("degrees_of_freedom")
    if formula == "biased":
        return BIASED
    reach = {f"{value:.3g}" for value in (row.get("quantiles") or {}).values()} or {f"{NORMAL:.3g}"}
    text = f"Low and high are estimate -+ {reach.pop() if len(reach) == 1 else 'their own number of'} errors"
    if not formula:
        return f"{text}."
    noise = "white" if formula == "white" else "coloured"
    how = "bootstrap-t" if formula == "bootstrap" else f"t, {number(freedom, 4)} degrees of freedom"
    return f"{text} ({how}); errors are those for {noise} noise."


def _start(row: Mapping[str, Any]) -> str:
    if "measures" in row:
        return ""
    if row["initial_delay"] is None:
        return f", start {row['start']}"
    drawn = f" ({number(row['start_delay'])} s)" if row["initial_delay"] == "random" else ""
    return f", start {delay_label(row['initial_delay'])}{drawn}"
