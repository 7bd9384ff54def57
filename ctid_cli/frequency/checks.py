"""Checks of options that hold one number for each tone."""

from __future__ import annotations

from collections.abc import Sequence

from ctid_cli.signals.checks import require_positive


def one_for_each(name: str, values: Sequence[float] | None, count: int, unit: str) -> tuple[float, ...] | None:
    """Check an option that holds one positive number for each tone.

    Parameters
    ----------
    name : str
        The option as the user writes it.
    values : sequence of float or None
        What was given.
    count : int
        Number of tones.
    unit : str
        Unit of the numbers.

    Returns
    -------
    tuple of float or None
        The numbers.

    Raises
    ------
    ValueError
        If there are too few or too many, or one is not positive.
    """
    if values is None:
        return None
    numbers = tuple(float(value) for value in values)
    if len(numbers) != count:
        raise ValueError(f"{name} must hold one number for each of the {count} tones, not {values!r}.")
    for number in numbers:
        require_positive(name, number, unit)
    return numbers
