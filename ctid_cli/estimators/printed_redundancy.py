"""Algorithm IV as printed: in every round one Gauss-Newton path on each filter's cost, all from the same delay.

The reference beside the faster and more careful search of ``useful_redundancy``: written to be compared with the
publication line by line. Equation numbers are those of Ha, Welsh and Alamir, "Useful redundancy in parameter and time
delay estimation for continuous-time models" (arXiv:1703.09344).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError
from ctid_cli.estimation.common import history_entry
from ctid_cli.estimation.delay_search import Descent, Minimum, descend
from ctid_cli.estimation.filter_search import FilterPath
from ctid_cli.estimation.redundancy import START, RedundantMinimum, SearchStatus, Visit
from ctid_cli.estimation.sampled_problem import SampledProblem
from ctid_cli.estimators.td_srivc import SrivcCost, TdSrivc
from ctid_cli.filtering.filter_set import FilterSet
from ctid_cli.filtering.lowpass import Lowpass
from ctid_cli.inference.fit import Fit, IterationRecord
from ctid_cli.inference.status import Status
from ctid_cli.signals.record import Record

#: Cost of a filter behind which SRIVC finds no model [%]: that of a model which explains nothing.
NOTHING = 100.0


class FilteredMember(SrivcCost):
    """The cost of one filter's data; what SRIVC finds from its own start at a delay is kept for that very delay."""

    def __init__(self, options: TdSrivc, problem: SampledProblem) -> None:
        assert options.svf_cutoff is not None
        super().__init__(options, problem, (options.svf_cutoff,))
        y = problem.data.y_used
        self.spread = float(np.sum((y - y.mean()) ** 2))
        self._known: dict[float, Minimum | None] = {}

    def minimise(self, delay: float, theta: Array | None) -> Minimum | None:
        """SRIVC at one delay, from given coefficients or by the whole of Algorithm I."""
        if theta is not None:
            return super().minimise(delay, theta)
        if delay not in self._known:
            self._known[delay] = super().minimise(delay, None)
        return self._known[delay]

    def percent(self, minimum: Minimum | None) -> float:
        """``100 ||y - x|| / ||y - mean y||`` of the filtered data [%]."""
        return NOTHING if minimum is None else 100.0 * float(np.sqrt(minimum.squared_error / self.spread))


class Path(NamedTuple):
    """One run of Algorithm II without its step 3."""

    round: int
    filter: int
    descent: Descent


@dataclass(frozen=True, eq=False)
class PrintedRounds:
    """Step 2 of Algorithm IV on the costs of some filters."""

    options: TdSrivc
    members: Sequence[FilteredMember]
    max_delay_step: float
    max_rounds: int

    def reference_cost(self, delay: float) -> float:
        """J0 (45) at a delay, every filter with its own coefficients [%]."""
        return float(np.mean([member.percent(member.minimise(delay, None)) for member in self.members]))

    def run(self, delay: float) -> tuple[RedundantMinimum[float], list[Path]]:
        """From the incumbent along every path, and on from the end of least J0, lower than before or not."""
        visits, paths = [Visit(0, START, delay, self.reference_cost(delay), True)], []
        incumbents, status = [delay], SearchStatus.MAX_ROUNDS
        for number in range(1, self.max_rounds + 1):
            descents = [self._descend(member, delay) for member in self.members]
            followed = [Path(number, k, descent) for k, descent in enumerate(descents) if descent is not None]
            if not followed:
                raise DataError(Status.SINGULAR.value)
            ends = [path.descent.minimum.delay for path in followed]
            costs = [self.reference_cost(end) for end in ends]
            least = int(np.argmin(costs))
            for i, path in enumerate(followed):
                visits.append(Visit(number, path.filter, ends[i], costs[i], i == least))
            paths += followed
            before, delay = delay, ends[least]
            # |(tau_i - tau_(i-1))/tau_i| < epsilon, without the division where tau_i is zero.
            if delay == before or abs(delay - before) < self.options.tolerance * abs(delay):
                status = SearchStatus.SETTLED
                break
            if delay in incumbents:
                # From here on everything would repeat itself.
                status = SearchStatus.EXHAUSTED
                break
            incumbents.append(delay)
        return RedundantMinimum(delay, costs[least], number, status, tuple(visits)), paths

    def _descend(self, member: FilteredMember, delay: float) -> Descent | None:
        """Algorithm II without its step 3."""
        return descend(
            member,
            delay,
            None,
            self.options.delay_bounds,
            max_iterations=self.options.max_iterations,
            tolerance=self.options.tolerance,
            largest_step=self.max_delay_step,
        )

    def told(self, paths: Sequence[Path]) -> list[FilterPath]:
        """The paths as they stand in a fit."""
        told = []
        for number, k, descent in paths:
            costs = np.array([self.members[k].percent(step) for step in descent.steps])
            thetas = np.array([step.theta for step in descent.steps])
            told.append(FilterPath(number, k, thetas[:, -1], costs, thetas[:, :-1]))
        return told

    def history(self, stage: str, found: RedundantMinimum[float], paths: Sequence[Path]) -> list[IterationRecord]:
        """The steps of the paths that led from incumbent to incumbent."""
        taken = {(visit.round, visit.path) for visit in found.trajectory}
        return [
            history_entry(stage.format(k + 1), i, self.members[k].problem, step.theta, step.squared_error)
            for number, k, descent in paths
            if (number, k) in taken
            for i, step in enumerate(descent.steps)
        ]


@dataclass(frozen=True, eq=False)
class PrintedSearch:
    """Algorithm IV on one record, for any number of initial delays."""

    filters: FilterSet
    filtered: PrintedRounds
    unfiltered: PrintedRounds

    def run(self, delay: float) -> tuple[Fit, RedundantMinimum[float], list[FilterPath]]:
        """Step 2 over all filters, then step 3: step 2 once more with ``L(p) = 1`` for the only filter."""
        found, paths = self.filtered.run(delay)
        refined, last = self.unfiltered.run(found.point)
        history = self.filtered.history("filter {}", found, paths)
        history += self.unfiltered.history("refine", refined, last)
        end = replace(last[-1].descent, iterations=found.rounds + sum(path.descent.iterations for path in last))
        problem = self.unfiltered.members[0].problem._replace(free_delay=True)
        return self.unfiltered.options._finish(problem, end, history), found, self.filtered.told(paths)


def printed_search(
    options: TdSrivc, record: Record, filters: FilterSet, max_delay_step: float, max_rounds: int
) -> PrintedSearch:
    """Filter a record through all filters, once for all initial delays."""

    def rounds(*lowpasses: Lowpass | None) -> PrintedRounds:
        behind = (replace(options, lowpass=lowpass)._lay_out(record).first for lowpass in lowpasses)
        members = [FilteredMember(options, problem) for problem in behind]
        return PrintedRounds(options, members, max_delay_step, max_rounds)

    return PrintedSearch(filters, rounds(*filters.lowpasses), rounds(None))
