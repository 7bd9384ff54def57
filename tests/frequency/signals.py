"""Signals for the tests beside this file, and the estimators that they try."""

import numpy as np

from ctid_cli.frequency.adaptive_observer import AdaptiveObserver
from ctid_cli.frequency.drem_finite_time import DremFiniteTime
from ctid_cli.frequency.drem_gradient import DremGradient
from ctid_cli.frequency.drem_window import DremWindow
from ctid_cli.frequency.filter_regression import FilterRegression
from ctid_cli.frequency.restarting_least_squares import RestartingLeastSquares

INTERVAL = 0.01
#: Well-separated frequencies [rad/s] for any number of tones up to five.
OMEGA = {n: np.array([1.0, 2.0, 3.0, 4.2, 5.5])[:n] for n in range(1, 6)}
AMPLITUDES = np.array([1.0, 0.8, 1.3, 0.6, 1.1])
PHASES = np.array([0.3, 1.1, -0.7, 2.0, -1.5])


def tones(n, count, interval=INTERVAL, omega=None):
    """The n sinusoids of a signal one by one, shape (count, n)."""
    t = interval * np.arange(count)
    return AMPLITUDES[:n] * np.sin(np.outer(t, OMEGA[n] if omega is None else omega) + PHASES[:n])


def online_estimators(n=2):
    """One of each kind, for n tones of the signals above, fit for a coarse clock."""
    initial = tuple(OMEGA[n] * 1.1)
    common = {"tones": n, "h": 0.4}
    return [
        DremGradient(d=0.3, epsilon=0.5, gamma=(1.0, 2.0, 0.5, 1.0, 1.0)[:n], initial_frequencies=initial, **common),
        DremFiniteTime(d=0.3, epsilon=0.5, first_row=0, **common),
        DremFiniteTime(d=0.3, gated=False, prefilter=0.2, **common),
        DremWindow(d=0.3, memory=1.5, difference=0.7, **common),
        RestartingLeastSquares(prefilter=0.5, **common),
        RestartingLeastSquares(solution="total_least_squares", memory=5.0, **common),
        AdaptiveObserver(tones=n, initial_frequencies=initial),
        FilterRegression(tones=n, pole=4.0, initial_frequencies=initial),
        FilterRegression(tones=n, pole=4.0, algorithm="gradient", initial_frequencies=initial),
    ]
