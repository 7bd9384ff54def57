r"""Records in a loop with an unknown controller, for plants that may be unstable.

Any controller C that stabilises the plant makes a loop from signals of the record: with ``s = u + C y`` as the
reference behind the controller, ``u = s - C y`` and

.. math:: y = \frac{G}{1 + G C}\,s + \frac{1}{1 + G C}\,v,

v being the output noise. The output error of this loop is finite for an unstable plant G too. Without the reference of
the loop of the record, s contains noise, and the output error is filtered to innovations (direct method): they do not
depend on C. With it, the part of s that follows the reference gives the instruments, the sensitivities of its response,
and the estimate is consistent for any noise.
"""

from dataclasses import dataclass, replace

import numpy as np

from ctid_cli.arrays import Array, BoolArray
from ctid_cli.errors import DataError
from ctid_cli.estimation.additive_problem import predicted_from
from ctid_cli.estimation.iteration import Steps, iterate
from ctid_cli.estimation.loop_columns import LoopPart
from ctid_cli.estimation.loop_problem import REFINED, LoopEstimate, LoopProblem
from ctid_cli.filtering.filter_data import FilterData, filter_data, plain_array
from ctid_cli.filtering.loop import stabilising_controller
from ctid_cli.filtering.loop_response import LoopResponse
from ctid_cli.inference.fit import Status
from ctid_cli.models.controller import DiscreteController
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.noise import ArmaNoise
from ctid_cli.signals.record import Record

#: Largest number of controllers, and steps with each of them; a controller that needs few steps is the last one.
CONTROLLERS, FEW = 20, 2
STEPS, BY_INSTRUMENTS = Steps(10, 1e-6, "guarded"), Steps(10, 1e-6, "relaxed")


@dataclass(frozen=True, eq=False)
class UnknownController:
    """Records of a plant in a loop, with a controller of our own that depends on the model."""

    records: tuple[Record, ...]
    #: Poles, zeros, integrators.
    structure: tuple[int, int, int]
    delay: float
    offset: bool
    free_state: bool
    noise: ArmaNoise | None = None

    @property
    def by_reference(self) -> bool:
        """Whether the reference of the loop is known."""
        return all(record.loop is not None for record in self.records)

    def around(self, theta: Array) -> LoopProblem | None:
        """Return the problem with a stable controller that stabilises a model; None if none is found.

        Signals of the record filtered by an unstable controller would grow.
        """
        poles, _, integrators = self.structure
        a = np.concatenate(([1.0], theta[:poles], np.zeros(integrators)))
        interval = self.records[0].interval or 0.0
        try:
            controller = stabilising_controller(TransferFunction(theta[poles:-1], a, self.delay), interval)
        except (DataError, ValueError, np.linalg.LinAlgError):
            return None
        if not np.abs(controller.poles).max(initial=0.0) < 1.0:
            return None
        found = self._with(controller)
        return replace(found, instruments=self._with(controller, projected=True)) if self.by_reference else found

    def _with(self, controller: DiscreteController, *, projected: bool = False) -> LoopProblem:
        parts = []
        for record in self.records:
            data = filter_data(record)
            s = self._reference(data, controller)
            if projected and record.loop is not None:
                s = s.mean() + predicted_from(record.loop.reference, s)
            driven = data._replace(u=plain_array(s))
            response = LoopResponse(driven, controller, False, *self.structure, controller_at_rest=True)
            parts.append(LoopPart(data, response))
        delays, innovations = (self.delay, self.delay), not self.by_reference
        return LoopProblem(
            tuple(parts), self.offset, self.free_state, delays, innovations=innovations, noise=self.noise
        )

    def _reference(self, data: FilterData, controller: DiscreteController) -> Array:
        from scipy.signal import lfilter  # slow to import

        b, a = controller.numerator, controller.denominator
        return np.asarray(data.u + lfilter(np.concatenate((np.zeros(a.size - b.size), b)), a, data.y))

    # --- minima --------------------------------------------------------------------------------------

    def best(self, record: Record) -> LoopEstimate | None:
        """Return the lowest minimum from starts with the reference, or the input, as instrument."""
        # The output error of a controller of zero is that of the plant in open loop.
        nothing = DiscreteController([0.0], [1.0])
        parts = []
        for part, each in zip(self._with(nothing).parts, self.records, strict=True):
            driven = part.data if each.loop is None else part.data._replace(u=plain_array(each.loop.reference))
            parts.append(LoopPart(part.data, replace(part.response, data=driven)))
        starts = [
            (self._cost(theta), theta) for theta in replace(self._with(nothing), parts=tuple(parts)).starts(self.delay)
        ]
        lowest = sorted((cost, k) for k, (cost, _) in enumerate(starts) if np.isfinite(cost))[:REFINED]
        found = [one for one in (self.local(starts[k][1]) for _, k in lowest) if one is not None]
        ended = [one for one in found if one.status is Status.CONVERGED]
        return LoopEstimate.least(ended or found)

    def _cost(self, theta: Array) -> float:
        """Return the squares of the innovations, or of the error of the response to the reference."""
        problem = self.around(theta)
        return np.inf if problem is None else (problem.instruments or problem).squared_error(theta)

    def local(self, *starts: Array) -> LoopEstimate | None:
        """Return the minimum in the basin of a start."""
        theta, found = starts[0], None
        for _ in range(CONTROLLERS):
            problem = self.around(theta)
            result = (
                None if problem is None else iterate(problem, theta, BY_INSTRUMENTS if self.by_reference else STEPS)
            )
            if problem is None or result is None:
                break
            theta, cost = result.theta, self._cost(result.theta)
            comparable = replace(result, equations=result.equations._replace(squared_error=cost))
            found = LoopEstimate(problem, comparable)
            if result.status is Status.CONVERGED and result.iterations <= FEW:
                break
        return found

    # --- noise model ---------------------------------------------------------------------------------

    def used(self) -> tuple[BoolArray, ...]:
        """Return the mask of the used samples of each record."""
        return tuple(np.ones(record.n_samples, dtype=bool) for record in self.records)

    def whitened_by(self, noise: ArmaNoise) -> "UnknownController":
        """Return a copy with errors whitened by a noise model."""
        return replace(self, noise=noise)

    def errors(self, found: LoopEstimate) -> list[Array]:
        """Return the innovations for white noise, of each record."""
        theta = found.result.theta
        whitened, columns = found.problem.columns(theta, 0), replace(found.problem, noise=None).columns(theta, 0)
        assert whitened is not None
        assert columns is not None
        left = columns.left - columns.linear @ whitened.own
        return np.split(left, np.cumsum([record.n_samples for record in self.records])[:-1])
