r"""Output error of a feedback loop: output minus the response of the simulated loop to the reference.

.. math:: y(t_k) = T(\theta) r(t_k) + (\text{response to the first state}) + c + e_k

T contains the plant and the known controller. As r is independent of the noise, the least-squares estimate is
consistent for any noise, and for unstable plants too; e is the noise filtered by the loop, and rarely white.
State and offset c of each record are eliminated by least squares for every theta (projection of the sensitivities, L.
Kaufman, *A variable projection method for solving separable nonlinear least squares problems*, BIT 15 (1975) 49-57).
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError
from ctid_cli.estimation.additive_problem import AdditiveProblem, estimate_submodels, predicted_from
from ctid_cli.estimation.iteration import Iterated, Steps, inadmissible, iterate
from ctid_cli.estimation.loop_columns import Columns, LoopPart, as_innovations, stacked
from ctid_cli.estimation.sampled_problem import reflect_unstable
from ctid_cli.estimation.sum_start import automatic_start
from ctid_cli.filtering.bank import Equations, standard_rows
from ctid_cli.filtering.filter_data import FilterData
from ctid_cli.filtering.loop_response import LoopResponse
from ctid_cli.filtering.submodels import OPEN_LOOP, LoopData
from ctid_cli.inference.fit import Status
from ctid_cli.inference.loop_noise import MOST_MISSING, SensitivityFunction
from ctid_cli.models.additive import Term
from ctid_cli.models.factoring import unfactored
from ctid_cli.signals.noise import ArmaNoise
from ctid_cli.signals.record import Record

#: Number of cut-offs of the filters of starts, from six over the length of the record to half the Nyquist frequency; a
#: search over the delay uses every third one at each delay.
CUTOFFS, OF_DELAY = 9, 3
#: Number of updates of the filter of a start with the estimated poles.
ROUNDS = 4
#: Largest number of poles for which starts by the reference suffice.
FEW_POLES = 2
#: Number of starts that are refined, and of delays of a search.
REFINED, MOST_DELAYS = 4, 60
#: Steps of the refinement, and at each delay of a search.
STEPS, FEW_STEPS = Steps(100, 1e-6, "guarded"), Steps(4, 1e-4, "guarded")
#: Largest number of sampling intervals by which a delay may move to its minimum.
MOST_CELLS = 30
#: Squared errors that differ by less than this fraction belong to one minimum.
SAME = 1e-6


@dataclass(frozen=True, eq=False)
class LoopProblem:
    """Parameters of a plant in a loop: ``theta = (a_1 … a_n, b_0 … b_m, tau)``."""

    parts: tuple[LoopPart, ...]
    offset: bool
    #: Whether the state at the first sample is estimated, not zero.
    free_state: bool
    #: Bounds of the delay [s]; equal for a known delay.
    delays: tuple[float, float]
    #: Index of the sampling interval of the delay; None for a fixed delay.
    cell: int | None = None
    #: Whether errors are innovations for white output noise, or for noise of a model: with an unknown controller.
    innovations: bool = False
    noise: ArmaNoise | None = None

    @property
    def data(self) -> FilterData:
        """First record; all have its sampling interval."""
        return self.parts[0].data

    @property
    def response(self) -> LoopResponse:
        """Response of the first record."""
        return self.parts[0].response

    @property
    def outputs(self) -> Array:
        """Outputs of all records that enter sums."""
        return np.concatenate([data.y_used for data, _ in self.parts])

    @property
    def size(self) -> int:
        """Number of parameters, including the delay."""
        return self.response.poles + self.response.zeros + 2

    @property
    def free(self) -> int:
        """Number of parameters to iterate on."""
        return self.size - (self.cell is None)

    @property
    def samples(self) -> int:
        """Number of samples in the sums."""
        return sum(data.count for data, _ in self.parts)

    def split(self, theta: Array) -> tuple[Array, Array, float]:
        """Return denominator, numerator and delay [s] of a parameter vector."""
        n = self.response.poles
        a = np.concatenate(([1.0], theta[:n], np.zeros(self.response.integrators)))
        return a, theta[n:-1], float(theta[-1])

    @property
    def bounds(self) -> tuple[float, float]:
        """Bounds of the delay in its sampling interval [s]."""
        if self.cell is None:
            return self.delays
        h = self.data.interval
        return max(self.delays[0], self.cell * h), min(self.delays[1], (self.cell + 1) * h)

    def cell_of(self, delay: float) -> int:
        """Return the index of the sampling interval of a delay, the last one for the greatest delay."""
        h = self.data.interval
        return min(int(delay / h), int(np.ceil(self.delays[1] / h)) - 1)

    def admissible(self, theta: Array) -> Array:
        """Return the parameters with the delay clipped to its bounds; poles are unrestricted."""
        moved = theta.copy()
        if self.cell is not None:
            moved[-1] = np.clip(theta[-1], *self.bounds)
        return moved

    def columns(self, theta: Array, count: int | None = None) -> Columns | None:
        """Return the signals of parameters with least-squares states and offsets; None if they are not finite."""
        found = [self._columns_of(part, theta, self.free if count is None else count) for part in self.parts]
        each = [columns for columns in found if columns is not None]
        if len(each) < len(found):
            return None
        return stacked(each)

    def _columns_of(self, part: LoopPart, theta: Array, count: int) -> Columns | None:
        (data, response), use = part, part.data.use
        linear, state = np.ones((data.count, int(self.offset))), None
        with np.errstate(all="ignore"):
            if self.innovations and not response.radius(theta) < 1.0:
                return None
            if self.free_state:
                left = (data.y - response.rows(theta, 0, self.cell).output)[use]
                linear = np.column_stack((response.free(theta, self.cell)[use], linear))
                if not (np.isfinite(linear).all() and np.isfinite(left).all()):
                    return None
                at_rest = self._whitened(Columns(np.zeros((data.count, 0)), linear, left), theta, response)
                state = at_rest.own[: linear.shape[1] - int(self.offset)]
            rows = response.rows(theta, count, self.cell, state)
        if not (np.isfinite(rows.output).all() and np.isfinite(rows.slopes).all()):
            return None
        left = (data.y - rows.output)[use]
        if state is not None:
            left += linear[:, : state.size] @ state
        return self._whitened(Columns(rows.slopes[use], linear, left), theta, response)

    def _whitened(self, columns: Columns, theta: Array, response: LoopResponse) -> Columns:
        return as_innovations(columns, theta, response, self.noise) if self.innovations else columns

    def rows(self, theta: Array, count: int | None = None) -> tuple[Array, Array] | None:
        """Return sensitivities and output error at the used samples with least-squares state and offset."""
        columns = self.columns(theta, count)
        if columns is None:
            return None
        Q, _ = columns.basis
        return columns.slopes - Q @ (Q.T @ columns.slopes), columns.left - Q @ (Q.T @ columns.left)

    def equations(self, theta: Array) -> Equations:
        """Return the second moments of the iteration, here Gauss-Newton."""
        found = self.rows(theta) if np.isfinite(theta).all() else None
        if found is None:
            return inadmissible(theta.size)
        psi, eps = found
        with np.errstate(all="ignore"):
            hessian, gradient = np.zeros((theta.size,) * 2), np.zeros(theta.size)
            hessian[: self.free, : self.free], gradient[: self.free] = psi.T @ psi, psi.T @ eps
            squared, output = float(eps @ eps), self.outputs - eps
        if not (np.isfinite(hessian).all() and np.isfinite(squared)):
            return inadmissible(theta.size)
        return Equations(hessian, gradient, hessian, squared, float(output @ output))

    def squared_error(self, theta: Array) -> float:
        """Return the least squared error over state and offset; infinite if the response is not finite."""
        with np.errstate(all="ignore"):
            found = self.rows(theta, 0) if np.isfinite(theta).all() else None
            return np.inf if found is None else float(np.nan_to_num(found[1] @ found[1], nan=np.inf))

    # --- starts --------------------------------------------------------------------------------------

    def starts(self, delay: float, every: int = 1, rounds: int = ROUNDS) -> Iterator[Array]:
        """Yield estimates from the measured input with the reference as instrument.

        For any filter ``1/E``: ``p^n/E y = -sum a_i p^(n-i)/E y + sum b_j p^(m-j)/E u``. The right side is projected
        onto the filtered reference (two-stage least squares), so that noise in the loop causes no bias. E is first a
        Butterworth polynomial, then the denominator with its unstable poles reflected.
        """
        from scipy.signal import butter  # slow to import

        t, n = self.data.t, self.response.poles + self.response.integrators
        cutoffs = np.geomspace(6.0 / (t[-1] - t[0]), 1.5 / float(np.median(np.diff(t))), CUTOFFS)
        filters = [np.asarray(butter(n, cutoff, analog=True)[1], dtype=float) for cutoff in cutoffs]
        behind = [self._filtered([response.data for _, response in self.parts], E, delay)[:, :n] for E in filters[::2]]
        instruments = np.column_stack((*behind, np.ones((self.samples, int(self.offset)))))
        instruments, _ = np.linalg.qr(instruments / np.maximum(np.linalg.norm(instruments, axis=0), 1e-300))
        for E in filters[::every]:
            for _ in range(1 + rounds):
                theta = self._two_stage(E, instruments, delay)
                if theta is None:
                    break
                yield theta
                poles = np.roots(self.split(theta)[0])
                slowest = 1.0 / (t[-1] - t[0])
                E = reflect_unstable(np.real(np.poly(np.where(np.abs(poles) < slowest, -slowest, poles))))

    def stable_start(self, record: Record, delay: float) -> Array | None:
        """Return the estimate of a stable plant with poles found pair by pair and the reference as instrument.

        A single filter for all frequencies does not reveal a lightly damped pair in the presence of a stronger one.
        """
        response, loop = self.response, OPEN_LOOP
        if self.data.interval and not response.continuous:
            loop = LoopData(predicted_from(response.data.u, self.data.u))
        problem = AdditiveProblem(self.data, (Term(response.poles, response.zeros, response.integrators),), delay, loop)
        with suppress(DataError):
            model = automatic_start(record, problem)
            found = unfactored(estimate_submodels(problem, model.theta, Steps(30, 1e-4, "relaxed")).model)
            b = np.concatenate((np.zeros(response.zeros + 1 - found.numerator.size), found.numerator))
            return np.concatenate((found.denominator[1 : response.poles + 1], b, [delay]))
        return None

    def _filtered(self, data: Sequence[FilterData], E: Array, delay: float) -> Array:
        """Return the rows of a filter at the used samples of all records."""
        return np.concatenate([standard_rows(each, E, np.zeros(1), delay) for each in data])

    def _two_stage(self, E: Array, instruments: Array, delay: float) -> Array | None:
        response, n = self.response, self.response.poles + self.response.integrators
        with np.errstate(all="ignore"):
            rows = self._filtered([data for data, _ in self.parts], E, delay)
        u, y = rows[:, :n], rows[:, 2 * n + 1 : 3 * n + 1]
        highest = rows[:, 3 * n + 1] - y[:, ::-1] @ E[1:]
        by_a = -y[:, ::-1][:, : response.poles]
        by_b = (
            u[:, response.zeros :: -1]
            if response.zeros < n
            else np.column_stack((rows[:, n] - u[:, ::-1] @ E[1:], u[:, ::-1]))
        )
        regressors = np.column_stack((by_a, by_b, np.ones((self.samples, int(self.offset)))))
        projected = instruments.T @ regressors
        if not np.isfinite(projected).all():
            return None
        lengths = np.linalg.norm(projected, axis=0)
        if not lengths.all():
            return None
        found = np.linalg.lstsq(projected / lengths, instruments.T @ highest)[0] / lengths
        theta = np.append(found[: self.size - 1], delay)
        return theta if np.isfinite(theta).all() else None

    # --- minimum of the output error -----------------------------------------------------------------

    def best(self, record: Record) -> "LoopEstimate | None":
        """Return the lowest of the minima reached from all starts."""
        starts = self._delays()
        if self.response.poles > FEW_POLES:
            delays = dict.fromkeys(float(theta[-1]) for theta in starts[:REFINED]) or [sum(self.delays) / 2]
            more = [self.stable_start(record, delay) for delay in delays]
            starts += [theta for theta in more if theta is not None]
        found = [self._local(start) for start in starts]
        return LoopEstimate.least([one for one in found if one is not None])

    def _lowest(self, thetas: Iterator[Array], most: int) -> list[Array]:
        """Return the parameters with the lowest distinct squared errors."""
        errors = sorted(((self.squared_error(theta), k, theta) for k, theta in enumerate(thetas)), key=lambda e: e[:2])
        kept: list[tuple[float, Array]] = []
        for error, _, theta in errors:
            if np.isfinite(error) and all(abs(error - other) > SAME * other for other, _ in kept):
                kept.append((error, theta))
        return [theta for _, theta in kept[:most]]

    def _delays(self) -> list[Array]:
        """Return the starts: for a free delay the lowest minima of its profile."""
        low, high = self.delays
        if low == high:
            return self._lowest(self.starts(low), REFINED)
        h = self.data.interval
        # Inside the sampling intervals, since the cost has kinks at their ends.
        count = min(max(2 * int(np.ceil((high - low) / h)), 3), MOST_DELAYS)
        profile = []
        for delay in low + (np.arange(count) + 0.5) / count * (high - low):
            at_delay: list[tuple[float, Array]] = []
            for theta in self._lowest(self.starts(float(delay), OF_DELAY, 1), 2):
                result = iterate(self, theta, FEW_STEPS)
                if result is not None:
                    at_delay.append((result.equations.squared_error, result.theta))
            profile.append(min(at_delay, key=lambda each: each[0], default=(np.inf, np.zeros(0))))
        errors = np.array([np.inf, *(error for error, _ in profile), np.inf])
        lowest = np.flatnonzero(
            (errors[1:-1] <= errors[:-2]) & (errors[1:-1] <= errors[2:]) & np.isfinite(errors[1:-1])
        )
        return [profile[k][1] for k in sorted(lowest, key=lambda k: errors[k + 1])[:REFINED]]

    def _local(self, theta: Array) -> "LoopEstimate | None":
        """Return the minimum reached from parameters, across sampling intervals of the delay."""
        low, high = self.delays
        if low == high:
            result = iterate(self, theta, STEPS)
            return None if result is None else LoopEstimate(self, result)
        cell, found = self.cell_of(theta[-1]), None
        for _ in range(MOST_CELLS):
            problem = replace(self, cell=cell)
            result = iterate(problem, theta, STEPS)
            if result is None:
                return found
            theta, (first, end) = result.theta, problem.bounds
            if first < theta[-1] < end:
                return LoopEstimate(problem, result)
            # At a sample the cost has a kink: minimise over the others there, and test both sides for a descent.
            side = 1 if theta[-1] == end else -1
            held = iterate(self, theta, STEPS)
            theta = theta if held is None else held.theta
            found = LoopEstimate(problem, result if held is None else held, at_bound=theta[-1] in self.delays)
            if problem.equations(theta).instrument_error[-1] * side < 0 and held is not None:
                continue
            if theta[-1] in self.delays:
                return found
            other = replace(self, cell=cell + side)
            if not other.equations(theta).instrument_error[-1] * side > 0:
                return found
            cell += side
        return found


class LoopEstimate(NamedTuple):
    """Minimum, and statistics of its search."""

    problem: LoopProblem
    result: Iterated
    #: Whether the delay is held at a bound.
    at_bound: bool = False
    tried: int = 1
    agree: int = 1
    iterations: int = 0

    @classmethod
    def least(cls, results: "list[LoopEstimate]") -> "LoopEstimate | None":
        """Return the lowest minimum, with the statistics of all."""
        if not results:
            return None
        least = min(results, key=lambda one: one.result.equations.squared_error)
        level = least.result.equations.squared_error * (1.0 + SAME)
        agree = sum(one.result.equations.squared_error <= level for one in results)
        evaluations = sum(one.result.iterations for one in results)
        return least._replace(tried=len(results), agree=agree, iterations=evaluations)

    @property
    def start(self) -> Array:
        """Parameters, as a start of another search."""
        return self.result.theta

    @property
    def radius(self) -> float:
        """Largest magnitude of the poles of the loop [-]."""
        return self.problem.response.radius(self.result.theta)

    @property
    def sensitivity(self) -> SensitivityFunction | None:
        """Filter from output noise to output error; None on an irregular clock, with many gaps, or if unstable."""
        found = self.problem.response.sensitivity(self.result.theta)
        missing = max(int((~data.use).sum()) for data, _ in self.problem.parts)
        return SensitivityFunction.of(*found) if found and missing <= MOST_MISSING and self.radius < 1.0 else None

    @property
    def status(self) -> Status:
        """Status of the search; a model with an unstable loop is not a minimum."""
        if not self.radius < 1.0:
            return Status.DIVERGED
        return Status.DELAY_AT_BOUND if self.at_bound and self.result.status is Status.CONVERGED else self.result.status
