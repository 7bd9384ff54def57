"""Least squares with a state-variable filter."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, get_args

from ctid_cli.errors import DataError
from ctid_cli.estimation.common import Start, StartFrom, check_record, check_structure, finish, history_entry
from ctid_cli.estimation.problems import CoefficientProblem, least_squares_start
from ctid_cli.filtering.filter_data import filter_data
from ctid_cli.inference.fit import Fit
from ctid_cli.inference.sensitivity import Structure
from ctid_cli.inference.status import Status
from ctid_cli.signals.checks import require_choice, require_not_negative, require_positive
from ctid_cli.signals.held import Hold
from ctid_cli.signals.record import Record


@dataclass(frozen=True)
class Svf:
    """Least-squares estimate with the state-variable filter ``1/(p + svf_cutoff)^poles``.

    Parameters
    ----------
    poles : int
        Degree of the denominator, 1 to 12.
    zeros : int
        Degree of the numerator, below ``poles``.
    delay : float, default 0.0
        Known delay [s].
    svf_cutoff : float, default 1.0
        Cut-off of the filter [rad/s], near the bandwidth of the system.
    hold_output : {"foh", "zoh"}, default "foh"
        Interpolation of the measured output between samples.

    Raises
    ------
    ValueError
        If an option is out of range.

    Notes
    -----
    Linear least squares on ``p^n/F y = phi' theta``, F the filter's denominator. The regressors hold the noisy output,
    so the estimate is biased unless there is no noise: no standard errors are given. It is a start for
    :class:`~ctid_cli.estimators.srivc.Srivc`.

    References
    ----------
    H. Garnier and L. Wang (eds.), *Identification of Continuous-time Models from Sampled Data*, Springer, 2008, ch. 1.
    """

    kind: ClassVar[str] = "svf"
    start_from: ClassVar[StartFrom | None] = None

    poles: int
    zeros: int
    delay: float = 0.0
    svf_cutoff: float = 1.0
    hold_output: Hold = "foh"

    def __post_init__(self) -> None:
        check_structure(self.poles, self.zeros)
        require_choice("hold_output", self.hold_output, get_args(Hold))
        require_positive("svf_cutoff", self.svf_cutoff, "rad/s")
        require_not_negative("delay", self.delay, "s")

    def prepare(self, record: Record) -> PreparedSvf:
        """Check a record and lay it out.

        Parameters
        ----------
        record : Record
            The record.

        Returns
        -------
        PreparedSvf
            Ready to fit.

        Raises
        ------
        DataError
            If nothing can be estimated from the record.
        """
        return PreparedSvf(self, record)

    def fit(self, record: Record, start: Start | None = None) -> Fit:
        """Estimate the coefficients.

        Parameters
        ----------
        record : Record
            The record.
        start : Start, optional
            Ignored: least squares needs no start.

        Returns
        -------
        Fit
            The estimate.

        Raises
        ------
        DataError
            If nothing can be estimated from the record.
        """
        return self.prepare(record).fit(start)


class PreparedSvf:
    """A record checked and laid out for :class:`Svf`."""

    def __init__(self, options: Svf, record: Record) -> None:
        self.options = options
        self.data = filter_data(record, options.delay, options.hold_output)
        self.structure = Structure(options.poles, options.zeros)
        check_record(record, self.data, self.structure.size)

    def fit(self, start: Start | None = None) -> Fit:
        """Estimate the coefficients."""
        options = self.options
        theta = least_squares_start(self.data, self.structure, options.delay, options.svf_cutoff)
        if theta is None:
            raise DataError(Status.SINGULAR.value)
        problem = CoefficientProblem(self.data, self.structure, options.delay)
        fit = finish(problem, theta, Status.LEAST_SQUARES, 1, [], accurate=False)
        entry = history_entry("least squares", 0, problem, theta, fit.cost)
        return replace(fit, history=(entry,))
