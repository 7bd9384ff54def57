r"""Responses of an estimated model with confidence bands, from the joint covariance of its parameters.

Linearised, a quantity g has the variance ``(dg/dtheta) C (dg/dtheta)'`` with exact derivatives, and its interval has
the same half-width in standard errors as those of the parameters. Sampled, parameters are drawn from the normal
distribution with covariance C, or Student's t if C is uncertain, and the interval is between quantiles of the drawn
responses: it need not be symmetric, and includes nonlinear effects, such as that of an uncertain delay on the first
instants of a step response.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from ctid_cli.arrays import Array, ComplexArray
from ctid_cli.errors import DataError, UsageError
from ctid_cli.inference.derived import indistinct
from ctid_cli.inference.sensitivities import Parametric
from ctid_cli.inference.uncertainty import Uncertainty
from ctid_cli.signals.held import HeldSignal


@dataclass(frozen=True, eq=False)
class ResponseBand:
    """A response over time with its pointwise confidence band.

    Parameters
    ----------
    t : ndarray, shape (N,)
        Instants [s].
    value : ndarray, shape (N,)
        Response of the estimate [output unit]; of an impulse response per second.
    standard_error : ndarray, shape (N,)
        Standard error of each value; NaN where it is not defined.
    lower, upper : ndarray, shape (N,)
        Pointwise interval ends; a simultaneous band of the whole curve is wider.
    level : float
        Confidence level of each interval [-].
    """

    t: Array = field(repr=False)
    value: Array = field(repr=False)
    standard_error: Array = field(repr=False)
    lower: Array = field(repr=False)
    upper: Array = field(repr=False)
    level: float


@dataclass(frozen=True, eq=False)
class FrequencyBand:
    """A frequency response with pointwise confidence bands of gain and phase.

    Parameters
    ----------
    frequencies : ndarray, shape (N,)
        Angular frequencies [rad/s].
    value : ndarray of complex, shape (N,)
        ``G(j w)`` of the estimate, delay included [output unit/input unit].
    covariance : ndarray, shape (N, 2, 2)
        Covariance of real and imaginary part: ellipses of a Nyquist plot.
    gain : ndarray, shape (N,)
        ``|G|`` [output unit/input unit].
    gain_error, gain_lower, gain_upper : ndarray, shape (N,)
        Its standard error and the ends of its interval, never below zero.
    phase : ndarray, shape (N,)
        Phase [rad], continuous over the frequency.
    phase_error, phase_lower, phase_upper : ndarray, shape (N,)
        Its standard error and the ends of its interval [rad].
    level : float
        Confidence level of each interval [-].
    """

    frequencies: Array = field(repr=False)
    value: ComplexArray = field(repr=False)
    covariance: Array = field(repr=False)
    gain: Array = field(repr=False)
    gain_error: Array = field(repr=False)
    gain_lower: Array = field(repr=False)
    gain_upper: Array = field(repr=False)
    phase: Array = field(repr=False)
    phase_error: Array = field(repr=False)
    phase_lower: Array = field(repr=False)
    phase_upper: Array = field(repr=False)
    level: float


@dataclass(frozen=True, eq=False)
class PoleBand:
    """Poles with their uncertainty.

    Parameters
    ----------
    value : ndarray of complex, shape (n,)
        Poles of the estimate [rad/s].
    covariance : ndarray, shape (n, 2, 2)
        Covariance of real and imaginary part [rad^2/s^2]; NaN for a pole that the data cannot distinguish from another.
    standard_error : ndarray, shape (n,)
        ``sqrt(var Re p + var Im p)`` [rad/s].
    lower, upper : ndarray of complex, shape (n,)
        Ends of the marginal intervals of real and imaginary part [rad/s].
    reach : ndarray, shape (n,)
        Axes of the confidence ellipse of a complex pole, over those of the covariance [-].
    level : float
        Confidence level [-].
    """

    value: ComplexArray
    covariance: Array = field(repr=False)
    standard_error: Array
    lower: ComplexArray = field(repr=False)
    upper: ComplexArray = field(repr=False)
    reach: Array = field(repr=False)
    level: float


#: Bands by linearisation or from drawn parameters.
Bands = Literal["linearised", "sampled"]
#: Number of parameter draws, and their fixed seed, for reproducible bands.
DRAWS, SEED = 1000, 20261122
#: Default number of points of a curve.
POINTS = 400


@dataclass(frozen=True, eq=False)
class Estimated:
    """A model with the joint distribution of the parameters of its fit."""

    parametric: Parametric
    law: Uncertainty

    @property
    def degrees_of_freedom(self) -> float:
        """Degrees of freedom of the t distribution of the draws [-]; infinite for the normal distribution."""
        return self.law.degrees_of_freedom if self.law.bootstrap is None else np.inf

    def intervals(self, slopes: Array, level: float) -> tuple[Array, Array]:
        """Return standard errors and half-widths of quantities from their gradients, shape (N, p)."""
        errors = self.law.errors(slopes)
        return errors, self.law.reach(slopes, level) * errors

    def of_parts(self, slopes: ComplexArray) -> Array:
        """Return the covariances of real and imaginary parts from their gradients, shape (N, 2, 2)."""
        own = self.law.along(slopes)
        parts = np.stack((own.real, own.imag), axis=1)
        found = np.asarray(np.einsum("nki,ij,nlj->nkl", parts, self.law.free_covariance, parts))
        found[~(self.law.determined(slopes.real) & self.law.determined(slopes.imag))] = np.nan
        return found

    def draws(self) -> Iterator[Parametric]:
        """Yield models with drawn parameters, without invalid ones."""
        mine, _ = self.parametric.free
        values, vectors = np.linalg.eigh(self.law.free_covariance)
        rng = np.random.default_rng(SEED)
        normal = rng.standard_normal((DRAWS, values.size))
        if np.isfinite(self.degrees_of_freedom):
            normal /= np.sqrt(rng.chisquare(self.degrees_of_freedom, DRAWS) / self.degrees_of_freedom)[:, None]
        for change in normal @ (self.law.tangent[mine] @ (vectors * np.sqrt(np.maximum(values, 0.0)))).T:
            with suppress(DataError):
                yield self.parametric.at(change)

    def response_times(self, times: ArrayLike | None) -> Array:
        """Return the given instants, or default ones until the slowest mode has settled."""
        if times is not None:
            return instants(times)
        model = self.parametric.model
        decay = np.abs(self.parametric.poles()[0].real)
        speeds = np.abs(self.parametric.poles()[0])
        decay, speeds = decay[decay > 1e-9 * speeds.max(initial=0.0)], speeds[speeds > 0]
        longest = 5.0 / float(decay.min()) if decay.size else 0.0
        if speeds.size:
            # A mode with little damping is shown for thirty periods of the slowest pole.
            longest = min(longest or np.inf, 60.0 * np.pi / float(speeds.min()))
        return np.linspace(0.0, model.delay + (longest or 10.0 * (model.delay or 1.0)), POINTS)

    def over_time(self, model: Parametric, signal: HeldSignal, t: Array, level: float, bands: Bands) -> ResponseBand:
        """Return the output from rest of the model, or of its derivative."""
        _check(level, bands)
        value, slopes = model.simulated(signal, t), model.output_slopes(signal, t)
        errors, half = self.intervals(slopes, level)
        if bands == "linearised" or not self.law.defined:
            lower, upper = value - half, value + half
        else:
            behind = (one.derivative if model.differentiated else one for one in self.draws())
            lower, upper = _quantiles(np.array([one.simulated(signal, t) for one in behind]), level, errors)
        return ResponseBand(t, value, errors, lower, upper, level)

    def over_frequency(self, frequencies: ArrayLike | None, level: float, bands: Bands) -> FrequencyBand:
        """Return gain and phase; the parts of ``d ln G = dG/G`` are the changes of relative gain and of phase."""
        _check(level, bands)
        model = self.parametric.model
        w = _grid(self.parametric) if frequencies is None else _checked_frequencies(frequencies)
        value, phase = model.frequency_response(w), _phase(self.parametric, w)
        gain = np.abs(value)
        slopes = self.parametric.frequency_slopes(w)
        with np.errstate(invalid="ignore", divide="ignore"):
            relative = slopes / value[:, None]
        gain_error, wide = self.intervals(relative.real, level)
        phase_error, turn = self.intervals(relative.imag, level)
        if bands == "linearised" or not self.law.defined:
            with np.errstate(over="ignore", invalid="ignore"):
                lower, upper = gain * np.exp(-wide), gain * np.exp(wide)
            low_phase, high_phase = phase - turn, phase + turn
        else:
            drawn = np.array([one.model.frequency_response(w) for one in self.draws()])
            with np.errstate(invalid="ignore", divide="ignore"):
                turned = np.angle(drawn / value)
            lower, upper = _quantiles(np.abs(drawn), level, gain_error)
            low_phase, high_phase = (phase + end for end in _quantiles(turned, level, phase_error))
        covariance = self.of_parts(slopes)
        return FrequencyBand(
            w,
            value,
            covariance,
            gain,
            gain * gain_error,
            lower,
            upper,
            phase,
            phase_error,
            low_phase,
            high_phase,
            level,
        )

    def poles(self, level: float) -> PoleBand:
        """Return the poles with their uncertainty by the delta method."""
        _check(level, "linearised")
        value, slopes = self.parametric.poles()
        slopes[~np.isfinite(slopes).all(axis=1)] = np.nan
        covariance = self.of_parts(slopes)
        for k in range(value.size):
            others = np.arange(value.size) != k
            if indistinct(value, k, slopes[k], others, self.law, level):
                covariance[k] = np.nan
        with np.errstate(invalid="ignore"):
            errors = np.sqrt(np.maximum(np.einsum("nkk->nk", covariance), 0.0))
        half = (
            self.law.reach(slopes.real, level) * errors[:, 0] + 1j * self.law.reach(slopes.imag, level) * errors[:, 1]
        )
        reach = np.full(value.size, _ellipse(level, self.degrees_of_freedom))
        return PoleBand(value, covariance, np.hypot(*errors.T), value - half, value + half, reach, level)


def _quantiles(drawn: Array, level: float, errors: Array) -> tuple[Array, Array]:
    """Return the ends of the central interval of draws, without NaN; NaN where there is no standard error."""
    ends = np.nanquantile(drawn, [0.5 - level / 2, 0.5 + level / 2], axis=0)
    ends[:, np.isnan(errors)] = np.nan
    return ends[0], ends[1]


def _ellipse(level: float, degrees_of_freedom: float) -> float:
    """Return the radius of the confidence region of two numbers with unit covariance."""
    if not np.isfinite(degrees_of_freedom):
        return float(np.sqrt(-2.0 * np.log1p(-level)))
    # Hotelling's T^2 of two numbers, 2 F(2, d), whose quantile has a closed form.
    d = degrees_of_freedom
    return float(np.sqrt(d * ((1.0 - level) ** (-2.0 / d) - 1.0)))


def _check(level: float, bands: str) -> None:
    if not 0.0 < level < 1.0:
        raise UsageError(f"the level of a confidence band must be between 0 and 1, such as 0.95; got {level:g}")
    if bands not in get_args(Bands):
        raise UsageError(f"bands must be {' or '.join(map(repr, get_args(Bands)))}; got {bands!r}")


def instants(times: ArrayLike) -> Array:
    """Return the given instants, checked."""
    t = np.atleast_1d(np.array(times, dtype=float))
    if t.ndim != 1 or not np.isfinite(t).all() or (np.diff(t) <= 0).any():
        raise DataError("the instants of a response must be a list of finite numbers that increase strictly")
    return t


def _grid(parametric: Parametric) -> Array:
    """Return frequencies from well below to well above all corner frequencies."""
    model = parametric.fraction
    corners = np.abs(np.concatenate((model.poles, model.zeros)))
    corners = corners[corners > 0]
    if not corners.size:
        corners = np.ones(1)
    return np.geomspace(0.05 * float(corners.min()), 20.0 * float(corners.max()), POINTS)


def _checked_frequencies(frequencies: ArrayLike) -> Array:
    w = np.atleast_1d(np.array(frequencies, dtype=float))
    if w.ndim != 1 or not np.isfinite(w).all() or (w < 0).any():
        raise DataError("frequencies must be a list of finite numbers of rad/s, none below zero")
    return w


def _phase(parametric: Parametric, w: Array) -> Array:
    """Return the phase [rad] of the response, unwrapped by the sum of the phases of poles and zeros."""
    model, s = parametric.fraction, np.asarray(1j * w, dtype=complex)
    with np.errstate(invalid="ignore"):
        undelayed = parametric.model.frequency_response(w) * np.exp(s * model.delay)
    wrapped = np.arctan2(undelayed.imag, undelayed.real)
    branch = np.full(w.size, 0.0 if model.numerator[0] >= 0 else np.pi)
    for corners, sign in ((model.zeros, 1.0), (model.poles, -1.0)):
        away = s[:, None] - corners
        branch += sign * np.sum(np.arctan2(away.imag, away.real), axis=1)
    phase: Array = wrapped + 2.0 * np.pi * np.round((branch - wrapped) / (2.0 * np.pi)) - w * model.delay
    return phase
