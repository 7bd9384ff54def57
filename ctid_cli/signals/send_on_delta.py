"""Samples that a sensor sends when its output has moved."""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numba import njit

from ctid_cli.arrays import Array, IndexArray
from ctid_cli.errors import DataError, OptionError
from ctid_cli.signals.checks import require_positive
from ctid_cli.signals.held import COINCIDENCE
from ctid_cli.signals.sampling import InputRecord, OfInterval


@dataclass(frozen=True)
class SendOnDelta(OfInterval):
    """Samples when the measured output has moved by a threshold since the last one, from 0 s.

    Parameters
    ----------
    interval : float
        Interval at which the sensor looks at the output [s].
    samples : int
        Number of looks, at least 2: the most samples that there can be.
    delta : float
        Change of the measured output, noise included, that makes a sample [output unit].
    longest_interval : float, optional
        Time without a sample after which there is one whatever the output [s]; None for no limit.
    input_record : {"sampled", "exact"}, default "exact"
        What the estimator is told of the input: its samples at the output's instants, or its true edges.

    Notes
    -----
    The output is simulated, and the noise drawn, at every look. How many samples a record has depends on the output.
    The instants depend on the noise: errors that carry the output over the threshold are sent more often than others,
    and estimates that take the instants for given are biased. In 150 data sets of a first-order system at 20 dB ``b0``
    is 3.6 % too large with a delta of 1.4 standard deviations of the noise, and 5.9 % with 4.
    """

    kind: ClassVar[str] = "send_on_delta"
    #: No random number is drawn.
    deterministic: ClassVar[bool] = True

    delta: float
    longest_interval: float | None = None
    input_record: InputRecord = "exact"

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive("delta", self.delta, "output unit")
        if self.longest_interval is not None:
            require_positive("longest_interval", self.longest_interval, "s")
            if self.longest_interval < self.interval:
                shorter = f"is shorter than the interval of the looks, {self.interval:g} s"
                raise OptionError("longest_interval", f"longest_interval {shorter}; raise it.")

    def times(self, rng: np.random.Generator) -> Array:
        """Instants of the looks; nothing is drawn."""
        return self.interval * np.arange(self.samples, dtype=float)

    def sent(self, output: Array) -> IndexArray:
        """Numbers of the looks that make a sample, the first 0; a DataError says that there is no second one."""
        longest = math.inf if self.longest_interval is None else self.longest_interval / self.interval
        found = _sent(output, self.delta, int(min(longest * (1 + COINCIDENCE), output.size)))
        if found.size < 2:
            moved = f"the output moves by {np.ptp(output):g} in all"
            raise DataError(f"no sample is sent but the first: {moved}, and delta is {self.delta:g}; lower delta")
        return found


@njit(cache=True, nogil=True)
def _sent(output: Array, delta: float, longest: int) -> IndexArray:
    """Compiled body of :meth:`SendOnDelta.sent`; ``longest`` is in looks."""
    found = np.empty(output.size, dtype=np.int64)
    # What was sent first is the value at the beginning.
    found[0], count, last = 0, 1, 0
    for k in range(1, output.size):
        if abs(output[k] - output[last]) >= delta or k - last >= longest:
            found[count], count, last = k, count + 1, k
    return found[:count].copy()
