"""What is asked of an estimated model: responses with pointwise confidence bands, and objects of other libraries."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

from ctid_cli.arrays import Array, ComplexArray


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
        Ends of the interval of each instant; a band that holds the whole curve is wider.
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
        Covariance of real and imaginary part [rad^2/s^2]; NaN of a pole that the data cannot tell from another.
    standard_error : ndarray, shape (n,)
        ``sqrt(var Re p + var Im p)`` [rad/s].
    lower, upper : ndarray of complex, shape (n,)
        Ends of the intervals of real and imaginary part, each by itself [rad/s].
    reach : ndarray, shape (n,)
        Axes of the ellipse that holds a complex pole with probability ``level``, over those of the covariance [-].
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


class SystemWithDelay(NamedTuple):
    """A model as an object of another library."""

    system: Any
    #: Delay that is not part of the object [s].
    delay: float
