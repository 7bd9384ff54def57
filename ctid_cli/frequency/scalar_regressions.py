"""The scalar regressions of dynamic regressor extension and mixing (DREM), and the recursion that solves them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ctid_cli.arrays import Array, IntArray
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
    """Options that the finite-time and the gradient estimate share."""

    d: float
    epsilon: float = 1.0
    gamma: float | tuple[float, ...] = 1.0
    initial_frequencies: tuple[float, ...] | None = None
    first_row: int = 1
    power: int | Literal["literal"] = 1
    gated: bool = True

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
    """Refuse impossible options of the mixing."""
    require_positive("d", d, "s")
    require_integer("first_row", first_row, 0, 1000)


def rows_before_valid(tones: int, clock: DelayClock) -> int:
    """Rows that must have arrived before an estimate can be valid."""
    return max(ROWS_PER_TONE * tones, int(STARTING_SPAN * tones * clock.lag))


def scalar_recursion(options: DremOptions, interval: float, *, finite_time: bool) -> Recursion:
    """The recursion that the finite-time and the gradient estimate share."""
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
    """What may be wrong with frequencies from mixed regressions."""
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
    """Gradient and finite-time estimate of every mixed regression."""
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
