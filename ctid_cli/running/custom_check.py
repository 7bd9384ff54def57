"""A first look at custom components before a run: data sets and estimates, twice, in a process of its own."""

import random
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from ctid_cli.canonical import canonical_json, plain
from ctid_cli.custom_code import reason
from ctid_cli.errors import SpecError
from ctid_cli.running.job import EstimatorCell, Job
from ctid_cli.running.limits import Limits
from ctid_cli.running.plan import Plan, Task
from ctid_cli.running.workers import call_alone
from ctid_cli.simulation.components import ComponentError, is_custom
from ctid_cli.simulation.dataset import SimulatedSource, StartPoint
from ctid_cli.specification.joint_checks import MAX_TRIALS, trial
from ctid_cli.specification.messages import Complaint
from ctid_cli.storage.columns import FAILURES
from ctid_cli.storage.manifest import found_values, true_values
from ctid_cli.temporary import TemporaryFolder

#: What takes longer is not repeated, and what takes far longer is left to the run [s].
SLOW = 30.0
PATIENCE = 600.0
#: Errors of a program, which no other data set would mend.
MISTAKES = (NameError, AttributeError, TypeError, ImportError)
#: What depends on the state of the global generators is another thing each time that it is computed.
GLOBAL = "depends on the global random state, so that no run could be repeated; draw from"


@dataclass(frozen=True)
class Look:
    """What custom components do wrong on a data set, and what is odd about it."""

    wrong: list[Complaint] = field(default_factory=list)
    odd: list[Complaint] = field(default_factory=list)
    #: Estimates as they would be stored, by estimator.
    returned: dict[str, dict[str, Any]] = field(default_factory=dict)


def check_components(plan: Plan, limits: Limits, warn: Callable[[str], object]) -> bool:
    """Refuse custom components that fail on the first data sets, or come out otherwise the second time.

    A component that ends the process, or takes too long, is left to the run, which stores that for every estimate; what
    other data sets may mend is a warning. Returns whether data are made by a custom component, so that no other process
    but a worker should make them.
    """
    cell = plan.data_cells[0]
    wanted = [entry for entry in plan.keys(Task(0, 0)) if is_custom(getattr(entry[1].estimator, "options", None))]
    makes_data = bool(_parts(cell.source))
    if not wanted and not makes_data:
        return False
    job = Job(cell, 0, plan.monte_carlo.get("seed"), tuple(wanted), plan.terms)
    sources = [plan.data_cells[k].source for k in range(min(len(plan.data_cells), MAX_TRIALS))] if makes_data else []
    with TemporaryFolder() as folder:
        returned, _, _ = call_alone(folder, _look, sources, job, limits, str(folder / "late"))
    found: Look = returned or Look()
    if found.wrong:
        raise SpecError([plan.spec.problem(path, message) for path, message in found.wrong])
    success = plan.spec.canonical().get("success") or {}
    for path, message in (*found.odd, *_uncounted(found.returned, true_values({"content": cell.content}), success)):
        warn(str(plan.spec.problem(path, message)))
    return makes_data


def _uncounted(
    returned: Mapping[str, Mapping[str, Any]], truth: Mapping[str, float], success: Mapping[str, Any]
) -> Iterator[Complaint]:
    """Say which estimators return nothing that a true value, or the rule of success, can be compared with."""
    others = [name for name in truth if name != "delay"]
    asked = {"delay_relative_error": ["delay"] if "delay" in truth else [], "parameter_relative_error": others}
    for name, row in returned.items():
        found = found_values(row, truth)[0]
        path = ("estimators", name, "kind")
        if truth and all(value is None for value in found.values()):
            names = ", ".join(row["parameters"] or {}) or "a model with another number of poles"
            yield path, f"returns {names}; true values are known of {', '.join(truth)} only"
        for rule, wanted in asked.items():
            lacking = [each for each in wanted if found[each] is None]
            if lacking and success.get(rule) is not None:
                yield path, f"returns no {', '.join(lacking)}, so that it never meets success.{rule}"


# --------------------------------------------------------------------------------------------------------------------
# In the other process


def _look(sources: list[SimulatedSource], job: Job, limits: Limits, late: str) -> Look:
    """Return what is seen of custom components on first data sets, within the limits of an estimate."""
    found = Look()
    if limits.wall_seconds is None:
        limits = replace(limits, wall_seconds=PATIENCE)
    with open(late, "wb") as watched, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        limits.begin(watched)
        end = time.monotonic() + SLOW
        for source in sources:
            found.wrong.extend(_of_data(source))
            if found.wrong or time.monotonic() > end:
                break
        if not found.wrong:
            _of_estimators(job, found)
        limits.end()
    return found


def _parts(source: Any) -> dict[str, Any]:
    """Return the custom components that make a data set, by their places, in the order of their work."""
    parts = source.parts if isinstance(source, SimulatedSource) else {}
    return {place: part for place, part in parts.items() if part is not None and is_custom(part)}


def _twice(compute: Callable[[], Any]) -> tuple[Any, Any]:
    """Return what is computed with the global generators in two states; only once what takes long."""
    results = []
    for seed in (0, 1):
        begun = time.monotonic()
        random.seed(seed)
        np.random.seed(seed)  # noqa: NPY002 - the one that must not matter
        results.append(compute())
        if time.monotonic() - begun > SLOW:
            break
    return results[0], results[-1]


def _of_data(source: SimulatedSource) -> Iterator[Complaint]:
    custom = _parts(source)
    wrong = list(trial(source))
    yield from (((*path, "kind") if ".".join(map(str, path)) in custom else path, text) for path, text in wrong)
    made: dict[str, Callable[[Any], Any]] = {
        "sampling": lambda r: r.t,
        "excitation": lambda r: r.input.values,
        "loop.reference": lambda r: None if r.loop is None else r.loop.reference,
        "system": lambda r: r.noise_free,
        "noise": lambda r: r.y,
    }
    with suppress(Exception):  # of which the run says more
        records = _twice(lambda: source.dataset(0).record)
        for place in custom if not wrong else ():
            first, second = (np.asarray(made[place](record), dtype=float) for record in records)
            if not np.array_equal(first, second, equal_nan=True):
                yield (*place.split("."), "kind"), f"{GLOBAL} the rng that it is given"
                return


def _of_estimators(job: Job, found: Look) -> None:
    try:
        data = job.cell.dataset(job.replicate)
    except Exception:
        # The run stores that for every estimate.
        return
    firsts: dict[str, tuple[EstimatorCell, StartPoint]] = {}
    for key, cell, start in job.wanted:
        firsts.setdefault(key.estimator_hash, (cell, start))
    for cell, start in firsts.values():
        path = ("estimators", cell.name, "kind")
        try:
            drawn = start.draw(job.seed, job.replicate, data.true_model)
            first, second = _twice(partial(_estimated, cell.estimator, data, drawn, job.terms))
            if canonical_json(first) != canonical_json(second):
                raise ComponentError(f"{GLOBAL} numpy.random.default_rng(seed), with seed among its options")
        except ComponentError as error:
            found.wrong.append((path, str(error)))
        except MISTAKES as error:
            found.wrong.append((path, f"fails on the first data set: {reason(error)}"))
        except BaseException as error:
            # Of another kind of failure others may be free.
            text = f"fails on the first data set: {reason(error)}; such estimates are stored as FAILED"
            found.odd.append((path, text))
        else:
            if first["status"] not in FAILURES:
                found.returned[cell.name] = first


def _estimated(estimator: Any, data: Any, start: Any, terms: Any) -> dict[str, Any]:
    """Return an estimate as it would be stored."""
    found: dict[str, Any] = plain(data.result_of(estimator.prepare(data.record).fit(start), start, terms))
    return found
