"""What ``ctid check accuracy`` says: standard errors that the estimators of an experiment can reach."""

from typing import Any

import numpy as np

from ctid_cli.errors import BiasedError, DataError, UsageError
from ctid_cli.inference.intervals import normal_quantile
from ctid_cli.reporting.expected_accuracy import expected_accuracy
from ctid_cli.reporting.layout import Report, Table, count, number, setting_text, setting_title
from ctid_cli.reporting.results import Results
from ctid_cli.reporting.surprises import FEWEST, surprises
from ctid_cli.running.job import DataCell, EstimatorCell
from ctid_cli.running.plan import Plan
from ctid_cli.simulation.dataset import SimulatedSource
from ctid_cli.text import listed

#: On what all of it rests.
REMARK = (
    "This is to first order in the noise, where the estimator converges to the right solution; it takes the noise to "
    "be as specified and the system to be at rest, and does not count initial states and offsets."
)
#: Different numbers of samples that are shown, of all that are swept.
SIZES = 4
#: Combinations of the other swept settings that are shown.
SETTINGS = 6


def accuracy_object(plan: Plan, results: Results | None = None) -> dict[str, Any]:
    """Expected accuracy of every estimator of an experiment as JSON-able content, and what its results say to it."""
    cells = [(cell, cell.source) for cell in plan.data_cells if isinstance(cell.source, SimulatedSource)]
    if not cells:
        text = f"{plan.experiment} is about a measured record, whose true system is not known; "
        raise UsageError(f"{text}its estimates carry their standard errors: ctid fit, or ctid run and ctid table")
    shown = _shown(cells)
    estimates = [_entry(cell, source, estimator, plan) for cell, source in shown for estimator in plan.estimators]
    content = {"experiment": plan.experiment, "left_out": len(cells) - len(shown), "estimates": estimates}
    return content | {"surprises": None if results is None else surprises(results)}


def _own(cell: DataCell) -> dict[str, Any]:
    """Swept settings besides the number of samples."""
    return {name: value for name, value in cell.swept.items() if name.split(".")[-1] != "samples"}


def _shown(cells: list[tuple[DataCell, SimulatedSource]]) -> list[tuple[DataCell, SimulatedSource]]:
    """Data cells of the first settings, each at a few numbers of samples from the least to the greatest."""
    by_settings: dict[str, dict[int, int]] = {}
    for k, (cell, source) in enumerate(cells):
        by_settings.setdefault(repr(_own(cell)), {})[source.sampling.length] = k
    shown: list[int] = []
    for places in list(by_settings.values())[:SETTINGS]:
        some = np.unique(np.linspace(0, len(places) - 1, SIZES).round().astype(int))
        shown += (places[sorted(places)[k]] for k in some)
    return [cells[k] for k in sorted(shown)]


def _entry(cell: DataCell, source: SimulatedSource, estimator: EstimatorCell, plan: Plan) -> dict[str, Any]:
    entry: dict[str, Any] = {
        "settings": _own(cell),
        "samples": source.sampling.length,
        "estimator": estimator.name,
        "options": dict(estimator.swept),
        "kind": estimator.kind,
    }
    try:
        expected = expected_accuracy(source, estimator.estimator, plan.terms)
    except DataError as error:
        reason = f"the estimate is biased, as {error}" if isinstance(error, BiasedError) else str(error)
        return entry | {"scales": False, "reason": reason, "parameters": []}
    found = expected.parameters
    rows = [
        {
            "name": name,
            "value": float(value),
            "standard_error": float(error),
            "relative_percent": float(100 * error / abs(value)) if value else None,
            "half_width_95": float(normal_quantile() * error),
        }
        for name, value, error in zip(found.names, found.values, found.standard_errors, strict=True)
    ]
    return entry | {"scales": expected.limit, "formula": expected.formula, "parameters": rows}


def accuracy_text(content: dict[str, Any]) -> str:
    """Expected accuracy of every estimator of an experiment for people."""
    # Entries that differ by the number of samples only share a table, and so do estimators that can do the same.
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for entry in content["estimates"]:
        groups.setdefault((_settings(entry["settings"]), _title(entry)), []).append(entry)
    tables: dict[tuple[str, str], list[str]] = {}
    unknown: dict[str, list[str]] = {}
    formulas: dict[str, list[dict[str, Any]]] = {}
    for (settings, title), entries in groups.items():
        entries.sort(key=lambda entry: int(entry["samples"]))
        if known := [entry for entry in entries if entry["parameters"]]:
            tables.setdefault((f" at {settings}" if settings else "", _table(known)), []).append(title)
        for entry in known:
            formulas.setdefault(entry["formula"], []).append(entry)
        for reason in (entry["reason"] for entry in entries if not entry["parameters"]):
            unknown.setdefault(reason, []).append(title)
    blocks = [
        [f"{content['experiment']}: standard errors to expect by theory. The half width is 1.96 of them, for 95 %."],
        *([f"{listed(titles)}: standard errors{where}", table] for (where, table), titles in tables.items()),
        *([f"{listed(titles)}: no theory: {reason}."] for reason, titles in unknown.items()),
        *([_formula(formula, entries)] for formula, entries in formulas.items()),
    ]
    if content["left_out"]:
        more = count(content["left_out"], "further combination")
        blocks.append([f"Not shown: {more} of swept settings and numbers of samples; --set gives a key one value."])
    found = content["surprises"]
    if found is not None:
        agree = f"The stored estimates are as expected, as far as {FEWEST} data sets or more tell."
        blocks.append(["Unexpected in the stored estimates:", *(f"- {text}" for text in found)] if found else [agree])
    return Report([*blocks, [REMARK]]).draw()


def _table(entries: list[dict[str, Any]]) -> str:
    """Parameters down, numbers of samples across; the last columns are about the greatest number."""
    last = entries[-1]
    rows = []
    for k, row in enumerate(last["parameters"]):
        errors = (entry["parameters"][k]["standard_error"] for entry in entries)
        numbers = (number(value, 3) for value in (*errors, row["relative_percent"], row["half_width_95"]))
        rows.append([row["name"], number(row["value"]), *numbers])
    sizes = [f"N = {entry['samples']}" for entry in entries]
    header = ["parameter", "true value", *sizes, "relative [%]", "half width"]
    table = Table(header, rows, "l" + "r" * (len(header) - 1)).draw()
    return table if len(entries) == 1 else f"{table}\nrelative, half width: of {last['samples']} samples."


def _formula(formula: str, entries: list[dict[str, Any]]) -> str:
    """A formula with the numbers of samples and the estimators that it is for."""
    sizes = ", ".join(map(str, sorted({entry["samples"] for entry in entries})))
    scaling = " Standard errors fall with the square root of N." if entries[0]["scales"] else ""
    return f"{listed(entry['estimator'] for entry in entries)}, N = {sizes}: {formula}.{scaling}"


def _title(entry: dict[str, Any]) -> str:
    """Name of an estimator with its swept options and its kind."""
    name, kind = entry["estimator"], entry["kind"]
    if entry["options"]:
        name = f"{name} with {_settings(entry['options'])}"
    return str(name) if name == kind else f"{name} ({kind})"


def _settings(settings: dict[str, Any]) -> str:
    return ", ".join(f"{setting_title(key)} {setting_text(key, value)}" for key, value in settings.items())
