"""Frequencies of a whole record by ESPRIT: estimation of signal parameters via rotational invariance techniques."""

from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ctid_cli.errors import DataError, OptionError
from ctid_cli.frequency.amplitudes import estimate_of, frequency_errors, present_samples
from ctid_cli.frequency.flags import Flag
from ctid_cli.frequency.inputs import require_bounds
from ctid_cli.frequency.tracking import BatchEstimator, FrequencyEstimate
from ctid_cli.signals.checks import require_not_negative

#: Rows of the Hankel matrix as a fraction of the samples, and the largest number of them.
ROWS_FRACTION = 0.4
MOST_ROWS = 400
#: More samples than this make a matrix too large to decompose; averages show as much.
MOST_AVERAGES = 100_000
#: Singular values below this fraction of the largest are rounding.
RANK_TOLERANCE = 1e-11


@dataclass(frozen=True, kw_only=True)
class Esprit(BatchEstimator):
    r"""Frequencies of a whole record by ESPRIT, for the tracker of recordings.

    Notes
    -----
    The Hankel matrix of a sum of n sinusoids has rank 2 n, and its column space U satisfies ``U_down = U_up F``, where
    F has the eigenvalues ``exp(+-j w_i T)``. F is found by least squares from the leading left singular vectors.

    References
    ----------
    R. Roy and T. Kailath, "ESPRIT - estimation of signal parameters via rotational invariance techniques", *IEEE Trans.
    Acoustics, Speech, and Signal Processing* 37 (1989) 984-995. doi:10.1109/29.32276
    """

    averaging: float = 0.0
    lowest_frequency: float = 0.0
    highest_frequency: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        require_not_negative("averaging", self.averaging, "s")
        require_bounds(self.lowest_frequency, self.highest_frequency)

    def blocks(self, count: int, interval: float) -> tuple[int, int, float]:
        """How a record is averaged and arranged."""
        block = max(1, round(min(self.averaging / interval, float(count))))
        highest = np.pi / (block * interval)
        if self.highest_frequency is not None:
            if self.highest_frequency > highest * (1.0 + 1e-12):
                shown = f"averages over {block * interval:g} s show frequencies up to {highest:g} rad/s"
                asked = f"highest_frequency is {self.highest_frequency:g} rad/s"
                remedy = f"use an averaging below {np.pi / self.highest_frequency:g} s."
                raise OptionError("averaging", f"{shown}, but {asked}; {remedy}")
            highest = self.highest_frequency
        averages = count // block
        rows = min(int(ROWS_FRACTION * averages), MOST_ROWS)
        if rows < 2 * self.tones + 1:
            few = f"{averages} samples, after the averaging, are too few for {self.tones} tones"
            raise DataError(f"{few}; use a longer record or a shorter averaging.", "averaging")
        if averages > MOST_AVERAGES:
            many = f"{averages:,} samples are more than the {MOST_AVERAGES:,} that ESPRIT takes"
            least = f"{count / MOST_AVERAGES * interval:.2g} s"
            raise DataError(f"{many}; use an averaging of at least {least}, or a part of the record.", "averaging")
        return block, rows, highest

    def estimate(self, samples: ArrayLike, interval: float) -> FrequencyEstimate:
        """Rotation of the signal space of the averaged record, which must have no gaps."""
        y, t = present_samples(samples, interval)
        if y.size < np.asarray(samples).size:
            raise DataError("ESPRIT takes no record with missing samples; nonlinear_least_squares does.")
        n = self.tones
        block, rows, highest = self.blocks(y.size, interval)
        averages = y[: y.size // block * block].reshape(-1, block).mean(axis=1)
        hankel = np.lib.stride_tricks.sliding_window_view(averages, averages.size - rows + 1)
        vectors, singular_values, _ = np.linalg.svd(hankel, full_matrices=False)
        flags = Flag(0)
        if not singular_values[2 * n - 1] > RANK_TOLERANCE * singular_values[0]:
            flags |= Flag.UNDETERMINED
        basis = vectors[:, : 2 * n]
        rotations = np.linalg.eigvals(np.linalg.lstsq(basis[:-1], basis[1:], rcond=None)[0])
        angles = np.sort(np.angle(rotations[np.imag(rotations) > 0]))
        if angles.size < n:
            # Real eigenvalues: a constant, an alternating or a vanishing part instead of a sinusoid.
            flags |= Flag.COMPLEX_ROOTS
            angles = np.sort(np.abs(np.angle(rotations)))[::2]
        omega = angles / (block * interval)
        bounded = np.clip(omega, self.lowest_frequency, highest)
        if (bounded != omega).any():
            flags |= Flag.OUT_OF_BOUNDS
        uncertainty = np.full(n, np.nan)
        # Where the samples determine no amplitudes, the estimate below says so.
        with suppress(DataError):
            uncertainty = frequency_errors(y, t, bounded, bias=False)[1]
        return estimate_of(y, t, bounded, uncertainty, flags, bias=False)
