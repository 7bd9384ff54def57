"""Best output-error model of a record within the admissible set, with diagnostics of the optimum."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from ctid_cli.arrays import Array, ComplexArray
from ctid_cli.errors import DataError
from ctid_cli.estimation.optimum.box import Bounds, Box, Point, box_of, point_of, widened
from ctid_cli.estimation.optimum.chain import all_numerators, numerators, polynomial
from ctid_cli.estimation.optimum.known import NOTHING, KnownCoefficients, null_space
from ctid_cli.estimation.optimum.projection import Problem, Projected
from ctid_cli.estimation.optimum.search import Ending, Local
from ctid_cli.estimation.optimum.starts import SAME, THOROUGH, StructureSearch, block_starts
from ctid_cli.estimation.optimum.sum_starts import SumGrowth, in_order
from ctid_cli.filtering.filter_data import FilterData
from ctid_cli.inference.sensitivities import SumStructure
from ctid_cli.models.additive import AdditiveModel, Submodel
from ctid_cli.models.factoring import unfactored
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.progress import reported

#: A model found from a part of the records is accepted for all of them if its mean squared error on all is at most
#: AS_GOOD times that on the part, and it explains at least the share EXPLAINED of the output's variance.
AS_GOOD, EXPLAINED = 1.5, 0.05
#: Records with more samples than LONG are long; a part of them has PART samples.
LONG, PART = 100_000, 20_000


#: Start of a search: a denominator, or the concatenated poles of several denominators; and the delay, or one for each
#: input [s].
Begin = tuple[Any, float | tuple[float, ...]]


class OtherMinimum(NamedTuple):
    """Further local minimum of the structure, nearly as low as the least one."""

    #: Poles without integrators [rad/s]; those of several denominators are concatenated.
    poles: ComplexArray
    #: Delay of each input [s].
    delays: tuple[float, ...]
    squared_error: float
    #: Start of a search for this minimum.
    start: Begin


@dataclass(frozen=True, eq=False)
class Optimum:
    """Model with the least output error found."""

    #: Coefficients in descending powers: numerators, and monic denominators, of the fractions; a common one only once.
    numerators: tuple[Array, ...]
    denominators: tuple[Array, ...]
    #: Delay of each input [s].
    delays: tuple[float, ...]
    #: For each record, coefficients of C in the free responses ``C/A delta(t - t_s)`` in descending powers, zeros
    #: without free responses; and coefficients of the powers of time.
    free_responses: Array
    trends: Array
    squared_error: float
    ending: Ending
    #: Predicted relative decrease of the squared error by a Newton step.
    promise: float
    #: Number of poles at infinity, if a smaller model has the least squared error.
    poles_at_infinity: int
    #: Derivatives of ``a_1 ... a_n`` with respect to the coordinates of poles that are not at a bound, or to directions
    #: that preserve known coefficients; and the poles at a bound.
    pole_slopes: Array
    held_poles: ComplexArray
    #: Inputs whose delays are held at a bound.
    delays_at_bound: tuple[int, ...]
    #: Whether a delay is at a kink of the cost, at a sample.
    pinned: bool
    tried: int
    agree: int
    evaluations: int
    box: Box = field(repr=False)
    #: Indices of the input and of the denominator of each fraction.
    drivers: tuple[tuple[int, int], ...] = ((0, 0),)
    #: Poles of each fraction at the origin, which its denominator does not contain.
    integrators: tuple[int, ...] = (0,)
    #: Submodels, if the model is a sum of submodels.
    additive: AdditiveModel | None = None
    #: Other minima of the structure whose squared error S satisfies ``N (S/S_min - 1) <= 3 * 3.84`` for N samples.
    others: tuple[OtherMinimum, ...] = ()

    @property
    def numerator(self) -> Array:
        """Numerator of the first fraction."""
        return self.numerators[0]

    @property
    def denominator(self) -> Array:
        """First denominator."""
        return self.denominators[0]

    @property
    def delay(self) -> float:
        """Delay of the first input [s]."""
        return self.delays[0]

    @property
    def start(self) -> Begin:
        """Start of a search from this model."""
        if len(self.denominators) == 1 and self.additive is None:
            return self.denominators[0], self.delays
        return np.concatenate([np.roots(a) for a in self.denominators]).astype(complex), self.delays

    @property
    def fractions(self) -> tuple[TransferFunction, ...]:
        """Transfer function of each input."""
        if self.additive is not None:
            whole = unfactored(self.additive)
            return (TransferFunction(_trimmed(whole.numerator), whole.denominator, self.delay),)
        each = zip(self.numerators, self.drivers, self.integrators, strict=True)
        return tuple(
            TransferFunction(b, np.append(self.denominators[block], np.zeros(count)), self.delays[driver])
            for b, (driver, block), count in each
        )

    @property
    def model(self) -> TransferFunction:
        """First fraction, which is the model of a single input."""
        return self.fractions[0]


def _point(start: Begin, box: Box) -> Point:
    """Return the admissible point of a start."""
    given, delays = start
    poles = given if box.parts else np.roots(np.asarray(given, dtype=float))
    return point_of(np.asarray(poles, dtype=complex), delays, box)


@reported("")
def best_output_error(
    problem: Problem,
    poles: int,
    delays: Bounds = (0.0, 0.0),
    starts: Sequence[Begin] = (),
    *,
    known: KnownCoefficients = NOTHING,
) -> Optimum:
    """Return the least sum of squared output errors of a structure and of all nested ones.

    Equal bounds of the delay [s] fix it, which a model with equal degrees requires. Searches start from the minima of
    nested smaller models, from random points, and from given denominators and delays. Without known coefficients the
    result may have fewer poles, so that the cost never increases with the structure.
    """
    zeros, box = problem.zeros, _box(problem, delays, known)
    points = [_point(start, box) for start in starts]
    part = part_of(problem, max(high for _, high in box.each_delay))
    if known is not NOTHING:
        if part is not None:
            there = best_output_error(part, poles, delays, starts, known=known)
            return best_local(problem, poles, delays, [there.start], known=known)
        search = _with_known(StructureSearch(problem, box), poles, points, known)
        return _with_others(_least(search, poles, zeros, False), search, poles, zeros)
    if part is not None:
        pilot = StructureSearch(part, box_of(part, delays))
        found = _from_part(StructureSearch(problem, box, pilot=pilot), pilot, poles)
        if found is not None:
            return found
    search = StructureSearch(problem, box)
    search.climb(poles, zeros)
    search.refine(poles, zeros, points + search.resonances(poles, zeros), slow_too=True)
    search.refine(poles, zeros, search.close_delays(poles, zeros))
    return _with_others(_least(search, poles, zeros, True), search, poles, zeros)


@reported("")
def best_local(
    problem: Problem,
    poles: int,
    delays: Bounds,
    starts: Sequence[Begin],
    *,
    known: KnownCoefficients = NOTHING,
    box: Box | None = None,
) -> Optimum:
    """Return the least sum of squared output errors in the basins of denominators and delays."""
    box = box or _box(problem, delays, known)
    search = StructureSearch(problem, box, known=known)
    search.refine(poles, problem.zeros, _met([_point(start, box) for start in starts], box, known))
    return _least(search, poles, problem.zeros, False)


def _box(problem: Problem, delays: Bounds, known: KnownCoefficients) -> Box:
    """Return the admissible set, which contains known poles."""
    box = box_of(problem, delays)
    return widened(box, known.poles) if known.all_poles else box


def _with_known(free: StructureSearch, poles: int, points: list[Point], known: KnownCoefficients) -> StructureSearch:
    """Return the search of models with known coefficients.

    It starts from given points, all minima found without the constraints, and random points, projected onto the
    constraints.
    """
    zeros, box = free.problem.zeros, free.box
    search = StructureSearch(free.problem, box, known=known)
    if known.all_poles:
        points = [point_of(known.poles, box.middle, box)]
    else:
        free.climb(poles, zeros)
        points += [local.point for local in free.minima(poles, zeros)] + free.from_below(poles, zeros)
        points += free.resonances(poles, zeros) + free.random_points(poles)
    points = search.descent(zeros).sorted(_met(points, box, known))
    search.refine(poles, zeros, search.along_delay(zeros, points), slow_too=True)
    search.refine(poles, zeros, search.close_delays(poles, zeros))
    return search


def _met(points: Sequence[Point], box: Box, known: KnownCoefficients) -> list[Point]:
    """Return the points projected to the values of the known coefficients."""
    found = [point for point in (known.met(start, box) for start in points) if point is not None]
    if points and not found:
        values = known.denominator[known.places].tolist()
        given, which = "coefficients", "a"
        if not known.parts:
            each = zip(known.places.tolist(), values, strict=True)
            given, which = ", ".join(f"a{place + 1} = {value:g}" for place, value in each), "the"
        what = f"no model with the fixed {given} has all its poles where they are searched"
        raise DataError(f"{what}: {box.sentence('s')}; change or drop {which} fixed value")
    return found


def _from_part(search: StructureSearch, pilot: StructureSearch, poles: int) -> Optimum | None:
    """Return the optimum found from a part of the records; None if it does not fit the whole records."""
    problem, ends = search.problem, list[Optimum]()
    for one in (pilot, search):
        one.climb(poles, problem.zeros)
        ends.append(_least(one, poles, problem.zeros, True))
    expected, whole = ends
    count, part_count = (sum(data.count for data in one.problem.records) for one in (search, pilot))
    power = sum(data.count * float(np.var(data.y_used)) for data in problem.records)
    if whole.squared_error > min(AS_GOOD * expected.squared_error * count / part_count, (1 - EXPLAINED) * power):
        return None
    found = replace(whole, tried=expected.tried, agree=expected.agree)
    return _with_others(found, search, poles, problem.zeros)


@reported("")
def best_of_orders(search: StructureSearch, poles: int, zeros: int) -> Optimum:
    """Return the least squared error of one structure of a common search, and of those in its closure."""
    search.climb(poles, zeros)
    return _least(search, poles, zeros, True)


@reported("")
def best_sum(
    problem: Problem,
    delays: Bounds,
    starts: Sequence[Begin],
    *,
    grown: bool = True,
    known: KnownCoefficients = NOTHING,
) -> Optimum:
    """Return the least sum of squared output errors of fractions with separate denominators.

    Searches start from the concatenated poles of the denominators, and delays. ``grown``: these poles are tried over
    the whole range of the delays, and so are the poles of submodels found term by term, and of inputs fitted to the
    residual of the others.
    """
    box, order, zeros = _box(problem, delays, known), sum(problem.parts), problem.zeros
    search = StructureSearch(problem, box, known=known)
    points = [_point(start, box) for start in starts]
    if grown:
        points = [each for point in points for each in search.along_delay(zeros, [point])]
        if box.several_delays:
            points += block_starts(problem, box, THOROUGH)
        elif not known.all_poles:
            part = part_of(problem, box.each_delay[0][1]) or problem
            points += SumGrowth(part, box_of(part, delays)).points()
    if known.all_poles:
        places = [point.seconds for point in points] or [box.middle]
        points = [point_of(known.poles, seconds, box) for seconds in places]
        points = search.along_delay(zeros, points) if grown else points
    search.refine(order, zeros, _met(points, box, known))
    if grown:
        if box.several_delays:
            around = search.along_delay(zeros, [search.best(order, zeros)])[1:]
            search.refine(order, zeros, [*around, *_met(search.random_points(order), box, known)])
        search.refine(order, zeros, search.close_delays(order, zeros))
    if known is NOTHING and not problem.monic:
        search.put_first(order, zeros, in_order(search.best(order, zeros), problem.terms, box))
    return _with_others(_least(search, order, zeros, False), search, order, zeros)


@reported("")
def best_near(search: StructureSearch, zeros: int, point: Point) -> Optimum:
    """Return the least squared error in the basin of given poles, without integrators, and delays."""
    search.refine(point.poles.size, zeros, [point])
    return _least(search, point.poles.size, zeros, False)


def _least(search: StructureSearch, poles: int, zeros: int, fewer_poles: bool) -> Optimum:
    """Return the least squared error of a structure found by a search."""
    # With a pole at infinity, any model with one pole less is in the closure of the structure.
    fewest = max(zeros - search.most_zeros, int(not search.problem.integrators)) if fewer_poles else poles
    found = [search.settled(n, zeros) for n in range(poles, min(fewest, poles) - 1, -1)]
    errors = [local.squared_error for local in found]
    # A smaller model is replaced only if its error is larger by more than rounding.
    lost = next(k for k, error in enumerate(errors) if error <= min(errors) * (1 + 1e-9))
    ends = np.array(search.ends(poles - lost, zeros))
    level = max(min(errors), float(ends.min()))
    agree = int(np.count_nonzero(ends <= level * (1 + SAME) + search.descent(zeros).floor))
    return _optimum(found[lost], zeros, lost, ends.size, agree, search)


def _optimum(best: Local, zeros: int, lost: int, tried: int, agree: int, search: StructureSearch) -> Optimum:
    """Return the model with coefficients of polynomials."""
    assert best.ending is not None
    point, projected, problem = best.point, best.projected, search.descent(zeros).problem
    known, n = search.known, point.poles.size
    held = best.held[:n]
    slopes = point.coefficient_slopes()[:, ~held]
    if known is not NOTHING:
        slopes = slopes @ null_space(known.slopes(point, n)[:, ~held])
    fractions = _fractions_of(problem, point, projected)
    additive = None if problem.monic else _sum_of(problem, known, point, fractions)
    denominators = point.denominators
    if known is not NOTHING and additive is None:
        _put_known(known, fractions, denominators)
    several = len(denominators) > 1
    return Optimum(
        numerators=tuple(_trimmed(b) for b in fractions),
        denominators=tuple(denominators),
        delays=point.seconds,
        free_responses=projected.free @ all_numerators(problem.rows(point.speed, point.damping)),
        trends=projected.trend,
        squared_error=best.squared_error,
        ending=best.ending,
        promise=best.promise,
        poles_at_infinity=lost,
        pole_slopes=slopes,
        held_poles=point.poles[point.whole_sections(held)],
        delays_at_bound=best.delays_at_bound,
        pinned=best.pinned,
        tried=tried,
        agree=agree,
        evaluations=search.evaluations,
        box=search.box,
        drivers=tuple((one.input, k if several else 0) for k, one in enumerate(problem.arranged(n).channels)),
        integrators=tuple(one.terms[0].integrators for one in problem.arranged(n).channels),
        additive=additive,
    )


def _with_others(found: Optimum, search: StructureSearch, poles: int, zeros: int) -> Optimum:
    """Return an optimum with the other minima of its structure."""
    others = []
    for local in search.others(poles - found.poles_at_infinity, zeros):
        point = local.point
        start = (point.poles if search.box.parts else point.denominator), point.seconds
        others.append(OtherMinimum(point.poles, point.seconds, local.squared_error, start))
    return replace(found, others=tuple(others))


def _fractions_of(problem: Problem, point: Point, projected: Projected) -> list[Array]:
    """Return the numerators of all fractions over monic denominators, each of its highest possible degree."""
    rows, found = problem.rows(point.speed, point.damping), []
    for k, channel in enumerate(problem.arranged(point.poles.size).channels):
        first, directs = 0, channel.directs(projected.directs[k]).tolist()
        for own, term, direct in zip(rows[channel.blocks], channel.terms, directs, strict=True):
            output = projected.outputs[k][first : first + term.order]
            b = np.concatenate(([0.0], output @ numerators(*own))) + direct * polynomial(*own)
            found.append(b[term.order - term.zeros :])
            first += term.order
    return found


def _trimmed(b: Array) -> Array:
    """Return a polynomial without leading zeros."""
    return np.trim_zeros(b, "f") if b.any() else np.zeros(1)


def _put_known(known: KnownCoefficients, fractions: list[Array], denominators: list[Array]) -> None:
    """Set known coefficients to their exact values, from which they differ by rounding."""
    whole, first = np.concatenate([a[1:] for a in denominators]), 0
    whole[known.places] = known.denominator[known.places]
    for a in denominators:
        a[1:], whole = whole[: a.size - 1], whole[a.size - 1 :]
    for b in fractions:
        values, first = known.numerator[first : first + b.size], first + b.size
        b[np.isfinite(values)] = values[np.isfinite(values)]


def _sum_of(problem: Problem, known: KnownCoefficients, point: Point, fractions: Sequence[Array]) -> AdditiveModel:
    """Return the submodels of a sum; raise DataError if they are not identifiable."""
    each = zip(fractions, point.denominators, problem.terms, strict=True)
    model = AdditiveModel([Submodel(b, a, term.integrators) for b, a, term in each], point.delay.seconds)
    if known is NOTHING:
        return model
    # Equal up to rounding.
    theta, structure = model.theta, SumStructure(problem.terms)
    theta[structure.denominators[known.places]] = known.denominator[known.places]
    given = np.isfinite(known.numerator)
    theta[structure.numerators[given]] = known.numerator[given]
    return AdditiveModel.from_theta(theta, problem.terms, model.delay)


def poles_of_submodels(model: AdditiveModel) -> ComplexArray:
    """Return the concatenated poles of the submodels, without integrators."""
    return np.concatenate([np.roots(submodel.denominator) for submodel in model.submodels]).astype(complex)


# --- part of long records, which gives the starts for the whole records -------------------------------


def part_of(problem: Problem, latest: float) -> Problem | None:
    """Return the most active part of each record, with a free response; None if the records are not long.

    The input of a part is known for delays up to ``latest`` [s].
    """
    parts = most_active_parts(problem.sampled, latest)
    if parts is None or any(problem.periods):
        return None
    records = tuple(_cut(data, part, latest) for data, part in zip(problem.sampled, parts, strict=True))
    return problem._replace(records=records, free_response=True, periods=(0.0,) * len(records))


def most_active_parts(records: Sequence[FilterData], latest: float) -> list[slice] | None:
    """Return the samples of each record with the largest variation of input and output; None if none is long."""
    if sum(data.t.size for data in records) <= LONG or not all(data.common_clock for data in records):
        return None
    # Samples before the latest delay carry no information.
    sizes = [PART // len(records) + int(latest * data.t.size / (data.t[-1] - data.t[0])) for data in records]
    return [most_active(data.u, data.y, size) for data, size in zip(records, sizes, strict=True)]


def most_active(u: Array, y: Array, size: int) -> slice:
    """Return the ``size`` samples with the largest variation of input and output."""
    if y.size <= size:
        return slice(None)
    moves, spread = np.abs(np.diff(u, append=u[-1])), np.abs(y - y.mean())
    life = np.cumsum(moves / max(moves.mean(), 1e-300) + spread / max(spread.mean(), 1e-300))
    begins = np.arange(0, y.size - size + 1, size // 4)
    begin = int(begins[np.argmax(life[begins + size - 1] - life[begins])])
    return slice(begin, begin + size)


def _cut(data: FilterData, part: slice, latest: float) -> FilterData:
    """Return a part whose samples are unused while the input is unknown."""
    if part == slice(None):
        return data
    t, y, u = (values[part].copy() for values in (data.t, data.y, data.u))
    further = tuple(_cut(one, part, latest) for one in data.further)
    return data._replace(t=t, y=y, use=data.use[part] & (t >= t[0] + latest), tu=t, u=u, further=further)
