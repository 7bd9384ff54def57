"""Estimates in the parameters of submodels, whichever form they were estimated in."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from ctid_cli.errors import DataError
from ctid_cli.inference.intervals import normal_quantile
from ctid_cli.models.additive import Term
from ctid_cli.models.factoring import factored, factored_jacobian


class InSubmodels(NamedTuple):
    """Parameters of submodels by name; None where an estimate has none."""

    parameters: dict[str, float] | None = None
    standard_errors: Mapping[str, float] = MappingProxyType({})
    #: Standard errors to each side of the 95 % intervals.
    quantiles: Mapping[str, float] = MappingProxyType({})


def additive_parameters(fit: Any, terms: Sequence[Term] | None) -> InSubmodels:
    """Parameters of the submodels of an estimate, with errors and quantiles where it has them in another form.

    The covariance of a fraction's coefficients goes with the Jacobian of its partial fractions. A fraction has none in
    the given terms if its poles are repeated, not as many, or more of them complex than the terms have room for.
    """
    additive = getattr(fit, "additive", None)
    if additive is not None:
        return InSubmodels(additive.parameters)
    if terms is None or fit.model is None:
        return InSubmodels()
    try:
        with np.errstate(all="ignore"):  # what overflows is refused
            model = factored(fit.model, terms)
            jacobian = factored_jacobian(fit.model, model)
    except (DataError, np.linalg.LinAlgError):
        return InSubmodels()
    coefficients, names = list(fit.model.parameters), list(fit.parameter_names)
    errors, quantiles = np.full((2, len(model.names)), np.nan)
    # A leading zero is no coefficient of the model, though it is a parameter: the powers would not match.
    if set(names) - {"delay"} == set(coefficients):
        places = [names.index(name) for name in coefficients]
        with np.errstate(invalid="ignore"):
            covariance = jacobian @ fit.covariance[np.ix_(places, places)] @ jacobian.T
            errors = np.sqrt(np.diag(covariance))
        if fit.law is None:
            quantiles[:] = normal_quantile()
        else:
            quantiles = fit.law.transformed(jacobian @ np.eye(len(names))[places]).quantiles()
    stated = (dict(zip(model.names, each.tolist(), strict=True)) for each in (errors, quantiles))
    return InSubmodels(model.parameters, *stated)
