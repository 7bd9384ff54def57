"""Sections of a specification, built from the option dataclasses of the floors below.

An option dataclass is written once, with its units; this module turns it into a pydantic model that

- refuses unknown keys and says which ones there are,
- lets every scalar field be a list, which is swept,
- explains in plain words what is wrong, everything in a section at once,
- carries descriptions and units into the JSON Schema.

Units and descriptions come from the class's docstring. Metadata of a field, all optional: ``geometric``, a sweep may be
given as its ends and its length; ``added_later``, left out of the canonical form at its default, so that what was
stored before the field existed keeps its identity.

Messages are final sentences: they travel through pydantic as custom errors, with their key path as ``loc``.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
import re
import types
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    ValidationError,
    create_model,
    model_serializer,
    model_validator,
)
from pydantic.functional_validators import ModelWrapValidatorHandler, WrapValidator
from pydantic_core import InitErrorDetails, PydanticCustomError

from ctid_cli.errors import CtidError
from ctid_cli.signals.sampling import geometric_sizes
from ctid_cli.specification.option_docs import OptionDoc, option_docs
from ctid_cli.specification.yaml_source import KeyPath
from ctid_cli.text import did_you_mean

#: Combinations that one section may sweep, and data cells that one experiment may hold.
MAX_COMBINATIONS = 10_000

#: Whole numbers beyond this fit no column of a table or archive.
MAX_WHOLE = 2**63 - 1

Check = Callable[[Any], Any]
#: Key path inside a section, and what is wrong there.
Complaint = tuple[KeyPath, str]


def wrong(message: str) -> PydanticCustomError:
    """An error whose text reaches the user as it is."""
    return PydanticCustomError("ctid", "{message}", {"message": message})


def several_wrong(title: str, complaints: Iterable[tuple[KeyPath, str, bool]]) -> ValidationError:
    """One validation error that holds several complaints."""
    details = [
        InitErrorDetails(
            type=PydanticCustomError("ctid", "{message}", {"message": message, "at_key": at_key}), loc=path, input=None
        )
        for path, message, at_key in complaints
    ]
    return ValidationError.from_exception_data(title, details)


def shown(value: Any) -> str:
    """A value from a YAML file in the words of a message."""
    if value is None:
        return "nothing (null)"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return f"the text {value if len(value) <= 40 else value[:37] + '...'!r}"
    if isinstance(value, (list, tuple)):
        return "a list" if value else "an empty list"
    if isinstance(value, Mapping):
        return "a mapping"
    return repr(value)


# --------------------------------------------------------------------------------------------------------------------
# Scalars: each factory returns a check that gives back the value to keep, or raises `wrong`.


def number(
    unit: str = "", *, above: float = -math.inf, at_least: float = -math.inf, at_most: float = math.inf
) -> Check:
    """Check for a finite number."""
    what = "a number" + (f" [{unit}]" if unit else "")
    if above > -math.inf:
        what += f" above {above:g}"
    if at_least > -math.inf:
        what += f" of at least {at_least:g}"
    if at_most < math.inf:
        what += f"{',' if above > -math.inf or at_least > -math.inf else ''} at most {at_most:g}"

    def check(value: Any) -> float:
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            hint = ""
            if isinstance(value, (list, tuple)):
                hint = "; this key cannot be swept"
            elif isinstance(value, str) and _looks_like_number(value):
                hint = "; write it without quotes, underscores or a unit"
            raise wrong(f"must be {what}, not {shown(value)}{hint}")
        try:
            result = float(value)
        except OverflowError:
            result = math.inf
        if not math.isfinite(result):
            raise wrong(f"must be {what} that is finite, not {shown(result)}")
        if not (result > above and at_least <= result <= at_most):
            raise wrong(f"must be {what}, not {shown(value)}")
        return result + 0.0  # -0.0 and 0.0 are one value and must have one text

    return check


def whole(unit: str = "", *, at_least: int = -MAX_WHOLE, at_most: int = MAX_WHOLE) -> Check:
    """Check for a whole number."""
    what = "a whole number" + (f" [{unit}]" if unit else "")
    if at_least > -MAX_WHOLE:
        what += f" of at least {at_least}"
    if at_most < MAX_WHOLE:
        what += f"{' and' if at_least > -MAX_WHOLE else ' of'} at most {at_most}"

    def check(value: Any) -> int:
        if isinstance(value, bool) or not isinstance(value, int):
            hint = ""
            if isinstance(value, (list, tuple)):
                hint = "; this key cannot be swept"
            elif isinstance(value, float) and value.is_integer() and abs(value) < MAX_WHOLE:
                hint = f"; write {int(value)}"
            raise wrong(f"must be {what}, not {shown(value)}{hint}")
        if not at_least <= value <= at_most:
            raise wrong(f"must be {what}, not {shown(value)}")
        return value

    return check


def truth() -> Check:
    """Check for ``true`` or ``false``."""

    def check(value: Any) -> bool:
        if not isinstance(value, bool):
            raise wrong(f"must be true or false, not {shown(value)}")
        return value

    return check


def plain_text(pattern: str = "", explanation: str = "") -> Check:
    """Check for a text."""

    def check(value: Any) -> str:
        if not isinstance(value, str):
            hint = f"; write it in quotes: '{shown(value)}'" if isinstance(value, (bool, int, float)) else ""
            raise wrong(f"must be a text, not {shown(value)}{hint}")
        if not value:
            raise wrong("must not be empty")
        if pattern and not re.fullmatch(pattern, value):
            raise wrong(f"{value!r} cannot be used here: {explanation}")
        return value

    return check


def choice(*allowed: Any) -> Check:
    """Check for one of a few words."""
    names = ", ".join(repr(word) for word in allowed)

    def check(value: Any) -> Any:
        for word in allowed:
            if type(value) is type(word) and value == word:
                return word
        hint = did_you_mean(value, [w for w in allowed if isinstance(w, str)]) if isinstance(value, str) else ""
        raise wrong(f"must be one of {names}, not {shown(value)}{hint}")

    return check


def optional(check: Check) -> Check:
    """Check that also lets null pass."""
    return lambda value: None if value is None else check(value)


def list_of(check: Check, what: str, *, length: int | None = None) -> Check:
    """Check for a list that is one value, such as the coefficients of a polynomial."""

    def checked(value: Any) -> list[Any]:
        if not isinstance(value, (list, tuple)):
            raise wrong(f"must be {what}, not {shown(value)}")
        if not value or (length is not None and len(value) != length):
            raise wrong(f"must be {what}, not {'an empty list' if not value else f'{len(value)} of them'}")
        return _each(check, value)

    return checked


def swept(check: Check) -> Check:
    """Check for one value, or a list of values to sweep."""

    def checked(value: Any) -> Any:
        if not isinstance(value, (list, tuple)):
            return check(value)
        if not value:
            raise wrong("an empty list sweeps nothing; give one value, or a list of at least one")
        items = _each(check, value)
        for k, item in enumerate(items):
            if item in items[:k]:
                raise several_wrong("list", [((k,), f"{shown(item)} is in this list twice; keep one of them", False)])
        return items

    return checked


def spaced(check: Check) -> Check:
    """Check that also takes a sweep of whole numbers by its ends and its length."""

    def checked(value: Any) -> Any:
        return check(Geometric.model_validate(value).values() if isinstance(value, Mapping) else value)

    return checked


def _each(check: Check, values: Sequence[Any]) -> list[Any]:
    items: list[Any] = []
    complaints: list[tuple[KeyPath, str, bool]] = []
    for k, value in enumerate(values):
        try:
            items.append(check(value))
        except PydanticCustomError as error:
            complaints.append(((k,), error.message(), False))
        except ValidationError as error:
            complaints += [((k, *path), message, at_key) for path, message, at_key in _complaints(error)]
    if complaints:
        raise several_wrong("list", complaints)
    return items


def _complaints(error: ValidationError) -> list[tuple[KeyPath, str, bool]]:
    return [(e["loc"], e["msg"], bool(e.get("ctx", {}).get("at_key"))) for e in error.errors(include_url=False)]


def _looks_like_number(value: str) -> bool:
    return re.match(r"\s*[-+]?\.?[0-9]", value) is not None


def checked(check: Check) -> WrapValidator:
    """Pydantic validator that asks ``check`` alone; the annotated type only serves the JSON Schema."""
    return WrapValidator(lambda value, _handler: check(value))


# --------------------------------------------------------------------------------------------------------------------
# Sections


class Section(BaseModel):
    """A mapping of the specification; unknown and missing keys are explained, all of them at once."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    #: Option dataclass that the section describes, if it describes one.
    target: ClassVar[type | None] = None
    #: Fields that may be a list of values to sweep.
    sweepable: ClassVar[frozenset[str]] = frozenset()
    #: Fields that the canonical form leaves out at their default.
    added_later: ClassVar[frozenset[str]] = frozenset()

    @model_serializer(mode="wrap")
    def _as_before(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        content: dict[str, Any] = handler(self)
        fields = type(self).model_fields
        return {
            name: value
            for name, value in content.items()
            if name not in self.added_later or value != fields[name].get_default()
        }

    @model_validator(mode="wrap")
    @classmethod
    def _in_plain_words(cls, value: Any, handler: ModelWrapValidatorHandler[Section]) -> Section:
        if isinstance(value, cls):
            return value
        allowed = list(cls.model_fields)
        if not isinstance(value, Mapping):
            raise wrong(f"must be a mapping with the keys {', '.join(allowed)}, not {shown(value)}")
        problems: list[tuple[KeyPath, str, bool]] = []
        for key in value:
            if key not in allowed:
                hint = did_you_mean(str(key), allowed) or ";"
                problems.append(((key,), f"there is no such key here{hint} allowed: {', '.join(allowed)}", True))
        for name, info in cls.model_fields.items():
            if info.is_required() and name not in value:
                meaning = f": {info.description}" if info.description else ""
                problems.append(((name,), f"is missing; add it{meaning}", True))
        problems += [(path, message, True) for path, message in cls.requirements(value)]
        section = None
        try:
            section = handler({key: item for key, item in value.items() if key in allowed})
        except ValidationError as error:
            # Keys that are missing here are explained above, with what they mean.
            problems += [c for c, e in zip(_complaints(error), error.errors(), strict=True) if e["type"] != "missing"]
        if section is not None and not problems:
            problems += [(path, message, False) for path, message in section.complaints()]
        if problems or section is None:
            raise several_wrong(cls.__name__, problems)
        return section

    @classmethod
    def requirements(cls, raw: Mapping[str, Any]) -> Iterator[Complaint]:
        """What is wrong with the presence of keys, whatever their values."""
        yield from ()

    def complaints(self) -> Iterator[Complaint]:
        """What is wrong with the section although every value is allowed by itself."""
        if self.target is not None:
            yield from _option_complaints(self)

    def build(self, values: Mapping[str, Any]) -> Any:
        """The options that the section describes."""
        assert self.target is not None
        return self.target(
            **{
                option.name: _argument(getattr(self, option.name), values[option.name], (option.name,))
                for option in dataclasses.fields(self.target)
                if option.init and option.name in values
            }
        )


class Geometric(Section):
    """Whole numbers to sweep, spaced geometrically and rounded."""

    geometric: Annotated[
        list[int],
        Field(min_length=3, max_length=3),
        checked(list_of(whole(), "three whole numbers: the first value, the last, and how many there are", length=3)),
    ] = Field(description="The first value, the last, and how many there are")

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


class RefusedOptionsError(ValueError):
    """An option dataclass refused its values; where that is and why."""

    def __init__(self, path: KeyPath, message: str) -> None:
        super().__init__(message)
        self.path = path
        self.message = message


@dataclass(frozen=True)
class Variant:
    """One combination of a section's swept values."""

    values: dict[str, Any]
    swept: dict[KeyPath, Any]
    options: Any


def variants(section: Section) -> list[Variant]:
    """All combinations of a section's swept values, the last swept field changing fastest."""
    return [Variant(values, combination, _instance(section, values)) for combination, values in _combinations(section)]


def sweep_label(combination: Mapping[KeyPath, Any]) -> str:
    """Swept values in the words of a message."""
    return ", ".join(f"{'.'.join(str(p) for p in path)} = {json.dumps(value)}" for path, value in combination.items())


def grouped(failures: Iterable[tuple[KeyPath, str, Mapping[KeyPath, Any]]], total: int) -> list[Complaint]:
    """Complaints about combinations, each said once, with the combinations it is about."""
    groups: dict[Complaint, list[str]] = {}
    for path, message, combination in failures:
        groups.setdefault((path, message), []).append(sweep_label(combination))
    complaints: list[Complaint] = []
    for (path, message), labels in groups.items():
        if len(labels) < total and any(labels):
            more = f"; and {len(labels) - 3} more" if len(labels) > 3 else ""
            message += f" (with {'; '.join(labels[:3])}{more})"
        complaints.append((path, message))
    return complaints


def _option_complaints(section: Section) -> Iterator[Complaint]:
    count = math.prod(len(values) for _, values in _axes(section))
    if count > MAX_COMBINATIONS:
        yield (), f"the lists in this section combine to {count} cases; at most {MAX_COMBINATIONS} are allowed"
        return
    failures: list[tuple[KeyPath, str, Mapping[KeyPath, Any]]] = []
    for combination, values in _combinations(section):
        try:
            _instance(section, values)
        except RefusedOptionsError as refused:
            path = refused.path
            message = refused.message
            if path in combination:
                # Point at the offending item of the list; its value then needs no repetition.
                items = section
                for part in path:
                    items = getattr(items, str(part))
                path = (*path, typing.cast(list[Any], items).index(combination[path]))
                failures.append((path, message, {}))
            else:
                failures.append((path, message, combination))
    yield from grouped(failures, count)


def _axes(section: Section, prefix: KeyPath = ()) -> Iterator[tuple[KeyPath, list[Any]]]:
    for name in type(section).model_fields:
        value = getattr(section, name)
        if isinstance(value, Section):
            yield from _axes(value, (*prefix, name))
        elif name in section.sweepable and isinstance(value, list):
            yield (*prefix, name), value


def _combinations(section: Section) -> Iterator[tuple[dict[KeyPath, Any], dict[str, Any]]]:
    axes = list(_axes(section))
    for point in itertools.product(*(values for _, values in axes)):
        values = section.model_dump(mode="json")
        combination: dict[KeyPath, Any] = {}
        for (path, _), value in zip(axes, point, strict=True):
            inner = values
            for part in path[:-1]:
                inner = inner[str(part)]
            inner[str(path[-1])] = value
            combination[path] = value
        yield combination, values


def _instance(section: Section, values: Mapping[str, Any]) -> Any:
    """The options of a section with the given values."""
    try:
        with np.errstate(all="ignore"):  # what overflows is refused, or found by the section's own complaints
            return section.build(values)
    except RefusedOptionsError:
        raise
    except (ValueError, ArithmeticError, CtidError) as error:
        message = str(error).strip() or f"these values were refused ({type(error).__name__})"
        field = getattr(error, "field", "")
        raise RefusedOptionsError((field,) if field in type(section).model_fields else (), message) from None


def _argument(inner: Any, value: Any, path: KeyPath) -> Any:
    """What an option dataclass is given for a field: `inner` as the section holds it, `value` as plain data."""
    if isinstance(inner, Section):
        try:
            return _instance(inner, value)
        except RefusedOptionsError as refused:
            raise RefusedOptionsError((*path, *refused.path), refused.message) from None
    if isinstance(value, list):
        return tuple(_argument(part, item, (*path, k)) for k, (part, item) in enumerate(zip(inner, value, strict=True)))
    return value


# --------------------------------------------------------------------------------------------------------------------
# From option dataclasses to sections

_NO_DEFAULT: Any = object()


@dataclass(frozen=True)
class _FieldForm:
    check: Check
    annotation: Any
    scalar: bool


def section_for(
    target: type, *, kind: str | None = None, extra: Mapping[str, Any] | None = None, sweeping: bool = True
) -> type[Section]:
    """Section model of an option dataclass."""
    hints, docs = get_type_hints(target), option_docs(target)
    definitions: dict[str, Any] = {}
    sweepable: set[str] = set()
    later: set[str] = set()
    if kind is not None:
        definitions["kind"] = (Annotated[Literal[kind], checked(choice(kind))], Field(description="Which one it is"))
    for option in dataclasses.fields(target):
        if not option.init:
            continue
        doc = docs.get(option.name, OptionDoc())
        form = _form(hints[option.name], doc.unit, f"{target.__name__}.{option.name}")
        annotation, check = form.annotation, form.check
        if form.scalar and sweeping:
            sweepable.add(option.name)
            annotation = Union[annotation, types.GenericAlias(list, (annotation,))]  # noqa: UP007 - built at run time
            check = swept(check)
            if option.metadata.get("geometric"):
                annotation = Union[annotation, Geometric]  # noqa: UP007 - built at run time
                check = spaced(check)
        if option.metadata.get("added_later"):
            later.add(option.name)
        default = _default(option, form.check)
        definitions[option.name] = (
            Annotated[annotation, checked(check)],
            Field(**({} if default is _NO_DEFAULT else {"default": default}), description=doc.text or None),
        )
    definitions.update(extra or {})
    model = create_model(target.__name__, __base__=Section, __doc__=_summary(target), **definitions)
    model.target = target
    model.sweepable = frozenset(sweepable)
    model.added_later = frozenset(later)
    return model


def by_kind(models: Mapping[str, type[Section]]) -> Any:
    """Annotation of a section that is one of several, told apart by its ``kind``."""
    allowed = ", ".join(models)

    def check(value: Any) -> Section:
        if isinstance(value, tuple(models.values())):
            return typing.cast(Section, value)
        if not isinstance(value, Mapping):
            raise wrong(f"must be a mapping with a 'kind' (one of {allowed}), not {shown(value)}")
        if "kind" not in value:
            raise several_wrong("kind", [(("kind",), f"is missing; allowed: {allowed}", True)])
        kind = value["kind"]
        if not isinstance(kind, str) or kind not in models:
            hint = did_you_mean(kind, models) if isinstance(kind, str) else ""
            message = f"must be one of {allowed}, not {shown(kind)}{hint}"
            raise several_wrong("kind", [(("kind",), message, False)])
        return models[kind].model_validate(value)

    return Annotated[Union[tuple(models.values())], checked(check)]  # noqa: UP007 - built at run time


def _form(hint: Any, unit: str, name: str) -> _FieldForm:
    """How a field of a given type is checked and shown in the schema."""
    origin, arguments = get_origin(hint), get_args(hint)
    if hint is bool:
        return _FieldForm(truth(), bool, True)
    if hint is int:
        return _FieldForm(whole(unit), int, True)
    if hint is float:
        return _FieldForm(number(unit), float, True)
    if hint is str:
        # Names of files and columns are no quantities, and sweeping them would hide what a result belongs to.
        return _FieldForm(plain_text(), str, False)
    if origin is Literal:
        return _FieldForm(choice(*arguments), hint, True)
    if origin in (Union, types.UnionType) and len(arguments) == 2 and type(None) in arguments:
        inner = _form(next(a for a in arguments if a is not type(None)), unit, name)
        return _FieldForm(optional(inner.check), inner.annotation | None, inner.scalar)
    if origin in (Union, types.UnionType) and len(arguments) == 2 and arguments[0] in (float, int):
        usual, other = (_form(argument, unit, name) for argument in arguments)
        annotation = usual.annotation | other.annotation
        return _FieldForm(_either(usual, other), annotation, usual.scalar and other.scalar)
    if origin in (tuple, list) and arguments and all(a in (float, int, Ellipsis) for a in arguments):
        item = _form(arguments[0], unit, name)
        length = len(arguments) if origin is tuple and Ellipsis not in arguments else None
        what = f"a list of {f'{length} ' if length else ''}numbers{f' [{unit}]' if unit else ''}"
        schema: Any = types.GenericAlias(list, (item.annotation,))
        if length:
            schema = Annotated[schema, Field(min_length=length, max_length=length)]
        return _FieldForm(list_of(item.check, what, length=length), schema, False)
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        model = section_for(hint)
        return _FieldForm(model.model_validate, model, False)
    if origin is tuple and arguments[1:] == (Ellipsis,) and dataclasses.is_dataclass(arguments[0]):
        # A list of such lists would say too little about which of them belong together, so that nothing in it is swept.
        model = section_for(typing.cast(type, arguments[0]), sweeping=False)
        what = f"a list of mappings with the keys {', '.join(model.model_fields)}"
        return _FieldForm(list_of(model.model_validate, what), types.GenericAlias(list, (model,)), False)
    raise TypeError(f"{name}: a field of type {hint} has no form in a specification")


def _either(usual: _FieldForm, other: _FieldForm) -> Check:
    """Check for a number, or else a list if such is the other form, or a word."""
    kind: Any = str if other.scalar else (list, tuple)

    def check(value: Any) -> Any:
        if isinstance(value, kind):
            return other.check(value)
        try:
            return usual.check(value)
        except PydanticCustomError as error:
            raise wrong(f"{error.message()}; {'a word' if other.scalar else 'a list'} is allowed too") from None

    return check


def _default(option: dataclasses.Field[Any], check: Check) -> Any:
    """The default in the form that the check gives to a value from a file, so that both have one canonical text."""
    default = option.default
    if default is dataclasses.MISSING:
        if option.default_factory is dataclasses.MISSING:
            return _NO_DEFAULT
        default = option.default_factory()
    if dataclasses.is_dataclass(default) and not isinstance(default, type):
        default = dataclasses.asdict(default)
    elif isinstance(default, tuple):
        default = [dataclasses.asdict(item) if hasattr(item, "__dataclass_fields__") else item for item in default]
    return check(default)


def _summary(target: type) -> str:
    return (target.__doc__ or target.__name__).strip().splitlines()[0]
