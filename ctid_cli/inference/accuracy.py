"""Covariance of the parameters of a known system, as one fraction or as a sum of submodels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.inference.sensitivity import Structure
from ctid_cli.models.additive import AdditiveModel, Term
from ctid_cli.models.factoring import FactoringError, factored, unfactored_jacobian
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

    @property
    def standard_errors(self) -> Array:
        """Square roots of the variances, in the units of the parameters, shape (p,)."""
        errors: Array = np.sqrt(np.diag(self.covariance))
        return errors

    def factored(self, terms: Sequence[Term] | None = None) -> ParameterAccuracy:
        """Accuracy of the sum of submodels into which an estimated transfer function is factored.

        By the delta method. Factoring undoes the sum of submodels whose numerators have full length, so its derivatives
        are the inverse of those of the sum; this holds for estimated numerators of any length.
        """
        if isinstance(self.model, AdditiveModel):
            return self
        additive = factored(self.model, terms)
        n = self.model.order
        delays = int(self.names[-1:] == ("delay",))
        coefficients = len(self.names) - n - delays
        inverse = np.linalg.inv(unfactored_jacobian(additive))
        if n + coefficients > inverse.shape[1]:
            raise FactoringError(
                "the estimated numerator has the degree of the denominator, and the true one a lower one: submodels of "
                "the true system leave no room for a direct feedthrough"
            )
        # Of a numerator of full length the last coefficients are estimated; the delay is the same in both forms.
        columns = np.r_[:n, inverse.shape[1] - coefficients : inverse.shape[1]]
        size = inverse.shape[0]
        jacobian = np.zeros((size + delays, len(self.names)))
        jacobian[:size, : n + coefficients] = inverse[:, columns]
        jacobian[size:, n + coefficients :] = np.eye(delays)
        return ParameterAccuracy(
            additive,
            additive.names + self.names[len(self.names) - delays :],
            np.concatenate([additive.theta, self.values[len(self.names) - delays :]]),
            jacobian @ self.covariance @ jacobian.T,
        )


def estimated_parameters(
    model: AdditiveModel | TransferFunction, zeros: int | None = None, *, delay: bool = False
) -> tuple[tuple[str, ...], Array]:
    """Names and true values of what is estimated."""
    if isinstance(model, AdditiveModel):
        if zeros is not None or delay:
            raise ValueError("an additive model has its degrees in its terms and a known delay; leave both out")
        return model.names, model.theta
    own = model.numerator.size - 1
    m = own if zeros is None else zeros
    if not own <= m <= model.order:
        raise ValueError(f"zeros must be from {own}, as the model has, to its {model.order} poles; got {zeros}")
    parts = [model.denominator[1:], np.zeros(m - own), model.numerator, np.full(int(delay), model.delay)]
    return Structure(model.order, m, delay).names, np.concatenate(parts)
