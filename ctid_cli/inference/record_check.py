"""What a record is worth for identification, in numbers."""

import math
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.inference.input_response import DelayHint, InputResponse, analyse_response
from ctid_cli.inference.record_facts import LONG_INTERVAL, Gap, excitation_order
from ctid_cli.inference.signal_features import InputMoves, input_moves, outliers, quantum, saturated
from ctid_cli.signals.record import Record

Level = Literal["ok", "note", "warning", "problem"]
#: Whether the output moves before it can respond to what happens in the record.
Start = Literal["flat", "moving", "unknown"]
#: From the best to the worst.
LEVELS: tuple[Level, ...] = ("ok", "note", "warning", "problem")
#: A mean counts as an offset above this fraction of the standard deviation.
OFFSET = 0.3
#: Below this order no model with a delay can be told from one without.
ENOUGH_ORDER = 4
#: A trend is one above this many standard errors.
SIGNIFICANT = 4.0


@dataclass(frozen=True)
class Finding:
    """One thing that a user should know of a record."""

    level: Level
    topic: str
    sentence: str


@dataclass(frozen=True)
class RecordReport:
    """Numbers and findings of one record; nan stands for what the record does not show."""

    name: str
    n_samples: int
    n_masked: int
    #: First instant, and time to the last one [s].
    start: float
    duration: float
    #: Median, shortest and longest sampling interval, and the standard deviation of all but the gaps [s].
    interval: float
    interval_min: float
    interval_max: float
    interval_deviation: float
    regular: bool
    gaps: tuple[Gap, ...]
    #: Half the sampling frequency at the median interval [rad/s].
    nyquist: float
    input_kind: str
    #: Mean, standard deviation, least and greatest value of the input during the record [input unit].
    input_mean: float
    input_deviation: float
    input_low: float
    input_high: float
    #: Values that the input returns to [input unit]; empty where there are many.
    input_levels: tuple[float, ...]
    input_changes: int
    #: Shortest time between two changes [s].
    shortest_hold: float
    #: Time after which the input repeats itself [s].
    input_period: float
    #: Order of persistent excitation, counted up to 50 [-].
    excitation_order: int
    #: Frequencies between which 95 % of the power of the input lies [rad/s].
    input_band: tuple[float, float]
    #: Mean, standard deviation, least and greatest value of the output [output unit].
    output_mean: float
    output_deviation: float
    output_low: float
    output_high: float
    #: Slope of the straight line through the output and its standard error [output unit/s].
    output_trend: float
    output_trend_error: float
    #: Step in which the output was recorded [output unit]; nan where it is too fine to matter.
    output_quantum: float
    #: Instants of single output samples far from their neighbours [s].
    outliers: tuple[float, ...]
    #: Fraction of the output samples that sit exactly at its least or greatest value in runs [-]; 0 for none.
    saturated: float
    #: Fraction of the output's variance that follows the input linearly [-].
    explained: float
    #: The same as a signal-to-noise ratio [dB].
    snr_db: float
    #: Frequency below which 95 % of the response to the input lies [rad/s].
    output_bandwidth: float
    #: Highest frequency at which the response is seen [rad/s].
    visible_up_to: float
    #: The output begins to respond between these times after a change of the input [s].
    delay_early: float
    delay_late: float
    starts: Start
    #: Range to search for the delay [s].
    suggested_delay: tuple[float, float] | None
    suggested_offset: Literal["none", "remove", "estimate"]
    suggested_initial_state: Literal["rest", "estimate"]
    #: Probability that noise of the output's colour follows the input as much as the output does [-]; nan where that
    #: cannot be tested.
    answer_p_value: float = math.nan
    findings: tuple[Finding, ...] = ()

    @property
    def worst(self) -> Level:
        """Level of the worst finding."""
        return max((finding.level for finding in self.findings), key=LEVELS.index, default="ok")


@dataclass(frozen=True)
class Examined:
    """A record with all that was found out about it."""

    record: Record
    moves: InputMoves
    answer: InputResponse
    report: RecordReport


def examine(record: Record) -> Examined:
    """Numbers of a record; an input that excites fewer than four parameters shows no delay."""
    moves = input_moves(record)
    answer = analyse_response(record, moves)
    order = excitation_order(record, moves, answer)
    if order < ENOUGH_ORDER and moves.kind != "steps":
        # A sine that comes later and one that is filtered look the same.
        answer = replace(answer, delay=None)
    t, y = record.t, record.y
    present, delay = y[record.valid], answer.delay or DelayHint(math.nan, math.nan, math.nan)
    steps = np.diff(t) if t.size > 1 else np.array([math.nan])
    interval = float(np.median(steps))
    long = np.flatnonzero(steps > LONG_INTERVAL * interval)
    deviation = float(present.std())
    slope, error, mean_error = _trend(t[record.valid], present)
    explained = min(answer.explained, 1 - 1e-9) if answer.explained > 0 else math.nan
    starts = _start(record, answer, deviation, explained)
    seldom = moves.kind in ("constant", "steps")
    certain = seldom or not abs(present.mean()) < SIGNIFICANT * mean_error
    offset = abs(present.mean()) > OFFSET * deviation and deviation > 0 and certain
    report = RecordReport(
        name=record.name,
        n_samples=record.n_samples,
        n_masked=int(np.count_nonzero(~record.valid)),
        start=float(t[0]),
        duration=record.duration,
        interval=interval,
        interval_min=float(steps.min()),
        interval_max=float(steps.max()),
        interval_deviation=float(steps[steps <= LONG_INTERVAL * interval].std()) if t.size > 1 else math.nan,
        regular=record.interval is not None,
        gaps=tuple(Gap(float(t[k]), float(steps[k])) for k in long),
        nyquist=math.pi / interval,
        input_kind=moves.kind,
        input_levels=moves.levels,
        input_changes=int(moves.changes.size),
        shortest_hold=moves.shortest_hold,
        input_period=answer.period,
        excitation_order=order,
        input_band=answer.input_band,
        output_trend=slope,
        output_trend_error=error,
        output_quantum=quantum(present),
        outliers=tuple(t[record.valid][outliers(present)].tolist()),
        saturated=saturated(present),
        explained=explained,
        snr_db=10 * math.log10(explained / (1 - explained)),
        output_bandwidth=answer.bandwidth,
        visible_up_to=answer.visible_up_to,
        delay_early=delay.early,
        delay_late=delay.late,
        starts=starts,
        suggested_delay=(0.0, _round_up(max(2 * delay.late, 4 / answer.bandwidth))) if answer.delay else None,
        suggested_offset="none" if not offset else "estimate" if seldom else "remove",
        suggested_initial_state="estimate" if starts == "moving" else "rest",
        **_range("input", record.input.at(t)),
        **_range("output", present),
    )
    return Examined(record, moves, answer, report)


def _range(signal: str, x: Array) -> dict[str, Any]:
    """Fields of a report on the values of a signal."""
    values = {"mean": x.mean(), "deviation": x.std(), "low": x.min(), "high": x.max()}
    return {f"{signal}_{name}": float(value) for name, value in values.items()}


def _trend(t: Array, y: Array) -> tuple[float, float, float]:
    """Slope of the straight line through the samples, and the standard errors of slope and mean.

    They allow for the correlation of the residuals, as seen in the order of the samples.
    """
    if y.size < 8:
        return math.nan, math.nan, math.nan
    time = t - t.mean()
    slope = float(time @ (y - y.mean()) / (time @ time))
    rest = y - y.mean() - slope * time
    variance = float(rest @ rest) / (y.size - 2)
    if variance <= 1e-24 * float(y @ y):
        return slope, 0.0, 0.0
    n = 1 << (2 * y.size - 1).bit_length()
    r = np.fft.irfft(np.abs(np.fft.rfft(rest, n)) ** 2, n)[: y.size // 4] / float(rest @ rest)
    # Summing beyond the first zero adds noise and no correlation.
    end = int(np.argmax(r < 0)) or r.size
    inflated = variance * (1 + 2 * float(r[1:end].sum()))
    return slope, math.sqrt(inflated / float(time @ time)), math.sqrt(inflated / y.size)


def _start(
    record: Record, answer: InputResponse, deviation: float, explained: float
) -> Literal["flat", "moving", "unknown"]:
    """Whether the output moves before it can respond to what happens in the record."""
    t, y = record.t[record.valid], record.y[record.valid]
    if answer.delay is None or deviation == 0.0 or not (explained > 0 or math.isnan(answer.explained)):
        return "unknown"
    before = t - t[0] <= answer.delay.early
    if np.count_nonzero(before) < 8:
        return "unknown"
    noise = math.sqrt(1 - explained) * deviation if explained > 0 else math.sqrt(np.mean(np.diff(y) ** 2) / 2)
    moved = float(y[before].std())
    # What is not explained is an upper bound of the noise, so what exceeds it by far is motion.
    return "moving" if moved > 2.5 * noise and moved > 0.25 * deviation else "flat"


def _round_up(x: float) -> float:
    """The next larger of 1, 2, 5 times a power of ten."""
    if not x > 0:
        return math.nan
    scale = 10.0 ** math.floor(math.log10(x))
    factor = next(f for f in (1, 2, 5, 10) if f * scale >= x * (1 - 1e-9))
    return float(f"{factor * scale:.12g}")
