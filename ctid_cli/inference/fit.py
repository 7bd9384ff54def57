"""What an estimation returns."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.inference.fitted_model import FittedModel, responses
from ctid_cli.inference.quantile import normal_quantile
from ctid_cli.inference.status import Status
from ctid_cli.inference.uncertainty import Uncertainty
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.text import ShownAsTable, wrapped

if TYPE_CHECKING:
    from ctid_cli.inference.responses import Estimated
    from ctid_cli.models.additive import AdditiveModel


@dataclass(frozen=True)
class IterationRecord:
    """One accepted iteration."""

    stage: str
    iteration: int
    #: Delay [s].
    delay: float
    #: Mean squared output error [output unit^2] on the data of this stage.
    cost: float
    denominator: tuple[float, ...]
    numerator: tuple[float, ...]


@dataclass(frozen=True, eq=False, repr=False)
class Fit(FittedModel, ShownAsTable):
    """An estimated model, its accuracy, and how it was reached.

    Parameters
    ----------
    model : TransferFunction
        The estimate: monic denominator, descending powers, delay [s].
    parameter_names : tuple of str
        Names of the free parameters, in the order of ``covariance``.
    covariance : ndarray, shape (p, p)
        Asymptotic covariance by the formula that ``law`` names; NaN where it is not defined.
    status : Status
        How the iterations ended.
    cost : float
        Mean squared output error over the used samples [output unit^2].
    fit_percent : float
        ``100 (1 - ||y - x|| / ||y - mean y||)`` over the used samples, zero initial state [%].
    r2 : float
        ``1 - ||y - x||^2 / ||y - mean y||^2`` [-].
    count : int
        Number of samples used.
    iterations : int
        Iterations in all stages.
    condition_number : float
        Of the scaled ``sum psi psi'`` [-].
    history : sequence of IterationRecord
        The accepted iterations.
    law : Uncertainty, optional
        What the covariance is from, and how many standard errors intervals reach; None where that is not known, and
        intervals are then those of the normal distribution.
    in_ignored_loop : bool, default False
        Whether the input answers to the output through a loop of which the estimator knows nothing.
    """

    model: TransferFunction
    parameter_names: tuple[str, ...]
    covariance: Array
    status: Status
    cost: float
    fit_percent: float
    r2: float
    count: int
    iterations: int
    condition_number: float
    history: Sequence[IterationRecord] = ()
    law: Uncertainty | None = None
    in_ignored_loop: bool = False

    def __repr__(self) -> str:
        errors = self.standard_errors
        listed = ", ".join(f"{name} = {value:.6g} ± {errors[name]:.2g}" for name, value in self.parameters.items())
        head = f"{type(self).__name__}: {self.status.name}, fit {self.fit_percent:.5g} % of {self.count} samples"
        return f"{head}\n{wrapped(listed, '  ')}"

    @property
    def parameters(self) -> dict[str, float]:
        """Free parameters by name."""
        a, b = self.model.denominator, self.model.numerator
        values = {f"a{i}": float(a[i]) for i in range(1, a.size)}
        # A leading numerator coefficient may be exactly zero and is dropped by the model; names keep their powers.
        zeros = sum(name.startswith("b") for name in self.parameter_names)
        padded = np.concatenate([np.zeros(zeros - b.size), b])
        values |= {f"b{j}": float(value) for j, value in enumerate(padded)}
        values["delay"] = self.model.delay
        return {name: values[name] for name in self.parameter_names}

    @property
    def standard_errors(self) -> dict[str, float]:
        """Asymptotic standard errors by name; NaN where they are not defined."""
        with np.errstate(invalid="ignore"):
            errors = np.sqrt(np.diag(self.covariance))
        return dict(zip(self.parameter_names, errors.tolist(), strict=True))

    @property
    def quantiles(self) -> dict[str, float]:
        """Standard errors to each side of the 95 % intervals of the parameters, by name [-]."""
        if self.law is None:
            return dict.fromkeys(self.standard_errors, normal_quantile())
        return dict(zip(self.parameter_names, self.law.quantiles().tolist(), strict=True))

    @property
    def parametrised(self) -> "TransferFunction | AdditiveModel":
        """The model in the form that has the parameters."""
        return self.model

    def _estimated(self) -> "Estimated":
        """The model with the joint law of its parameters."""
        if self.law is not None:
            return responses.with_uncertainty(self.parametrised, self.parameter_names, self.law, defined=True)
        return responses.with_covariance(self.parametrised, self.parameter_names, self.covariance)
