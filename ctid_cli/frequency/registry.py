"""Every estimator of frequencies by the name that a specification gives it."""

from __future__ import annotations

from typing import Any

from ctid_cli.frequency.adaptive_observer import AdaptiveObserver
from ctid_cli.frequency.drem_finite_time import DremFiniteTime
from ctid_cli.frequency.drem_gradient import DremGradient
from ctid_cli.frequency.drem_window import DremWindow
from ctid_cli.frequency.esprit import Esprit
from ctid_cli.frequency.filter_regression import FilterRegression
from ctid_cli.frequency.nonlinear_least_squares import NonlinearLeastSquares
from ctid_cli.frequency.restarting_least_squares import RestartingLeastSquares

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
