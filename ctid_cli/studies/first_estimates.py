"""The estimates of the first data sets of a study, kept beside it: a reproduction small enough for every change.

They are computed from the published specifications with fewer and shorter records, stored and read back as
``ctid run`` would, and must agree with those that were committed.
"""

import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from ctid_cli.reporting.results import read_results
from ctid_cli.running.cells import Plan
from ctid_cli.running.engine import run_experiment
from ctid_cli.studies.catalogue import StudyFolder
from ctid_cli.written_files import write_file

#: Largest relative difference of a number.
TOLERANCE = 1e-6
#: Differences of measured frequencies and their errors that are rounding [rad/s].
ROUNDING = 1e-9
#: What is compared of an estimate.
QUANTITIES = (
    *("start_delay", "delay", "numerator", "denominator", "parameters", "standard_errors", "cost", "fit_percent"),
    "measures",
)
#: Statuses of estimates that are compared number by number: those of frequencies follow from filters, valid or not.
COMPARED = ("CONVERGED", "VALID", "INVALID")

Estimates = dict[str, dict[str, Any]]


#: Where the committed estimates lie in the folder of a study.
FILE = "first_estimates.json"


def compute_first(study: StudyFolder, out: Path, jobs: int | None = None) -> Estimates:
    """Run the first data sets of a study, and read them back by experiment, settings, estimator and start."""
    found: Estimates = {}
    for short, overrides in study.first.items():
        plan = study.plan(short, ["monte_carlo.runs=1", *overrides])
        run_experiment(plan, out / plan.experiment, jobs=jobs)
        steps = _single_steps(plan)
        for row in read_results(out, plan.experiment).rows:
            swept = [f"{name}={row[name]}" for name in plan.data_cells[0].swept]
            words = [short, *swept, row["estimator"], str(row.get("initial_delay")), str(row["replicate"])]
            compared = row["status"] in COMPARED or row["estimator"] in steps
            values = dict(_numbers({name: row.get(name) for name in QUANTITIES})) if compared else {}
            found[" ".join(words)] = {"status": row["status"], "values": values}
    return found


def _single_steps(plan: Plan) -> set[str]:
    """Estimators that take one step from where they start, which is compared whether it converged or not."""
    return {cell.name for cell in plan.estimators if cell.content.get("max_iterations") == 1}


def _numbers(content: Any, name: str = "") -> Iterator[tuple[str, float]]:
    if isinstance(content, Mapping | list):
        items = content.items() if isinstance(content, Mapping) else enumerate(content)
        for key, value in items:
            yield from _numbers(value, f"{name}.{key}" if name else str(key))
    elif content is not None:
        yield name, float(content)


def read_first(study: StudyFolder) -> Estimates:
    """The committed estimates of a study."""
    return dict(json.loads((study.folder / FILE).read_text(encoding="utf-8")))


def write_first(study: StudyFolder, found: Estimates) -> None:
    """Commit to these estimates: one line for each, so that a change can be read."""
    lines = [f"{json.dumps(name)}: {json.dumps(found[name])}" for name in found]
    write_file(study.folder / FILE, ("{\n" + ",\n".join(lines) + "\n}\n").encode())


def differences(found: Estimates, committed: Estimates) -> list[str]:
    """What is not as it was committed, in words."""
    wrong = [f"{name}: missing" for name in committed if name not in found]
    wrong += [f"{name}: not among those that were committed" for name in found if name not in committed]
    for name in committed.keys() & found.keys():
        ours, theirs = found[name], committed[name]
        if ours["status"] != theirs["status"]:
            wrong.append(f"{name}: status {ours['status']} (not {theirs['status']})")
            continue
        for key in sorted(ours["values"].keys() | theirs["values"].keys()):
            a, b = ours["values"].get(key), theirs["values"].get(key)
            slack = ROUNDING if key.startswith("measures.") else 0.0
            if a is None or b is None or not math.isclose(a, b, rel_tol=TOLERANCE, abs_tol=slack):
                wrong.append(f"{name}: {key} {a!r} (not {b!r})")
                break
    return sorted(wrong)
