"""Simplified refined instrumental variables for continuous-time models (SRIVC) at a known delay."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar, get_args

import numpy as np
from numpy.typing import NDArray

from ctid_cli.errors import DataError
from ctid_cli.estimators.common import (
    Start,
    check_iteration,
    check_record,
    check_structure,
    finish,
    history_entry,
)
from ctid_cli.estimators.problems import CoefficientProblem, least_squares_start, refit_numerator
from ctid_cli.estimators.refined_iv import Equations, Iterated, Variant, iterate
from ctid_cli.filtering.bank import FilterData, filter_data
from ctid_cli.inference.fit import Fit, IterationRecord
from ctid_cli.inference.sensitivity import Structure
from ctid_cli.inference.status import Status
from ctid_cli.signals.checks import require_choice, require_not_negative, require_positive
from ctid_cli.signals.held import Hold
from ctid_cli.signals.record import Record

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Srivc:
    """SRIVC: optimal instrumental variables for a transfer function with white output noise.

    Parameters
    ----------
    poles : int
        Degree of the denominator, 1 to 12.
    zeros : int
        Degree of the numerator, below ``poles``.
    delay : float, default 0.0
        Known delay [s]; any real number of sampling intervals.
    svf_cutoff : float, default 1.0
        Cut-off of the state-variable filter of the start [rad/s], near the bandwidth of the system.
    max_iterations : int, default 50
        Largest number of iterations.
    tolerance : float, default 1e-6
        Stop when a step changes the simulated output by less than this fraction of its rms value [-].
    variant : {"guarded", "plain"}, default "guarded"
        ``plain`` is the published iteration; ``guarded`` never lets the output-error cost rise.
    hold_output : {"foh", "zoh"}, default "foh"
        Interpolation of the measured output between samples; changes the path, not the converged estimate.

    Raises
    ------
    ValueError
        If an option is out of range.

    Notes
    -----
    ``theta+ = theta + [sum psi phi']^-1 sum psi eps`` from the least-squares start of
    :class:`~ctid_cli.estimators.svf.Svf`. The converged estimate is a stationary point of the output-error cost, hence
    asymptotically efficient for white output noise. It fails where the start is useless: heavy noise with a
    ``svf_cutoff`` far from the bandwidth, or a wrong delay.

    References
    ----------
    P. C. Young and A. Jakeman, "Refined instrumental variable methods of recursive time-series analysis, Part III",
    *Int. J. Control* 31 (1980) 741-764. doi:10.1080/00207178008961080

    Examples
    --------
    >>> import numpy as np
    >>> from ctid_cli import HeldSignal, Record, Srivc, TransferFunction, simulate
    >>> t = 0.1 * np.arange(500)
    >>> u = HeldSignal(t, np.sign(np.sin(t) + np.sin(2.3 * t)))
    >>> y = simulate(TransferFunction([3], [1, 2]), u, t) + 0.1 * np.random.default_rng(0).standard_normal(500)
    >>> fit = Srivc(poles=1, zeros=0).fit(Record(t, y, u))
    >>> {name: f"{value:.2f} +- {fit.standard_errors[name]:.2f}" for name, value in fit.parameters.items()}
    {'a1': '2.03 +- 0.02', 'b0': '3.02 +- 0.02'}
    """

    kind: ClassVar[str] = "srivc"
    uses_start: ClassVar[bool] = False

    poles: int = field(metadata={"doc": "Number of poles, 1 to 12"})
    zeros: int = field(metadata={"doc": "Number of zeros, fewer than poles"})
    delay: float = field(default=0.0, metadata={"doc": "Known delay", "unit": "s"})
    svf_cutoff: float = field(
        default=1.0, metadata={"doc": "Cut-off of the state-variable filter of the start", "unit": "rad/s"}
    )
    max_iterations: int = field(default=50, metadata={"doc": "Largest number of iterations"})
    tolerance: float = field(
        default=1e-6,
        metadata={"doc": "Stop when a step changes the simulated output by less than this fraction of its rms value"},
    )
    variant: Variant = field(default="guarded", metadata={"doc": "plain: as published; guarded: the cost never rises"})
    hold_output: Hold = field(default="foh", metadata={"doc": "Interpolation of the measured output between samples"})

    def __post_init__(self) -> None:
        check_structure(self.poles, self.zeros)
        require_choice("hold_output", self.hold_output, get_args(Hold))
        require_choice("variant", self.variant, get_args(Variant))
        require_positive("svf_cutoff", self.svf_cutoff, "rad/s")
        check_iteration(self.max_iterations, self.tolerance)
        require_not_negative("delay", self.delay, "s")

    def prepare(self, record: Record) -> PreparedSrivc:
        """Check a record and lay it out.

        Parameters
        ----------
        record : Record
            The record.

        Returns
        -------
        PreparedSrivc
            Ready to fit.

        Raises
        ------
        DataError
            If nothing can be estimated from the record.
        """
        return PreparedSrivc(self, record)

    def fit(self, record: Record, start: Start | None = None) -> Fit:
        """Estimate the coefficients.

        Parameters
        ----------
        record : Record
            The record.
        start : Start, optional
            Ignored: the least-squares start needs no value.

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


class PreparedSrivc:
    """A record checked and laid out for :class:`Srivc`.

    Parameters
    ----------
    options : Srivc
        The estimator.
    record : Record
        The record.
    """

    def __init__(self, options: Srivc, record: Record) -> None:
        self.options = options
        self.data = filter_data(record, options.delay, options.hold_output)
        self.structure = Structure(options.poles, options.zeros)
        check_record(record, self.data, self.structure.size)

    def fit(self, start: Start | None = None) -> Fit:
        """Estimate the coefficients.

        Parameters
        ----------
        start : Start, optional
            Ignored: the least-squares start needs no value.

        Returns
        -------
        Fit
            The estimate.

        Raises
        ------
        DataError
            If the equations of the start are singular.
        """
        options = self.options
        problem = CoefficientProblem(self.data, self.structure, options.delay)
        theta = initial_coefficients(problem, options.svf_cutoff, options.variant)
        if theta is None:
            raise DataError(Status.SINGULAR.value)
        history: list[IterationRecord] = []

        def record_step(theta: Array, equations: Equations) -> None:
            cost = equations.squared_error / self.data.count
            history.append(history_entry("refine", len(history), problem, theta, cost))

        result = iterate(
            problem,
            theta,
            max_iterations=options.max_iterations,
            tolerance=options.tolerance,
            variant=options.variant,
            on_step=record_step,
        )
        if result is None:
            return finish(problem, theta, Status.DIVERGED, 0, history)
        return finish(problem, result.theta, result.status, result.iterations, history)


def initial_coefficients(problem: CoefficientProblem, svf_cutoff: float, variant: Variant) -> Array | None:
    """Least-squares start; the guarded variant re-fits the numerator to the output error.

    Parameters
    ----------
    problem : CoefficientProblem
        Record, degrees and delay.
    svf_cutoff : float
        Cut-off of the state-variable filter [rad/s].
    variant : {"plain", "guarded"}
        Variant of the iteration.

    Returns
    -------
    ndarray, shape (n + m + 1,) or None
        Start; None if the equations are singular.
    """
    data: FilterData = problem.data
    theta = least_squares_start(data, problem.structure, problem.delay, svf_cutoff)
    if theta is not None and variant == "guarded":
        theta = refit_numerator(data, problem.structure, theta, problem.delay)
    return theta


__all__ = ["Iterated", "PreparedSrivc", "Srivc", "initial_coefficients"]
