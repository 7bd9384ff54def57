"""Estimates for other programs, and one of them in full: the results of ``ctid export``."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from textwrap import indent
from typing import TYPE_CHECKING, Any

import pandas as pd

from ctid_cli.inference.intervals import BIASED, NORMAL, UncertainValue
from ctid_cli.kinds import KINDS
from ctid_cli.reporting.document import Result, Section, pairs
from ctid_cli.reporting.estimate import PARAMETER_FORMATS, as_object, parameter_frame, parameter_object, parameters
from ctid_cli.reporting.layout import delay_label, number, seconds
from ctid_cli.simulation.frequency_measures import MEASURE_UNITS, base_name, measure_names
from ctid_cli.storage import columns
from ctid_cli.storage.column_arrays import ROWS
from ctid_cli.storage.estimates import Estimates, export_rows
from ctid_cli.storage.manifest import swept_names

if TYPE_CHECKING:
    from ctid_cli.storage.status import FoundEstimate


@dataclass(frozen=True, eq=False)
class EstimateResult(Result):
    """One stored estimate: its parameters with their uncertainty, its status, and what it was computed from."""

    schema = "ctid-estimate-1"

    found: FoundEstimate

    @property
    def parameters(self) -> list[UncertainValue]:
        """Parameters with their uncertainty."""
        estimator = self.found.slot.estimator
        # A custom estimator may mean something else by the name.
        ours = estimator["kind"] in KINDS["estimator"]
        return parameters(self.found.row, estimator["content"].get("delay_bounds") if ours else None)

    def content(self) -> dict[str, Any]:
        """Return the estimate for JSON, with its parameters, data and settings."""
        manifest = self.found.stored.manifest
        return as_object(self.found.row) | {
            "parameters": [parameter_object(item) for item in self.parameters],
            "data": self.found.slot.cell["content"],
            "settings": self.found.slot.estimator["content"],
            "seed": manifest["seed"],
            "origins": [origin._asdict() for origin in self.found.stored.origins],
        }

    def sections(self) -> list[Section]:
        """Return what it is, its numbers, and the data and the settings that it comes from."""
        row, seed = self.found.row, self.found.stored.manifest["seed"]
        head = [f"{row['estimator']} ({row['kind']}), data set {row['replicate']}{_start(row)}"]
        head.append(f"{row['status']}: {row['message']}")
        if row.get("converged") is not None:
            head.append("It meets the success rule." if row["converged"] else "It does not meet the success rule.")
        numbers = [_frequencies(row)] if "measures" in row else [self._fitted(), _facts(row)]
        data = f"Data (cell {row['cell']}, seed {seed}, data set {row['replicate']})"
        return [
            Section(f"Estimate {row['id']} of {row['experiment']}", head),
            *numbers,
            Section(data, _settings(self.found.slot.cell["content"])),
            Section("Estimator", _settings(self.found.slot.estimator["content"])),
        ]

    def to_frame(self) -> pd.DataFrame:
        """Return one row for each parameter, or measure of frequencies."""
        if "measures" in self.found.row:
            frame = _frequencies(self.found.row).frame
            assert frame is not None
            return frame
        return pd.DataFrame([parameter_object(item) for item in self.parameters])

    def _fitted(self) -> Section:
        """Return the parameters of a model, and what their names and intervals mean."""
        row, names = self.found.row, [item.name for item in self.parameters]
        notes = [f"True delay: {number(row['true_delay'])} s."] if row.get("true_delay") is not None else []
        if not names:
            return Section(notes=notes)
        meaning = " ".join([*_conventions(names), _interval(row)])
        return Section(frame=parameter_frame(self.parameters), formats=PARAMETER_FORMATS, notes=[meaning, *notes])


def _facts(row: Mapping[str, Any]) -> Section:
    """Return how well a model fits, and how it was computed."""
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
    return Section(frame=pairs(list(facts.items())))


def _frequencies(row: Mapping[str, Any]) -> Section:
    """Return what was measured of the frequencies of a signal."""
    measures = row["measures"] or {}
    lines = [
        (name, number(measures[name], 8 if name.startswith("omega") else 4), MEASURE_UNITS[base_name(name)[0]])
        for name in measure_names([measures])
    ]
    return Section(frame=pd.DataFrame(lines, columns=["measure", "value", "unit"]), notes=[f"Time: {_times(row)}."])


def _times(row: Mapping[str, Any]) -> str:
    cpu = row.get("cpu_seconds")
    return seconds(row["seconds"]) + (f" ({seconds(cpu)} of the processor)" if cpu is not None else "")


def _settings(content: Mapping[str, Any]) -> list[str]:
    return ["\n".join(f"  {key}: {json.dumps(value, ensure_ascii=False)}" for key, value in content.items())]


def _interval(row: Mapping[str, Any]) -> str:
    """Return how intervals follow from errors."""
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


def _conventions(names: list[str]) -> list[str]:
    """Return what the names of parameters mean."""
    if not any(name.startswith("g") for name in names):
        return ["Monic denominator, descending powers."]
    lines = ["g1: submodel of the least natural frequency; g1_a2: coefficient of p^2 in its denominator (ends in 1)."]
    if "a1" in names:
        lines.append("a1, b0: all submodels as one fraction with a monic denominator, descending powers.")
    return lines


def _start(row: Mapping[str, Any]) -> str:
    if "measures" in row:
        return ""
    if row["initial_delay"] is None:
        return f", start {row['start']}"
    drawn = f" ({number(row['start_delay'])} s)" if row["initial_delay"] == "random" else ""
    return f", start {delay_label(row['initial_delay'])}{drawn}"


# --- all of an experiment ---------------------------------------------------------------------------------------------


def csv_lines(stored: Estimates) -> Iterator[str]:
    """The estimates as CSV, the head first."""
    types = _types(stored)
    head = _head(stored, types)
    yield str(head.to_csv(index=False, lineterminator="\n"))
    for start in range(0, len(stored), ROWS):
        flat = export_rows(stored.part(start, start + ROWS).frame(types=types))
        yield str(flat.reindex(columns=head.columns).to_csv(index=False, lineterminator="\n", header=False))


def _head(stored: Estimates, types: Mapping[str, Any]) -> pd.DataFrame:
    """A table without rows, with the columns of an estimate that has all that any of them has."""
    some: dict[str, Any] = dict.fromkeys(map(str, stored.part(0, 0).frame(types=types)))
    for column in columns.COLUMNS:
        if column.name not in some:
            continue
        if column.type == "by name" and stored.has(column.name):
            there: Any = stored.column(f"{column.name}_present").any(axis=0).tolist()
            parts = zip(stored.export.parts(column.name), there, strict=True)
            some[column.name] = {name: 0.0 for name, one in parts if one}
        elif column.type == "coefficients" and stored.has(column.name):
            some[column.name] = [0.0] * max(0, int(stored.column(f"{column.name}_length").max(initial=0)))
    whole = pd.DataFrame({name: pd.Series([value], dtype="object") for name, value in some.items()})
    return export_rows(whole).iloc[:0]


def _types(stored: Estimates) -> dict[str, Any]:
    """Types that columns of swept fields have over all estimates."""
    swept = [{**block.cell["swept"], **block.estimator["swept"]} for block in stored.blocks]
    return {name: pd.Series([part.get(name) for part in swept]).dtype for name in swept_names(stored.manifest)}


def json_lines(rows: Iterable[Mapping[str, Any]]) -> Iterator[str]:
    """The estimates as one list of objects."""
    before = "[\n"
    for row in rows:
        yield before + indent(json.dumps(as_object(row), indent=1, allow_nan=False), " ")
        before = ",\n"
    yield "[]\n" if before == "[\n" else "\n]\n"
