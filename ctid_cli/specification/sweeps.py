"""Sweeps over lists of values: combinations of a section, and problems of some of them."""

from __future__ import annotations

import inspect
import itertools
import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from pydantic import BaseModel

from ctid_cli.errors import OptionError
from ctid_cli.specification.messages import Violation
from ctid_cli.specification.values import Swept
from ctid_cli.specification.yaml_source import KeyPath

#: Maximum number of combinations of one section, and of data cells of one experiment.
MAX_COMBINATIONS = 100_000
AnySection = TypeVar("AnySection", bound=BaseModel)
#: A problem, and the swept values for which it occurs.
Failure = tuple[KeyPath, str, Mapping[KeyPath, Any]]
#: Argument of a check, with the swept values from which it was made.
Case = tuple[Any, Mapping[KeyPath, Any]]
#: All arguments of checks, by name and place.
Cases = Mapping[str, Mapping[KeyPath, Sequence[Case]]]
Check = Callable[..., Iterator[Violation]]


@dataclass(frozen=True)
class Variant:
    """One combination of a section's swept values."""

    values: dict[str, Any]
    swept: dict[KeyPath, Any]
    options: Any


def variants(section: Any) -> list[Variant]:
    """Return all combinations of a section's swept values, the last one changing fastest; empty without a section."""
    if section is None:
        return []
    return [Variant(one.model_dump(mode="json"), swept, one.options()) for swept, one in _combinations(section)]


def case_count(section: Any) -> int:
    """Return the number of combinations of a section's swept values without making them."""
    return math.prod(len(values) for _, values in _axes(section)) if isinstance(section, BaseModel) else 1


def _axes(section: BaseModel, prefix: KeyPath = ()) -> Iterator[tuple[KeyPath, list[Any]]]:
    for name, info in type(section).model_fields.items():
        value = getattr(section, name)
        if isinstance(value, BaseModel):
            yield from _axes(value, (*prefix, name))
        elif isinstance(value, list) and any(isinstance(mark, Swept) for mark in info.metadata):
            yield (*prefix, name), value


def _combinations(section: Any) -> Iterator[tuple[dict[KeyPath, Any], Any]]:
    axes = list(_axes(section))
    for point in itertools.product(*(values for _, values in axes)):
        swept = {path: value for (path, _), value in zip(axes, point, strict=True)}
        one = section
        for path, value in swept.items():
            one = replaced(one, path, value)
        yield swept, one


def replaced(section: AnySection, path: KeyPath, value: Any) -> AnySection:
    """Return a section in which the value at a path is replaced."""
    name, rest = str(path[0]), path[1:]
    own = getattr(section, name)
    if rest and isinstance(own, Mapping):
        inner: Any = {**own, rest[0]: replaced(own[rest[0]], rest[1:], value)}
    else:
        inner = replaced(own, rest, value) if rest else value
    return section.model_copy(update={name: inner})


def option_violations(section: Any) -> list[Violation]:
    """Return the problems that the option dataclass, if any, finds in the values of a section."""
    if section.target is None:
        return []
    axes = dict(_axes(section))
    count = math.prod(map(len, axes.values()))
    if count > MAX_COMBINATIONS:
        return [((), f"the lists in this section combine to {count} cases; at most {MAX_COMBINATIONS} are allowed")]
    failures: list[Failure] = []
    tried: list[Mapping[KeyPath, Any]] = []
    for swept, one in _combinations(section):
        tried.append(swept)
        try:
            one.options()
        except OptionError as refused:
            path: KeyPath = (refused.field,) if refused.field else ()
            if path in swept:
                # The place is the invalid item of the list, so that its value need not be repeated.
                failures.append(((*path, axes[path].index(swept[path])), str(refused), {}))
            else:
                failures.append((path, str(refused), swept))
    return grouped(failures, tried)


def grouped(failures: Iterable[Failure], tried: Sequence[Mapping[KeyPath, Any]]) -> list[Violation]:
    """Return problems of combinations, each once, with the swept values on which it depends."""
    groups: dict[Violation, list[Mapping[KeyPath, Any]]] = {}
    for path, message, swept in failures:
        groups.setdefault((path, message), []).append(swept)
    violations: list[Violation] = []
    for (path, message), found in groups.items():
        names = [name for name in found[0] if len(_texts(name, found)) < len(_texts(name, tried))]
        if not names and len(found) < len(tried):
            names = list(found[0])
        if names:
            texts = {name: ".".join(map(str, name)) for name in names}
            each = [", ".join(f"{text} = {json.dumps(one[name])}" for name, text in texts.items()) for one in found]
            labels = list(dict.fromkeys(each))
            more = f"; and {len(labels) - 3} more" if len(labels) > 3 else ""
            message += f" (with {'; '.join(labels[:3])}{more})"
        violations.append((path, message))
    return violations


def _texts(name: KeyPath, swept: Iterable[Mapping[KeyPath, Any]]) -> set[str]:
    return {json.dumps(one[name]) for one in swept}


def checked(cases: Cases, checks: Iterable[Check], at_most: int | None = None) -> Iterator[Violation]:
    """Yield problems found by checks in options that are valid on their own.

    The arguments of a check are named after the cases; each combination of cases is checked in turn. A place yielded by
    a check begins with the name of an argument, which is replaced by the place of that case.
    """
    for check in checks:
        names = list(inspect.signature(check).parameters)
        for places in itertools.product(*(cases.get(name, {}) for name in names)):
            at = dict(zip(names, places, strict=True))
            failures: list[Failure] = []
            tried: list[Mapping[KeyPath, Any]] = []
            given = itertools.product(*(cases[name][place] for name, place in at.items()))
            for combination in itertools.islice(given, at_most):
                tried.append({path: value for _, swept in combination for path, value in swept.items()})
                for (first, *rest), text in check(*(options for options, _ in combination)):
                    failures.append(((*at.get(str(first), (first,)), *rest), text, tried[-1]))
            yield from grouped(failures, tried)


def swept_in(case: Mapping[KeyPath, Variant]) -> dict[KeyPath, Any]:
    """Return the swept values of a combination of several sections' variants, by their places."""
    return {(*at, *path): value for at, variant in case.items() for path, value in variant.swept.items()}
