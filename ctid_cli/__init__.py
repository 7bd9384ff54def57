"""Identification of continuous-time models with a time delay, and Monte Carlo studies of it."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
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
    from ctid_cli.inference import Fit as Fit
    from ctid_cli.inference import Status as Status
    from ctid_cli.inference import cramer_rao_bound as cramer_rao_bound
    from ctid_cli.inference import fit_percent as fit_percent
    from ctid_cli.models import TransferFunction as TransferFunction
    from ctid_cli.signals import HeldSignal as HeldSignal
    from ctid_cli.signals import Record as Record
    from ctid_cli.signals import read_record as read_record

__version__ = "0.1.0"

# Imported when first asked for: `ctid --help` must not wait for numpy and numba.
_HOME = {
    "DelayProfile": "estimators",
    "Fit": "inference",
    "HeldSignal": "signals",
    "Lowpass": "estimators",
    "Record": "signals",
    "Srivc": "estimators",
    "Start": "estimators",
    "Status": "inference",
    "Svf": "estimators",
    "TdSrivc": "estimators",
    "TransferFunction": "models",
    "UsefulRedundancy": "estimators",
    "cramer_rao_bound": "inference",
    "fit_percent": "inference",
    "identify": "estimators",
    "minimise_redundantly": "estimators",
    "read_record": "signals",
    "simulate": "filtering",
}
__all__ = ["__version__", *sorted(_HOME)]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'ctid_cli' has no attribute {name!r}")
    return getattr(import_module(f"ctid_cli.{_HOME[name]}"), name)
