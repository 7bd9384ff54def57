"""The least output error of measured records from the minima of a profile, and what may be asked of it later."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ctid_cli.arrays import Array, BoolArray
from ctid_cli.estimation.measured_records import MeasuredRecords
from ctid_cli.estimation.optimum.best_model import Optimum, best_output_error
from ctid_cli.estimation.optimum.projection import Problem
from ctid_cli.estimation.optimum.search import local_minimum
from ctid_cli.estimation.output_error import Layout, sensitivities
from ctid_cli.inference.sensitivity import Structure
from ctid_cli.models.transfer_function import TransferFunction

#: Random starts of a search that fits the smaller models too, besides two for each pole.
RANDOM_STARTS = 4


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

    def __init__(self, measured: MeasuredRecords) -> None:
        self.measured = measured
        self.structure = measured.structure

    @property
    def problem(self) -> Problem:
        """The records and what is eliminated with them."""
        return self.measured.problem

    def best(self, starts: Sequence[tuple[Array, float]], nested: bool) -> Optimum:
        """The least output error from denominators and delays, and if nested of smaller models and at random too.

        A profile under an unknown initial state, an offset or a period has too few basins: smaller models help then.
        """
        (poles, zeros), records = (self.structure.poles, self.structure.zeros), self.measured.data
        random = RANDOM_STARTS + 2 * poles
        options = replace(
            self.measured.options,
            starts=starts,
            nested=nested or not self.measured.plain,
            fewer_poles=nested,
            random_starts=random if nested else 0,
        )
        found = best_output_error(records, poles, zeros, options)
        agreed = found.ending.optimal and (found.agree > 1 or found.tried == 1)
        if agreed or options.nested:
            return found
        # Where the starts disagree others are asked.
        starts = [(found.denominator, found.delay), *starts]
        return best_output_error(records, poles, zeros, replace(options, starts=starts, random_starts=random))

    def squared_error_at(self, model: TransferFunction, delay: float) -> float:
        """Least sum of squared output errors at a given delay, in the basin of a model."""
        return local_minimum(self.problem, model.poles, delay, (delay, delay)).squared_error

    def squared_error_with(
        self, model: TransferFunction, *, initial_state: bool = False, offset: bool = False
    ) -> float:
        """Least sum of squared output errors if an initial state or an offset were estimated too."""
        problem = self.problem
        more = problem._replace(free_response=problem.free_response or initial_state, offset=problem.offset or offset)
        return local_minimum(more, model.poles, model.delay, self.measured.treatment.delay_bounds).squared_error

    def errors_of(self, model: TransferFunction) -> AppliedModel:
        """Errors of a given model on these records, each with its own best initial state and offset."""
        layout = self.layout_of(model.order, delay=False)
        theta, residuals = layout.theta(model), []
        for k, (psi, eps) in enumerate(sensitivities(self.problem, layout, theta, model.delay)):
            own = slice(layout.first(k), layout.first(k) + layout.own)
            theta[own] = np.linalg.lstsq(psi[:, own], eps)[0]
            residuals.append(eps - psi[:, own] @ theta[own])
        return AppliedModel(tuple(residuals), self.measured.used(), *self.own(layout, theta))

    def layout_of(self, poles: int, delay: bool) -> Layout:
        """Which numbers stand where for so many poles."""
        return replace(self.measured.layout, structure=Structure(poles, self.structure.zeros, delay))

    def own(self, layout: Layout, theta: Array) -> tuple[tuple[Array, ...], tuple[float, ...]]:
        """Initial states and offsets of the experiments, means that were subtracted included."""
        own = [layout.own_of(theta, k) for k in range(layout.experiments)]
        offsets = tuple(y0 + c for y0, (_, c) in zip(self.measured.offsets, own, strict=True))
        return tuple(state for state, _ in own), offsets
