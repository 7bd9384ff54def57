"""Frequencies from a regression on filtered derivatives: a comparator, derived, not the published algorithm."""

from __future__ import annotations

from dataclasses import dataclass
from math import comb
from typing import ClassVar, Literal, get_args

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ctid_cli.arrays import Array, IntArray
from ctid_cli.errors import OptionError
from ctid_cli.filtering.exponential import held_step
from ctid_cli.frequency.checks import one_for_each, require_bounds, samples_in
from ctid_cli.frequency.decoding import flag_uncertain, root_real_parts, root_sensitivities
from ctid_cli.frequency.flags import COMPLEX_ROOTS, GAP, OUT_OF_BOUNDS, STARTING, UNDETERMINED
from ctid_cli.frequency.moments import accumulate_row, factorise, least_squares, moment_uncertainty, squared_residual
from ctid_cli.frequency.regression import MOST_TONES
from ctid_cli.frequency.tracking import OnlineEstimator, Recursion
from ctid_cli.signals.checks import require_choice, require_integer, require_not_negative, require_positive

Algorithm = Literal["least_squares", "gradient"]

#: The estimate is decoded anew every so many samples.
REFRESH = 5


@dataclass(frozen=True, kw_only=True)
class FilterRegression(OnlineEstimator):
    r"""Frequencies from a linear regression on filtered derivatives; derived, not the published algorithm.

    Parameters
    ----------
    tones : int
        Number of sinusoids n, 1 to 8.
    pole : float
        Rate of the filter [rad/s], near the frequencies.
    forgetting : float, default 0.5
        Rate at which old data are forgotten [1/s].
    algorithm : {"least_squares", "gradient"}, default "least_squares"
        How the parameters are adapted.
    gains : tuple of float, optional
        Gains of the gradient algorithm, one for each parameter; 1 if not given.
    initial_frequencies : tuple of float, optional
        Frequencies to begin with [rad/s]; by default spread up to ``pole``.
    hold : float, default 1.0
        Least squares shows no estimate before this time [s].
    lowest_frequency : float, default 0.0
        Lower bound of the frequencies [rad/s].
    highest_frequency : float, optional
        Upper bound of the frequencies [rad/s].

    Raises
    ------
    ValueError
        If an option is out of range.

    Notes
    -----
    Derived, not the published algorithm: with one tone and the gradient it has the structure of the known first-order
    frequency observer, and the extension to several tones is our own.

    ``z = (l/(s + l))^(2n) y`` satisfies ``prod(s^2 + w_i^2) z = 0`` once the filter has settled, a linear regression of
    ``z^(2n)`` on the even derivatives below. They are combinations of the states of a chain of first-order filters,
    advanced exactly for a signal that is linear between its samples. The parameters are those of the polynomial in
    ``X = w^2`` whose roots are the squared frequencies. The gradient is normalised and implicit:
    ``a += Ts K phi e/(1 + Ts phi' K phi)``.

    References
    ----------
    For the structure with one tone: D. J. W. Belleter, R. Galeazzi and T. I. Fossen, "Experimental verification of a
    global exponential stable nonlinear wave encounter frequency estimator", *Ocean Engineering* 97 (2015) 48-56.
    doi:10.1016/j.oceaneng.2014.12.030
    """

    kind: ClassVar[str] = "filter_regression"

    tones: int
    pole: float
    forgetting: float = 0.5
    algorithm: Algorithm = "least_squares"
    gains: tuple[float, ...] | None = None
    initial_frequencies: tuple[float, ...] | None = None
    hold: float = 1.0
    lowest_frequency: float = 0.0
    highest_frequency: float | None = None

    def __post_init__(self) -> None:
        require_integer("tones", self.tones, 1, MOST_TONES)
        require_positive("pole", self.pole, "rad/s")
        require_positive("forgetting", self.forgetting, "1/s")
        require_choice("algorithm", self.algorithm, get_args(Algorithm))
        require_not_negative("hold", self.hold, "s")
        require_bounds(self.lowest_frequency, self.highest_frequency)
        for name, unit in (("gains", "-"), ("initial_frequencies", "rad/s")):
            object.__setattr__(self, name, one_for_each(name, getattr(self, name), self.tones, unit))

    def recursion(self, interval: float) -> Recursion:
        """The compiled recursion for a sampling interval.

        Parameters
        ----------
        interval : float
            Sampling interval [s].

        Returns
        -------
        Recursion
            With the state before the first sample.

        Raises
        ------
        ValueError
            If the options make no sense at this sampling interval.
        """
        n = self.tones
        order = 2 * n
        if self.pole * interval > np.pi:
            raise OptionError(
                "pole",
                f"pole = {self.pole:g} rad/s is beyond what samples every {interval:g} s can show; "
                f"use one below {np.pi / interval:g} rad/s.",
            )
        dynamics = self.pole * (np.eye(order, k=-1) - np.eye(order))
        gain = np.zeros(order)
        gain[0] = self.pole
        transition, from_value, from_change = held_step(dynamics, gain, interval)
        initial = self.initial_frequencies
        if initial is None:
            initial = tuple(self.pole * np.arange(1, n + 1) / n)
        coefficients = np.poly(np.asarray(initial, dtype=float) ** 2)[1:]
        highest = np.inf if self.highest_frequency is None else self.highest_frequency
        constants = (
            transition,
            from_value,
            from_change,
            derivative_rows(n, self.pole),
            float(np.exp(-self.forgetting * interval)),
            self.algorithm == "gradient",
            interval * np.asarray(self.gains if self.gains is not None else np.ones(n), dtype=float),
            float(interval),
            # The effective length of an exponential window, and the mean delay of the filter.
            (2.0 / self.forgetting + order / self.pole) / interval,
            samples_in(self.hold, interval),
            # A gap empties the filter; it takes about twice its mean delay to fill again.
            samples_in(2 * order / self.pole, interval),
            float(self.lowest_frequency) ** 2,
            float(highest) ** 2,
        )
        state = {
            "chain": np.zeros(order + 1),
            "moments": np.zeros((n + 1, n + 1)),
            "estimate": np.array([coefficients, np.sort(np.asarray(initial, dtype=float)), np.full(n, np.nan)]),
            "counters": np.array([0, 0, 0, UNDETERMINED], np.int64),
        }
        return Recursion(advance_filter, constants, state)


def derivative_rows(tones: int, pole: float) -> Array:
    """Regressors and regressand as combinations of the filter states."""
    order = 2 * tones
    rows = np.zeros((tones + 1, order + 1))
    for k in range(tones + 1):
        derivative = 2 * (tones - k)
        target = k - 1 if k else tones
        sign = -((-1) ** k) if k else 1
        for i in range(derivative + 1):
            rows[target, order - derivative + i] = sign * pole**derivative * comb(derivative, i) * (-1) ** i
    return rows


@njit(cache=True, nogil=True)
def decode_squares(
    coefficients: Array, lowest: float, highest: float, polynomial: Array, work: Array, roots: Array, omega: Array
) -> int:
    """Frequencies whose squares are the roots of a polynomial, ascending."""
    n = coefficients.size
    polynomial[0] = 1.0
    for k in range(n):
        if not np.isfinite(coefficients[k]):
            for i in range(n):
                roots[i] = omega[i] = np.nan
            return COMPLEX_ROOTS
        polynomial[k + 1] = coefficients[k]
    flags = 0 if root_real_parts(polynomial, work, roots) else COMPLEX_ROOTS
    for i in range(n // 2):
        roots[i], roots[n - 1 - i] = roots[n - 1 - i], roots[i]
    for i in range(n):
        if roots[i] < lowest or roots[i] > highest:
            roots[i] = min(max(roots[i], lowest), highest)
            flags |= OUT_OF_BOUNDS
        omega[i] = np.sqrt(roots[i])
    return flags


@njit(cache=True, nogil=True)
def advance_filter(
    samples: Array,
    omega: Array,
    uncertainty: Array,
    flags: NDArray[np.uint16],
    transition: Array,
    from_value: Array,
    from_change: Array,
    derivatives: Array,
    keep: float,
    by_gradient: bool,
    gains: Array,
    interval: float,
    memory: float,
    hold: int,
    refill: int,
    lowest: float,
    highest: float,
    chain: Array,
    moments: Array,
    estimate: Array,
    counters: IntArray,
) -> None:
    """Chain of filters, regression with forgetting, and least squares or gradient steps."""
    n = omega.shape[1]
    order = 2 * n
    row, moved = np.empty(n + 1), np.empty(order)
    best, slopes, roots, scales, rounding = np.empty(n), np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    polynomial, work = np.empty(n + 1), np.empty(n + 1)
    factor, sensitivities = np.empty((n, n)), np.empty((n, n))
    coefficients, frequencies, possible_errors = estimate[0], estimate[1], estimate[2]
    for k in range(samples.size):
        y = samples[k]
        flag = STARTING if counters[0] < hold else 0
        if not np.isfinite(y):
            counters[1] = refill + 1
            flag |= GAP
        elif counters[1] == refill + 1 or counters[0] == 0:
            # Nothing to interpolate from: the chain begins at rest.
            chain[0] = y
            for i in range(order):
                chain[1 + i] = 0.0
            flag |= GAP if counters[1] > 0 else STARTING
            counters[1] = max(counters[1] - 1, 0)
        else:
            for i in range(order):
                moved[i] = from_value[i] * chain[0] + from_change[i] * (y - chain[0])
                for j in range(i + 1):
                    moved[i] += transition[i, j] * chain[1 + j]
            chain[0] = y
            for i in range(order):
                chain[1 + i] = moved[i]
            if counters[1] > 0:
                counters[1] -= 1
                flag |= GAP
            else:
                for i in range(n + 1):
                    row[i] = 0.0
                    for j in range(order + 1):
                        row[i] += derivatives[i, j] * chain[j]
                accumulate_row(row, moments, keep)
                if by_gradient:
                    residual, size = row[n], 1.0
                    for i in range(n):
                        residual -= row[i] * coefficients[i]
                        size += gains[i] * row[i] * row[i]
                    for i in range(n):
                        coefficients[i] += gains[i] * row[i] * residual / size
                counters[2] += 1
        counters[0] += 1
        if counters[2] >= REFRESH and counters[0] > hold:
            counters[2] = 0
            if factorise(moments, 0.0, factor, scales):
                least_squares(moments, factor, scales, best)
                if not by_gradient:
                    for i in range(n):
                        coefficients[i] = best[i]
                verdict = decode_squares(coefficients, lowest, highest, polynomial, work, roots, frequencies)
                for i in range(n):
                    slopes[i] = 0.5 / frequencies[i] if frequencies[i] > 0.0 else np.inf
                root_sensitivities(roots, slopes, sensitivities)
                misfit = squared_residual(moments, coefficients)
                moment_uncertainty(
                    moments, factor, scales, misfit, coefficients, sensitivities, possible_errors, rounding
                )
                elapsed = counters[0] * interval
                span = min(elapsed, memory * interval)
                counters[3] = verdict | flag_uncertain(frequencies, possible_errors, rounding, span, elapsed)
            else:
                counters[3] = UNDETERMINED
        for i in range(n):
            omega[k, i] = frequencies[i]
            uncertainty[k, i] = possible_errors[i]
        flags[k] = flag | counters[3]
