"""Compile the kernels that the tests call before their workers start: each of them would compile most of them.

``python -m tests.compile_kernels`` stores them in the package's cache, from which all later processes load them.
"""

import numpy as np

from ctid_cli import (
    DelayProfile,
    LoopOutputError,
    Srivc,
    TdSrivc,
    UsefulRedundancy,
    track,
)
from ctid_cli.custom_code import STUDIES, find_class
from ctid_cli.estimation.compilation import compile_kernels
from ctid_cli.frequency.drem import DremFiniteTime, DremGradient, DremWindow
from ctid_cli.frequency.restarting_least_squares import RestartingLeastSquares
from ctid_cli.signals.sampled_signal import SampledSignal

ESTIMATORS = (
    Srivc(2, 1, 0.0),
    TdSrivc(2, 0, delay_bounds=(0.0, 1.0)),
    UsefulRedundancy(2, 0, delay_bounds=(0.0, 1.0)),
    DelayProfile(2, 0, (0.0, 1.0), initial_state="estimate", offset="estimate"),
    DelayProfile(2, 0, (0.0, 1.0), noise_model="arma:1,1"),
)
IN_LOOP = (Srivc(2, 1, 0.0, instruments="closed_loop"), LoopOutputError(2, 0, (0.0, 0.5)))
COMPARATORS = STUDIES / "finite_time_frequency" / "comparators"
Observer = find_class("./adaptive_observer.py:AdaptiveObserver", COMPARATORS)
FilterRegression = find_class("./filter_regression.py:FilterRegression", COMPARATORS)
FREQUENCY = (
    Observer(tones=2, initial_frequencies=(2.0, 5.0)),
    FilterRegression(tones=2, pole=3.0, algorithm="gradient"),
    DremGradient(tones=2, h=0.03, d=0.05),
    DremFiniteTime(tones=2, h=0.03, d=0.05),
    DremWindow(tones=2, h=0.03, d=0.05, memory=1.0),
    RestartingLeastSquares(tones=2, h=0.03),
)


def main() -> None:
    """Compile what the estimators of systems, of frequencies and of tones call."""
    for regular in (True, False):
        compile_kernels(ESTIMATORS, regular=regular)
        compile_kernels(IN_LOOP, regular=regular, closed=True)
    t = 0.01 * np.arange(1200)
    samples = np.sin(2 * np.pi * 5.0 * t) + 0.5 * np.sin(2 * np.pi * 11.0 * t + 1.0)
    for estimator in FREQUENCY:
        estimator.track(samples, 0.01)
    track(SampledSignal(samples, 0.01, 0.0, "", "", None, "s", None), tones=2)


if __name__ == "__main__":
    main()
