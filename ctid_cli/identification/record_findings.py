"""Facts on a record in sentences, each with its level."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, NamedTuple

from ctid_cli.inference.record_facts import FEWEST_SAMPLES, HIGHEST_ORDER, LONG_INTERVAL, RecordFacts
from ctid_cli.inference.record_tests import LEVEL, SlowTerm
from ctid_cli.inference.response_estimates import Estimate
from ctid_cli.inference.response_test import LEVEL as NO_RESPONSE
from ctid_cli.text import count, listed, probability

Level = Literal["ok", "note", "warning", "problem"]
#: Levels from the best to the worst.
LEVELS: tuple[Level, ...] = ("ok", "note", "warning", "problem")
#: An irregular clock counts as regular with jitter if the standard deviation of its intervals is below this fraction.
JITTER = 0.05
#: Below this order of excitation a model with a delay cannot be distinguished from one without.
ENOUGH_ORDER = 4
#: How a loop is declared.
LOOP = "if a controller sets the input, fit with --loop FILE, which describes it, or with --loop unknown"


class Finding(NamedTuple):
    """One fact on a record."""

    level: Level
    topic: str
    sentence: str


def findings(facts: RecordFacts, time: str, input: str, output: str) -> list[Finding]:
    """Return the facts on a record in sentences, with the units of its signals, the worst first."""
    return sorted(_Sentences(facts, time, input, output), key=lambda finding: -LEVELS.index(finding.level))


def _needed(low: float, high: float, digits: int) -> int:
    """Return the number of digits by which the ends of a narrow range differ, at least ``digits``."""
    size, width = max(abs(low), abs(high)), high - low
    return digits + max(math.floor(math.log10(size / width)) - 1, 0) if 0.0 < width < math.inf else digits


def _digits(x: float, digits: int) -> str:
    """Return a rounded number without an unneeded exponent."""
    return f"{float(f'{x:.{digits}g}'):.12g}"


@dataclass(frozen=True)
class _Sentences:
    """The facts on a record in sentences, in the order of signals and time."""

    facts: RecordFacts
    time: str
    input: str
    output: str

    def t(self, x: float) -> str:
        return f"{_digits(x, 4)} {self.time}"

    def u(self, x: float) -> str:
        return f"{_digits(x, _needed(self.facts.input_low, self.facts.input_high, 4))} {self.input}".rstrip()

    def y(self, x: float) -> str:
        return f"{_digits(x, 3)} {self.output}".rstrip()

    def __iter__(self) -> Iterator[Finding]:
        yield from self._clock()
        yield self._input()
        yield from self._output()
        if self.facts.input_kind != "constant" and not self.facts.output_constant:
            yield self._response()
        yield from self._tests()

    def _clock(self) -> Iterator[Finding]:
        f = self.facts
        present = f.n_samples - f.n_masked
        if present < FEWEST_SAMPLES:
            text = "offset, drift, start, outliers, feedback and noise are not tested."
            yield Finding("warning", "samples", f"Only {count(present, 'output sample')}: {text}")
        spread = f"{self.t(f.interval_min)} to {self.t(f.interval_max)}, median {self.t(f.interval)}"
        if f.regular:
            yield Finding("ok", "sampling", f"The clock is regular, one sample every {self.t(f.interval)}.")
        elif f.gaps and f.interval_deviation < 1e-6 * f.interval:
            yield Finding(
                "ok", "sampling", f"The clock is regular but for gaps, one sample every {self.t(f.interval)}."
            )
        elif f.interval_deviation < JITTER * f.interval:
            share = f"{100 * f.interval_deviation / f.interval:.2g} %"
            yield Finding("note", "sampling", f"The clock jitters: intervals of {spread}, standard deviation {share}.")
        elif math.isfinite(f.interval):
            yield Finding("note", "sampling", f"The clock is irregular: intervals of {spread}.")
        if f.gaps:
            longest = max(f.gaps, key=lambda gap: gap.length)
            many = f"{len(f.gaps)} gaps" if len(f.gaps) > 1 else "A gap"
            where = f"the longest of {self.t(longest.length)} after t = {self.t(longest.start)}"
            yield Finding("warning", "gaps", f"{many} longer than {LONG_INTERVAL:g} median intervals, {where}.")
        if f.n_masked:
            share, verb = f"{100 * f.n_masked / f.n_samples:.2g} %", "is" if f.n_masked == 1 else "are"
            text = f"{f.n_masked} of {f.n_samples} output samples ({share}) {verb} missing."
            yield Finding("note", "missing", text)

    def _input(self) -> Finding:
        f = self.facts
        if f.input_kind == "constant":
            text = f"The input is constant at {self.u(f.input_low)}: it shows no response"
            remedy = "if it was at another level before the record, give that level (ctid fit --input-before VALUE)"
            return Finding("problem", "input", f"{text}; {remedy}.")
        if f.input_kind == "steps":
            times = "once" if f.input_changes == 1 else f"{f.input_changes} times"
            return Finding("note", "input", f"The input changes only {times}, {self._levels()}.")
        least = "at least " if f.excitation_order >= HIGHEST_ORDER else ""
        text = f"It is persistently exciting of order {least}{f.excitation_order}"
        low, high = f.input_band
        band = f"; 95 % of its power lies from {_digits(low, 2)} to {_digits(high, 3)} rad/{self.time}"
        moves = f"The input moves continuously between {self.u(f.input_low)} and {self.u(f.input_high)}."
        if f.input_kind == "levels":
            times = f"{f.input_changes} times {self._levels()}"
            moves = f"The input switches {times} and holds for {self.t(f.shortest_hold)} or longer."
        period = f" It repeats itself every {self.t(f.input_period)}." if math.isfinite(f.input_period) else ""
        level: Level = "warning" if f.excitation_order < ENOUGH_ORDER else "ok"
        return Finding(level, "input", f"{moves} {text}{band * math.isfinite(low)}.{period}")

    def _levels(self) -> str:
        f = self.facts
        if 0 < len(f.input_levels) <= 4:
            digits = _needed(f.input_low, f.input_high, 4)
            return f"between {listed(_digits(level, digits) for level in f.input_levels)} {self.input}".rstrip()
        return f"between many levels from {self.u(f.input_low)} to {self.u(f.input_high)}"

    def _output(self) -> Iterator[Finding]:
        f = self.facts
        if math.isfinite(f.growth_time):
            text = (
                f"The output diverges: it grows by a factor of e every {self.t(f.growth_time)}, and the input does not"
            )
            remedy = "an unstable plant is not among the models; in a loop, give the controller (ctid fit --loop FILE)"
            yield Finding("problem", "growth", f"{text}; {remedy}.")
        if f.output_constant:
            yield Finding(
                "problem", "output", f"The output is constant at {self.y(f.output_mean)}: it does not respond."
            )
        if f.saturated:
            text = f"{100 * f.saturated:.2g} % of the output samples sit exactly at the least or greatest value"
            yield Finding("warning", "saturation", f"{text}, as at a limit.")
        if math.isfinite(f.output_quantum):
            share = f.output_quantum / f.output_deviation
            text = f"The output was recorded in steps of {self.y(f.output_quantum)}"
            level: Level = "warning" if share > 0.1 else "note"
            yield Finding(level, "resolution", f"{text}, {100 * share:.2g} % of its standard deviation.")
        if f.parts.outliers:
            where = ", ".join(self.t(t) for t in f.parts.outliers[:3]) + (", ..." if len(f.parts.outliers) > 3 else "")
            lies = count(len(f.parts.outliers), "output sample") + (" lies" if len(f.parts.outliers) == 1 else " lie")
            yield Finding("warning", "outliers", f"{lies} farther from the others than noise explains (t = {where}).")

    def _response(self) -> Finding:
        f = self.facts
        p = probability(f.answer_p_value)
        if math.isnan(f.answer_p_value):
            return Finding("note", "response", "Whether the output responds to the input cannot be tested.")
        if f.answer_p_value > NO_RESPONSE:
            text = (
                f"No response of the output to the input is seen: noise of its colour follows the input as much ({p})."
            )
            few = f.n_samples - f.n_masked < FEWEST_SAMPLES
            return Finding("warning" if few else "problem", "response", text)
        ratio, time, delay = f.parts.signal_to_noise, f.parts.response_time, f.parts.delay
        parts = [f"The output responds to the input ({p})"]
        if not math.isnan(ratio.value):
            parts.append(f"signal-to-noise ratio {self._interval(ratio, 'dB')}")
        if not math.isnan(delay.value):
            parts.append(
                f"the response begins {_digits(delay.low, 3)} to {self.t(delay.high)} after a change of the input"
            )
        ended = "its end is not seen" if not math.isnan(ratio.value) else ""
        if not math.isnan(time.value):
            ended = f"63 % of it is reached after {self._interval(time, self.time)}"
        return Finding("ok", "response", "; ".join(filter(None, [*parts, ended])) + ".")

    def _interval(self, estimate: Estimate | SlowTerm, unit: str) -> str:
        digits = _needed(estimate.low, estimate.high, 3)
        ends = f"{_digits(estimate.low, digits)} to {_digits(estimate.high, digits)}"
        return f"{_digits(estimate.value, digits)} {unit}".rstrip() + f" ({ends})"

    def _tests(self) -> Iterator[Finding]:
        """Yield the components besides the response, and those not detected."""
        parts = self.facts.parts
        if parts.offset is None or parts.drift is None or parts.start is None:
            return
        rest = f"an input of {self.u(parts.input_at_rest)}"
        named = [
            ("offset", parts.offset, f"At {rest} the output rests at"),
            ("drift", parts.drift, "Beside the response the output drifts over the record by"),
            ("start", parts.start, "The record does not begin at rest: at first the output is off by"),
        ]
        missed = []
        for topic, term, words in named:
            size = self._interval(term, self.output)
            if term.detected:
                # Nearly every process has an operating point.
                yield Finding(
                    "note" if topic == "offset" else "warning", topic, f"{words} {size}, {probability(term.p_value)}."
                )
            else:
                missed.append(f"{topic} {size}")
        p = probability(parts.feedback_p_value)
        if parts.feedback_p_value <= LEVEL:
            text = f"The input follows the noise of the output, as in a loop ({p})"
            yield Finding("warning", "feedback", f"{text}; {LOOP}.")
        else:
            missed.append(f"feedback ({p})")
        missed += ["outliers"] * (not parts.outliers) + ["saturation"] * (not self.facts.saturated)
        if missed:
            text = "; ".join(missed)
            rule = f"the tests are at the level of {LEVEL:g}, so that a 95 % interval may exclude 0"
            yield Finding("ok", "not detected", f"{text}. Small effects may be present: {rule}.")
