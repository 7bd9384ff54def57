"""What a record is worth for identification, in numbers and in sentences."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.inference.answer import Answer, analyse_answer, output_bandwidth, regular_grid
from ctid_cli.inference.faults import outliers, quantum, saturated
from ctid_cli.inference.input_moves import InputMoves, input_moves
from ctid_cli.signals.record import Record

__all__ = ["Finding", "Gap", "RecordReport", "check_record_quality", "output_bandwidth"]

Level = Literal["ok", "note", "warning", "problem"]

#: From the best to the worst.
LEVELS: tuple[Level, ...] = ("ok", "note", "warning", "problem")
#: An interval longer than this many median intervals is a gap.
GAP = 3.0
#: An irregular clock is regular but for jitter where the standard deviation of its intervals is below this fraction.
JITTER = 0.05
#: A mean counts as an offset above this fraction of the standard deviation.
OFFSET = 0.3
#: Fewer samples than this leave little for the noise to average out over.
FEW_SAMPLES = 50
#: Fewer samples than this in a period of the fastest part of the answer leave much to the assumed hold.
FEW_PER_PERIOD = 2.5
#: Persistence of excitation is counted up to this order.
HIGHEST_ORDER = 50
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
class Gap:
    """An interval without samples."""

    #: Last instant before it [s].
    start: float
    #: Time to the next sample [s].
    length: float


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
    #: Frequency below which 95 % of the answer to the input lies [rad/s].
    output_bandwidth: float
    #: Highest frequency at which the answer is seen [rad/s].
    visible_up_to: float
    #: The output begins to answer between these times after a change of the input [s].
    delay_early: float
    delay_late: float
    starts: Literal["flat", "moving", "unknown"]
    #: Range to search for the delay [s].
    suggested_delay: tuple[float, float] | None
    suggested_offset: Literal["none", "remove", "estimate"]
    suggested_initial_state: Literal["rest", "estimate"]
    findings: tuple[Finding, ...] = ()

    @property
    def worst(self) -> Level:
        """Level of the worst finding."""
        return max((finding.level for finding in self.findings), key=LEVELS.index, default="ok")


def check_record_quality(
    record: Record, *, time_unit: str = "s", input_unit: str = "", output_unit: str = ""
) -> RecordReport:
    """Look for everything in a record that helps or hinders identification.

    The findings rest on spectra, correlations and order statistics, never on a model, so they hold whatever model
    is fitted later; a hint is not an estimate.
    """
    moves = input_moves(record)
    answer = analyse_answer(record, moves)
    order = _excitation_order(record, moves, answer)
    if order < ENOUGH_ORDER and moves.kind != "steps":
        # A sine that comes later and one that is filtered look the same.
        answer = replace(answer, delay=None)
    report = _numbers(record, moves, answer, order)
    findings = _Words(record, report, moves, answer, _Units(time_unit, input_unit, output_unit)).findings()
    worst_first = sorted(findings, key=lambda finding: -LEVELS.index(finding.level))
    return replace(report, findings=tuple(worst_first))


# --- numbers ---------------------------------------------------------------------------------------


def _numbers(record: Record, moves: InputMoves, answer: Answer, order: int) -> RecordReport:
    t, y = record.t, record.y
    present = y[record.valid]
    steps = np.diff(t) if t.size > 1 else np.array([math.nan])
    interval = float(np.median(steps))
    long = np.flatnonzero(steps > GAP * interval)
    u = record.input.at(t)
    deviation = float(present.std())
    slope, error, mean_error = _trend(t[record.valid], present)
    explained = min(answer.explained, 1 - 1e-9) if answer.explained > 0 else math.nan
    starts = _start(record, answer, deviation, explained)
    seldom = moves.kind in ("constant", "steps")
    offset: Literal["none", "remove", "estimate"] = "none"
    certain = seldom or not abs(present.mean()) < SIGNIFICANT * mean_error
    if abs(present.mean()) > OFFSET * deviation and deviation > 0 and certain:
        offset = "estimate" if seldom else "remove"
    return RecordReport(
        name=record.name,
        n_samples=record.n_samples,
        n_masked=int(np.count_nonzero(~record.valid)),
        start=float(t[0]),
        duration=record.duration,
        interval=interval,
        interval_min=float(steps.min()),
        interval_max=float(steps.max()),
        interval_deviation=float(steps[steps <= GAP * interval].std()) if t.size > 1 else math.nan,
        regular=record.interval is not None,
        gaps=tuple(Gap(float(t[k]), float(steps[k])) for k in long),
        nyquist=math.pi / interval,
        input_kind=moves.kind,
        input_mean=float(u.mean()),
        input_deviation=float(u.std()),
        input_low=float(u.min()),
        input_high=float(u.max()),
        input_levels=moves.levels,
        input_changes=int(moves.changes.size),
        shortest_hold=moves.shortest_hold,
        input_period=answer.period,
        excitation_order=order,
        input_band=answer.input_band,
        output_mean=float(present.mean()),
        output_deviation=deviation,
        output_low=float(present.min()),
        output_high=float(present.max()),
        output_trend=slope,
        output_trend_error=error,
        output_quantum=quantum(present),
        outliers=tuple(float(x) for x in t[record.valid][outliers(present)]),
        saturated=saturated(present),
        explained=explained,
        snr_db=10 * math.log10(explained / (1 - explained)) if explained > 0 else math.nan,
        output_bandwidth=answer.bandwidth,
        visible_up_to=answer.visible_up_to,
        delay_early=answer.delay.early if answer.delay else math.nan,
        delay_late=answer.delay.late if answer.delay else math.nan,
        starts=starts,
        suggested_delay=(0.0, _round_up(max(2 * answer.delay.late, 4 / answer.bandwidth))) if answer.delay else None,
        suggested_offset=offset,
        suggested_initial_state="estimate" if starts == "moving" else "rest",
    )


def _excitation_order(record: Record, moves: InputMoves, answer: Answer) -> int:
    """Rank of the autocovariance of the input, at most 50; directions 40 dB below the strongest do not count."""
    grid = regular_grid(record)
    u = record.input.at(record.t[0] + grid.interval * (np.arange(grid.u.size) + 1e-6))
    highest = answer.input_band[1]
    if moves.kind == "continuous" and highest > 0:
        # Of a slow input, neighbouring samples are all alike: look at it as fast as it moves.
        u = u[:: max(1, int(math.pi / (1.5 * highest * grid.interval)))]
    order = min(HIGHEST_ORDER, u.size // 3)
    if order < 1 or moves.kind == "constant":
        return 0
    past = np.lib.stride_tricks.sliding_window_view(u, order)[:: max(1, u.size // 20_000)]
    past = past - past.mean(axis=0)
    strength = np.linalg.eigvalsh(past.T @ past)
    return int(np.count_nonzero(strength > 1e-4 * strength[-1]))


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


def _start(record: Record, answer: Answer, deviation: float, explained: float) -> Literal["flat", "moving", "unknown"]:
    """Whether the output moves before it can answer to what happens in the record."""
    t, y = record.t[record.valid], record.y[record.valid]
    if answer.delay is None or deviation == 0.0 or not (explained > 0 or math.isnan(answer.explained)):
        return "unknown"
    before = t - t[0] <= answer.delay.early
    if np.count_nonzero(before) < 8:
        return "unknown"
    noise = math.sqrt(1 - explained) * deviation if explained > 0 else _roughness(y)
    moved = float(y[before].std())
    # What is not explained is an upper bound of the noise, so what exceeds it by far is motion.
    return "moving" if moved > 2.5 * noise and moved > 0.25 * deviation else "flat"


def _roughness(y: Array) -> float:
    return float(np.sqrt(np.mean(np.diff(y) ** 2) / 2)) if y.size > 1 else 0.0


def _round_up(x: float) -> float:
    """The next larger of 1, 2, 5 times a power of ten."""
    if not x > 0:
        return math.nan
    scale = 10.0 ** math.floor(math.log10(x))
    factor = next(f for f in (1, 2, 5, 10) if f * scale >= x * (1 - 1e-9))
    return float(f"{factor * scale:.12g}")


# --- sentences -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Units:
    """Numbers with their units, three digits."""

    time: str
    input: str
    output: str

    def t(self, x: float) -> str:
        return f"{_digits(x, 4)} {self.time}"

    def u(self, x: float) -> str:
        return f"{_digits(x, 4)} {self.input}".rstrip()

    def y(self, x: float) -> str:
        return f"{_digits(x, 3)} {self.output}".rstrip()

    def w(self, x: float) -> str:
        return f"{_digits(x, 3)} rad/{self.time}"


def _digits(x: float, digits: int) -> str:
    """Rounded, without an exponent that is not needed."""
    return f"{float(f'{x:.{digits}g}'):.12g}"


@dataclass(frozen=True)
class _Words:
    """The findings of a report."""

    record: Record
    report: RecordReport
    moves: InputMoves
    answer: Answer
    unit: _Units

    def findings(self) -> list[Finding]:
        parts = (
            *(self.samples, self.sampling, self.gaps, self.masked, self.excitation, self.smoothness, self.output),
            *(self.offset, self.trend, self.outliers, self.saturation, self.quantisation, self.noise),
            *(self.bandwidth, self.edges, self.feedback, self.delay, self.start),
        )
        return [finding for part in parts if (finding := part()) is not None]

    @property
    def _edges_known(self) -> bool:
        """Whether the input has times of its own."""
        signal, t = self.record.input, self.record.t
        return signal.t.size != t.size or bool(np.any(signal.t != t))

    def samples(self) -> Finding | None:
        r = self.report
        if r.n_samples - r.n_masked >= FEW_SAMPLES:
            return None
        return Finding(
            "warning",
            "samples",
            f"Only {r.n_samples - r.n_masked} output samples: standard errors will be large and their formula, which "
            "holds for long records, rough.",
        )

    def sampling(self) -> Finding | None:
        r, unit = self.report, self.unit
        if not math.isfinite(r.interval):
            return None
        if r.regular:
            return Finding("ok", "sampling", f"The clock is regular, one sample every {unit.t(r.interval)}.")
        if r.gaps and r.interval_deviation < 1e-6 * r.interval:
            return Finding(
                "ok", "sampling", f"The clock is regular but for the gaps, one sample every {unit.t(r.interval)}."
            )
        spread = f"{unit.t(r.interval_min)} to {unit.t(r.interval_max)}, median {unit.t(r.interval)}"
        if r.interval_deviation < JITTER * r.interval:
            return Finding(
                "note",
                "sampling",
                f"The clock jitters (intervals of {spread}, standard deviation "
                f"{100 * r.interval_deviation / r.interval:.2g} %); the time stamps are used as they are.",
            )
        return Finding(
            "note",
            "sampling",
            f"The clock is irregular: intervals of {spread}. The time stamps are used as they are; do not resample.",
        )

    def gaps(self) -> Finding | None:
        r, unit = self.report, self.unit
        if not r.gaps:
            return None
        longest = max(r.gaps, key=lambda gap: gap.length)
        many = f"{len(r.gaps)} gaps" if len(r.gaps) > 1 else "A gap"
        held = "" if self.moves.kind == "constant" else " The input is held across them: make sure that it was."
        return Finding(
            "warning",
            "gaps",
            f"{many} longer than {GAP:g} median intervals, the longest of {unit.t(longest.length)} after t = "
            f"{unit.t(longest.start)}.{held}",
        )

    def masked(self) -> Finding | None:
        r = self.report
        if not r.n_masked:
            return None
        share = r.n_masked / r.n_samples
        verb = "is" if r.n_masked == 1 else "are"
        return Finding(
            "warning" if share > 0.2 else "note",
            "missing",
            f"{r.n_masked} of {r.n_samples} output samples ({100 * share:.2g} %) {verb} missing; they are left out and "
            "nothing is put in their place.",
        )

    def excitation(self) -> Finding:
        r, unit = self.report, self.unit
        if r.input_kind == "constant":
            if r.input_low == 0.0:
                return Finding(
                    "problem",
                    "input",
                    "The input is zero throughout: the output answers to nothing that was recorded, so no model from "
                    "this input can be found.",
                )
            return Finding(
                "problem",
                "input",
                f"The input is constant at {unit.u(r.input_low)}: nothing shows when or how much the output answers. "
                "If it was switched on at the first sample, add a line before that with the earlier input; otherwise "
                "record an experiment in which the input changes.",
            )
        if r.input_kind == "steps":
            times = "once" if r.input_changes == 1 else f"{r.input_changes} times"
            return Finding(
                "warning",
                "input",
                f"The input changes only {times}: enough for a gain, one or two time constants and a rough delay, not "
                "for more, and drift cannot be told from the answer. An input that switches often would show more.",
            )
        order = f"at least {r.excitation_order}" if r.excitation_order >= HIGHEST_ORDER else f"{r.excitation_order}"
        low, high = r.input_band
        power = f"95 % of its power lies from {_digits(low, 2)} to {unit.w(high)}"
        if r.excitation_order < ENOUGH_ORDER:
            return Finding(
                "warning",
                "input",
                f"The input is persistently exciting of order {order} only, enough for {r.excitation_order} "
                f"parameters; {power}. Add frequencies, or switch at random.",
            )
        what = self._movement()
        return Finding("ok", "input", f"{what} It is persistently exciting of order {order}; {power}.")

    def _movement(self) -> str:
        r, unit = self.report, self.unit
        if r.input_kind == "continuous":
            return f"The input moves continuously between {unit.u(r.input_low)} and {unit.u(r.input_high)}."
        if 0 < len(r.input_levels) <= 4:
            about = "about " if self.moves.noisy else ""
            levels = ", ".join(f"{level:.4g}" for level in r.input_levels[:-1]) + f" and {r.input_levels[-1]:.4g}"
            where = f"{about}{levels} {self.unit.input}".rstrip()
        else:
            where = f"many levels from {unit.u(r.input_low)} to {unit.u(r.input_high)}"
        return (
            f"The input switches {r.input_changes} times between {where} and holds for {unit.t(r.shortest_hold)} or "
            "longer."
        )

    def smoothness(self) -> Finding | None:
        if self.report.input_kind != "continuous" or self.record.input.hold == "foh":
            return None
        return Finding(
            "note",
            "hold",
            "The input was neither held nor switched between levels; if it moves between its samples, as a measured "
            "flow or position does, straight lines (--hold foh) describe it better than steps, which would shift the "
            "delay by half an interval.",
        )

    def output(self) -> Finding | None:
        r, unit = self.report, self.unit
        if r.output_deviation > 1e-9 * abs(r.output_mean):
            return None
        return Finding(
            "problem",
            "output",
            f"The output is constant at {unit.y(r.output_mean)}: it does not answer to the input, or the sensor does "
            "not answer to it.",
        )

    def offset(self) -> Finding | None:
        r, unit = self.report, self.unit
        if r.suggested_offset == "none" or r.output_deviation == 0:
            return None
        levels = f"The output varies by {unit.y(r.output_deviation)} about {unit.y(r.output_mean)}"
        if r.input_kind != "constant":
            levels += f", the input by {unit.u(r.input_deviation)} about {unit.u(r.input_mean)}"
        if r.suggested_offset == "remove":
            cure = "subtract the means (--offset remove) or estimate the offset with the model (--offset estimate)"
        else:
            cure = "estimate the offset with the model (--offset estimate); the mean is no operating point here"
        return Finding("warning", "offset", f"{levels}; a linear model has no such constant, so {cure}.")

    def trend(self) -> Finding | None:
        r, unit = self.report, self.unit
        drift = r.output_trend * r.duration
        if r.input_kind in ("constant", "steps") or not r.output_trend_error > 0:
            return None
        significance = abs(r.output_trend) / r.output_trend_error
        if significance < SIGNIFICANT or abs(drift) < 0.3 * r.output_deviation:
            return None
        return Finding(
            "warning",
            "trend",
            f"The output drifts by {unit.y(drift)} over the record ({significance:.2g} standard errors). Unless the "
            "input drifts as well, remove the trend or use a part of the record without it (--from, --to).",
        )

    def outliers(self) -> Finding | None:
        r = self.report
        if not r.outliers:
            return None
        where = ", ".join(self.unit.t(t) for t in r.outliers[:3]) + (", ..." if len(r.outliers) > 3 else "")
        many = "1 output sample lies" if len(r.outliers) == 1 else f"{len(r.outliers)} output samples lie"
        return Finding(
            "warning",
            "outliers",
            f"{many} far from the neighbours (t = {where}); leave those fields empty if they are faults of the sensor.",
        )

    def saturation(self) -> Finding | None:
        r = self.report
        if not r.saturated or r.input_kind in ("constant", "steps"):
            return None
        return Finding(
            "warning",
            "saturation",
            f"{100 * r.saturated:.2g} % of the output samples sit exactly at the least or greatest value, as if the "
            "sensor had reached its limit; leave those fields empty.",
        )

    def quantisation(self) -> Finding | None:
        r, unit = self.report, self.unit
        if not math.isfinite(r.output_quantum):
            return None
        coarse = r.output_quantum > 0.1 * r.output_deviation
        return Finding(
            "warning" if coarse else "note",
            "resolution",
            f"The output was recorded in steps of {unit.y(r.output_quantum)}, "
            f"{100 * r.output_quantum / r.output_deviation:.2g} % of its standard deviation; that acts like a noise of "
            f"{unit.y(r.output_quantum / math.sqrt(12))}, which is not quite independent from sample to sample.",
        )

    def noise(self) -> Finding | None:
        r = self.report
        if r.input_kind in ("constant", "steps") or r.output_deviation == 0:
            return None
        if not r.explained > 0 and self.answer.delay is not None:
            return Finding(
                "warning",
                "answer",
                "The output follows the input, but so weakly that noise dominates at every frequency. Expect large "
                "standard errors; a longer record would help.",
            )
        if not r.explained > 0:
            return Finding(
                "problem" if r.n_samples - r.n_masked >= FEW_SAMPLES else "warning",
                "answer",
                "No part of the output follows the input visibly at any frequency: the noise is too strong, the record "
                "too short, or the two columns do not belong together.",
            )
        share = f"{100 * min(r.explained, 0.999):.3g} % of the output's variance follows the input linearly"
        text = f"At least {share} (signal-to-noise ratio {r.snr_db:.2g} dB or better)."
        if r.explained < 0.3:
            return Finding("warning", "answer", f"{text} Expect large standard errors; a longer record would help.")
        return Finding("ok", "answer", text)

    def bandwidth(self) -> Finding | None:
        r, unit = self.report, self.unit
        if not (r.explained > 0 or (r.input_kind == "steps" and self.answer.delay is not None)):
            return None
        per_period = 2 * math.pi / (r.output_bandwidth * r.interval)
        text = (
            f"95 % of the answer lies below {unit.w(r.output_bandwidth)}, and the clock resolves {unit.w(r.nyquist)} "
            f"({per_period:.3g} samples in a period of the fastest part)."
        )
        if per_period < FEW_PER_PERIOD:
            return Finding(
                "warning",
                "clock",
                f"{text} That is too few: what happens between the samples, the delay above all, rests on the assumed "
                "hold of the input. Sample faster, if possible.",
            )
        if r.output_bandwidth * r.duration < 20:
            return Finding(
                "warning",
                "duration",
                f"{text} The record lasts only {r.output_bandwidth * r.duration:.2g} times as long as the time that "
                "goes with it; slow dynamics and noise can hardly be told apart.",
            )
        return Finding("ok", "clock", text)

    def edges(self) -> Finding | None:
        r, unit = self.report, self.unit
        jittery = r.interval_deviation > JITTER * r.interval
        if not jittery or r.input_kind not in ("levels", "steps") or self._edges_known:
            return None
        return Finding(
            "warning",
            "edges",
            f"The input is known at the output's irregular instants only, so each change is known to within an "
            f"interval: taken at the next sample it is late by {unit.t(r.interval / 2)} on average, and the delay "
            "will come out too short by as much. Record the times at which the input changes, if you can.",
        )

    def feedback(self) -> Finding | None:
        before = self.answer.before
        if not before > 8 or self.answer.delay is None or before < 0.2 * self.answer.delay.strength:
            return None
        return Finding(
            "warning",
            "feedback",
            "The input seems to follow the output: their correlation at negative lags is "
            f"{before:.2g} times what chance gives. In closed loop an open-loop estimate is biased by the noise; if "
            "there was no controller, look at the time stamps of the two signals.",
        )

    def delay(self) -> Finding | None:
        r, unit = self.report, self.unit
        if self.answer.delay is None:
            if r.input_kind == "constant" or not (r.explained > 0 or r.input_kind == "steps"):
                return None
            return Finding(
                "note",
                "delay",
                "The beginning of the answer is hidden in the noise, so there is no hint of a delay; give the range "
                "that you know from the plant.",
            )
        low, high = r.suggested_delay or (0.0, math.nan)
        when = f"between {unit.t(r.delay_early)} and" if r.delay_early > 0 else "within"
        text = (
            f"The output begins to answer {when} {unit.t(r.delay_late)} of a change of the input, slow dynamics "
            f"included; search the delay from {low:g} to {unit.t(high)} (--delay {low:g}:{high:g})."
        )
        if r.delay_early > 0:
            text = text.replace("of a change", "after a change")
        if math.isfinite(r.input_period):
            text += (
                f" The input repeats itself every {unit.t(r.input_period)}: delays that differ by as much look alike."
            )
        wide = r.delay_late - r.delay_early > 0.5 * r.delay_late and r.input_kind == "steps"
        return Finding("note" if wide else "ok", "delay", text)

    def start(self) -> Finding | None:
        r, unit = self.report, self.unit
        if r.starts == "moving":
            return Finding(
                "warning",
                "start",
                f"The output moves during the first {unit.t(r.delay_early)}, before it can answer to anything in the "
                "record: the experiment was under way. Estimate the initial state with the model "
                "(--initial-state estimate).",
            )
        if r.starts == "flat":
            return Finding(
                "ok",
                "start",
                f"The output is flat during the first {unit.t(r.delay_early)}, so the record seems to begin at rest.",
            )
        if r.input_kind in ("constant", "steps"):
            return None
        return Finding(
            "note",
            "start",
            "Whether the record begins at rest cannot be seen, the answer being too quick for that; if the experiment "
            "was under way, use --initial-state estimate.",
        )
