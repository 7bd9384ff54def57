"""SRIVC with an estimated time delay: Gauss-Newton on the delay around SRIVC for the coefficients."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, get_args

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.errors import DataError, OptionError
from ctid_cli.estimation.common import (
    Start,
    StartFrom,
    check_iteration,
    check_record,
    check_structure,
    finish,
    history_entry,
    initial_delay,
)
from ctid_cli.estimation.delay_search import Descent, Minimum, bound_in_the_way, delay_step, descend
from ctid_cli.estimation.problems import CoefficientProblem, DelayProblem
from ctid_cli.estimation.refined_iv import Equations, Iterated, Variant, iterate
from ctid_cli.estimators.srivc import initial_coefficients
from ctid_cli.filtering.filter_data import FilterData, filter_data
from ctid_cli.filtering.lowpass import Lowpass
from ctid_cli.inference.fit import Fit, IterationRecord
from ctid_cli.inference.sensitivity import Structure
from ctid_cli.inference.status import Status
from ctid_cli.signals.checks import require_choice, require_positive
from ctid_cli.signals.held import Hold
from ctid_cli.signals.record import Record

#: SRIVC iterations at each trial delay while searching.
INNER_ITERATIONS = 20
#: Tolerance of the guarded variant while it searches.
SEARCH_TOLERANCE = 1e-3


@dataclass(frozen=True)
class TdSrivc:
    """Coefficients and delay by separable least squares: SRIVC for the coefficients, Gauss-Newton for the delay.

    Parameters
    ----------
    poles : int
        Degree of the denominator, 1 to 12.
    zeros : int
        Degree of the numerator, below ``poles``.
    delay_bounds : tuple of float
        Least and greatest delay [s]. Samples earlier than the greatest delay after the first input are not used.
    lowpass : Lowpass, optional
        Search on low-pass-filtered data first, which widens the region of convergence; then refine on the data as
        they are. None searches on the data as they are.
    svf_cutoff : float, default 1.0
        Cut-off of the state-variable filter of the start [rad/s], near the bandwidth of the system.
    max_iterations : int, default 50
        Largest number of Gauss-Newton iterations on the delay, in the search and in the refinement each.
    tolerance : float, default 1e-6
        Stop when the cost falls by less than this fraction; also the tolerance of SRIVC at each trial delay [-].
    variant : {"guarded", "plain"}, default "guarded"
        ``plain`` is the published algorithm. ``guarded`` never lets the cost rise inside SRIVC and ends with joint
        iterations on coefficients and delay.
    hold_output : {"foh", "zoh"}, default "foh"
        Interpolation of the measured output between samples; changes the path, not the converged estimate.

    Raises
    ------
    ValueError
        If an option is out of range.

    Notes
    -----
    The cost as a function of the delay has many local minima, roughly one for each half period of the system's
    dominant frequency. The search finds the one in whose basin it starts; a low-pass filter merges basins. With
    ``eps = y - B/A u(t - tau)``, ``d eps/d tau = p B/A u(t - tau)`` and psi the sensitivities to the coefficients,

    ``H = eps_tau' eps_tau - eps_tau' psi (psi' psi)^-1 psi' eps_tau``, step ``-(eps_tau' eps)/H``,

    halved while it leaves the bounds or the cost does not fall.

    References
    ----------
    F. Chen, H. Garnier and M. Gilson, "Robust identification of continuous-time models with arbitrary time-delay from
    irregularly sampled data", *J. Process Control* 25 (2015) 19-27. doi:10.1016/j.jprocont.2014.10.003
    """

    kind: ClassVar[str] = "td_srivc"
    start_from: ClassVar[StartFrom | None] = "delay"

    poles: int
    zeros: int
    delay_bounds: tuple[float, float]
    lowpass: Lowpass | None = None
    svf_cutoff: float = 1.0
    max_iterations: int = 50
    tolerance: float = 1e-6
    variant: Variant = "guarded"
    hold_output: Hold = "foh"

    def __post_init__(self) -> None:
        check_structure(self.poles, self.zeros)
        require_choice("hold_output", self.hold_output, get_args(Hold))
        require_choice("variant", self.variant, get_args(Variant))
        require_positive("svf_cutoff", self.svf_cutoff, "rad/s")
        check_iteration(self.max_iterations, self.tolerance)
        try:
            low, high = (float(bound) for bound in self.delay_bounds)
        except (TypeError, ValueError):
            low, high = np.nan, np.nan
        if not 0 <= low < high < np.inf:
            raise OptionError(
                "delay_bounds",
                f"delay_bounds must be two delays in seconds, the smaller (0 or more) first: got {self.delay_bounds!r}",
            )
        object.__setattr__(self, "delay_bounds", (low, high))

    def prepare(self, record: Record) -> PreparedTdSrivc:
        """Check a record, lay it out and filter it, once for any number of starts.

        Parameters
        ----------
        record : Record
            The record.

        Returns
        -------
        PreparedTdSrivc
            Ready to fit from any start.

        Raises
        ------
        DataError
            If nothing can be estimated from the record.
        """
        return PreparedTdSrivc(self, record)

    def fit(self, record: Record, start: Start | None = None) -> Fit:
        """Estimate coefficients and delay.

        Parameters
        ----------
        record : Record
            The record.
        start : Start, optional
            Initial delay; the middle of the bounds by default.

        Returns
        -------
        Fit
            The estimate.

        Raises
        ------
        DataError
            If nothing can be estimated from the record, or the start lies outside the bounds.
        """
        return self.prepare(record).fit(start)


class PreparedTdSrivc:
    """A record checked, laid out and filtered for :class:`TdSrivc`."""

    def __init__(self, options: TdSrivc, record: Record) -> None:
        self.options = options
        self.structure = Structure(options.poles, options.zeros)
        greatest = options.delay_bounds[1]
        if greatest >= record.t[-1] - record.input.t[0]:
            raise DataError(
                f"{record.name + ': ' if record.name else ''}the greatest delay, {greatest:g} s, is not shorter than "
                f"the record, {record.t[-1] - record.input.t[0]:g} s"
            )
        self.data = filter_data(record, greatest, options.hold_output)
        check_record(record, self.data, self.structure.size + 1)
        self.search_data = self.data
        if options.lowpass is not None:
            try:
                filtered = options.lowpass.apply(record)
            except ValueError as error:
                raise DataError(str(error)) from error
            self.search_data = filter_data(filtered, greatest, options.hold_output)

    def fit(self, start: Start | None = None) -> Fit:
        """Estimate coefficients and delay from one start."""
        options = self.options
        delay = initial_delay(start, options.delay_bounds)
        history: list[IterationRecord] = []
        found = _SampleCost(self.search_data, self.structure, options).descend(delay, None, "search", history)
        if found is None:
            raise DataError(Status.SINGULAR.value)
        if options.lowpass is None:
            return self._finish(found, history, found.iterations)
        return self.refine(found, history)

    def refine(self, found: Descent, history: list[IterationRecord]) -> Fit:
        """Go on from a delay and coefficients that a search on filtered data has found."""
        cost = _SampleCost(self.data, self.structure, self.options)
        refined = cost.descend(found.minimum.delay, found.minimum.theta, "refine", history)
        if refined is None:
            return self._finish(found, history, found.iterations)
        return self._finish(refined, history, found.iterations + refined.iterations)

    def _finish(self, found: Descent, history: list[IterationRecord], iterations: int) -> Fit:
        """Polish, mind the bounds, and report."""
        options = self.options
        problem = DelayProblem(self.data, self.structure, options.delay_bounds)
        theta, status = np.concatenate((found.minimum.theta, [found.minimum.delay])), found.status
        if options.variant == "guarded":
            polished = self._polish(problem, theta, history)
            if polished is not None:
                theta, iterations, status = polished.theta, iterations + polished.iterations, polished.status
        there = self._at_bound(problem, theta)
        if there is not None:
            status = Status.DELAY_AT_BOUND
            if options.variant == "guarded":
                theta, squared_error = there
                history.append(history_entry("bound", 0, problem, theta, squared_error / self.data.count))
        return finish(problem, theta, status, iterations, history)

    def _at_bound(self, problem: DelayProblem, theta: Array) -> tuple[Array, float] | None:
        """The estimate with the delay on a bound and its sum of squares, if that is where the cost leads."""
        here = problem.equations(theta)
        bound = None if here is None else bound_in_the_way(here, float(theta[-1]), problem.bounds)
        if here is None or bound is None:
            return None
        coefficients = CoefficientProblem(self.data, self.structure, bound)
        there = iterate(
            coefficients,
            theta[:-1],
            max_iterations=self.options.max_iterations,
            tolerance=self.options.tolerance,
            variant="guarded",
        )
        if there is None or there.equations.squared_error > here.squared_error:
            return None
        return np.concatenate((there.theta, [bound])), there.equations.squared_error

    def _polish(self, problem: DelayProblem, theta: Array, history: list[IterationRecord]) -> Iterated | None:
        """Joint iterations on coefficients and delay: from the right basin they converge in a few steps."""
        first = len(history)

        def record_step(theta: Array, equations: Equations) -> None:
            cost = equations.squared_error / problem.data.count
            history.append(history_entry("joint", len(history) - first, problem, theta, cost))

        return iterate(
            problem,
            theta,
            max_iterations=self.options.max_iterations,
            tolerance=self.options.tolerance,
            variant="guarded",
            on_step=record_step,
        )


class _SampleCost:
    """The cost of a record's samples; SRIVC estimates the coefficients."""

    def __init__(self, data: FilterData, structure: Structure, options: TdSrivc) -> None:
        self.data = data
        self.structure = structure
        self.options = options
        self.joint = DelayProblem(data, structure, options.delay_bounds)
        # The guarded variant ends with joint iterations: its search only has to find the basin.
        self.tolerance = options.tolerance if options.variant == "plain" else max(options.tolerance, SEARCH_TOLERANCE)

    def minimise(self, delay: float, theta: Array | None) -> Minimum | None:
        """SRIVC at one delay, from given coefficients or from the least-squares start."""
        problem = CoefficientProblem(self.data, self.structure, delay)
        options = self.options
        if theta is None:
            theta = initial_coefficients(problem, options.svf_cutoff, options.variant)
            if theta is None:
                return None
        result = iterate(
            problem,
            theta,
            max_iterations=INNER_ITERATIONS,
            tolerance=self.tolerance,
            variant=options.variant,
        )
        if result is None or not np.isfinite(result.theta).all():
            return None
        return Minimum(delay, result.theta, result.equations.squared_error)

    def step(self, minimum: Minimum) -> float | None:
        """Gauss-Newton step of the delay."""
        equations = self.joint.equations(np.concatenate((minimum.theta, [minimum.delay])))
        return None if equations is None else delay_step(equations)

    def descend(self, delay: float, theta: Array | None, stage: str, history: list[IterationRecord]) -> Descent | None:
        """Search from a delay; the accepted steps go to the history."""
        first = len(history)

        def log(minimum: Minimum) -> None:
            joint = np.concatenate((minimum.theta, [minimum.delay]))
            cost = minimum.squared_error / self.data.count
            history.append(history_entry(stage, len(history) - first, self.joint, joint, cost))

        return descend(
            self,
            delay,
            theta,
            self.options.delay_bounds,
            max_iterations=self.options.max_iterations,
            tolerance=self.tolerance,
            on_step=log,
        )
