"""The scalar regressions of dynamic regressor extension and mixing (DREM), and the recursion that solves them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ctid_cli.frequency.checks import one_for_each
from ctid_cli.frequency.consistency import (
    DETECTOR_SPAN,
    USUAL_SPANS,
    check_consistency,
    contradicts,
    observe_second_delay,
    samples_between_verdicts,
)
from ctid_cli.frequency.decoding import cosine_sensitivities, decode, flag_uncertain, propagate, still_doubtful
from ctid_cli.frequency.delay_options import DelayClock, DelayRegression
from ctid_cli.frequency.flags import GAP, STARTING, UNCERTAIN, UNDETERMINED
from ctid_cli.frequency.regression import form_row, minor_plan, mix_rows, theta_of, whole_delay
from ctid_cli.frequency.tracking import Recursion
from ctid_cli.signals.checks import require_integer, require_positive

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: A mixed regression may be wrong by this fraction of the product of its rows' lengths.
MIXING_ROUNDING = 1e-15
#: An estimate is valid after this many rows for each tone, and after this fraction of n h: before, the rows are too few
#: or too much alike to show that they disagree.
ROWS_PER_TONE = 4
STARTING_SPAN = 0.25
#: The check at the second delay forgets over so many times n h.
CHECK_SPANS = 4
#: The residuals that show how far an estimate can be trusted are remembered over so many times n h.
RECENT_SPANS = 2
#: Samples since an event that never happened.
LONG_AGO = 1 << 50
#: Fraction of the regressand's second moment that the frequencies may leave at the second delay.
NEGLIGIBLE = 1e-4


@dataclass(frozen=True, kw_only=True)
class DremOptions(DelayRegression):
    """Options that the finite-time and the gradient estimate share.

    Parameters
    ----------
    tones : int
        Number of sinusoids n.
    h : float
        Delay of the regression [s].
    d : float
        Distance of the stacked rows [s].
    epsilon : float, default 1.0
        Normalisation of the mixed regression [-].
    gamma : float or tuple of float, default 1.0
        Adaptation gain, one for all parameters or one for each.
    initial_frequencies : tuple of float, optional
        Frequencies before there is an estimate [rad/s].
    first_row : int, default 1
        Number of the first stacked row.
    power : int or "literal", default 1
        Power of ``epsilon`` in the mixed regression.
    gated : bool, default True
        Whether the estimation waits until the delays are filled.
    prefilter : float, default 0.0
        Length of a Hann low-pass in front of the regression [s].
    difference : float, default 0.0
        Distance of the two samples whose difference is taken against a bias [s].
    lowest_frequency : float, default 0.0
        Lower bound of the frequencies [rad/s].
    highest_frequency : float, optional
        Upper bound of the frequencies [rad/s].

    Raises
    ------
    ValueError
        If an option is out of range.
    """

    d: float = field(metadata={"doc": "Distance of the stacked rows", "unit": "s"})
    epsilon: float = field(default=1.0, metadata={"doc": "Normalisation of the mixed regression"})
    gamma: float | tuple[float, ...] = field(
        default=1.0, metadata={"doc": "Adaptation gain, one for all parameters or one for each"}
    )
    initial_frequencies: tuple[float, ...] | None = field(
        default=None, metadata={"doc": "Frequencies before there is an estimate", "unit": "rad/s"}
    )
    first_row: int = field(default=1, metadata={"doc": "Number of the first stacked row: 1 as published, 0 is earlier"})
    power: int | Literal["literal"] = field(
        default=1, metadata={"doc": "Power of epsilon in the mixed regression; literal: the number of tones"}
    )
    gated: bool = field(default=True, metadata={"doc": "Wait until the delays are filled"})

    def __post_init__(self) -> None:
        super().__post_init__()
        check_mixing(self.d, self.first_row)
        require_positive("epsilon", self.epsilon, "-")
        if isinstance(self.gamma, Sequence):
            object.__setattr__(self, "gamma", one_for_each("gamma", self.gamma, self.tones, "-"))
        else:
            require_positive("gamma", self.gamma, "-")
        initial = one_for_each("initial_frequencies", self.initial_frequencies, self.tones, "rad/s")
        object.__setattr__(self, "initial_frequencies", initial)
        if self.power != "literal":
            require_integer("power", self.power, 1)


def check_mixing(d: float, first_row: int) -> None:
    """Refuse impossible options of the mixing.

    Parameters
    ----------
    d : float
        Distance of the stacked rows [s].
    first_row : int
        Number of the first stacked row.

    Raises
    ------
    ValueError
        If one is out of range.
    """
    require_positive("d", d, "s")
    require_integer("first_row", first_row, 0, 1000)


def rows_before_valid(tones: int, clock: DelayClock) -> int:
    """Rows that must have arrived before an estimate can be valid.

    Parameters
    ----------
    tones : int
        Number of sinusoids n.
    clock : DelayClock
        Delays and prefilter.

    Returns
    -------
    int
        Four for each tone, and no less than n h/4: fewer are too much alike.
    """
    return max(ROWS_PER_TONE * tones, int(STARTING_SPAN * tones * clock.lag))


def scalar_recursion(options: DremOptions, interval: float, *, finite_time: bool) -> Recursion:
    """The recursion that the finite-time and the gradient estimate share.

    Parameters
    ----------
    options : DremOptions
        Options.
    interval : float
        Sampling interval [s].
    finite_time : bool
        Which of the two estimates is decoded.

    Returns
    -------
    Recursion
        With the state before the first sample.

    Raises
    ------
    ValueError
        If the options make no sense at this sampling interval.
    """
    n = options.tones
    clock = options.clock(interval)
    spacing = whole_delay("d", options.d, interval)
    power = n if options.power == "literal" else int(options.power)
    gains = np.full(n, 1.0) * np.asarray(options.gamma, dtype=float) * interval
    initial = options.initial_frequencies
    if initial is None:
        lowest, highest = np.arccos((clock.top, clock.bottom)) / clock.delay
        initial = lowest + (highest - lowest) * np.arange(1, n + 1) / (n + 1)
    start = theta_of(initial, clock.delay)
    past = np.nan if options.gated else 0.0
    constants = (
        clock.table,
        minor_plan(n),
        clock.lag,
        rows_before_valid(n, clock),
        options.first_row,
        spacing,
        float(options.epsilon) ** power,
        gains,
        start,
        finite_time,
        float(interval),
        clock.delay,
        clock.top,
        clock.bottom,
        clock.second_lag,
        clock.second_delay,
        samples_between_verdicts(clock.lag),
    )
    state = {
        "samples": np.full(2 * n * clock.lag + 1, past),
        "rows": np.full(((options.first_row + n - 1) * spacing + 1, n + 1), past),
        "theta": start.copy(),
        "sums": np.zeros((2, n)),
        "recent": np.zeros(n + 3),
        "check": np.zeros((n + 1, n + 1)),
        "counters": np.zeros(3, np.int64),
        "doubts": np.array([0, 0, LONG_AGO], np.int64),
        "levels": np.zeros(4),
        "possible_errors": np.full(n, np.nan),
    }
    return Recursion(advance_scalars, constants, state, clock.weights, past, clock.notes)


@njit(cache=True, nogil=True)
def judge_mixed(
    theta: Array,
    roots: Array,
    errors: Array,
    relative: float,
    delay: float,
    span: float,
    elapsed: float,
    interval: float,
    started: bool,
    contradicted: bool,
    check: Array,
    check_delay: float,
    doubts: IntArray,
    sensitivities: Array,
    slopes: Array,
    rounding: Array,
    omega: Array,
    uncertainty: Array,
) -> int:
    """What may be wrong with frequencies from mixed regressions.

    Parameters
    ----------
    theta, roots : ndarray, shape (n,)
        Parameters and cosines.
    errors : ndarray, shape (n,)
        Errors of the parameters that the misfit shows.
    relative : float
        Relative error of the mixed regressions by rounding.
    delay : float
        Delay h [s].
    span, elapsed : float
        Time that the estimate rests on, and since the first sample [s].
    interval : float
        Sampling interval [s].
    started : bool
        Whether there are enough rows for a verdict that lasts.
    contradicted : bool
        Whether the newest rows contradict the estimate.
    check : ndarray, shape (n + 1, n + 1)
        Second moments at the second delay.
    check_delay : float
        The same [s].
    doubts : ndarray of int, shape (3,)
        Samples since the last verdict, that verdict, and samples since the estimate was uncertain.
    sensitivities, slopes, rounding : ndarray, shapes (n, n), (n,), (n,)
        Work space.
    omega : ndarray, shape (n,)
        Frequencies [rad/s].
    uncertainty : ndarray, shape (n,)
        Receives what may be wrong with them [rad/s].

    Returns
    -------
    int
        The verdict: what is wrong with the estimate.
    """
    n = theta.size
    cosine_sensitivities(roots, delay, slopes, sensitivities)
    propagate(sensitivities, errors, uncertainty)
    for i in range(n):
        slopes[i] = (1.0 + abs(theta[i])) * relative
    propagate(sensitivities, slopes, rounding)
    flag = 0
    if flag_uncertain(omega, uncertainty, rounding, span, elapsed) or contradicted:
        flag = UNCERTAIN
        if started:
            doubts[2] = 0
    elif still_doubtful(omega, doubts[2] * interval):
        flag = UNCERTAIN
    return flag | check_consistency(check, omega, check_delay, NEGLIGIBLE)


@njit(cache=True, nogil=True)
def advance_scalars(
    samples: Array,
    omega: Array,
    uncertainty: Array,
    flags: NDArray[np.uint16],
    table: Array,
    plan: IntArray,
    lag: int,
    enough: int,
    first_row: int,
    spacing: int,
    normalisation: float,
    gains: Array,
    initial: Array,
    finite_time: bool,
    interval: float,
    delay: float,
    top: float,
    bottom: float,
    check_lag: int,
    check_delay: float,
    every: int,
    history: Array,
    rows: Array,
    theta: Array,
    sums: Array,
    recent: Array,
    check: Array,
    counters: IntArray,
    doubts: IntArray,
    levels: Array,
    possible_errors: Array,
) -> None:
    """Gradient and finite-time estimate of every mixed regression.

    Parameters
    ----------
    samples : ndarray, shape (N,)
        New samples.
    omega, uncertainty : ndarray, shape (N, n)
        Receive the estimates.
    flags : ndarray of uint16, shape (N,)
        Receives the flags.
    table : ndarray, shape (n + 1, 2 n + 1)
        Coefficients of the regression.
    plan : ndarray of int
        Order of the minors.
    lag, enough, first_row, spacing : int
        Delay h in sampling intervals, rows before an estimate can be valid, first stacked row, and distance d in
        sampling intervals.
    normalisation : float
        Factor on the mixed regression.
    gains : ndarray, shape (n,)
        gamma Ts.
    initial : ndarray, shape (n,)
        theta(0).
    finite_time : bool
        Whether the initial values are taken out of the estimate.
    interval, delay : float
        Sampling interval and delay h [s].
    top, bottom : float
        Cosines of the bounds of the frequencies.
    check_lag : int
        Second delay in sampling intervals.
    check_delay : float
        The same [s].
    every : int
        Samples from one verdict to the next.
    history, rows : ndarray
        Rings of samples and of rows.
    theta : ndarray, shape (n,)
        Estimate before the samples.
    sums : ndarray, shape (2, n)
        z and q.
    recent : ndarray, shape (n + 3,)
        Recent sums of the squared residuals, of Delta^2 and of the squared rounding errors; squared weights of the rows
        in the fastest estimate.
    check : ndarray, shape (n + 1, n + 1)
        Second moments at the second delay.
    counters : ndarray of int, shape (3,)
        Place of the newest sample and of the newest row, and mixed rows so far.
    doubts : ndarray of int, shape (3,)
        See :func:`judge_mixed`.
    levels : ndarray, shape (4,)
        See :func:`~ctid_cli.frequency.consistency.contradicts`.
    possible_errors : ndarray, shape (n,)
        What may be wrong with the frequencies according to the last verdict [rad/s].
    """
    n = gains.size
    row, check_row = np.empty(n + 1), np.empty(n + 1)
    matrix, minors, mixed = np.empty((n, n + 1)), np.empty(2 ** (n + 1)), np.empty(n + 1)
    errors, roots, slopes, rounding = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    sensitivities = np.empty((n, n))
    polynomial, work = np.empty(n + 1), np.empty(n + 1)
    keep = 1.0 - every / (CHECK_SPANS * n * lag)
    fast, slow = 1.0 / max(1.0, DETECTOR_SPAN * lag), 1.0 / (USUAL_SPANS * n * lag)
    remember = 1.0 - 1.0 / (RECENT_SPANS * n * lag)
    z, q = sums[0], sums[1]
    fastest = 0
    for i in range(1, n):
        if gains[i] > gains[fastest]:
            fastest = i
    for k in range(samples.size):
        counters[0] = counters[0] + 1 if counters[0] + 1 < history.size else 0
        counters[1] = counters[1] + 1 if counters[1] + 1 < rows.shape[0] else 0
        history[counters[0]] = samples[k]
        form_row(history, counters[0], lag, table, row)
        for i in range(n + 1):
            rows[counters[1], i] = row[i]
        if counters[0] % every == 0:
            observe_second_delay(history, counters[0], check_lag, table, check_row, check, keep)
        scale = normalisation * mix_rows(rows, counters[1], first_row, spacing, plan, matrix, minors, mixed)
        delta = normalisation * mixed[n]
        flag = 0
        if np.isfinite(scale * scale) and np.isfinite(delta * delta):
            counters[2] += 1
            recent[n] = remember * recent[n] + delta * delta
            recent[n + 1] = remember * recent[n + 1] + (MIXING_ROUNDING * scale) ** 2
            x, m, gain = 0.0, 0.0, 0.0
            for i in range(n):
                right = normalisation * mixed[i]
                if counters[2] > 1:
                    # The residual of what was known before this sample.
                    recent[i] = remember * recent[i] + (right - delta * theta[i]) ** 2
                if i == 0 or gains[i] != gains[i - 1]:
                    x = gains[i] * delta * delta
                    m = -np.expm1(-x)
                    gain = gains[i] * (m / x if x > 1e-8 else 1.0 - 0.5 * x)
                if i == fastest:
                    recent[n + 2] = (1.0 - m) ** 2 * recent[n + 2] + m * m
                z[i] += gain * delta * right - m * z[i]
                q[i] += m * (1.0 - q[i])
                theta[i] = z[i] / q[i] if finite_time and q[i] > 0.0 else z[i] + (1.0 - q[i]) * initial[i]
        else:
            flag = GAP if counters[2] > 0 else STARTING
        if counters[2] < enough:
            flag |= STARTING
        flag |= decode(theta, delay, top, bottom, polynomial, work, roots, omega[k])
        if recent[n] > 0.0:
            started = counters[2] >= enough
            contradicted = started and contradicts(row, theta, levels, fast, slow)
            if doubts[0] == 0 or contradicted:
                relative = np.sqrt(recent[n + 1] / recent[n])
                for i in range(n):
                    errors[i] = np.sqrt(recent[i] / recent[n])
                # Rows that carry weight: (sum w)^2/sum w^2.
                remembered = q[fastest] * q[fastest] / recent[n + 2] if recent[n + 2] > 0.0 else 0.0
                span = (rows.shape[0] + 2 * n * lag + remembered) * interval
                elapsed = (rows.shape[0] + 2 * n * lag + counters[2]) * interval
                doubts[1] = judge_mixed(
                    theta,
                    roots,
                    errors,
                    relative,
                    delay,
                    span,
                    elapsed,
                    interval,
                    started,
                    contradicted,
                    check,
                    check_delay,
                    doubts,
                    sensitivities,
                    slopes,
                    rounding,
                    omega[k],
                    possible_errors,
                )
            doubts[0] = (doubts[0] + 1) % every if started else 0
            doubts[2] += 1
            for i in range(n):
                uncertainty[k, i] = possible_errors[i]
        else:
            for i in range(n):
                uncertainty[k, i] = np.nan
            if counters[2] > 0:
                flag |= UNDETERMINED
        flags[k] = flag | doubts[1]
