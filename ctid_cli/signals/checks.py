"""Checks shared by option dataclasses; each error message is one full sentence.

The sentence begins with the name of the option, or with a more specific label.
"""

import math
import types
from dataclasses import fields
from functools import cache
from numbers import Integral, Real
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np

from ctid_cli.errors import OptionError


def require_positive(name: str, value: float, unit: str, label: str = "") -> None:
    """Refuse anything but a positive finite number."""
    if not _is_number(value) or not value > 0:
        raise OptionError(name, f"{label or name} must be a positive number [{unit}], not {value!r}.")


def require_not_negative(name: str, value: float, unit: str, label: str = "") -> None:
    """Refuse anything but zero or a positive finite number."""
    if not _is_number(value) or value < 0:
        raise OptionError(name, f"{label or name} must be zero or a positive number [{unit}], not {value!r}.")


def require_share(name: str, value: float, label: str = "", *, whole: bool = True) -> None:
    """Refuse anything but a number above 0 and at most 1, or below 1."""
    if not _is_number(value) or not 0 < value <= 1 or (value == 1 and not whole):
        most = "at most" if whole else "below"
        raise OptionError(name, f"{label or name} must be a number above 0 and {most} 1 [-], not {value!r}.")


def require_finite(name: str, value: float, unit: str, label: str = "") -> None:
    """Refuse anything but a finite number."""
    if not _is_number(value):
        raise OptionError(name, f"{label or name} must be a finite number [{unit}], not {value!r}.")


def require_integer(name: str, value: int, lowest: int, highest: int | None = None, label: str = "") -> None:
    """Refuse anything but an integer within bounds."""
    whole = isinstance(value, Integral) and not isinstance(value, bool)
    if not whole or value < lowest or (highest is not None and value > highest):
        allowed = f"of at least {lowest}" if highest is None else f"from {lowest} to {highest}"
        raise OptionError(name, f"{label or name} must be an integer {allowed}, not {value!r}.")


def require_choice(name: str, value: str, allowed: tuple[str, ...]) -> None:
    """Refuse anything but one of some words."""
    if value not in allowed:
        raise OptionError(name, f"{name} must be {' or '.join(map(repr, allowed))}, not {value!r}.")


def freeze(owner: object, **values: object) -> None:
    """Set fields of a frozen dataclass; arrays become read-only."""
    for name, value in values.items():
        if isinstance(value, np.ndarray):
            value.setflags(write=False)
        object.__setattr__(owner, name, value)


class Checked:
    """Base of option dataclasses whose annotations define the allowed values.

    A number is annotated with its check and the further arguments of the check, as in
    ``Annotated[float, require_positive, "s"]``; words are a ``Literal``. Each item of a tuple is checked, and lists are
    accepted as tuples.
    """

    def __post_init__(self) -> None:
        kind: Any = type(self)
        hints = _hints(kind)
        for option in fields(self):  # type: ignore[arg-type]  # of subclasses, which are dataclasses
            value = _checked(option.name, getattr(self, option.name), hints[option.name])
            object.__setattr__(self, option.name, value)


@cache
def _hints(kind: Any) -> dict[str, Any]:
    return get_type_hints(kind, include_extras=True)


def _checked(name: str, value: Any, hint: Any, label: str = "") -> Any:
    """Return the value of an option; refuse what its annotation does not allow."""
    origin, parts = get_origin(hint), get_args(hint)
    if origin is Annotated:
        parts[1](name, value, *parts[2:], label=label)
    elif origin is Literal:
        require_choice(name, value, parts)
    elif origin in (Union, types.UnionType) and value is not None:  # optional values
        return _checked(name, value, parts[0])
    elif origin is tuple:
        return tuple(_checked(name, item, parts[0], f"each of the {name}") for item in value)
    return value


def _is_number(value: object) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)
