"""What a user should know of a record before any model is fitted, in sentences."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ctid_cli.inference import record_check
from ctid_cli.inference.record_check import Examined, Finding, Level, RecordReport
from ctid_cli.inference.response_test import AnswerTest, response_test
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record
from ctid_cli.text import listed

#: An irregular clock is regular but for jitter where the standard deviation of its intervals is below this fraction.
JITTER = 0.05
#: Fewer samples than this leave little for the noise to average out over.
FEW_SAMPLES = 50
#: Fewer samples than this in a period of the fastest part of the answer leave much to the assumed hold.
FEW_PER_PERIOD = 2.5
#: Without a hint of the delay, delays up to this fraction of the record are tried.
LONGEST_DELAY = 0.1
#: Where spectra show that so much of the output follows the input, no test has to.
EXPLAINED = 0.3


def check_record_quality(
    record: Record, time_unit: str = "s", input_unit: str = "", output_unit: str = ""
) -> RecordReport:
    """Look for everything in a record that helps or hinders identification.

    The findings rest on spectra, correlations and order statistics, never on a model, so they hold whatever model
    is fitted later; a hint is not an estimate.
    """
    found = record_check.examine(record)
    low, high = found.report.suggested_delay or (0.0, LONGEST_DELAY * found.report.duration)
    # Where the record begins, the system is taken to be in equilibrium.
    signal = record.input
    moved = HeldSignal(signal.t, signal.values - signal.at(record.t[:1]), signal.hold)
    test = response_test([replace(record, input=moved)], [record.valid], (low, high))
    findings = _Words(found, found.report, test, time_unit, input_unit, output_unit).findings()
    worst_first = sorted(findings, key=lambda finding: -record_check.LEVELS.index(finding.level))
    return replace(found.report, answer_p_value=test.p_value, findings=tuple(worst_first))


def _digits(x: float, digits: int) -> str:
    """Rounded, without an exponent that is not needed."""
    return f"{float(f'{x:.{digits}g}'):.12g}"


@dataclass(frozen=True)
class _Words:
    """The findings of a report, each group in the order of the thought."""

    found: Examined
    r: RecordReport
    test: AnswerTest
    time: str
    input: str
    output: str

    # Numbers with their units, three or four digits.

    def t(self, x: float) -> str:
        return f"{_digits(x, 4)} {self.time}"

    def u(self, x: float) -> str:
        return f"{_digits(x, 4)} {self.input}".rstrip()

    def y(self, x: float) -> str:
        return f"{_digits(x, 3)} {self.output}".rstrip()

    def w(self, x: float) -> str:
        return f"{_digits(x, 3)} rad/{self.time}"

    def findings(self) -> Iterator[Finding]:
        yield from self._clock()
        yield from self._missing()
        yield self._input()
        yield from self._output()
        yield from self._faults()
        yield from self._answer()
        yield from self._pairing()
        if self._answers:
            yield from self._speed()
            yield from self._delay()
            yield from self._start()

    @property
    def _seldom(self) -> bool:
        return self.r.input_kind in ("constant", "steps")

    @property
    def _answers(self) -> bool:
        """Whether an answer is seen at all."""
        return self.test.seen or self.r.explained >= EXPLAINED

    def _clock(self) -> Iterator[Finding]:
        r = self.r
        present = r.n_samples - r.n_masked
        if present < FEW_SAMPLES:
            yield Finding("warning", "samples", f"Only {present} output samples: expect large, rough standard errors.")
        every = f"one sample every {self.t(r.interval)}."
        spread = f"{self.t(r.interval_min)} to {self.t(r.interval_max)}, median {self.t(r.interval)}"
        if r.regular:
            yield Finding("ok", "sampling", f"The clock is regular, {every}")
        elif r.gaps and r.interval_deviation < 1e-6 * r.interval:
            yield Finding("ok", "sampling", f"The clock is regular but for the gaps, {every}")
        elif r.interval_deviation < JITTER * r.interval:
            spread += f", standard deviation {100 * r.interval_deviation / r.interval:.2g} %"
            yield Finding("note", "sampling", f"The clock jitters: intervals of {spread}; the time stamps are used.")
        elif math.isfinite(r.interval):
            text = f"The clock is irregular: intervals of {spread}. Do not resample: the time stamps are used."
            yield Finding("note", "sampling", text)

    def _missing(self) -> Iterator[Finding]:
        r = self.r
        if r.gaps:
            longest = max(r.gaps, key=lambda gap: gap.length)
            many = f"{len(r.gaps)} gaps" if len(r.gaps) > 1 else "A gap"
            where = f"the longest of {self.t(longest.length)} after t = {self.t(longest.start)}"
            held = "" if r.input_kind == "constant" else " The input is held across them: make sure that it was."
            text = f"{many} longer than {record_check.LONG_INTERVAL:g} median intervals, {where}.{held}"
            yield Finding("warning", "gaps", text)
        if r.n_masked:
            share, verb = r.n_masked / r.n_samples, "is" if r.n_masked == 1 else "are"
            text = f"{r.n_masked} of {r.n_samples} output samples ({100 * share:.2g} %) {verb} missing and left out."
            yield Finding("warning" if share > 0.2 else "note", "missing", text)

    def _input(self) -> Finding:
        r = self.r
        if r.input_kind == "constant" and r.input_low == 0.0:
            return Finding("problem", "input", "The input is zero throughout: no model can be found from it.")
        if r.input_kind == "constant":
            text = f"The input is constant at {self.u(r.input_low)}: it shows no answer. Record changes; if it was "
            return Finding(
                "problem", "input", f"{text}switched on at the first sample, add a line with its value before."
            )
        if r.input_kind == "steps":
            times = "once" if r.input_changes == 1 else f"{r.input_changes} times"
            text = f"The input changes only {times}: enough for a gain, one or two time constants and a rough delay. "
            return Finding("warning", "input", f"{text}An input that switches often tells drift from the answer too.")
        order = (
            f"at least {r.excitation_order}"
            if r.excitation_order >= record_check.HIGHEST_ORDER
            else f"{r.excitation_order}"
        )
        power = f"95 % of its power lies from {_digits(r.input_band[0], 2)} to {self.w(r.input_band[1])}"
        if r.excitation_order < record_check.ENOUGH_ORDER:
            text = f"The input is persistently exciting of order {order} only, enough for as many parameters; {power}."
            return Finding("warning", "input", f"{text} Add frequencies, or switch at random.")
        return Finding("ok", "input", f"{self._movement()} It is persistently exciting of order {order}; {power}.")

    def _movement(self) -> str:
        r = self.r
        if r.input_kind == "continuous":
            return f"The input moves continuously between {self.u(r.input_low)} and {self.u(r.input_high)}."
        where = f"many levels from {self.u(r.input_low)} to {self.u(r.input_high)}"
        if 0 < len(r.input_levels) <= 4:
            levels = listed(f"{level:.4g}" for level in r.input_levels)
            where = f"{'about ' if self.found.moves.noisy else ''}{levels} {self.input}".rstrip()
        hold = f"holds for {self.t(r.shortest_hold)} or longer"
        return f"The input switches {r.input_changes} times between {where} and {hold}."

    def _output(self) -> Iterator[Finding]:
        r = self.r
        if r.input_kind == "continuous" and self.found.record.input.hold == "zoh":
            text = (
                "The input was not held: if it moves between the samples, straight lines (--hold foh) fit better, and "
                "behind an anti-alias filter a band-limited input (--hold band-limited); else the best is taken."
            )
            yield Finding("note", "hold", text)
        if not r.output_deviation > 1e-9 * abs(r.output_mean):
            yield Finding(
                "problem", "output", f"The output is constant at {self.y(r.output_mean)}: it does not answer."
            )
        if r.suggested_offset != "none" and r.output_deviation != 0:
            about = f"The output varies by {self.y(r.output_deviation)} about {self.y(r.output_mean)}"
            if r.input_kind != "constant":
                about += f", the input by {self.u(r.input_deviation)} about {self.u(r.input_mean)}"
            cure = "estimate it (--offset estimate); the mean is no operating point here"
            if r.suggested_offset == "remove":
                cure = "subtract the means (--offset remove) or estimate the offset (--offset estimate)"
            yield Finding("warning", "offset", f"{about}; a linear model has no such constant, so {cure}.")
        if not self._seldom and r.output_trend_error > 0:
            drift, significance = r.output_trend * r.duration, abs(r.output_trend) / r.output_trend_error
            if significance >= record_check.SIGNIFICANT and abs(drift) >= 0.3 * r.output_deviation:
                cure = "Unless the input drifts too, remove the trend or use a part without it (--from, --to)."
                text = (
                    f"The output drifts by {self.y(drift)} over the record ({significance:.2g} standard errors). {cure}"
                )
                yield Finding("warning", "trend", text)

    def _faults(self) -> Iterator[Finding]:
        r = self.r
        if r.outliers:
            where = ", ".join(self.t(t) for t in r.outliers[:3]) + (", ..." if len(r.outliers) > 3 else "")
            lie = "1 output sample lies" if len(r.outliers) == 1 else f"{len(r.outliers)} output samples lie"
            text = f"{lie} far from the neighbours (t = {where}); leave faults of the sensor empty."
            yield Finding("warning", "outliers", text)
        if r.saturated and not self._seldom:
            many = f"{100 * r.saturated:.2g} % of the output samples sit exactly at the least or greatest value"
            yield Finding("warning", "saturation", f"{many}, as at a limit of the sensor; leave those fields empty.")
        if math.isfinite(r.output_quantum):
            share = r.output_quantum / r.output_deviation
            steps = f"in steps of {self.y(r.output_quantum)}, {100 * share:.2g} % of its standard deviation"
            text = f"The output was recorded {steps}, like a noise of {self.y(r.output_quantum / math.sqrt(12))}."
            yield Finding("warning" if share > 0.1 else "note", "resolution", text)

    def _answer(self) -> Iterator[Finding]:
        r = self.r
        if r.input_kind == "constant" or r.output_deviation == 0:
            return
        if not self._answers:
            text = f"The output is not seen to answer to the input (p = {self.test.p_value:.2g}). {self.test.evidence}"
            why = "Too much noise, too short a record, a longer delay, or the wrong columns."
            level: Level = "problem" if r.n_samples - r.n_masked >= FEW_SAMPLES else "warning"
            yield Finding(level, "answer", f"{text} {why}")
            return
        if self._seldom:
            return
        weak = "Expect large standard errors; a longer record would help."
        share = f"At least {100 * min(r.explained, 0.999):.3g} % of the output's variance follows the input linearly"
        text = f"{share} (signal-to-noise ratio {r.snr_db:.2g} dB or better)."
        if r.explained >= EXPLAINED:
            yield Finding("ok", "answer", text)
        elif r.explained > 0:
            yield Finding("warning", "answer", f"{text} {weak}")
        elif not math.isnan(self.test.p_value):
            text = f"The output follows the input, but noise dominates at every frequency. {weak}"
            yield Finding("warning", "answer", text)

    def _speed(self) -> Iterator[Finding]:
        """Whether the clock is fast enough for the answer, and the record long enough."""
        r = self.r
        if not (r.explained > 0 or (r.input_kind == "steps" and self.found.answer.delay is not None)):
            return
        per_period, spans = 2 * math.pi / (r.output_bandwidth * r.interval), r.output_bandwidth * r.duration
        resolved = f"the clock resolves {self.w(r.nyquist)} ({per_period:.3g} samples in the shortest period)"
        text = f"95 % of the answer lies below {self.w(r.output_bandwidth)}; {resolved}."
        if per_period < FEW_PER_PERIOD:
            text += " What happens between the samples rests on the assumed hold of the input. Sample faster."
            yield Finding("warning", "clock", text)
        elif spans < 20:
            text += (
                f" The record lasts only {spans:.2g} times the time that goes with it: slow dynamics look like noise."
            )
            yield Finding("warning", "duration", text)
        else:
            yield Finding("ok", "clock", text)

    def _pairing(self) -> Iterator[Finding]:
        """What is odd about input and output together."""
        r, answer = self.r, self.found.answer
        own_times = not np.array_equal(self.found.record.input.t, self.found.record.t)
        if r.interval_deviation > JITTER * r.interval and r.input_kind in ("levels", "steps") and not own_times:
            late = f"late by {self.t(r.interval / 2)} on average, and the delay too short by as much"
            text = f"The input is known at irregular instants only: its changes seem {late}. Record when it changes."
            yield Finding("warning", "edges", text)
        if answer.fed_back:
            shown = f"at negative lags their correlation is {answer.before:.2g} times what chance gives"
            biased = "Noise in a closed loop biases the estimate; without a controller, look at the time stamps."
            yield Finding("warning", "feedback", f"The input seems to follow the output: {shown}. {biased}")

    def _delay(self) -> Iterator[Finding]:
        r = self.r
        if self.found.answer.delay is not None:
            low, high = r.suggested_delay or (0.0, math.nan)
            late = self.t(r.delay_late)
            when = f"between {self.t(r.delay_early)} and {late} after" if r.delay_early > 0 else f"within {late} of"
            search = f"search it from {low:g} to {self.t(high)} (--delay {low:g}:{high:g})"
            text = f"The output begins to answer {when} a change of the input, slow dynamics included; {search}."
            if math.isfinite(r.input_period):
                text += f" The input repeats itself every {self.t(r.input_period)}: delays that far apart look alike."
            wide = r.delay_late - r.delay_early > 0.5 * r.delay_late and r.input_kind == "steps"
            yield Finding("note" if wide else "ok", "delay", text)
        elif r.input_kind != "constant" and (r.explained > 0 or r.input_kind == "steps"):
            text = "The beginning of the answer is hidden in the noise; give the range of delays that you know."
            yield Finding("note", "delay", text)

    def _start(self) -> Iterator[Finding]:
        first, cure = f"during the first {self.t(self.r.delay_early)}", "(--initial-state estimate)"
        if self.r.starts == "moving":
            text = f"The output moves {first}, before it can answer: estimate the initial state {cure}."
            yield Finding("warning", "start", text)
        elif self.r.starts == "flat":
            yield Finding("ok", "start", f"The output is flat {first}: the record seems to begin at rest.")
        elif not self._seldom:
            text = f"The answer is too quick to see a start from rest; if unsure, estimate the initial state {cure}."
            yield Finding("note", "start", text)
