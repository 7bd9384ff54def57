"""From a start to an estimate of a sum of submodels with its covariance: what additive SRIVC and CLSRIVC share."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError
from ctid_cli.estimation.additive_problem import AdditiveProblem
from ctid_cli.estimation.common import diverged, history_entry, quality
from ctid_cli.estimation.iteration import GUARDED, Equations, Iterated, Steps, iterate
from ctid_cli.filtering.loop import loop_radius
from ctid_cli.inference.covariance import white_noise_covariance
from ctid_cli.inference.fit import IterationRecord, Status
from ctid_cli.inference.uncertainty import Covariance, Uncertainty, estimate_uncertainty
from ctid_cli.models.additive import AdditiveModel
from ctid_cli.models.controller import DiscreteController

#: An unstable loop is simulated over a record unless it would grow beyond this factor.
LARGEST_GROWTH = 1e20


class History(Sequence[IterationRecord]):
    """Accepted iterations, each multiplied out to a transfer function only when it is looked at."""

    def __init__(self, problem: AdditiveProblem) -> None:
        self._problem = problem
        self._entries: list[tuple[str, int, Array]] = []

    def add(self, stage: str, result: Iterated | None) -> None:
        """Append the start and the accepted steps of an iteration."""
        if result is not None:
            self._entries += [(stage, k, row) for k, row in enumerate(result.path)]

    @property
    def steps(self) -> int:
        """Number of accepted steps, starts not counted."""
        return sum(number > 0 for _, number, _ in self._entries)

    def __len__(self) -> int:
        return len(self._entries)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return tuple(self[k] for k in range(*index.indices(len(self))))
        stage, iteration, row = self._entries[index]
        return history_entry(stage, iteration, self._problem, row[:-1], float(row[-1]))


class SubmodelEstimate(NamedTuple):
    """Estimated parameters of a sum of submodels."""

    #: Parameters of the model, in the order of the problem's terms, shape (p,).
    theta: Array
    #: The same and those of the free response.
    whole: Array
    #: Covariance, status and all else that a `Fit` says of them, by its names.
    values: dict[str, Any]

    def values_in(self, jacobian: Array) -> dict[str, Any]:
        """The same of parameters with these derivatives by the present ones."""
        law: Uncertainty | None = self.values.get("law")
        if law is None:
            return {**self.values, "covariance": np.full((len(jacobian),) * 2, np.nan)}
        law = law.transformed(jacobian)
        return {**self.values, "law": law, "covariance": law.covariance}


def estimate_submodels(
    problem: AdditiveProblem, theta: Array, steps: Steps, covariance: Covariance, draws: int
) -> SubmodelEstimate:
    """Iterate from a start and judge the result.

    Where the iteration does not converge it is run once more with the other interpolation of the output; and in open
    loop, if that does not help, goes on with guarded steps.
    """
    p, y = problem.size, problem.data.y_used
    whole = problem.with_fixed(np.concatenate((theta, np.zeros(problem.filter.free))))
    radius = radius_in_loop(problem, problem.model(whole)) if problem.loop.closed else 0.0
    if radius > 1.0 and problem.data.y.size * np.log(radius) > np.log(LARGEST_GROWTH):
        raise DataError(
            "the start makes an unstable loop with the controller: its poles reach the magnitude "
            f"{radius:.4g}, and must stay below 1; start closer, or with instruments 'open_loop'"
        )
    history = History(problem)

    def run(stage: str, problem: AdditiveProblem, start: Array, steps: Steps) -> Iterated | None:
        result = iterate(problem, start, steps)
        history.add(stage, result)
        return result

    result = run("refine", problem, whole, steps)
    if result is None or result.status is not Status.CONVERGED:
        otherwise_held = replace(problem, data=problem.data._replace(y_foh=not problem.data.y_foh))
        result = _better(result, run("refine_again", otherwise_held, whole, steps))
    if result is not None and result.status is Status.MAX_ITERATIONS and not problem.loop.closed:
        # Slow on its way to a minimum: near it the cost may guard the steps, and Gauss-Newton is faster.
        result = _better(result, run("refine_guarded", problem, result.theta, steps._replace(rule=GUARDED)))
    values: dict[str, Any] = {"iterations": history.steps, "history": history}
    if result is None:
        return SubmodelEstimate(whole[:p], whole, {**values, **diverged(p, y.size)})
    equations, status = result.equations, result.status
    law, matrix = None, np.full((p, p), np.nan)
    if status is not Status.DIVERGED:
        law = _law(problem, result.theta, equations, covariance, draws)
        # Those of a free response are nobody's.
        law = law and law.transformed(np.eye(p, whole.size))
        matrix = matrix if law is None else law.covariance
        if status is Status.CONVERGED and np.isnan(np.delete(np.diag(matrix), list(problem.fixed))).any():
            status = Status.SINGULAR
    values |= {"covariance": matrix, "law": law, "status": status}
    values |= quality(equations, float(np.sum((y - y.mean()) ** 2)), y.size)
    return SubmodelEstimate(result.theta[:p], result.theta, values)


def _better(one: Iterated | None, other: Iterated | None) -> Iterated | None:
    """The one that converged; of two that did not, that with the smaller output error."""
    if one is None or other is None:
        return other if one is None else one
    if other.status is Status.CONVERGED:
        return other
    return one if one.equations.squared_error <= other.equations.squared_error else other


def _law(
    problem: AdditiveProblem, theta: Array, equations: Equations, kind: Covariance, draws: int
) -> Uncertainty | None:
    """Uncertainty of all parameters, those of a free response included; None where the response is not finite."""
    if kind == "white" and not problem.fixed:
        count = problem.data.count
        found = white_noise_covariance(equations.hessian, equations.squared_error, count)
        return Uncertainty("white", np.eye(theta.size), found, count)
    rows = problem.filter.rows(theta)
    if rows is None:
        return None
    psi, _, error, _ = rows
    tangent = problem.tangent if problem.fixed else None
    return estimate_uncertainty([psi], [error], kind, draws, regular=problem.data.interval > 0.0, tangent=tangent)


def radius_in_loop(problem: AdditiveProblem, model: AdditiveModel) -> float:
    """Spectral radius of the sampled loop of a model with the controller [-]; NaN in open loop."""
    loop, interval = problem.loop, problem.data.interval
    if not loop.closed or interval == 0.0:
        return float("nan")
    return loop_radius(model, DiscreteController(loop.numerator, loop.denominator), interval)
