"""Coloured noise: white innovations through a rational filter, stationary from the first sample on."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from ctid_cli.arrays import Array
from ctid_cli.errors import OptionError
from ctid_cli.signals.checks import require_finite
from ctid_cli.signals.noise import Noise, require_one_level, variance_at


@dataclass(frozen=True)
class ArmaNoise(Noise):
    r"""Autoregressive moving-average noise ``v = C(q^-1) / D(q^-1) e`` with Gaussian white innovations e.

    Parameters
    ----------
    numerator : tuple of float
        Coefficients of C in rising powers of q^-1, the first not zero.
    denominator : tuple of float
        Coefficients of D in rising powers of q^-1, the first not zero, its zeros inside the unit circle.
    innovation_variance : float, optional
        Variance of e [output unit^2].
    variance : float, optional
        Variance of v [output unit^2].
    snr_db : float, optional
        Signal-to-noise ratio [dB]: ten times the decimal logarithm of the mean square of the noise-free
        output over the variance of v. Exactly one of the three is given.

    Raises
    ------
    ValueError
        If the filter is unstable or no filter, or not exactly one level is given.

    Notes
    -----
    With ``z+ = F z + G e``, ``v = z_1 + h_0 e`` (the transposed direct form), the first state is drawn from its
    stationary distribution, whose covariance solves ``P = F P F' + G G'``. Hence every sample has the same variance.
    For unit innovations it is ``P_11 + h_0^2``, and the covariance at lag k > 0 is the first entry of
    ``F^(k-1) (F P e_1 + G h_0)``.

    The same standard normal numbers are drawn at every level, first those of the state, so that levels differ by a
    factor only and longer records begin with the shorter ones.

    Examples
    --------
    >>> from ctid_cli.signals.arma_noise import ArmaNoise
    >>> noise = ArmaNoise(numerator=(1.0, 0.5), denominator=(1.0, -0.85), innovation_variance=0.02)
    >>> round(noise.variance_of(), 6)
    0.151351
    """

    kind: ClassVar[str] = "arma"
    coloured: ClassVar[bool] = True

    numerator: tuple[float, ...]
    denominator: tuple[float, ...]
    innovation_variance: float | None = None
    variance: float | None = None
    snr_db: float | None = None

    def __post_init__(self) -> None:
        for name in ("numerator", "denominator"):
            coefficients = tuple(getattr(self, name))
            if not coefficients:
                raise OptionError(name, f"{name} must hold at least one coefficient.")
            for value in coefficients:
                require_finite(name, value, "-", label=f"a coefficient of {name}")
            if coefficients[0] == 0:
                raise OptionError(name, f"the first coefficient of {name} is zero; it belongs to q^0 and must not be.")
            object.__setattr__(self, name, tuple(float(value) for value in coefficients))
        largest = float(np.abs(np.roots(self.denominator)).max(initial=0.0))
        if largest >= 1.0:
            raise OptionError(
                "denominator",
                f"denominator has a zero of magnitude {largest:.6g}: the noise would grow without bound; "
                "all must lie inside the unit circle.",
            )
        require_one_level(
            {"innovation_variance": self.innovation_variance, "variance": self.variance, "snr_db": self.snr_db}
        )

    @property
    def filter(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Numerator and denominator in rising powers of q^-1 of what white innovations pass through."""
        return self.numerator, self.denominator

    def innovation_variance_of(self, noise_free: Array | None = None) -> float:
        """What the level asks for, over the variance for unit innovations."""
        if self.innovation_variance is not None:
            return self.innovation_variance
        variance = self.variance
        if variance is None:
            assert self.snr_db is not None
            variance = variance_at(self.snr_db, noise_free)
        return variance / self._unit_variance

    def variance_of(self, noise_free: Array | None = None) -> float:
        """That for unit innovations times theirs."""
        return self._unit_variance * self.innovation_variance_of(noise_free)

    def autocovariance(self, lags: ArrayLike, noise_free: Array | None = None) -> Array:
        """From the first state's stationary covariance on, lag by lag."""
        distances = np.abs(np.asarray(lags, dtype=int))
        transition, gain, direct = self._state_space
        covariances = np.zeros(int(distances.max(initial=0)) + 1)
        covariances[0] = self._unit_variance
        if gain.size:
            state = transition @ self._state_covariance[:, 0] + gain * direct
            for k in range(1, covariances.size):
                covariances[k] = state[0]
                state = transition @ state
        return np.asarray(self.innovation_variance_of(noise_free) * covariances[distances], dtype=float)

    def generate(self, noise_free: Array, rng: np.random.Generator) -> Array:
        """Filtered innovations; the first state is drawn from its stationary distribution."""
        from scipy.signal import lfilter

        initial = self._state_root @ rng.standard_normal(self._state_root.shape[0])
        innovations = rng.standard_normal(noise_free.size)
        shape: Array = lfilter(self.numerator, self.denominator, innovations, zi=initial)[0]
        return float(np.sqrt(self.innovation_variance_of(noise_free))) * shape

    @cached_property
    def _state_space(self) -> tuple[Array, Array, float]:
        """Transposed direct form, whose state is that of ``scipy.signal.lfilter``: F, G and h_0."""
        states = max(len(self.numerator), len(self.denominator)) - 1
        numerator: Array = np.pad(self.numerator, (0, states + 1 - len(self.numerator))) / self.denominator[0]
        denominator: Array = np.pad(self.denominator, (0, states + 1 - len(self.denominator))) / self.denominator[0]
        transition = np.eye(states, k=1)
        transition[:, :1] -= denominator[1:, None]
        return transition, numerator[1:] - denominator[1:] * numerator[0], float(numerator[0])

    @cached_property
    def _state_covariance(self) -> Array:
        from scipy.linalg import solve_discrete_lyapunov

        transition, gain, _ = self._state_space
        if not gain.size:
            return np.zeros((0, 0))
        covariance: Array = solve_discrete_lyapunov(transition, np.outer(gain, gain))
        return np.asarray(0.5 * (covariance + covariance.T), dtype=float)

    @cached_property
    def _state_root(self) -> Array:
        """Symmetric root of the state's covariance, which may be singular: common zeros of C and D, or an empty G."""
        values, vectors = np.linalg.eigh(self._state_covariance)
        return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T, dtype=float)

    @cached_property
    def _unit_variance(self) -> float:
        """Variance for unit innovations."""
        direct = self._state_space[2]
        return direct**2 + (float(self._state_covariance[0, 0]) if self._state_covariance.size else 0.0)
