r"""The least output error of measured records from the minima of a profile, and the least loss with outliers.

With x the simulated outputs, a loss is minimised by fitting ``x + psi(r)`` instead of ``y = x + r``: the squared errors
touch twice the loss from above, so that every fit lowers the loss, and where nothing moves any more
``sum s psi(r) = 0`` [1]_. All starts, bounds and kinds of minima of least squares serve the loss too.

References
----------
.. [1] P. J. Huber and E. M. Ronchetti, *Robust Statistics*, 2nd ed. (Wiley 2009), section 7.8.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ctid_cli.arrays import Array, BoolArray, ComplexArray
from ctid_cli.estimation.measured_records import Layout, MeasuredRecords, sensitivities
from ctid_cli.estimation.optimum.best_model import Optimum, best_output_error
from ctid_cli.estimation.optimum.box import box_of
from ctid_cli.estimation.optimum.known import NOTHING, KnownCoefficients
from ctid_cli.estimation.optimum.projection import Problem
from ctid_cli.estimation.optimum.search import ROUNDING, local_minimum
from ctid_cli.inference.robust_loss import Loss, RobustKind, Weighting, scale_of
from ctid_cli.inference.sensitivities import Structure
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.record import Record

#: Random starts, so many and so many for each pole.
RANDOM_STARTS = 2
#: Most fits in one descent, and most of them after which the scale is taken anew.
MOST_FITS, MOST_SCALES = 60, 20
#: The scale has settled where it changes by less than this fraction, the descent where the loss falls by less.
SETTLED, DONE = 1e-4, 1e-11
#: Most searches, and the fraction by which the next one must lower the loss.
MOST_SEARCHES, WORTHWHILE = 5, 1e-6


@dataclass(frozen=True, eq=False)
class AppliedModel:
    """A given model on records that it need not have been estimated from."""

    #: Output errors at the used samples of each experiment [output unit].
    residuals: tuple[Array, ...] = field(repr=False)
    used: tuple[BoolArray, ...] = field(repr=False)
    initial_states: tuple[Array, ...]
    #: Output offset of each experiment [output unit].
    offsets: tuple[float, ...]
    #: Derivatives of the output at the used samples to all parameters, the delay and what is each experiment's among
    #: them, shape (count, p).
    sensitivities: tuple[Array, ...] = field(repr=False)


class Refinement:
    """The output-error cost of measured records, minimised over all parameters."""

    def __init__(
        self, measured: MeasuredRecords, known: KnownCoefficients = NOTHING, problem: Problem | None = None
    ) -> None:
        self.measured, self.known = measured, known
        self.structure = measured.structure
        self.problem = problem or measured.problem

    @property
    def records(self) -> list[Record]:
        """The records, without the means that were subtracted."""
        return self.measured.records

    def with_outputs(self, outputs: Sequence[Array]) -> "Refinement":
        """The same with other outputs at the used samples of each record."""
        records = []
        for data, values in zip(self.problem.records, outputs, strict=True):
            y = data.y.copy()
            y[data.use] = values
            records.append(data._replace(y=y))
        return Refinement(self.measured, self.known, self.problem._replace(records=tuple(records)))

    def near(self, errors: Sequence[Array], weighting: Weighting | None) -> "Refinement":
        """The records whose least squares are, near the estimate, what its loss is."""
        if weighting is None:
            return self
        each = zip(self.measured.outputs, errors, weighting.pseudo_errors, strict=True)
        return self.with_outputs([y - r + pseudo for y, r, pseudo in each])

    def best(self, starts: Sequence[tuple[Array, float]], nested: bool) -> Optimum:
        """The least output error from denominators and delays, and if nested of smaller models and at random too.

        A profile under an unknown initial state, an offset or a period has too few basins: smaller models help then.
        """
        (poles, zeros), records = (self.structure.poles, self.structure.zeros), self.problem.records
        poles -= self.problem.integrators
        options = replace(
            self.measured.options,
            starts=starts,
            nested=nested or not self.measured.plain or self.known is not NOTHING,
            fewer_poles=nested,
            random_starts=RANDOM_STARTS if nested or self.measured.plain else 0,
            known=self.known,
        )
        return best_output_error(records, poles, zeros, options)

    def local(self, near: Optimum) -> Optimum:
        """The least output error in the basin of an optimum of other outputs."""
        starts = [(near.denominator, near.delay)]
        options = replace(self.measured.options, starts=starts, nested=False, random_starts=0, known=self.known)
        return best_output_error(self.problem.records, near.denominator.size - 1, self.structure.zeros, options)

    def parameters(self, found: Optimum) -> tuple[Layout, Array]:
        """Which numbers an optimum has, and what they are."""
        layout = self.layout_of(found.model.order, self.structure.delay)
        theta = layout.theta(found.model)
        for k in range(layout.experiments):
            state, first = found.free_responses[k] if layout.initial_state else (), layout.first(k)
            theta[first : first + layout.own] = [*state, found.offsets[k]][: layout.own]
        return layout, theta

    def simulated(self, found: Optimum) -> list[Array]:
        """Outputs of an optimum at the used samples of each record."""
        parts = sensitivities(self.problem, *self.parameters(found), found.model.delay)
        return [data.y_used - eps for data, (_, eps) in zip(self.problem.records, parts, strict=True)]

    def squared_error_at(self, model: TransferFunction, delay: float) -> float:
        """Least sum of squared output errors at a given delay, in the basin of a model."""
        return local_minimum(
            self.problem, self.free_poles(model), delay, (delay, delay), known=self.known
        ).squared_error

    def squared_error_with(
        self, model: TransferFunction, *, initial_state: bool = False, offset: bool = False
    ) -> float:
        """Return the least sum of squared output errors if an initial state or an offset were estimated too.

        Among the models that are admissible without them: in a smaller set the cost might be higher.
        """
        problem, bounds = self.problem, self.measured.treatment.delay_bounds
        more = problem._replace(free_response=problem.free_response or initial_state, offset=problem.offset or offset)
        box = box_of(problem, bounds)
        return local_minimum(more, self.free_poles(model), model.delay, bounds, box=box, known=self.known).squared_error

    def errors_of(self, model: TransferFunction) -> AppliedModel:
        """Errors of a given model on these records, each with its own best initial state and offset."""
        layout = self.layout_of(model.order, delay=True)
        theta, residuals = layout.theta(model), []
        found = sensitivities(self.problem, layout, theta, model.delay)
        for k, (psi, eps) in enumerate(found):
            own = slice(layout.first(k), layout.first(k) + layout.own)
            theta[own] = np.linalg.lstsq(psi[:, own], eps)[0]
            bridged = self.problem.records[k].y_used
            residuals.append(eps - psi[:, own] @ theta[own] + (self.measured.outputs[k] - bridged))
        slopes = tuple(psi for psi, _ in found)
        return AppliedModel(tuple(residuals), self.measured.used(), *self.own(layout, theta), slopes)

    def free_poles(self, model: TransferFunction) -> ComplexArray:
        """The poles of a model but its integrators."""
        return np.roots(model.denominator[: model.denominator.size - self.problem.integrators]).astype(complex)

    @property
    def given(self) -> BoolArray:
        """Which of the coefficients of the structure are known, those that integrators make zero among them."""
        zeros = self.structure.zeros + 1
        if self.known is NOTHING:
            free = self.structure.poles - self.problem.integrators
            of_a, of_b = np.zeros(free, dtype=bool), np.zeros(zeros, dtype=bool)
        else:
            of_a, of_b = np.isfinite(self.known.denominator), np.isfinite(self.known.numerator)
        return np.concatenate((of_a, np.ones(self.problem.integrators, dtype=bool), of_b))

    def layout_of(self, poles: int, delay: bool) -> Layout:
        """Layout of the parameters for a number of poles, integrators among them."""
        return replace(self.measured.layout, structure=Structure(poles, self.structure.zeros, delay))

    def own(self, layout: Layout, theta: Array) -> tuple[tuple[Array, ...], tuple[float, ...]]:
        """Initial states and offsets of the experiments, means that were subtracted included."""
        own = [layout.own_of(theta, k) for k in range(layout.experiments)]
        offsets = tuple(y0 + c for y0, (_, c) in zip(self.measured.offsets, own, strict=True))
        return tuple(state for state, _ in own), offsets


@dataclass(frozen=True, eq=False)
class RobustFit:
    """A local minimum of the loss."""

    found: Optimum
    losses: tuple[Loss, ...]
    #: Simulated outputs and output errors at the used samples of each record.
    simulated: list[Array]
    errors: list[Array]

    def cost(self, losses: Sequence[Loss]) -> float:
        """Twice the sum of losses of given scales."""
        return sum(loss.cost(r) for loss, r in zip(losses, self.errors, strict=True))

    def modified(self) -> list[Array]:
        """Outputs whose least squares are taken next."""
        each = zip(self.simulated, self.losses, self.errors, strict=True)
        return [x + loss.weight(r) * r for x, loss, r in each]


def robust_fit(
    refinement: Refinement, kind: RobustKind, starts: Sequence[tuple[Array, float]], nested: bool
) -> RobustFit:
    """Search for the least Huber loss, and from there for Tukey's.

    The first search sees the outputs with their outliers bridged, the next ones those that the last fit has modified.
    """
    best = _descend(refinement, refinement.best(starts, nested), "huber")
    for _ in range(MOST_SEARCHES):
        at = [(best.found.denominator, best.found.delay), *starts]
        trial = _descend(refinement, refinement.with_outputs(best.modified()).best(at, nested), "huber")
        smaller = [min(pair, key=lambda loss: loss.scale) for pair in zip(best.losses, trial.losses, strict=True)]
        if trial.cost(smaller) > best.cost(smaller) * (1.0 - WORTHWHILE):
            break
        best = trial
    if kind == "tukey":
        best = _descend(refinement, best.found, kind, tuple(replace(loss, kind=kind) for loss in best.losses))
    return best


def _descend(
    refinement: Refinement, found: Optimum, kind: RobustKind, losses: tuple[Loss, ...] | None = None
) -> RobustFit:
    """Local minimum of the loss, at given scales or at those of the errors, which are fixed when they have settled."""
    here = _at(refinement, found, kind, losses)
    settled = losses is not None
    for k in range(MOST_FITS):
        there = refinement.with_outputs(here.modified()).local(here.found)
        there = replace(there, tried=found.tried, agree=found.agree, poles_at_infinity=found.poles_at_infinity)
        following = _at(refinement, there, kind, here.losses if settled else None)
        if settled and following.cost(here.losses) >= here.cost(here.losses) * (1.0 - DONE):
            break
        changes = [new.scale / old.scale - 1.0 for new, old in zip(following.losses, here.losses, strict=True)]
        settled = settled or k >= MOST_SCALES or float(np.abs(changes).max()) < SETTLED
        here = following
    return following


def _at(refinement: Refinement, found: Optimum, kind: RobustKind, losses: tuple[Loss, ...] | None) -> RobustFit:
    simulated, outputs = refinement.simulated(found), refinement.measured.outputs
    errors = [y - x for y, x in zip(outputs, simulated, strict=True)]
    least = [ROUNDING * float(np.sqrt(np.mean(y**2))) for y in outputs]
    losses = losses or tuple(Loss(kind, scale_of(*pair)) for pair in zip(errors, least, strict=True))
    return RobustFit(found, losses, simulated, errors)
