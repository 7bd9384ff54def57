"""Least squares with a state-variable filter."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ctid_cli.errors import DataError
from ctid_cli.estimation.common import Estimator, Start, check_proper, check_record, finish, history_of
from ctid_cli.estimation.sampled_problem import SampledProblem, at_known_delay, cutoffs_of, least_squares_start
from ctid_cli.filtering.filter_data import filter_data
from ctid_cli.inference.fit import Fit, Status
from ctid_cli.inference.sensitivities import Structure
from ctid_cli.signals.record import Record
from ctid_cli.signals.treatment import OutputHold


@dataclass(frozen=True)
class Svf(Estimator[tuple[SampledProblem, float], Fit]):
    """Least-squares estimate with the state-variable filter ``1/(p + svf_cutoff)^poles``.

    Parameters
    ----------
    poles : int
        Degree of the denominator, 1 to 12.
    zeros : int
        Degree of the numerator, below ``poles``.
    delay : float, default 0.0
        Known delay [s].
    svf_cutoff : float, optional
        Cut-off of the filter [rad/s], near the bandwidth of the system; by default the bandwidth of the output.
    hold_output : {"foh", "zoh"}, default "foh"
        Interpolation of the measured output between samples.

    Raises
    ------
    ValueError
        If an option is out of range.

    Notes
    -----
    Linear least squares on ``p^n/F y = phi' theta``, F the filter's denominator. The regressors contain the noisy
    output, so that noise biases the estimate: no standard errors are given. It is a start for
    :class:`~ctid_cli.estimators.srivc.Srivc`.

    References
    ----------
    H. Garnier and L. Wang (eds.), *Identification of Continuous-time Models from Sampled Data*, Springer, 2008, ch. 1.
    """

    kind: ClassVar[str] = "svf"

    poles: int
    zeros: int
    delay: float = 0.0
    svf_cutoff: float | None = None
    hold_output: OutputHold = "foh"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_proper(self.poles, self.zeros)

    def _lay_out(self, record: Record) -> tuple[SampledProblem, float]:
        """Return a filtered record, and the cut-off of the filter [rad/s]."""
        data = filter_data(record, self.delay, self.hold_output)
        structure = Structure(self.poles, self.zeros)
        check_record(record, data, structure.size)
        return at_known_delay(data, structure), cutoffs_of(record, self.svf_cutoff)[0]

    def _estimate(self, laid_out: tuple[SampledProblem, float], start: Start | None) -> Fit:
        problem, svf_cutoff = laid_out
        theta = least_squares_start(problem.data, problem.structure, self.delay, svf_cutoff)
        if theta is None:
            raise DataError(Status.SINGULAR.value)
        squared_error = problem.equations(theta).squared_error
        history = history_of("least squares", problem, np.append(theta, squared_error)[None])
        return finish(problem, theta, Status.LEAST_SQUARES, 1, history)
