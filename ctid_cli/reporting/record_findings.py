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
    record: Record, time_unit: str = "s", input_unit: str = "", output_unit: str = ""
) -> RecordReport:
    """Look for everything in a record that helps or hinders identification.

    The findings rest on spectra, correlations and order statistics, never on a model, so they hold whatever model
    is fitted later; a hint is not an estimate.
    """
    found = examine(record, ENOUGH_ORDER)
    findings = list(_Words(found, found.report, _Units(time_unit, input_unit, output_unit)).findings())
    return replace(found.report, findings=tuple(sorted(findings, key=lambda finding: -LEVELS.index(finding.level))))


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
        yield from self._clock()
        yield from self._missing()
        yield self._input()
        yield from self._output()
        yield from self._faults()
        yield from self._answer()
        yield from self._speed()
        yield from self._pairing()
        yield from self._delay()
        if (start := self._start()) is not None:
            yield start

    @property
    def _seldom(self) -> bool:
        return self.r.input_kind in ("constant", "steps")

    def _clock(self) -> Iterator[Finding]:
        r, unit = self.r, self.unit
        present = r.n_samples - r.n_masked
        if present < FEW_SAMPLES:
            text = f"Only {present} output samples: standard errors will be large, and rough themselves."
            yield Finding("warning", "samples", text)
        every = f"one sample every {unit.t(r.interval)}."
        spread = f"{unit.t(r.interval_min)} to {unit.t(r.interval_max)}, median {unit.t(r.interval)}"
        if r.regular:
            yield Finding("ok", "sampling", f"The clock is regular, {every}")
        elif r.gaps and r.interval_deviation < 1e-6 * r.interval:
            yield Finding("ok", "sampling", f"The clock is regular but for the gaps, {every}")
        elif r.interval_deviation < JITTER * r.interval:
            spread += f", standard deviation {100 * r.interval_deviation / r.interval:.2g} %"
            text = f"The clock jitters (intervals of {spread}); the time stamps are used as they are."
            yield Finding("note", "sampling", text)
        elif math.isfinite(r.interval):
            text = f"The clock is irregular: intervals of {spread}. Do not resample: the time stamps are used."
            yield Finding("note", "sampling", text)

    def _missing(self) -> Iterator[Finding]:
        r, unit = self.r, self.unit
        if r.gaps:
            longest = max(r.gaps, key=lambda gap: gap.length)
            text = f"{len(r.gaps)} gaps" if len(r.gaps) > 1 else "A gap"
            text += f" longer than {LONG_INTERVAL:g} median intervals, the longest of {unit.t(longest.length)}"
            text += f" after t = {unit.t(longest.start)}."
            text += "" if r.input_kind == "constant" else " The input is held across them: make sure that it was."
            yield Finding("warning", "gaps", text)
        if r.n_masked:
            share, verb = r.n_masked / r.n_samples, "is" if r.n_masked == 1 else "are"
            text = f"{r.n_masked} of {r.n_samples} output samples ({100 * share:.2g} %) {verb} missing and left out."
            yield Finding("warning" if share > 0.2 else "note", "missing", text)

    def _input(self) -> Finding:
        r, unit = self.r, self.unit
        order = f"at least {r.excitation_order}" if r.excitation_order >= HIGHEST_ORDER else f"{r.excitation_order}"
        power = f"95 % of its power lies from {_digits(r.input_band[0], 2)} to {unit.w(r.input_band[1])}"
        if r.input_kind == "constant" and r.input_low == 0.0:
            return Finding("problem", "input", "The input is zero throughout: no model can be found from it.")
        if r.input_kind == "constant":
            text = f"The input is constant at {unit.u(r.input_low)}: nothing shows when or how much the output answers."
            text += " Record changes; if it was switched on at the first sample, add a line with the earlier input."
            return Finding("problem", "input", text)
        if r.input_kind == "steps":
            times = "once" if r.input_changes == 1 else f"{r.input_changes} times"
            text = f"The input changes only {times}: enough for a gain, one or two time constants and a rough delay,"
            text += " while drift cannot be told from the answer. An input that switches often would show more."
            return Finding("warning", "input", text)
        if r.excitation_order < ENOUGH_ORDER:
            text = f"The input is persistently exciting of order {order} only, enough for {r.excitation_order}"
            return Finding("warning", "input", f"{text} parameters; {power}. Add frequencies, or switch at random.")
        return Finding("ok", "input", f"{self._movement()} It is persistently exciting of order {order}; {power}.")

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
        if r.input_kind == "continuous" and self.found.record.input.hold != "foh":
            text = "The input was not held: straight lines (--hold foh) describe it better if it moves between samples."
            yield Finding("note", "hold", text)
        if not r.output_deviation > 1e-9 * abs(r.output_mean):
            text = f"The output is constant at {unit.y(r.output_mean)}: it, or its sensor, does not answer."
            yield Finding("problem", "output", text)
        if r.suggested_offset != "none" and r.output_deviation != 0:
            text = f"The output varies by {unit.y(r.output_deviation)} about {unit.y(r.output_mean)}"
            if r.input_kind != "constant":
                text += f", the input by {unit.u(r.input_deviation)} about {unit.u(r.input_mean)}"
            cures = {"remove": "subtract the means (--offset remove) or estimate the offset (--offset estimate)"}
            cure = cures.get(r.suggested_offset, "estimate it (--offset estimate); the mean is no operating point here")
            yield Finding("warning", "offset", f"{text}; a linear model has no such constant, so {cure}.")
        drift = r.output_trend * r.duration
        if not self._seldom and r.output_trend_error > 0:
            significance = abs(r.output_trend) / r.output_trend_error
            if significance >= SIGNIFICANT and abs(drift) >= 0.3 * r.output_deviation:
                text = f"The output drifts by {unit.y(drift)} over the record ({significance:.2g} standard errors). "
                text += "Unless the input drifts too, remove the trend or use a part without it (--from, --to)."
                yield Finding("warning", "trend", text)

    def _faults(self) -> Iterator[Finding]:
        r, unit = self.r, self.unit
        if r.outliers:
            where = ", ".join(unit.t(t) for t in r.outliers[:3]) + (", ..." if len(r.outliers) > 3 else "")
            text = "1 output sample lies" if len(r.outliers) == 1 else f"{len(r.outliers)} output samples lie"
            text += f" far from the neighbours (t = {where}); leave faults of the sensor empty."
            yield Finding("warning", "outliers", text)
        if r.saturated and not self._seldom:
            text = f"{100 * r.saturated:.2g} % of the output samples sit exactly at the least or greatest value, as if "
            text += "the sensor had reached its limit; leave those fields empty."
            yield Finding("warning", "saturation", text)
        if math.isfinite(r.output_quantum):
            coarse = r.output_quantum > 0.1 * r.output_deviation
            text = f"The output was recorded in steps of {unit.y(r.output_quantum)}, "
            text += f"{100 * (r.output_quantum / r.output_deviation):.2g} % of its standard deviation; that acts like "
            text += f"a noise of {unit.y(r.output_quantum / math.sqrt(12))}."
            yield Finding("warning" if coarse else "note", "resolution", text)

    def _answer(self) -> Iterator[Finding]:
        r = self.r
        if self._seldom or r.output_deviation == 0:
            return
        weak = "Expect large standard errors; a longer record would help."
        text = f"At least {100 * min(r.explained, 0.999):.3g} % of the output's variance follows the input linearly "
        text += f"(signal-to-noise ratio {r.snr_db:.2g} dB or better)."
        if r.explained >= 0.3:
            yield Finding("ok", "answer", text)
        elif r.explained > 0:
            yield Finding("warning", "answer", f"{text} {weak}")
        elif self.found.answer.delay is not None:
            text = f"The output follows the input, but so weakly that noise dominates at every frequency. {weak}"
            yield Finding("warning", "answer", text)
        else:
            text = "No part of the output follows the input visibly: too much noise, too short, or the wrong columns."
            yield Finding("problem" if r.n_samples - r.n_masked >= FEW_SAMPLES else "warning", "answer", text)

    def _speed(self) -> Iterator[Finding]:
        """Whether the clock is fast enough for the answer, and the record long enough."""
        r, unit = self.r, self.unit
        if not (r.explained > 0 or (r.input_kind == "steps" and self.found.answer.delay is not None)):
            return
        per_period, spans = 2 * math.pi / (r.output_bandwidth * r.interval), r.output_bandwidth * r.duration
        text = f"95 % of the answer lies below {unit.w(r.output_bandwidth)}, and the clock resolves "
        text += f"{unit.w(r.nyquist)} ({per_period:.3g} samples in a period of the fastest part)."
        if per_period < FEW_PER_PERIOD:
            text += " What happens between the samples rests on the assumed hold of the input. Sample faster."
            yield Finding("warning", "clock", text)
        elif spans < 20:
            text += f" The record lasts only {spans:.2g} times as long as the time that goes with it; slow dynamics "
            yield Finding("warning", "duration", f"{text}and noise can hardly be told apart.")
        else:
            yield Finding("ok", "clock", text)

    def _pairing(self) -> Iterator[Finding]:
        """What is odd about input and output together."""
        r, before, delay = self.r, self.found.answer.before, self.found.answer.delay
        own_times = not np.array_equal(self.found.record.input.t, self.found.record.t)
        if r.interval_deviation > JITTER * r.interval and r.input_kind in ("levels", "steps") and not own_times:
            text = "The input is known at the output's irregular instants only: its changes seem late by "
            text += f"{self.unit.t(r.interval / 2)} on average, and the delay will come out too short by as much. "
            yield Finding("warning", "edges", f"{text}Record the times at which the input changes, if you can.")
        if before > 8 and delay is not None and before >= 0.2 * delay.strength:
            text = f"The input seems to follow the output: their correlation at negative lags is {before:.2g} times "
            text += "what chance gives. In closed loop noise biases an open-loop estimate; if there was no controller, "
            yield Finding("warning", "feedback", f"{text}look at the time stamps of the two signals.")

    def _delay(self) -> Iterator[Finding]:
        r, unit = self.r, self.unit
        if self.found.answer.delay is not None:
            low, high = r.suggested_delay or (0.0, math.nan)
            late = unit.t(r.delay_late)
            when = f"between {unit.t(r.delay_early)} and {late} after" if r.delay_early > 0 else f"within {late} of"
            text = f"The output begins to answer {when} a change of the input, slow dynamics included; search it "
            text += f"from {low:g} to {unit.t(high)} (--delay {low:g}:{high:g})."
            if math.isfinite(r.input_period):
                text += f" The input repeats itself every {unit.t(r.input_period)}: delays that far apart look alike."
            wide = r.delay_late - r.delay_early > 0.5 * r.delay_late and r.input_kind == "steps"
            yield Finding("note" if wide else "ok", "delay", text)
        elif r.input_kind != "constant" and (r.explained > 0 or r.input_kind == "steps"):
            text = "The beginning of the answer is hidden in the noise; give the range of delays that you know."
            yield Finding("note", "delay", text)

    def _start(self) -> Finding | None:
        early, cure = self.unit.t(self.r.delay_early), "(--initial-state estimate)"
        if self.r.starts == "moving":
            text = f"The output moves during the first {early}, before it can answer to anything in the record: the "
            return Finding("warning", "start", f"{text}experiment was under way. Estimate the initial state {cure}.")
        if self.r.starts == "flat":
            text = f"The output is flat during the first {early}, so the record seems to begin at rest."
            return Finding("ok", "start", text)
        if self._seldom:
            return None
        text = "The answer is too quick to see whether the record begins at rest; if the experiment was under way, "
        return Finding("note", "start", f"{text}estimate the initial state {cure}.")
