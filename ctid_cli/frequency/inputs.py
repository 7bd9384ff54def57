"""What every estimator checks: bounds of frequencies, and samples."""

import numpy as np
from numpy.typing import ArrayLike

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError, OptionError
from ctid_cli.signals.checks import require_not_negative, require_positive

#: More tones than this cannot be told apart in double precision.
MOST_TONES = 8
#: A sample larger than this counts as missing: its powers would overflow.
LARGEST_SAMPLE = 1e30


def samples_in(duration: float, interval: float) -> int:
    """Sampling intervals nearest to a time, however long it is."""
    return round(min(duration / interval, float(1 << 62)))


def require_bounds(lowest: float, highest: float | None) -> None:
    """Refuse bounds of frequencies that leave nothing between them."""
    require_not_negative("lowest_frequency", lowest, "rad/s")
    if highest is None:
        return
    require_positive("highest_frequency", highest, "rad/s")
    if lowest >= highest:
        order = f"lowest_frequency ({lowest:g} rad/s) must be below highest_frequency ({highest:g} rad/s)."
        raise OptionError("lowest_frequency", order)


def series_of(samples: ArrayLike) -> Array:
    """One series of real numbers, with NaN for whatever counts as missing."""
    values = np.asarray(samples)
    if values.ndim != 1 or values.dtype.kind not in "fiu":
        found = f"shape {values.shape} and type {values.dtype}"
        raise DataError(f"the samples must be one series of real numbers, not of {found}.")
    values = values.astype(np.float64)
    with np.errstate(invalid="ignore"):
        return np.where(np.abs(values) <= LARGEST_SAMPLE, values, np.nan)
