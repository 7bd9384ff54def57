r"""Records in a loop with an unknown controller, for plants that may be unstable.

Any controller C that stabilises the plant makes a loop from signals of the record: with ``s = u + C y`` as the
reference behind the controller, ``u = s - C y`` and

.. math:: y = \frac{G}{1 + G C}\,s + \frac{1}{1 + G C}\,v,

v being the output noise. The output error of this loop is finite for an unstable plant G too. It is filtered to
innovations, which do not depend on C (direct method).
"""

from dataclasses import dataclass, replace

import numpy as np

from ctid_cli.arrays import Array, BoolArray
from ctid_cli.errors import DataError
from ctid_cli.estimation.iteration import Steps, iterate
from ctid_cli.estimation.loop_columns import LoopPart
from ctid_cli.estimation.loop_problem import REFINED, LoopEstimate, LoopProblem
from ctid_cli.filtering.filter_data import filter_data, plain_array
from ctid_cli.filtering.loop import stabilising_controller
from ctid_cli.filtering.loop_response import LoopResponse
from ctid_cli.inference.fit import Status
from ctid_cli.models.controller import DiscreteController
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.noise import ArmaNoise
from ctid_cli.signals.record import Record

#: Largest number of controllers, and steps with each of them; a controller that needs few steps is the last one.
CONTROLLERS, STEPS, FEW = 20, Steps(10, 1e-6, "guarded"), 2


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
        return self._with(controller)

    def _with(self, controller: DiscreteController) -> LoopProblem:
        from scipy.signal import lfilter  # slow to import

        b, a = controller.numerator, controller.denominator
        b, parts = np.concatenate((np.zeros(a.size - b.size), b)), []
        for record in self.records:
            data = filter_data(record)
            driven = data._replace(u=plain_array(data.u + lfilter(b, a, data.y)))
            response = LoopResponse(driven, controller, False, *self.structure, controller_at_rest=True)
            parts.append(LoopPart(data, response))
        delays = self.delay, self.delay
        return LoopProblem(tuple(parts), self.offset, self.free_state, delays, innovations=True, noise=self.noise)

    # --- minima --------------------------------------------------------------------------------------

    def best(self, record: Record) -> LoopEstimate | None:
        """Return the lowest minimum from starts with the input as instrument."""
        # The output error of a controller of zero is that of the plant in open loop.
        starts = list(self._with(DiscreteController([0.0], [1.0])).starts(self.delay))
        costs = sorted((self._cost(theta), k) for k, theta in enumerate(starts))
        found = (self.local(starts[k]) for cost, k in costs[:REFINED] if np.isfinite(cost))
        return LoopEstimate.least([one for one in found if one is not None])

    def _cost(self, theta: Array) -> float:
        problem = self.around(theta)
        return np.inf if problem is None else problem.squared_error(theta)

    def local(self, *starts: Array) -> LoopEstimate | None:
        """Return the minimum in the basin of a start."""
        theta, found = starts[0], None
        for _ in range(CONTROLLERS):
            problem = self.around(theta)
            result = None if problem is None else iterate(problem, theta, STEPS)
            if problem is None or result is None:
                break
            theta, found = result.theta, LoopEstimate(problem, result)
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
