"""Results of an estimation: the estimated model, its accuracy, and how the iterations ended."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Self

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.inference.fitted_model import FittedModel
from ctid_cli.inference.model_responses import Estimated
from ctid_cli.inference.sensitivities import Parametric
from ctid_cli.inference.uncertainty import Uncertainty
from ctid_cli.models.additive import AdditiveModel
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.treatment import Holds
from ctid_cli.text import Shown, listed, wrapped

#: Names of the parameters of one transfer function.
_OF_INPUT = r"[ab]\d+|delay"


class Status(Enum):
    """Outcome of an estimation: what happened, and the usual cause."""

    CONVERGED = "The iterations converged to a minimum of the cost."
    LEAST_SQUARES = "A one-shot least-squares estimate: biased by output noise; use it as a start, not as a result."
    MAX_ITERATIONS = (
        "The iterations stopped at max_iterations before reaching the tolerance; raise max_iterations, or start closer."
    )
    STALLED = (
        "No step lowers the cost although no minimum is reached: too many parameters for these data, or a tolerance "
        "below what rounding allows."
    )
    AT_BOUND = (
        "The least cost is at the bound of the admissible models: a pole has its largest or smallest allowed "
        "speed, or its smallest allowed damping; or a parameter is at a given bound."
    )
    RIDGE = (
        "The cost is minimal and nearly constant along a line up to the bound of the admissible models: the data "
        "do not determine all parameters."
    )
    DELAY_AT_BOUND = "The delay stopped at one of its bounds."
    LOCAL = "A local minimum: at another delay within the bounds the cost is lower; start there, or use delay_profile."
    REFLECTED = (
        "The last step led to an unstable model, whose poles were reflected: this is not a minimum of the "
        "cost; use fewer poles or another start, or closed-loop instruments for an unstable plant in a loop."
    )
    SINGULAR = (
        "The equations became singular: the data do not determine all parameters; use fewer poles or zeros, or an "
        "input that excites the system more."
    )
    DIVERGED = "The iterations diverged; use variant 'guarded', another svf_cutoff, or a start closer to the solution."

    @property
    def succeeded(self) -> bool:
        """Whether the estimate may be used."""
        return self in (Status.CONVERGED, Status.AT_BOUND, Status.RIDGE, Status.LEAST_SQUARES)


class DeferredFields:
    """A result whose per-sample fields are computed on first use.

    A loaded result has a model and its covariance without its records, which residuals need. The fields in ``deferred``
    must have no default value (a factory is allowed), so that the class has no such attributes.
    """

    deferred: ClassVar[tuple[str, ...]] = ()

    def leave_out(self, fill: Callable[[], Mapping[str, Any]]) -> None:
        """Delete the fields in ``deferred``; the first access to one of them fills them all."""
        for name in self.deferred:
            self.__dict__.pop(name, None)
        self.__dict__["_fill"] = fill

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            fill = self.__dict__.get("_fill")
            if fill is None or name not in self.deferred:
                raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
            values = fill()
            self.__dict__.update({each: values[each] for each in self.deferred})
            return self.__dict__[name]


class AssumedHold(NamedTuple):
    """Hold of a smooth input whose hold was not given."""

    hold: Holds
    #: Other holds that fit as well.
    others: tuple[Holds, ...] = ()

    @property
    def sentence(self) -> str:
        """What was taken, and why; empty if constant values between the samples fit clearly best."""
        best, *likely = (each if isinstance(each, str) else ", ".join(each) for each in (self.hold, *self.others))
        start = f"The hold of the input was not given: {best} fits"
        if likely:
            return f"{start} best, and {listed(likely)} not clearly worse. Give the hold."
        return "" if best == "zoh" else f"{start} best. Give the hold."


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
class Fit(FittedModel, Shown):
    """An estimated model, its accuracy, and the iterations.

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
        Distribution of the estimates: covariance formula and quantiles; None for the normal distribution.
    in_ignored_loop : bool, default False
        Whether the input responds to the output through a loop that the estimator ignores.
    assumed_hold : AssumedHold, optional
        Hold of a smooth input whose hold was not given; None if it was given.
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
    assumed_hold: AssumedHold | None = None

    def __repr__(self) -> str:
        errors = self.standard_errors
        listed = ", ".join(f"{name} = {value:.6g} ± {errors[name]:.2g}" for name, value in self.parameters.items())
        head = f"{type(self).__name__}: {self.status.name}, fit {self.fit_percent:.5g} % of {self.count} samples"
        return f"{head}\n{wrapped(listed, '  ')}"

    def marks(self, time_unit: str = "s") -> list[str]:
        """Return what is to be known of the estimate, in sentences.

        Parameters
        ----------
        time_unit : str, default "s"
            Unit of time of the records.

        Returns
        -------
        list of str
            One sentence for each; empty if there is nothing to say.
        """
        return [self.assumed_hold.sentence] if self.assumed_hold is not None and self.assumed_hold.sentence else []

    @property
    def _misfit(self) -> float:
        """Measure of the error of this fit, with which fits of the same samples are compared."""
        return self.cost

    def _is_likely_as(self, best: Self) -> bool:
        """Return whether the data do not reject this fit against a better one; without residuals they do."""
        return False

    def _joined(self, others: Sequence[Self]) -> Self:
        """Return the fit with intervals of the delay that contain those of other fits."""
        return self

    @property
    def parameters(self) -> dict[str, float]:
        """Free parameters by name; of submodels ``g1_a1 … g1_b0 …, g2_a1 …``, numbered by the power of p."""
        parametric = Parametric(self.parametrised, self.parameter_names)
        values = dict(zip(parametric.every, parametric.theta.tolist(), strict=True))
        return {name: values[name] for name in self.parameter_names}

    @property
    def standard_errors(self) -> dict[str, float]:
        """Asymptotic standard errors by name; NaN where they are not defined."""
        with np.errstate(invalid="ignore"):
            errors = np.sqrt(np.diag(self.covariance))
        return dict(zip(self.parameter_names, errors.tolist(), strict=True))

    @property
    def quantiles(self) -> dict[str, float]:
        """Half-widths of the 95 % intervals of the parameters in standard errors, by name [-]."""
        law = self.law or Uncertainty.known(self.covariance)
        return dict(zip(self.parameter_names, law.quantiles().tolist(), strict=True))

    @property
    def parametrised(self) -> TransferFunction | AdditiveModel:
        """The model in the estimated parametrisation."""
        return self.model

    def _estimated(self) -> Estimated:
        """Return the model with the joint distribution of its parameters."""
        law = self.law or Uncertainty.known(self.covariance)
        return Estimated(Parametric(self.parametrised, self.parameter_names), law)


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
        return cls(model, tuple(bare if re.fullmatch(_OF_INPUT, bare) else f"other {each}" for bare, each in own), law)

    def _estimated(self) -> Estimated:
        """Return the transfer function with the joint distribution of all parameters."""
        return Estimated(Parametric(self.model, self.parameter_names), self.law)
