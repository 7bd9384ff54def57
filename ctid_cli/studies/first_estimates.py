"""Committed estimates of the first data sets of a study: a reproduction small enough for every change.

They are computed from the published specifications with fewer and shorter records, stored and read like those of ``ctid
run``, and must agree with the committed ones: parameters within a fraction of their standard errors, so that the
rounding of different processors does not matter.
"""

import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from ctid_cli.reporting.results import read_results
from ctid_cli.reporting.study import Study
from ctid_cli.running.engine import run_experiment
from ctid_cli.running.plan import Plan
from ctid_cli.written_files import write_file

#: Largest differences by their unit:
#:
#: - of a parameter in standard errors: Newton's method ends if the squared error would decrease by less than 1e-12 of
#:   itself, at most 1e-6 sqrt(N) standard errors from the optimum, 9e-5 for the 8,000 samples of the longest record, in
#:   either direction; other iterations end closer to it;
#: - of a standard error, a cost or a fit, relative: their sampling deviation is below a tenth of them, so they change
#:   by less than a tenth of what the parameters change in standard errors;
#: - of a measure of a track: rounding moves frequencies of exact signals by 4e-12 rad/s;
#: - of the share of valid samples: with exact signals rounding decides when a reading becomes valid, one sample in
#:   3,300 earlier or later.
TOLERANCES = {"standard errors": 2e-4, "of its value": 2e-5, "rad/s or s": 1e-9, "% of the samples": 0.1}
#: Compared fields of an estimate.
QUANTITIES = (
    *("start_delay", "delay", "numerator", "denominator", "parameters", "standard_errors", "cost", "fit_percent"),
    "measures",
)
#: Statuses of estimates whose numbers are compared: frequencies come from filters, whether valid or not.
COMPARED = ("CONVERGED", "VALID", "INVALID")

Estimates = dict[str, dict[str, Any]]


#: Path of the committed estimates in the folder of a study.
FILE = "first_estimates.json"


def compute_first(study: Study, out: Path, jobs: int | None = None) -> Estimates:
    """Run the first data sets of a study, and return them by experiment, settings, estimator and start."""
    found: Estimates = {}
    for short, overrides in study.first.items():
        plan = study.plan(short, ["monte_carlo.runs=1", *overrides])
        run_experiment(plan, out / plan.experiment, jobs=jobs)
        steps = _single_steps(plan)
        for row in read_results(out, plan.experiment).stored:
            swept = [f"{name}={row[name]}" for name in plan.data_cells[0].swept]
            words = [short, *swept, row["estimator"], str(row.get("initial_delay")), str(row["replicate"])]
            compared = row["status"] in COMPARED or row["estimator"] in steps
            # Numerator and denominator of a sum of submodels follow from the parameters.
            kept = [name for name in QUANTITIES if not (row.get("parameters") and name in ("numerator", "denominator"))]
            values = dict(_numbers({name: row.get(name) for name in kept})) if compared else {}
            found[" ".join(words)] = {"status": row["status"], "values": values}
    return found


def _single_steps(plan: Plan) -> set[str]:
    """Return estimators that take a single step from their start, which is compared whether it converged or not."""
    return {cell.name for cell in plan.estimators if cell.content.get("max_iterations") == 1}


def _numbers(content: Any, name: str = "") -> Iterator[tuple[str, float]]:
    if isinstance(content, Mapping | list):
        items = content.items() if isinstance(content, Mapping) else enumerate(content)
        for key, value in items:
            yield from _numbers(value, f"{name}.{key}" if name else str(key))
    elif content is not None:
        yield name, float(content)


def read_first(study: Study) -> Estimates:
    """Return the committed estimates of a study."""
    return dict(json.loads((study.folder / FILE).read_text(encoding="utf-8")))


def write_first(study: Study, found: Estimates) -> None:
    """Write estimates to be committed, one per line, for readable differences."""
    lines = [f"{json.dumps(name)}: {json.dumps(found[name])}" for name in found]
    write_file(study.folder / FILE, ("{\n" + ",\n".join(lines) + "\n}\n").encode())


class Comparison(NamedTuple):
    """Comparison of recomputed estimates with the committed ones, in words."""

    #: Differences from the committed estimates.
    wrong: list[str]
    #: The largest difference of each kind of number.
    largest: list[str]


def compare(found: Estimates, committed: Estimates) -> Comparison:
    """Compare estimates with the committed ones."""
    wrong = [f"{name}: missing" for name in committed if name not in found]
    wrong += [f"{name}: not among those that were committed" for name in found if name not in committed]
    largest: dict[str, tuple[float, str]] = {}
    for name in (name for name in committed if name in found):
        ours, theirs = found[name], committed[name]
        if ours["status"] != theirs["status"]:
            wrong.append(f"{name}: status {ours['status']} (not {theirs['status']})")
            continue
        outside = []
        for key in sorted(ours["values"].keys() | theirs["values"].keys()):
            a, b = ours["values"].get(key), theirs["values"].get(key)
            if a is None or b is None:
                outside.append((math.inf, f"{name}: {key} {a!r} (not {b!r})"))
                continue
            unit, scale = _unit_of(key, theirs["values"])
            size = 0.0 if a == b else abs(a - b) / scale if scale else math.inf
            # A difference of NaN counts as a disagreement.
            if not size <= TOLERANCES[unit]:
                outside.append((size / TOLERANCES[unit], f"{name}: {key} {a!r} (not {b!r}, {size:.2g} {unit} away)"))
            if size > largest.get(unit, (0.0, ""))[0]:
                largest[unit] = size, f"{key} of {name}"
        if outside:
            wrong.append(max(outside)[1])
    listed = [f"{size:.2g} {unit} (allowed: {TOLERANCES[unit]:g}), {where}" for unit, (size, where) in largest.items()]
    return Comparison(sorted(wrong), sorted(listed))


def _unit_of(key: str, values: Mapping[str, float]) -> tuple[str, float]:
    """Return the unit in which a number is compared, and its size."""
    group, _, name = key.partition(".")
    if group == "measures":
        return ("% of the samples" if name == "valid_share" else "rad/s or s"), 1.0
    parameter = {"parameters": name, "denominator": f"a{name}", "numerator": f"b{name}", "delay": "delay"}.get(group)
    error = values.get(f"standard_errors.{parameter}", 0.0)
    return ("standard errors", error) if error > 0 else ("of its value", abs(values[key]))
