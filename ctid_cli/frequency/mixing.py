"""Front end of dynamic regressor extension and mixing (DREM), and the loop that all its back ends share.

A sample goes through the delays into a row of the regression, n rows into the scalar regressions
``Psi_k = Delta theta_k``, those into a back end, which estimates theta, and theta into frequencies and flags.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numba.extending import overload

from ctid_cli.arrays import Array, IntArray
from ctid_cli.frequency.consistency import (
    DETECTOR_SPAN,
    USUAL_SPANS,
    check_consistency,
    contradicts,
    observe_second_delay,
)
from ctid_cli.frequency.decoding import (
    Decoding,
    cosine_sensitivities,
    decode,
    decoding_memory,
    flag_uncertain,
    propagate,
    still_doubtful,
)
from ctid_cli.frequency.delay_options import DelayClock, DelayRegression
from ctid_cli.frequency.flags import GAP, STARTING, UNCERTAIN, UNDETERMINED
from ctid_cli.frequency.regression import following, form_row, minor_plan, mix_rows, whole_delay
from ctid_cli.frequency.tracking import Output, Recursion
from ctid_cli.signals.checks import require_integer, require_positive

#: A mixed regression may be wrong by this fraction of the product of its rows' lengths.
MIXING_ROUNDING = 1e-15
#: The check at the second delay forgets over so many times n h.
CHECK_SPANS = 4
#: Samples since an event that never happened.
LONG_AGO = 1 << 50
#: Fraction of the regressand's second moment that the frequencies may leave at the second delay.
NEGLIGIBLE = 1e-4


class Mixing(NamedTuple):
    """How rows become scalar regressions."""

    #: Order in which the minors are built up, shape (m, 5).
    plan: IntArray
    first_row: int
    #: Distance of the stacked rows [samples].
    spacing: int
    #: Factor ``eps^p`` of Delta and Psi.
    normalisation: float
    #: Rows that an estimate needs before it can be valid.
    enough: int


class Front(NamedTuple):
    """State of the front end."""

    #: Ring of samples, shape (2 n lag + 1,).
    samples: Array
    #: Ring of regression rows ``[phi psi]``, shape (r, n + 1).
    rows: Array
    #: What the back end estimates, shape (n,).
    theta: Array
    #: Second moments of the rows at the second delay.
    check: Array
    #: Places of the newest sample and of the newest row; mixed regressions that could be used so far.
    counters: IntArray
    #: Samples since the last verdict, the verdict (flags), samples since the last doubt.
    doubts: IntArray
    #: Averages of :func:`contradicts`.
    levels: Array
    #: Of the last verdict [rad/s], shape (n,).
    possible_errors: Array


class Work(NamedTuple):
    """Memory for one sample."""

    row: Array
    matrix: Array
    minors: Array
    #: Psi and Delta, shape (n + 1,).
    mixed: Array
    #: What the scalar regressions say may be wrong with theta, shape (n,).
    errors: Array
    decoding: Decoding


PLACE, ROW, USED = range(3)
SINCE_VERDICT, VERDICT, QUIET = range(3)


@dataclass(frozen=True, kw_only=True)
class MixingOptions(DelayRegression):
    """Options of an estimator on the mixed regressions."""

    d: float
    first_row: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive("d", self.d, "s")
        require_integer("first_row", self.first_row, 0, 1000)

    def _mixed(
        self,
        clock: DelayClock,
        back: Any,
        theta: Array,
        *,
        tuning: Any = None,
        normalisation: float = 1.0,
        past: float = np.nan,
        most_rows: int = LONG_AGO,
    ) -> Recursion:
        """The recursion of a back end, given its state, the first theta and its settings."""
        n, interval = self.tones, clock.interval
        spacing = whole_delay("d", self.d, interval)
        enough = min(self._rows_before_valid(clock), most_rows)
        samples = np.full(2 * n * clock.lag + 1, past)
        rows = np.full(((self.first_row + n - 1) * spacing + 1, n + 1), past)
        check, counters, doubts = np.zeros((n + 1, n + 1)), np.zeros(3, np.int64), np.array([0, 0, LONG_AGO], np.int64)
        front = Front(samples, rows, theta.copy(), check, counters, doubts, np.zeros(4), np.full(n, np.nan))
        settings = (clock, Mixing(minor_plan(n), self.first_row, spacing, normalisation, enough), tuning)
        return Recursion(advance_mixed, settings, (front, back), self._weights(interval), past, self._notes(clock))


def absorb(scale: float, count: int, tuning: Any, back: Any, theta: Array, work: Work) -> tuple[float, float]:
    """A back end takes in ``work.mixed`` and estimates theta; weight of its data, and how many rows it rests on.

    ``scale`` is the product of the lengths of the rows, NaN if they cannot be used.
    """
    raise NotImplementedError


def weigh(tuning: Any, back: Any, theta: Array, work: Work) -> tuple[float, float]:
    """A back end says how wrong theta may be: ``work.errors``, rounding relative to theta, and rows that count."""
    raise NotImplementedError


def back_end(state: type, absorbing: Callable[..., Any], weighing: Callable[..., Any]) -> None:
    """Let the loop find the kernels of a back end by the type of its state."""

    @overload(absorb, strict=False)
    def choose_absorb(scale: Any, count: Any, tuning: Any, back: Any, theta: Any, work: Any) -> Any:
        return absorbing.py_func if back.instance_class is state else None  # type: ignore[attr-defined]

    @overload(weigh, strict=False)
    def choose_weigh(tuning: Any, back: Any, theta: Any, work: Any) -> Any:
        return weighing.py_func if back.instance_class is state else None  # type: ignore[attr-defined]


@njit(cache=True, nogil=True)
def mix_next(sample: float, keep: float, clock: DelayClock, mixing: Mixing, front: Front, work: Work) -> float:
    """Scalar regressions at the newest sample, in ``work.mixed``; their scale, NaN if they cannot be used."""
    counters, mixed = front.counters, work.mixed
    counters[PLACE] = following(counters[PLACE], front.samples.size)
    counters[ROW] = following(counters[ROW], front.rows.shape[0])
    front.samples[counters[PLACE]] = sample
    # The second delay comes first: it leaves its own row in work.row.
    if counters[PLACE] % clock.every == 0:
        observe_second_delay(front.samples, counters[PLACE], clock.second_lag, clock.table, work.row, front.check, keep)
    form_row(front.samples, counters[PLACE], clock.lag, clock.table, work.row)
    for i in range(mixed.size):
        front.rows[counters[ROW], i] = work.row[i]
    scale = mixing.normalisation * mix_rows(
        front.rows, counters[ROW], mixing.first_row, mixing.spacing, mixing.plan, work.matrix, work.minors, mixed
    )
    for i in range(mixed.size):
        mixed[i] *= mixing.normalisation
    # A missing sample makes a row and all its minors NaN; squares beyond the largest number are of no use either.
    delta = mixed[mixed.size - 1]
    if not (np.isfinite(scale * scale) and np.isfinite(delta * delta)):
        return np.nan
    counters[USED] += 1
    return scale


@njit(cache=True, nogil=True)
def judge_mixed(
    omega: Array, relative: float, span: float, elapsed: float, clock: DelayClock, front: Front, work: Work
) -> int:
    """What may be wrong with the frequencies: ``front.possible_errors``, and the flags that follow."""
    # theta is wrong by at most work.errors, and by rounding in Delta and Psi; the decoding multiplies both.
    memory = work.decoding
    cosine_sensitivities(memory.roots, clock.delay, memory.slopes, memory.sensitivities)
    propagate(memory.sensitivities, work.errors, front.possible_errors)
    for i in range(omega.size):
        work.errors[i] = (1.0 + abs(front.theta[i])) * relative
    propagate(memory.sensitivities, work.errors, memory.rounding)
    flag = flag_uncertain(omega, front.possible_errors, memory.rounding, span, elapsed)
    return flag | check_consistency(front.check, omega, clock.second_delay, NEGLIGIBLE)


@njit(cache=True, nogil=True)
def advance_mixed(
    samples: Array, output: Output, clock: DelayClock, mixing: Mixing, tuning: Any, front: Front, back: Any
) -> None:
    """Delays, mixing, a back end, decoding and verdict, sample by sample."""
    n = output.omega.shape[1]
    row, matrix, minors, mixed = np.empty(n + 1), np.empty((n, n + 1)), np.empty(2 ** (n + 1)), np.empty(n + 1)
    work = Work(row, matrix, minors, mixed, np.empty(n), decoding_memory(n))
    theta, counters, doubts = front.theta, front.counters, front.doubts
    # The check at the second delay, the newest residuals and the usual ones forget over different times.
    keep = 1.0 - clock.every / (CHECK_SPANS * n * clock.lag)
    fast, slow = 1.0 / max(1.0, DETECTOR_SPAN * clock.lag), 1.0 / (USUAL_SPANS * n * clock.lag)
    # How far the rows of one mixed regression reach back [samples].
    reach = front.rows.shape[0] + 2 * n * clock.lag
    for k in range(samples.size):
        scale = mix_next(samples[k], keep, clock, mixing, front, work)
        flag = 0
        if np.isnan(scale):
            flag = GAP if counters[USED] > 0 else STARTING
        weight, rows = absorb(scale, counters[USED], tuning, back, theta, work)
        started = rows >= mixing.enough
        if not started:
            flag |= STARTING
        # Initial frequencies are shown as well, though nothing bears them out.
        omega = output.omega[k]
        if weight > 0.0 or np.isfinite(theta[0]):
            flag |= decode(theta, clock.delay, clock.bottom, clock.top, work.decoding, omega)
        else:
            omega[:] = np.nan
        if weight > 0.0:
            # A residual unlike the ones before is doubted at once; otherwise a verdict is given now and then.
            contradicted = started and contradicts(row, theta, front.levels, fast, slow)
            if doubts[SINCE_VERDICT] == 0 or contradicted:
                relative, remembered = weigh(tuning, back, theta, work)
                span, elapsed = (reach + remembered) * clock.interval, (reach + counters[USED]) * clock.interval
                verdict = judge_mixed(omega, relative, span, elapsed, clock, front, work)
                if verdict & UNCERTAIN or contradicted:
                    verdict |= UNCERTAIN
                    if started:
                        doubts[QUIET] = 0
                elif still_doubtful(omega, doubts[QUIET] * clock.interval):
                    verdict |= UNCERTAIN
                doubts[VERDICT] = verdict
            doubts[SINCE_VERDICT] = (doubts[SINCE_VERDICT] + 1) % clock.every if started else 0
            doubts[QUIET] += 1
            for i in range(n):
                output.uncertainty[k, i] = front.possible_errors[i]
        else:
            output.uncertainty[k, :] = np.nan
            if counters[USED] > 0:
                flag |= UNDETERMINED
        output.flags[k] = flag | doubts[VERDICT]
