"""Reasons why an estimate is invalid, one bit for each."""

from enum import IntFlag
from typing import Any

import numpy as np
from numpy.typing import NDArray


class Flag(IntFlag):
    """Reasons why an estimate is invalid; an estimate without flags is valid.

    Notes
    -----
    Tracks store the flags as unsigned 16-bit integers; ``track.flags & Flag.GAP`` selects one reason.
    """

    STARTING = 1
    GAP = 2
    CHANGED = 4
    UNDETERMINED = 8
    UNCERTAIN = 16
    COMPLEX_ROOTS = 32
    OUT_OF_BOUNDS = 64
    INCONSISTENT = 128
    NOT_CONVERGED = 256
    CHANGE = 1024
    UNRESOLVED = 2048
    INACCURATE = 4096
    ABSENT = 8192

    @property
    def sentences(self) -> tuple[str, ...]:
        """One sentence for each flag that is set, with cause and remedy."""
        return tuple(MEANINGS[flag] for flag in Flag if flag in self)


#: Message of each flag.
MEANINGS: dict[Flag, str] = {
    Flag.STARTING: "Too few samples have arrived since the start or since the last restart.",
    Flag.GAP: "A sample that the estimate needs at this instant is missing or not finite.",
    Flag.CHANGED: "The signal changed: the estimate is held until all samples from before have left the delays.",
    Flag.UNDETERMINED: "The signal has fewer tones, or two that are equal at this delay; use fewer tones or another h.",
    Flag.UNCERTAIN: (
        "Noise, a bias or another tone may move a frequency by a tenth of itself or of the distance to the next one; "
        "use a prefilter, more tones or a longer record."
    ),
    Flag.COMPLEX_ROOTS: "The estimated parameters belong to no set of real frequencies.",
    Flag.OUT_OF_BOUNDS: "A frequency beyond the bounds, zero and pi/h if none are given, was put on the bound.",
    Flag.INCONSISTENT: (
        "The frequencies do not explain the signal at a second delay: a tone above pi/h is an alias of another one "
        "(use a smaller h), or the estimate lags behind a change."
    ),
    Flag.NOT_CONVERGED: "The iterations did not converge; start closer, or use a longer record.",
    Flag.CHANGE: "Frequency, amplitude or phase change here faster than any window can follow.",
    Flag.UNRESOLVED: "Another tone is so near that no window resolves the two; use a longer record.",
    Flag.INACCURATE: "The standard error is larger than the requested accuracy; allow more with --accuracy.",
    Flag.ABSENT: "The tone is absent, or not significant, at this instant.",
}


def flag_names(flags: NDArray[np.uint16]) -> NDArray[Any]:
    """Return the names of the flags that are set in each bit field, of the same shape."""
    values, places = np.unique(flags, return_inverse=True)
    names = [" ".join(str(flag.name).lower() for flag in Flag if value & flag) for value in values.tolist()]
    return np.array(names, dtype=object)[places].reshape(flags.shape)
