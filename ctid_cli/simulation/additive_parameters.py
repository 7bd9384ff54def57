"""Estimates in the parameters of submodels, whichever form they were estimated in."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ctid_cli.errors import DataError
from ctid_cli.models.additive import Term
from ctid_cli.models.factoring import factored, factored_jacobian


def additive_parameters(fit: Any, terms: Sequence[Term] | None) -> tuple[dict[str, float] | None, dict[str, float]]:
    """Parameters of the submodels of an estimate, and their standard errors.

    The covariance of a fraction's coefficients goes with the Jacobian of its partial fractions. A fraction has none in
    the given terms if its poles are repeated, not as many, or more of them complex than the terms have room for.
    """
    additive = getattr(fit, "additive", None)
    if additive is not None:
        return additive.parameters, {}
    if terms is None or fit.model is None:
        return None, {}
    try:
        with np.errstate(all="ignore"):  # what overflows is refused
            model = factored(fit.model, terms)
            jacobian = factored_jacobian(fit.model, model)
    except (DataError, np.linalg.LinAlgError):
        return None, {}
    coefficients, names = list(fit.model.parameters), list(fit.parameter_names)
    errors = np.full(len(model.names), np.nan)
    # A leading zero is no coefficient of the model, though it is a parameter: the powers would not match.
    if set(names) - {"delay"} == set(coefficients):
        places = [names.index(name) for name in coefficients]
        with np.errstate(invalid="ignore"):
            covariance = jacobian @ fit.covariance[np.ix_(places, places)] @ jacobian.T
            errors = np.sqrt(np.diag(covariance))
    return model.parameters, dict(zip(model.names, errors.tolist(), strict=True))
