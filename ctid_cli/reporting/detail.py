"""What ``ctid show`` answers: one estimate in full, what it was computed from, and the same once more."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ctid_cli.canonical import plain
from ctid_cli.errors import MismatchError
from ctid_cli.inference.intervals import BIASED, NORMAL, UncertainValue
from ctid_cli.kinds import KINDS
from ctid_cli.reporting.estimate import as_object, parameter_object, parameter_table, parameters
from ctid_cli.reporting.layout import Table, delay_label, number, seconds
from ctid_cli.reporting.results import out_option
from ctid_cli.storage.status import FoundEstimate, spec_folder

#: A repeated estimate agrees if no parameter moved by more than this fraction; other processors give other last bits.
AGREEMENT = 1e-6


@dataclass(frozen=True)
class Repeated:
    """An estimate that was computed once more."""

    #: Its accepted iterations: stage, iteration, delay [s], cost [output unit^2], coefficients.
    history: list[dict[str, Any]]
    #: Largest relative difference from the stored one [-]; None where there is nothing to compare with.
    difference: float | None


def detail_object(found: FoundEstimate, again: Repeated | None, out: Path) -> dict[str, Any]:
    """One estimate for ``ctid show --json``."""
    content = as_object(found.row) | {
        "parameters": [parameter_object(item) for item in _parameters(found)],
        "data": found.slot.cell["content"],
        "settings": found.slot.estimator["content"],
        "seed": found.stored.manifest["seed"],
        "origins": [origin._asdict() for origin in found.stored.origins],
        "redo": _redo_command(found, out),
    }
    return content if again is None else content | asdict(again)


def detail_text(found: FoundEstimate, again: Repeated | None, out: Path) -> str:
    """One estimate as text."""
    row = found.row
    head = [
        f"Estimate {row['id']} of {row['experiment']}",
        f"{row['estimator']} ({row['kind']}), data set {row['replicate']}{_start(row)}",
        f"{row['status']}: {row['message']}",
    ]
    if row.get("converged") is not None:
        head.append("It meets the success rule." if row["converged"] else "It does not meet the success rule.")
    data, estimator = found.slot.cell["content"], found.slot.estimator["content"]
    place = f"Data (cell {row['cell']}, seed {found.stored.manifest['seed']}, data set {row['replicate']}):"
    origin = [place, *_settings(data), "Estimator:", *_settings(estimator)]
    of_signal = "measures" in row
    blocks = [head, *(_measured(row) if of_signal else _fitted(found)), origin]
    if again is None:
        blocks.append(["To make this data set and this estimate again:", f"  {_redo_command(found, out)}"])
    else:
        blocks.append([_verdict(again, "frequencies" if of_signal else "parameters")])
        blocks += [[_history(again)]] if again.history else []
    return "\n\n".join("\n".join(block) for block in blocks)


def _parameters(found: FoundEstimate) -> list[UncertainValue]:
    # An estimator of one's own may mean something else by the name.
    ours = found.slot.estimator["kind"] in KINDS["estimator"]
    return parameters(found.row, found.slot.estimator["content"].get("delay_bounds") if ours else None)


def _fitted(found: FoundEstimate) -> list[list[str]]:
    """Parameters of a model, and how well it fits."""
    row, shown = found.row, _parameters(found)
    table = [parameter_table(shown).draw(), *_conventions(shown, _interval(row))] if shown else []
    if row.get("true_delay") is not None:
        table.append(f"True delay: {number(row['true_delay'])} s.")
    facts = [("fit", f"{number(row['fit_percent'])} % of the data it was estimated from")]
    if row.get("validation_fit_percent") is not None:
        facts.append(("", f"{number(row['validation_fit_percent'])} % of the validation part"))
    facts += [(name, number(value)) for name, value in (row.get("custom_measures") or {}).items()]
    facts += [
        ("cost", f"{number(row['cost'])} (mean squared output error, output unit^2)"),
        ("iterations", number(row["iterations"])),
        ("condition number", number(row["condition_number"], 3)),
        ("time", _times(row)),
    ]
    measures = [f"{name:16} {text}" for name, text in facts]
    return [table, measures] if table else [measures]


def _measured(row: Mapping[str, Any]) -> list[list[str]]:
    """What was measured of the frequencies of a signal."""
    from ctid_cli.simulation.frequency_measures import MEASURE_UNITS, base_name, measure_names

    measures = row["measures"] or {}
    body = [
        [name, number(measures[name], 8 if name.startswith("omega") else 4), MEASURE_UNITS[base_name(name)[0]]]
        for name in measure_names([measures])
    ]
    table = [[Table(["measure", "value", "unit"], body, "lrl").draw()]] if body else []
    return [*table, [f"time             {_times(row)}"]]


def _times(row: Mapping[str, Any]) -> str:
    cpu = row.get("cpu_seconds")
    return seconds(row["seconds"]) + (f" ({seconds(cpu)} of the processor)" if cpu is not None else "")


def _redo_command(found: FoundEstimate, out: Path) -> str:
    return f"ctid show {found.row['id']} --history{out_option(out)}"


def repeat(found: FoundEstimate, *, allow_code: bool = False) -> Repeated:
    """Make the data set of an estimate and the estimate once more."""
    from ctid_cli.running.plan import build_plan
    from ctid_cli.simulation.frequency_measures import SignalDataSet
    from ctid_cli.specification.load import spec_from_canonical

    row = found.row
    folder = spec_folder(found.folder)
    plan = build_plan(spec_from_canonical(found.stored.manifest["spec"], folder, allow_code=allow_code))
    cells = [number for number, cell in enumerate(plan.data_cells) if cell.hash == row["cell"]]
    wanted = [one for number in cells[:1] for one in plan.keys(number, row["replicate"]) if one[0].id == row["id"]]
    if not wanted:
        raise MismatchError(f"the stored specification of {row['experiment']} does not describe estimate {row['id']}")
    key, cell, start = wanted[0]
    data = plan.data_cells[cells[0]].dataset(key.replicate)
    drawn = start.draw(found.stored.manifest["seed"], key.replicate, data.true_model)
    fit = cell.estimator.prepare(data.record).fit(drawn)
    if isinstance(data, SignalDataSet):
        sides = (row.get("measures") or {}, data.result_of(fit, None, None)["measures"])
        then, now = ({k: v for k, v in side.items() if k.startswith("omega")} for side in sides)
        return Repeated([], _difference(then, now))
    model = data.result_of(fit, drawn, None)
    then, now = _coefficients(row), _coefficients(plain(model))
    difference = _difference(then, now) if then.keys() <= now.keys() else float("inf")
    return Repeated([plain(asdict(entry)) for entry in fit.history], difference)


def _coefficients(model: Mapping[str, Any]) -> dict[str, float | None]:
    if not model["numerator"] or not model["denominator"]:
        return dict(model.get("parameters") or {})
    sides = {"b": model["numerator"], "a": model["denominator"], "delay": [model["delay"]]}
    return {f"{name}{len(values) - k}": value for name, values in sides.items() for k, value in enumerate(values)}


def _difference(then: Mapping[str, float | None], now: Mapping[str, float | None]) -> float | None:
    """Largest relative difference of the numbers that both have."""
    pairs = [(a, b) for name, a in then.items() if a is not None and (b := now.get(name)) is not None]
    return max((abs(a - b) / max(abs(a), abs(b)) if a != b else 0.0 for a, b in pairs), default=None)


def _verdict(again: Repeated, what: str) -> str:
    if again.difference is None:
        return f"Computed once more; there are no stored {what} to compare with."
    if again.difference == 0:
        return f"Computed once more: the same {what} to the last digit."
    if again.difference <= AGREEMENT:
        return f"Computed once more: the same {what}, up to {again.difference:.1e} of their size."
    why = "Another version of the code or another processor computed the stored ones."
    return f"Computed once more: {what} differ by up to {again.difference:.1e} of their size. {why}"


def _history(again: Repeated) -> str:
    rows = [
        [str(entry["stage"]), str(entry["iteration"]), number(entry["delay"], 8), number(entry["cost"], 8)]
        + [" ".join(number(value, 5) for value in entry[name]) for name in ("numerator", "denominator")]
        for entry in again.history
    ]
    return Table(["stage", "iteration", "delay [s]", "cost", "numerator", "denominator"], rows, "lrrrll").draw()


def _settings(content: Mapping[str, Any]) -> list[str]:
    return [f"  {key}: {json.dumps(value, ensure_ascii=False)}" for key, value in content.items()]


def _interval(row: Mapping[str, Any]) -> str:
    """How intervals follow from errors."""
    formula, freedom = row.get("covariance"), row.get("degrees_of_freedom")
    if formula == "biased":
        return BIASED
    reach = {f"{value:.3g}" for value in (row.get("quantiles") or {}).values()} or {f"{NORMAL:.3g}"}
    text = f"low and high are estimate -+ {reach.pop() if len(reach) == 1 else 'their own number of'} errors"
    if not formula:
        return f"{text}."
    noise = "white" if formula == "white" else "coloured"
    how = "bootstrap-t" if formula == "bootstrap" else f"t, {number(freedom, 4)} degrees of freedom"
    return f"{text} ({how}); errors are those for {noise} noise."


def _conventions(shown: list[UncertainValue], interval: str) -> list[str]:
    """What the names and columns of a table of parameters mean."""
    names = [item.name for item in shown]
    if not any(name.startswith("g") for name in names):
        return [f"Monic denominator, descending powers; {interval}"]
    lines = ["g1: submodel of the least natural frequency; g1_a2: coefficient of p^2 in its denominator (ends in 1)."]
    if "a1" in names:
        lines.append("a1, b0: all submodels as one fraction with a monic denominator, descending powers.")
    return [*lines, interval[0].upper() + interval[1:]]


def _start(row: Mapping[str, Any]) -> str:
    if "measures" in row:
        return ""
    if row["initial_delay"] is None:
        return f", start {row['start']}"
    drawn = f" ({number(row['start_delay'])} s)" if row["initial_delay"] == "random" else ""
    return f", start {delay_label(row['initial_delay'])}{drawn}"
