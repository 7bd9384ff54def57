"""Values of a specification: numbers, words, and annotations of values with several forms."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Annotated, Any, Union

from pydantic import AfterValidator, BaseModel, Discriminator, Field, GetCoreSchemaHandler, Tag
from pydantic_core import CoreSchema

from ctid_cli.specification.messages import HINT, TAG, several_wrong, shown, wrong

#: Largest whole number that fits into a column of a table or archive.
MAX_WHOLE = 2**63 - 1


def _representable(value: int) -> int:
    if abs(value) > MAX_WHOLE:
        raise wrong(f"must be a whole number of at most {MAX_WHOLE}, not {value}")
    return value


#: Maps -0.0 to 0.0, which must have the same text.
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
    """Annotation of a value with one of several forms, selected by the result of `choose`; None is refused."""

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
    """Annotation of a value with a usual form, and other forms for lists, mappings or texts."""

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
    """Return the values; refuse duplicates."""
    seen: set[str] = set()
    for k, item in enumerate(values):
        # Lists and sections are not hashable; equal ones have equal text.
        text = repr(item + 0.0 if type(item) in (int, float) else item)
        if text in seen:
            raise several_wrong("list", [((k,), f"{called(item)} is in this list twice; keep one of them")])
        seen.add(text)
    return values
