"""Sections of a specification: pydantic models that explain in plain words what is wrong, everything at once.

A section for an option dataclass is made from the class: types and defaults from its fields, descriptions and units
from its docstring. Every scalar option may be a list of values to sweep, or a mapping ``{geometric: …}`` where the
metadata of the field say so.
"""

from __future__ import annotations

import dataclasses
import inspect
import itertools
import json
import math
import re
import types
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
import pydantic
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    GetCoreSchemaHandler,
    PlainValidator,
    Tag,
    ValidationError,
    ValidationInfo,
    WithJsonSchema,
)
from pydantic_core import CoreSchema

from ctid_cli.arrays import Array
from ctid_cli.custom_code import CustomCodeError, find_class, reason
from ctid_cli.errors import CtidError, OptionError
from ctid_cli.frequency.base import FrequencyEstimator
from ctid_cli.kinds import classes
from ctid_cli.signals.excitation import Excitation
from ctid_cli.signals.sampling import Sampling, geometric_sizes
from ctid_cli.simulation.components import Estimator, Measure, Noise, System
from ctid_cli.specification.messages import HINT, TAG, Complaint, explained, option_docs, several_wrong, shown, wrong
from ctid_cli.specification.yaml_source import KeyPath
from ctid_cli.text import did_you_mean

#: Combinations that one section may sweep, and data cells that one experiment may hold.
MAX_COMBINATIONS = 100_000
#: Whole numbers beyond this fit no column of a table or archive.
MAX_WHOLE = 2**63 - 1

AnySection = TypeVar("AnySection", bound="Section")
#: A complaint, and the swept values that it is about.
Failure = tuple[KeyPath, str, Mapping[KeyPath, Any]]


# --------------------------------------------------------------------------------------------------------------------
# Values


def _representable(value: int) -> int:
    if abs(value) > MAX_WHOLE:
        raise wrong(f"must be a whole number of at most {MAX_WHOLE}, not {value}")
    return value


#: -0.0 and 0.0 are one value and must have one text.
_OneZero = AfterValidator(lambda value: value + 0.0)
#: Finite numbers.
Number = Annotated[float, Field(allow_inf_nan=False), _OneZero]
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False), _OneZero]
Whole = Annotated[int, AfterValidator(_representable)]
Text = Annotated[str, Field(min_length=1)]
Coefficients = Annotated[list[Number], Field(min_length=1)]


def matching(pattern: str, rule: str) -> AfterValidator:
    """Refuse a text that does not match a pattern as a whole."""

    def check(value: str) -> str:
        if not re.fullmatch(pattern, value):
            raise wrong(f"{value!r} cannot be used here: {rule}")
        return value

    return AfterValidator(check)


#: Name of an estimator or of a custom measure.
Name = Annotated[str, matching("[A-Za-z0-9_-]{1,60}", "a name has letters, digits, '-' and '_', at most 60 of them")]


class OneOf:
    """Annotation of a value with one of several forms, by the name that `choose` gives to it; None is refused."""

    def __init__(
        self, choose: Callable[[Any], str | None], forms: Mapping[str, Any], error: str = "", allowed: str = ""
    ) -> None:
        def chosen(value: Any) -> str | None:
            name = choose(value)
            return None if name is None else TAG + name

        refusal = ("{allowed}", {"allowed": allowed}) if error else (None, None)
        named = Discriminator(chosen, error or None, *refusal)
        tagged = tuple(Annotated[form, Tag(TAG + name)] for name, form in forms.items())
        self._form = Annotated[Union[tagged], named]  # noqa: UP007 - built at run time

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return handler.generate_schema(self._form)


class ByShape(OneOf):
    """Annotation of a value with a usual form, and another one if it is a list, a mapping or a text."""

    def __init__(self, usual: Any, hint: str = "", **others: Any) -> None:
        name = HINT.removeprefix(TAG) + f" {hint}" if hint else "usual"
        kinds: dict[str, Any] = {"list": list, "text": str, "mapping": (Mapping, BaseModel)}
        shapes = {shape: kinds[shape] for shape in others}
        super().__init__(
            lambda value: next((shape for shape, kind in shapes.items() if isinstance(value, kind)), name),
            {name: usual, **others},
        )


class Swept(ByShape):
    """Annotation of a field that may be a list of values to sweep, or a mapping that stands for such a list."""

    def __init__(self, one: Any, **others: Any) -> None:
        super().__init__(one, list=Annotated[list[one], AfterValidator(_different)], **others)


def _different(values: list[Any]) -> list[Any]:
    if not values:
        raise wrong("an empty list sweeps nothing; give one value, or a list of at least one")
    return without_copies(values, shown)


def without_copies(values: list[Any], called: Callable[[Any], str] = lambda item: "this start") -> list[Any]:
    """Return the values, if none is there twice."""
    seen: set[str] = set()
    for k, item in enumerate(values):
        # Lists and sections have no hash; what is equal reads alike.
        text = repr(item + 0.0 if type(item) in (int, float) else item)
        if text in seen:
            raise several_wrong("list", [((k,), f"{called(item)} is in this list twice; keep one of them", False)])
        seen.add(text)
    return values


# --------------------------------------------------------------------------------------------------------------------
# Sections


class Section(BaseModel):
    """A mapping of the specification."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, validate_default=True, defer_build=True)

    #: Option dataclass that the section describes, if it describes one.
    target: ClassVar[type | None] = None
    #: Sentences for keys that belong to another form of the section.
    elsewhere: ClassVar[Mapping[str, str]] = {}
    #: Whether the option dataclass is one that the user wrote.
    custom: ClassVar[bool] = False
    #: What to say of a section that gives nothing; empty if it may.
    if_empty: ClassVar[str] = ""

    @classmethod
    def descriptions(cls) -> dict[str, str]:
        """Return what the docstring of the section, or of the option dataclass it was made from, says of each key."""
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
            problems += [explained(detail, cls.descriptions()) for detail in error.errors(include_url=False)]
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
        """Say what is wrong with the presence of keys, whatever their values."""
        yield from ()

    def complaints(self) -> Iterator[Complaint]:
        """Say what is wrong with the section although every value, and the options if any, are right by themselves."""
        if self.if_empty and all(getattr(self, name) is None for name in type(self).model_fields):
            yield (), self.if_empty

    def build(self) -> Any:
        """Return the options that the section describes, where nothing is swept."""
        assert self.target is not None
        options = {option.name for option in dataclasses.fields(self.target) if option.init}
        return self.target(**{name: self.part(name) for name in type(self).model_fields if name in options})

    def part(self, name: str) -> Any:
        """Return what an option dataclass is given for a field."""
        return _part(getattr(self, name))

    def options(self) -> Any:
        """Build the options; an OptionError says which of them is refused and why."""
        try:
            with np.errstate(all="ignore"):  # what overflows is refused, or found by the section's own complaints
                return self.build()
        except (Exception, SystemExit) as error:
            if self.custom and not isinstance(error, (ValueError, CtidError)):
                raise OptionError("kind", f"refuses these options: {reason(error)}") from None
            if not isinstance(error, (ValueError, ArithmeticError, CtidError)):
                raise
            message = str(error).strip() or f"these values were refused ({type(error).__name__})"
            raise OptionError("".join(place_of(error, type(self).model_fields)), message) from None


def place_of(error: Exception, options: Container[str]) -> tuple[str, ...]:
    """Return the option that an error is about, if it is about one of them."""
    field = getattr(error, "field", "")
    return (field,) if field in options else ()


def _part(value: Any) -> Any:
    if isinstance(value, Section):
        return value.options()  # which nothing has against it: the section was validated before the one it is in
    return tuple(map(_part, value)) if isinstance(value, list) else value


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
        """Return the numbers."""
        first, last, count = self.geometric
        return geometric_sizes(first, last, count)


def section_for(
    target: type, kind: str = "", *, sweeping: bool = True, without: str = "", base: type[Section] = Section
) -> type[Section]:
    """Return the section of an option dataclass."""
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
    summary = ((target.__doc__ or "").strip() or target.__name__).splitlines()[0]
    section = pydantic.create_model(target.__name__, __base__=base, __doc__=summary, **fields)
    section.target = target
    return section


class Kinds(OneOf):
    """Annotation of a section that is one of several, told apart by its ``kind``, or a custom one where it may be."""

    def __init__(self, *names: str, custom: str = "") -> None:
        forms: dict[str, Any] = {k: section_for(target, k) for name in names for k, target in classes(name).items()}
        allowed = ", ".join(forms) or "./file.py:Class, package.module:Class"
        forms |= {"custom": custom_form(custom)} if custom else {}

        def choose(value: Any) -> str | None:
            kind = value.get("kind") if isinstance(value, Mapping) else getattr(value, "kind", None)
            if custom and isinstance(kind, str) and names_code(kind):
                return "custom"
            return kind if isinstance(kind, str) and kind in forms else None

        super().__init__(choose, forms, "no_kind", allowed)


class Options(OneOf):
    """Annotation of the section of an option dataclass."""

    def __init__(self, target: type, **settings: Any) -> None:
        super().__init__(lambda _: "options", {"options": section_for(target, **settings)})


class WithKey(OneOf):
    """Annotation of a section that has one form with a key (and other values), and another one without it."""

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
    """Return the annotation of a tuple of numbers, words or option dataclasses; None for any other tuple."""
    if dataclasses.is_dataclass(items[0]):
        # A list of such lists would say too little about which of them belong together, so that nothing in it is swept.
        item = section_for(items[0], sweeping=False)  # type: ignore[arg-type]
        return Annotated[list[item], Field(min_length=1)]  # type: ignore[valid-type]
    length = None if Ellipsis in items else len(items)
    one: Any = {float: Number, int: Whole, str: Text}.get(items[0])
    return None if one is None else Annotated[list[one], Field(min_length=length or 1, max_length=length)]


def _default(option: dataclasses.Field[Any]) -> Any:
    """Return the default as a file would give it."""
    default: Any = option.default
    if option.default_factory is not dataclasses.MISSING:
        default = option.default_factory()
    if default is dataclasses.MISSING:
        return ...
    if dataclasses.is_dataclass(default) and not isinstance(default, type):
        return dataclasses.asdict(default)
    return list(default) if isinstance(default, tuple) else default


# --------------------------------------------------------------------------------------------------------------------
# Custom components


#: The base class of custom components, and the methods of which it needs one, with what they are given.
CONTRACTS: dict[str, tuple[type, dict[str, tuple[str, ...]]]] = {
    "estimator": (Estimator, {"fit": ("record", "start")}),
    "measure": (Measure, {"value": ("fit", "data")}),
    "excitation": (Excitation, {"generate": ("times", "rng")}),
    "frequency_estimator": (FrequencyEstimator, {"track": ("samples", "interval")}),
    "noise": (Noise, {"generate": ("output", "rng"), "generate_at": ("times", "output", "rng")}),
    "sampling": (Sampling, {"times": ("rng",)}),
    "system": (System, {"simulate": ("input", "times")}),
}


def names_code(kind: str) -> bool:
    """Return whether a kind names a file or a module."""
    return ":" in kind


def custom_form(part: str) -> Any:
    """Return the annotation of the section of a custom component."""

    def validated(value: Any, info: ValidationInfo) -> Section:
        if isinstance(value, Section):
            return value
        context = info.context or {}
        wanted = "frequency_estimator" if part == "estimator" and context.get("of_signal") else part
        try:
            target = find_class(str(value["kind"]), context.get("folder", Path()))
            form = _custom_section(target, wanted, value["kind"])
        except CustomCodeError as error:
            raise several_wrong("custom", [(("kind",), str(error), False)]) from None
        given = {"name": target.__name__, **value} if part == "measure" else value
        return form.model_validate(given, context=info.context)

    schema = {
        "type": "object",
        "description": "A custom component: './file.py:Class' or 'package.module:Class', and its options",
        "properties": {"kind": {"type": "string", "pattern": ":"}},
        "required": ["kind"],
    }
    return Annotated[Any, PlainValidator(validated), WithJsonSchema(schema)]


def _custom_section(target: type[Any], part: str, kind: str) -> type[Section]:
    """Return the section of a custom class, if it is what this part of a specification needs."""
    name, (base, methods) = target.__name__, CONTRACTS[part]
    wanted = " or ".join(f"{method}(self, {', '.join(given)})" for method, given in methods.items())
    if part != "estimator" and not issubclass(target, base):
        raise CustomCodeError(f"{name} is no ctid_cli.{base.__name__}; derive it from that, with {wanted}")
    written = {method: getattr(target, method, None) for method in methods}
    written = {method: call for method, call in written.items() if call is not getattr(base, method)}
    if not any(map(callable, written.values())):
        raise CustomCodeError(f"{name} has no method {' or '.join(methods)}; this kind needs {wanted}")
    for method, call in written.items():
        try:
            inspect.signature(call).bind(None, *methods[method])  # type: ignore[arg-type]
        except (TypeError, ValueError):
            raise CustomCodeError(f"{name}.{method} cannot be called so; this kind needs {wanted}") from None
    if "__dataclass_fields__" not in vars(target):
        inherited = dataclasses.is_dataclass(target)
        if vars(target).get("__annotations__") or (target.__init__ is not object.__init__ and not inherited):
            raise CustomCodeError(f"{name} is no dataclass; write @dataclass(frozen=True) above it")
        target = target if inherited else dataclass(frozen=True)(target)
    start_from = getattr(target, "start_from", None)
    if part == "estimator" and start_from not in (None, "delay", "parameters"):
        raise CustomCodeError(f"{name}.start_from must be None, 'delay' or 'parameters', not {start_from!r}")
    unit = getattr(target, "unit", None)
    if part == "measure" and not isinstance(unit, str):
        raise CustomCodeError(f"{name}.unit must be a text, such as '%' or 'rad/s', not {unit!r}")
    forms: dict[str, type[CustomSection]] = {"system": CustomSystemSection, "measure": CustomMeasureSection}
    form = forms.get(part, CustomSection)
    for option in (option.name for option in dataclasses.fields(target)):
        if option in {"kind", *form.model_fields, *dir(CustomSection)} or option.startswith(("_", "model_")):
            raise CustomCodeError(f"{name}: an option cannot be called {option!r} here; rename it")
    try:
        return section_for(target, kind, base=form, sweeping=part != "measure")
    # Whatever is wrong with the annotations of a class that somebody wrote.
    except Exception as error:
        raise CustomCodeError(f"the options of {name} cannot be read: {reason(error)}") from None


class CustomSection(Section):
    """Options of a custom component."""

    custom: ClassVar[bool] = True

    def complaints(self) -> Iterator[Complaint]:
        """Say that worker processes cannot be given the component."""
        from joblib.externals.loky.backend.reduction import dumps

        try:
            dumps(variants(self)[0].options)
        except Exception as error:
            yield ("kind",), f"cannot be sent to worker processes: {reason(error)}; keep only plain data in options"


class CustomMeasureSection(CustomSection):
    """Options of a custom measure, and what it is called.

    Parameters
    ----------
    name : str, optional
        what tables call it; by default like its class
    """

    name: Name


class CustomSystemSection(CustomSection):
    """Options of a custom system, and what is true of it.

    Parameters
    ----------
    truth : mapping, optional
        true values of what is estimated, by name; the name of an option stands for its value
    """

    truth: dict[str, Annotated[float | str, ByShape(Number, "the name of an option is allowed too", text=Text)]] = {}

    def complaints(self) -> Iterator[Complaint]:
        """Say which true values are none."""
        yield from super().complaints()
        fields = {name: getattr(self, name) for name in type(self).model_fields}
        numbers = [name for name, value in fields.items() if isinstance(value, (int, float, list))]
        for name, value in self.truth.items():
            if isinstance(value, str) and value not in numbers:
                hint = did_you_mean(value, numbers) or ";"
                known = ", ".join(numbers)
                yield ("truth", name), f"{value!r} is no option that is a number{hint} options: {known}"


# --------------------------------------------------------------------------------------------------------------------
# Sweeps


@dataclass(frozen=True)
class Variant:
    """One combination of a section's swept values."""

    values: dict[str, Any]
    swept: dict[KeyPath, Any]
    options: Any


def variants(section: Section | None) -> list[Variant]:
    """Return all combinations of a section's swept values, the last one changing fastest; none of no section."""
    if section is None:
        return []
    return [Variant(one.model_dump(mode="json"), swept, one.options()) for swept, one in _combinations(section)]


def known_variants(section: Section | None) -> list[Variant]:
    """Return the same, but none of a custom component: what its options mean is not known."""
    return [] if section is None or section.custom else variants(section)


def case_count(section: Any) -> int:
    """Return the number of combinations of a section's swept values, before any of them is made."""
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
    """Return a section with another value at a place in it."""
    name = str(path[0])
    inner = value if len(path) == 1 else replaced(getattr(section, name), path[1:], value)
    return section.model_copy(update={name: inner})


def _option_complaints(section: Section) -> list[Complaint]:
    """Return what the option dataclass, if any, has against the values of a section."""
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
                # Point at the offending item of the list; its value then needs no repetition.
                failures.append(((*path, axes[path].index(swept[path])), str(refused), {}))
            else:
                failures.append((path, str(refused), swept))
    return grouped(failures, tried)


def grouped(failures: Iterable[Failure], tried: Sequence[Mapping[KeyPath, Any]]) -> list[Complaint]:
    """Return complaints about combinations, each once, with the swept values that decide on it."""
    groups: dict[Complaint, list[Mapping[KeyPath, Any]]] = {}
    for path, message, swept in failures:
        groups.setdefault((path, message), []).append(swept)
    complaints: list[Complaint] = []
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
        complaints.append((path, message))
    return complaints


def _texts(name: KeyPath, swept: Iterable[Mapping[KeyPath, Any]]) -> set[str]:
    return {json.dumps(one[name]) for one in swept}


def over(
    sections: Mapping[KeyPath, Sequence[Variant]],
    check: Callable[..., Iterable[Complaint]],
    at_most: int | None = None,
) -> list[Complaint]:
    """Return what a check of options says about the combinations of several sections' variants.

    Swept values are called by the place that their section's variants are given under.
    """
    failures: list[Failure] = []
    tried: list[Mapping[KeyPath, Any]] = []
    for case in itertools.islice(itertools.product(*sections.values()), at_most):
        tried.append(swept_in(dict(zip(sections, case, strict=True))))
        failures += [(path, text, tried[-1]) for path, text in check(*(variant.options for variant in case))]
    return grouped(failures, tried)


def swept_in(case: Mapping[KeyPath, Variant]) -> dict[KeyPath, Any]:
    """Return the swept values of a combination of several sections' variants, by their places."""
    return {(*at, *path): value for at, variant in case.items() for path, value in variant.swept.items()}
