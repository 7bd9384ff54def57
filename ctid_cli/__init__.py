"""Identification of continuous-time models, frequencies of signals, and Monte Carlo studies of both."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ctid_cli.estimators import AdditiveSrivc as AdditiveSrivc
    from ctid_cli.estimators import DelayProfile as DelayProfile
    from ctid_cli.estimators import Lowpass as Lowpass
    from ctid_cli.estimators import Srivc as Srivc
    from ctid_cli.estimators import Start as Start
    from ctid_cli.estimators import Svf as Svf
    from ctid_cli.estimators import TdSrivc as TdSrivc
    from ctid_cli.estimators import UsefulRedundancy as UsefulRedundancy
    from ctid_cli.estimators import identify as identify
    from ctid_cli.estimators import minimise_redundantly as minimise_redundantly
    from ctid_cli.filtering import simulate as simulate
    from ctid_cli.filtering import simulate_additive as simulate_additive
    from ctid_cli.filtering import simulate_loop as simulate_loop
    from ctid_cli.frequency import AdaptiveObserver as AdaptiveObserver
    from ctid_cli.frequency import DremFiniteTime as DremFiniteTime
    from ctid_cli.frequency import DremGradient as DremGradient
    from ctid_cli.frequency import DremWindow as DremWindow
    from ctid_cli.frequency import Esprit as Esprit
    from ctid_cli.frequency import FilterRegression as FilterRegression
    from ctid_cli.frequency import NonlinearLeastSquares as NonlinearLeastSquares
    from ctid_cli.frequency import RestartingLeastSquares as RestartingLeastSquares
    from ctid_cli.frequency import fit_sinusoids as fit_sinusoids
    from ctid_cli.inference import Fit as Fit
    from ctid_cli.inference import Status as Status
    from ctid_cli.inference import cramer_rao_bound as cramer_rao_bound
    from ctid_cli.inference import fit_percent as fit_percent
    from ctid_cli.models import AdditiveModel as AdditiveModel
    from ctid_cli.models import DiscreteController as DiscreteController
    from ctid_cli.models import Submodel as Submodel
    from ctid_cli.models import Term as Term
    from ctid_cli.models import TransferFunction as TransferFunction
    from ctid_cli.signals import HeldSignal as HeldSignal
    from ctid_cli.signals import Loop as Loop
    from ctid_cli.signals import Record as Record
    from ctid_cli.signals import read_record as read_record

__version__ = "0.1.0"

# Imported when first asked for: `ctid --help` must not wait for numpy and numba.
_HOME = {
    "AdaptiveObserver": "frequency",
    "AdditiveModel": "models",
    "AdditiveSrivc": "estimators",
    "DelayProfile": "estimators",
    "DiscreteController": "models",
    "DremFiniteTime": "frequency",
    "DremGradient": "frequency",
    "DremWindow": "frequency",
    "Esprit": "frequency",
    "FilterRegression": "frequency",
    "Fit": "inference",
    "HeldSignal": "signals",
    "Loop": "signals",
    "Lowpass": "estimators",
    "NonlinearLeastSquares": "frequency",
    "Record": "signals",
    "RestartingLeastSquares": "frequency",
    "Srivc": "estimators",
    "Start": "estimators",
    "Status": "inference",
    "Submodel": "models",
    "Svf": "estimators",
    "TdSrivc": "estimators",
    "Term": "models",
    "TransferFunction": "models",
    "UsefulRedundancy": "estimators",
    "cramer_rao_bound": "inference",
    "fit_percent": "inference",
    "fit_sinusoids": "frequency",
    "identify": "estimators",
    "minimise_redundantly": "estimators",
    "read_record": "signals",
    "simulate": "filtering",
    "simulate_additive": "filtering",
    "simulate_loop": "filtering",
}
__all__ = ["__version__", *sorted(_HOME)]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'ctid_cli' has no attribute {name!r}")
    return getattr(import_module(f"ctid_cli.{_HOME[name]}"), name)
