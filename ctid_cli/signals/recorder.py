"""What becomes of a measured output on its way into the record: its resolution, and losses."""

from dataclasses import dataclass

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import OptionError
from ctid_cli.signals.checks import require_not_negative
from ctid_cli.signals.missing import check_loss, ticks_between
from ctid_cli.signals.sampling import from_zero


@dataclass(frozen=True)
class Recorder:
    """What becomes of the output, noise included, when it is recorded.

    Parameters
    ----------
    resolution : float, default 0.0
        Outputs are rounded to multiples of this [output unit]; 0 does not round.
    missing : float, default 0.0
        Share of the outputs that are missing [-], below 1; the record marks them.
    mean_burst : float, optional
        Mean number of outputs that are missing in a row [samples]; None for losses that are independent.

    Raises
    ------
    ValueError
        If there cannot be so many losses in such short bursts.

    Notes
    -----
    Rounding acts like white noise of the standard deviation ``resolution / sqrt(12)`` if the output moves by more than
    a step from sample to sample. The first output is never missing. In a loop, the controller is given the output as
    it is before all this.

    Examples
    --------
    >>> import numpy as np
    >>> from ctid_cli.signals.recorder import Recorder
    >>> Recorder(resolution=0.5).rounded(np.array([0.2, 0.3, -1.1]))
    array([ 0. ,  0.5, -1. ])
    """

    resolution: float = 0.0
    missing: float = 0.0
    mean_burst: float | None = None

    def __post_init__(self) -> None:
        require_not_negative("resolution", self.resolution, "output unit")
        require_not_negative("missing", self.missing, "-")
        if self.missing >= 1:
            raise OptionError("missing", f"missing must be a share below 1 [-], not {self.missing!r}.")
        check_loss(self.missing, self.mean_burst)

    def rounded(self, output: Array) -> Array:
        """The output in steps of the resolution."""
        if self.resolution == 0.0:
            return output
        # Without a minus before zero, which would be written to files.
        return np.asarray(self.resolution * np.rint(output / self.resolution) + 0.0)

    def with_losses(self, output: Array, rng: np.random.Generator) -> Array:
        """The output with NaN where it is missing; losses are drawn."""
        if self.missing == 0.0:
            return output
        ticks = from_zero(ticks_between(rng, output.size - 1, self.missing, self.mean_burst))
        there = ticks[ticks < output.size].astype(int)
        marked = np.full(output.size, np.nan)
        marked[there] = output[there]
        return marked
