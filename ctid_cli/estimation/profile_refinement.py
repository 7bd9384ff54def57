"""Gauss-Newton on everything at once, from a minimum of the profile, and what may be asked of the estimate later."""

from dataclasses import dataclass, field, replace

import numpy as np

from ctid_cli.arrays import Array, BoolArray
from ctid_cli.errors import DataError
from ctid_cli.estimation.common import history_of
from ctid_cli.estimation.delay_search import Minimum, bound_in_the_way
from ctid_cli.estimation.iteration import GAUSS_NEWTON, HALVINGS, Iterated, Steps, iterate
from ctid_cli.estimation.measured_records import MeasuredRecords
from ctid_cli.estimation.output_error import OutputErrorProblem
from ctid_cli.inference.fit import IterationRecord
from ctid_cli.inference.status import Status
from ctid_cli.models.transfer_function import TransferFunction


@dataclass(frozen=True, eq=False)
class AppliedModel:
    """A given model on records that it need not have been estimated from."""

    #: Output errors at the used samples of each experiment [output unit].
    residuals: tuple[Array, ...] = field(repr=False)
    used: tuple[BoolArray, ...] = field(repr=False)
    initial_states: tuple[Array, ...]
    #: Output offset of each experiment [output unit].
    offsets: tuple[float, ...]


class Refinement:
    """The output-error cost of measured records, minimised over all parameters."""

    def __init__(self, measured: MeasuredRecords, max_iterations: int, tolerance: float) -> None:
        self.measured = measured
        self.structure = measured.structure
        self.layout = measured.layout
        self.steps = Steps(max_iterations, tolerance, GAUSS_NEWTON, HALVINGS)

    @property
    def problem(self) -> OutputErrorProblem:
        """All parameters together."""
        bounds = self.measured.treatment.delay_bounds
        return OutputErrorProblem(self.measured.data, self.layout, bounds[0], bounds)

    def _at(self, delay: float) -> OutputErrorProblem:
        """The same at a known delay."""
        layout = replace(self.layout, structure=replace(self.structure, delay=False))
        return OutputErrorProblem(self.measured.data, layout, delay)

    def from_minimum(self, minimum: Minimum) -> tuple[Iterated | None, list[IterationRecord]]:
        """Gauss-Newton on all parameters from one local minimum of the profile."""
        problem = self.problem
        a = minimum.theta[: self.structure.poles]
        theta = problem.linear_start(np.concatenate(([1.0], a)), minimum.delay)
        result = None if theta is None else iterate(problem, theta, self.steps)
        history = history_of("refine", problem, result)
        if result is None or not self.structure.delay:
            return result, history
        return self._mind_the_bounds(problem, result), history

    def _mind_the_bounds(self, problem: OutputErrorProblem, result: Iterated) -> Iterated:
        """Move a delay that wants to leave its bounds onto the bound, and say so."""
        place = self.structure.size - 1
        reordered = np.r_[np.delete(np.arange(self.layout.size), place), place]
        equations = result.equations
        delay_last = equations._replace(
            hessian=equations.hessian[np.ix_(reordered, reordered)],
            instrument_error=equations.instrument_error[reordered],
        )
        bound = bound_in_the_way(delay_last, float(result.theta[place]), problem.bounds)
        if bound is None:
            return result
        there = iterate(self._at(bound), np.delete(result.theta, place), self.steps)
        if there is None or there.equations.squared_error > equations.squared_error:
            return result
        theta = np.insert(there.theta, place, bound)
        iterations = result.iterations + there.iterations
        return Iterated(theta, problem.equations(theta), Status.DELAY_AT_BOUND, iterations, result.path)

    def squared_error_at(self, theta: Array, delay: float) -> float:
        """Least sum of squared output errors at a given delay, in the basin of an estimate."""
        return self._least(self._at(delay), np.delete(theta, self.structure.size - 1))

    def squared_error_with(
        self, theta: Array, delay: float, *, initial_state: bool = False, offset: bool = False
    ) -> float:
        """Least sum of squared output errors if an initial state or an offset were estimated too."""
        layout = replace(
            self.layout,
            initial_state=self.layout.initial_state or initial_state,
            offset=self.layout.offset or offset,
        )
        problem = OutputErrorProblem(self.measured.data, layout, delay, self.measured.treatment.delay_bounds)
        shared = np.concatenate((theta[: self.structure.size], np.zeros(layout.size - self.structure.size)))
        return self._least(problem, problem.with_best_own(shared))

    def _least(self, problem: OutputErrorProblem, theta: Array | None) -> float:
        """Squared error where the iteration ends; NaN where it cannot begin."""
        result = None if theta is None else iterate(problem, theta, self.steps)
        return float("nan") if result is None else result.equations.squared_error

    def errors_of(self, model: TransferFunction) -> AppliedModel:
        """Errors of a given model on these records, each with its own best initial state and offset."""
        measured = self.measured
        if measured.treatment.initial_state == "periodic":
            measured.make_periodic(model.denominator[1:])
        problem = self._at(model.delay)
        b = np.concatenate((np.zeros(self.structure.zeros + 1 - model.numerator.size), model.numerator))
        own = np.zeros(problem.layout.size - problem.structure.size)
        theta = problem.with_best_own(np.concatenate((model.denominator[1:], b, own)))
        parts = None if theta is None else problem.sensitivities(theta)
        if theta is None or parts is None:
            raise DataError("the record does not determine the initial state and the offset of a given model")
        states, offsets = self.own(problem, theta)
        return AppliedModel(tuple(eps for _, eps in parts), measured.used(), states, offsets)

    def own(self, problem: OutputErrorProblem, theta: Array) -> tuple[tuple[Array, ...], tuple[float, ...]]:
        """Initial states and offsets of the experiments, means that were subtracted included."""
        own = [problem.own(theta, k) for k in range(len(self.measured.data))]
        offsets = tuple(y0 + c for y0, (_, c) in zip(self.measured.offsets, own, strict=True))
        return tuple(state for state, _ in own), offsets
