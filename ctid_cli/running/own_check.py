"""A first look at custom components, before anything is stored: one data set, twice, in a process of its own."""

import random
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ctid_cli.canonical import canonical_json, plain
from ctid_cli.errors import SpecError
from ctid_cli.own_code import reason
from ctid_cli.running.job import Job
from ctid_cli.running.limits import Limits
from ctid_cli.running.plan import Plan, Task
from ctid_cli.running.workers import call_alone
from ctid_cli.simulation.dataset import SimulatedSource
from ctid_cli.simulation.own_components import (
    ContractError,
    OwnEstimation,
    OwnExcitation,
    OwnNoise,
    OwnSampling,
    OwnSystem,
)
from ctid_cli.storage.columns import FAILURES
from ctid_cli.storage.manifest import found_values, true_values
from ctid_cli.temporary import TemporaryFolder

STAND_INS = (OwnSampling, OwnExcitation, OwnSystem, OwnNoise)
#: Key path, and what is wrong there.
Complaint = tuple[tuple[str, ...], str]
#: An estimate that takes longer is not repeated [s].
SLOW = 30.0
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
    """Refuse custom components that fail on the first data set, or come out otherwise the second time.

    A component that ends the process, or takes too long, is left to the run, which stores that for every estimate; what
    other data sets may mend is a warning. Returns whether custom components make the data.
    """
    cell = plan.data_cells[0]
    wanted = [entry for entry in plan.keys(Task(0, 0)) if isinstance(entry[1].estimator, OwnEstimation)]
    makes_data = bool(_parts(cell.source))
    if not wanted and not makes_data:
        return False
    job = Job(cell, 0, plan.monte_carlo.get("seed"), tuple(wanted), plan.terms)
    with TemporaryFolder() as folder:
        returned, _, _ = call_alone(folder, look, job, limits, str(folder / "late"))
    found: Look = returned or Look()
    if found.wrong:
        raise SpecError([plan.spec.problem(path, message) for path, message in found.wrong])
    success = plan.spec.canonical().get("success") or {}
    for path, message in (*found.odd, *_uncounted(found.returned, true_values({"content": cell.content}), success)):
        warn(str(plan.spec.problem(path, message)))
    return makes_data


def look(job: Job, limits: Limits, late: str) -> Look:
    """Return what is seen of custom components on a data set, within the limits of an estimate."""
    found = Look()
    with open(late, "wb") as watched:
        limits.begin(watched)
        found.wrong.extend(_of_data(job))
        if not found.wrong:
            _of_estimators(job, found)
        limits.end()
    return found


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


def _parts(source: Any) -> dict[str, Any]:
    """Return the custom components that make a data set, by their place in the specification, in the order of work."""
    if not isinstance(source, SimulatedSource):
        return {}
    reference = None if source.loop is None else source.loop.reference
    parts: dict[str, Any] = {"sampling": source.sampling, "excitation": source.excitation, "loop.reference": reference}
    parts |= {"system": source.system, "noise": source.noise}
    return {name: part.options for name, part in parts.items() if isinstance(part, STAND_INS)}


def _set_global(seed: int) -> None:
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002 - the one that must not matter


def _of_data(job: Job) -> Iterator[Complaint]:
    own = _parts(job.cell.source)
    records: list[Any] = []
    try:
        for seed in (0, 1) if own else ():
            _set_global(seed)
            records.append(job.cell.dataset(job.replicate).record)
    except ContractError as error:
        yield from (((*at.split("."), "kind"), str(error)) for at in own if own[at] is error.component)
    except Exception:
        # Not theirs alone: the run stores that for every estimate.
        return
    if len(records) == 2:
        made: dict[str, Callable[[Any], Any]] = {
            "sampling": lambda r: r.t,
            "excitation": lambda r: r.input.values,
            "loop.reference": lambda r: None if r.loop is None else r.loop.reference,
            "system": lambda r: r.noise_free,
            "noise": lambda r: r.y,
        }
        for name in own:
            first, second = (np.asarray(made[name](record), dtype=float) for record in records)
            if not np.array_equal(first, second, equal_nan=True):
                yield (*name.split("."), "kind"), f"{GLOBAL} the rng that it is given"
                return


def _of_estimators(job: Job, found: Look) -> None:
    try:
        data = job.cell.dataset(job.replicate)
    except Exception:
        # The run stores that for every estimate.
        return
    seen: set[str] = set()
    for key, cell, start in job.wanted:
        if key.estimator_hash not in seen:
            seen.add(key.estimator_hash)
            drawn = start.draw(job.seed, job.replicate, data.true_model)
            path = ("estimators", cell.name, "kind")
            try:
                returned = _of_estimator(cell.estimator, data, drawn, job.terms)
            except ContractError as error:
                found.wrong.append((path, str(error)))
            except MISTAKES as error:
                found.wrong.append((path, f"fails on the first data set: {reason(error)}"))
            except BaseException as error:
                # Of another kind of failure others may be free.
                text = f"fails on the first data set: {reason(error)}; such estimates are stored as FAILED"
                found.odd.append((path, text))
            else:
                if returned["status"] not in FAILURES:
                    found.returned[cell.name] = returned


def _of_estimator(estimator: Any, data: Any, start: Any, terms: Sequence[Any] | None) -> dict[str, Any]:
    """Return what comes out of an estimator, twice the same."""
    results: list[dict[str, Any]] = []
    for seed in (0, 1):
        begun = time.perf_counter()
        _set_global(seed)
        fit = estimator.prepare(data.record).fit(start)
        results.append(plain(data.result_of(fit, start, terms)))
        if time.perf_counter() - begun > SLOW:
            break
    if canonical_json(results[0]) != canonical_json(results[-1]):
        raise ContractError(f"{GLOBAL} numpy.random.default_rng(seed), with seed among its options")
    return results[0]
