"""The least output error with some parameters at known values: their columns leave the normal equations."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.estimation.optimum.best_model import Optimum
from ctid_cli.estimation.optimum.search import Ending
from ctid_cli.estimation.output_error import Layout, sensitivities
from ctid_cli.estimation.profile_refinement import Refinement

#: Stages in which known parameters are brought from what they were estimated to be to their values.
STAGES = 5
#: Iterations of each stage, and of the last one.
ON_THE_WAY, MOST = 10, 200
#: A step that promises less than this fraction of the squared error ends the search.
PROMISE = 1e-12
#: Damping of the first step, and that from which on no step is tried any more.
FIRST_DAMPING, LARGEST_DAMPING = 1e-3, 1e12
#: Two searches that end within this fraction of the least squared error agree.
AGREE = 1e-6


@dataclass
class _Search:
    """Damped Gauss-Newton steps in all parameters that are not known."""

    refinement: Refinement
    layout: Layout
    fastest: float
    evaluations: int = field(default=0, init=False)

    def errors(self, theta: Array) -> tuple[Array, Array] | None:
        """Sensitivities and output errors of all records; None of a model that is not admissible."""
        n, problem = self.layout.structure.poles, self.refinement.problem
        if not np.isfinite(theta).all():
            return None
        poles = np.roots(np.concatenate(([1.0], theta[:n])))
        if not (poles.real < 0).all() or np.abs(poles).max() > self.fastest:
            return None
        low = self.refinement.measured.treatment.delay_bounds[0]
        self.evaluations += 1
        with np.errstate(all="ignore"):
            psi, eps = zip(*sensitivities(problem, self.layout, theta, low), strict=True)
        rows, error = np.concatenate(psi), np.concatenate(eps)
        return (rows, error) if np.isfinite(error).all() and np.isfinite(rows).all() else None

    def descend(self, theta: Array, free: Array, most: int) -> tuple[Array, float, bool]:
        """The least squared error near a start: parameters, squared error, and whether it is a minimum."""
        here, damping = self.errors(theta), FIRST_DAMPING
        if here is None:
            return theta, np.inf, False
        psi, error = here
        for _ in range(most):
            columns, squared = psi[:, free], float(error @ error)
            scale = np.maximum(np.linalg.norm(columns, axis=0), np.finfo(float).tiny)
            step = np.linalg.lstsq(columns / scale, error)[0]
            explained = float(np.sum((columns / scale @ step) ** 2))
            if explained <= PROMISE * squared:
                return theta, squared, True
            found = None
            while damping < LARGEST_DAMPING:
                grown = np.vstack((columns / scale, np.sqrt(damping) * np.eye(free.size)))
                step = np.linalg.lstsq(grown, np.concatenate((error, np.zeros(free.size))))[0] / scale
                trial = self._moved(theta, free, step)
                found = self.errors(trial)
                if found is not None and float(found[1] @ found[1]) < squared:
                    break
                found, damping = None, 4.0 * damping
            if found is None:
                # No step goes down: a minimum, up to rounding, or one at a bound or a kink of the delay.
                return theta, squared, explained <= 1e-6 * squared
            theta, (psi, error), damping = trial, found, 0.2 * damping
        return theta, float(error @ error), False

    def _moved(self, theta: Array, free: Array, step: Array) -> Array:
        """Parameters after a step, the delay within its bounds."""
        moved = theta.copy()
        moved[free] += step
        if self.layout.structure.delay:
            place = self.layout.structure.size - 1
            moved[place] = np.clip(moved[place], *self.refinement.measured.treatment.delay_bounds)
        return moved


def with_known(
    refinement: Refinement, known: Mapping[int, float], starts: Sequence[Array], free_optimum: Optimum
) -> Optimum:
    """The least output error with parameters at known values, from parameters that need not have them."""
    layout = refinement.layout_of(refinement.structure.poles, refinement.structure.delay)
    search = _Search(refinement, layout, free_optimum.box.fastest)
    places, values = np.array(list(known), dtype=int), np.array(list(known.values()))
    free = np.setdiff1d(np.arange(layout.size), places)
    ends = []
    for start in starts:
        theta = np.concatenate((start, np.zeros(layout.size - start.size)))
        given = theta[places].copy()
        for stage in range(1, STAGES + 1):
            theta = theta.copy()
            theta[places] = values + (given - values) * (STAGES - stage) / STAGES
            theta, squared, done = search.descend(theta, free, MOST if stage == STAGES else ON_THE_WAY)
        ends.append((squared, theta, done))
    squared, theta, done = min(ends, key=lambda end: end[0])
    structure, n = layout.structure, layout.structure.poles
    low, high = refinement.measured.treatment.delay_bounds
    delay = float(theta[structure.size - 1]) if structure.delay else low
    own = [layout.own_of(theta, k) for k in range(layout.experiments)]
    states = np.array([state if state.size else np.zeros(n) for state, _ in own])
    return replace(
        free_optimum,
        numerator=theta[n : n + structure.zeros + 1],
        denominator=np.concatenate(([1.0], theta[:n])),
        delay=delay,
        free_responses=states,
        offsets=np.array([offset for _, offset in own]),
        squared_error=squared,
        ending=Ending.CONVERGED if done else Ending.STALLED,
        promise=float("nan"),
        poles_at_infinity=0,
        pole_slopes=np.eye(n),
        held_poles=np.zeros(0, dtype=complex),
        delay_at_bound=structure.delay and delay in (low, high),
        pinned=False,
        tried=len(ends),
        agree=sum(end[0] <= squared * (1 + AGREE) for end in ends),
        evaluations=free_optimum.evaluations + search.evaluations,
    )
