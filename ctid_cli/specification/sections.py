"""Base of the sections of a specification: pydantic models that report all errors at once in plain words.

A section for an option dataclass is made from the class: types and defaults from its fields, descriptions and units
from its docstring. Every scalar option may be a list of values to sweep, or a mapping ``{geometric: …}`` if the field
metadata allow it.
"""

from __future__ import annotations

import dataclasses
import inspect
import types
from collections.abc import Container, Iterator, Mapping
from functools import partial
from typing import Annotated, Any, ClassVar, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np
import pydantic
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import ErrorDetails

from ctid_cli.arrays import Array
from ctid_cli.custom_code import reason
from ctid_cli.errors import CtidError, OptionError
from ctid_cli.signals.checks import require_integer
from ctid_cli.specification.messages import Violation, explained, option_docs, several_wrong
from ctid_cli.specification.sweeps import MAX_COMBINATIONS, option_violations
from ctid_cli.specification.values import ByShape, Coefficients, Number, OneOf, Swept, Text, Whole
from ctid_cli.specification.yaml_source import KEY
from ctid_cli.text import closest


class Section(BaseModel):
    """A mapping of the specification."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, validate_default=True, defer_build=True)

    #: Option dataclass that it describes, if any.
    target: ClassVar[type | None] = None
    #: Whether the option dataclass is custom.
    custom: ClassVar[bool] = False
    #: Messages for keys that belong to another form of the section.
    elsewhere: ClassVar[Mapping[str, str]] = {}
    #: Message for an empty section; empty if it is allowed.
    if_empty: ClassVar[str] = ""

    @classmethod
    def descriptions(cls) -> dict[str, str]:
        """Return the description of each key from the docstring of the section or of its option dataclass."""
        docs = {"kind": "Which one it is"} | option_docs(cls.target or cls) | option_docs(cls)
        docs |= dict.fromkeys(former_options(cls.target), "An option of earlier versions, which has no effect")
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
        problems = [((*path, KEY), message) for path, message in required]
        try:
            section = handler(value)
        except ValidationError as error:
            details, known = cls.details(error, value), cls.descriptions()
            # The key meant by a misspelt one is not also reported as missing.
            unknown = [str(each["loc"][-1]) for each in details if each["type"] == "extra_forbidden"]
            meant = {closest(name, known) for name in unknown}
            reported = [each for each in details if each["type"] != "missing" or each["loc"][-1] not in meant]
            problems += [explained(each, known) for each in reported]
        else:
            problems = problems or option_violations(section) or list(section.violations())
            if not problems:
                return section
        other = cls.elsewhere
        said = [(at, other.get(str(at[0]), text) if at else text) for at, text in problems]
        raise several_wrong(cls.__name__, said)

    @classmethod
    def details(cls, error: ValidationError, raw: Any) -> list[ErrorDetails]:
        """Return the pydantic errors of the values of a section."""
        return error.errors(include_url=False)

    @classmethod
    def requirements(cls, raw: Mapping[str, Any]) -> Iterator[Violation]:
        """Yield missing or superfluous keys, independent of their values."""
        yield from ()

    def violations(self) -> Iterator[Violation]:
        """Yield problems of a section in which every value is valid on its own."""
        if self.if_empty and all(getattr(self, name) is None for name in type(self).model_fields):
            yield (), self.if_empty

    def build(self) -> Any:
        """Return the options described by a section without swept values."""
        assert self.target is not None
        options = {option.name for option in dataclasses.fields(self.target) if option.init}
        return self.target(**{name: self.part(name) for name in type(self).model_fields if name in options})

    def part(self, name: str) -> Any:
        """Return the value of a key for a field of the option dataclass."""
        return _part(getattr(self, name))

    def options(self) -> Any:
        """Build the options; an OptionError names the refused option and the reason."""
        try:
            with np.errstate(all="ignore"):  # overflow is refused here or by `violations`
                return self.build()
        except (Exception, SystemExit) as error:
            if self.custom and not isinstance(error, (ValueError, CtidError)):
                raise OptionError("kind", f"refuses these options: {reason(error)}") from None
            if not isinstance(error, (ValueError, ArithmeticError, CtidError)):
                raise
            message = str(error).strip() or f"these values were refused ({type(error).__name__})"
            raise OptionError("".join(place_of(error, type(self).model_fields)), message) from None


def place_of(error: Exception, options: Container[str]) -> tuple[str, ...]:
    """Return the option named by an error as a path; empty if there is none."""
    field = getattr(error, "field", "")
    return (field,) if field in options else ()


def _part(value: Any) -> Any:
    if isinstance(value, Section):
        return value.options()  # never fails: inner sections are validated before outer ones
    return tuple(map(_part, value)) if isinstance(value, list) else value


class Geometric(Section):
    """Whole numbers to sweep, spaced geometrically and rounded.

    Parameters
    ----------
    geometric : list of int
        three whole numbers, the first value, the last, and how many there are
    """

    geometric: Annotated[list[Whole], Field(min_length=3, max_length=3)]

    def violations(self) -> Iterator[Violation]:
        """Yield the reason why there are no such numbers."""
        if self.geometric[2] > MAX_COMBINATIONS:
            yield ("geometric", 2), f"{self.geometric[2]} values are too many; at most {MAX_COMBINATIONS} are allowed"
            return
        try:
            self.values()
        except ValueError as error:
            yield ("geometric",), str(error)

    def values(self) -> list[int]:
        """Return the numbers."""
        first, last, count = self.geometric
        return geometric_sizes(first, last, count)


def geometric_sizes(first: int, last: int, count: int) -> list[int]:
    """Return geometrically spaced whole numbers, such as the record lengths of a study of convergence."""
    require_integer("the first size", first, 1)
    require_integer("the last size", last, 1)
    require_integer("the count", count, 2)
    if first >= last:
        raise ValueError(f"the first size must be below the last; they are {first} and {last}.")
    sizes = [int(size) for size in np.rint(np.geomspace(first, last, count))]
    if len(set(sizes)) < count:
        raise ValueError(f"there are no {count} different sizes from {first} to {last}, spaced geometrically.")
    return sizes


def former_options(target: type | None) -> Mapping[str, tuple[Any, Any]]:
    """Return the types and defaults of options of earlier versions, which have no effect."""
    return getattr(target, "former", {})


def section_for(
    target: type, kind: str = "", *, sweeping: bool = True, without: str = "", base: type[Section] = Section
) -> type[Section]:
    """Return the section class of an option dataclass."""
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
        fields[option.name] = (form, _default(option))
    for name, (hint, default) in former_options(target).items():
        # A part of the identity of estimates.
        form, scalar = _form(hint, f"{target.__name__}.{name}")
        fields[name] = (Annotated[Any, Swept(form)] if scalar and sweeping else form, default)
    summary = ((target.__doc__ or "").strip() or target.__name__).splitlines()[0]
    section = pydantic.create_model(target.__name__, __base__=base, __doc__=summary, **fields)
    section.target = target
    return section


class Options(OneOf):
    """Annotation of a section of an option dataclass."""

    def __init__(self, target: type, **settings: Any) -> None:
        super().__init__(lambda _: "options", {"options": section_for(target, **settings)})


class WithKey(OneOf):
    """Annotation of a section with one form that has a key (and other values), and another form without it."""

    def __init__(self, key: str, form: Any, otherwise: Any, **also: Any) -> None:
        def choose(value: Any) -> str:
            read = value.get if isinstance(value, Mapping) else partial(getattr, value)
            keys = value if isinstance(value, Mapping) else getattr(type(value), "model_fields", {})
            return key if key in keys and all(read(k, None) == v for k, v in also.items()) else "otherwise"

        super().__init__(choose, {key: form, "otherwise": otherwise})


def _form(hint: Any, name: str) -> tuple[Any, bool]:
    """Return the annotation of an option of a given type, and whether it can be swept."""
    simple = {float: Number, int: Whole, bool: bool, str: Text, Array: Coefficients}
    origin, arguments = get_origin(hint), get_args(hint)
    if hint in simple:
        # Names of files and columns are not quantities; sweeping them would hide the origin of a result.
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
    """Return the annotation of a tuple of numbers, words or option dataclasses; None for any other tuple."""
    if dataclasses.is_dataclass(items[0]):
        # Nothing in these lists is swept: it would be unclear which of the lists inside belong together.
        item = section_for(items[0], sweeping=False)  # type: ignore[arg-type]
        return Annotated[list[item], Field(min_length=1)]  # type: ignore[valid-type]
    length = None if Ellipsis in items else len(items)
    one: Any = {float: Number, int: Whole, str: Text}.get(items[0])
    return None if one is None else Annotated[list[one], Field(min_length=length or 1, max_length=length)]


def _default(option: dataclasses.Field[Any]) -> Any:
    """Return the default as written in a file."""
    default: Any = option.default
    if option.default_factory is not dataclasses.MISSING:
        default = option.default_factory()
    if default is dataclasses.MISSING:
        return ...
    if dataclasses.is_dataclass(default) and not isinstance(default, type):
        return dataclasses.asdict(default)
    return list(default) if isinstance(default, tuple) else default
