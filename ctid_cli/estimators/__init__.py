"""Estimators: one algorithm per file, their options are their fields."""

from typing import Any

from ctid_cli.estimators.additive_srivc import AdditiveFit, AdditiveSrivc
from ctid_cli.estimators.common import Start
from ctid_cli.estimators.compilation import compile_kernels
from ctid_cli.estimators.identification import Identification, identify
from ctid_cli.estimators.measured import DelayProfile, MeasuredFit
from ctid_cli.estimators.redundancy import RedundantMinimum, local_paths, minimise_redundantly
from ctid_cli.estimators.srivc import Srivc
from ctid_cli.estimators.svf import Svf
from ctid_cli.estimators.td_srivc import TdSrivc
from ctid_cli.estimators.useful_redundancy import RedundantFit, UsefulRedundancy
from ctid_cli.filtering.lowpass import Lowpass

#: Every estimator by the name that a specification gives it.
ESTIMATORS: dict[str, type[Any]] = {
    estimator.kind: estimator for estimator in (Svf, Srivc, TdSrivc, UsefulRedundancy, DelayProfile, AdditiveSrivc)
}

__all__ = [
    "ESTIMATORS",
    "AdditiveFit",
    "AdditiveSrivc",
    "DelayProfile",
    "Identification",
    "Lowpass",
    "MeasuredFit",
    "RedundantFit",
    "RedundantMinimum",
    "Srivc",
    "Start",
    "Svf",
    "TdSrivc",
    "UsefulRedundancy",
    "compile_kernels",
    "identify",
    "local_paths",
    "minimise_redundantly",
]
