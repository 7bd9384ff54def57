"""Output-error estimation of a sum of submodels: free delay, estimated state and offset, several records."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import ClassVar

import numpy as np

from ctid_cli.errors import OptionError
from ctid_cli.estimation.additive_problem import AdditiveProblem
from ctid_cli.estimation.common import Fixed, Start, StartFrom, checked_bounds, places_of
from ctid_cli.estimation.measured_records import MeasuredRecords, Treatment
from ctid_cli.estimation.optimum.best_model import Begin, poles_of_submodels
from ctid_cli.estimation.optimum.known import NOTHING, KnownCoefficients
from ctid_cli.estimation.parameter_layout import SumDegrees
from ctid_cli.estimators.additive_srivc import check_submodels, check_terms
from ctid_cli.estimators.delay_profile import RecordsEstimator, check_clocks, check_positive, check_treatment
from ctid_cli.estimators.measured_fit import MeasuredFit
from ctid_cli.estimators.measured_submodels import SubmodelsFit, sampling_margin
from ctid_cli.inference.sensitivities import SumStructure
from ctid_cli.inference.uncertainty import DRAWS, Covariance
from ctid_cli.models.additive import AdditiveModel, Term, degrees_of, names_of
from ctid_cli.signals.record import Record, as_records
from ctid_cli.signals.treatment import InitialState, InputBefore, LossKind, Offset

#: Methods by which starts were found.
GROWN = "Submodels were found one after the other, the first over the whole range of the delay."
GIVEN = f"The start was given. {GROWN}"


@dataclass(frozen=True)
class AdditiveOutputError(RecordsEstimator):
    """Output-error estimate of a sum of submodels, together with delay, initial state and offset.

    Parameters
    ----------
    terms : tuple of Term
        Degrees of the submodels.
    delay_bounds : tuple of float, default (0, 0)
        Least and greatest delay [s]; equal values fix the delay.
    initial_state : {"rest", "estimate", "periodic"}, default "rest"
        State before the record, as in ``delay_profile``.
    offset : {"none", "remove", "estimate", "drift"}, default "none"
        Offset of the output, as in ``delay_profile``.
    loss : {"squares", "huber", "tukey"}, default "squares"
        Loss function of the output errors, as in ``delay_profile``.
    covariance : {"auto", "white", "robust", "bootstrap"}, default "auto"
        Noise assumed for the standard errors, as in ``delay_profile``.
    bootstrap_draws : int, default 500
        Number of simulated noise sequences of a bootstrap [-].
    fixed : tuple of Fixed, optional
        Known parameters, by their names ``g1_a1 ... g1_b0 ...``.
    input_before : float or "first", optional
        Constant input before the first sample, as in ``delay_profile``.
    noise_model : str, default "white"
        Model of the output noise, estimated with the plant, as in ``delay_profile``.

    Raises
    ------
    ValueError
        If an option is out of range.

    Notes
    -----
    The numerators are eliminated: the search is over the poles of the submodels and the delay, within the same set of
    admissible poles as for one transfer function. It starts from a given model, if any, and from sums that are extended
    term by term: the best first submodel on a grid of frequencies, dampings and delays, then the best second one, and
    so on, with the lowest minima refined at each step. Submodels of equal structure are sorted by natural frequency,
    unless parameters are fixed by name.
    """

    kind: ClassVar[str] = "additive_output_error"
    start_from: ClassVar[StartFrom | None] = "parameters"
    factored: ClassVar[bool] = True

    terms: tuple[Term, ...]
    delay_bounds: tuple[float, float] = (0.0, 0.0)
    initial_state: InitialState = "rest"
    offset: Offset = "none"
    loss: LossKind = "squares"
    covariance: Covariance = "auto"
    bootstrap_draws: int = DRAWS
    fixed: tuple[Fixed, ...] | None = None
    input_before: InputBefore = None
    noise_model: str = "white"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_terms(self.terms)
        if not any(term.poles for term in self.terms):
            raise OptionError("terms", "terms must have a pole to search; integrators and gains alone have none")
        check_treatment(self)
        low, high = bounds = checked_bounds(self.delay_bounds, known_allowed=True)
        object.__setattr__(self, "delay_bounds", bounds)
        if low < high and any(term.zeros == term.order for term in self.terms):
            raise OptionError("terms", "terms must have fewer zeros than poles while the delay is estimated")
        names = names_of(self.terms)
        for place, value in places_of(self.fixed, names).items():
            if "_a" in names[place]:
                check_positive(names[place], value)

    @property
    def poles(self) -> int:
        """Number of poles, including integrators."""
        return degrees_of(self.terms)[0]

    @property
    def order(self) -> int:
        """Number of poles, including integrators, as of one transfer function."""
        return self.poles

    @property
    def zeros(self) -> int:
        """Degree of the numerator of the sum."""
        return degrees_of(self.terms)[1]

    @property
    def integrators(self) -> int:  # type: ignore[override]
        """Poles at the origin."""
        return sum(term.integrators for term in self.terms)

    def check_start(self, start: Start) -> None:
        """Raise DataError for a model with other submodels."""
        if start.model is not None:
            check_submodels(start.model, self.terms)

    def _lay_out(self, records: Record | Sequence[Record]) -> MeasuredRecords:
        several = as_records(records)
        if self.noise_model != "white":
            check_clocks(several)
        low, high = self.delay_bounds
        known = places_of(self.fixed, names_of(self.terms))
        return MeasuredRecords(
            several,
            SumDegrees(SumStructure(self.terms, delay=low < high)),
            Treatment(
                self.delay_bounds,
                self.initial_state,
                self.offset,
                "foh",
                bridge=self.loss != "squares",
                integrators=(self.integrators,),
                input_before=self.input_before,
            ),
            KnownCoefficients.of_sum(self.terms, known) if known else NOTHING,
        )

    def _minimum(self, measured: MeasuredRecords, start: Start | None) -> SubmodelsFit:
        starts: list[Begin] = []
        method = GROWN
        if start is not None and start.model is not None:
            check_submodels(start.model, self.terms)
            low, high = self.delay_bounds
            delay = 0.5 * (low + high) if start.delay is None else start.delay
            starts, method = [(poles_of_submodels(start.model), delay)], GIVEN
        fit = self._least(measured, starts)
        return self._of_submodels(measured, fit, method)

    def _of_submodels(self, measured: MeasuredRecords, fit: MeasuredFit, method: str) -> SubmodelsFit:
        """Return the fit with its submodels and their consistency conditions."""
        size = sum(term.size for term in self.terms)
        additive = AdditiveModel.from_theta(fit.theta[:size], self.terms, fit.model.delay)
        consistency, interval = np.nan, measured.data[0].interval
        if len(measured.data) == 1 and self.initial_state == "rest":
            problem = AdditiveProblem(measured.data[0], self.terms, additive.delay)
            consistency = problem.consistency_margin(additive.theta)
        return SubmodelsFit(
            **{one.name: getattr(fit, one.name) for one in fields(fit)},
            additive=additive,
            start_method=method,
            consistency=consistency,
            sampling=sampling_margin(additive, interval),
        )
