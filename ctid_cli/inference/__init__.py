"""Accuracy and quality of an estimate, whichever algorithm found it."""

from ctid_cli.inference.accuracy import ParameterAccuracy
from ctid_cli.inference.additive_derived import additive_derived
from ctid_cli.inference.asymptotic import closed_loop_accuracy, open_loop_accuracy
from ctid_cli.inference.conditioning import describe_conditioning
from ctid_cli.inference.covariance import condition_number, white_noise_covariance
from ctid_cli.inference.cramer_rao import cramer_rao_bound
from ctid_cli.inference.criteria import (
    InformationCriteria,
    information_criteria,
    r_t_squared,
    young_information_criterion,
)
from ctid_cli.inference.delay_interval import DelayInterval, profile_likelihood_interval, quadratic_is_doubtful
from ctid_cli.inference.derived import DerivedParameter, derived_parameters
from ctid_cli.inference.diagnostics import fit_percent, percent_from_r_squared, r_squared
from ctid_cli.inference.fit import Fit, IterationRecord
from ctid_cli.inference.noise_model import NoiseModel, fit_noise_model
from ctid_cli.inference.residuals import ResidualTests, residual_tests
from ctid_cli.inference.robust import sandwich_covariance
from ctid_cli.inference.sensitivity import Structure
from ctid_cli.inference.status import Status
from ctid_cli.models.factoring import pole_jacobian

__all__ = [
    "DelayInterval",
    "DerivedParameter",
    "Fit",
    "InformationCriteria",
    "IterationRecord",
    "NoiseModel",
    "ParameterAccuracy",
    "ResidualTests",
    "Status",
    "Structure",
    "additive_derived",
    "closed_loop_accuracy",
    "condition_number",
    "cramer_rao_bound",
    "derived_parameters",
    "describe_conditioning",
    "fit_noise_model",
    "fit_percent",
    "information_criteria",
    "open_loop_accuracy",
    "percent_from_r_squared",
    "pole_jacobian",
    "profile_likelihood_interval",
    "quadratic_is_doubtful",
    "r_squared",
    "r_t_squared",
    "residual_tests",
    "sandwich_covariance",
    "white_noise_covariance",
    "young_information_criterion",
]
