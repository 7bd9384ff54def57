"""Which structure a record asks for: fits of a range of structures side by side, and the one to take."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from ctid_cli.errors import DataError, OptionError
from ctid_cli.estimation.measured_records import MeasuredRecords
from ctid_cli.estimation.optimum.best_model import best_of_orders
from ctid_cli.estimation.optimum.box import box_of
from ctid_cli.estimation.optimum.starts import QUICK, StructureSearch
from ctid_cli.estimators.delay_profile import DelayProfile, MeasuredFit, fitted
from ctid_cli.estimators.identification import laid_out_validation, tests_of, validated
from ctid_cli.inference import criteria as criteria_of
from ctid_cli.inference.criteria import (
    cross_validated_errors,
    fit_percent,
    innovations_count,
    shared_noise,
    squared_innovations,
)
from ctid_cli.inference.noise_model import NoiseModel
from ctid_cli.inference.residual_tests import ResidualTests
from ctid_cli.inference.response_test import AnswerTest, response_test
from ctid_cli.inference.sensitivities import Structure
from ctid_cli.signals.record import Record
from ctid_cli.signals.treatment import InitialState, Offset

#: A search that may end early does so when so many further poles in a row were not worth it.
PATIENCE = 2
#: A smaller fall of the squared error is none [%].
LEAST_FALL = 1e-3


@dataclass(frozen=True, eq=False)
class FittedOrder:
    """One structure of an order search.

    Parameters
    ----------
    options : DelayProfile
        The structure, and how the records are treated: what ``identify`` takes.
    fit : MeasuredFit
        The least squared output error found of it, standard errors for white noise.
    criteria : InformationCriteria
        AICc, BIC and FPE of the innovations, with the noise model that all structures share.
    yic : float
        Young's criterion [-].
    cross_validated_percent : float
        Fit of each tenth of each record with the parameters of all the rest, linearised [%].
    tests : tuple of ResidualTests
        Whether the residuals of each record are white, and independent of its input.
    validation_percent : float or None
        Fit on the validation record [%].
    """

    options: DelayProfile
    fit: MeasuredFit
    criteria: criteria_of.InformationCriteria
    yic: float = float("nan")
    cross_validated_percent: float = float("nan")
    tests: tuple[ResidualTests, ...] = ()
    validation_percent: float | None = None

    @property
    def name(self) -> str:
        """Poles and zeros, for example ``2/1``."""
        return f"{self.options.poles}/{self.options.zeros}"

    @property
    def white(self) -> bool:
        """Whether the residuals of all records pass as white."""
        return all(test.white for test in self.tests)

    @property
    def independent(self) -> bool:
        """Whether the residuals of all records pass as independent of the input."""
        return all(test.uncorrelated for test in self.tests)


@dataclass(frozen=True, eq=False)
class OrderSearch:
    """Fits of a range of structures to the same records.

    Parameters
    ----------
    orders : tuple of FittedOrder
        The structures, the least BIC first.
    answer : AnswerTest
        Whether the outputs are seen to answer to the inputs at all.
    noise : NoiseModel
        What makes the residuals of the closest fit white; the criteria hold behind it.
    bic_of_none : float
        BIC of no model at all; NaN where a free response makes that a question of its own.
    records : tuple of Record
        What was fitted.
    """

    orders: tuple[FittedOrder, ...]
    answer: AnswerTest
    noise: NoiseModel
    bic_of_none: float
    records: tuple[Record, ...] = field(default_factory=tuple, repr=False)

    @property
    def best(self) -> FittedOrder:
        """The structure of the least BIC."""
        return self.orders[0]

    @property
    def recommended(self) -> FittedOrder | None:
        """That structure, or None where the output is not seen to answer to the input."""
        better_than_none = not self.best.criteria.bic >= self.bic_of_none
        return self.best if self.answer.seen and better_than_none else None

    def of(self, poles: int, zeros: int) -> FittedOrder | None:
        """The fit of a structure.

        Parameters
        ----------
        poles, zeros : int
            Its numbers.

        Returns
        -------
        FittedOrder or None
            None where it was not tried.
        """
        return next((each for each in self.orders if (each.options.poles, each.options.zeros) == (poles, zeros)), None)

    @property
    def reason(self) -> str:
        """Why that structure, in words."""
        best = self.recommended
        if best is None:
            return self._why_none
        n, m = best.options.poles, best.options.zeros
        neighbours = [
            ("a pole and a zero more", n + 1, m + 1),
            ("a further pole", n + 1, m),
            ("a further zero", n, m + 1),
        ]
        more = [(what, each) for what, *key in neighbours if (each := self.of(*key)) is not None]
        rise = self._above
        words = []
        if more:
            what, least = min(more, key=lambda pair: rise(pair[1]))
            fall = 100 * (1 - least.fit.cost / best.fit.cost)
            of_which = "but that of the whitened residuals by" if self.noise.order else "which is"
            gain = f"would lower the squared error by {fall:.2g} %, {of_which} no more than it fits of the noise"
            if least.fit.poles_at_infinity or fall < LEAST_FALL:
                gain = "would not lower the squared error"
            words.append(f"{what} ({least.name}) {gain}: BIC is {rise(least):.3g} higher")
        else:
            words.append("nothing larger was tried")
        simpler = [each for each in self.orders if each.options.poles < n]
        if simpler:
            words.append(f"with fewer poles ({simpler[0].name}) it is {rise(simpler[0]):.3g} higher")
        elif m > 0 and (each := self.of(n, m - 1)) is not None:
            words.append(f"without the zero ({each.name}) it is {rise(each):.3g} higher")
        text = "; ".join(words)
        return text[0].upper() + text[1:] + "."

    @property
    def _why_none(self) -> str:
        if not self.answer.seen:
            evidence = f" {self.answer.evidence}" if np.isfinite(self.answer.explained) else ""
            return (
                "There is no model here: the output is not seen to answer to the input "
                f"(p = {self.answer.p_value:.2g}).{evidence}"
            )
        rise = self.best.criteria.bic - self.bic_of_none
        return (
            f"There is no model here: the best structure ({self.best.name}) explains no more of the output than noise "
            f"would let it; its BIC is {rise:.3g} above that of none at all."
        )

    def _above(self, each: FittedOrder) -> float:
        return each.criteria.bic - self.best.criteria.bic


def search_orders(
    records: Record | Sequence[Record],
    poles: tuple[int, int] = (1, 6),
    zeros: tuple[int, int] = (0, 3),
    delay_bounds: tuple[float, float] = (0.0, 0.0),
    *,
    initial_state: InitialState = "rest",
    offset: Offset = "none",
    validation: Record | None = None,
    ends_early: bool = False,
    integrators: int = 0,
) -> OrderSearch:
    r"""Fit a range of structures to the same records, judge them, and say which the records ask for.

    Parameters
    ----------
    records : Record or sequence of Record
        One for each experiment.
    poles, zeros : tuple of int, default (1, 6) and (0, 3)
        Least and greatest number. Structures with as many zeros as poles are tried where the delay is known.
    delay_bounds : tuple of float, default (0, 0)
        Least and greatest delay [s]; two equal numbers are a known delay.
    initial_state : {"rest", "estimate", "periodic"}, default "rest"
        State before the record.
    offset : {"none", "remove", "estimate"}, default "none"
        Constant offset of the output.
    validation : Record, optional
        Another record of the same system, on which all models are tried.
    ends_early : bool, default False
        Whether the search ends before the greatest number of poles when two further ones in a row were not worth it.
    integrators : int, default 0
        Poles at the origin besides, of all structures.

    Returns
    -------
    OrderSearch
        The structures, the least BIC first, and the recommended one, if there is a model at all.

    Raises
    ------
    ValueError
        If an option is out of range.
    DataError
        If a record cannot be used.

    Notes
    -----
    The fits share what is laid out of the records, and each starts from those that it contains, so that the squared
    error never rises with poles or zeros. The criteria are those of innovations: an autoregressive model of the
    residuals of the closest fit makes all residuals white, if they are not. A pole that runs to infinity leaves a
    smaller model, and its parameter counts all the same.
    """
    whole = DelayProfile(
        *(poles[1], 0, delay_bounds), initial_state=initial_state, offset=offset, integrators=integrators
    )
    search = _search(records, poles, zeros, whole, ends_early)
    checked: MeasuredRecords | None = None
    if validation is not None:
        laid_out = laid_out_validation(search.options(poles[1], 0), validation)
        assert isinstance(laid_out, MeasuredRecords)
        checked = laid_out
    orders = [search.judged(each, checked, validation) for each in search.ranked()]
    return search.result(orders)


def recommend_order(
    records: Record | Sequence[Record],
    poles: tuple[int, int],
    zeros: tuple[int, int],
    delay_bounds: tuple[float, float],
    *,
    initial_state: InitialState = "rest",
    offset: Offset = "none",
    answer: AnswerTest | None = None,
) -> OrderSearch:
    """The same without what is only looked at: no tests, no cross-validation, and no more poles than needed.

    ``answer`` says whether the outputs answer to the inputs, where that is known already.
    """
    whole = DelayProfile(poles[1], 0, delay_bounds, initial_state=initial_state, offset=offset)
    search = _search(records, poles, zeros, whole, True)
    if answer is not None:
        search.answer = answer
    return search.result(search.ranked())


def _search(
    records: Record | Sequence[Record],
    poles: tuple[int, int],
    zeros: tuple[int, int],
    whole: DelayProfile,
    ends_early: bool,
) -> "_Search":
    """The fits; ``whole`` says of the most poles how the records are treated."""
    for name, (low, high), least in (("poles", poles, int(not whole.integrators)), ("zeros", zeros, 0)):
        if not least <= low <= high:
            raise OptionError(name, f"{name} must be a range from {least} on, the least number first; got {low}:{high}")
    most_zeros = whole.integrators - int(whole.delay_bounds[0] < whole.delay_bounds[1])
    if zeros[0] > poles[1] + most_zeros:
        raise OptionError("zeros", f"no structure has at least {zeros[0]} zeros and at most {poles[1]} poles")
    search = _Search([records] if isinstance(records, Record) else list(records), whole)
    for n in range(poles[0], poles[1] + 1):
        for m in range(zeros[0], min(zeros[1], n + most_zeros) + 1):
            search.fit(n, m)
        if ends_early and search.found and n - search.ranked()[0].options.poles >= PATIENCE:
            break
    return search


class _Search:
    """Fits of structures, one after another, to records that are laid out once."""

    def __init__(self, records: list[Record], whole: DelayProfile) -> None:
        self.records, self.whole = records, whole
        # Of the most poles, so that a record that is too short for them is refused before anything is fitted.
        self.measured: MeasuredRecords = whole.prepare(records).laid_out
        problem = self.measured.problem
        self.searched = StructureSearch(problem, box_of(problem, whole.delay_bounds), effort=QUICK)
        self.found: list[FittedOrder] = []

    def options(self, poles: int, zeros: int) -> DelayProfile:
        """A structure, treated like the others."""
        return replace(self.whole, poles=poles, zeros=zeros)

    def _for_structure(self, measured: MeasuredRecords, options: DelayProfile) -> MeasuredRecords:
        """Return laid out records for a structure."""
        return measured.with_structure(Structure(options.order, options.zeros, delay=self.searched.box.delay_free))

    def fit(self, poles: int, zeros: int) -> None:
        """Add a structure."""
        options = self.options(poles, zeros)
        found = fitted(
            self._for_structure(self.measured, options), best_of_orders(self.searched, poles, zeros), None, None
        )
        nothing = criteria_of.information_criteria(found.cost * found.count, found.count, 0)
        self.found.append(FittedOrder(options, found, nothing))
        self.__dict__.pop("noise", None)

    @cached_property
    def noise(self) -> NoiseModel:
        """What the closest fit leaves."""
        return shared_noise(min(self.found, key=lambda each: each.fit.cost).fit.residuals)

    def ranked(self) -> list[FittedOrder]:
        """The structures by BIC of their innovations."""
        judged = [replace(each, criteria=self._criteria(each)) for each in self.found]
        return sorted(judged, key=lambda each: each.criteria.bic)

    def _criteria(self, each: FittedOrder) -> criteria_of.InformationCriteria:
        fit = each.fit
        free = [psi @ fit.tangent for psi in fit.sensitivities]
        squared = squared_innovations(fit.residuals, free, self.noise)
        # A pole that has run to infinity was one that could be chosen.
        own = self.measured.layout.own * len(self.records)
        size = each.options.poles + each.options.zeros + 1 + int(self.searched.box.delay_free) + own
        return criteria_of.information_criteria(squared, innovations_count(fit.residuals, self.noise), size)

    def judged(self, each: FittedOrder, checked: MeasuredRecords | None, validation: Record | None) -> FittedOrder:
        """A structure with everything that is printed of it."""
        fit = each.fit
        white = fit.uncertainty("white")
        fit = replace(fit, covariance=white.covariance, law=white)
        free = np.flatnonzero(fit.tangent.any(axis=1))
        residuals = np.concatenate(fit.residuals)
        output = [record.y[use] for record, use in zip(self.records, fit.used, strict=True)]
        whole = np.concatenate(output)
        left = cross_validated_errors(fit.residuals, [psi @ fit.tangent for psi in fit.sensitivities])
        # About the mean of each record, as the fit itself.
        total = np.concatenate([y - y.mean() for y in output])
        other = None
        if checked is not None and validation is not None:
            applied = self._for_structure(checked, each.options).errors_of(fit.model)
            other = validated(applied, validation).fit_percent
        return replace(
            each,
            fit=fit,
            yic=criteria_of.young_information_criterion(
                residuals, whole, fit.theta[free], fit.covariance[np.ix_(free, free)]
            ),
            cross_validated_percent=fit_percent(total, total - np.concatenate(left)),
            tests=tests_of(each.options, fit, self.records),
            validation_percent=other,
        )

    @cached_property
    def answer(self) -> AnswerTest:
        """Whether there is anything to model."""
        measured, treatment = self.measured, self.measured.treatment
        return response_test(measured.records, measured.used(), treatment.delay_bounds, treatment.initial_state)

    def result(self, orders: Sequence[FittedOrder]) -> OrderSearch:
        """All of them."""
        if not orders:
            raise DataError("no structure could be fitted")
        return OrderSearch(tuple(orders), self.answer, self.noise, self._bic_of_none(), tuple(self.records))

    def _bic_of_none(self) -> float:
        treatment = self.measured.treatment
        if treatment.initial_state == "estimate":
            return float("nan")
        about = [y - y.mean() if treatment.offset == "estimate" else y for y in self.measured.outputs]
        squared = squared_innovations(about, [np.zeros((y.size, 0)) for y in about], self.noise)
        own = len(about) * (treatment.offset == "estimate")
        return criteria_of.information_criteria(squared, innovations_count(about, self.noise), own).bic
