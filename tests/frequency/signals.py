"""Signals and estimators for the tests in this folder, and plain versions of the estimators' first steps."""

import numpy as np

from ctid_cli.frequency.delay_kernels import Clock, decode
from ctid_cli.frequency.delay_regression import delay_table
from ctid_cli.frequency.drem import DremFiniteTime, DremGradient, DremWindow
from ctid_cli.frequency.flags import Flag
from ctid_cli.frequency.restarting_least_squares import RestartingLeastSquares

INTERVAL = 0.01
#: Well-separated frequencies [rad/s] for any number of tones up to five.
OMEGA = {n: np.array([1.0, 2.0, 3.0, 4.2, 5.5])[:n] for n in range(1, 6)}
AMPLITUDES = np.array([1.0, 0.8, 1.3, 0.6, 1.1])
PHASES = np.array([0.3, 1.1, -0.7, 2.0, -1.5])

T = INTERVAL * np.arange(4000)
CLEAN = np.sin(2 * T) + np.cos(3 * T)
NOISE = np.random.default_rng(0).standard_normal(T.size)

#: Signals without two tones, for which no estimate is right.
NO_TWO_TONES = {
    "zero": 0 * T,
    "constant": 0 * T + 2.5,
    "a ramp": 0.3 * T,
    "one tone": np.sin(2 * T),
    "one tone twice": np.sin(2 * T) + 0.7 * np.cos(2 * T + 1),
    "one tone and noise": np.sin(2 * T) + 0.05 * NOISE,
    "noise": NOISE,
    "an alias": np.sin(2 * T) + np.sin(7 * T),
    "a weak alias": np.sin(2 * T) + 0.2 * np.sin(7 * T + 1),
    "an alias and noise": np.sin(2 * T) + np.sin(7 * T) + 0.05 * NOISE,
    "three tones": CLEAN + np.sin(4 * T),
    "a bias": CLEAN + 0.5,
    "a large bias": CLEAN + 3.0,
    "a square wave": np.sign(np.sin(2 * T)),
}


def tones(n, count, interval=INTERVAL, omega=None):
    """Return the n sinusoids of a signal separately, shape (count, n)."""
    t = interval * np.arange(count)
    return AMPLITUDES[:n] * np.sin(np.outer(t, OMEGA[n] if omega is None else omega) + PHASES[:n])


def online_estimators(n=2):
    """Return one estimator of each kind, for n tones of the signals above, suitable for a coarse clock."""
    initial = tuple(OMEGA[n] * 1.1)
    common = {"tones": n, "h": 0.4}
    return [
        DremGradient(d=0.3, epsilon=0.5, gamma=(1.0, 2.0, 0.5, 1.0, 1.0)[:n], initial_frequencies=initial, **common),
        DremFiniteTime(d=0.3, epsilon=0.5, first_row=0, **common),
        DremFiniteTime(d=0.3, gated=False, prefilter=0.2, **common),
        DremWindow(d=0.3, memory=1.5, difference=0.7, **common),
        RestartingLeastSquares(prefilter=0.5, **common),
        RestartingLeastSquares(solution="total_least_squares", memory=5.0, **common),
    ]


def regression_rows(y, n, lag):
    """Return regressand and regressors of a whole record; NaN if a sample is missing."""
    rows = np.full((y.size, n + 1), np.nan)
    span = 2 * n * lag
    if y.size > span:
        delayed = np.column_stack([y[span - j * lag : y.size - j * lag] for j in range(2 * n + 1)])
        rows[span:] = delayed @ delay_table(n).T
    return rows[:, n], rows[:, :n]


def frequencies_of(theta, delay):
    """Return the frequencies for the parameters of the delay regression, and their flags."""
    theta = np.ascontiguousarray(theta, dtype=float)
    omega = np.empty(theta.size)
    return omega, Flag(decode(theta, clock_of(delay), np.empty(theta.size), omega))


def clock_of(delay):
    """Return a regression for tests in which only the delay matters."""
    return Clock(1.0, 1, float(delay), 1, 1.0, 1)
