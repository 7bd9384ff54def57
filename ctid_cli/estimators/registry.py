"""Every estimator of a system by the name that a specification gives it."""

from __future__ import annotations

from typing import Any

from ctid_cli.estimators.additive_srivc import AdditiveSrivc
from ctid_cli.estimators.delay_profile import DelayProfile
from ctid_cli.estimators.srivc import Srivc
from ctid_cli.estimators.svf import Svf
from ctid_cli.estimators.td_srivc import TdSrivc
from ctid_cli.estimators.useful_redundancy import UsefulRedundancy

ESTIMATORS: dict[str, type[Any]] = {
    estimator.kind: estimator for estimator in (Svf, Srivc, TdSrivc, UsefulRedundancy, DelayProfile, AdditiveSrivc)
}
