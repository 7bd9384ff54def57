"""Descent to a local minimum of the projected squared error, and what kind of minimum it is."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from ctid_cli.arrays import Array, BoolArray
from ctid_cli.estimation.optimum.box import TOUCH, Box, Point, frozen, moved_by
from ctid_cli.estimation.optimum.projection import Problem, Projected, project, slopes

#: Fall of the squared error that Newton's step may promise, as a fraction of it, at a minimum; what Newton's steps aim
#: at, and where a descent leaves the rest to them.
CONVERGED, AIM, NEAR = 1e-8, 1e-12, 1e-8
#: Residuals of this fraction of the output are rounding, for which no relative fall means anything.
ROUNDING = 1e-10
#: Steps of a descent, consecutive rejections, and steps of Newton's method at its end.
MOST_STEPS, MOST_REJECTIONS, MOST_NEWTON = 60, 12, 15
#: Step of the differences of the gradient; eigenvalues below this fraction of the largest have no sign.
DIFFERENCE, FLAT = 1e-4, 1e-9


class Ending(Enum):
    """What a local search has come to."""

    CONVERGED = "A local minimum of the output-error cost."
    AT_BOUND = "A minimum of the output-error cost within the stated set of models, at its border."
    RIDGE = "The least cost, which hardly changes along a direction as far as the stated set reaches."
    STALLED = "No step lowers the cost although none of the conditions of a minimum holds."

    @property
    def optimal(self) -> bool:
        """Whether no admissible model nearby is better."""
        return self is not Ending.STALLED


@dataclass(frozen=True, eq=False)
class Local:
    """Where a search is: the point, the least squares there, gradient and curvature of half the squared error."""

    point: Point
    projected: Projected
    gradient: Array
    curvature: Array

    @property
    def squared_error(self) -> float:
        """Sum of squared output errors."""
        return self.projected.squared_error


@dataclass(frozen=True, eq=False)
class Judged:
    """A local minimum and its kind."""

    local: Local
    ending: Ending
    #: Fall that Newton's step promises, as a fraction of the squared error.
    promise: float
    #: Coordinates held at a bound.
    held: BoolArray
    #: Whether the delay sits in a kink of the cost, at a sample.
    pinned: bool


class Descent:
    """Local searches on one record."""

    def __init__(self, problem: Problem, box: Box) -> None:
        self.problem, self.box = problem, box
        self.evaluations = 0
        used = problem.data.y[problem.data.use]
        self.count = used.size
        self.floor = ROUNDING**2 * float(used @ used)

    def value(self, point: Point) -> Projected:
        """Least squares for the poles and delay of a point."""
        self.evaluations += 1
        found: Projected = project(self.problem, point.speed, point.damping, point.delay)
        return found

    def local(self, point: Point, projected: Projected | None = None) -> Local:
        """Gradient and curvature at a point; the delay counts in quarter periods."""
        projected = self.value(point) if projected is None else projected
        self.evaluations += 1
        found = slopes(self.problem, point.speed, point.damping, point.delay, projected, self.box.delay_free)
        inner = np.eye(found.gradient.size)
        n = point.poles.size
        inner[:n, :n] = point.jacobian()
        if self.box.delay_free:
            inner[n, n] = self.box.quarter
        return Local(point, projected, inner.T @ found.gradient, inner.T @ found.curvature @ inner)

    def _faced(self, here: Local) -> Local:
        """Where the delay is at a sample, the side of it that goes downhill, if any."""
        delay, cell = here.point.delay, self.box.cell
        if delay.cell < 0 or not frozen(here.point, here.gradient, self.box)[-1]:
            return here
        side = 1 if here.gradient[-1] < 0 else -1
        # A delay at the bound of the set has no other side.
        low, high = self.box.delays
        if (side > 0 and delay.seconds >= high - TOUCH * cell) or (side < 0 and delay.seconds <= low + TOUCH * cell):
            return here
        sample = (delay.cell + (side > 0)) * cell
        other = replace(here.point, delay=delay._replace(seconds=sample, cell=delay.cell + side))
        across = self.local(other, here.projected)
        return across if across.gradient[-1] * side < 0 else here

    def descend(self, start: Point, steps: int = MOST_STEPS) -> Local:
        """Levenberg-Marquardt steps: Moré's scaling, Nielsen's damping, held coordinates frozen."""
        here = self.local(start)
        damping, factor, slow = 1e-3, 2.0, 0
        scale = np.zeros(here.gradient.size)
        for _ in range(steps):
            here = self._faced(here)
            free = ~frozen(here.point, here.gradient, self.box)
            gradient, curvature = here.gradient[free], here.curvature[np.ix_(free, free)]
            scale = np.maximum(scale, _lengths(here))
            unit = scale[free]
            scaled, slope = curvature / np.outer(unit, unit), gradient / unit
            if not free.any() or _promise(scaled, slope)[0] <= NEAR * max(here.squared_error, self.floor):
                break
            step = np.zeros(free.size)
            for _ in range(MOST_REJECTIONS):
                step[free] = -np.linalg.solve(scaled + damping * np.eye(unit.size), slope) / unit
                step /= max(1.0, float(np.abs(step).max()))
                trial = moved_by(here.point, step, self.box)
                found = self.value(trial)
                fall = here.squared_error - found.squared_error
                along = step[free]
                promised = -float(2.0 * along @ gradient + along @ curvature @ along)
                if fall > 0:
                    break
                damping, factor = damping * factor, factor * 2.0
            else:
                break
            damping *= max(1.0 / 3.0, 1.0 - (2.0 * fall / promised - 1.0) ** 3) if promised > 0 else 1.0
            damping, factor = max(damping, 1e-12), 2.0
            slow = slow + 1 if fall < 1e-9 * here.squared_error else 0
            same = np.array_equal(trial.damping < 0, here.point.damping < 0)
            here = self.local(trial, found)
            if not same:
                scale = np.zeros(here.gradient.size)
            # What is left is a narrow valley, which second derivatives see and Gauss-Newton steps do not.
            if slow == 3:
                break
        return here

    def hessian(self, here: Local) -> Array:
        """Second derivatives of half the squared error, by differences of its exact gradient."""
        size = here.gradient.size
        rows = np.zeros((size, size))
        for i in range(size):
            ends = []
            small = DIFFERENCE
            if self.box.cell > 0 and i == here.point.poles.size:
                small = min(small, 0.1 * self.box.cell / self.box.quarter)
            for side in (1.0, -1.0):
                step = np.zeros(size)
                step[i] = side * small
                beyond = _unbounded(here.point, step, self.box)
                # Across a sample the delay has other derivatives: stay in its cell.
                ends.append((0.0, here.gradient) if beyond is None else (side, self.local(beyond).gradient))
            rows[i] = (ends[0][1] - ends[1][1]) / (small * (ends[0][0] - ends[1][0]))
        return 0.5 * (rows + rows.T)

    def settle(self, here: Local) -> Judged:
        """Newton's steps to the minimum itself, along negative curvature where there is any, and its kind."""
        for _ in range(MOST_NEWTON):
            here = self._faced(here)
            free = ~frozen(here.point, here.gradient, self.box)
            if not free.any():
                return self._judged(here, free, 0.0, None)
            curvature = self.hessian(here)[np.ix_(free, free)]
            unit = _lengths(here)[free]
            scaled, slope = curvature / np.outer(unit, unit), here.gradient[free] / unit
            promise, values, vectors = _promise(scaled, slope)
            promise /= max(here.squared_error, self.floor)
            saddle = bool(values[0] < -FLAT * values[-1])
            if not saddle and promise <= AIM:
                return self._judged(here, free, promise, (values, vectors / unit[:, None]))
            following = self._newton(here, free, unit, slope, values, vectors)
            if following is None:
                promise = np.inf if saddle else promise
                return self._judged(here, free, promise, (values, vectors / unit[:, None]))
            here = following
        return self._judged(here, free, promise, (values, vectors / unit[:, None]))

    def _newton(
        self, here: Local, free: BoolArray, unit: Array, slope: Array, values: Array, vectors: Array
    ) -> Local | None:
        """A step of Newton's method that lowers the squared error, or none."""
        along = vectors.T @ slope
        flat = FLAT * max(float(np.abs(values).max()), 1e-300)
        parts = -along / np.maximum(np.abs(values), flat)
        if values[0] < -flat:
            parts[0] = -np.copysign(max(abs(parts[0]), np.sqrt(float(unit.max()))), along[0])
        step = np.zeros(free.size)
        step[free] = vectors @ parts / unit
        step /= max(1.0, float(np.abs(step).max()))
        for _ in range(MOST_REJECTIONS):
            for sign in (1.0, -1.0) if values[0] < -flat else (1.0,):
                trial = moved_by(here.point, sign * step, self.box)
                found = self.value(trial)
                if found.squared_error < here.squared_error:
                    return self.local(trial, found)
            step *= 0.4
        return None

    def _judged(self, here: Local, free: BoolArray, promise: float, modes: tuple[Array, Array] | None) -> Judged:
        held = ~free
        pinned, bound = False, held.copy()
        if self.box.delay_free and held[-1]:
            tau, (low, high) = here.point.delay.seconds, self.box.delays
            pinned = low < tau < high
            bound[-1] = not pinned
        ending = Ending.STALLED
        if modes is not None and self._on_ridge(here, free, *modes):
            ending = Ending.RIDGE
        elif promise <= CONVERGED:
            ending = Ending.AT_BOUND if bound.any() else Ending.CONVERGED
        return Judged(here, ending, promise, held, pinned)

    def _on_ridge(self, here: Local, free: BoolArray, values: Array, vectors: Array) -> bool:
        """Whether the squared error moves by less than its variance as far as the set reaches."""
        variance = here.squared_error / max(self.count - free.size - self.problem.zeros - 1, 1)
        direction = np.zeros(free.size)
        direction[free] = vectors[:, 0] / np.abs(vectors[:, 0]).max()
        # Twice the half squared error that the curvature promises for a step of one.
        if values[0] / np.abs(vectors[:, 0]).max() ** 2 > variance or here.squared_error <= self.floor:
            return False
        for sign in (1.0, -1.0):
            last, length = here.point, 1.0
            while True:
                trial = moved_by(here.point, sign * length * direction, self.box)
                if abs(self.value(trial).squared_error - here.squared_error) >= variance:
                    break
                if trial.speed.size == last.speed.size and np.allclose(trial.speed, last.speed, rtol=1e-9) and (
                    trial.delay.seconds == last.delay.seconds
                ):
                    return True
                last, length = trial, 2.0 * length
                if length > 64:
                    return True
        return False


def _lengths(here: Local) -> Array:
    """Lengths of the columns of the Jacobian; what has no effect at all gets the least that can be told from none."""
    lengths: Array = np.sqrt(np.maximum(np.diag(here.curvature), 0.0))
    return np.maximum(lengths, max(1e-9 * float(lengths.max()), 1e-150))


def _promise(curvature: Array, gradient: Array) -> tuple[float, Array, Array]:
    """``g'H^-1 g`` over the directions that curve, with the eigenvalues and vectors of H."""
    values, vectors = np.linalg.eigh(curvature)
    curved = values > FLAT * max(float(np.abs(values).max()), 1e-300)
    along = (vectors.T @ gradient)[curved]
    return float(np.sum(along**2 / values[curved])), values, vectors


def _unbounded(point: Point, step: Array, box: Box) -> Point | None:
    """The point a small step away, in the same coordinates, admissible or not; none across a sample."""
    speed, damping = point.shifted(step)
    delay = point.delay
    if box.delay_free and step[-1]:
        tau = delay.seconds + step[-1] * box.quarter
        if tau < 0 or (delay.cell >= 0 and not delay.cell * box.cell <= tau <= (delay.cell + 1) * box.cell):
            return None
        delay = delay._replace(seconds=tau)
    return Point(speed, damping, point.edge, delay)
