r"""Layout of a frequency response for estimation, and responses of modes and state spaces at its lines.

The values are ``G(jw)``, or the sampled response ``Y(q)/U(q)`` with ``q = exp(j w h)`` for an input that is constant
over intervals h. With a delay of ``d - f`` intervals the output of a sampled system ``z' = F z + g u`` depends on the
state a fraction f after the break d breaks earlier:

.. math:: z = q^{-d} \left[ e^{F f h} (q I - e^{F h})^{-1} \Gamma(h) + \Gamma(f h) \right] u, \qquad
          \Gamma(x) = \int_0^x e^{F s} ds \, g.

A complex equation is two real ones, except at frequency zero and at half the sampling frequency, where it is one.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ctid_cli.arrays import Array, BoolArray, ComplexArray
from ctid_cli.filtering.bank import Place
from ctid_cli.filtering.realisation import held_step

#: Below this magnitude of ``p x`` integrals over a step x are computed as series with this number of terms.
SERIES_BELOW, TERMS = 0.5, 16
#: Relative tolerance within which a line counts as half the sampling frequency.
AT_NYQUIST = 1e-9


@dataclass(frozen=True, eq=False)
class FrequencyLines:
    """A frequency response, each line with the weight of its error."""

    #: Frequencies [rad/s], rising, shape (K,).
    frequencies: Array
    response: ComplexArray
    #: Factors of the errors in the sum of squares, shape (K,).
    weights: Array
    #: Sampling interval [s] of a sampled response; 0 for ``G(jw)``.
    interval: float = 0.0

    #: Input and output have no instants.
    common_clock = False

    @cached_property
    def use(self) -> BoolArray:
        """Mask of the real and imaginary parts that are equations, shape (2 K,)."""
        real = self.frequencies == 0.0
        if self.interval:
            real |= np.abs(self.frequencies * self.interval / np.pi - 1.0) <= AT_NYQUIST
        return np.concatenate((np.ones(real.size, dtype=bool), ~real))

    @property
    def count(self) -> int:
        """Number of real equations."""
        return int(self.use.sum())

    @property
    def y_used(self) -> Array:
        """Weighted real and imaginary parts, shape (count,)."""
        return np.asarray(self.parts(self.response[:, None])[0])

    @cached_property
    def lowest(self) -> float:
        """Least frequency that is not zero [rad/s]."""
        return float(self.frequencies[self.frequencies > 0.0][0])

    @property
    def highest(self) -> float:
        """Greatest frequency [rad/s]."""
        return float(self.frequencies[-1])

    @cached_property
    def length(self) -> float:
        """Length of a record with the same frequency resolution [s]."""
        gaps = np.diff(np.unique(self.frequencies))
        return 2.0 * np.pi / min(self.lowest, float(np.median(gaps)) if gaps.size else self.lowest)

    @property
    def shift(self) -> ComplexArray:
        """Operator ``j w``, or ``q`` for a sampled response, at each line."""
        return np.asarray(np.exp(1j * self.frequencies * self.interval) if self.interval else 1j * self.frequencies)

    def parts(self, columns: ComplexArray) -> Array:
        """Return weighted real and imaginary parts of columns at the lines as rows, shape (columns, count)."""
        weighted = self.weights[:, None] * columns
        return np.ascontiguousarray(np.vstack((weighted.real, weighted.imag))[self.use].T)

    def delayed(self, delay: Place) -> ComplexArray:
        """Return the frequency response of the delay, of its whole intervals for a sampled response."""
        if isinstance(delay, tuple):
            return np.asarray(self.shift ** -delay[0])
        return np.asarray(np.exp(-self.shift * delay))

    def of_modes(self, poles: ComplexArray, delay: Place) -> tuple[ComplexArray, ComplexArray]:
        """Return ``1/(s - p)`` with the delay and its derivative by each pole, shapes (K, n)."""
        late = self.delayed(delay)[:, None]
        if not isinstance(delay, tuple):
            first = 1.0 / (self.shift[:, None] - poles)
            return late * first, late * first**2
        h, part = self.interval, delay[1] * self.interval
        whole, whole_slope = held_integral(poles, h)
        rest, rest_slope = held_integral(poles, part)
        # q - exp(p h) without cancellation.
        inverse = 1.0 / (np.expm1(1j * self.frequencies * h)[:, None] - np.expm1(poles * h))
        onward = np.exp(poles * part)
        value = onward * whole * inverse + rest
        slope = onward * inverse * (part * whole + whole_slope + whole * h * np.exp(poles * h) * inverse) + rest_slope
        return late * value, late * slope

    def of_states(self, dynamics: Array, gain: Array, delay: Place) -> ComplexArray:
        """Return the responses of the states of ``z' = F z + g u`` with the delay, shape (K, n)."""
        late, unit = self.delayed(delay)[:, None], np.eye(gain.size)
        if not isinstance(delay, tuple):
            return np.asarray(late * _resolved(self.shift, dynamics, gain))
        step, rest = held_step(dynamics, gain, self.interval), held_step(dynamics, gain, delay[1] * self.interval)
        beyond = np.expm1(1j * self.frequencies * self.interval)
        at_break = _resolved(beyond, step.transition - unit, step.from_value)
        return np.asarray(late * (at_break @ rest.transition.T + rest.from_value))


def _resolved(points: ComplexArray, matrix: Array, gain: Array) -> ComplexArray:
    """Return ``(s I - M)^-1 g`` at several points, shape (K, n)."""
    whole = points[:, None, None] * np.eye(gain.size) - matrix
    return np.asarray(np.linalg.solve(whole, np.broadcast_to(gain[:, None], (points.size, gain.size, 1)))[..., 0])


def held_integral(poles: ComplexArray, x: float) -> tuple[ComplexArray, ComplexArray]:
    """Return ``(exp(p x) - 1)/p`` and its derivative by p, also for p = 0."""
    z = np.asarray(poles * x, dtype=complex)
    small = np.abs(z) < SERIES_BELOW
    power = 1.0 / np.cumprod(np.arange(1.0, TERMS + 1.0))
    k = np.arange(TERMS)
    # sum z^k/(k + 1)!, and sum z^k (k + 1)/(k + 2)!
    near = np.where(small, z, 0.0)
    value, slope = np.polyval(power[::-1], near), np.polyval((power[1:] * (k[1:]))[::-1], near)
    far = np.where(small, 1.0, z)
    ratio = np.expm1(far) / far
    value = np.where(small, value, ratio)
    slope = np.where(small, slope, (np.exp(far) - ratio) / far)
    return np.asarray(x * value, dtype=complex), np.asarray(x * x * slope, dtype=complex)
