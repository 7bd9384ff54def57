r"""A start for the estimation of a sum of submodels, from the record alone.

Several sets of poles are found in two ways: mode by mode in the spectra of the record
(:mod:`ctid_cli.estimation.pole_relocation`), and as those of one transfer function with some poles to spare. Each set
is shared out among the terms. For given poles the output is linear in the numerators, which least squares on the output
error supplies; the set whose output errors are least, each band of frequencies compared with its own noise level, wins.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, islice
from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array, IndexArray
from ctid_cli.errors import DataError
from ctid_cli.estimation import pole_relocation
from ctid_cli.estimation.iteration import GUARDED, Steps, iterate, solve_scaled
from ctid_cli.estimation.sampled_problem import at_known_delay, least_squares_starts
from ctid_cli.filtering.filter_data import FilterData, filter_data
from ctid_cli.filtering.submodels import SubmodelFilter, free_response, free_response_size
from ctid_cli.inference.sensitivities import Structure
from ctid_cli.models.additive import AdditiveModel, Submodel, Term
from ctid_cli.signals.record import Record, named

#: Noise levels within this factor of each other are not worth a second search with other weights.
NEARLY_WHITE = 2.0
#: Moves of the poles found, with the noise levels of what they leave.
WEIGHTED_MOVES = 6
#: Poles of the transfer function beyond those of the terms, for noise and modes that were not asked for.
SPARE_POLES = 2
#: The greatest order of a transfer function that is fitted.
HIGHEST_ORDER = 12
#: Cut-offs of the state-variable filter, how many of their estimates are refined, and steps of the refinement.
CUTOFFS = 6
REFINED = 3
REFINEMENT = Steps(max_iterations=10, tolerance=1e-4, rule=GUARDED, halvings=4)
#: Ways of sharing poles out among terms of different structure that are tried.
MOST_ARRANGEMENTS = 24
#: Frequencies of a periodogram that share one noise level.
BAND = 16
#: A free response must lower the criterion by this many times what its parameters cost in Schwarz's criterion.
DECISIVE = 2.0
#: A complex pair that must give two real poles gives them this factor below and above its magnitude.
SPLIT = 1.25


class ModalStart(NamedTuple):
    """Where the estimation of a sum of submodels may start."""

    model: AdditiveModel
    method: str


def automatic_start(record: Record, terms: Sequence[Term], delay: float = 0.0) -> ModalStart:
    r"""Find a start for a sum of submodels.

    Sets of poles are compared by

    .. math:: J = 2 \sum_b n_b \log \frac{1}{n_b} \sum_{k \in b} |E_k|^2,

    where E is the discrete Fourier transform of the output error and b runs over bands of :math:`n_b` neighbouring
    frequencies: twice the negative logarithm of the likelihood for noise of an unknown level in each band. The plain
    output error would prefer a mode that follows a few lines of strong coloured noise to a weak one where noise is low.

    Where the record clearly does not start at rest the numerators are fitted together with a free response. In closed
    loop the measured input is taken as it is: that biases the numbers a little, which a start may be.

    It fails for modes slower than the record or hidden in the noise, and for two modes that no frequency separates.
    """
    data = filter_data(record, delay)
    fitter = _NumeratorFit(data, terms, delay)
    best: tuple[AdditiveModel, _Fitted] | None = None
    method = ""
    sets = list(_pole_sets(record, fitter))
    for way, poles in sets:
        for groups in islice(_arrangements(poles, terms), MOST_ARRANGEMENTS):
            fitted = fitter.fit(groups)
            if fitted is not None and (best is None or fitted[1].criterion < best[1].criterion):
                best, method = fitted, way
    if best is None:
        raise DataError(
            f"{named(record)}no start was found: {data.count} samples show no modes of the structure asked for; give "
            "the start, or take a longer record or fewer poles"
        )
    text = f"{method}; numerators by least squares on the output error; the best of {len(sets)} sets of poles."
    if best[1].free:
        text += " The record does not start at rest: a free response was fitted along with the numerators."
    return ModalStart(best[0], text)


def _pole_sets(record: Record, fitter: _NumeratorFit) -> Iterator[tuple[str, list[complex]]]:
    """Candidates for all poles but the integrators, one of each conjugate pair, and how they were found."""
    terms, delay = fitter.terms, fitter.delay
    pairs, reals = sum(term.poles // 2 for term in terms), sum(term.poles % 2 for term in terms)
    integrators = sum(term.integrators for term in terms)
    n = 2 * pairs + reals
    if n == 0:
        yield "No poles to be found", []
        return
    lines = pole_relocation.spectral_lines(record, delay, integrators, any(term.zeros == term.order for term in terms))
    # Real and imaginary part of each line for numerators, transients and poles.
    if lines is not None and 2 * lines.frequencies.size > 3 * n + 2 * integrators + 1:
        yield "Poles from the spectra of the record, mode by mode", _spectral_poles(lines, pairs, reals)
        weights = pole_relocation.local_weights(lines)
        if weights.max() > NEARLY_WHITE * weights.min():
            poles = _spectral_poles(lines.weighted(weights), pairs, reals)
            yield "Poles from the spectra of the record, mode by mode, weighted by local noise levels", poles
    order = min(n + integrators + SPARE_POLES, HIGHEST_ORDER)
    if order >= n + integrators:
        found = _transfer_function_poles(fitter.data, order, delay)
        if found is not None:
            yield f"Poles from a transfer function of order {order}", fitter.reduced(found, n)


def _spectral_poles(lines: pole_relocation.Lines, pairs: int, reals: int) -> list[complex]:
    """Poles found with the weights of the lines, then moved with those that their residual asks for."""
    poles = pole_relocation.find_poles(lines, pairs, reals)
    weighted = lines.weighted(pole_relocation.residual_weights(lines, poles))
    return pole_relocation.relocate(weighted, poles, WEIGHTED_MOVES)


# --- poles of one transfer function ----------------------------------------------------------------


def _transfer_function_poles(data: FilterData, order: int, delay: float) -> list[complex] | None:
    """Poles of the best of a few refined fits; None if there are too few samples or all equations are singular."""
    structure = Structure(order, order - 1)
    if data.count <= structure.size:
        return None
    problem = at_known_delay(data, structure)
    duration = float(data.t[-1] - data.t[0])
    fastest = 0.5 * np.pi / float(np.median(np.diff(data.t)))
    cutoffs = np.geomspace(min(4.0 * np.pi / duration, fastest), fastest, CUTOFFS).tolist()
    starts = least_squares_starts(data, structure, delay, cutoffs, refit=True)
    starts.sort(key=lambda theta: problem.equations(theta).squared_error)
    refined = [end for theta in starts[:REFINED] if (end := iterate(problem, theta, REFINEMENT)) is not None]
    if not refined:
        return None
    best = min(refined, key=lambda end: end.equations.squared_error)
    roots = np.roots(problem.split(best.theta)[0])
    return [complex(root) for root in roots if root.imag >= 0 and root.real < 0]


# --- poles to terms --------------------------------------------------------------------------------


def _size(poles: Sequence[complex]) -> int:
    """Number of poles, conjugates counted."""
    return sum(2 if pole.imag else 1 for pole in poles)


def _arrangements(poles: Sequence[complex], terms: Sequence[Term]) -> Iterator[list[list[complex]]]:
    """Ways of giving each term its poles, conjugates not listed.

    Complex pairs beyond the room of the terms become real poles, and real poles that are left over fill pairs as
    neighbours. Groups go to the terms by rising frequency, in every order of the different structures.
    """
    single, room = sum(term.poles % 2 for term in terms), sum(term.poles // 2 for term in terms)
    pairs, reals = _with_room(poles, room)
    if len(reals) < single or len(reals) != single + 2 * (room - len(pairs)):
        return
    tried: list[list[list[complex]]] = []
    for alone in combinations(range(len(reals)), single):
        rest = [pole for k, pole in enumerate(reals) if k not in alone]
        doubles = [[pole] for pole in pairs] + [rest[k : k + 2] for k in range(0, len(rest), 2)]
        doubles.sort(key=lambda group: abs(group[0]))
        for order in _distinct_orders(terms, range(len(terms))):
            groups = _dealt(terms, order, doubles, [reals[k] for k in alone])
            # Exchanging a term of one pole with one of two changes nothing.
            if groups not in tried:
                tried.append(groups)
                yield groups


def _dealt(
    terms: Sequence[Term], order: Sequence[int], doubles: list[list[complex]], singles: list[complex]
) -> list[list[complex]]:
    """Pairs and single poles given to the terms in an order."""
    two, one = iter(doubles), iter(singles)
    groups: list[list[complex]] = [[] for _ in terms]
    for k in order:
        groups[k] = [pole for pair in islice(two, terms[k].poles // 2) for pole in pair]
        groups[k] += islice(one, terms[k].poles % 2)
    return groups


def _with_room(poles: Sequence[complex], room: int) -> tuple[list[complex], list[complex]]:
    """Complex poles, no more than there is room for, and real ones; both by rising magnitude."""
    pairs = sorted((pole for pole in poles if pole.imag), key=abs)
    reals = [pole for pole in poles if not pole.imag]
    while len(pairs) > room:
        # The best damped pair is nearest to two real poles.
        pole = pairs.pop(int(np.argmax([-pole.real / abs(pole) for pole in pairs])))
        reals += [complex(-abs(pole) / SPLIT), complex(-abs(pole) * SPLIT)]
    return pairs, sorted(reals, key=abs)


def _distinct_orders(terms: Sequence[Term], left: Sequence[int]) -> Iterator[list[int]]:
    """Orders of those of the terms that are left which differ in structure; equal terms keep theirs."""
    if not left:
        yield []
    for k in sorted({terms[j]: j for j in reversed(left)}.values()):
        for rest in _distinct_orders(terms, [j for j in left if j != k]):
            yield [k, *rest]


# --- numerators ------------------------------------------------------------------------------------


class _Fitted(NamedTuple):
    """Fitted numerators, what they are judged by, and whether a free response was fitted too."""

    gains: Array
    criterion: float
    squared_error: float
    free: bool


class _NumeratorFit:
    """Numerators for given poles, by linear least squares on the output error."""

    def __init__(self, data: FilterData, terms: Sequence[Term], delay: float) -> None:
        self.data, self.terms, self.delay = data, tuple(terms), delay

    def fit(self, groups: Sequence[Sequence[complex]]) -> tuple[AdditiveModel, _Fitted] | None:
        """Fit with given poles of each term; None where they give no valid model or no finite response."""
        responses = _responses(self.data, groups, self.terms, self.delay)
        found = None if responses is None else responses.fit(self.data.y_used)
        if responses is None or found is None:
            return None
        theta = responses.theta
        theta[_numerator_places(self.terms)] = found.gains
        return AdditiveModel.from_theta(theta, self.terms, self.delay), found

    def _without_poles(self) -> list[Term]:
        """What stands beside the modes: the integrators, and a direct feedthrough."""
        integrators = sum(term.integrators for term in self.terms)
        found = [Term(0, integrators - 1, integrators)] if integrators else []
        return [*found, Term(0, 0)] if any(term.zeros == term.order for term in self.terms) else found

    def reduced(self, poles: Sequence[complex], count: int) -> list[complex]:
        """The poles without which the output error would rise most, in all ``count``, conjugates counted."""
        kept, others = list(poles), self._without_poles()
        terms = [Term(2, 1) if pole.imag else Term(1, 0) for pole in kept] + others
        groups = [[pole] for pole in kept] + [[] for _ in others]
        responses = _responses(self.data, groups, terms, self.delay)
        places = list(range(len(kept)))

        def squared_error(left_out: int) -> float:
            used = [*range(len(kept), len(terms)), *(k for k in places if k != left_out)]
            found = None if responses is None else responses.of(used).fit(self.data.y_used)
            return np.inf if found is None else found.squared_error

        while (size := _size([kept[k] for k in places])) > count:
            possible = [k for k in places if size - _size([kept[k]]) >= count]
            if possible:
                places.remove(min(possible, key=squared_error))
            else:
                # One pole too many and only pairs: the best damped one makes room for a real pole.
                k = max(places, key=lambda k: -kept[k].real / abs(kept[k]))
                kept[k] = complex(-abs(kept[k]))
        return [kept[k] for k in places]


@dataclass(frozen=True, eq=False)
class _Responses:
    """What each numerator coefficient and each initial condition contributes to the output, and whose they are."""

    #: Of the model whose responses they are.
    theta: Array
    forced: Array
    free: Array
    forced_owner: IndexArray
    free_owner: IndexArray

    def of(self, owners: Sequence[int]) -> _Responses:
        """Those of some submodels."""
        forced, free = np.isin(self.forced_owner, owners), np.isin(self.free_owner, owners)
        own = self.forced[:, forced], self.free[:, free], self.forced_owner[forced], self.free_owner[free]
        return _Responses(self.theta, *own)

    def fit(self, y: Array) -> _Fitted | None:
        """Numerators, with free responses where they are worth their parameters; None if all is singular."""
        best: _Fitted | None = None
        for free, columns in ((False, self.forced), (True, np.hstack((self.forced, self.free)))):
            gram = columns.T @ columns
            scales = np.diag(gram).copy()
            solved, solution = solve_scaled(gram, columns.T @ y, scales, scales, scales.size)
            if not solved or y.size <= scales.size:
                continue
            error = y - columns @ solution
            criterion = _criterion(error) + DECISIVE * free * self.free.shape[1] * np.log(y.size)
            if best is None or criterion < best.criterion:
                best = _Fitted(solution[: self.forced.shape[1]], criterion, float(error @ error), free)
        return best


def _responses(
    data: FilterData, groups: Sequence[Sequence[complex]], terms: Sequence[Term], delay: float
) -> _Responses | None:
    """Responses of submodels with given poles; None where they give no valid model or one is not finite."""
    try:
        theta = _with_poles(groups, terms, delay).theta
    except DataError:
        return None
    rows = SubmodelFilter(data, terms, delay).rows(theta)
    if rows is None or not np.isfinite(rows[0]).all():
        return None
    # Before the delayed input begins, which is where used samples do, nothing is known of the state.
    elapsed = np.maximum(data.t - data.t[data.use][0], 0.0)
    response = free_response(theta, np.zeros(free_response_size(terms)), terms, elapsed)
    if response is None:
        return None
    return _Responses(
        theta,
        rows[0][:, _numerator_places(terms)],
        response[2][data.use],
        np.repeat(np.arange(len(terms)), [term.zeros + 1 for term in terms]),
        np.repeat(np.arange(len(terms)), [term.order for term in terms]),
    )


def _with_poles(groups: Sequence[Sequence[complex]], terms: Sequence[Term], delay: float) -> AdditiveModel:
    """Model with given poles and numerators 1; DataError if two terms share a pole."""
    submodels = []
    for poles, term in zip(groups, terms, strict=True):
        conjugates = [pole.conjugate() for pole in poles if pole.imag]
        denominator = np.real(np.poly([*poles, *conjugates])) if poles else np.ones(1)
        numerator = np.zeros(term.zeros + 1)
        numerator[-1] = denominator[-1]
        submodels.append(Submodel(numerator, denominator, term.integrators))
    return AdditiveModel(submodels, delay)


def _numerator_places(terms: Sequence[Term]) -> IndexArray:
    """Places of the numerators' coefficients in theta."""
    flags = [k >= term.poles for term in terms for k in range(term.size)]
    return np.flatnonzero(flags)


def _criterion(error: Array) -> float:
    """The criterion J of :func:`automatic_start`."""
    power = np.abs(np.fft.rfft(error)) ** 2
    edges = BAND * np.arange(max(power.size // BAND, 1))
    counts = np.diff(np.append(edges, power.size))
    means = np.add.reduceat(power, edges) / counts
    floor = np.finfo(float).tiny
    return float(2.0 * counts @ np.log(np.maximum(means, floor)))
