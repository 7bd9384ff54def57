"""What ``ctid show`` answers: one estimate in full, what it was computed from, and the same once more."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ctid_cli.canonical import plain
from ctid_cli.errors import MismatchError
from ctid_cli.inference.uncertain_value import UncertainValue
from ctid_cli.reporting.estimate import as_object, parameter_object, parameter_table, parameters
from ctid_cli.reporting.layout import delay_label, number, seconds, text_table
from ctid_cli.reporting.results import out_option
from ctid_cli.running.plan import build_plan
from ctid_cli.simulation.frequency_measures import MEASURE_UNITS, base_name, measure_names
from ctid_cli.simulation.frequency_runs import FrequencyFit, SignalDataSet
from ctid_cli.specification.spec import spec_from_canonical
from ctid_cli.storage.store import FoundEstimate, read_stored, spec_folder

#: A repeated estimate agrees if no parameter moved by more than this fraction; other processors give other last bits.
AGREEMENT = 1e-6


@dataclass(frozen=True)
class Repeated:
    """An estimate that was computed once more."""

    #: Its accepted iterations: stage, iteration, delay [s], cost [output unit^2], coefficients.
    history: list[dict[str, Any]]
    difference: float | None

    @property
    def agrees(self) -> bool:
        """Whether it is the stored estimate."""
        return self.difference is None or self.difference <= AGREEMENT


def parameters_of(found: FoundEstimate) -> list[UncertainValue]:
    """Parameters of a stored estimate with their uncertainty."""
    return parameters(found.row, found.estimator.get("delay_bounds"))


def detail_object(found: FoundEstimate, again: Repeated | None, out: Path) -> dict[str, Any]:
    """One estimate for ``ctid show --json``."""
    content = as_object(found.row) | {
        "parameters": [parameter_object(item) for item in parameters_of(found)],
        "data": found.data,
        "settings": found.estimator,
        "seed": found.seed,
        "origins": [asdict(origin) for origin in found.origins],
        "redo": redo_command(found, out),
    }
    return content if again is None else content | {"history": again.history, "difference": again.difference}


def detail_text(found: FoundEstimate, again: Repeated | None, out: Path) -> str:
    """One estimate as text."""
    row = found.row
    lines = [
        f"Estimate {row['id']} of {row['experiment']}",
        f"{row['estimator']} ({row['kind']}), data set {row['replicate']}{_start(row)}",
        f"{row['status']}: {row['message']}",
    ]
    if row.get("converged") is not None:
        lines.append("It meets the success rule." if row["converged"] else "It does not meet the success rule.")
    if "measures" in row:
        return "\n".join([*lines, *_measured(found), "", *_origin_of(found), *_repeated(found, again, out)])
    shown = parameters_of(found)
    if shown:
        lines += ["", parameter_table(shown), *_conventions(shown)]
    if row.get("true_delay") is not None:
        lines.append(f"True delay: {number(row['true_delay'])} s.")
    lines += [
        "",
        f"fit              {number(row['fit_percent'])} % of the data it was estimated from",
        *(
            [f"                 {number(row['validation_fit_percent'])} % of the validation part"]
            if row.get("validation_fit_percent") is not None
            else []
        ),
        f"cost             {number(row['cost'])} (mean squared output error, output unit^2)",
        f"iterations       {number(row['iterations'])}",
        f"condition number {number(row['condition_number'], 3)}",
        f"time             {seconds(row['seconds'])}",
        "",
        *_origin_of(found),
    ]
    return "\n".join([*lines, *_repeated(found, again, out)])


def _measured(found: FoundEstimate) -> list[str]:
    """What was measured of the frequencies of a signal."""
    measures = found.row["measures"] or {}
    body = [
        [name, number(measures[name], 8 if name.startswith("omega") else 4), MEASURE_UNITS[base_name(name)[0]]]
        for name in measure_names([measures])
    ]
    table = ["", text_table(["measure", "value", "unit"], body, "lrl")] if body else []
    return [*table, "", f"time             {seconds(found.row['seconds'])}"]


def _origin_of(found: FoundEstimate) -> list[str]:
    row = found.row
    return [
        f"Data (cell {row['cell']}, seed {found.seed}, data set {row['replicate']}):",
        *_settings(found.data),
        "Estimator:",
        *_settings(found.estimator),
        "",
    ]


def _repeated(found: FoundEstimate, again: Repeated | None, out: Path) -> list[str]:
    if again is not None:
        what = "frequencies" if "measures" in found.row else "parameters"
        return [_verdict(again, what), *(["", _history(again)] if again.history else [])]
    every = "" if "measures" in found.row else " and see every iteration"
    return [f"To make this data set and this estimate again{every}:", f"  {redo_command(found, out)}"]


def redo_command(found: FoundEstimate, out: Path) -> str:
    """The command that repeats an estimate."""
    return f"ctid show {found.row['id']} --history{out_option(out)}"


def repeat(found: FoundEstimate) -> Repeated:
    """Make the data set of an estimate and the estimate once more."""
    row = found.row
    spec = spec_from_canonical(read_stored(found.folder).manifest["spec"], spec_folder(found.folder))
    plan = build_plan(spec)
    for task in plan.tasks():
        cell = plan.data_cells[task.cell]
        if (cell.hash, task.replicate) != (row["cell"], row["replicate"]):
            continue
        for key, estimator, start in plan.keys(task):
            if key.id == row["id"]:
                data = cell.dataset(task.replicate)
                drawn = start.draw(found.seed, task.replicate, data.true_model)
                fit = estimator.estimator.prepare(data.record).fit(drawn)
                if isinstance(fit, FrequencyFit) and isinstance(data, SignalDataSet):
                    return Repeated([], _moved(row.get("measures") or {}, fit.result(data)["measures"]))
                model = {
                    "numerator": plain(fit.model.numerator),
                    "denominator": plain(fit.model.denominator),
                    "delay": float(fit.model.delay),
                }
                return Repeated([plain(asdict(entry)) for entry in fit.history], _difference(row, model))
    raise MismatchError(f"the stored specification of {row['experiment']} does not describe estimate {row['id']}")


def _difference(stored: Mapping[str, Any], model: Mapping[str, Any]) -> float | None:
    if not stored.get("denominator") or not stored.get("numerator"):
        return None
    worst = 0.0
    for name in ("numerator", "denominator", "delay"):
        then, now = (item if isinstance(item, list) else [item] for item in (stored[name], model[name]))
        if len(then) != len(now):
            return float("inf")
        for a, b in zip(then, now, strict=True):
            if a is not None and b is not None and a != b:
                worst = max(worst, abs(a - b) / max(abs(a), abs(b)))
    return worst


def _moved(stored: Mapping[str, float | None], now: Mapping[str, float | None]) -> float | None:
    """Largest relative difference between frequencies."""
    worst = None
    for name, then in stored.items():
        value = now.get(name)
        if name.startswith("omega") and then is not None and value is not None:
            worst = max(worst or 0.0, abs(value - then) / max(abs(then), abs(value)))
    return worst


def _verdict(again: Repeated, what: str) -> str:
    if again.difference is None:
        return f"Computed once more; there are no stored {what} to compare with."
    if again.difference == 0:
        return f"Computed once more: the same {what} to the last digit."
    if again.agrees:
        return f"Computed once more: the same {what}, up to {again.difference:.1e} of their size."
    return (
        f"Computed once more: {what} differ by up to {again.difference:.1e} of their size. "
        "Another version of the code or another processor computed the stored ones."
    )


def _history(again: Repeated) -> str:
    rows = [
        [str(entry["stage"]), str(entry["iteration"]), number(entry["delay"], 8), number(entry["cost"], 8)]
        + [" ".join(number(value, 5) for value in entry[name]) for name in ("numerator", "denominator")]
        for entry in again.history
    ]
    return text_table(["stage", "iteration", "delay [s]", "cost", "numerator", "denominator"], rows, "lrrrll")


def _settings(content: Mapping[str, Any]) -> list[str]:
    return [f"  {key}: {json.dumps(value, ensure_ascii=False)}" for key, value in content.items()]


def _conventions(shown: list[UncertainValue]) -> list[str]:
    """What the names and columns of a table of parameters mean."""
    interval = "low and high are estimate -+ 1.96 errors."
    submodels = any(item.name.startswith("g") for item in shown)
    if not submodels:
        return [f"Monic denominator, descending powers; {interval}"]
    lines = [
        "g1: submodel of the least natural frequency; g1_a2: coefficient of p^2 in its denominator, which ends in 1."
    ]
    if any(item.name == "a1" for item in shown):
        lines.append("a1, b0: all submodels as one fraction with a monic denominator, descending powers.")
    return [*lines, interval.capitalize()]


def _start(row: Mapping[str, Any]) -> str:
    if "measures" in row:
        return ""
    if row["initial_delay"] is None:
        return f", start {row['start']}"
    label = delay_label(row["initial_delay"])
    return f", start {label} ({number(row['start_delay'])} s)" if label == "random" else f", start {label}"
