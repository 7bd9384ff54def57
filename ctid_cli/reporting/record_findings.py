"""What a user should know of a record before any model is fitted, in sentences."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ctid_cli.inference.record_check import (
    HIGHEST_ORDER,
    LEVELS,
    LONG_INTERVAL,
    SIGNIFICANT,
    Examined,
    Finding,
    Level,
    RecordReport,
    examine,
)
from ctid_cli.signals.record import Record

#: An irregular clock is regular but for jitter where the standard deviation of its intervals is below this fraction.
JITTER = 0.05
#: Fewer samples than this leave little for the noise to average out over.
FEW_SAMPLES = 50
#: Fewer samples than this in a period of the fastest part of the answer leave much to the assumed hold.
FEW_PER_PERIOD = 2.5
#: Below this order no model with a delay can be told from one without.
ENOUGH_ORDER = 4


def check_record_quality(
    record: Record, *, time_unit: str = "s", input_unit: str = "", output_unit: str = ""
) -> RecordReport:
    """Look for everything in a record that helps or hinders identification.

    The findings rest on spectra, correlations and order statistics, never on a model, so they hold whatever model
    is fitted later; a hint is not an estimate.
    """
    found = examine(record, ENOUGH_ORDER)
    words = _Words(found, found.report, _Units(time_unit, input_unit, output_unit))
    worst_first = sorted(words.findings(), key=lambda finding: -LEVELS.index(finding.level))
    return replace(found.report, findings=tuple(worst_first))


@dataclass(frozen=True)
class _Units:
    """Numbers with their units, three or four digits."""

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
    """The findings of a report, each group in the order of the thought."""

    found: Examined
    r: RecordReport
    unit: _Units

    def findings(self) -> Iterator[Finding]:
        for group in (self._clock, self._input, self._output, self._faults, self._answer, self._delay):
            yield from group()

    @property
    def _seldom(self) -> bool:
        return self.r.input_kind in ("constant", "steps")

    def _clock(self) -> Iterator[Finding]:
        r, unit = self.r, self.unit
        present = r.n_samples - r.n_masked
        if present < FEW_SAMPLES:
            yield Finding(
                "warning",
                "samples",
                f"Only {present} output samples: standard errors will be large and their formula, which holds for "
                "long records, rough.",
            )
        every = f"one sample every {unit.t(r.interval)}."
        spread = f"{unit.t(r.interval_min)} to {unit.t(r.interval_max)}, median {unit.t(r.interval)}"
        if r.regular:
            yield Finding("ok", "sampling", f"The clock is regular, {every}")
        elif r.gaps and r.interval_deviation < 1e-6 * r.interval:
            yield Finding("ok", "sampling", f"The clock is regular but for the gaps, {every}")
        elif r.interval_deviation < JITTER * r.interval:
            deviation = f"standard deviation {100 * r.interval_deviation / r.interval:.2g} %"
            text = f"The clock jitters (intervals of {spread}, {deviation}); the time stamps are used as they are."
            yield Finding("note", "sampling", text)
        elif math.isfinite(r.interval):
            text = (
                f"The clock is irregular: intervals of {spread}. The time stamps are used as they are; do not resample."
            )
            yield Finding("note", "sampling", text)
        if r.gaps:
            longest = max(r.gaps, key=lambda gap: gap.length)
            many = f"{len(r.gaps)} gaps" if len(r.gaps) > 1 else "A gap"
            held = "" if r.input_kind == "constant" else " The input is held across them: make sure that it was."
            yield Finding(
                "warning",
                "gaps",
                f"{many} longer than {LONG_INTERVAL:g} median intervals, the longest of {unit.t(longest.length)} after "
                f"t = {unit.t(longest.start)}.{held}",
            )
        if r.n_masked:
            share = r.n_masked / r.n_samples
            verb = "is" if r.n_masked == 1 else "are"
            yield Finding(
                "warning" if share > 0.2 else "note",
                "missing",
                f"{r.n_masked} of {r.n_samples} output samples ({100 * share:.2g} %) {verb} missing; they are left out "
                "and nothing is put in their place.",
            )

    def _input(self) -> Iterator[Finding]:
        r, unit = self.r, self.unit
        order = f"at least {r.excitation_order}" if r.excitation_order >= HIGHEST_ORDER else f"{r.excitation_order}"
        power = f"95 % of its power lies from {_digits(r.input_band[0], 2)} to {unit.w(r.input_band[1])}"
        level: Level = "problem" if r.input_kind == "constant" else "warning"
        if r.input_kind == "constant" and r.input_low == 0.0:
            text = (
                "The input is zero throughout: the output answers to nothing that was recorded, so no model from "
                "this input can be found."
            )
        elif r.input_kind == "constant":
            text = (
                f"The input is constant at {unit.u(r.input_low)}: nothing shows when or how much the output answers. "
                "If it was switched on at the first sample, add a line before that with the earlier input; otherwise "
                "record an experiment in which the input changes."
            )
        elif r.input_kind == "steps":
            times = "once" if r.input_changes == 1 else f"{r.input_changes} times"
            text = (
                f"The input changes only {times}: enough for a gain, one or two time constants and a rough delay, not "
                "for more, and drift cannot be told from the answer. An input that switches often would show more."
            )
        elif r.excitation_order < ENOUGH_ORDER:
            text = (
                f"The input is persistently exciting of order {order} only, enough for {r.excitation_order} "
                f"parameters; {power}. Add frequencies, or switch at random."
            )
        else:
            level = "ok"
            text = f"{self._movement()} It is persistently exciting of order {order}; {power}."
        yield Finding(level, "input", text)
        if r.input_kind == "continuous" and self.found.record.input.hold != "foh":
            yield Finding(
                "note",
                "hold",
                "The input was neither held nor switched between levels; if it moves between its samples, as a "
                "measured flow or position does, straight lines (--hold foh) describe it better than steps, which "
                "would shift the delay by half an interval.",
            )

    def _movement(self) -> str:
        r, unit = self.r, self.unit
        if r.input_kind == "continuous":
            return f"The input moves continuously between {unit.u(r.input_low)} and {unit.u(r.input_high)}."
        where = f"many levels from {unit.u(r.input_low)} to {unit.u(r.input_high)}"
        if 0 < len(r.input_levels) <= 4:
            levels = ", ".join(f"{level:.4g}" for level in r.input_levels[:-1]) + f" and {r.input_levels[-1]:.4g}"
            where = f"{'about ' if self.found.moves.noisy else ''}{levels} {unit.input}".rstrip()
        hold = f"holds for {unit.t(r.shortest_hold)} or longer"
        return f"The input switches {r.input_changes} times between {where} and {hold}."

    def _output(self) -> Iterator[Finding]:
        r, unit = self.r, self.unit
        if not r.output_deviation > 1e-9 * abs(r.output_mean):
            yield Finding(
                "problem",
                "output",
                f"The output is constant at {unit.y(r.output_mean)}: it does not answer to the input, or the sensor "
                "does not answer to it.",
            )
        if r.suggested_offset != "none" and r.output_deviation != 0:
            levels = f"The output varies by {unit.y(r.output_deviation)} about {unit.y(r.output_mean)}"
            if r.input_kind != "constant":
                levels += f", the input by {unit.u(r.input_deviation)} about {unit.u(r.input_mean)}"
            cure = "estimate the offset with the model (--offset estimate); the mean is no operating point here"
            if r.suggested_offset == "remove":
                cure = "subtract the means (--offset remove) or estimate the offset with the model (--offset estimate)"
            text = f"{levels}; a linear model has no such constant, so {cure}."
            yield Finding("warning", "offset", text)
        drift = r.output_trend * r.duration
        if not self._seldom and r.output_trend_error > 0:
            significance = abs(r.output_trend) / r.output_trend_error
            if significance >= SIGNIFICANT and abs(drift) >= 0.3 * r.output_deviation:
                yield Finding(
                    "warning",
                    "trend",
                    f"The output drifts by {unit.y(drift)} over the record ({significance:.2g} standard errors). "
                    "Unless the input drifts as well, remove the trend or use a part of the record without it (--from, "
                    "--to).",
                )

    def _faults(self) -> Iterator[Finding]:
        r, unit = self.r, self.unit
        if r.outliers:
            where = ", ".join(unit.t(t) for t in r.outliers[:3]) + (", ..." if len(r.outliers) > 3 else "")
            many = "1 output sample lies" if len(r.outliers) == 1 else f"{len(r.outliers)} output samples lie"
            cure = "leave those fields empty if they are faults of the sensor"
            yield Finding("warning", "outliers", f"{many} far from the neighbours (t = {where}); {cure}.")
        if r.saturated and not self._seldom:
            yield Finding(
                "warning",
                "saturation",
                f"{100 * r.saturated:.2g} % of the output samples sit exactly at the least or greatest value, as if "
                "the sensor had reached its limit; leave those fields empty.",
            )
        if math.isfinite(r.output_quantum):
            share = r.output_quantum / r.output_deviation
            yield Finding(
                "warning" if r.output_quantum > 0.1 * r.output_deviation else "note",
                "resolution",
                f"The output was recorded in steps of {unit.y(r.output_quantum)}, {100 * share:.2g} % of its standard "
                f"deviation; that acts like a noise of {unit.y(r.output_quantum / math.sqrt(12))}, which is not quite "
                "independent from sample to sample.",
            )

    def _answer(self) -> Iterator[Finding]:
        r, unit, delay = self.r, self.unit, self.found.answer.delay
        weak = "Expect large standard errors; a longer record would help."
        if not (self._seldom or r.output_deviation == 0):
            share = f"{100 * min(r.explained, 0.999):.3g} % of the output's variance follows the input linearly"
            text = f"At least {share} (signal-to-noise ratio {r.snr_db:.2g} dB or better)."
            if r.explained >= 0.3:
                yield Finding("ok", "answer", text)
            elif r.explained > 0:
                yield Finding("warning", "answer", f"{text} {weak}")
            elif delay is not None:
                text = f"The output follows the input, but so weakly that noise dominates at every frequency. {weak}"
                yield Finding("warning", "answer", text)
            else:
                yield Finding(
                    "problem" if r.n_samples - r.n_masked >= FEW_SAMPLES else "warning",
                    "answer",
                    "No part of the output follows the input visibly at any frequency: the noise is too strong, the "
                    "record too short, or the two columns do not belong together.",
                )
        if r.explained > 0 or (r.input_kind == "steps" and delay is not None):
            per_period = 2 * math.pi / (r.output_bandwidth * r.interval)
            topic = "clock"
            text = (
                f"95 % of the answer lies below {unit.w(r.output_bandwidth)}, and the clock resolves "
                f"{unit.w(r.nyquist)} ({per_period:.3g} samples in a period of the fastest part)."
            )
            if per_period < FEW_PER_PERIOD:
                text += (
                    " That is too few: what happens between the samples, the delay above all, rests on the assumed "
                    "hold of the input. Sample faster, if possible."
                )
            elif r.output_bandwidth * r.duration < 20:
                topic = "duration"
                text += (
                    f" The record lasts only {r.output_bandwidth * r.duration:.2g} times as long as the time that goes "
                    "with it; slow dynamics and noise can hardly be told apart."
                )
            enough = per_period >= FEW_PER_PERIOD and topic == "clock"
            yield Finding("ok" if enough else "warning", topic, text)
        signal, t = self.found.record.input, self.found.record.t
        own_times = signal.t.size != t.size or bool(np.any(signal.t != t))
        if r.interval_deviation > JITTER * r.interval and r.input_kind in ("levels", "steps") and not own_times:
            yield Finding(
                "warning",
                "edges",
                "The input is known at the output's irregular instants only, so each change is known to within an "
                f"interval: taken at the next sample it is late by {unit.t(r.interval / 2)} on average, and the delay "
                "will come out too short by as much. Record the times at which the input changes, if you can.",
            )
        before = self.found.answer.before
        if before > 8 and delay is not None and before >= 0.2 * delay.strength:
            yield Finding(
                "warning",
                "feedback",
                "The input seems to follow the output: their correlation at negative lags is "
                f"{before:.2g} times what chance gives. In closed loop an open-loop estimate is biased by the noise; "
                "if there was no controller, look at the time stamps of the two signals.",
            )

    def _delay(self) -> Iterator[Finding]:
        r, unit = self.r, self.unit
        if self.found.answer.delay is not None:
            low, high = r.suggested_delay or (0.0, math.nan)
            late = unit.t(r.delay_late)
            when = f"between {unit.t(r.delay_early)} and {late} after" if r.delay_early > 0 else f"within {late} of"
            text = (
                f"The output begins to answer {when} a change of the input, slow dynamics included; search the delay "
                f"from {low:g} to {unit.t(high)} (--delay {low:g}:{high:g})."
            )
            if math.isfinite(r.input_period):
                period = unit.t(r.input_period)
                text += f" The input repeats itself every {period}: delays that differ by as much look alike."
            wide = r.delay_late - r.delay_early > 0.5 * r.delay_late and r.input_kind == "steps"
            yield Finding("note" if wide else "ok", "delay", text)
        elif r.input_kind != "constant" and (r.explained > 0 or r.input_kind == "steps"):
            yield Finding(
                "note",
                "delay",
                "The beginning of the answer is hidden in the noise, so there is no hint of a delay; give the range "
                "that you know from the plant.",
            )
        if r.starts == "moving":
            yield Finding(
                "warning",
                "start",
                f"The output moves during the first {unit.t(r.delay_early)}, before it can answer to anything in the "
                "record: the experiment was under way. Estimate the initial state with the model "
                "(--initial-state estimate).",
            )
        elif r.starts == "flat":
            flat = f"The output is flat during the first {unit.t(r.delay_early)}"
            yield Finding("ok", "start", f"{flat}, so the record seems to begin at rest.")
        elif not self._seldom:
            yield Finding(
                "note",
                "start",
                "Whether the record begins at rest cannot be seen, the answer being too quick for that; if the "
                "experiment was under way, use --initial-state estimate.",
            )
