"""Checks that the option dataclasses share; each failure is one full sentence for the user.

The sentence begins with the name of the option, or with a label that says more.
"""

from __future__ import annotations

import math
from numbers import Integral, Real

from ctid_cli.errors import OptionError


def require_positive(name: str, value: float, unit: str, label: str = "") -> None:
    """Refuse anything but a positive finite number."""
    if not _is_number(value) or not value > 0:
        raise OptionError(name, f"{label or name} must be a positive number [{unit}], not {value!r}.")


def require_not_negative(name: str, value: float, unit: str, label: str = "") -> None:
    """Refuse anything but zero or a positive finite number."""
    if not _is_number(value) or value < 0:
        raise OptionError(name, f"{label or name} must be zero or a positive number [{unit}], not {value!r}.")


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


def _is_number(value: object) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)
