"""Noise of the output error of a simulated loop, which is the output noise filtered by the loop."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ctid_cli.arrays import Array, BoolArray, ComplexArray

#: Largest number of missing samples of a record that are completed.
MOST_MISSING = 500


@dataclass(frozen=True, eq=False)
class SensitivityFunction:
    r"""Sensitivity function ``S = 1/(1 + P C)`` of a sampled loop up to its gain.

    Output noise v of a loop gives the output error S v. With an integrating controller S is zero at frequency 0, and
    with a delay its inverse has a long impulse response: S v is then not close to an autoregression of low order, and v
    is. Zeros outside the unit circle, from an unstable plant, are reflected, so that the inverse is stable: this leaves
    the spectrum of the output error unchanged.

    Measured, 200 records of 600 samples, PI controller, delay of 5.4 samples, white noise, 15 dB: standard errors are
    .94 to .96 of the true ones by an autoregression of S v, and 1.00 to 1.01 by one of v.
    """

    #: Poles of plant and controller, reflected if unstable, and of the loop, equally many [-].
    zeros: ComplexArray
    poles: ComplexArray

    @classmethod
    def of(cls, open_loop: ComplexArray, closed_loop: ComplexArray) -> "SensitivityFunction":
        """Return the function of a loop with given poles of plant and controller, and of the loop."""
        zeros = open_loop.astype(complex)
        outside = np.abs(zeros) > 1.0
        zeros[outside] = 1.0 / zeros[outside].conj()
        return cls(zeros, closed_loop.astype(complex))

    @cached_property
    def _sections(self) -> tuple[Array, Array]:
        from scipy.signal import zpk2sos  # slow to import

        return zpk2sos(self.zeros, self.poles, 1.0), zpk2sos(self.poles, self.zeros, 1.0)

    def filtered(self, noise: Array) -> Array:
        """Return ``S v`` of columns v that are zero before the first row."""
        from scipy.signal import sosfilt  # slow to import

        return np.asarray(sosfilt(self._sections[0], noise, axis=0))

    def removed(self, errors: Array) -> Array:
        """Return v from columns ``S v``."""
        from scipy.signal import sosfilt  # slow to import

        return np.asarray(sosfilt(self._sections[1], errors, axis=0))

    def completed(self, columns: Array, errors: Array, used: BoolArray) -> tuple[Array, Array]:
        """Return columns and errors ``S v`` at all samples from the first used one.

        Missing errors are those with the least ``v'v``, and all are scaled for the degrees of freedom; missing rows of
        the columns are zero, since these samples are not in the sums.
        """
        used = used[np.argmax(used) :]
        missing = np.flatnonzero(~used)
        if not missing.size:
            return columns, errors
        rows, complete = np.zeros((used.size, columns.shape[1])), np.zeros(used.size)
        units = np.zeros((used.size, missing.size))
        rows[used], complete[used], units[missing, range(missing.size)] = columns, errors, 1.0
        complete[missing] = -np.linalg.lstsq(self.removed(units), self.removed(complete))[0]
        return rows, complete * np.sqrt(used.size / used.sum())

    def transposed(self, columns: Array) -> Array:
        """Return columns g with ``g' v = columns' S v`` for every v."""
        return self.filtered(columns[::-1])[::-1]
