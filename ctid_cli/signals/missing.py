"""Samples that are lost one by one or in bursts (the model of E. N. Gilbert, Bell Syst. Tech. J. 39(5), 1960)."""

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import OptionError
from ctid_cli.signals.checks import require_finite

#: Longest bursts on average [samples].
LONGEST_MEAN = 1e6


def check_loss(missing: float, mean_burst: float | None) -> None:
    """Refuse bursts that are no bursts, or too short for the share of losses."""
    if mean_burst is None:
        return
    require_finite("mean_burst", mean_burst, "samples")
    least = max(1.0, missing / (1 - missing))
    if not least <= mean_burst <= LONGEST_MEAN:
        ends = f"from {least:g} to {LONGEST_MEAN:g} [samples]"
        why = f"must be {ends} where a share of {missing:g} is missing, not {mean_burst:g}"
        raise OptionError("mean_burst", f"mean_burst {why}.")


def ticks_between(rng: np.random.Generator, count: int, missing: float, mean_burst: float | None) -> Array:
    """Ticks from each sample that is there to the next one, shape (count,): 1, and the length of a burst if one begins.

    A share p of losses in bursts of mean length L needs a burst after a sample with probability ``p / ((1 - p) L)``.
    """
    length = 1 / (1 - missing) if mean_burst is None else mean_burst
    begins = missing / ((1 - missing) * length)
    # Two numbers for each sample, so that longer records begin with the shorter ones.
    chance, place = rng.random((count, 2)).T
    with np.errstate(divide="ignore"):  # bursts of length 1 have no chance to go on
        lengths = 1 + np.floor(np.log1p(-place) / np.log1p(-1 / length))
    return np.asarray(1 + np.where(chance < begins, lengths, 0))
