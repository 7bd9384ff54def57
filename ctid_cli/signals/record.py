"""One experiment's data: output samples and the held input that caused them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctid_cli.errors import DataError
from ctid_cli.signals.held import HeldSignal, Hold

#: A clock counts as regular when no instant is further than this fraction of the interval from its place.
REGULARITY = 1e-7


@dataclass(frozen=True, eq=False)
class Record:
    """Output samples, their instants, and the held input.

    Parameters
    ----------
    t : ndarray, shape (N,)
        Instants of the output samples [s], strictly increasing.
    y : ndarray, shape (N,)
        Output samples [output unit]; a NaN is a masked (missing) sample.
    input : HeldSignal
        The input on its own break times [s].
    noise_free : ndarray, shape (N,), optional
        The output without noise [output unit], known only for simulated records.
    name : str, default ""
        Where the record comes from; appears in messages.

    Raises
    ------
    DataError
        If the record is empty, its times do not increase strictly, or no output is finite.

    Notes
    -----
    Arrays are copied and made read-only: a record never changes, and never changes its owner's data.
    """

    t: NDArray[np.float64]
    y: NDArray[np.float64]
    input: HeldSignal
    noise_free: NDArray[np.float64] | None = None
    name: str = ""

    def __post_init__(self) -> None:
        t = np.array(self.t, dtype=float)
        y = np.array(self.y, dtype=float)
        where = f"{self.name}: " if self.name else ""
        if t.ndim != 1 or t.shape != y.shape:
            raise DataError(
                f"{where}times and outputs must be one-dimensional and of equal length; got {t.shape} and {y.shape}"
            )
        if t.size == 0:
            raise DataError(f"{where}the record is empty")
        if not np.isfinite(t).all():
            raise DataError(f"{where}time of sample {int(np.argmin(np.isfinite(t)))} is not a finite number")
        if not (np.diff(t) > 0).all():
            k = int(np.argmin(np.diff(t) > 0))
            raise DataError(
                f"{where}times must increase strictly; samples {k} and {k + 1} are at {t[k]:g} s and {t[k + 1]:g} s"
            )
        if np.isinf(y).any():
            k = int(np.argmax(np.isinf(y)))
            raise DataError(f"{where}output of sample {k} is infinite; mark missing samples as NaN")
        if not np.isfinite(y).any():
            raise DataError(f"{where}no output sample is a finite number")
        t.setflags(write=False)
        y.setflags(write=False)
        object.__setattr__(self, "t", t)
        object.__setattr__(self, "y", y)

    @classmethod
    def from_arrays(cls, t: ArrayLike, u: ArrayLike, y: ArrayLike, hold: Hold = "zoh", name: str = "") -> Record:
        """Record whose input is known at the instants of the output.

        Parameters
        ----------
        t : array_like, shape (N,)
            Sampling instants [s].
        u : array_like, shape (N,)
            Input samples [input unit].
        y : array_like, shape (N,)
            Output samples [output unit]; NaN marks a missing sample.
        hold : {"zoh", "foh"}, default "zoh"
            How the input behaves between its samples.
        name : str, default ""
            Appears in messages.

        Returns
        -------
        Record
            The record.
        """
        times = np.asarray(t, dtype=float)
        return cls(times, np.asarray(y, dtype=float), HeldSignal(times, np.asarray(u, dtype=float), hold), name=name)

    @property
    def n_samples(self) -> int:
        """Number of output samples, masked ones included."""
        return int(self.t.size)

    @property
    def duration(self) -> float:
        """Time from the first to the last output sample [s]."""
        return float(self.t[-1] - self.t[0])

    @cached_property
    def valid(self) -> NDArray[np.bool_]:
        """Which output samples are present, shape (N,)."""
        return np.isfinite(self.y)

    @cached_property
    def bridged_y(self) -> NDArray[np.float64]:
        """Outputs with missing samples bridged by straight lines [output unit], shape (N,)."""
        if self.valid.all():
            return self.y
        return np.asarray(np.interp(self.t, self.t[self.valid], self.y[self.valid]), dtype=float)

    @cached_property
    def interval(self) -> float | None:
        """Sampling interval [s] if the output clock is regular, else None."""
        return regular_interval(self.t)

    @cached_property
    def input_on_grid(self) -> bool:
        """Whether the input's breaks are the output's (regular) sampling instants."""
        if self.interval is None or self.input.t.size != self.t.size:
            return False
        return bool(np.abs(self.input.t - self.t).max() <= REGULARITY * self.interval)


def regular_interval(t: NDArray[np.float64]) -> float | None:
    """Interval of a regular clock.

    Parameters
    ----------
    t : ndarray, shape (N,)
        Instants [s], strictly increasing.

    Returns
    -------
    float or None
        The interval [s], or None where the instants stray from an equidistant grid.
    """
    if t.size < 2:
        return None
    interval = float((t[-1] - t[0]) / (t.size - 1))
    grid = t[0] + interval * np.arange(t.size)
    # Large times carry their own rounding, which is no sign of an irregular clock.
    tolerance = REGULARITY * interval + 4 * np.finfo(float).eps * float(np.abs(t).max())
    return interval if float(np.abs(t - grid).max()) <= tolerance else None
