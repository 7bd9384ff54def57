"""Models: what an estimator returns and a simulation takes."""

from ctid_cli.models.additive import AdditiveModel, Submodel, Term
from ctid_cli.models.controller import DiscreteController
from ctid_cli.models.factoring import (
    FactoringError,
    factored,
    factored_jacobian,
    unfactored,
    unfactored_jacobian,
)
from ctid_cli.models.transfer_function import TransferFunction

__all__ = [
    "AdditiveModel",
    "DiscreteController",
    "FactoringError",
    "Submodel",
    "Term",
    "TransferFunction",
    "factored",
    "factored_jacobian",
    "unfactored",
    "unfactored_jacobian",
]
