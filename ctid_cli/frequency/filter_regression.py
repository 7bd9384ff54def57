"""Frequencies from a regression on filtered derivatives: a comparator, derived, not the published algorithm."""

from dataclasses import dataclass
from math import comb
from typing import ClassVar, Literal, NamedTuple, get_args

import numpy as np
from numba import njit

from ctid_cli.arrays import Array, IntArray
from ctid_cli.errors import OptionError
from ctid_cli.filtering.realisation import held_step
from ctid_cli.frequency.decoding import Decoding, bounded_roots, decoding_memory, flag_uncertain, root_sensitivities
from ctid_cli.frequency.flags import GAP, STARTING, UNDETERMINED
from ctid_cli.frequency.inputs import require_bounds, samples_in
from ctid_cli.frequency.moments import accumulate_row, factorise, least_squares, moment_uncertainty, squared_residual
from ctid_cli.frequency.tracking import OnlineEstimator, Output, Recursion
from ctid_cli.signals.checks import require_choice, require_not_negative, require_positive

Algorithm = Literal["least_squares", "gradient"]

#: The estimate is decoded anew every so many samples.
REFRESH = 5


class Filter(NamedTuple):
    """Settings of the filters and of the regression."""

    #: The chain over one interval: its transition, and what the last sample and the change since then add to it.
    step: tuple[Array, Array, Array]
    #: Rows of the regression from the chain, shape (n + 1, 2 n + 1).
    derivatives: Array
    #: What the second moments keep from one sample to the next.
    keep: float
    #: Gains of the gradient times the interval, shape (n,); none for least squares.
    gains: Array
    #: [s]
    interval: float
    #: How far an estimate reaches back, when the first one is shown, and how long a gap empties the chain [samples].
    memory: float
    hold: int
    refill: int
    #: Bounds of the squared frequencies.
    lowest: float
    highest: float


class Chain(NamedTuple):
    """State of the filters and of the regression."""

    #: The newest sample, and it after 1, 2, ... 2 n filters.
    chain: Array
    moments: Array
    #: Coefficients, frequencies and their possible errors, shape (3, n).
    estimate: Array
    #: Samples so far, samples until the chain is full again after a gap, rows since the last verdict, verdict (flags).
    counters: IntArray


SEEN, REFILL, NEW, VERDICT = range(4)


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

    pole: float
    forgetting: float = 0.5
    algorithm: Algorithm = "least_squares"
    gains: tuple[float, ...] | None = None
    initial_frequencies: tuple[float, ...] | None = None
    hold: float = 1.0
    lowest_frequency: float = 0.0
    highest_frequency: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive("pole", self.pole, "rad/s")
        require_positive("forgetting", self.forgetting, "1/s")
        require_choice("algorithm", self.algorithm, get_args(Algorithm))
        require_not_negative("hold", self.hold, "s")
        require_bounds(self.lowest_frequency, self.highest_frequency)
        for name, unit in (("gains", "-"), ("initial_frequencies", "rad/s")):
            self._keep_one_for_each(name, unit)

    def _recursion(self, interval: float) -> Recursion:
        n = self.tones
        order = 2 * n
        if self.pole * interval > np.pi:
            beyond = f"pole = {self.pole:g} rad/s is beyond what samples every {interval:g} s can show"
            raise OptionError("pole", f"{beyond}; use one below {np.pi / interval:g} rad/s.")
        dynamics = self.pole * (np.eye(order, k=-1) - np.eye(order))
        gain = np.zeros(order)
        gain[0] = self.pole
        initial = np.asarray(self.initial_frequencies or self.pole * np.arange(1, n + 1) / n, dtype=float)
        coefficients = np.poly(initial**2)[1:]
        gains = interval * np.asarray(self.gains or np.ones(n)) if self.algorithm == "gradient" else np.empty(0)
        settings = Filter(
            held_step(dynamics, gain, interval),
            derivative_rows(n, self.pole),
            float(np.exp(-self.forgetting * interval)),
            gains,
            float(interval),
            # The effective length of an exponential window, and the mean delay of the filter.
            (2.0 / self.forgetting + order / self.pole) / interval,
            samples_in(self.hold, interval),
            # A gap empties the filter; it takes about twice its mean delay to fill again.
            samples_in(2 * order / self.pole, interval),
            float(self.lowest_frequency) ** 2,
            np.inf if self.highest_frequency is None else float(self.highest_frequency) ** 2,
        )
        estimate = np.array([coefficients, np.sort(initial), np.full(n, np.nan)])
        counters = np.array([0, 0, 0, UNDETERMINED], np.int64)
        state = Chain(np.zeros(order + 1), np.zeros((n + 1, n + 1)), estimate, counters)
        return Recursion(advance_filter, (settings,), (state,))


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


@njit(cache=True, nogil=True, forceinline=True)
def filter_sample(
    y: float, transition: Array, from_value: Array, from_change: Array, chain: Array, moved: Array
) -> None:
    """Chain of filters over one interval, exactly for a signal that is linear between its samples."""
    for i in range(moved.size):
        moved[i] = from_value[i] * chain[0] + from_change[i] * (y - chain[0])
        # Lower triangular: a filter sees only those before it.
        for j in range(i + 1):
            moved[i] += transition[i, j] * chain[1 + j]
    chain[0] = y
    for i in range(moved.size):
        chain[1 + i] = moved[i]


@njit(cache=True, nogil=True)
def take_gradient_step(row: Array, gains: Array, coefficients: Array) -> None:
    """Implicit step ``a += K phi e/(1 + phi' K phi)``: no gain is too large."""
    n = coefficients.size
    residual, size = row[n], 1.0
    for i in range(n):
        residual -= row[i] * coefficients[i]
        size += gains[i] * row[i] * row[i]
    for i in range(n):
        coefficients[i] += gains[i] * row[i] * residual / size


@njit(cache=True, nogil=True, forceinline=True)
def estimate_frequencies(settings: Filter, state: Chain, factor: Array, scales: Array, work: Decoding) -> int:
    """Frequencies and their possible errors from the moments, and the flags that follow."""
    # Singular moments determine nothing, whatever the gradient has made of them.
    n, moments = scales.size, state.moments
    coefficients, frequencies, possible_errors = state.estimate[0], state.estimate[1], state.estimate[2]
    if not factorise(moments, 0.0, factor, scales):
        return UNDETERMINED
    if settings.gains.size == 0:
        least_squares(moments, factor, scales, coefficients)
    roots, slopes, sensitivities, rounding = work.roots, work.slopes, work.sensitivities, work.rounding
    verdict = bounded_roots(coefficients, settings.lowest, settings.highest, work.polynomial, work.quotient, roots)
    # The roots are squared frequencies: ascending, as frequencies are shown.
    for i in range(n // 2):
        roots[i], roots[n - 1 - i] = roots[n - 1 - i], roots[i]
    for i in range(n):
        frequencies[i] = np.sqrt(roots[i])
        slopes[i] = 0.5 / frequencies[i] if frequencies[i] > 0.0 else np.inf
    # d w/d w^2 = 1/(2 w), times the derivatives of the roots.
    root_sensitivities(roots, slopes, sensitivities)
    misfit = squared_residual(moments, coefficients)
    moment_uncertainty(moments, factor, scales, misfit, coefficients, sensitivities, possible_errors, rounding)
    elapsed = state.counters[SEEN] * settings.interval
    span = min(elapsed, settings.memory * settings.interval)
    return verdict | flag_uncertain(frequencies, possible_errors, rounding, span, elapsed)


@njit(cache=True, nogil=True)
def advance_filter(samples: Array, output: Output, settings: Filter, state: Chain) -> None:
    """Chain of filters, regression with forgetting, and least squares or gradient steps."""
    n = output.omega.shape[1]
    row, moved = np.empty(n + 1), np.empty(2 * n)
    factor, scales, memory = np.empty((n, n)), np.empty(n), decoding_memory(n)
    # Arrays are taken out of their tuples once: in the loop, each would cost two counts of its references.
    chain, moments, estimate, counters = state
    omegas, uncertainty, flags = output
    (transition, from_value, from_change), derivatives, gains = settings.step, settings.derivatives, settings.gains
    coefficients = estimate[0]
    for k in range(samples.size):
        y = samples[k]
        flag = STARTING if counters[SEEN] < settings.hold else 0
        # A gap breaks the chain: what is in it belongs to another time.
        if not np.isfinite(y):
            counters[REFILL] = settings.refill + 1
            flag |= GAP
        elif counters[REFILL] == settings.refill + 1 or counters[SEEN] == 0:
            # Nothing to interpolate from: the chain begins at rest.
            chain[:] = 0.0
            chain[0] = y
            flag |= GAP if counters[REFILL] > 0 else STARTING
            counters[REFILL] = max(counters[REFILL] - 1, 0)
        else:
            filter_sample(y, transition, from_value, from_change, chain, moved)
            if counters[REFILL] > 0:
                counters[REFILL] -= 1
                flag |= GAP
            else:
                # Derivatives of the filtered signal are combinations of the chain.
                for i in range(n + 1):
                    row[i] = 0.0
                    for j in range(2 * n + 1):
                        row[i] += derivatives[i, j] * chain[j]
                accumulate_row(row, moments, settings.keep)
                if gains.size:
                    take_gradient_step(row, gains, coefficients)
                counters[NEW] += 1
        # Verdicts come after the hold, and only where new rows have come.
        counters[SEEN] += 1
        if counters[NEW] >= REFRESH and counters[SEEN] > settings.hold:
            counters[NEW] = 0
            counters[VERDICT] = estimate_frequencies(settings, state, factor, scales, memory)
        for i in range(n):
            omegas[k, i] = estimate[1, i]
            uncertainty[k, i] = estimate[2, i]
        flags[k] = flag | counters[VERDICT]
