"""Frequencies of multi-sinusoidal signals: online estimators and batch references.

An online estimator is a frozen dataclass of options. ``tracker = options.start(interval)`` takes samples one by one,
``tracker.update(sample)``, or many at once, ``tracker.run(samples)``, with the same numbers bit for bit;
``tracker.state()`` and ``options.restore(interval, state)`` stop and go on in the middle of a signal. A batch estimator
(``online`` is False) has ``options.estimate(samples, interval)``. Every estimate carries flags that say why it must not
be trusted, if so, and a sentence for each.

The recommended tracker is :class:`RestartingLeastSquares` with a prefilter. :class:`DremGradient`,
:class:`DremFiniteTime` and :class:`DremWindow` mix the same regression into scalar ones. :class:`AdaptiveObserver` and
:class:`FilterRegression` are comparators, derived, not the published algorithms. :class:`Esprit` and
:class:`NonlinearLeastSquares` are references for whole records. :func:`fit_sinusoids` finds amplitudes, phases and the
bias once the frequencies are known.
"""

from typing import Any

from ctid_cli.frequency.adaptive_observer import AdaptiveObserver
from ctid_cli.frequency.amplitudes import Sinusoids, fit_sinusoids
from ctid_cli.frequency.drem_finite_time import DremFiniteTime
from ctid_cli.frequency.drem_gradient import DremGradient
from ctid_cli.frequency.drem_window import DremWindow
from ctid_cli.frequency.esprit import Esprit
from ctid_cli.frequency.filter_regression import FilterRegression
from ctid_cli.frequency.flags import Flag
from ctid_cli.frequency.nonlinear_least_squares import NonlinearLeastSquares
from ctid_cli.frequency.restarting_least_squares import RestartingLeastSquares
from ctid_cli.frequency.tracking import FrequencyEstimate, FrequencyTrack, OnlineEstimator, Tracker

#: Every frequency estimator by the name that a specification gives it.
FREQUENCY_ESTIMATORS: dict[str, type[Any]] = {
    estimator.kind: estimator
    for estimator in (
        DremGradient,
        DremFiniteTime,
        DremWindow,
        RestartingLeastSquares,
        AdaptiveObserver,
        FilterRegression,
        Esprit,
        NonlinearLeastSquares,
    )
}

__all__ = [
    "FREQUENCY_ESTIMATORS",
    "AdaptiveObserver",
    "DremFiniteTime",
    "DremGradient",
    "DremWindow",
    "Esprit",
    "FilterRegression",
    "Flag",
    "FrequencyEstimate",
    "FrequencyTrack",
    "NonlinearLeastSquares",
    "OnlineEstimator",
    "RestartingLeastSquares",
    "Sinusoids",
    "Tracker",
    "fit_sinusoids",
]
