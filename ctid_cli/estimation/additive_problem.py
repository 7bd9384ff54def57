"""Estimation problem of a sum of submodels, in open or closed loop, and its iteration."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np

from ctid_cli.arrays import Array, IndexArray
from ctid_cli.errors import DataError
from ctid_cli.estimation.common import assessed, history_entry
from ctid_cli.estimation.iteration import GUARDED, Iterated, Steps, inadmissible, iterate
from ctid_cli.estimation.sampled_problem import is_hurwitz, reflect_unstable
from ctid_cli.filtering.bank import Equations
from ctid_cli.filtering.filter_data import FilterData, plain_array
from ctid_cli.filtering.loop import loop_radius
from ctid_cli.filtering.submodels import OPEN_LOOP, InitialState, LoopData, SubmodelFilter
from ctid_cli.inference.fit import IterationRecord, Status
from ctid_cli.inference.uncertainty import Covariance
from ctid_cli.models.additive import AdditiveModel, Term
from ctid_cli.models.controller import DiscreteController
from ctid_cli.models.factoring import unfactored
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.record import Record, named

#: Largest growth over a record at which an unstable loop is simulated.
LARGEST_GROWTH = 1e20
#: Impulse response of the input to the reference: most lags, fewest samples per lag, and regularisation.
MOST_LAGS, SAMPLES_PER_LAG, RIDGE = 300, 10, 1e-9

#: Source of the instruments: the measured input, the noise-free loop of the model, or the part of the input that is
#: predicted from the reference through an unknown loop.
Instruments = Literal["open_loop", "closed_loop", "reference"]


def check_closed_loop(instruments: Instruments, variant: str) -> None:
    """Raise ValueError for guarded steps on a cost that the solution does not minimise."""
    if instruments != "open_loop" and variant == "guarded":
        reason = "in closed loop the solution is not the least output error"
        raise ValueError(f"variant guarded is for open-loop instruments: {reason}; use relaxed or plain")


def loop_data(record: Record, instruments: Instruments) -> LoopData:
    """Return the feedback with which instruments are simulated."""
    if instruments == "open_loop":
        return OPEN_LOOP
    by_reference = instruments == "reference"
    if record.loop is None or (record.loop.controller is None and not by_reference):
        missing = "neither" if record.loop is None else "no controller"
        wanted = f"the reference{' and the controller' * (not by_reference)}, and this record has {missing}"
        what = "instruments of the reference" if by_reference else "closed-loop instruments"
        raise DataError(f"{named(record)}{what} need {wanted}; give them, or use instruments 'open_loop'")
    if record.loop.continuous and not by_reference:
        why = "with a controller in continuous time closed-loop instruments are inconsistent on any sampling"
        raise DataError(f"{named(record)}{why}; fit one transfer function (loop_output_error)")
    if not record.input_on_grid or record.input.hold != "zoh":
        wanted = "an input that is held from sample to sample of a regular clock"
        raise DataError(f"{named(record)}instruments in a loop need {wanted}")
    if by_reference:
        return LoopData(predicted_from(record.loop.reference, record.input.values))
    assert record.loop.controller is not None
    controller = DiscreteController(record.loop.controller.numerator, record.loop.controller.denominator)
    return LoopData(plain_array(record.loop.reference), controller, record.loop.enters == "controller")


def predicted_from(reference: Array, u: Array) -> Array:
    """Return the best prediction of an input from the reference by a finite impulse response, from rest."""
    from scipy.linalg import solve_toeplitz  # slow to import

    r, moved = reference - reference.mean(), u - u.mean()
    lags = min(MOST_LAGS, u.size // SAMPLES_PER_LAG + 1)
    size = 2 * u.size
    spectrum = np.fft.rfft(r, size)
    own = np.fft.irfft(np.abs(spectrum) ** 2)[:lags]
    shared = np.fft.irfft(np.conj(spectrum) * np.fft.rfft(moved, size))[:lags]
    if not own[0] > 0.0:
        raise DataError("the reference is constant: it is no instrument")
    own[0] *= 1.0 + RIDGE
    return np.asarray(np.convolve(r, solve_toeplitz(own, shared))[: u.size])


@dataclass(frozen=True, eq=False)
class AdditiveProblem:
    """Parameters of a sum of submodels: ``theta = (a_1 … a_n, b_0 … b_m)``, concatenated for all submodels."""

    data: FilterData
    terms: tuple[Term, ...]
    delay: float
    loop: LoopData = OPEN_LOOP
    initial_state: InitialState = "rest"
    #: Values of known parameters by their indices.
    fixed: Mapping[int, float] = field(default_factory=dict)

    @cached_property
    def filter(self) -> SubmodelFilter:
        """Filter that computes the second moments of the record."""
        return SubmodelFilter(self.data, self.terms, self.delay, self.loop, self.initial_state)

    @property
    def tangent(self) -> Array:
        """Free directions of the parameters, including those of a free response, shape (p, f)."""
        return np.delete(np.eye(self.free), list(self.fixed), axis=1)

    def with_fixed(self, theta: Array) -> Array:
        """Return the parameters with known ones at their values."""
        found = theta.copy()
        for place, value in self.fixed.items():
            found[place] = value
        return found

    @property
    def samples(self) -> int:
        """Number of samples in the sums."""
        return self.data.count

    @property
    def free(self) -> int:
        """Number of parameters of the iteration, including those of a free response."""
        return self.size + self.filter.free

    @property
    def size(self) -> int:
        """Number of parameters of the model, without those of a free response."""
        return sum(term.size for term in self.terms)

    def model(self, theta: Array) -> AdditiveModel:
        """Return the model with given parameters."""
        return AdditiveModel.from_theta(theta[: self.size], self.terms, self.delay)

    def split(self, theta: Array) -> tuple[Array, Array, float]:
        """Return the unfactored denominator, numerator and delay [s] of a parameter vector."""
        try:
            whole = unfactored(self.model(theta))
        except DataError:
            whole = TransferFunction([np.nan_to_num(theta[self.size - 1])], [1.0], self.delay)
        return whole.denominator, whole.numerator, whole.delay

    def admissible(self, theta: Array) -> Array:
        """Reflect unstable submodels.

        Reflecting a real pole changes the sign of the response either below or above its frequency. The sign must be
        kept in the band of the record: a pole in the lower half of the record's frequencies (in octaves, from one
        period in the record to two samples) keeps the gain above its frequency, any other the static gain.
        """
        if not np.isfinite(theta).all():
            return theta
        if self.fixed:
            # Reflecting a pole may change known parameters; if the model is then still unstable, the step is shortened.
            mirrored = self.with_fixed(self._mirrored(self.with_fixed(theta)))
            stable = np.array_equal(self._mirrored(mirrored), mirrored)
            return mirrored if stable else np.full_like(theta, np.nan)
        return self._mirrored(theta)

    def _mirrored(self, theta: Array) -> Array:
        """Return the parameters with unstable submodels reflected."""
        result = theta.copy()
        offset = 0
        for term in self.terms:
            own, n = result[offset : offset + term.size], term.poles
            if n and own[n - 1] != 0.0:
                monic = np.append(own[:n][::-1], 1.0) / own[n - 1]
                if not is_hurwitz(monic):
                    stable = reflect_unstable(monic)
                    own[:n] = stable[-2::-1] / stable[-1]
                    if self._changes_sign(monic):
                        own[n:] *= -1.0
            offset += term.size
        return result

    def _changes_sign(self, denominator: Array) -> bool:
        """Return whether the numerator changes sign, to keep the gain above an odd number of slow poles."""
        roots = np.roots(denominator)
        slow = (roots.imag == 0.0) & (roots.real > 0.0) & (np.abs(roots) < self._middle_frequency)
        return bool(np.count_nonzero(slow) % 2)

    @cached_property
    def _middle_frequency(self) -> float:
        """Geometric mean of the lowest and the highest frequency of the record [rad/s]."""
        t = self.data.t
        duration = float(t[-1] - t[0])
        return math.pi * math.sqrt(2.0 * (t.size - 1)) / duration

    def equations(self, theta: Array) -> Equations:
        """Return the second moments of the iteration."""
        moments = self.filter.moments(theta) if np.isfinite(theta).all() else None
        found: Equations = moments or inadmissible(theta.size)
        return self._without_fixed(found) if self.fixed else found

    def rows(self, theta: Array) -> tuple[Array, Array] | None:
        """Return sensitivities, or instruments in closed loop, and the output error at the used samples."""
        rows = self.filter.rows(theta)
        return None if rows is None else (rows[0], rows[2])

    def least_errors(self, theta: Array) -> Array:
        """Return the output errors of a model with its best free response."""
        rows = self.rows(np.concatenate((theta, np.zeros(self.filter.free))))
        if rows is None:
            raise DataError("the response of the model is not finite on this record")
        free = rows[0][:, self.size :]
        return np.asarray(rows[1] - free @ np.linalg.lstsq(free, rows[1])[0])

    def consistency_margin(self, theta: Array) -> float:
        r"""Return the right side over the left side of the condition for consistency, which holds above 1.

        .. math:: \|E\,\hat\varphi\,\Delta'\|_2 < \sigma_{\min}(E\,\hat\varphi\,\tilde\varphi')

        of González et al. (2025), (36) in open and (37) in closed loop, at the estimate instead of the system, with
        instruments of unit length. Delta is the error of the regressors due to the interpolation of the output. NaN for
        an initial state or a clock for which the condition was not derived.
        """
        source = None if self.filter.free or self.data.interval == 0.0 else self.filter.instrument_input(theta)
        if source is None or self.initial_state != "rest":
            return math.nan
        whole = self.data._replace(u=plain_array(source), use=np.ones_like(self.data.use))
        noise_free = replace(self, data=whole, loop=OPEN_LOOP)
        rows = noise_free.filter.rows(theta)
        if rows is None:
            return math.nan
        # Noise-free regressors: from samples of the output of the model.
        rows = replace(noise_free, data=whole._replace(y=plain_array(rows[3]), use=self.data.use)).filter.rows(theta)
        if rows is None:
            return math.nan
        psi, phi = (part / np.linalg.norm(rows[0], axis=0) for part in rows[:2])
        least, greatest = np.linalg.svd(psi.T @ psi)[1][-1], np.linalg.norm(psi.T @ (phi - psi), 2)
        return float(least / greatest) if greatest > 0.0 else math.inf

    def loop_radius(self, model: AdditiveModel) -> float:
        """Return the spectral radius of the sampled loop of a model with the controller [-]; NaN in open loop."""
        controller, interval = self.loop.controller, self.data.interval
        return math.nan if controller is None or interval == 0.0 else loop_radius(model, controller, interval)

    def _without_fixed(self, found: Equations) -> Equations:
        """Return the equations with each known parameter decoupled and its step zero."""
        matrices = [found.instrument_regressor.copy(), found.hessian.copy()]
        error, known = found.instrument_error.copy(), list(self.fixed)
        for matrix in matrices:
            matrix[known] = matrix[:, known] = 0.0
            matrix[known, known] = 1.0
        error[known] = 0.0
        return found._replace(instrument_regressor=matrices[0], hessian=matrices[1], instrument_error=error)


class History(Sequence[IterationRecord]):
    """Accepted iterations, each converted to an unfactored transfer function only on access."""

    def __init__(self, problem: AdditiveProblem) -> None:
        self._problem = problem
        self._entries: list[tuple[str, int, Array]] = []

    def add(self, stage: str, result: Iterated | None) -> None:
        """Append the start and the accepted steps of an iteration."""
        if result is not None:
            self._entries += [(stage, k, row) for k, row in enumerate(result.path)]

    @property
    def steps(self) -> int:
        """Number of accepted steps, without starts."""
        return sum(number > 0 for _, number, _ in self._entries)

    def __len__(self) -> int:
        return len(self._entries)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return tuple(self[k] for k in range(*index.indices(len(self))))
        stage, iteration, row = self._entries[index]
        return history_entry(stage, iteration, self._problem, row)


class SubmodelEstimate(NamedTuple):
    """Final estimate of the iteration for a sum of submodels."""

    problem: AdditiveProblem
    #: Parameters of the model in the order of the problem's terms, then those of the free response.
    theta: Array
    equations: Equations
    status: Status
    history: History

    @property
    def model(self) -> AdditiveModel:
        """Estimated model, its submodels sorted by natural frequency unless parameters are fixed by name."""
        try:
            found = self.problem.model(self.theta)
        except DataError as error:
            text = "the iterations ended where the terms cannot be told apart"
            raise DataError(f"{text}: {error}; give a closer start") from None
        return found if self.problem.fixed else found.sorted()

    @property
    def order(self) -> IndexArray:
        """Indices of all parameters in the order of the model, those of the free response last."""
        problem = self.problem
        if problem.fixed:
            return np.arange(self.theta.size)
        sorting, places = problem.model(self.theta).order_of_sorting, np.arange(self.theta.size)
        parts = np.split(places[: problem.size], np.cumsum([term.size for term in problem.terms])[:-1])
        states = np.split(places[problem.size :], np.cumsum([term.order for term in problem.terms])[:-1])
        own = [parts[k] for k in sorting] + [states[k] for k in sorting] * (problem.filter.free > 0)
        return np.concatenate(own)

    def described(self, covariance: Covariance, draws: int, jacobian: Array) -> dict[str, Any]:
        """Return the fields of a `Fit` for parameters with this Jacobian by the parameters of the model."""
        problem = self.problem
        # In closed loop an unconverged estimate may be far off, so that it has no standard errors.
        unsolved = problem.loop.closed and not self.status.succeeded
        tangent = problem.tangent[:, :0] if unsolved or self.status is Status.DIVERGED else problem.tangent
        values = assessed(problem, self.theta, self.equations, self.status, covariance, draws, tangent)
        values |= {"iterations": self.history.steps, "history": self.history}
        law = values.get("law")
        if law is None:
            return {**values, "covariance": np.full((len(jacobian),) * 2, np.nan)}
        # Covariances of a free response are not reported.
        law = law.transformed(jacobian @ np.eye(problem.size, problem.free))
        return {**values, "law": law, "covariance": law.covariance}


def estimate_submodels(problem: AdditiveProblem, theta: Array, steps: Steps) -> SubmodelEstimate:
    """Iterate from a start.

    If the iteration does not converge, it is repeated with the other interpolation of the output; in open loop, if that
    fails too, it continues with guarded steps.
    """
    whole = problem.with_fixed(np.concatenate((theta, np.zeros(problem.filter.free))))
    radius = 0.0 if problem.loop.controller is None else problem.loop_radius(problem.model(whole))
    if radius > 1.0 and problem.data.y.size * np.log(radius) > np.log(LARGEST_GROWTH):
        raise DataError(
            "the start makes an unstable loop with the controller: its poles reach the magnitude "
            f"{radius:.4g}, and must stay below 1; start closer, or with instruments 'open_loop'"
        )
    history = History(problem)

    def run(stage: str, problem: AdditiveProblem, start: Array, steps: Steps) -> Iterated | None:
        result = iterate(problem, start, steps)
        history.add(stage, result)
        return result

    result = run("refine", problem, whole, steps)
    if result is None or result.status is not Status.CONVERGED:
        otherwise_held = replace(problem, data=problem.data._replace(y_foh=not problem.data.y_foh))
        result = _better(result, run("refine_again", otherwise_held, whole, steps))
    if result is not None and result.status is Status.MAX_ITERATIONS and not problem.loop.closed:
        # Slow convergence: near a minimum the cost may guard the steps, and Gauss-Newton steps are faster.
        result = _better(result, run("refine_guarded", problem, result.theta, steps._replace(rule=GUARDED)))
    if result is None:
        return SubmodelEstimate(problem, whole, inadmissible(whole.size), Status.DIVERGED, history)
    return SubmodelEstimate(problem, result.theta, result.equations, result.status, history)


def _better(one: Iterated | None, other: Iterated | None) -> Iterated | None:
    """Return the converged result; if none converged, that with the smaller output error."""
    if one is None or other is None:
        return other if one is None else one
    if other.status is Status.CONVERGED:
        return other
    return one if one.equations.squared_error <= other.equations.squared_error else other
