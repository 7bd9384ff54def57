"""Trial of a specification: find errors that only its first data sets show, before anything is stored.

The first data set of each setting is simulated, and every estimator prepared on it; those that are biased in theory get
a warning. Custom components are tried in a separate process, under limits and twice, with the global random generators
in two states: results that differ the second time are not reproducible. Custom estimators are also fitted to the first
data set. A component that ends its process, or takes too long, is left to the run, which stores the failure for every
estimate.
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
from ctid_cli.specification.messages import Violation
from ctid_cli.specification.spec import Spec
from ctid_cli.specification.sweeps import Failure, Variant, grouped, swept_in, variants
from ctid_cli.specification.system_sections import start_points
from ctid_cli.specification.yaml_source import KeyPath
from ctid_cli.storage.columns import FAILURES
from ctid_cli.storage.manifest import true_values
from ctid_cli.storage.truth import found_of_rows

#: Total number of samples of the simulated data sets, and time after which no further one is begun [s].
MAX_TRIAL_SAMPLES = 20_000_000
MAX_SECONDS = 30.0
#: Wall time limit of the process of custom components if there is no other limit [s].
PATIENCE = 600.0
#: Name for the data sets among the tried parts; estimator names are never empty.
_DATA = ""
#: Programming errors, which are independent of the data set.
MISTAKES = (NameError, AttributeError, TypeError, ImportError)
#: Results that depend on the state of the global generators differ in every computation.
GLOBAL = "depends on the global random state, so that no run could be repeated; draw from"


def load_tried(
    given: Path | Mapping[str, Any],
    overrides: Sequence[str] = (),
    *,
    allow_code: bool = False,
    allow_outside: bool = False,
) -> Spec:
    """Read, check and try a specification before a run."""
    return load_spec(given, overrides, allow_code=allow_code, allow_outside=allow_outside, trial=try_out)


class Setting(NamedTuple):
    """One combination of data options, and its swept values."""

    cell: DataCell
    swept: Mapping[KeyPath, Any]


class Candidate(NamedTuple):
    """An estimator with one combination of swept options, and one of its starts."""

    name: str
    estimator: Any
    swept: Mapping[KeyPath, Any]
    start: StartPoint

    @property
    def is_custom(self) -> bool:
        """Whether its class is custom."""
        return is_custom(getattr(self.estimator, "options", None))


@dataclass(frozen=True)
class Found:
    """Result of a trial."""

    #: Errors to correct, and problems that may not occur with other data.
    errors: list[Violation] = field(default_factory=list)
    warnings: list[Violation] = field(default_factory=list)


def try_out(spec: Spec) -> Found:
    """Try the settings and estimators of a specification without the sections that have errors."""
    settings, candidates = _settings(spec), list(_candidates(spec))
    success = {} if spec.success is None else spec.success.model_dump()
    custom_data = any(_custom_parts(setting.cell.source) for setting in settings)
    if not (custom_data or spec.custom_measures or any(candidate.is_custom for candidate in candidates)):
        return _try_all(settings, candidates, success)
    limits = Limits() if spec.limits is None else Limits(**spec.limits.model_dump())
    found = None
    # Components that end their process, or cannot be sent to one, are left to the run.
    with TemporaryDirectory(prefix="ctid-", ignore_cleanup_errors=True) as made, suppress(Exception):
        folder = Path(made)
        found = call_alone(folder, _try_under_limits, limits, folder / "late", settings, candidates, success)[0]
    return found or Found()


def _settings(spec: Spec) -> list[Setting]:
    """Return the distinct settings, each with the first noise level, because other levels make no difference here."""
    parts = data_parts(spec)
    if spec.signal is None and spec.data is None and spec.inputs is None:
        if spec.loop is None and spec.excitation is None:
            return []
        # The other sections are tried even if the system is wrong.
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
# In this process, or in the process of custom components


def _try_under_limits(limits: Limits, late: Path, *given: Any) -> Found:
    """Try custom components under the limits of an estimate."""
    if limits.wall_seconds is None:
        limits = replace(limits, wall_seconds=PATIENCE)
    with late.open("wb") as watched:
        limits.begin(watched)
        found = _try_all(*given)
        limits.end()
    return found


def _try_all(settings: Sequence[Setting], candidates: Sequence[Candidate], success: Mapping[str, Any]) -> Found:
    """Simulate the first data set of each setting, and prepare every estimator on it."""
    from ctid_cli.estimators.svf import Svf
    from ctid_cli.simulation.expected_accuracy import why_biased

    found, end = Found(), time.monotonic() + MAX_SECONDS
    #: Problems of the data, and of each estimator by name, with the swept values that were tried; biased estimators.
    failures: dict[str, list[Failure]] = defaultdict(list)
    biased: dict[str, list[Failure]] = defaultdict(list)
    tried: dict[str, list[Mapping[KeyPath, Any]]] = defaultdict(list)
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        for setting in settings:
            if tried and time.monotonic() > end:
                break
            first = not tried
            data, violations = _first_data(setting.cell.source)
            tried[_DATA].append(setting.swept)
            failures[_DATA] += [(path, text, setting.swept) for path, text in violations]
            for candidate in candidates if data is not None else ():
                name, swept, unusable = candidate.name, {**setting.swept, **candidate.swept}, ""
                if not candidate.is_custom:
                    unusable = _unusable(candidate.estimator, data)
                    tried[name].append(swept)
                    failures[name] += [(("estimators", name), unusable, swept)] if unusable else []
                    # The documentation of svf says that it is a start for others.
                    start = isinstance(candidate.estimator, Svf)
                    why = "" if start else why_biased(setting.cell.source, candidate.estimator)
                    biased[name] += [(("estimators", name), f"is biased: {why}", swept)] if why else []
                if first and not unusable and (candidate.is_custom or setting.cell.measures):
                    _fit(candidate, data, setting, [one.estimator for one in candidates], success, found)
    for subject in tried:
        found.errors.extend(grouped(failures[subject], tried[subject]))
        found.warnings.extend(grouped(biased[subject], tried[subject]))
    return found


def _custom_parts(source: Any) -> dict[str, Any]:
    """Return the custom components of a data set by their places, in the order of use."""
    parts = source.parts if isinstance(source, SimulatedSource) else {}
    return {place: part for place, part in parts.items() if is_custom(part)}


def _first_data(source: Any) -> tuple[Any, list[Violation]]:
    """Return the first data set of a source; or None, and the problems if its sections cause the error."""
    custom = _custom_parts(source)
    try:
        if isinstance(source, SimulatedSource):
            source.require_stable()
        first, second = _twice(partial(source.dataset, 0)) if custom else (source.dataset(0),) * 2
    except DataError as error:
        at = tuple(error.section.split(".")) if error.section else ()
        return None, [((*at, "kind") if error.section in custom else at, str(error))]
    except Exception:  # a run reports it with every estimate
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
    """Compute something with the global generators in two states, or once if it takes long."""
    results = []
    for seed in (0, 1):
        begun = time.monotonic()
        random.seed(seed)
        np.random.seed(seed)  # noqa: NPY002 - results must not depend on it
        results.append(compute())
        if time.monotonic() - begun > MAX_SECONDS:
            break
    return results[0], results[-1]


def _unusable(estimator: Any, data: Any) -> str:
    """Return why an estimator cannot use a record; empty if it can."""
    try:
        estimator.prepare(data.record)
    except (DataError, OptionError) as error:
        return str(error)
    except Exception:  # a run reports it with every estimate
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
    """Fit an estimator to the first data set, with custom measures, as in a run."""
    path: KeyPath = ("estimators", candidate.name, "kind")
    cell, terms = setting.cell, structure(setting.cell.source, estimators)

    def fit() -> tuple[dict[str, Any], dict[str, Any], dict[str, str]]:
        start = candidate.start.draw(getattr(cell.source, "seed", 0), 0, data.true_model)
        fitted = candidate.estimator.prepare(data.record).fit(start)
        return plain(data.result_of(fitted, start, terms)), *measured(cell.measures, fitted, data, Limits())

    try:
        (first, values, reasons), (second, others, _) = _twice(fit)
        text = f"{GLOBAL} numpy.random.default_rng(seed), with seed among its options"
        found.errors.extend((("measures", name), text) for name in values if values[name] != others[name])
        if canonical_json(first) != canonical_json(second):
            raise ComponentError(text)
    except ComponentError as error:
        found.errors.append((path, str(error)))
    except MISTAKES as error:
        found.errors.append((path, f"fails on the first data set: {reason(error)}"))
    except BaseException as error:
        # Other data sets may not have such a failure.
        text = f"fails on the first data set: {reason(error)}; such estimates are stored as FAILED"
        found.warnings.append((path, text))
    else:
        for name, why in reasons.items():
            text = f"fails on the first data set, with the estimator {candidate.name!r}: {why}"
            found.warnings.append((("measures", name), f"{text}; such estimates are stored without it"))
        if first["status"] not in FAILURES and candidate.is_custom:
            found.warnings.extend(
                (path, text) for text in _uncounted(first, true_values({"content": cell.content}), success)
            )


def _uncounted(row: Mapping[str, Any], truth: Mapping[str, float], success: Mapping[str, Any]) -> Iterator[str]:
    """Yield the reasons why an estimate cannot be compared with true values or the success rule."""
    lacks = dict(zip(truth, np.isnan(found_of_rows([row], truth).values[0]).tolist(), strict=True))
    if truth and all(lacks.values()):
        names = ", ".join(row["parameters"] or {}) or "a model with another number of poles"
        yield f"returns {names}; true values are known of {', '.join(truth)} only"
    delays = [name for name in truth if is_delay(name)]
    rules = {"delay_relative_error": delays, "parameter_relative_error": [n for n in truth if n not in delays]}
    for rule, wanted in rules.items():
        lacking = [each for each in wanted if lacks[each]]
        if lacking and success.get(rule) is not None:
            yield f"returns no {', '.join(lacking)}, so that it never meets success.{rule}"
