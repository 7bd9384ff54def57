"""Sections of a specification: pydantic models that explain in plain words what is wrong, everything at once.

A section for an option dataclass is made from the class: types and defaults from its fields, descriptions and units
from its docstring. Every scalar option may be a list of values to sweep. Metadata of a field, both optional:
``geometric``, a sweep may be given as its ends and its length; ``added_later``.
"""

from __future__ import annotations

import dataclasses
import inspect
import itertools
import json
import math
import types
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
import pydantic
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import ErrorDetails

from ctid_cli.arrays import Array
from ctid_cli.errors import CtidError
from ctid_cli.kinds import classes
from ctid_cli.signals.sampling import geometric_sizes
from ctid_cli.specification.fields import LATER, ByShape, Coefficients, Number, OneOf, Swept, Text, Whole
from ctid_cli.specification.messages import Complaint, explained, several_wrong
from ctid_cli.specification.option_docs import option_docs
from ctid_cli.specification.yaml_source import KeyPath

#: Combinations that one section may sweep, and data cells that one experiment may hold.
MAX_COMBINATIONS = 100_000

AnySection = TypeVar("AnySection", bound="Section")
#: A complaint, and the swept values that it is about.
Failure = tuple[KeyPath, str, Mapping[KeyPath, Any]]


class RefusedOptionsError(ValueError):
    """An option dataclass refused its values; where that is and why."""

    def __init__(self, path: KeyPath, message: str) -> None:
        super().__init__(message)
        self.path = path
        self.message = message


class Section(BaseModel):
    """A mapping of the specification."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, validate_default=True, defer_build=True)

    #: Option dataclass that the section describes, if it describes one.
    target: ClassVar[type | None] = None
    #: Sentences for keys that belong to another form of the section.
    elsewhere: ClassVar[Mapping[str, str]] = {}
    #: Whether the option dataclass is one that the user wrote.
    own: ClassVar[bool] = False
    #: What to say of a section that gives nothing; empty if it may.
    if_empty: ClassVar[str] = ""

    @pydantic.model_serializer(mode="wrap")
    def _as_before(self, handler: pydantic.SerializerFunctionWrapHandler) -> dict[str, Any]:
        content: dict[str, Any] = handler(self)
        fields = type(self).model_fields
        return {
            name: value
            for name, value in content.items()
            if LATER not in fields[name].metadata or value != fields[name].get_default()
        }

    @classmethod
    def descriptions(cls) -> dict[str, str]:
        """What is said about each key: by the docstring of the section, or of the option dataclass it was made from."""
        docs = {"kind": "Which one it is"} | option_docs(cls.target or cls) | option_docs(cls)
        return {name: docs.get(name, "") for name in cls.model_fields}

    @classmethod
    def __get_pydantic_json_schema__(cls, core_schema: Any, handler: pydantic.GetJsonSchemaHandler) -> dict[str, Any]:
        reference = handler(core_schema)
        schema = handler.resolve_ref_schema(reference)
        schema["description"] = inspect.cleandoc(cls.__doc__ or "").partition("\n\n")[0]
        for name, text in cls.descriptions().items():
            schema["properties"][name] |= {"description": text} if text else {}
        return reference

    @pydantic.model_validator(mode="wrap")
    @classmethod
    def _in_plain_words(cls, value: Any, handler: pydantic.ModelWrapValidatorHandler[Section]) -> Section:
        required = cls.requirements(value) if isinstance(value, Mapping) else ()
        problems = [(path, message, True) for path, message in required]
        try:
            section = handler(value)
        except ValidationError as error:
            details = (cls.narrowed(detail, value) for detail in error.errors(include_url=False))
            problems += [explained(detail, cls.descriptions()) for detail in details]
        else:
            if not problems:
                found = _option_complaints(section) or section.complaints()
                problems = [(path, message, False) for path, message in found]
            if not problems:
                return section
        other = cls.elsewhere
        said = [(at, other.get(str(at[0]), text) if at else text, key) for at, text, key in problems]
        raise several_wrong(cls.__name__, said)

    @classmethod
    def requirements(cls, raw: Mapping[str, Any]) -> Iterator[Complaint]:
        """What is wrong with the presence of keys, whatever their values."""
        yield from ()

    @classmethod
    def narrowed(cls, error: ErrorDetails, raw: Any) -> ErrorDetails:
        """An error that allows only what the rest of the section allows."""
        return error

    def complaints(self) -> Iterator[Complaint]:
        """What is wrong with the section although every value, and the option dataclass if any, is right by itself."""
        if self.if_empty and all(getattr(self, name) is None for name in type(self).model_fields):
            yield (), self.if_empty

    def build(self) -> Any:
        """The options that the section describes, where nothing is swept."""
        assert self.target is not None
        options = {option.name for option in dataclasses.fields(self.target) if option.init}
        return self.target(**{name: self.part(name) for name in type(self).model_fields if name in options})

    def part(self, name: str) -> Any:
        """What an option dataclass is given for a field."""
        return _part(getattr(self, name), (name,))

    def options(self) -> Any:
        """The same as `build`; what is refused is refused with its place."""
        try:
            with np.errstate(all="ignore"):  # what overflows is refused, or found by the section's own complaints
                return self.build()
        except RefusedOptionsError:
            raise
        except (ValueError, ArithmeticError, CtidError) as error:
            message = str(error).strip() or f"these values were refused ({type(error).__name__})"
            raise RefusedOptionsError(place_of(error, type(self).model_fields), message) from None


def place_of(error: Exception, options: Container[str]) -> KeyPath:
    """The option that an error is about, if it is about one of them."""
    field = getattr(error, "field", "")
    return (field,) if field in options else ()


def _part(value: Any, path: KeyPath) -> Any:
    if isinstance(value, Section):
        try:
            return value.options()
        except RefusedOptionsError as refused:
            raise RefusedOptionsError((*path, *refused.path), refused.message) from None
    if isinstance(value, list):
        return tuple(_part(item, (*path, k)) for k, item in enumerate(value))
    return value


class Geometric(Section):
    """Whole numbers to sweep, spaced geometrically and rounded.

    Parameters
    ----------
    geometric : list of int
        three whole numbers, the first value, the last, and how many there are
    """

    geometric: Annotated[list[Whole], Field(min_length=3, max_length=3)]

    def complaints(self) -> Iterator[Complaint]:
        """Say why there are no such numbers."""
        if self.geometric[2] > MAX_COMBINATIONS:
            yield ("geometric", 2), f"{self.geometric[2]} values are too many; at most {MAX_COMBINATIONS} are allowed"
            return
        try:
            self.values()
        except ValueError as error:
            yield ("geometric",), str(error)

    def values(self) -> list[int]:
        """The numbers."""
        first, last, count = self.geometric
        return geometric_sizes(first, last, count)


def section_for(
    target: type, kind: str = "", *, sweeping: bool = True, without: str = "", base: type[Section] = Section
) -> type[Section]:
    """Section of an option dataclass."""
    hints = get_type_hints(target)
    fields: dict[str, Any] = {}
    if kind:
        fields["kind"] = (Literal[kind], ...)
    for option in dataclasses.fields(target):
        if not option.init or option.name == without:
            continue
        form, scalar = _form(hints[option.name], f"{target.__name__}.{option.name}")
        if scalar and sweeping:
            spaced = {"mapping": Annotated[Geometric, AfterValidator(Geometric.values)]}
            form = Annotated[Any, Swept(form, **(spaced if option.metadata.get("geometric") else {}))]
        if option.metadata.get("added_later"):
            form = Annotated[form, LATER]
        fields[option.name] = (form, _default(option))
    summary = ((target.__doc__ or "").strip() or target.__name__).splitlines()[0]
    section = pydantic.create_model(target.__name__, __base__=base, __doc__=summary, **fields)
    section.target = target
    return section


class Kinds(OneOf):
    """Annotation of a section that is one of several, told apart by its ``kind``, or one's own if that has a form."""

    def __init__(self, *names: str, own: Any = None) -> None:
        sections = {kind: section_for(target, kind) for name in names for kind, target in classes(name).items()}

        def choose(value: Any) -> str | None:
            kind = value.get("kind") if isinstance(value, Mapping) else getattr(value, "kind", None)
            if own is not None and is_own(value):
                return "own"
            return kind if isinstance(kind, str) and kind in sections else None

        forms = sections if own is None else {**sections, "own": own}
        super().__init__(choose, forms, "no_kind", ", ".join(sections))


def is_own(value: Any) -> bool:
    """Whether a section, or the mapping that it is made from, is about a component of one's own."""
    return bool(getattr(value.get("kind") if isinstance(value, Mapping) else value, "own", False))


class Options(OneOf):
    """Annotation of the section of an option dataclass."""

    def __init__(self, target: type, **settings: Any) -> None:
        super().__init__(lambda _: "options", {"options": section_for(target, **settings)})


class WithKey(OneOf):
    """Annotation of a section that has one form with a key (and other values), and another one without it."""

    def __init__(self, key: str, form: Any, otherwise: Any, **also: Any) -> None:
        def choose(value: Any) -> str:
            given = isinstance(value, Mapping) and key in value and all(value.get(k) == v for k, v in also.items())
            return key if given or key in getattr(type(value), "model_fields", {}) else "otherwise"

        super().__init__(choose, {key: form, "otherwise": otherwise})


def _form(hint: Any, name: str) -> tuple[Any, bool]:
    """Annotation of an option of a given type, and whether it can be swept."""
    simple = {float: Number, int: Whole, bool: bool, str: Text, Array: Coefficients}
    origin, arguments = get_origin(hint), get_args(hint)
    if hint in simple:
        # Names of files and columns are no quantities, and sweeping them would hide what a result belongs to.
        return simple[hint], hint not in (str, Array)
    if origin is Literal:
        return hint, True
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        return section_for(hint), False
    if origin in (Union, types.UnionType) and type(None) in arguments:
        form, scalar = _form(Union[tuple(a for a in arguments if a is not type(None))], name)  # noqa: UP007
        return form | None, scalar
    if origin in (Union, types.UnionType) and len(arguments) == 2:
        (usual, _), (other, word) = (_form(argument, name) for argument in arguments)
        if word:
            return Annotated[Any, ByShape(usual, "a word is allowed too", text=other)], True
        return Annotated[Any, ByShape(usual, "a list is allowed too", list=other)], False
    if origin is tuple and arguments and (listed := _list_form(arguments)) is not None:
        return listed, False
    allowed = "float, int, bool, str, Literal, tuple[float, ...], dataclasses of these, and any of them or None"
    raise TypeError(f"{name}: a field of type {hint} has no form in a specification; allowed: {allowed}")


def _list_form(items: tuple[Any, ...]) -> Any:
    """Annotation of an option that is a tuple of numbers, words or option dataclasses; None for any other tuple."""
    if dataclasses.is_dataclass(items[0]):
        # A list of such lists would say too little about which of them belong together, so that nothing in it is swept.
        item = section_for(items[0], sweeping=False)  # type: ignore[arg-type]
        return Annotated[list[item], Field(min_length=1)]  # type: ignore[valid-type]
    length = None if Ellipsis in items else len(items)
    one: Any = {float: Number, int: Whole, str: Text}.get(items[0])
    return None if one is None else Annotated[list[one], Field(min_length=length or 1, max_length=length)]


def _default(option: dataclasses.Field[Any]) -> Any:
    """The default as a file would give it."""
    default: Any = option.default
    if option.default_factory is not dataclasses.MISSING:
        default = option.default_factory()
    if default is dataclasses.MISSING:
        return ...
    if dataclasses.is_dataclass(default) and not isinstance(default, type):
        return dataclasses.asdict(default)
    return list(default) if isinstance(default, tuple) else default


# --------------------------------------------------------------------------------------------------------------------
# Sweeps


@dataclass(frozen=True)
class Variant:
    """One combination of a section's swept values."""

    values: dict[str, Any]
    swept: dict[KeyPath, Any]
    options: Any


def variants(section: Section | None) -> list[Variant]:
    """All combinations of a section's swept values, the last swept field changing fastest; none of no section."""
    if section is None:
        return []
    return [Variant(one.model_dump(mode="json"), swept, one.options()) for swept, one in _combinations(section)]


def case_count(section: Any) -> int:
    """Number of combinations of a section's swept values, before any of them is made."""
    return math.prod(len(values) for _, values in _axes(section)) if isinstance(section, Section) else 1


def _axes(section: Section, prefix: KeyPath = ()) -> Iterator[tuple[KeyPath, list[Any]]]:
    for name, info in type(section).model_fields.items():
        value = getattr(section, name)
        if isinstance(value, Section):
            yield from _axes(value, (*prefix, name))
        elif isinstance(value, list) and any(isinstance(mark, Swept) for mark in info.metadata):
            yield (*prefix, name), value


def _combinations(section: Section) -> Iterator[tuple[dict[KeyPath, Any], Section]]:
    axes = list(_axes(section))
    for point in itertools.product(*(values for _, values in axes)):
        swept = {path: value for (path, _), value in zip(axes, point, strict=True)}
        one = section
        for path, value in swept.items():
            one = replaced(one, path, value)
        yield swept, one


def replaced(section: AnySection, path: KeyPath, value: Any) -> AnySection:
    """A section with another value at a place in it."""
    name = str(path[0])
    inner = value if len(path) == 1 else replaced(getattr(section, name), path[1:], value)
    return section.model_copy(update={name: inner})


def _option_complaints(section: Section) -> list[Complaint]:
    """What the option dataclass, if any, has against the values of a section."""
    if section.target is None:
        return []
    axes = dict(_axes(section))
    count = math.prod(map(len, axes.values()))
    if count > MAX_COMBINATIONS:
        return [((), f"the lists in this section combine to {count} cases; at most {MAX_COMBINATIONS} are allowed")]
    failures: list[Failure] = []
    for swept, one in _combinations(section):
        try:
            one.options()
        except RefusedOptionsError as refused:
            if refused.path in swept:
                # Point at the offending item of the list; its value then needs no repetition.
                place = axes[refused.path].index(swept[refused.path])
                failures.append(((*refused.path, place), refused.message, {}))
            else:
                failures.append((refused.path, refused.message, swept))
    return grouped(failures, count)


def grouped(failures: Iterable[Failure], total: int) -> list[Complaint]:
    """Complaints about combinations, each said once, with the combinations it is about."""
    groups: dict[Complaint, list[str]] = {}
    for path, message, swept in failures:
        label = ", ".join(f"{'.'.join(map(str, where))} = {json.dumps(value)}" for where, value in swept.items())
        groups.setdefault((path, message), []).append(label)
    complaints: list[Complaint] = []
    for (path, message), labels in groups.items():
        if len(labels) < total and any(labels):
            more = f"; and {len(labels) - 3} more" if len(labels) > 3 else ""
            message += f" (with {'; '.join(labels[:3])}{more})"
        complaints.append((path, message))
    return complaints


def over(
    sections: Mapping[KeyPath, Sequence[Variant]],
    check: Callable[..., Iterable[Complaint]],
    at_most: int | None = None,
) -> list[Complaint]:
    """What a check of options says about the combinations of several sections' variants.

    Swept values are called by the place that their section's variants are given under.
    """
    cases = list(itertools.islice(itertools.product(*sections.values()), at_most))
    failures: list[Failure] = []
    for case in cases:
        swept = {(*at, *path): v for at, one in zip(sections, case, strict=True) for path, v in one.swept.items()}
        failures += [(path, text, swept) for path, text in check(*(variant.options for variant in case))]
    return grouped(failures, len(cases))
