"""Global estimation from measured records: a one-dimensional search over the delay, then Gauss-Newton on everything."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar, Literal, get_args

import numpy as np

from ctid_cli.arrays import Array, BoolArray
from ctid_cli.errors import DataError, OptionError
from ctid_cli.estimation.common import Start, StartFrom, check_iteration, check_record, history_entry
from ctid_cli.estimation.delay_grid import Level, local_minima, search_grid
from ctid_cli.estimation.delay_search import bound_in_the_way
from ctid_cli.estimation.filtered_costs import Effort, filtered_costs
from ctid_cli.estimation.output_error import Layout, OutputErrorProblem
from ctid_cli.estimation.problems import CoefficientProblem, least_squares_start, refit_numerator
from ctid_cli.estimation.refined_iv import Equations, Iterated, iterate
from ctid_cli.filtering.filter_data import FilterData, filter_data
from ctid_cli.filtering.lowpass import Lowpass
from ctid_cli.inference.answer import output_bandwidth
from ctid_cli.inference.covariance import condition_number, white_noise_covariance
from ctid_cli.inference.diagnostics import percent_from_r_squared
from ctid_cli.inference.fit import Fit, IterationRecord
from ctid_cli.inference.sensitivity import Structure
from ctid_cli.inference.status import Status
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.checks import require_choice, require_integer, require_not_negative, require_positive
from ctid_cli.signals.held import HeldSignal, Hold
from ctid_cli.signals.record import Record
from ctid_cli.signals.treatment import InitialState, Offset

ProfileSearch = Literal["time", "spectral", "samples"]

#: Local minima of the profile that are refined.
MINIMA = 3
#: SRIVC iterations and tolerance at each delay of the grid.
GRID_ITERATIONS = 15
GRID_TOLERANCE = 1e-2
#: Trials of a step on the grid. Far from the true delay a pole may run to infinity, where no number of them helps.
GRID_HALVINGS = 4
#: Delays on the grid: between these numbers, whatever the bandwidth asks for.
FEWEST_DELAYS = 24
MOST_DELAYS = 2000
#: Most parts into which a step of the grid is divided around its minima.
FINEST = 32
#: A search behind filters: ratio of the cut-off frequencies of its levels, how many delays the first level may have
#: before a coarser one is put before it, how many levels at most, and order and effort of each.
LEVEL_RATIO = 3.0
MOST_FIRST_DELAYS = 30
MOST_LEVELS = 4
LEVEL_ORDER = 10
LEVEL_EFFORT = Effort(max_iterations=6, tolerance=2e-2, halvings=3, gauss_newton=True)
#: Cut-offs of the state-variable filter that are tried, as multiples of the output's bandwidth.
CUTOFFS = (0.2, 1.0, 5.0)
#: Time constants after which a free response counts as gone (1e-12), and most periods that are prepended for it.
SETTLING = 28.0
MOST_PERIODS = 200


@dataclass(frozen=True)
class DelayProfile:
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
    start_from: ClassVar[StartFrom | None] = None

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
        require_integer("poles", self.poles, 1, 12)
        require_integer("zeros", self.zeros, 0)
        require_choice("initial_state", self.initial_state, get_args(InitialState))
        require_choice("offset", self.offset, get_args(Offset))
        require_choice("search", self.search, get_args(ProfileSearch))
        require_choice("hold_output", self.hold_output, get_args(Hold))
        check_iteration(self.max_iterations, self.tolerance)
        if self.svf_cutoff is not None:
            require_positive("svf_cutoff", self.svf_cutoff, "rad/s")
        try:
            low, high = (float(bound) for bound in self.delay_bounds)
        except (TypeError, ValueError):
            raise OptionError(
                "delay_bounds", f"delay_bounds must be two delays in seconds, not {self.delay_bounds!r}"
            ) from None
        require_not_negative("delay_bounds", low, "s")
        if not low <= high < np.inf:
            raise OptionError(
                "delay_bounds",
                f"delay_bounds must be two delays in seconds, the smaller first: got [{low:g}, {high:g}]",
            )
        object.__setattr__(self, "delay_bounds", (low, high))
        allowed = self.poles if low == high else self.poles - 1
        if self.zeros > allowed:
            reason = "" if low == high else " while the delay is estimated"
            raise OptionError(
                "zeros", f"zeros must be at most {allowed}{reason}: got {self.zeros} zeros and {self.poles} poles"
            )

    def prepare(self, records: Record | Sequence[Record]) -> PreparedProfile:
        """Check one or more records and lay them out.

        Parameters
        ----------
        records : Record or sequence of Record
            One record for each experiment.

        Returns
        -------
        PreparedProfile
            Ready to fit.

        Raises
        ------
        DataError
            If nothing can be estimated from the records.
        """
        return PreparedProfile(self, [records] if isinstance(records, Record) else list(records))

    def fit(self, records: Record | Sequence[Record], start: Start | None = None) -> MeasuredFit:
        """Estimate the model.

        Parameters
        ----------
        records : Record or sequence of Record
            One record for each experiment; all share coefficients and delay.
        start : Start, optional
            Ignored: the search is global.

        Returns
        -------
        MeasuredFit
            The estimate.

        Raises
        ------
        DataError
            If nothing can be estimated from the records.
        """
        return self.prepare(records).fit(start)


@dataclass(frozen=True, eq=False)
class Profile:
    """Cost over the grid of delays, minimised over all other parameters."""

    #: Grid [s], shape (K,).
    delays: Array
    #: Mean squared output error [output unit^2]; NaN where the equations were singular, shape (K,).
    costs: Array
    #: Frequency below which the output has 95 % of its power [rad/s]; the spacing is at most a quarter of its period.
    bandwidth: float
    #: Cut-off frequency [rad/s] of the low-pass filter behind which the grid was searched, and to whose output the
    #: costs belong; the spacing is then a quarter of its period. None where every sample was searched.
    cutoff: float | None = None


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

    theta: Array = field(default_factory=lambda: np.zeros(0), repr=False)
    initial_states: tuple[Array, ...] = ()
    offsets: tuple[float, ...] = ()
    input_offsets: tuple[float, ...] = ()
    profile: Profile | None = field(default=None, repr=False)
    residuals: tuple[Array, ...] = field(default=(), repr=False)
    sensitivities: tuple[Array, ...] = field(default=(), repr=False)
    used: tuple[BoolArray, ...] = field(default=(), repr=False)

    @property
    def parameters(self) -> dict[str, float]:
        """Free parameters by name."""
        return dict(zip(self.parameter_names, self.theta.tolist(), strict=True))


class _CoefficientSearch(CoefficientProblem):
    """Coefficients at a fixed delay by Gauss-Newton: a direction of descent also where the delay is wrong."""

    def equations(self, theta: Array) -> Equations | None:
        equations = super().equations(theta)
        return None if equations is None else replace(equations, instrument_regressor=equations.hessian)


@dataclass(frozen=True, eq=False)
class AppliedModel:
    """A given model on records that it need not have been estimated from."""

    #: Output errors at the used samples of each experiment [output unit].
    residuals: tuple[Array, ...] = field(repr=False)
    used: tuple[BoolArray, ...] = field(repr=False)
    initial_states: tuple[Array, ...]
    #: Output offset of each experiment [output unit].
    offsets: tuple[float, ...]


class PreparedProfile:
    """Records checked and laid out for :class:`DelayProfile`."""

    def __init__(self, options: DelayProfile, records: list[Record]) -> None:
        if not records:
            raise DataError("there is no record to estimate from")
        self.options = options
        low, high = options.delay_bounds
        self.structure = Structure(options.poles, options.zeros, delay=low < high)
        self.coefficients = Structure(options.poles, options.zeros)
        self.layout = Layout(
            self.structure, len(records), options.initial_state == "estimate", options.offset == "estimate"
        )
        self.offsets: list[float] = []
        self.input_offsets: list[float] = []
        self.records: list[Record] = []
        for record in records:
            where = f"{record.name}: " if record.name else ""
            if high > 0 and high >= record.t[-1] - record.input.t[0]:
                raise DataError(
                    f"{where}the greatest delay, {high:g} s, is not shorter than the record, "
                    f"{record.t[-1] - record.input.t[0]:g} s"
                )
            if low < high and np.ptp(record.input.values) == 0.0:
                raise DataError(
                    f"{where}the input is constant ({record.input.values[0]:g}) over the whole record: it holds no "
                    "event from which a delay could be read; give a known delay, and an initial state to be estimated"
                )
            if np.ptp(record.input.values) == 0.0 and options.initial_state != "estimate":
                raise DataError(
                    f"{where}the input is constant ({record.input.values[0]:g}) over the whole record; only with an "
                    "estimated initial state (initial_state 'estimate') can a model be read from the free response"
                )
            centred, u0, y0 = _without_means(record) if options.offset == "remove" else (record, 0.0, 0.0)
            self.records.append(centred)
            self.input_offsets.append(u0)
            self.offsets.append(y0)
        self.data = [self._lay_out(record) for record in self.records]
        for record, data in zip(self.records, self.data, strict=True):
            self._check(record, data)
        self.bandwidth = options.svf_cutoff or max(output_bandwidth(record) for record in self.records)

    def _check(self, record: Record, data: FilterData) -> None:
        """Refuse what cannot be estimated; a constant input is no obstacle to an estimated initial state."""
        if np.ptp(record.input.values) == 0.0 and self.layout.initial_state:
            if data.count <= self.layout.size:
                raise DataError(f"{data.count} usable samples for {self.layout.size} parameters; take a longer record")
            return
        check_record(record, data, self.layout.size)

    def _lay_out(self, record: Record, periods: int = 0) -> FilterData:
        """Filter data; ``periods`` copies of the record's input come before it, with masked outputs."""
        if periods == 0:
            # At rest the input before the record is known to be zero, whatever the delay; otherwise it is not known.
            known_after = self.options.delay_bounds[1] if self.options.initial_state == "estimate" else 0.0
            return filter_data(record, known_after, self.options.hold_output)
        extended = _repeated(record, periods)
        return filter_data(extended, record.t[0] - extended.input.t[0], self.options.hold_output)

    def fit(self, start: Start | None = None) -> MeasuredFit:
        """Search and refine."""
        options = self.options
        low, high = options.delay_bounds
        searches = [self._search_levels, self._search_samples] if self._filtered else [self._search_samples]
        for search in searches:
            starts, profile = search()
            problem = OutputErrorProblem(self.data, self.layout, low, (low, high))
            history: list[IterationRecord] = []
            best: Iterated | None = None
            for delay, theta in starts:
                refined, steps = self._refine(problem, theta[: options.poles], delay)
                if refined is not None and (
                    best is None or refined.equations.squared_error < best.equations.squared_error
                ):
                    best, history = refined, steps
            if best is not None:
                return self._finish(problem, best, history, profile)
        raise DataError(Status.SINGULAR.value)

    @property
    def _filtered(self) -> bool:
        """Whether the search may look at filtered signals: what filters see must be the answer to the input alone."""
        options = self.options
        low, high = options.delay_bounds
        at_rest = options.initial_state == "rest" and options.offset != "estimate"
        return options.search != "samples" and at_rest and len(self.records) == 1 and low < high

    def _search_levels(self) -> tuple[list[tuple[float, Array]], Profile | None]:
        """Starts for the refinement, none if nothing can be computed, and the profile: behind low-pass filters."""
        cutoffs = self._cutoffs()
        costs = filtered_costs(
            self.records[0],
            [Lowpass(cutoff, LEVEL_ORDER) for cutoff in cutoffs],
            self.coefficients,
            self.options.delay_bounds,
            search="spectral" if self.options.search == "spectral" else "time",
            start=0.0,
            svf_cutoff=cutoffs,
            hold_output=self.options.hold_output,
            effort=LEVEL_EFFORT,
        )
        usable = [(cost, cutoff) for cost, cutoff in zip(costs, cutoffs, strict=True) if cost is not None]
        if costs[-1] is None:
            return [], None
        levels = [Level(cost, 0.5 * np.pi / cutoff) for cost, cutoff in usable]
        found = search_grid(levels, self.options.delay_bounds, FEWEST_DELAYS)
        first, cutoff = usable[0]
        profile = Profile(found.delays, found.costs * first.mean_factor, self.bandwidth, cutoff)
        starts = [(minimum.delay, minimum.theta) for minimum in found.minima]
        interval = self.data[0].interval
        if interval == 0.0:
            return starts, profile
        # On a regular clock the cost has a kink at every interval, and local minima between them that a model too small
        # for its system makes deep: every sample is asked about an eighth of a period around what the filters found.
        reach = max(interval, 0.25 * np.pi / self.bandwidth)
        parts = int(np.ceil(2.0 * reach / interval))
        centres = [(delay, theta[: self.options.poles]) for delay, theta in starts]
        starts = [start for centre in centres for start in self._local_grid([centre], reach, min(parts, FINEST), 1)]
        return starts, profile

    def _cutoffs(self) -> list[float]:
        """Cut-off frequencies of the levels of a search [rad/s], lowest first."""
        low, high = self.options.delay_bounds
        cutoffs = [self.bandwidth]
        while (high - low) * cutoffs[0] / (0.5 * np.pi) > MOST_FIRST_DELAYS and len(cutoffs) < MOST_LEVELS:
            cutoffs.insert(0, cutoffs[0] / LEVEL_RATIO)
        return cutoffs

    def _search_samples(self) -> tuple[list[tuple[float, Array]], Profile | None]:
        """Starts for the refinement, none if nothing can be computed, and the profile: from every sample."""
        delays = self._grid()
        candidates = self._scan(delays)
        costs = np.array([np.nan if c is None else c.equations.squared_error for c in candidates])
        if np.isnan(costs).all():
            return [], None
        if self.options.initial_state == "periodic":
            candidate = candidates[int(np.nanargmin(costs))]
            assert candidate is not None
            self._make_periodic(candidate.theta[: self.options.poles])
        count = sum(data.count for data in self.data)
        profile = Profile(delays, costs / count, self.bandwidth) if delays.size > 1 else None
        return self._closer_look(delays, candidates, costs), profile

    def squared_error_at(self, theta: Array, delay: float) -> float:
        """Least sum of squared output errors at a given delay, in the basin of an estimate."""
        layout = replace(self.layout, structure=replace(self.structure, delay=False))
        problem = OutputErrorProblem(self.data, layout, delay)
        result = self._iterated(problem, np.delete(theta, self.structure.size - 1))
        return float("nan") if result is None else result.equations.squared_error

    def squared_error_with(self, fit: MeasuredFit, *, initial_state: bool = False, offset: bool = False) -> float:
        """Least sum of squared output errors if an initial state or an offset were estimated too."""
        layout = replace(
            self.layout,
            initial_state=self.layout.initial_state or initial_state,
            offset=self.layout.offset or offset,
        )
        problem = OutputErrorProblem(self.data, layout, fit.model.delay, self.options.delay_bounds)
        shared = np.concatenate((fit.theta[: self.structure.size], np.zeros(layout.size - self.structure.size)))
        theta = problem.with_best_own(shared)
        result = None if theta is None else self._iterated(problem, theta)
        return float("nan") if result is None else result.equations.squared_error

    def errors_of(self, model: TransferFunction) -> AppliedModel:
        """Errors of a given model on these records, each with its own best initial state and offset."""
        if self.options.initial_state == "periodic":
            self._make_periodic(model.denominator[1:])
        layout = replace(self.layout, structure=replace(self.structure, delay=False))
        problem = OutputErrorProblem(self.data, layout, model.delay)
        b = np.concatenate((np.zeros(self.structure.zeros + 1 - model.numerator.size), model.numerator))
        own = np.zeros(layout.size - layout.structure.size)
        theta = problem.with_best_own(np.concatenate((model.denominator[1:], b, own)))
        parts = None if theta is None else problem.sensitivities(theta)
        if theta is None or parts is None:
            raise DataError("the record does not determine the initial state and the offset of a given model")
        estimated = [problem.own(theta, k) for k in range(len(self.data))]
        return AppliedModel(
            residuals=tuple(eps for _, eps in parts),
            used=self._used(problem),
            initial_states=tuple(state for state, _ in estimated),
            offsets=tuple(y0 + c for y0, (_, c) in zip(self.offsets, estimated, strict=True)),
        )

    def _iterated(
        self,
        problem: OutputErrorProblem,
        theta: Array,
        on_step: Callable[[Array, Equations], None] | None = None,
    ) -> Iterated | None:
        """Gauss-Newton with the options' tolerance."""
        return iterate(
            problem,
            theta,
            max_iterations=self.options.max_iterations,
            tolerance=self.options.tolerance,
            variant="guarded",
            on_step=on_step,
        )

    def _used(self, problem: OutputErrorProblem) -> tuple[BoolArray, ...]:
        """Which samples of each record enter the sums, without those of periods put before it."""
        return tuple(
            data.use[data.use.size - record.t.size :] for data, record in zip(problem.data, self.records, strict=True)
        )

    def _grid(self) -> Array:
        """Delays of the search: the spacing is at most a quarter period of the output's bandwidth."""
        low, high = self.options.delay_bounds
        if low == high:
            return np.array([low])
        wanted = int(np.ceil((high - low) * self.bandwidth / (0.5 * np.pi))) + 1
        return np.linspace(low, high, min(max(wanted, FEWEST_DELAYS), MOST_DELAYS))

    def _closer_look(self, delays: Array, candidates: list[Iterated | None], costs: Array) -> list[tuple[float, Array]]:
        """Delays and coefficients to refine: the local minima of a fine grid around those of the coarse one.

        Held inputs that change on the sampling clock put a kink into the cost at every sampling interval, and local
        minima between the kinks: the fine grid resolves a quarter of an interval.
        """
        chosen = [(float(delays[k]), candidates[k]) for k in local_minima(costs, MINIMA)]
        starts = [(delay, candidate.theta) for delay, candidate in chosen if candidate is not None]
        if delays.size == 1:
            return starts
        spacing = float(delays[1] - delays[0])
        interval = min(float(np.median(np.diff(record.t))) for record in self.records)
        parts = int(np.clip(np.ceil(4.0 * spacing / interval), 4, FINEST))
        centres = [(delay, theta[: self.options.poles]) for delay, theta in starts]
        return self._local_grid(centres, spacing, parts, MINIMA) or starts

    def _local_grid(
        self, centres: Sequence[tuple[float, Array]], reach: float, parts: int, most: int
    ) -> list[tuple[float, Array]]:
        """The lowest minima on fine grids of all samples around given delays and denominators (a_1 … a_n)."""
        low, high = self.options.delay_bounds
        fine: list[tuple[float, Iterated | None]] = []
        for centre, start in centres:
            for side in (-1, 1):
                a = start
                row: list[tuple[float, Iterated | None]] = []
                for part in range(0 if side > 0 else 1, parts + 1):
                    delay = centre + side * part * reach / parts
                    if low <= delay <= high:
                        result = self._coefficients(delay, a)
                        a = a if result is None else result.theta[: self.options.poles]
                        row.append((delay, result))
                fine += row if side > 0 else row[::-1]
        fine.sort(key=lambda entry: entry[0])
        errors = np.array([np.nan if r is None else r.equations.squared_error for _, r in fine])
        found = [fine[k] for k in local_minima(errors, most)]
        return [(delay, result.theta) for delay, result in found if result is not None]

    def _scan(self, delays: Array) -> list[Iterated | None]:
        """Coefficients at every delay of the grid, from least squares and from the neighbour's, the cheaper kept."""
        found: list[Iterated | None] = [None] * delays.size
        for order in (range(delays.size), range(delays.size - 1, -1, -1)):
            neighbour: Array | None = None
            for k in order:
                # The way back only hands good coefficients on to worse neighbours.
                starts = [] if neighbour is None else [neighbour]
                current = found[k]
                if current is None:
                    starts += self._least_squares(float(delays[k]), (1.0,) if delays.size > 1 else CUTOFFS)
                for a in starts:
                    result = self._coefficients(float(delays[k]), a)
                    if result is not None and (
                        current is None or result.equations.squared_error < current.equations.squared_error
                    ):
                        current = result
                found[k] = current
                neighbour = None if current is None else current.theta[: self.options.poles]
        return found

    def _least_squares(self, delay: float, cutoffs: Sequence[float]) -> list[Array]:
        """Denominators (a_1 … a_n) of least-squares starts; the output's mean is left to the offset."""
        structure = Structure(self.structure.poles, min(self.structure.zeros, self.structure.poles - 1))
        starts: list[Array] = []
        for cutoff in cutoffs:
            theta = least_squares_start(self._centred, structure, delay, cutoff * self.bandwidth)
            if theta is not None:
                starts.append(theta[: structure.poles])
        if not starts:
            # A system of the right speed, whatever the data say: a start for Gauss-Newton.
            starts.append(np.asarray(np.poly(np.full(structure.poles, -0.5 * self.bandwidth))[1:], dtype=float))
        return starts

    @cached_property
    def _centred(self) -> FilterData:
        """The first record without its means, for starts that know no offset and no initial state."""
        if self.options.offset != "estimate":
            return self.data[0]
        return self._lay_out(_without_means(self.records[0])[0])

    def _coefficients(self, delay: float, a: Array) -> Iterated | None:
        """Minimise the cost at a fixed delay."""
        fixed = self.coefficients
        problem: CoefficientProblem | OutputErrorProblem
        start: Array | None
        if self.layout.own == 0 and len(self.data) == 1 and fixed.zeros < fixed.poles:
            problem = _CoefficientSearch(self.data[0], fixed, delay)
            start = refit_numerator(self.data[0], fixed, np.concatenate((a, np.zeros(fixed.zeros + 1))), delay)
        else:
            problem = OutputErrorProblem(self.data, replace(self.layout, structure=fixed), delay)
            start = problem.linear_start(np.concatenate(([1.0], a)), delay)
        if start is None:
            return None
        return iterate(
            problem,
            start,
            max_iterations=GRID_ITERATIONS,
            tolerance=GRID_TOLERANCE,
            variant="guarded",
            halvings=GRID_HALVINGS,
        )

    def _refine(
        self, problem: OutputErrorProblem, a: Array, delay: float
    ) -> tuple[Iterated | None, list[IterationRecord]]:
        """Gauss-Newton on all parameters from one local minimum of the profile."""
        steps: list[IterationRecord] = []

        def record_step(theta: Array, equations: Equations) -> None:
            steps.append(history_entry("refine", len(steps), problem, theta, equations.squared_error / problem.count))

        theta = problem.linear_start(np.concatenate(([1.0], a)), delay)
        if theta is None:
            return None, steps
        result = self._iterated(problem, theta, record_step)
        if result is None or not self.structure.delay:
            return result, steps
        return self._mind_the_bounds(problem, result), steps

    def _mind_the_bounds(self, problem: OutputErrorProblem, result: Iterated) -> Iterated:
        """Move a delay that wants to leave its bounds onto the bound, and say so."""
        place = self.structure.size - 1
        reordered = np.r_[np.delete(np.arange(self.layout.size), place), place]
        equations = result.equations
        delay_last = replace(
            equations,
            hessian=equations.hessian[np.ix_(reordered, reordered)],
            instrument_error=equations.instrument_error[reordered],
        )
        bound = bound_in_the_way(delay_last, float(result.theta[place]), problem.bounds)
        if bound is None:
            return result
        fixed = OutputErrorProblem(
            self.data, replace(self.layout, structure=replace(self.structure, delay=False)), bound
        )
        there = self._iterated(fixed, np.delete(result.theta, place))
        if there is None or there.equations.squared_error > equations.squared_error:
            return result
        theta = np.insert(there.theta, place, bound)
        at_bound = problem.equations(theta)
        assert at_bound is not None
        return Iterated(theta, at_bound, Status.DELAY_AT_BOUND, result.iterations + there.iterations)

    def _make_periodic(self, a: Array) -> None:
        """Put enough periods before each record for the free response of a model (a_1 … a_n) to be gone."""
        model = TransferFunction([1.0], np.concatenate(([1.0], a)))
        slowest = float(np.abs(model.poles.real).min())
        for k, record in enumerate(self.records):
            period = _period(record)
            periods = int(np.ceil(SETTLING / (slowest * period))) if slowest > 0 else MOST_PERIODS
            self.data[k] = self._lay_out(record, min(max(periods, 1), MOST_PERIODS))

    def _finish(
        self, problem: OutputErrorProblem, result: Iterated, history: list[IterationRecord], profile: Profile | None
    ) -> MeasuredFit:
        a, b, delay = problem.split(result.theta)
        parts = problem.sensitivities(result.theta)
        assert parts is not None
        hessian, squared_error, count = result.equations.hessian, result.equations.squared_error, problem.count
        covariance = np.full((self.layout.size, self.layout.size), np.nan)
        free = np.arange(self.layout.size)
        if result.status is Status.DELAY_AT_BOUND:
            free = np.delete(free, self.structure.size - 1)
        covariance[np.ix_(free, free)] = white_noise_covariance(hessian[np.ix_(free, free)], squared_error, count)
        status = result.status
        if status is Status.CONVERGED and np.isnan(covariance).any():
            status = Status.SINGULAR
        outputs = np.concatenate([data.y_used - data.y_used.mean() for data in problem.data])
        r2 = 1.0 - squared_error / float(outputs @ outputs)
        estimated = [problem.own(result.theta, k) for k in range(len(self.data))]
        return MeasuredFit(
            model=TransferFunction(b, a, delay),
            parameter_names=self.layout.names,
            covariance=covariance,
            status=status,
            cost=squared_error / count,
            fit_percent=percent_from_r_squared(r2),
            r2=r2,
            count=count,
            iterations=result.iterations,
            condition_number=condition_number(hessian),
            history=tuple(history),
            theta=result.theta,
            initial_states=tuple(state for state, _ in estimated),
            offsets=tuple(y0 + c for y0, (_, c) in zip(self.offsets, estimated, strict=True)),
            input_offsets=tuple(self.input_offsets),
            profile=profile,
            residuals=tuple(eps for _, eps in parts),
            sensitivities=tuple(psi for psi, _ in parts),
            used=self._used(problem),
        )


def _without_means(record: Record) -> tuple[Record, float, float]:
    """Record less the mean of its output samples and the time average of its input."""
    y0 = float(np.nanmean(record.y))
    signal = record.input
    u0 = float(np.mean(signal.at(record.t)))
    centred = Record(record.t, record.y - y0, HeldSignal(signal.t, signal.values - u0, signal.hold), name=record.name)
    return centred, u0, y0


def _period(record: Record) -> float:
    """Period of a record that repeats: its duration and one more interval."""
    return record.duration + (record.interval or float(np.median(np.diff(record.t))))


def _repeated(record: Record, periods: int) -> Record:
    """Record with copies of its input before it and no outputs there."""
    period = _period(record)
    shifts = period * np.arange(-periods, 1)
    t = (record.t + shifts[:, None]).ravel()
    y = np.concatenate([np.full(periods * record.n_samples, np.nan), record.y])
    signal = record.input
    inside = signal.t < signal.t[0] + period * (1 - 1e-9)
    tu = (signal.t[inside] + shifts[:, None]).ravel()
    u = np.tile(signal.values[inside], periods + 1)
    return Record(t, y, HeldSignal(tu, u, signal.hold), name=record.name)


__all__ = ["AppliedModel", "DelayProfile", "MeasuredFit", "PreparedProfile", "Profile"]
