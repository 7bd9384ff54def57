"""Signals held between known instants, which allow exact simulation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import get_args

import numpy as np
from numpy.typing import ArrayLike

from ctid_cli.arrays import Array, ComplexArray
from ctid_cli.errors import DataError
from ctid_cli.signals.band_limited import finer_times, finer_values, periodic_values, values_between
from ctid_cli.signals.checks import freeze
from ctid_cli.signals.data_checks import Rows, check_times
from ctid_cli.signals.treatment import Hold as Hold

#: Instants closer than this fraction of the shortest break interval count as the same instant: ``k * 0.05`` and
#: ``j * 0.5`` may be the same instant and differ in the last bit.
COINCIDENCE = 1e-9
#: A clock counts as regular if all instants are within this fraction of the interval from the regular grid.
REGULARITY = 1e-7


def regular_interval(t: Array) -> float | None:
    """Return the interval of a regular clock [s]; None if the clock is irregular."""
    if t.size < 2:
        return None
    interval = float((t[-1] - t[0]) / (t.size - 1))
    grid = t[0] + interval * np.arange(t.size)
    # Large times have rounding errors, which do not make a clock irregular.
    tolerance = REGULARITY * interval + 4 * np.finfo(float).eps * float(np.abs(t).max())
    return interval if float(np.abs(t - grid).max()) <= tolerance else None


@dataclass(frozen=True, eq=False)
class HeldSignal:
    """A signal given at break times and held between them; zero before the first break.

    Parameters
    ----------
    t : ndarray, shape (M,)
        Break times [s], strictly increasing.
    values : ndarray, shape (M,)
        Values at the break times [input unit].
    hold : {"zoh", "foh", "band-limited"}
        ``zoh`` keeps each value until the next break; ``foh`` joins the values by straight lines; ``band-limited``
        has no power above half the sampling frequency, as signals behind an anti-alias filter, and needs a regular
        clock. After the last break all keep the last value.
    assumed : bool, default False
        Whether the hold was not given: estimators compare a smooth signal as ``zoh`` and as ``foh``.

    Raises
    ------
    DataError
        If the arrays differ in length, hold non-finite numbers, or the times do not increase; or if a band-limited
        signal has no regular clock.
    """

    t: Array
    values: Array
    hold: Hold = "zoh"
    assumed: bool = False

    def __post_init__(self) -> None:
        t = np.array(self.t, dtype=float)
        values = np.array(self.values, dtype=float)
        if t.ndim != 1 or t.shape != values.shape or t.size == 0:
            shapes = f"{t.shape} and {values.shape}"
            raise DataError(f"a held signal needs times and values of one equal, non-zero length; got {shapes}")
        if self.hold not in get_args(Hold):
            raise DataError(f"hold must be 'zoh', 'foh' or 'band-limited', not {self.hold!r}")
        if not np.isfinite(values).all():
            raise DataError(f"{Rows().at(int(np.argmin(np.isfinite(values))))}the input is not a finite number")
        check_times(t, "the time of the input", Rows())
        if self.hold == "band-limited" and regular_interval(t) is None:
            raise DataError("a band-limited input needs a regular clock; take straight lines between its samples (foh)")
        freeze(self, t=t, values=values)

    def __repr__(self) -> str:
        return f"HeldSignal({self.t.size} values from {self.t[0]:g} to {self.t[-1]:g} s, {self.hold})"

    @cached_property
    def slack(self) -> float:
        """Tolerance for instants that count as the same [s]."""
        return COINCIDENCE * float(np.diff(self.t).min()) if self.t.size > 1 else 0.0

    @cached_property
    def lines(self) -> HeldSignal:
        """The signal for exact simulation: itself, or for a band-limited one, straight lines on a finer clock."""
        return self._finer(finer_values) if self.hold == "band-limited" else self

    @cached_property
    def periodic_lines(self) -> HeldSignal:
        """Straight lines of a signal that repeats one interval after its last sample."""
        return self._finer(periodic_values, periodic=True) if self.hold == "band-limited" else self

    @cached_property
    def _between(self) -> HeldSignal:
        """The values of a band-limited signal on a clock fine enough for straight lines."""
        return self._finer(values_between)

    def _finer(self, values_of: Callable[[Array], Array], *, periodic: bool = False) -> HeldSignal:
        return HeldSignal(finer_times(self.t, periodic=periodic), values_of(self.values), "foh")

    @cached_property
    def mean(self) -> float:
        """Mean of the values at the breaks [input unit]."""
        return float(self.values.mean())

    def at(self, times: ArrayLike) -> Array:
        """Return the signal at given instants, with the right-hand limit at a jump.

        Parameters
        ----------
        times : array_like, shape (N,)
            Instants [s].

        Returns
        -------
        ndarray, shape (N,)
            Values [input unit]; zero before the first break.
        """
        if self.hold == "band-limited":
            return self._between.at(times)
        instants = np.asarray(times, dtype=float)
        index = np.searchsorted(self.t, instants + self.slack, side="right") - 1
        if self.hold == "zoh":
            held = self.values[np.maximum(index, 0)]
        else:
            held = np.interp(instants, self.t, self.values)
        return np.where(index < 0, 0.0, held)


def hold_factor(hold: Hold, frequencies: Array, interval: float) -> ComplexArray:
    """Return the spectrum of a held input divided by that of its samples."""
    across = np.sinc(frequencies * interval / (2 * np.pi))
    if hold == "zoh":
        return np.asarray(across * np.exp(-0.5j * frequencies * interval))
    return np.asarray(across**2 if hold == "foh" else np.ones(frequencies.size), dtype=np.complex128)
