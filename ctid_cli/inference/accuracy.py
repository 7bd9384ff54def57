"""Covariance of the parameters of a known system, as one fraction or as a sum of submodels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.inference.sensitivity import Structure
from ctid_cli.models.additive import AdditiveModel, Term
from ctid_cli.models.factoring import factored, factored_jacobian
from ctid_cli.models.transfer_function import TransferFunction


@dataclass(frozen=True, eq=False)
class ParameterAccuracy:
    """Parameters of the true system and the covariance of their estimates."""

    model: AdditiveModel | TransferFunction
    names: tuple[str, ...]
    #: Their true values, shape (p,).
    values: Array
    #: Covariance of their estimates, shape (p, p).
    covariance: Array

    @classmethod
    def of(
        cls, model: AdditiveModel | TransferFunction, covariance: Array, zeros: int | None = None, delay: bool = False
    ) -> ParameterAccuracy:
        """Accuracy of the parameters of a model, or of a fraction with more zeros or with its delay estimated too."""
        if isinstance(model, AdditiveModel):
            return cls(model, model.names, model.theta, covariance)
        own = model.numerator.size - 1
        m = own if zeros is None else zeros
        parts = [model.denominator[1:], np.zeros(m - own), model.numerator, np.full(int(delay), model.delay)]
        return cls(model, Structure(model.order, m, delay).names, np.concatenate(parts), covariance)

    @property
    def standard_errors(self) -> Array:
        """Square roots of the variances, in the units of the parameters, shape (p,)."""
        errors: Array = np.sqrt(np.diag(self.covariance))
        return errors

    def factored(self, terms: Sequence[Term] | None = None) -> ParameterAccuracy:
        """Accuracy of the submodels into which an estimated transfer function is factored, by the delta method."""
        if isinstance(self.model, AdditiveModel):
            return self
        additive = factored(self.model, terms)
        # The delay is the same in both forms.
        own = len(self.names) - int(self.names[-1] == "delay")
        size, delays = additive.theta.size, len(self.names) - own
        jacobian = np.zeros((size + delays, len(self.names)))
        jacobian[:size, :own] = factored_jacobian(self.model, additive, own - self.model.order)
        jacobian[size:, own:] = np.eye(delays)
        names, values = additive.names + self.names[own:], np.concatenate([additive.theta, self.values[own:]])
        return ParameterAccuracy(additive, names, values, jacobian @ self.covariance @ jacobian.T)
