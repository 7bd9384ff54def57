"""Results as plain data without loss: every number to its last bit, every array with its shape.

What is read back is what the annotations of the result's classes name, and nothing else: a file cannot ask for a class.
"""

import dataclasses
import math
import types
from collections.abc import Mapping, Sequence
from enum import Enum
from functools import cache
from typing import Any, Literal, NoReturn, Union, get_args, get_origin, get_type_hints

import numpy as np

from ctid_cli.errors import DataError
from ctid_cli.inference.fit import DeferredFields

#: Numbers that JSON does not have.
_NOT_FINITE = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}


def encoded(value: Any) -> Any:
    """A result as JSON can hold it, without what it computes later."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        kept = {name: encoded(getattr(value, name)) for name in _hints(type(value))}
        return {"type": type(value).__name__, **kept}
    if isinstance(value, np.ndarray):
        numbers = [_number(item) for item in value.ravel().tolist()]
        return numbers if value.ndim == 1 else {"shape": list(value.shape), "values": numbers}
    if isinstance(value, Enum):
        return value.name
    if isinstance(value, tuple | list):
        return [encoded(item) for item in value]
    return _number(value.item() if isinstance(value, np.generic) else value)


def _number(value: Any) -> Any:
    if isinstance(value, complex):
        return [_number(value.real), _number(value.imag)]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value


def decoded(content: Any, hint: Any, place: str = "result") -> Any:
    """The value of an annotation that was encoded."""
    origin, choices = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return _one_of(content, choices, place)
    if origin is Literal:
        return content if content in choices else _refuse(place)
    if origin is np.ndarray:
        return _array(content, np.dtype(get_args(choices[1])[0]), place)
    if origin in (tuple, Sequence):
        return _sequence(content, choices, place)
    if isinstance(hint, type) and dataclasses.is_dataclass(hint):
        return _instance(content, hint, place)
    if isinstance(hint, type) and hasattr(hint, "_fields"):
        return hint(*_sequence(content, list(get_type_hints(hint).values()), place))
    if isinstance(hint, type) and issubclass(hint, Enum):
        return hint[content] if isinstance(content, str) and content in hint.__members__ else _refuse(place)
    return _plain(content, hint, place)


def _one_of(content: Any, choices: Sequence[Any], place: str) -> Any:
    if content is None and type(None) in choices:
        return None
    left = [choice for choice in choices if choice is not type(None)]
    if isinstance(content, Mapping) and len(left) > 1:
        left = [choice for choice in left if getattr(choice, "__name__", "") == content.get("type")]
    return decoded(content, left[0], place) if left else _refuse(place)


def _sequence(content: Any, choices: Sequence[Any], place: str) -> tuple[Any, ...]:
    if not isinstance(content, list):
        _refuse(place)
    if choices and choices[-1] is not Ellipsis and len(choices) > 1 and len(choices) != len(content):
        _refuse(place)
    hints = choices if len(choices) == len(content) and Ellipsis not in choices else [choices[0]] * len(content)
    return tuple(
        decoded(item, each, f"{place}[{k}]") for k, (item, each) in enumerate(zip(content, hints, strict=True))
    )


def _array(content: Any, dtype: Any, place: str) -> Any:
    shape = content.get("shape") if isinstance(content, Mapping) else None
    values = content.get("values") if isinstance(content, Mapping) else content
    one: Any = {"f": float, "c": complex, "b": bool}.get(dtype.kind, int)
    array = np.array(_sequence(values, (one, Ellipsis), place), dtype=dtype)
    return array if shape is None else array.reshape(_sequence(shape, (int, Ellipsis), place))


def _instance(content: Any, kind: type, place: str) -> Any:
    hints = _hints(kind)
    if not isinstance(content, Mapping) or set(content) != {"type", *hints} or content["type"] != kind.__name__:
        _refuse(place)
    values = {name: decoded(content[name], hint, f"{place}.{name}") for name, hint in hints.items()}
    late = dict.fromkeys(kind.deferred, ()) if issubclass(kind, DeferredFields) else {}
    return kind(**values, **late)


def _plain(content: Any, hint: Any, place: str) -> Any:
    if hint is float and isinstance(content, str) and content in _NOT_FINITE:
        return _NOT_FINITE[content]
    if hint is complex and isinstance(content, list) and len(content) == 2:
        return complex(*(_plain(part, float, place) for part in content))
    if hint is float and isinstance(content, int) and not isinstance(content, bool):
        return content
    return content if type(content) is hint else _refuse(place)


@cache
def _hints(kind: type) -> dict[str, Any]:
    """The fields that are written, with their annotations."""
    late = kind.deferred if issubclass(kind, DeferredFields) else ()
    hints = get_type_hints(kind)
    return {each.name: hints[each.name] for each in dataclasses.fields(kind) if each.init and each.name not in late}


def _refuse(place: str) -> NoReturn:
    raise DataError(f"{place} is not what a fit has there")
