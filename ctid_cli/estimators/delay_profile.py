"""Global estimation from measured records: a one-dimensional search over the delay, then Gauss-Newton on everything."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from ctid_cli.arrays import Array, BoolArray
from ctid_cli.errors import DataError, OptionError
from ctid_cli.estimation.common import Estimator, Start, checked_bounds, covariance_of, quality
from ctid_cli.estimation.iteration import Iterated
from ctid_cli.estimation.measured_records import MeasuredRecords, Treatment
from ctid_cli.estimation.profile_refinement import Refinement
from ctid_cli.estimation.profile_search import Profile, ProfileSearch, search_delay
from ctid_cli.inference.fit import Fit, IterationRecord
from ctid_cli.inference.sensitivity import Structure
from ctid_cli.inference.status import Status
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import Hold
from ctid_cli.signals.record import Record
from ctid_cli.signals.treatment import InitialState, Offset


@dataclass(frozen=True, eq=False, repr=False)
class MeasuredFit(Fit):
    """A fit with what belongs to the records.

    Parameters
    ----------
    model : TransferFunction
        The estimate: monic denominator, descending powers, delay [s].
    parameter_names : tuple of str
        Names of the free parameters, in the order of ``covariance``.
    covariance : ndarray, shape (p, p)
        Asymptotic covariance for white residuals; NaN where it is not defined.
    status : Status
        How the iterations ended.
    cost : float
        Mean squared output error over the used samples [output unit^2].
    fit_percent : float
        ``100 (1 - ||y - x|| / ||y - mean y||)`` over the used samples of all experiments, means by experiment [%].
    r2 : float
        ``1 - ||y - x||^2 / ||y - mean y||^2`` [-].
    count : int
        Number of samples used.
    iterations : int
        Iterations of the refinement.
    condition_number : float
        Of the scaled ``sum psi psi'`` [-].
    history : tuple of IterationRecord
        The accepted iterations of the refinement.
    theta : ndarray, shape (p,)
        All free parameters, in the order of ``parameter_names``.
    initial_states : tuple of ndarray
        Coefficients of C for each experiment; empty arrays where the state was not estimated.
    offsets : tuple of float
        Output offset of each experiment [output unit]; what was subtracted, where means were removed.
    input_offsets : tuple of float
        Mean of the input that was subtracted [input unit]; 0 where none was.
    profile : Profile or None
        The search over the delay; None where the delay is known.
    residuals : tuple of ndarray
        Output errors at the used samples of each experiment [output unit].
    sensitivities : tuple of ndarray
        psi at the used samples of each experiment, shape (count, p).
    used : tuple of ndarray of bool
        Which samples of each record were used, shape (N,).
    """

    theta: Array = field(default_factory=lambda: np.zeros(0))
    initial_states: tuple[Array, ...] = ()
    offsets: tuple[float, ...] = ()
    input_offsets: tuple[float, ...] = ()
    profile: Profile | None = None
    residuals: tuple[Array, ...] = ()
    sensitivities: tuple[Array, ...] = ()
    used: tuple[BoolArray, ...] = ()

    @property
    def parameters(self) -> dict[str, float]:
        """Free parameters by name."""
        return dict(zip(self.parameter_names, self.theta.tolist(), strict=True))


@dataclass(frozen=True)
class DelayProfile(Estimator[Refinement, MeasuredFit]):
    """Global search over the delay, refined on the output-error cost together with initial state and offset.

    Parameters
    ----------
    poles : int
        Degree of the denominator, 1 to 12.
    zeros : int
        Degree of the numerator, below ``poles``; equal to ``poles`` only where the delay is known.
    delay_bounds : tuple of float
        Least and greatest delay [s]; two equal numbers are a known delay.
    initial_state : {"rest", "estimate", "periodic"}, default "rest"
        State before the record: at rest (zero input before the first sample), estimated with the model, or the steady
        state of an input that repeats the record for ever.
    offset : {"none", "remove", "estimate"}, default "none"
        Constant offset of the output: none, means of input and output subtracted first, or estimated with the model.
    search : {"time", "spectral", "samples"}, default "time"
        What the search over the delay looks at: low-pass-filtered signals resampled at a lower rate, the spectra of
        the record, or every sample. The first two need one record at rest without an estimated offset; every sample
        is looked at otherwise. The estimate itself always comes from every sample.
    svf_cutoff : float, optional
        Cut-off of the state-variable filter of the starts [rad/s]; by default from the bandwidth of the output.
    max_iterations : int, default 100
        Largest number of Gauss-Newton iterations from each local minimum.
    tolerance : float, default 1e-8
        Stop when a step changes the simulated output by less than this fraction of its rms value [-].
    hold_output : {"foh", "zoh"}, default "foh"
        Interpolation of the measured output between samples; does not change the estimate.

    Raises
    ------
    ValueError
        If an option is out of range.

    Notes
    -----
    The cost, minimised over everything but the delay, is computed on a grid whose spacing is a quarter period of the
    highest frequency that matters in the output (95 % of its power), so that no basin is missed. Where the filters of
    ``search`` can be used, long grids are searched from coarse to fine: behind a filter of a third of that bandwidth
    three times fewer delays do, and the next level looks around the best of them only. The best local minima are
    refined jointly in all parameters on every sample, and the lowest is kept: no start has to be given.
    """

    kind: ClassVar[str] = "delay_profile"

    poles: int
    zeros: int
    delay_bounds: tuple[float, float]
    initial_state: InitialState = "rest"
    offset: Offset = "none"
    search: ProfileSearch = "time"
    svf_cutoff: float | None = None
    max_iterations: int = 100
    tolerance: float = 1e-8
    hold_output: Hold = "foh"

    def __post_init__(self) -> None:
        super().__post_init__()
        low, high = bounds = checked_bounds(self.delay_bounds, known_allowed=True)
        object.__setattr__(self, "delay_bounds", bounds)
        allowed = self.poles if low == high else self.poles - 1
        if self.zeros > allowed:
            reason = "" if low == high else " while the delay is estimated"
            given = f"got {self.zeros} zeros and {self.poles} poles"
            raise OptionError("zeros", f"zeros must be at most {allowed}{reason}: {given}")

    def _lay_out(self, records: Record | Sequence[Record]) -> Refinement:
        low, high = self.delay_bounds
        measured = MeasuredRecords(
            [records] if isinstance(records, Record) else list(records),
            Structure(self.poles, self.zeros, delay=low < high),
            Treatment(self.delay_bounds, self.initial_state, self.offset, self.hold_output),
        )
        return Refinement(measured, self.max_iterations, self.tolerance)

    def _estimate(self, refinement: Refinement, start: Start | None) -> MeasuredFit:
        for minima, profile in search_delay(refinement.measured, self.search, self.svf_cutoff):
            refined = [refinement.from_minimum(minimum) for minimum in minima]
            found = [(result, history) for result, history in refined if result is not None]
            if found:
                best, history = min(found, key=lambda end: end[0].equations.squared_error)
                return _fit(refinement, best, history, profile)
        raise DataError(Status.SINGULAR.value)


def _fit(
    refinement: Refinement, result: Iterated, history: list[IterationRecord], profile: Profile | None
) -> MeasuredFit:
    problem, measured = refinement.problem, refinement.measured
    a, b, delay = problem.split(result.theta)
    parts = problem.sensitivities(result.theta)
    assert parts is not None
    free = np.arange(problem.free)
    if result.status is Status.DELAY_AT_BOUND:
        free = np.delete(free, refinement.structure.size - 1)
    covariance, status = covariance_of(result.equations, free, problem.samples, result.status)
    outputs = np.concatenate([data.y_used - data.y_used.mean() for data in problem.data])
    states, offsets = refinement.own(problem, result.theta)
    return MeasuredFit(
        model=TransferFunction(b, a, delay),
        parameter_names=problem.layout.names,
        covariance=covariance,
        status=status,
        iterations=result.iterations,
        history=tuple(history),
        theta=result.theta,
        initial_states=states,
        offsets=offsets,
        input_offsets=tuple(measured.input_offsets),
        profile=profile,
        residuals=tuple(eps for _, eps in parts),
        sensitivities=tuple(psi for psi, _ in parts),
        used=measured.used(),
        **quality(result.equations, float(outputs @ outputs), problem.samples),
    )
