"""The trial of a specification: what only its first data sets show is found before anything is stored.

The first data set of each setting is made, and every estimator is prepared on it. Custom components are tried in a
process of their own, under limits and twice, with the global random generators in two states: what comes out otherwise
the second time could not be repeated. Custom estimators are fitted to the first data set as well. A component that ends
its process, or takes too long, is left to the run, which stores that for every estimate.
"""

from __future__ import annotations

import itertools
import random
import time
import warnings
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from ctid_cli.canonical import canonical_json, plain
from ctid_cli.custom_code import reason
from ctid_cli.errors import DataError, OptionError
from ctid_cli.models.several_inputs import is_delay
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.running.job import DataCell, measured
from ctid_cli.running.limits import Limits
from ctid_cli.running.plan import data_cells, data_parts, estimation, starts_of, structure
from ctid_cli.running.workers import call_alone
from ctid_cli.simulation.components import ComponentError, is_custom
from ctid_cli.simulation.dataset import MeasuredSource, SimulatedSource
from ctid_cli.simulation.start_points import StartPoint
from ctid_cli.specification.joint_checks import MAX_TRIALS
from ctid_cli.specification.load import load_spec
from ctid_cli.specification.messages import Complaint
from ctid_cli.specification.spec import Spec
from ctid_cli.specification.sweeps import Failure, Variant, grouped, swept_in, variants
from ctid_cli.specification.system_sections import start_points
from ctid_cli.specification.yaml_source import KeyPath
from ctid_cli.storage.columns import FAILURES
from ctid_cli.storage.manifest import true_values
from ctid_cli.storage.truth import found_of_rows

#: Samples of the data sets that are made, and time after which no other is begun [s].
MAX_TRIAL_SAMPLES = 20_000_000
MAX_SECONDS = 30.0
#: Wall time that the process of custom components may take where there is no limit [s].
PATIENCE = 600.0
#: The data sets among what is tried; no estimator has an empty name.
_DATA = ""
#: Errors of a program, which no other data set would mend.
MISTAKES = (NameError, AttributeError, TypeError, ImportError)
#: What depends on the state of the global generators is another thing each time that it is computed.
GLOBAL = "depends on the global random state, so that no run could be repeated; draw from"


def load_tried(
    given: Path | Mapping[str, Any],
    overrides: Sequence[str] = (),
    *,
    allow_code: bool = False,
    allow_outside: bool = False,
) -> Spec:
    """Read, check and try a specification, for a run."""
    return load_spec(given, overrides, allow_code=allow_code, allow_outside=allow_outside, trial=try_out)


class Setting(NamedTuple):
    """One combination of what data sets are made from, and the swept values that tell it from others."""

    cell: DataCell
    swept: Mapping[KeyPath, Any]


class Candidate(NamedTuple):
    """An estimator with one combination of its swept options, and a start that it takes."""

    name: str
    estimator: Any
    swept: Mapping[KeyPath, Any]
    start: StartPoint

    @property
    def is_custom(self) -> bool:
        """Whether its class is not one of ctid's."""
        return is_custom(getattr(self.estimator, "options", None))


@dataclass(frozen=True)
class Found:
    """What a trial has found."""

    #: What must be mended, and what may be right with other data.
    wrong: list[Complaint] = field(default_factory=list)
    odd: list[Complaint] = field(default_factory=list)


def try_out(spec: Spec) -> Found:
    """Try the settings and estimators of a specification; sections that have mistakes are not in it."""
    settings, candidates = _settings(spec), list(_candidates(spec))
    success = {} if spec.success is None else spec.success.model_dump()
    custom_data = any(_custom_parts(setting.cell.source) for setting in settings)
    if not (custom_data or spec.custom_measures or any(candidate.is_custom for candidate in candidates)):
        return _try_all(settings, candidates, success)
    limits = Limits() if spec.limits is None else Limits(**spec.limits.model_dump())
    found = None
    # What ends its process, or cannot be sent to one, is left to the run.
    with TemporaryDirectory(prefix="ctid-", ignore_cleanup_errors=True) as made, suppress(Exception):
        folder = Path(made)
        found = call_alone(folder, _try_under_limits, limits, folder / "late", settings, candidates, success)[0]
    return found or Found()


def _settings(spec: Spec) -> list[Setting]:
    """Return the distinct settings, each with the first level of the noise: the others decide on nothing else."""
    parts = data_parts(spec)
    if spec.signal is None and spec.data is None and spec.inputs is None:
        if spec.loop is None and spec.excitation is None:
            return []
        # The other sections are tried although the system is wrong.
        parts.setdefault(("system",), [Variant({}, {}, TransferFunction([1.0], [1.0, 1.0]))])
    if spec.data is None and spec.sampling is None:
        return []
    parts = {path: found[:1] if path == ("noise",) else found for path, found in parts.items()}
    settings: list[Setting] = []
    samples = 0
    points = itertools.product(*parts.values())
    for cell, point in itertools.islice(zip(data_cells(spec, parts), points, strict=True), MAX_TRIALS):
        if not isinstance(cell.source, MeasuredSource) and not is_custom(cell.source.sampling):
            samples += cell.source.sampling.length
        if samples > MAX_TRIAL_SAMPLES and settings:
            break
        case = {path: variant for path, variant in zip(parts, point, strict=True) if path != ("noise",)}
        settings.append(Setting(cell, swept_in(case)))
    return settings


def _candidates(spec: Spec) -> Iterator[Candidate]:
    points = start_points(spec.starts)
    for name, section in spec.estimators.items():
        for variant in variants(section):
            estimator = estimation(variant)
            swept = swept_in({("estimators", name): variant})
            yield Candidate(name, estimator, swept, starts_of(estimator.start_from, points)[0])


# --------------------------------------------------------------------------------------------------------------------
# In this process, or in that of custom components


def _try_under_limits(limits: Limits, late: Path, *given: Any) -> Found:
    """Try custom components within the limits of an estimate."""
    if limits.wall_seconds is None:
        limits = replace(limits, wall_seconds=PATIENCE)
    with late.open("wb") as watched:
        limits.begin(watched)
        found = _try_all(*given)
        limits.end()
    return found


def _try_all(settings: Sequence[Setting], candidates: Sequence[Candidate], success: Mapping[str, Any]) -> Found:
    """Make the first data set of each setting, and prepare every estimator on it."""
    found, end = Found(), time.monotonic() + MAX_SECONDS
    #: What is wrong with the data, and with each estimator by its name, and the swept values that were tried.
    failures: dict[str, list[Failure]] = defaultdict(list)
    tried: dict[str, list[Mapping[KeyPath, Any]]] = defaultdict(list)
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        for setting in settings:
            if tried and time.monotonic() > end:
                break
            first = not tried
            data, complaints = _first_data(setting.cell.source)
            tried[_DATA].append(setting.swept)
            failures[_DATA] += [(path, text, setting.swept) for path, text in complaints]
            for candidate in candidates if data is not None else ():
                name, swept, unusable = candidate.name, {**setting.swept, **candidate.swept}, ""
                if not candidate.is_custom:
                    unusable = _unusable(candidate.estimator, data)
                    tried[name].append(swept)
                    failures[name] += [(("estimators", name), unusable, swept)] if unusable else []
                if first and not unusable and (candidate.is_custom or setting.cell.measures):
                    _fit(candidate, data, setting, [one.estimator for one in candidates], success, found)
    for subject, some in failures.items():
        found.wrong.extend(grouped(some, tried[subject]))
    return found


def _custom_parts(source: Any) -> dict[str, Any]:
    """Return the custom components that make a data set, by their places, in the order of their work."""
    parts = source.parts if isinstance(source, SimulatedSource) else {}
    return {place: part for place, part in parts.items() if is_custom(part)}


def _first_data(source: Any) -> tuple[Any, list[Complaint]]:
    """Return the first data set of a source; or None, and why it cannot be made if its sections are to blame."""
    custom = _custom_parts(source)
    try:
        if isinstance(source, SimulatedSource):
            source.require_stable()
        first, second = _twice(partial(source.dataset, 0)) if custom else (source.dataset(0),) * 2
    except DataError as error:
        at = tuple(error.section.split(".")) if error.section else ()
        return None, [((*at, "kind") if error.section in custom else at, str(error))]
    except Exception:  # of which a run says more: it is stored with every estimate
        return None, []

    def excited(r: Any) -> Any:
        return np.concatenate([signal.values for signal in r.held.values()])

    made: dict[str, Callable[[Any], Any]] = {
        "sampling": lambda r: r.t,
        "loop.reference": lambda r: None if r.loop is None else r.loop.reference,
        "system": lambda r: r.noise_free,
        "noise": lambda r: r.y,
    }
    for place in custom:
        of = made.get(place, excited)
        one, other = (np.asarray(of(data.record), dtype=np.float64) for data in (first, second))
        if not np.array_equal(one, other, equal_nan=True):
            return None, [((*place.split("."), "kind"), f"{GLOBAL} the rng that it is given")]
    return first, []


def _twice(compute: Callable[[], Any]) -> tuple[Any, Any]:
    """Return what is computed with the global generators in two states; only once what takes long."""
    results = []
    for seed in (0, 1):
        begun = time.monotonic()
        random.seed(seed)
        np.random.seed(seed)  # noqa: NPY002 - the one that must not matter
        results.append(compute())
        if time.monotonic() - begun > MAX_SECONDS:
            break
    return results[0], results[-1]


def _unusable(estimator: Any, data: Any) -> str:
    """Say why an estimator cannot use a record at all; empty where it can."""
    try:
        estimator.prepare(data.record)
    except (DataError, OptionError) as error:
        return str(error)
    except Exception:  # of which a run says more: it is stored with every estimate
        return ""
    return ""


def _fit(
    candidate: Candidate,
    data: Any,
    setting: Setting,
    estimators: Sequence[Any],
    success: Mapping[str, Any],
    found: Found,
) -> None:
    """Fit an estimator to the first data set, with custom measures, as a run does."""
    path: KeyPath = ("estimators", candidate.name, "kind")
    cell, terms = setting.cell, structure(setting.cell.source, estimators)

    def fit() -> tuple[dict[str, Any], dict[str, Any], dict[str, str]]:
        start = candidate.start.draw(getattr(cell.source, "seed", 0), 0, data.true_model)
        fitted = candidate.estimator.prepare(data.record).fit(start)
        return plain(data.result_of(fitted, start, terms)), *measured(cell.measures, fitted, data, Limits())

    try:
        (first, values, reasons), (second, others, _) = _twice(fit)
        text = f"{GLOBAL} numpy.random.default_rng(seed), with seed among its options"
        found.wrong.extend((("measures", name), text) for name in values if values[name] != others[name])
        if canonical_json(first) != canonical_json(second):
            raise ComponentError(text)
    except ComponentError as error:
        found.wrong.append((path, str(error)))
    except MISTAKES as error:
        found.wrong.append((path, f"fails on the first data set: {reason(error)}"))
    except BaseException as error:
        # Of another kind of failure others may be free.
        text = f"fails on the first data set: {reason(error)}; such estimates are stored as FAILED"
        found.odd.append((path, text))
    else:
        for name, why in reasons.items():
            text = f"fails on the first data set, with the estimator {candidate.name!r}: {why}"
            found.odd.append((("measures", name), f"{text}; such estimates are stored without it"))
        if first["status"] not in FAILURES and candidate.is_custom:
            found.odd.extend(
                (path, text) for text in _uncounted(first, true_values({"content": cell.content}), success)
            )


def _uncounted(row: Mapping[str, Any], truth: Mapping[str, float], success: Mapping[str, Any]) -> Iterator[str]:
    """Say that an estimate has nothing that a true value, or the rule of success, can be compared with."""
    lacks = dict(zip(truth, np.isnan(found_of_rows([row], truth).values[0]).tolist(), strict=True))
    if truth and all(lacks.values()):
        names = ", ".join(row["parameters"] or {}) or "a model with another number of poles"
        yield f"returns {names}; true values are known of {', '.join(truth)} only"
    delays = [name for name in truth if is_delay(name)]
    asked = {"delay_relative_error": delays, "parameter_relative_error": [n for n in truth if n not in delays]}
    for rule, wanted in asked.items():
        lacking = [each for each in wanted if lacks[each]]
        if lacking and success.get(rule) is not None:
            yield f"returns no {', '.join(lacking)}, so that it never meets success.{rule}"
