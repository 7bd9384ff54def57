"""The transfer function of one of several inputs, with the joint distribution of all parameters."""

from __future__ import annotations

import re
from dataclasses import dataclass

from ctid_cli.inference.fitted_model import FittedModel
from ctid_cli.inference.model_responses import Estimated
from ctid_cli.inference.sensitivities import Parametric
from ctid_cli.inference.uncertainty import Uncertainty
from ctid_cli.models.transfer_function import TransferFunction

_OWN = re.compile(r"[ab]\d+|delay")


@dataclass(frozen=True, eq=False)
class InputFit(FittedModel):
    """Part of a fit with several inputs that belongs to one of them."""

    model: TransferFunction
    #: Names of all parameters of the fit; those that this transfer function does not have begin with "other".
    parameter_names: tuple[str, ...]
    #: Covariance of all of them.
    law: Uncertainty

    @classmethod
    def of(cls, name: str, model: TransferFunction, names: tuple[str, ...], law: Uncertainty) -> InputFit:
        """Return the transfer function of an input; parameters of a common denominator have no prefix."""
        own = [(each.removeprefix(f"{name}_"), each) for each in names]
        return cls(model, tuple(bare if _OWN.fullmatch(bare) else f"other {each}" for bare, each in own), law)

    def _estimated(self) -> Estimated:
        """Return the transfer function with the joint distribution of all parameters."""
        return Estimated(Parametric(self.model, self.parameter_names), self.law)
