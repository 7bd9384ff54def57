"""Whether a clock is regular, and its interval."""

import numpy as np

from ctid_cli.arrays import Array

#: A clock counts as regular when no instant is further than this fraction of the interval from its place.
REGULARITY = 1e-7


def regular_interval(t: Array) -> float | None:
    """Interval of a regular clock."""
    if t.size < 2:
        return None
    interval = float((t[-1] - t[0]) / (t.size - 1))
    grid = t[0] + interval * np.arange(t.size)
    # Large times carry their own rounding, which is no sign of an irregular clock.
    tolerance = REGULARITY * interval + 4 * np.finfo(float).eps * float(np.abs(t).max())
    return interval if float(np.abs(t - grid).max()) <= tolerance else None
