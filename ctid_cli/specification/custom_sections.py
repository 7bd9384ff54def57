"""Sections of custom components, and of components selected by their kind."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

from pydantic import PlainValidator, ValidationInfo, WithJsonSchema

from ctid_cli.custom_code import CustomCodeError, find_class, reason
from ctid_cli.frequency.base import FrequencyEstimator
from ctid_cli.kinds import classes
from ctid_cli.signals.excitation import Excitation
from ctid_cli.signals.sampling import Sampling
from ctid_cli.simulation.components import Estimator, Measure, Noise, System
from ctid_cli.specification.messages import Violation, several_wrong
from ctid_cli.specification.sections import Section, section_for
from ctid_cli.specification.sweeps import variants
from ctid_cli.specification.values import ByShape, Name, Number, OneOf, Text
from ctid_cli.text import did_you_mean

#: Base class of custom components, and its required methods with their arguments.
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
    """Return the annotation for sections of a custom component."""

    def validated(value: Any, info: ValidationInfo) -> Section:
        if isinstance(value, Section):
            return value
        context = info.context or {}
        wanted = "frequency_estimator" if part == "estimator" and context.get("of_signal") else part
        try:
            target = find_class(str(value["kind"]), context.get("folder", Path()))
            form = _custom_section(target, wanted, value["kind"])
        except CustomCodeError as error:
            raise several_wrong("custom", [(("kind",), str(error))]) from None
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
    """Return the section of a custom class; refuse a class without the required methods or base class."""
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
    # Evaluating the annotations of a custom class can raise any exception.
    except Exception as error:
        raise CustomCodeError(f"the options of {name} cannot be read: {reason(error)}") from None


class CustomSection(Section):
    """Options of a custom component."""

    custom: ClassVar[bool] = True

    def violations(self) -> Iterator[Violation]:
        """Yield a problem if the component cannot be sent to worker processes."""
        from joblib.externals.loky.backend.reduction import dumps

        try:
            dumps(variants(self)[0].options)
        except Exception as error:
            yield ("kind",), f"cannot be sent to worker processes: {reason(error)}; keep only plain data in options"


class CustomMeasureSection(CustomSection):
    """Options of a custom measure, and its name.

    Parameters
    ----------
    name : str, optional
        name in tables; by default that of its class
    """

    name: Name


class CustomSystemSection(CustomSection):
    """Options of a custom system, and its true values.

    Parameters
    ----------
    truth : mapping, optional
        true values of the estimated quantities, by name; the name of an option stands for its value
    """

    truth: dict[str, Annotated[float | str, ByShape(Number, "the name of an option is allowed too", text=Text)]] = {}  # noqa: RUF012

    def violations(self) -> Iterator[Violation]:
        """Yield invalid true values."""
        yield from super().violations()
        fields = {name: getattr(self, name) for name in type(self).model_fields}
        numbers = [name for name, value in fields.items() if isinstance(value, (int, float, list))]
        for name, value in self.truth.items():
            if isinstance(value, str) and value not in numbers:
                hint = did_you_mean(value, numbers) or ";"
                known = ", ".join(numbers)
                yield ("truth", name), f"{value!r} is no option that is a number{hint} options: {known}"


class Kinds(OneOf):
    """Annotation of a section with one of several kinds, or a custom one if allowed."""

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
