"""Output noise, white or through a rational filter, and the random streams of an experiment."""

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError, OptionError
from ctid_cli.signals.checks import Checked, require_finite, require_not_negative

Role = Literal["input", "sampling", "noise", "start", "parameters"]

#: First component of every spawn key. Results are repeatable only if these numbers never change.
ROLES: dict[Role, int] = {"input": 0, "sampling": 1, "noise": 2, "start": 3, "parameters": 4}
#: Unit of every noise level option.
LEVEL_UNITS = {
    "snr_db": "dB",
    "standard_deviation": "output unit",
    "variance": "output unit^2",
    "innovation_variance": "output unit^2",
}
#: Largest absolute signal-to-noise ratio; the variance ratio of much larger ones cannot be represented.
MAX_SNR_DB = 1000


def _require_decibels(name: str, value: float, label: str = "") -> None:
    """Refuse a ratio of variances that cannot be represented."""
    require_finite(name, value, "dB", label)
    if abs(value) > MAX_SNR_DB:
        raise OptionError(name, f"{name} must be within plus or minus {MAX_SNR_DB} dB, not {value!r}.")


Decibels = Annotated[float, _require_decibels] | None
Variance = Annotated[float, require_not_negative, "output unit^2"] | None


def stream(seed: int, role: Role, replicate: int, number: int = 0) -> np.random.Generator:
    """Return the random generator of one role in one replicate, for the first or a further input.

    Levels (noise power, record length, estimators) do not enter, so every level of an experiment has the
    same input and the same noise shape in the same replicate, and adding a level does not change the others.
    """
    further = (number,) if number else ()
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(ROLES[role], replicate, *further)))


class Noise(Checked):
    """Output noise: white innovations through a filter, at an absolute or a relative level.

    It is stationary from the first sample on.
    """

    kind: ClassVar[str]
    #: Whether samples at different instants are correlated.
    coloured: ClassVar[bool]

    snr_db: float | None
    variance: float | None

    def __post_init__(self) -> None:
        super().__post_init__()
        levels = {name: getattr(self, name) for name in LEVEL_UNITS if hasattr(self, name)}
        given = [name for name, value in levels.items() if value is not None]
        if len(given) != 1:
            choices = ", ".join(f"{name} [{LEVEL_UNITS[name]}]" for name in levels)
            found = f"{' and '.join(given)} were" if given else "none was"
            raise ValueError(f"noise needs exactly one of {choices}; {found} given.")

    @property
    def filter(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Numerator and denominator of the noise filter in ascending powers of q^-1."""
        return (1.0,), (1.0,)

    def innovation_variance_of(self, noise_free: Array | None = None) -> float:
        """Return the variance of the innovations.

        Parameters
        ----------
        noise_free : ndarray, shape (N,), optional
            The output without noise [output unit]; needed with a signal-to-noise ratio.

        Returns
        -------
        float
            Variance [output unit^2].

        Raises
        ------
        DataError
            If the level is a signal-to-noise ratio and the noise-free output is missing or zero throughout.
        """
        if (variance := getattr(self, "innovation_variance", None)) is not None:
            return float(variance)
        if (deviation := getattr(self, "standard_deviation", None)) is not None:
            return float(deviation**2)
        if (variance := self.variance) is None:
            if noise_free is None:
                raise DataError("a signal-to-noise ratio is relative to a noise-free output; give that")
            power = float(np.mean(noise_free**2))
            if power == 0.0:
                why = "the noise-free output is zero, so no noise has a signal-to-noise ratio to it"
                raise DataError(f"{why}; is the delay longer than the record? Give noise.variance, or a longer record")
            assert self.snr_db is not None  # one level is always given
            variance = power / 10 ** (self.snr_db / 10)
        return variance / self._unit_variance

    def autocovariance(self, lags: ArrayLike, noise_free: Array | None = None) -> Array:
        """Return the covariance of samples at given lags.

        Parameters
        ----------
        lags : array_like of int, shape (M,)
            Lags [samples], of either sign.
        noise_free : ndarray, shape (N,), optional
            The output without noise [output unit]; needed with a signal-to-noise ratio.

        Returns
        -------
        ndarray, shape (M,)
            Covariance [output unit^2].
        """
        distances = np.abs(np.asarray(lags, dtype=int))
        transition, gain, direct = self.state_space
        covariances = np.zeros(int(distances.max(initial=0)) + 1)
        covariances[0] = self._unit_variance
        if gain.size:
            state = transition @ self.state_covariance[:, 0] + gain * direct
            for k in range(1, covariances.size):
                covariances[k] = state[0]
                state = transition @ state
        return np.asarray(self.innovation_variance_of(noise_free) * covariances[distances], dtype=float)

    def generate(self, noise_free: Array, rng: np.random.Generator) -> Array:
        """Draw the noise of one record: filtered innovations, with the initial state from its stationary distribution.

        Parameters
        ----------
        noise_free : ndarray, shape (N,)
            The output without noise [output unit]; only its length matters without a signal-to-noise ratio.
        rng : numpy.random.Generator
            Source of standard normal numbers: one for each state of the filter, then N.

        Returns
        -------
        ndarray, shape (N,)
            Noise [output unit].

        Raises
        ------
        DataError
            If the level is a signal-to-noise ratio and the noise-free output is zero throughout.
        """
        # A symmetric root: the covariance is singular with common zeros of C and D.
        values, vectors = np.linalg.eigh(self.state_covariance)
        root = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
        initial = root @ rng.standard_normal(values.size)
        shape: Array = rng.standard_normal(noise_free.size)
        if self.coloured:
            from scipy.signal import lfilter

            shape = lfilter(*self.filter, shape, zi=initial)[0]
        return float(np.sqrt(self.innovation_variance_of(noise_free))) * shape

    @cached_property
    def state_space(self) -> tuple[Array, Array, float]:
        """Transposed direct form, with the state of ``scipy.signal.lfilter``: F, G and h_0."""
        states = max(map(len, self.filter)) - 1
        leading = self.filter[1][0]
        numerator, denominator = (np.pad(part, (0, states + 1 - len(part))) / leading for part in self.filter)
        transition = np.eye(states, k=1)
        transition[:, :1] -= denominator[1:, None]
        return transition, numerator[1:] - denominator[1:] * numerator[0], float(numerator[0])

    @cached_property
    def state_covariance(self) -> Array:
        """Stationary covariance of the state for unit innovations."""
        from scipy.linalg import solve_discrete_lyapunov

        transition, gain, _ = self.state_space
        if not gain.size:
            return np.zeros((0, 0))
        covariance: Array = solve_discrete_lyapunov(transition, np.outer(gain, gain))
        return np.asarray(0.5 * (covariance + covariance.T), dtype=float)

    @cached_property
    def _unit_variance(self) -> float:
        """Noise variance for unit innovations."""
        return float(self.state_space[2] ** 2 + self.state_covariance[:1, :1].sum())


@dataclass(frozen=True)
class WhiteNoise(Noise):
    """Independent Gaussian samples of one standard deviation.

    Parameters
    ----------
    snr_db : float, optional
        Signal-to-noise ratio [dB]: ten times the decimal logarithm of the mean square of the noise-free
        output over the variance of the noise.
    standard_deviation : float, optional
        Standard deviation [output unit]; 0 for no noise.
    variance : float, optional
        Variance [output unit^2]. Exactly one of the three is given.

    Notes
    -----
    The same standard normal samples are drawn at every level and then scaled, so levels differ only by a factor.
    The mean square is that of the current record, including its mean value.

    Examples
    --------
    >>> import numpy as np
    >>> from ctid_cli.signals.noise import WhiteNoise
    >>> output = np.sin(np.arange(10_000))
    >>> noise = WhiteNoise(snr_db=20.0).generate(output, np.random.default_rng(0))
    >>> round(10 * np.log10(np.mean(output**2) / np.mean(noise**2)), 1)
    np.float64(20.0)
    """

    kind: ClassVar[str] = "white"
    coloured: ClassVar[bool] = False

    snr_db: Decibels = None
    standard_deviation: Annotated[float, require_not_negative, "output unit"] | None = None
    variance: Variance = None


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
        If the filter is unstable or invalid, or not exactly one level is given.

    Notes
    -----
    With ``z+ = F z + G e``, ``v = z_1 + h_0 e`` (the transposed direct form), the first state is drawn from its
    stationary distribution, whose covariance solves ``P = F P F' + G G'``. Hence every sample has the same variance.
    For unit innovations it is ``P_11 + h_0^2``, and the covariance at lag k > 0 is the first entry of
    ``F^(k-1) (F P e_1 + G h_0)``.

    The same standard normal numbers are drawn at every level, first those of the state, so that levels differ only
    by a factor and longer records begin with the shorter ones.

    Examples
    --------
    >>> from ctid_cli.signals.noise import ArmaNoise
    >>> noise = ArmaNoise(numerator=(1.0, 0.5), denominator=(1.0, -0.85), innovation_variance=0.02)
    >>> noise.autocovariance([0]).round(6).tolist()
    [0.151351]
    """

    kind: ClassVar[str] = "arma"
    coloured: ClassVar[bool] = True

    numerator: tuple[Annotated[float, require_finite, "-"], ...]
    denominator: tuple[Annotated[float, require_finite, "-"], ...]
    innovation_variance: Variance = None
    variance: Variance = None
    snr_db: Decibels = None

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("numerator", "denominator"):
            coefficients = tuple(map(float, getattr(self, name)))
            if not coefficients or coefficients[0] == 0:
                raise OptionError(name, f"the first coefficient of {name}, which belongs to q^0, must not be zero.")
            object.__setattr__(self, name, coefficients)
        largest = float(np.abs(np.roots(self.denominator)).max(initial=0.0))
        if largest >= 1.0:
            why = f"denominator has a zero of magnitude {largest:.6g}: the noise would grow without bound"
            raise OptionError("denominator", f"{why}; all must lie inside the unit circle.")

    @property
    def filter(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Numerator and denominator of the noise filter in ascending powers of q^-1."""
        return self.numerator, self.denominator
