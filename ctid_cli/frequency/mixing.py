"""Front end of dynamic regressor extension and mixing (DREM), and the loop that all its back ends share.

A sample goes through the delays into a row of the regression, n rows into the scalar regressions
``Psi_k = Delta theta_k``, those into a back end, which estimates theta, and theta into frequencies and flags.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numba.extending import overload

from ctid_cli.arrays import Array, IntArray
from ctid_cli.frequency.consistency import DETECTOR_SPAN, USUAL_SPANS, check_consistency, contradicts
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
from ctid_cli.frequency.moments import accumulate_row
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


def absorb(scale: float, count: int, tuning: Any, back: Any, theta: Array, mixed: Array) -> tuple[float, float]:
    """A back end takes in ``[Psi Delta]`` and estimates theta; weight of its data, and how many rows it rests on.

    ``scale`` is the product of the lengths of the rows, NaN if they cannot be used.
    """
    raise NotImplementedError


def weigh(tuning: Any, back: Any, theta: Array, errors: Array) -> tuple[float, float]:
    """A back end says how wrong theta may be: errors, rounding relative to theta, and rows that count."""
    raise NotImplementedError


def back_end(state: type, absorbing: Callable[..., Any], weighing: Callable[..., Any]) -> None:
    """Let the loop find the kernels of a back end by the type of its state."""

    @overload(absorb, jit_options={"forceinline": True}, strict=False)
    def choose_absorb(scale: Any, count: Any, tuning: Any, back: Any, theta: Any, mixed: Any) -> Any:
        return absorbing.py_func if back.instance_class is state else None  # type: ignore[attr-defined]

    @overload(weigh, strict=False)
    def choose_weigh(tuning: Any, back: Any, theta: Any, errors: Any) -> Any:
        return weighing.py_func if back.instance_class is state else None  # type: ignore[attr-defined]


@njit(cache=True, nogil=True, forceinline=True)
def judge_mixed(
    front: Front,
    omega: Array,
    relative: float,
    span: float,
    elapsed: float,
    clock: DelayClock,
    errors: Array,
    memory: Decoding,
) -> int:
    """What may be wrong with the frequencies, and the flags that follow."""
    # theta is wrong by at most its errors, and by rounding in Delta and Psi; the decoding multiplies both.
    cosine_sensitivities(memory.roots, clock.delay, memory.slopes, memory.sensitivities)
    propagate(memory.sensitivities, errors, front.possible_errors)
    for i in range(omega.size):
        errors[i] = (1.0 + abs(front.theta[i])) * relative
    propagate(memory.sensitivities, errors, memory.rounding)
    flag = flag_uncertain(omega, front.possible_errors, memory.rounding, span, elapsed)
    return flag | check_consistency(front.check, omega, clock.second_delay, NEGLIGIBLE)


@njit(cache=True, nogil=True)
def advance_mixed(
    samples: Array, output: Output, clock: DelayClock, mixing: Mixing, tuning: Any, front: Front, back: Any
) -> None:
    """Delays, mixing, a back end, decoding and verdict, sample by sample."""
    # Arrays are taken out of their tuples once: in the loop, each would cost two counts of its references.
    omegas, uncertainty, flags = output
    history, rows, theta, check, counters, doubts, levels, possible_errors = front
    table, plan, n = clock.table, mixing.plan, omegas.shape[1]
    row, matrix, minors, mixed = np.empty(n + 1), np.empty((n, n + 1)), np.empty(2 ** (n + 1)), np.empty(n + 1)
    errors, memory = np.empty(n), decoding_memory(n)
    roots, polynomial, quotient = memory.roots, memory.polynomial, memory.quotient
    # The check at the second delay, the newest residuals and the usual ones forget over different times.
    keep = 1.0 - clock.every / (CHECK_SPANS * n * clock.lag)
    fast, slow = 1.0 / max(1.0, DETECTOR_SPAN * clock.lag), 1.0 / (USUAL_SPANS * n * clock.lag)
    # How far the rows of one mixed regression reach back [samples].
    reach = rows.shape[0] + 2 * n * clock.lag
    for k in range(samples.size):
        counters[PLACE] = following(counters[PLACE], history.size)
        counters[ROW] = following(counters[ROW], rows.shape[0])
        history[counters[PLACE]] = samples[k]
        # The second delay comes first: it leaves its own row behind.
        checked = counters[PLACE] % clock.every == 0 and clock.second_lag > 0
        if checked and form_row(history, counters[PLACE], clock.second_lag, table, row):
            accumulate_row(row, check, keep)
        form_row(history, counters[PLACE], clock.lag, table, row)
        for i in range(n + 1):
            rows[counters[ROW], i] = row[i]
        scale = mix_rows(rows, counters[ROW], mixing.first_row, mixing.spacing, plan, matrix, minors, mixed)
        scale *= mixing.normalisation
        for i in range(n + 1):
            mixed[i] *= mixing.normalisation
        # A missing sample makes a row and all its minors NaN; squares beyond the largest number are of no use either.
        flag = 0
        if np.isfinite(scale * scale) and np.isfinite(mixed[n] * mixed[n]):
            counters[USED] += 1
        else:
            scale = np.nan
            flag = GAP if counters[USED] > 0 else STARTING
        weight, used = absorb(scale, counters[USED], tuning, back, theta, mixed)
        started = used >= mixing.enough
        if not started:
            flag |= STARTING
        # Initial frequencies are shown as well, though nothing bears them out.
        omega = omegas[k]
        if weight > 0.0 or np.isfinite(theta[0]):
            flag |= decode(theta, clock.delay, clock.bottom, clock.top, polynomial, quotient, roots, omega)
        else:
            omega[:] = np.nan
        if weight > 0.0:
            # A residual unlike the ones before is doubted at once; otherwise a verdict is given now and then.
            contradicted = started and contradicts(row, theta, levels, fast, slow)
            if doubts[SINCE_VERDICT] == 0 or contradicted:
                relative, remembered = weigh(tuning, back, theta, errors)
                span, elapsed = (reach + remembered) * clock.interval, (reach + counters[USED]) * clock.interval
                verdict = judge_mixed(front, omega, relative, span, elapsed, clock, errors, memory)
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
                uncertainty[k, i] = possible_errors[i]
        else:
            uncertainty[k, :] = np.nan
            if counters[USED] > 0:
                flag |= UNDETERMINED
        flags[k] = flag | doubts[VERDICT]
