"""How strong noise is: in units of the output, or relative to the output that it is added to."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError
from ctid_cli.signals.checks import require_finite, require_not_negative

#: Unit of every way to say how strong noise is.
LEVEL_UNITS = {
    "snr_db": "dB",
    "standard_deviation": "output unit",
    "variance": "output unit^2",
    "innovation_variance": "output unit^2",
}


def require_one_level(levels: Mapping[str, float | None]) -> None:
    """Refuse anything but exactly one level, a signal-to-noise ratio or a number that is not negative."""
    given = [name for name, value in levels.items() if value is not None]
    if len(given) != 1:
        choices = [f"{name} [{LEVEL_UNITS[name]}]" for name in levels]
        found = f"{' and '.join(given)} were" if given else "none was"
        raise ValueError(f"noise needs exactly one of {', '.join(choices)}; {found} given.")
    name = given[0]
    value = levels[name]
    assert value is not None
    check = require_finite if name == "snr_db" else require_not_negative
    check(name, value, LEVEL_UNITS[name])


def variance_at(snr_db: float, noise_free: Array | None) -> float:
    """Variance of noise with a signal-to-noise ratio."""
    if noise_free is None:
        raise DataError("a signal-to-noise ratio says how strong noise is only beside a noise-free output; give that")
    power = float(np.mean(noise_free**2))
    if power == 0.0:
        raise DataError(
            "the noise-free output is zero, so no noise has a signal-to-noise ratio to it; "
            "is the delay longer than the record? Give noise.variance, or a longer record"
        )
    return power / 10 ** (snr_db / 10)
