"""Algorithm IV as printed: in every round one Gauss-Newton path on each filter's cost, all from the same delay.

Reference for the faster and more robust search of ``useful_redundancy``, which can be compared with the publication
line by line. Equation numbers are those of Ha, Welsh and Alamir, "Useful redundancy in parameter and time
delay estimation for continuous-time models" (arXiv:1703.09344).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError
from ctid_cli.estimation.delay_search import Minimum, SampledCost, descend
from ctid_cli.estimation.filtered_costs import FilterPath, path_history, percents
from ctid_cli.estimation.redundancy import START, RedundantMinimum, SearchStatus, Visit
from ctid_cli.estimators.td_srivc import TdSrivc
from ctid_cli.filtering.filter_set import FilterSet
from ctid_cli.filtering.lowpass import Lowpass
from ctid_cli.inference.fit import Fit, Status
from ctid_cli.signals.record import Record


class FilteredMember(SampledCost):
    """Cost of one filter's data, with SRIVC estimates from least-squares starts cached by delay."""

    @cached_property
    def spread(self) -> float:
        """Sum of squares of the filtered output about its mean [output unit^2]."""
        y = self.problem.data.y_used
        return float(np.sum((y - y.mean()) ** 2))

    @cached_property
    def _known(self) -> dict[float, Minimum]:
        return {}

    def minimise(self, delay: float, starts: Array, own: bool) -> Minimum:
        """Run SRIVC at one delay, from given coefficients or by the complete Algorithm I."""
        if not own:
            return super().minimise(delay, starts, own)
        if delay not in self._known:
            self._known[delay] = super().minimise(delay, starts, own)
        return self._known[delay]


@dataclass(frozen=True, eq=False)
class PrintedRounds:
    """Step 2 of Algorithm IV on the costs of several filters."""

    options: TdSrivc
    members: Sequence[FilteredMember]
    max_delay_step: float
    max_rounds: int

    def reference_cost(self, delay: float) -> float:
        """Return J0 (45) at a delay, with separate coefficients for every filter [%]."""
        errors = [member.minimise(delay, np.empty((0, member.size)), True).squared_error for member in self.members]
        return float(percents(np.array(errors), np.array([member.spread for member in self.members])).mean())

    def run(self, delay: float) -> tuple[RedundantMinimum[float], list[FilterPath]]:
        """Follow every path from the incumbent, and continue from the end of least J0, even if J0 increases."""
        visits = [Visit(0, START, delay, self.reference_cost(delay), True)]
        paths: list[FilterPath] = []
        incumbents, status = [delay], SearchStatus.MAX_ROUNDS
        for number in range(1, self.max_rounds + 1):
            followed = self._followed(number, delay)
            if not followed:
                raise DataError(Status.SINGULAR.value)
            costs = [self.reference_cost(path.end) for path in followed]
            least = int(np.argmin(costs))
            for i, path in enumerate(followed):
                visits.append(Visit(number, path.filter, path.end, costs[i], i == least))
            paths += followed
            before, delay = delay, followed[least].end
            # |(tau_i - tau_(i-1))/tau_i| < epsilon, without the division where tau_i is zero.
            if delay == before or abs(delay - before) < self.options.tolerance * abs(delay):
                status = SearchStatus.SETTLED
                break
            if delay in incumbents:
                # The rounds would repeat from here on.
                status = SearchStatus.EXHAUSTED
                break
            incumbents.append(delay)
        return RedundantMinimum(delay, costs[least], number, status, tuple(visits)), paths

    def _followed(self, number: int, delay: float) -> list[FilterPath]:
        """Run Algorithm II without its step 3 on the cost of each filter."""
        limits, paths = self.options._limits._replace(largest_step=self.max_delay_step), []
        for k, member in enumerate(self.members):
            descent = descend(member, delay, np.empty((0, member.size)), limits)
            if descent.path.size:
                paths.append(FilterPath(number, k, descent, member.spread, descent.minimum.delay))
        return paths


@dataclass(frozen=True, eq=False)
class PrintedSearch:
    """Algorithm IV on one record, for any number of initial delays."""

    filters: FilterSet
    filtered: PrintedRounds
    unfiltered: PrintedRounds

    def run(self, delay: float) -> tuple[Fit, RedundantMinimum[float], list[FilterPath]]:
        """Run step 2 over all filters, then step 3: step 2 with ``L(p) = 1`` as the only filter."""
        found, paths = self.filtered.run(delay)
        refined, last = self.unfiltered.run(found.point)
        problem = self.unfiltered.members[0].problem._replace(free_delay=True)
        history = path_history("filter {}", found, paths, problem.poles, problem.samples)
        history += path_history("refine", refined, last, problem.poles, problem.samples)
        end = last[-1].descent._replace(iterations=found.rounds + sum(path.descent.iterations for path in last))
        return self.unfiltered.options._finish(problem, end, history), found, paths


def printed_search(
    options: TdSrivc, record: Record, filters: FilterSet, max_delay_step: float, max_rounds: int
) -> PrintedSearch:
    """Apply all filters to a record, once for all initial delays."""
    cutoff = options.svf_cutoff or filters.bandwidth

    def rounds(*lowpasses: Lowpass | None) -> PrintedRounds:
        behind = (replace(options, lowpass=lowpass)._lay_out(record).first for lowpass in lowpasses)
        costs = [options._cost(problem, (cutoff,)) for problem in behind]
        members = [FilteredMember(cost.problem, cost.steps, cost.svf_cutoffs) for cost in costs]
        return PrintedRounds(options, members, max_delay_step, max_rounds)

    return PrintedSearch(filters, rounds(*filters.lowpasses), rounds(None))
