"""Descent to a local minimum of the projected squared error, and classification of the minimum."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ctid_cli.arrays import Array, BoolArray, ComplexArray
from ctid_cli.estimation.optimum.box import (
    TOUCH,
    Bounds,
    Box,
    Point,
    at_bounds,
    box_of,
    frozen,
    moved_by,
    point_of,
    widened,
)
from ctid_cli.estimation.optimum.known import NOTHING, KnownCoefficients, null_space
from ctid_cli.estimation.optimum.projection import Problem, Projected, project, slopes, squared_errors
from ctid_cli.estimation.optimum.triangle import Delay

#: Predicted relative decrease of the squared error by a Newton step: largest value at a minimum, target of Newton
#: steps, and value at which a descent ends and Newton steps begin.
CONVERGED, AIM, NEAR = 1e-8, 1e-12, 1e-8
#: Residuals below this fraction of the output are rounding, for which relative decreases are meaningless.
ROUNDING = 1e-10
#: Largest numbers of steps of a descent, of consecutive rejections, and of final Newton steps.
MOST_STEPS, MOST_REJECTIONS, MOST_NEWTON = 60, 12, 15
#: Points that differ by less than this fraction in poles, dampings and squared error converge to one minimum.
CLOSE = 0.01
#: Corresponding difference of the delay on an irregular clock, as a fraction of a quarter period.
CLOSE_BETWEEN_KINKS = 1e-3
#: A search ends for a lower known minimum after FIRST_STEPS steps if the predicted decrease is less than 1/HOPELESS of
#: the distance to that minimum, and after PATIENCE steps if the squared error is still more than FAR times as high.
HOPELESS, FIRST_STEPS, PATIENCE, FAR = 30.0, 3, 12, 4.0
#: Step of the differences of the gradient; eigenvalues below this fraction of the largest count as zero.
DIFFERENCE, FLAT = 1e-4, 1e-9
#: One-sided differences suffice if the least eigenvalue exceeds their error by this factor.
SURE = 10.0
#: Least length of a ridge, in logarithms: a factor of two.
RIDGE = float(np.log(2.0))
#: A kink is searched for if a Newton step achieves less than this fraction of the predicted decrease, starting this
#: number of decades below the length of the step.
CROSSED, NEIGHBOURS = 0.01, 8
#: Least step along negative curvature, and longest step after which second derivatives are reused.
SADDLE, SHORT = 0.1, 0.01
#: No delay is at a kink.
NO_DELAYS: Mapping[int, int] = {}


class Ending(Enum):
    """Outcome of a local search."""

    CONVERGED = "A local minimum of the output-error cost."
    AT_BOUND = "A minimum of the output-error cost within the stated set of models, at its border."
    RIDGE = "The least cost, which hardly changes along a direction as far as the stated set reaches."
    STALLED = "No step lowers the cost although none of the conditions of a minimum holds."

    @property
    def optimal(self) -> bool:
        """Whether the point is a local minimum over the admissible models."""
        return self is not Ending.STALLED


@dataclass(frozen=True, eq=False)
class Local:
    """State of a search: the point, its least-squares solution, gradient and curvature of half the squared error.

    The fields from ``ending`` on are those of a settled minimum.
    """

    point: Point
    projected: Projected
    gradient: Array
    curvature: Array
    ending: Ending | None = None
    #: Predicted relative decrease of the squared error by a Newton step.
    promise: float = np.inf
    #: Mask of the coordinates held at a bound.
    held: BoolArray = field(default_factory=lambda: np.zeros(0, dtype=bool))
    #: Whether a delay is at a kink of the cost, at a sample; and inputs whose delays are held at a bound.
    pinned: bool = False
    delays_at_bound: tuple[int, ...] = ()

    @property
    def squared_error(self) -> float:
        """Sum of squared output errors."""
        return self.projected.squared_error


class Freedom(NamedTuple):
    """Feasible directions: free coordinates, and directions in them that preserve known coefficients."""

    free: BoolArray
    #: Scales of the free coordinates, and an orthonormal basis in these units, shape (f, r).
    unit: Array
    basis: Array

    def reduced(self, gradient: Array, curvature: Array) -> tuple[Array, Array]:
        """Return curvature and gradient in the basis."""
        scaled = curvature[np.ix_(self.free, self.free)] / np.outer(self.unit, self.unit)
        return self.basis.T @ scaled @ self.basis, self.basis.T @ (gradient[self.free] / self.unit)

    def whole(self, step: ArrayLike) -> Array:
        """Return steps in the basis, columns or one, as steps in all coordinates."""
        inner = self.basis @ np.asarray(step)
        moved = np.zeros((self.free.size, *inner.shape[1:]))
        moved[self.free] = (inner.T / self.unit).T
        return moved


class Descent:
    """Local search on records, over models with the known coefficients."""

    def __init__(self, problem: Problem, box: Box, known: KnownCoefficients = NOTHING) -> None:
        self.problem, self.box, self.known = problem._replace(numerator=known.numerator), box, known
        self.evaluations = 0
        used = np.concatenate([data.y_used for data in problem.records])
        self.count = used.size
        self.floor = ROUNDING**2 * float(used @ used)

    def value(self, point: Point, *, slopes_too: bool = False) -> Projected:
        """Return the least-squares solution at a point, optionally prepared for derivatives."""
        self.evaluations += 1
        return project(self.problem, point.speed, point.damping, point.delays, slopes_too=slopes_too)

    def squared_errors(self, points: Sequence[Point]) -> Array:
        """Return the squared errors at many points of one order, to compare them."""
        self.evaluations += len(points)
        errors, of_delay = np.zeros(len(points)), dict[tuple[Delay, ...], list[int]]()
        for k, point in enumerate(points):
            of_delay.setdefault(point.delays, []).append(k)
        for delays, places in of_delay.items():
            sections = [(points[k].speed, points[k].damping) for k in places]
            errors[places] = squared_errors(self.problem, sections, delays)
        return errors

    def sorted(self, points: Sequence[Point]) -> list[Point]:
        """Return points in order of ascending squared error."""
        return [points[k] for k in np.argsort(self.squared_errors(points), kind="stable")]

    def local(self, point: Point, projected: Projected | None = None) -> Local:
        """Return gradient and curvature at a point, with delays in quarter periods."""
        projected = self.value(point, slopes_too=True) if projected is None else projected
        self.evaluations += 1
        free, edge = self.box.free_delays, self.box.beyond_edges
        delays = tuple(
            delay._replace(seconds=max(delay.seconds, edge)) if k in free else delay
            for k, delay in enumerate(point.delays)
        )
        found = slopes(self.problem, point.speed, point.damping, delays, projected, free)
        if not np.isfinite(found.curvature).all():
            # Responses overflow, and the search stays at a point of no use.
            found = found._replace(gradient=np.zeros_like(found.gradient), curvature=np.zeros_like(found.curvature))
        inner = self.box.quarter * np.eye(found.gradient.size)
        n = found.gradient.size - len(free)
        inner[:n, :n] = point.jacobian()
        return Local(point, projected, inner.T @ found.gradient, inner.T @ found.curvature @ inner)

    def at_its_delay(self, point: Point) -> Point:
        """Return a point after one Gauss-Newton step at constant delays."""
        here = self.local(point)
        ways = self._freedom(here, _lengths(here), kinked=self.box.delay_places)
        scaled, slope = ways.reduced(here.gradient, here.curvature)
        step = ways.whole(-np.linalg.lstsq(scaled, slope, rcond=FLAT)[0])
        step /= max(1.0, float(np.abs(step).max()))
        moved = self._moved(here.point, step)
        return point if moved is None else moved

    def _freedom(self, here: Local, lengths: Array, kinked: Mapping[int, int] = NO_DELAYS) -> Freedom:
        """Return the feasible directions in scaled coordinates, excluding delays at a kink."""
        slopes = self.known.slopes(here.point, lengths.size)
        free = ~self.known.held(here.gradient / lengths, slopes / lengths, *at_bounds(here.point, self.box))
        if kinked:
            free[list(kinked.values())] = False
        return Freedom(free, lengths[free], null_space(slopes[:, free] / lengths[free]))

    def _moved(self, point: Point, step: Array) -> Point | None:
        """Return the admissible point after a step, with the known coefficients; None if there is none."""
        return self.known.met(moved_by(point, step, self.box), self.box)

    def _faced(self, here: Local) -> Local:
        """Return the point with each delay at a sample moved to the cell with a descent direction, if any."""
        if not self.box.cell:
            return here
        for k, place in self.box.delay_places.items():
            here = self._one_faced(here, k, place)
        return here

    def _one_faced(self, here: Local, k: int, place: int) -> Local:
        """Return the point with one delay at a sample moved to the cell with a descent direction."""
        delay, cell = here.point.delays[k], self.box.cell
        if delay.cell < 0 or not frozen(here.point, here.gradient, self.box)[place]:
            return here
        side = 1 if here.gradient[place] < 0 else -1
        # A delay at the bound of the set has no other side.
        low, high = self.box.each_delay[k]
        if (side > 0 and delay.seconds >= high - TOUCH * cell) or (side < 0 and delay.seconds <= low + TOUCH * cell):
            return here
        sample = (delay.cell + (side > 0)) * cell
        delays = list(here.point.delays)
        delays[k] = delay._replace(seconds=sample, cell=delay.cell + side)
        across = self.local(here.point.with_delays(delays), here.projected)
        return across if across.gradient[place] * side < 0 else here

    def descend(
        self,
        start: Point,
        known: Sequence[Local] = (),
        near: float = NEAR,
        most_steps: int = MOST_STEPS,
        *,
        to_end: bool = False,
    ) -> Local:
        """Descend by Levenberg-Marquardt steps: Moré's scaling, Nielsen's damping, held coordinates constant.

        A search ends close to a known minimum, at a predicted relative decrease below ``near``, or unless ``to_end`` if
        it is not expected to reach the lowest known minimum.
        """
        here = self.local(start)
        lowest = min((other.squared_error for other in known), default=np.inf) if not to_end else np.inf
        damping, factor, slow = 1e-3, 2.0, 0
        scale = np.zeros(here.gradient.size)
        for taken in range(most_steps):
            here = self._faced(here)
            reached = next((other for other in known if _close(here, other, self.box)), None)
            if reached is not None:
                return reached
            scale = np.maximum(scale, _lengths(here))
            ways = self._freedom(here, scale)
            scaled, slope = ways.reduced(here.gradient, here.curvature)
            promise = _promise(scaled, slope)[0] if slope.size else 0.0
            arrived = not scale.size or promise <= near * max(here.squared_error, self.floor)
            if arrived or _hopeless(taken, here.squared_error, promise, lowest):
                break
            for _ in range(MOST_REJECTIONS):
                step = ways.whole(np.linalg.solve(scaled + damping * np.eye(slope.size), -slope))
                step /= max(1.0, float(np.abs(step).max()))
                lower = self._lower(here, self._whole_and_to_edge(here.point, step))
                if lower is not None:
                    break
                damping, factor = damping * factor, factor * 2.0
            else:
                break
            along, trial, found = lower
            fall = here.squared_error - found.squared_error
            promised = -float(2.0 * along @ here.gradient + along @ here.curvature @ along)
            damping *= max(1.0 / 3.0, 1.0 - (2.0 * fall / promised - 1.0) ** 3) if promised > 0 else 1.0
            damping, factor = max(damping, 1e-12), 2.0
            slow = slow + 1 if fall < 1e-9 * here.squared_error else 0
            same = np.array_equal(trial.damping < 0, here.point.damping < 0)
            here = self.local(trial, found)
            if not same:
                scale = np.zeros(here.gradient.size)
            # A narrow valley requires second derivatives, not Gauss-Newton steps.
            if slow == 3:
                break
        return here

    def _forces(self, here: Local) -> Array:
        """Return the multipliers of the known coefficients of the denominator."""
        if not self.known.places.size:
            return np.zeros(0)
        lengths = _lengths(here)
        free = self._freedom(here, lengths).free
        slopes = self.known.slopes(here.point, lengths.size) / lengths
        return np.asarray(np.linalg.lstsq(slopes[:, free].T, -(here.gradient / lengths)[free])[0])

    def hessian(self, here: Local) -> Array:
        """Return second derivatives of half the squared error, by differences of its exact gradient.

        With known coefficients of the denominator these are derivatives of the Lagrangian along the constraint.
        One-sided differences come first: their asymmetry shows their error, and whether central ones are needed.
        """
        size = here.gradient.size
        forces = self._forces(here)
        steps = np.full(size, DIFFERENCE)
        if self.box.cell > 0:
            steps[size - len(self.box.free_delays) :] = min(DIFFERENCE, 0.1 * self.box.cell / self.box.quarter)
        rows, widths, unit = np.zeros((size, size)), np.zeros(size), _lengths(here)
        for side in (1.0, -1.0):
            for i in range(size):
                # The derivatives by the delay change at a sample: stay in its cell.
                beyond = _unbounded(here.point, side * steps[i] * np.eye(size)[i], self.box)
                if beyond is not None:
                    change = self.local(beyond).gradient - here.gradient
                    if forces.size:
                        change += forces @ (self.known.slopes(beyond, size) - self.known.slopes(here.point, size))
                    rows[i] += side * change
                    widths[i] += steps[i]
            if not (widths > 0).all():
                continue
            whole = rows / widths[:, None]
            error = np.linalg.norm((whole - whole.T) / np.outer(unit, unit))
            if np.linalg.eigvalsh(0.5 * (whole + whole.T) / np.outer(unit, unit))[0] > SURE * (error + DIFFERENCE):
                break
        return 0.5 * (whole + whole.T)

    def settle(self, here: Local) -> Local:
        """Converge to the minimum by Newton steps, also along negative curvature, and classify it."""
        kinked: dict[int, int] = {}
        second: Array | None = None
        for _ in range(MOST_NEWTON):
            here = self._faced(here)
            ways = self._freedom(here, _lengths(here), kinked)
            free = ways.free
            if not ways.basis.shape[1]:
                return self._classified(here, free, 0.0, None)
            fresh = second is None
            second = self.hessian(here) if second is None else second
            scaled, slope = ways.reduced(here.gradient, second)
            promise, values, vectors = _promise(scaled, slope)
            saddle = bool(values[0] < -FLAT * values[-1])
            promise = np.inf if saddle else promise / max(here.squared_error, self.floor)
            modes = values, ways.whole(vectors)
            if promise <= AIM:
                return self._classified(here, free, promise, modes)
            step = ways.whole(_newton_step(values, vectors, slope))
            length = float(np.abs(step).max())
            # At a saddle the gradient does not determine the step length.
            step *= (min(max(length, SADDLE), 1.0) if saddle else min(length, 1.0)) / max(length, 1e-300)
            lower = self._lower_along(here, step, saddle)
            fall = 0.0
            if lower is not None:
                # After a short step the second derivatives are accurate enough for the test of convergence.
                same = np.array_equal(lower[1].damping < 0, here.point.damping < 0)
                short = float(np.abs(lower[0]).max()) < SHORT
                fall = 1.0 - lower[2].squared_error / here.squared_error
                here = self.local(*lower[1:])
                second = second if fresh and same and short else None
            elif not fresh:
                second = None
                continue
            # A step with much less than the predicted decrease has crossed a kink.
            if lower is None or fall < CROSSED * promise < np.inf:
                kink = self._in_kink(here, step, free)
                if kink is not None:
                    here, k, place = kink
                    kinked, second = {**kinked, k: place}, None
                    continue
            if lower is None:
                return self._classified(here, free, promise, modes)
        return self._classified(here, free, promise, modes)

    def _lower_along(self, here: Local, step: Array, both: bool) -> tuple[Array, Point, Projected] | None:
        """Return the longest fraction of a step that reduces the squared error, with ``both`` in either direction."""
        for length in 0.4 ** np.arange(MOST_REJECTIONS):
            whole = self._whole_and_to_edge(here.point, length * step)
            lower = self._lower(here, [*whole, -length * step] if both else whole)
            if lower is not None:
                return lower
        return None

    def _lower(self, here: Local, steps: Sequence[Array]) -> tuple[Array, Point, Projected] | None:
        """Return the first of several steps that reduces the squared error, with its point and projection."""
        for step in steps:
            trial = self._moved(here.point, step)
            if trial is None:
                continue
            found = self.value(trial, slopes_too=True)
            if found.squared_error < here.squared_error:
                return step, trial, found
        return None

    def _whole_and_to_edge(self, point: Point, step: Array) -> list[Array]:
        """Return a step, and its parts up to the samples that it crosses: a minimum may be at the kink."""
        parts = []
        for k, place in self.box.delay_places.items():
            delay, cell = point.delays[k], self.box.cell
            if delay.cell >= 0 and step[place] != 0.0:
                way = (delay.cell + (step[place] > 0)) * cell - delay.seconds
                parts.append(way / (step[place] * self.box.quarter))
        return [step, *(part * step for part in sorted(parts, reverse=True) if 0.0 < part < 1.0)]

    def _in_kink(self, here: Local, step: Array, free: BoolArray) -> tuple[Local, int, int] | None:
        """Return the nearest kink along a delay on an irregular clock, its input, and its coordinate."""
        for k, place in self.box.delay_places.items():
            if free[place]:
                found = self._in_kink_along(here, k, place, float(abs(step[place])))
                if found is not None:
                    return found, k, place
        return None

    def _in_kink_along(self, here: Local, k: int, place: int, reach: float) -> Local | None:
        """Return the nearest kink along one delay; None if there is none.

        The slope along the delay changes sign at the kink. The next kink may be closer than the step, so distances are
        tried in ascending order; bisection follows until no decrease is possible between the two sides.
        """
        if here.point.delays[k].cell >= 0 or not reach > 0:
            return None
        along = np.eye(here.gradient.size)[place]

        def at(shift: float) -> Local:
            return self.local(moved_by(here.point, shift * along, self.box))

        for length in reach * 10.0 ** np.arange(-NEIGHBOURS, 1.0):
            low, high = -length, length
            before, after = at(low), at(high)
            if before.gradient[place] <= 0 <= after.gradient[place]:
                break
        else:
            return None
        while (high - low) * (after.gradient[place] - before.gradient[place]) > CONVERGED * here.squared_error:
            middle = 0.5 * (low + high)
            if not low < middle < high:
                break
            between = at(middle)
            if between.gradient[place] <= 0:
                low, before = middle, between
            else:
                high, after = middle, between
        return min((here, before, after), key=lambda one: one.squared_error)

    def _classified(self, here: Local, free: BoolArray, promise: float, modes: tuple[Array, Array] | None) -> Local:
        held = ~free
        pinned, bound, at_bound = False, held.copy(), []
        for k, place in self.box.delay_places.items():
            low, high = self.box.each_delay[k]
            if held[place] and low < here.point.seconds[k] < high:
                pinned, bound[place] = True, False
            elif held[place]:
                at_bound.append(k)
        ending = Ending.STALLED
        if modes is not None and self._on_ridge(here, free, *modes):
            ending = Ending.RIDGE
        elif promise <= CONVERGED:
            ending = Ending.AT_BOUND if bound.any() else Ending.CONVERGED
        return replace(here, ending=ending, promise=promise, held=held, pinned=pinned, delays_at_bound=tuple(at_bound))

    def _on_ridge(self, here: Local, free: BoolArray, values: Array, vectors: Array) -> bool:
        """Return whether the squared error changes by less than the residual's variance up to the limit of the set.

        The limit must be at least a factor of two away: closer to it, a direction is short, not flat.
        """
        variance = here.squared_error / max(self.count - free.size - self.problem.coefficients, 1)
        direction = vectors[:, 0] / np.abs(vectors[:, 0]).max()
        # Change of the squared error predicted by the curvature over a factor of two.
        expected = values[0] * (RIDGE / np.abs(vectors[:, 0]).max()) ** 2
        if expected > 4.0 * variance or here.squared_error <= self.floor:
            return False
        for sign in (1.0, -1.0):
            last = self._moved(here.point, 0.9 * sign * RIDGE * direction)
            for length in RIDGE * 2.0 ** np.arange(8):
                trial = self._moved(here.point, sign * length * direction)
                if trial is None or last is None:
                    break
                if _same(trial, last):
                    # At a bound of the set.
                    if length > RIDGE:
                        return True
                    break
                if abs(self.value(trial).squared_error - here.squared_error) >= variance:
                    break
                last = trial
        return False


def local_minimum(
    problem: Problem,
    poles: ComplexArray,
    delay: float | Sequence[float],
    delays: Bounds,
    *effort: Any,
    box: Box | None = None,
    known: KnownCoefficients = NOTHING,
) -> Local:
    """Descend from given poles, which satisfy the known coefficients, and delay, which stays within its bounds.

    Comparable costs require one ``box``; the default is that of the problem, which depends on its free response.
    """
    box = box or box_of(problem, delays)
    if known.all_poles:
        box = widened(box, poles)
    return Descent(problem, box, known).descend(point_of(poles, delay, box), (), *effort)


def _same(one: Point, other: Point) -> bool:
    """Return whether two points are equal up to rounding."""
    return (
        one.speed.size == other.speed.size
        and np.allclose(one.speed, other.speed, rtol=1e-9)
        and one.seconds == other.seconds
    )


def _close(here: Local, other: Local, box: Box) -> bool:
    """Return whether two points are close enough to converge to one minimum."""
    if here.squared_error >= (1 + CLOSE) * other.squared_error:
        return False
    if here.point.cells != other.point.cells or not np.array_equal(here.point.damping < 0, other.point.damping < 0):
        return False
    away = np.concatenate((here.point.speed / other.point.speed - 1, here.point.damping / other.point.damping - 1))
    each = zip(here.point.seconds, other.point.seconds, strict=True)
    later = max(abs(one - two) for one, two in each) / box.quarter
    # On an irregular clock minima are closer along the delay.
    nearest = CLOSE if box.cell > 0 else CLOSE_BETWEEN_KINKS
    return bool(np.abs(away).max(initial=0.0) < CLOSE and later < nearest)


def _hopeless(taken: int, squared_error: float, promise: float, lowest: float) -> bool:
    """Return whether a search is not expected to reach the lowest known minimum."""
    too_flat = taken >= FIRST_STEPS and squared_error - HOPELESS * promise > lowest
    return too_flat or (taken >= PATIENCE and squared_error > FAR * lowest)


def _newton_step(values: Array, vectors: Array, gradient: Array) -> Array:
    """Return ``-H^-1 g`` with absolute eigenvalues of H; along a negative one the step is at least one."""
    along = vectors.T @ gradient
    flat = FLAT * max(float(np.abs(values).max(initial=0.0)), 1e-300)
    parts = -along / np.maximum(np.abs(values), flat)
    if values[0] < -flat:
        parts[0] = -np.copysign(max(abs(parts[0]), 1.0), along[0])
    step: Array = vectors @ parts
    return step


def _lengths(here: Local) -> Array:
    """Return the norms of the columns of the Jacobian, at least the smallest significant one."""
    lengths: Array = np.sqrt(np.maximum(np.diag(here.curvature), 0.0))
    return np.maximum(lengths, max(1e-9 * float(lengths.max(initial=0.0)), 1e-150))


def _promise(curvature: Array, gradient: Array) -> tuple[float, Array, Array]:
    """Return ``g'H^-1 g`` over the directions of nonzero curvature, with the eigenvalues and vectors of H."""
    values, vectors = np.linalg.eigh(curvature)
    curved = values > FLAT * max(float(np.abs(values).max(initial=0.0)), 1e-300)
    along = (vectors.T @ gradient)[curved]
    return float(np.sum(along**2 / values[curved])), values, vectors


def _unbounded(point: Point, step: Array, box: Box) -> Point | None:
    """Return the point after a small step in the same coordinates, admissible or not; None across a sample."""
    speed, damping = point.shifted(step)
    delays = list(point.delays)
    for k, place in box.delay_places.items():
        if step[place]:
            tau, cell = delays[k].seconds + step[place] * box.quarter, delays[k].cell
            if tau < 0 or (cell >= 0 and not cell * box.cell <= tau <= (cell + 1) * box.cell):
                return None
            delays[k] = delays[k]._replace(seconds=tau)
    return replace(point, speed=speed, damping=damping, delays=tuple(delays))
