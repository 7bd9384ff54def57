"""Options that hold one number for each tone, bounds of frequencies, and times that are counted in samples."""

from __future__ import annotations

from collections.abc import Sequence

from ctid_cli.signals.checks import require_not_negative, require_positive

#: A sample larger than this counts as missing: its powers would overflow.
LARGEST_SAMPLE = 1e30


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


def samples_in(duration: float, interval: float) -> int:
    """Sampling intervals nearest to a time, however long it is.

    Parameters
    ----------
    duration : float
        Time [s].
    interval : float
        Sampling interval [s].

    Returns
    -------
    int
        No more than a counter of samples can hold.

    Examples
    --------
    >>> samples_in(2.0, 0.01), samples_in(1e300, 0.01) == 1 << 62
    (200, True)
    """
    return round(min(duration / interval, float(1 << 62)))


def require_bounds(lowest: float, highest: float | None) -> None:
    """Refuse bounds of frequencies that leave nothing between them.

    Parameters
    ----------
    lowest : float
        Option ``lowest_frequency`` [rad/s].
    highest : float or None
        Option ``highest_frequency`` [rad/s]; None for no bound.

    Raises
    ------
    ValueError
        If the lower one is negative, or not below the upper one.
    """
    require_not_negative("lowest_frequency", lowest, "rad/s")
    if highest is None:
        return
    require_positive("highest_frequency", highest, "rad/s")
    if lowest >= highest:
        raise ValueError(f"lowest_frequency ({lowest:g} rad/s) must be below highest_frequency ({highest:g} rad/s).")
