"""Sections for components of one's own: kinds that name code, and those that installed packages offer."""

import inspect
from collections.abc import Iterator, Mapping
from dataclasses import is_dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, ClassVar

from pydantic import PlainValidator, WithJsonSchema

from ctid_cli.errors import CtidError
from ctid_cli.kinds import KINDS
from ctid_cli.own_code import OwnCodeError, find_class, find_entry_point, reason
from ctid_cli.simulation.own_components import (
    OwnClockedNoise,
    OwnEstimation,
    OwnExcitation,
    OwnNoise,
    OwnSampling,
    OwnSystem,
)
from ctid_cli.specification.fields import ByShape, Number, Text
from ctid_cli.specification.messages import Complaint, several_wrong
from ctid_cli.specification.sections import RefusedOptionsError, Section, section_for, variants
from ctid_cli.specification.yaml_source import KeyPath
from ctid_cli.text import did_you_mean

#: What stands for a component of one's own, the method that it needs, and what the method is given: one way or more.
CONTRACTS: dict[str, tuple[tuple[type, str, tuple[str, ...]], ...]] = {
    "estimator": ((OwnEstimation, "fit", ("record", "start")),),
    "excitation": ((OwnExcitation, "generate", ("times", "rng")),),
    "noise": (
        (OwnNoise, "generate", ("output", "rng")),
        (OwnClockedNoise, "generate", ("output", "times", "rng")),
    ),
    "sampling": ((OwnSampling, "times", ("rng",)),),
    "system": ((OwnSystem, "simulate", ("input", "times")),),
}


class OwnKind(str):
    """A kind that is none of ours, with the section of the class that it names, or with why there is none."""

    own = True
    section: type[Section] | None = None
    deterministic = False
    problem = ""


def own_places(tree: Mapping[str, Any]) -> Iterator[tuple[KeyPath, str, str]]:
    """Where a specification names kinds that are none of ours, what they are kinds of, and the kinds."""
    loop, estimators = tree.get("loop"), tree.get("estimators")
    places: list[tuple[KeyPath, str, Any]] = [((name,), name, tree.get(name)) for name in CONTRACTS]
    places += [(("loop", "reference"), "excitation", loop.get("reference") if isinstance(loop, Mapping) else None)]
    if isinstance(estimators, Mapping):
        places += [(("estimators", name), "estimator", part) for name, part in estimators.items()]
    for path, section, part in places:
        kind = part.get("kind") if isinstance(part, Mapping) else None
        ours = {*KINDS.get(section, ()), *(KINDS["frequency_estimator"] if section == "estimator" else ())}
        if isinstance(kind, str) and kind not in ours:
            yield path, section, kind


def names_code(kind: str) -> bool:
    """Whether a kind names a file or a module."""
    return ":" in kind


def with_own_kinds(tree: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """A specification whose kinds of one's own know their classes."""
    found = dict(tree)
    for path, section, kind in own_places(tree):
        place: Any = found
        for key in path:
            place[key] = dict(place[key])
            place = place[key]
        own = _own_kind(section, kind, folder)
        if own is not None:
            place["kind"] = own
    return found


def _own_kind(section: str, name: str, folder: Path) -> OwnKind | None:
    kind = OwnKind(name)
    try:
        target = find_class(name, folder) if names_code(name) else find_entry_point(section, name)
        if target is None and section in KINDS:
            return None
        if target is None:
            raise OwnCodeError(f"must be './file.py:Class' or 'package.module:Class', not the text {name!r}")
        if not isinstance(target, type):
            raise OwnCodeError(f"{name} is no class; a kind names a dataclass of options")
        kind.section = _section_of(target, section, name)
        kind.deterministic = getattr(target, "deterministic", False) is True
    except OwnCodeError as error:
        kind.problem = str(error)
    return kind


@cache
def _section_of(target: type[Any], section: str, kind: str) -> type[Section]:
    name, method = target.__name__, CONTRACTS[section][0][1]
    wanted = " or ".join(f"{method}(self, {', '.join(given)})" for _, _, given in CONTRACTS[section])
    if not callable(getattr(target, method, None)):
        raise OwnCodeError(f"{name} has no method {method}; this kind needs {wanted}")
    if not is_dataclass(target):
        raise OwnCodeError(f"{name} is no dataclass; write @dataclass(frozen=True) above it")
    fitting = [stand_in for stand_in, _, given in CONTRACTS[section] if _takes(getattr(target, method), given)]
    if not fitting:
        raise OwnCodeError(f"{name}.{method} cannot be called so; this kind needs {wanted}")
    start_from = getattr(target, "start_from", None)
    if section == "estimator" and start_from not in (None, "delay", "parameters"):
        raise OwnCodeError(f"{name}.start_from must be None, 'delay' or 'parameters', not {start_from!r}")
    taken = {"kind", "truth", *dir(OwnSystemSection)}
    for option in target.__dataclass_fields__:
        if option in taken or option.startswith(("_", "model_")):
            raise OwnCodeError(f"{name}: an option cannot be called {option!r} here; rename it")
    try:
        found = section_for(target, kind, base=OwnSystemSection if section == "system" else OwnSection)
    # Whatever is wrong with the annotations of a class that somebody wrote.
    except Exception as error:
        raise OwnCodeError(f"the options of {name} cannot be read: {reason(error)}") from None
    found.stand_in = fitting[0]  # type: ignore[attr-defined]
    return found


def _takes(call: Any, given: tuple[str, ...]) -> bool:
    """Whether a method can be called with so many values besides its object."""
    try:
        inspect.signature(call).bind(None, *given)
    except (TypeError, ValueError):
        return False
    return True


class OwnSection(Section):
    """Options of a component of one's own."""

    own: ClassVar[bool] = True
    #: What holds the options where one of ours would hold its own.
    stand_in: ClassVar[Any] = None

    def build(self) -> Any:
        """What stands for the component; whatever it raises but a ValueError, which is a sentence, needs its place."""
        try:
            return self.stand_in(super().build())
        except (ValueError, CtidError):
            raise
        except (Exception, SystemExit) as error:
            raise RefusedOptionsError(("kind",), f"refuses these options: {reason(error)}") from None

    def complaints(self) -> Iterator[Complaint]:
        """Say that worker processes cannot be given the component."""
        from joblib.externals.loky.backend.reduction import dumps

        try:
            dumps(variants(self)[0].options)
        except Exception as error:
            yield ("kind",), f"cannot be sent to worker processes: {reason(error)}; keep only plain data in options"


class OwnSystemSection(OwnSection):
    """Options of a system of one's own, and what is true of it.

    Parameters
    ----------
    truth : mapping, optional
        true values of what is estimated, by name; the name of an option stands for its value
    """

    truth: dict[str, Annotated[float | str, ByShape(Number, "the name of an option is allowed too", text=Text)]] = {}  # noqa: RUF012

    def complaints(self) -> Iterator[Complaint]:
        """Say which true values are none."""
        yield from super().complaints()
        for name, value in self.truth.items():
            option = getattr(self, value, None) if isinstance(value, str) and value in self._numbers() else value
            if isinstance(option, str):
                hint = did_you_mean(option, self._numbers()) or ";"
                yield (
                    ("truth", name),
                    f"{option!r} is no option that is a number{hint} options: {', '.join(self._numbers())}",
                )

    def _numbers(self) -> list[str]:
        """Options that are numbers, or swept."""
        return [name for name in type(self).model_fields if isinstance(getattr(self, name), (int, float, list))]


def _validated(value: Any) -> Section:
    if isinstance(value, Section):
        return value
    kind = value["kind"]
    if kind.section is None:
        raise several_wrong("own", [(("kind",), kind.problem, False)])
    found: Section = kind.section.model_validate({**value, "kind": str(kind)})
    return found


#: Annotation of a section whose kind is one's own.
OWN_FORM = Annotated[
    Any,
    PlainValidator(_validated),
    WithJsonSchema(
        {
            "type": "object",
            "description": "A component of one's own: './file.py:Class' or 'package.module:Class', and its options",
            "properties": {"kind": {"type": "string", "pattern": ":"}},
            "required": ["kind"],
        }
    ),
]
