"""Accuracy and quality of an estimate, whichever algorithm found it."""

from ctid_cli.inference.covariance import condition_number, white_noise_covariance
from ctid_cli.inference.cramer_rao import cramer_rao_bound
from ctid_cli.inference.diagnostics import fit_percent, r_squared
from ctid_cli.inference.fit import Fit, IterationRecord
from ctid_cli.inference.sensitivity import Structure
from ctid_cli.inference.status import Status

__all__ = [
    "Fit",
    "IterationRecord",
    "Status",
    "Structure",
    "condition_number",
    "cramer_rao_bound",
    "fit_percent",
    "r_squared",
    "white_noise_covariance",
]
