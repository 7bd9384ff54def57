"""The best output-error model of a record within the stated set, and how far that may be trusted."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from ctid_cli.arrays import Array, ComplexArray
from ctid_cli.errors import DataError
from ctid_cli.estimation.optimum.box import Box, box_of, point_of, widened
from ctid_cli.estimation.optimum.chain import numerators
from ctid_cli.estimation.optimum.known import NOTHING, KnownCoefficients, null_space
from ctid_cli.estimation.optimum.pilot import part_of
from ctid_cli.estimation.optimum.projection import Problem
from ctid_cli.estimation.optimum.search import Ending, Judged
from ctid_cli.estimation.optimum.starts import QUICK, SAME, Nest
from ctid_cli.filtering.filter_data import FilterData
from ctid_cli.models.transfer_function import TransferFunction

#: A model found from a part of the records is one of all of them if its mean squared error there is at most so many
#: times that in the part, and so large a share of the output's variance is explained.
AS_GOOD, EXPLAINED = 1.5, 0.05


@dataclass(frozen=True)
class SearchOptions:
    """What is estimated beside the coefficients, and where the searches start."""

    #: Least and greatest delay [s]; two equal numbers are a known delay.
    delays: tuple[float, float] = (0.0, 0.0)
    free_response: bool = False
    offset: bool = False
    #: Poles at the origin, besides those that are searched. With free responses these hold the offset, too; no record
    #: may repeat itself.
    integrators: int = 0
    #: Period [s] of each record that repeats for ever, 0 for another; by default none repeats.
    periods: Sequence[float] = ()
    #: Denominators and delays [s] that other estimators have found.
    starts: Sequence[tuple[ArrayLike, float]] = ()
    #: Whether the smaller models that the structure contains are fitted too: their optima are starts. Without them only
    #: the given starts are refined.
    nested: bool = True
    #: Whether the least of all is returned, so that the cost never rises with the structure, though with fewer poles.
    fewer_poles: bool = True
    #: Further starts at random, so many and so many for each pole, also of the smaller models. Where these are left
    #: out: only if the given starts do not agree.
    random_starts: int = 10
    seed: int = 0
    #: Coefficients that are known.
    known: KnownCoefficients = NOTHING


@dataclass(frozen=True, eq=False)
class Optimum:
    """The least output error that was found."""

    #: Coefficients in descending powers, the denominator monic.
    numerator: Array
    denominator: Array
    delay: float
    #: Of each record, coefficients of C in the free response ``C/A delta(t - t_s)``, descending powers, and offset;
    #: zeros without them.
    free_responses: Array
    offsets: Array
    squared_error: float
    ending: Ending
    #: Fall of the squared error that Newton's step promises, as a fraction of it.
    promise: float
    #: Poles of the structure that have run to infinity, where a smaller model has the least squared error.
    poles_at_infinity: int
    #: Derivatives of ``a_1 ... a_n`` to the coordinates of the poles, or with known ones of those to directions that
    #: keep them, where no bound of the set holds the poles; and the poles that are held.
    pole_slopes: Array
    held_poles: ComplexArray
    #: Whether the delay would leave its bounds.
    delay_at_bound: bool
    #: Whether the delay sits in a kink of the cost, at a sample.
    pinned: bool
    tried: int
    agree: int
    evaluations: int
    box: Box = field(repr=False)
    #: Poles at the origin, which the denominator does not have.
    integrators: int = 0

    @property
    def model(self) -> TransferFunction:
        """The model."""
        return TransferFunction(self.numerator, np.append(self.denominator, np.zeros(self.integrators)), self.delay)


def best_output_error(records: Sequence[FilterData], poles: int, zeros: int, options: SearchOptions) -> Optimum:
    """Least sum of squared output errors of a structure and of all that it contains.

    As many zeros as poles need a known delay. Free responses begin at the first used sample of each record.
    """
    problem = problem_of(records, zeros, options)
    box = box_of(problem, options.delays)
    if options.known is not NOTHING:
        return _with_known(problem, box, poles, options)
    if options.nested and (part := part_of(problem, options.delays[1])) is not None:
        found = _from_part(problem, part, box, poles, options)
        if found is not None:
            return found
    nest = Nest(problem, box, options.random_starts, options.seed)
    points = [point_of(np.roots(np.asarray(a, dtype=float)).astype(complex), tau, box) for a, tau in options.starts]
    if options.nested or not points:
        nest.optima(poles, zeros)
        points += nest.resonances(poles, zeros)
    nest.refine(poles, zeros, points)
    if options.nested:
        nest.refine(poles, zeros, nest.close_delays(poles, zeros))
    found = least(nest, poles, zeros, options.nested and options.fewer_poles)
    in_doubt = (found.tried > 1 and found.agree == 1) or not found.ending.optimal
    if options.nested or not in_doubt:
        return found
    nest.refine(poles, zeros, nest.random_points(poles))
    return least(nest, poles, zeros, False)


def _with_known(problem: Problem, box: Box, poles: int, options: SearchOptions) -> Optimum:
    """Return the least output error of the models that have known coefficients."""
    zeros, known = problem.zeros, options.known
    if known.all_poles:
        box = widened(box, known.poles)
    points = [point_of(np.roots(np.asarray(a, dtype=float)).astype(complex), tau, box) for a, tau in options.starts]
    part = part_of(problem, options.delays[1]) if options.nested else None
    if options.nested and part is None:
        free = Nest(problem, box, options.random_starts, options.seed)
        nest = free.with_known(poles, zeros, known, points)
        if nest.optima(poles, zeros):
            nest.refine(poles, zeros, nest.close_delays(poles, zeros))
    else:
        if part is not None:
            there = _with_known(part, box_of(part, options.delays), poles, options)
            points = [point_of(there.model.poles, there.delay, box)]
        nest = Nest(problem, box, 0, options.seed, known=known)
        moved = (known.met(point, box) for point in points)
        nest.refine(poles, zeros, [point for point in moved if point is not None])
    if not nest.optima(poles, zeros):
        given = ", ".join(f"a{place + 1} = {known.denominator[place]:g}" for place in known.places.tolist())
        raise DataError(
            f"no model with the fixed {given} has all its poles where they are searched: {box.in_words()}; "
            "change or drop the fixed value"
        )
    return least(nest, poles, zeros, False)


def _from_part(problem: Problem, part: Problem, box: Box, poles: int, options: SearchOptions) -> Optimum | None:
    """The search of a part, followed on the whole records; None where they say more, or something else, than it."""
    zeros, fewer = problem.zeros, options.fewer_poles
    pilot = Nest(part, box_of(part, options.delays), options.random_starts, options.seed)
    expected = least(pilot, poles, zeros, fewer)
    found = least(Nest(problem, box, options.random_starts, options.seed, pilot), poles, zeros, fewer)
    count, part_count = (sum(data.count for data in one.records) for one in (problem, part))
    power = sum(data.count * float(np.var(data.y_used)) for data in problem.records)
    if found.squared_error > min(AS_GOOD * expected.squared_error * count / part_count, (1 - EXPLAINED) * power):
        return None
    return replace(found, tried=expected.tried, agree=expected.agree)


def least(nest: Nest, poles: int, zeros: int, fewer_poles: bool) -> Optimum:
    """The least squared error that a nest knows of a structure."""
    # With a pole at infinity a model of one pole less, whatever its zeros, is in the closure of the structure.
    integrators = nest.problem.integrators
    fewest = max(zeros + int(nest.box.delay_free) - integrators, int(not integrators)) if fewer_poles else poles
    found = [nest.settled(n, zeros) for n in range(poles, fewest - 1, -1)] or [nest.settled(poles, zeros)]
    errors = [judged.local.squared_error for judged in found]
    # Such a pole costs nothing: a smaller model must be worse by more than rounding to lose.
    lost = next(k for k, error in enumerate(errors) if error <= min(errors) * (1 + 1e-9))
    ends = np.array(nest.ends(poles - lost, zeros))
    level = max(min(errors), float(ends.min()))
    agree = int(np.count_nonzero(ends <= level * (1 + SAME) + nest.descent(zeros).floor))
    return _optimum(found[lost], lost, ends.size, agree, nest)


class Ladder(Nest):
    """The optima of a range of structures, each from those below it, with few starts and none at random."""

    def __init__(self, nest: Nest) -> None:
        super().__init__(nest.problem, nest.box, 0, nest.seed, effort=QUICK)

    def best(self, poles: int, zeros: int) -> Optimum:
        """The least squared error of a structure and of those with fewer poles that are in its closure."""
        return least(self, poles, zeros, fewer_poles=True)


def problem_of(records: Sequence[FilterData], zeros: int, options: SearchOptions) -> Problem:
    """The records and what is eliminated with them."""
    periods = tuple(options.periods) or (0.0,) * len(records)
    data = tuple(_one_period(*pair) if pair[1] else pair[0] for pair in zip(records, periods, strict=True))
    integrators = options.integrators
    if integrators and any(periods):
        raise ValueError("what an integrator makes of a periodic input need not repeat itself")
    return Problem(data, zeros, options.free_response, options.offset, periods, integrators=integrators)


def _one_period(data: FilterData, period: float) -> FilterData:
    """The record with the breaks of its input within one period."""
    within = data.tu < data.tu[0] + period * (1 - 1e-9)
    if within.all():
        return data
    # A regular pass takes a break for each sample.
    return data._replace(tu=data.tu[within].copy(), u=data.u[within].copy(), interval=0.0)


def _optimum(best: Judged, lost: int, tried: int, agree: int, nest: Nest) -> Optimum:
    """The model in coefficients of polynomials."""
    point, projected = best.local.point, best.local.projected
    a, known, n = point.denominator, nest.known, point.poles.size
    over = numerators(*nest.problem.sections(point.speed, point.damping))
    held = best.held[:n]
    b = projected.output @ over
    if projected.direct:
        b = np.concatenate(([0.0], b)) + projected.direct * np.append(a, np.zeros(nest.problem.integrators))
    slopes = point.denominator_slopes()[:, ~held]
    if known is not NOTHING:
        # The same up to rounding.
        a[1:][known.places] = known.denominator[known.places]
        given = np.isfinite(known.numerator)
        b = b[b.size - given.size :]
        b[given] = known.numerator[given]
        slopes = slopes @ null_space(known.slopes(point, n)[:, ~held])
    return Optimum(
        numerator=np.trim_zeros(b, "f") if b.any() else np.zeros(1),
        denominator=a,
        delay=point.delay.seconds,
        free_responses=projected.free @ over,
        offsets=projected.offset,
        squared_error=best.local.squared_error,
        ending=best.ending,
        promise=best.promise,
        poles_at_infinity=lost,
        pole_slopes=slopes,
        held_poles=point.poles[point.whole_sections(held)],
        delay_at_bound=nest.box.delay_free and bool(best.held[-1]) and not best.pinned,
        pinned=best.pinned,
        tried=tried,
        agree=agree,
        evaluations=nest.evaluations,
        box=nest.box,
        integrators=nest.problem.integrators,
    )
