r"""Sets of low-pass filters with which a delay estimate escapes local minima.

For a known rational part, an input of spectral density ``Psi(w)`` and white output noise of intensity ``lambda``, the
cost of a delay error d after a low-pass filter L is, by Parseval,

.. math:: J(d) = \frac1\pi \int_{-\infty}^{\infty} (1 - \cos w d) |L G_0(jw)|^2 \Psi(w)\,dw
                 + \frac{\lambda}{2\pi} \int_{-\infty}^{\infty} |L(jw)|^2\,dw,

twice the decrease of the autocorrelation of the filtered output from its peak, plus the noise floor. Every such cost
is even in d and least at d = 0. The region of convergence around zero grows with the period of the filter.

A descent of one filtered cost may stop at a local minimum. If for every delay error the descent of some filter of a
set ends strictly closer to zero, switching between filters ends at zero, since there are finitely many minima and each
is closer than the one before. That is the necessary condition (40) for useful redundancy, which :func:`check_filters`
verifies.

Equation numbers are those of Ha, Welsh and Alamir, "Useful redundancy in parameter and time delay estimation for
continuous-time models" (arXiv:1703.09344).
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ctid_cli.arrays import Array
from ctid_cli.errors import OptionError
from ctid_cli.filtering.lowpass import Lowpass
from ctid_cli.signals.checks import require_integer, require_positive


def ideal_cost(delay_error: ArrayLike, cutoff: float) -> Array:
    r"""Return the cost of a delay error if low-pass filter and system in series are an ideal low-pass filter.

    The input is white noise of unit intensity, and there is no output noise.

    Equation (50): ``J(d) = 2 wc/pi - 2 sin(wc d)/(pi d)``, the integral (35) with ``|L G0| = 1`` up to wc.
    """
    require_positive("cutoff", cutoff, "rad/s")
    # sinc(x) of NumPy is sin(pi x)/(pi x).
    return np.asarray(2 * cutoff / np.pi * (1.0 - np.sinc(cutoff / np.pi * np.asarray(delay_error, dtype=float))))


def extrema(cutoff: float, count: int, exact: bool = False) -> Array:
    r"""Return the positive delay errors at which the ideal cost has extrema.

    The extrema are those of ``sin(x)/x``, ``x = wc d``: the roots of ``tan x = x`` (51), one just below each
    ``q = (i + 1/2) pi``. Equation (36) is ``x ~ q - 1/q``; it lies above the root, by 0.15 % for i = 1, 0.018 % for
    i = 2, and less beyond.
    """
    require_positive("cutoff", cutoff, "rad/s")
    require_integer("count", count, 0)
    q = (np.arange(1, count + 1) + 0.5) * np.pi
    x = q - 1 / q
    if exact:
        # With y = q - x the equation is y = arctan(1/(q - y)): each iteration reduces the error by x² + 1 > 21.
        y = 1 / q
        for _ in range(14):
            y = np.arctan(1 / (q - y))
        x = q - y
    return np.asarray(x / cutoff)


def convergence_region(cutoff: float, exact: bool = False) -> float:
    r"""Return the delay error up to which a descent of the ideal cost ends at zero."""
    return float(extrema(cutoff, 1, exact)[0])


#: Least ratio of the longest to the shortest period for which a sufficient number of filters exists, (41): the second
#: extremum over the first, both by (36). The true extrema require 1.7192; between the two values a narrow gap remains.
LEAST_BETA = (5 / 4 - 1 / (5 * math.pi**2)) / (3 / 4 - 1 / (3 * math.pi**2))
#: Beyond this ratio the longest period is too slow for the system.
GREATEST_BETA = 10.0
#: Largest number of filters times extrema in a check.
_WORK_LIMIT = 20_000_000


@dataclass(frozen=True)
class FilterSet:
    r"""Butterworth low-pass filters of linearly spaced periods, up to the bandwidth of a system.

    Parameters
    ----------
    bandwidth : float
        Bandwidth of the system [rad/s]: its last -3 dB crossing. The narrowest period is ``2 pi/bandwidth``.
    count : int, default 10
        Number of filters, at least 2.
    beta : float, default 10.0
        Ratio of the longest to the shortest period [-], from :data:`LEAST_BETA` to 10.
    order : int, default 10
        Order of the Butterworth filters, 1 to 20.

    Raises
    ------
    ValueError
        If an option is out of its range.

    Notes
    -----
    ``T_k = beta T_bw + (k - 1) (1 - beta) T_bw/(nf - 1)``, k = 1 ... nf: (38), equivalent to (39).
    The minima of a filter's cost are proportional to its period, hence the linear spacing.

    Examples
    --------
    >>> FilterSet(bandwidth=2 * np.pi, count=6, beta=2.0).periods
    array([2. , 1.8, 1.6, 1.4, 1.2, 1. ])
    """

    bandwidth: float
    count: int = 10
    beta: float = 10.0
    order: int = 10

    def __post_init__(self) -> None:
        require_positive("bandwidth", self.bandwidth, "rad/s")
        require_integer("count", self.count, 2)
        _check_beta(self.beta)
        Lowpass(self.bandwidth, self.order)

    @property
    def periods(self) -> Array:
        """Periods of the cut-off frequencies [s], the longest first, shape (count,)."""
        shortest = 2 * np.pi / self.bandwidth
        return np.linspace(self.beta * shortest, shortest, self.count)

    @property
    def cutoffs(self) -> Array:
        """Cut-off frequencies [rad/s], the lowest first, shape (count,)."""
        return np.asarray(2 * np.pi / self.periods)

    @property
    def lowpasses(self) -> tuple[Lowpass, ...]:
        """The filters, the lowest cut-off first."""
        return tuple(Lowpass(float(cutoff), self.order) for cutoff in self.cutoffs)


def _check_beta(beta: float) -> None:
    if not isinstance(beta, int | float | np.number) or not LEAST_BETA <= beta <= GREATEST_BETA:
        raise OptionError(
            "beta",
            f"beta, the ratio of the longest to the shortest period, must be between {LEAST_BETA:.4f} (bound (41): the "
            f"least for which a finite number of filters suffices) and {GREATEST_BETA:g}, not {beta}.",
        )


@dataclass(frozen=True)
class ServedInterval:
    """Interval of delay errors from which the same filters descend closer to zero, to the same minima."""

    #: Ends of the open interval of absolute delay errors [s].
    low: float
    high: float
    filters: tuple[int, ...]
    #: The minimum nearest to zero [s], at most ``low``.
    minimum: float


@dataclass(frozen=True)
class FilterCheck:
    """Result of the check that from every delay error some ideal low-pass filter descends closer to zero."""

    #: Cut-off frequencies [rad/s].
    cutoffs: tuple[float, ...]
    #: Largest absolute delay error checked [s].
    largest_error: float
    intervals: tuple[ServedInterval, ...]
    #: Open intervals of absolute delay errors [s] from which no filter descends closer to zero.
    gaps: tuple[tuple[float, float], ...]
    exact: bool

    @property
    def passes(self) -> bool:
        """Whether there is no gap: the necessary condition (40) holds."""
        return not self.gaps

    def path(self, initial_error: float) -> list[tuple[int, float]]:
        """Return the descents, as filter and end, from a delay error towards zero."""
        if not abs(initial_error) <= self.largest_error:
            raise ValueError(
                f"the check covers delay errors up to {self.largest_error:g} s, not {abs(initial_error):g} s; "
                "repeat it with a larger range."
            )
        steps: list[tuple[int, float]] = []
        error = abs(initial_error)
        while error > 0:
            ends = [
                float(_ends(np.array([error]), *_landscape(cutoff, error, self.exact))[0]) for cutoff in self.cutoffs
            ]
            best = int(np.argmin(ends))
            if not ends[best] < error:
                break
            error = ends[best]
            steps.append((best, math.copysign(error, initial_error) if error else 0.0))
        return steps


def check_filters(cutoffs: ArrayLike, largest_error: float, exact: bool = True) -> FilterCheck:
    r"""Verify the necessary condition (40) for a set of ideal low-pass filters.

    Parameters
    ----------
    cutoffs : array_like, shape (nf,)
        Cut-off frequencies [rad/s] of the filters in series with the system, in any order.
    largest_error : float
        Largest absolute delay error to start from [s].
    exact : bool, default True
        Whether to use the true extrema of the ideal cost, else the approximation (36).

    Returns
    -------
    FilterCheck
        Intervals of errors with the filters that reduce them, and the gaps.

    Raises
    ------
    ValueError
        If a cut-off frequency or the largest error is not positive, or the range contains too many extrema.

    Notes
    -----
    No grid is involved. A descent from any point between two neighbouring maxima of a filter's cost ends at the minimum
    between them, so the filter reduces exactly the errors between that minimum and the next maximum. The ends of all
    these intervals split the range into pieces with constant results. The ends, where the direction of a descent is
    undetermined, are excluded.

    The condition is necessary, not sufficient: an estimator must also prefer the nearer minimum to the current one, and
    real filters are not ideal.

    Examples
    --------
    >>> check = check_filters(FilterSet(26.85, count=15).cutoffs, largest_error=15.0)
    >>> check.passes, len(check.path(15.0)), check.path(15.0)[-1]
    (True, 19, (0, 0.0))
    >>> check_filters(FilterSet(26.85, count=9).cutoffs, largest_error=15.0).passes
    False
    """
    w = np.atleast_1d(np.asarray(cutoffs, dtype=float))
    if w.ndim != 1 or not w.size:
        raise ValueError("the cut-offs must be a list of at least one frequency in rad/s")
    for cutoff in w:
        require_positive("cutoff", float(cutoff), "rad/s")
    require_positive("largest_error", largest_error, "s")
    if w.size * (largest_error * w.sum() / np.pi + w.size) > _WORK_LIMIT:
        raise ValueError(
            f"{w.size} filters have too many extrema up to {largest_error:g} s to be checked one by one; "
            "give a smaller largest error, fewer filters or lower cut-offs."
        )
    landscapes = [_landscape(float(cutoff), largest_error, exact) for cutoff in w]
    breaks = np.unique(np.concatenate([part for landscape in landscapes for part in landscape]))
    breaks = np.array([0.0, *breaks[(breaks > 0) & (breaks < largest_error)], largest_error])
    wide = np.diff(breaks) > 1e-12 * largest_error  # drop pieces between ends that differ by rounding only
    low, high = breaks[:-1][wide], breaks[1:][wide]
    middle = 0.5 * (low + high)
    ends = np.array([_ends(middle, *landscape) for landscape in landscapes])
    intervals, gaps = _served(low, high, ends, middle)
    return FilterCheck(tuple(map(float, w)), float(largest_error), tuple(intervals), tuple(gaps), exact)


def _served(
    low: Array, high: Array, ends: Array, middle: Array
) -> tuple[list[ServedInterval], list[tuple[float, float]]]:
    """Return the pieces that filters reduce, merged if filters and minima are equal, and the gaps.

    ``ends`` are the ends of the descent of each filter from the middle of each piece, shape (filters, pieces).
    """
    nearest_first = np.argsort(ends, axis=0, kind="stable")
    helps = ends < middle
    intervals: list[ServedInterval] = []
    gaps: list[tuple[float, float]] = []
    for k in range(middle.size):
        filters = tuple(int(i) for i in nearest_first[:, k] if helps[i, k])
        if not filters:
            gaps.append((gaps.pop()[0] if gaps and gaps[-1][1] == low[k] else float(low[k]), float(high[k])))
            continue
        minimum = float(ends[filters[0], k])
        last = intervals[-1] if intervals else None
        if last and (last.high, last.filters, last.minimum) == (low[k], filters, minimum):
            intervals[-1] = ServedInterval(last.low, float(high[k]), filters, minimum)
        else:
            intervals.append(ServedInterval(float(low[k]), float(high[k]), filters, minimum))
    return intervals, gaps


def _landscape(cutoff: float, largest_error: float, exact: bool) -> tuple[Array, Array]:
    """Return the maxima up to the first beyond an error, and the minima between them, starting with zero [s]."""
    pairs = int(largest_error * cutoff / (2 * np.pi)) + 2
    all_ = extrema(cutoff, 2 * pairs - 1, exact)
    return all_[::2], np.concatenate([[0.0], all_[1::2]])


def _ends(errors: Array, maxima: Array, minima: Array) -> Array:
    """Return the ends of descents from positive delay errors [s]."""
    return np.asarray(minima[np.searchsorted(maxima, errors)])
