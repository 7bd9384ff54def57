"""Useful redundancy: escape from local minima by searches on other costs with the same global minimum."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from itertools import pairwise
from typing import Generic, Literal, TypeAlias, TypeVar, get_args

from ctid_cli.signals.checks import require_choice, require_integer, require_not_negative

#: A point of the search: a number, an array, or any type accepted by the costs and the local solver.
P = TypeVar("P")

#: Runs a local solver on one member cost from a point, without modifying it, and returns its minima: usually one,
#: several for several inner starts, none if it failed.
Path: TypeAlias = Callable[[P], Sequence[P]]

#: Rule by which a round chooses the next incumbent.
Choice = Literal["first", "best"]

#: Path number of the start, which no solver found.
START = -1


class SearchStatus(Enum):
    """Reason for the end of a redundant search and, if needed, a remedy."""

    EXHAUSTED = "No path improves the reference cost any further."
    SETTLED = "The last round changed the point by too little to go on."
    MAX_ROUNDS = "The search stopped at max_rounds while the reference cost was still falling; raise max_rounds."
    NO_FINITE_COST = (
        "The reference cost is finite neither at the start nor at any point that the paths lead to; start elsewhere."
    )

    @property
    def succeeded(self) -> bool:
        """Whether the search ended regularly at a point of finite cost."""
        return self in (SearchStatus.EXHAUSTED, SearchStatus.SETTLED)


@dataclass(frozen=True)
class Visit(Generic[P]):
    """Candidate with its reference cost."""

    round: int
    path: int
    point: P
    cost: float
    accepted: bool


@dataclass(frozen=True)
class RedundantMinimum(Generic[P]):
    """Result of a redundant search.

    Parameters
    ----------
    point : P
        Last incumbent, the accepted point of least reference cost.
    cost : float
        Reference cost of this point; ``inf`` if no finite one was found.
    rounds : int
        Number of rounds, including a last one without improvement.
    status : SearchStatus
        Reason for the end of the search.
    visits : tuple of Visit
        All candidates in the order of their evaluation, the start first.
    """

    point: P
    cost: float
    rounds: int
    status: SearchStatus
    visits: tuple[Visit[P], ...]

    @property
    def trajectory(self) -> tuple[Visit[P], ...]:
        """Successive incumbents, the start first."""
        return tuple(visit for visit in self.visits if visit.accepted)

    @property
    def switches(self) -> tuple[Visit[P], ...]:
        """Incumbents found on another path than the previous incumbent, without the start."""
        return tuple(now for before, now in pairwise(self.trajectory) if before.path not in (START, now.path))


def minimise_redundantly(
    start: P,
    reference: Callable[[P], float],
    paths: Sequence[Path[P]],
    *,
    choice: Choice = "first",
    improvement: float = 1e-3,
    settled: Callable[[P, P], bool] | None = None,
    max_rounds: int = 100,
) -> RedundantMinimum[P]:
    r"""Minimise a cost with local minima by local searches on a family of costs.

    Parameters
    ----------
    start : P
        Initial point.
    reference : callable
        Reference cost J0, which ranks the candidates; often the mean of the member costs. A value that is not finite
        counts as infinite.
    paths : sequence of callable
        One solver path for each member cost, see `local_paths`. J0 is a member only if it is included here. Exceptions
        of a path are not caught.
    choice : {"first", "best"}, default "first"
        ``first`` repeats a path while it improves the incumbent, and otherwise proceeds to the next one, cyclically.
        ``best`` follows every path in each round and takes the candidate of least reference cost.
    improvement : float, default 1e-3
        Relative improvement of the reference cost, 0 to below 1, that ``first`` requires [-]; 0 accepts any decrease,
        as ``best`` always does.
    settled : callable, optional
        ``settled(previous, new)`` of two successive incumbents: whether the step between them is small enough to stop.
        Intended for ``best``; ``first`` has not tried all paths when it is called. None disables this criterion.
    max_rounds : int, default 100
        Largest number of rounds, in each of which every path is followed at most once from one incumbent.

    Returns
    -------
    RedundantMinimum
        The point, its reference cost, the reason for the end, and all candidates.

    Raises
    ------
    ValueError
        Without paths, or if an option is out of range.

    Notes
    -----
    *The problem* [1]_ [2]_: a local solver that minimises :math:`J_0` ends in one of its local minima. Let
    :math:`\ell^{(r)}(\rho, J_i)` be the point that r iterations of the solver reach on :math:`J_i` from
    :math:`\rho`. The minimisation of :math:`J_0` is *M-safely redundant* if there are member costs
    :math:`J_i, i = 1 \dots M`, that have their global minimum where :math:`J_0` has it, and a number of iterations r
    and a :math:`\gamma < 1` with

    .. math:: \min_{i = 0 \dots M} J_0\big(\ell^{(r)}(\rho, J_i)\big) \le \gamma J_0(\rho)

    for all :math:`\rho`: from every point at least one member leads to a lower :math:`J_0`. This can hold at the global
    minimum only if :math:`J_0` is zero there; then a search that requires an improvement of at most
    :math:`1 - \gamma` reduces :math:`J_0` to zero at least geometrically, from any point.

    *The algorithm* [3]_: from the incumbent :math:`\rho`, path i leads to :math:`\xi`. If
    :math:`J_0(\xi) \le (1 - \epsilon) J_0(\rho)`, the incumbent becomes :math:`\xi`, otherwise
    :math:`i \leftarrow (i + 1) \bmod M`. There are three differences from the printed Algorithm III. That algorithm
    cycles forever once every path fails; this search ends after one full cycle without an improvement. After an
    improvement the algorithm returns to the first path; this search continues with the same path. An improvement must
    also be a strict decrease, relative to :math:`|J_0|`, since a factor only would not terminate at zero or below. If a
    path returns several minima, the one of least :math:`J_0` is used. ``best`` is the outer iteration of Algorithm IV:
    a step needs M local searches, and the order of the paths matters only for ties.

    *Failure*: at a point from which no path reduces the cost, which is then returned as `SearchStatus.EXHAUSTED`.
    Redundancy of the family is an assumption that one run does not test: run the search from many starts on a problem
    with a known solution. Members are useful if their basins differ in width or position. With noise the members agree
    on the global minimum only approximately: finish with a local search on the cost of interest. A reference cost with
    a large constant part (noise) has small relative changes: subtract that part, or reduce `improvement`.

    References
    ----------
    .. [1] M. Alamir, "On useful redundancy in dynamic inverse problems related optimization", *IFAC Proceedings
       Volumes* 41(2) (2008) 976-981.
    .. [2] M. Alamir, J. S. Welsh and G. C. Goodwin, "Redundancy versus multiple starting points in nonlinear system
       related inverse problems", *Automatica* 45(4) (2009) 1052-1057.
    .. [3] H. Ha, J. S. Welsh and M. Alamir, "Useful redundancy in parameter and time delay estimation for
       continuous-time models", arXiv:1703.09344 (2017), Algorithms III and IV. doi:10.48550/arXiv.1703.09344

    Examples
    --------
    Frequency of a noisy sine. For a long record the cost has a narrow global minimum among many local ones, for a short
    record a wide and inaccurate one:

    >>> import numpy as np
    >>> from scipy.optimize import minimize
    >>> t = np.arange(0, 60, 0.1)
    >>> y = np.sin(3 * t) + 0.5 * np.random.default_rng(0).standard_normal(t.size)
    >>> def cost_over(duration):
    ...     short = t < duration
    ...     return lambda w: float(np.mean((y[short] - np.sin(w * t[short])) ** 2))
    >>> def solver(cost, w):
    ...     return float(minimize(lambda x: cost(x[0]), [w], method="L-BFGS-B", bounds=[(0, 10)]).x[0])
    >>> costs = [cost_over(duration) for duration in (1, 4, 15, 60)]
    >>> round(solver(costs[-1], 5.0), 1)  # trapped
    5.1
    >>> found = minimise_redundantly(5.0, lambda w: sum(cost(w) for cost in costs), local_paths(costs, solver))
    >>> [(visit.path, round(visit.point, 1)) for visit in found.trajectory]
    [(-1, 5.0), (0, 3.3), (1, 3.1), (2, 3.0), (3, 3.0)]
    >>> found.status.value
    'No path improves the reference cost any further.'
    >>> round(solver(costs[-1], found.point), 3)
    3.001
    """
    require_choice("choice", choice, get_args(Choice))
    require_not_negative("improvement", improvement, "-")
    if improvement >= 1:
        raise ValueError(f"improvement is a share of the reference cost and must be below 1, not {improvement!r}.")
    require_integer("max_rounds", max_rounds, 1)
    if not paths:
        raise ValueError("paths must hold at least one solver path.")

    demanded = improvement if choice == "first" else 0.0
    incumbent = Visit(0, START, start, _cost_or_infinity(reference(start)), True)
    visits = [incumbent]
    current = 0
    for number in range(1, max_rounds + 1):
        examined: list[Visit[P]] = []
        winner = incumbent
        for offset in range(len(paths)):
            path = (current + offset) % len(paths)
            candidates = [
                Visit(number, path, point, _cost_or_infinity(reference(point)), False)
                for point in paths[path](incumbent.point)
            ]
            examined += candidates
            least = min(candidates, key=lambda visit: visit.cost, default=winner)
            if _improves(least.cost, winner.cost, demanded):
                winner = least
                if choice == "first":
                    current = path
                    break
        if winner is incumbent:
            visits += examined
            finite = math.isfinite(incumbent.cost)
            status = SearchStatus.EXHAUSTED if finite else SearchStatus.NO_FINITE_COST
            return RedundantMinimum(incumbent.point, incumbent.cost, number, status, tuple(visits))
        previous, incumbent = incumbent, replace(winner, accepted=True)
        visits += [incumbent if visit is winner else visit for visit in examined]
        if settled is not None and settled(previous.point, incumbent.point):
            return RedundantMinimum(incumbent.point, incumbent.cost, number, SearchStatus.SETTLED, tuple(visits))
    return RedundantMinimum(incumbent.point, incumbent.cost, max_rounds, SearchStatus.MAX_ROUNDS, tuple(visits))


def local_paths(costs: Sequence[Callable[[P], float]], solver: Callable[[Callable[[P], float], P], P]) -> list[Path[P]]:
    """Return solver paths of a family of costs, all with the same local solver."""

    def path_of(cost: Callable[[P], float]) -> Path[P]:
        return lambda point: [solver(cost, point)]

    return [path_of(cost) for cost in costs]


def _cost_or_infinity(cost: float) -> float:
    return float(cost) if math.isfinite(cost) else math.inf


def _improves(cost: float, incumbent: float, share: float) -> bool:
    """Return whether a cost is strictly below the incumbent's, and by at least a share of it."""
    if math.isinf(incumbent):
        return math.isfinite(cost)
    return cost < incumbent and cost <= incumbent - share * abs(incumbent)
