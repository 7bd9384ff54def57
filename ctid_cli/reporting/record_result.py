"""The result of ``ctid check``: facts on a record, each with the numbers that show it, and the command to run."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
import pandas as pd

from ctid_cli.inference.record_facts import FEWEST_SAMPLES, HIGHEST_ORDER, LONG_INTERVAL, RecordFacts
from ctid_cli.inference.record_tests import LEVEL, SlowTerm
from ctid_cli.inference.response_estimates import Estimate
from ctid_cli.inference.response_test import LEVEL as NO_RESPONSE
from ctid_cli.reporting.document import Result, Section
from ctid_cli.signals.measurement import Measurement
from ctid_cli.signals.table import ROLES
from ctid_cli.text import count, listed

Level = Literal["ok", "note", "warning", "problem"]
#: From the best to the worst.
LEVELS: tuple[Level, ...] = ("ok", "note", "warning", "problem")
#: An irregular clock is regular but for jitter where the standard deviation of its intervals is below this fraction.
JITTER = 0.05
#: Below this order of excitation no model with a delay can be told from one without.
ENOUGH_ORDER = 4
#: A mean below this fraction of the standard deviation is what rounding leaves where a mean was subtracted.
ROUNDING = 1e-9
#: Keys of the estimates in JSON: value, and ends of the 95 % interval.
KEYS = {
    "signal_to_noise": ("snr_db", "snr_db_low", "snr_db_high"),
    "response_time": ("response_time", "response_time_low", "response_time_high"),
    "delay": ("delay", "delay_early", "delay_late"),
}
#: Columns of numbers; the value of a signal is its mean.
NUMBERS = ("value", "standard deviation", "low", "high")


class Finding(NamedTuple):
    """One fact on a record."""

    level: Level
    topic: str
    sentence: str


@dataclass(frozen=True, eq=False)
class RecordCheckResult(Result):
    """Facts on a measured record, and the command that identifies a model of it."""

    schema = "ctid-check-1"

    measurement: Measurement
    facts: RecordFacts
    #: None where no model can be identified.
    command: str | None = None

    def sections(self) -> list[Section]:
        """Return facts, numbers, and the command to run."""
        measurement, facts = self.measurement, self.facts
        columns = ", ".join(f"{role} {getattr(measurement, role)!r}" for role in ROLES)
        duration = f"{facts.duration:.6g} {measurement.time_unit or 's'}"
        head = f"{facts.name}: {count(facts.n_samples, 'sample')} in {duration} ({columns})"
        found = [f"- {_label(each.level)}, {each.topic}: {each.sentence}" for each in self.findings]
        return [
            Section("", [head, *measurement.notes]),
            Section("", found),
            Section(frame=self.to_frame(), formats=dict.fromkeys(NUMBERS, ".4g")),
            Section("", [] if self.command is None else [f"next:\n    {self.command}"]),
        ]

    @property
    def findings(self) -> list[Finding]:
        """Return the facts in sentences, the worst first."""
        units = (
            self.measurement.time_unit or "s",
            self.measurement.input_unit or "",
            self.measurement.output_unit or "",
        )
        return sorted(_Sentences(self.facts, *units), key=lambda finding: -LEVELS.index(finding.level))

    @property
    def worst(self) -> Level:
        """Return the level of the worst fact."""
        return self.findings[0].level

    def to_frame(self) -> pd.DataFrame:
        """Return the numbers of the record with their units; low and high of estimates are 95 % intervals."""
        facts, time = self.facts, self.measurement.time_unit or "s"
        none, frequency, output = np.nan, f"rad/{time}", self.measurement.output_unit
        jitter = 0.0 if facts.regular else facts.interval_deviation
        beside = facts.beside
        terms = [
            (name, term) for name, term in (("offset", beside.offset), ("drift over the record", beside.drift)) if term
        ]
        rows = [
            ("sampling interval", facts.interval, jitter, facts.interval_min, facts.interval_max, time),
            ("Nyquist frequency", facts.nyquist, none, none, none, frequency),
            ("input", *_level(facts, "input"), self.measurement.input_unit),
            ("output", *_level(facts, "output"), output),
            ("signal-to-noise ratio", *_row(beside.signal_to_noise), "dB"),
            ("response time (63 %)", *_row(beside.response_time), time),
            ("delay", *_row(beside.delay), time),
            *((name, term.value, none, term.low, term.high, output) for name, term in terms),
        ]
        frame = pd.DataFrame(rows, columns=["quantity", *NUMBERS, "unit"]).set_index("quantity")
        return frame.fillna({"unit": ""}).dropna(how="all", subset=list(NUMBERS))

    def content(self) -> dict[str, Any]:
        """Return facts and command for JSON."""
        content = asdict(self.facts)
        beside = content.pop("beside")
        for name, keys in KEYS.items():
            beside.update(zip(keys, beside.pop(name), strict=True))
        columns = {
            role: {"column": getattr(self.measurement, role), "unit": getattr(self.measurement, f"{role}_unit")}
            for role in ROLES
        }
        head = {"file": content.pop("name"), "columns": columns, "notes": self.measurement.notes}
        found = {"findings": [finding._asdict() for finding in self.findings], "command": self.command}
        return {**head, "worst": self.worst, **content, **beside, **found}


def _row(estimate: Estimate) -> tuple[float, float, float, float]:
    """Return value and ends of the interval of an estimate, without a standard deviation."""
    return estimate.value, math.nan, estimate.low, estimate.high


def _level(facts: RecordFacts, signal: str) -> tuple[float, float, float, float]:
    """Return mean, standard deviation, least and greatest value of a signal."""
    mean, deviation, low, high = (getattr(facts, f"{signal}_{name}") for name in ("mean", "deviation", "low", "high"))
    return 0.0 if abs(mean) < ROUNDING * deviation else mean, deviation, low, high


def _label(level: str) -> str:
    return level.upper() if level == "problem" else level


def _digits(x: float, digits: int) -> str:
    """Rounded, without an exponent that is not needed."""
    return f"{float(f'{x:.{digits}g}'):.12g}"


def _probability(p: float) -> str:
    return f"p = {p:.2g}" if p >= 1e-4 else "p < 0.0001"


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
        return f"{_digits(x, 4)} {self.input}".rstrip()

    def y(self, x: float) -> str:
        return f"{_digits(x, 3)} {self.output}".rstrip()

    def __iter__(self) -> Iterator[Finding]:
        yield from self._clock()
        yield self._input()
        yield from self._output()
        if self.facts.input_kind != "constant" and self.facts.output_deviation > 0:
            yield self._response()
        yield from self._tests()

    def _clock(self) -> Iterator[Finding]:
        f = self.facts
        present = f.n_samples - f.n_masked
        if present < FEWEST_SAMPLES:
            text = f"Only {present} output samples: offset, drift, start, outliers, feedback and noise are not tested."
            yield Finding("warning", "samples", text)
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
            remedy = "where it was at another level before the record, type that level (ctid fit --input-before VALUE)"
            return Finding("problem", "input", f"{text}; {remedy}.")
        if f.input_kind == "steps":
            times = "once" if f.input_changes == 1 else f"{f.input_changes} times"
            return Finding("note", "input", f"The input changes only {times}, {self._levels()}.")
        least = "at least " if f.excitation_order >= HIGHEST_ORDER else ""
        text = f"It is persistently exciting of order {least}{f.excitation_order}"
        band = f"{_digits(f.input_band[0], 2)} to {_digits(f.input_band[1], 3)} rad/{self.time}"
        moves = f"The input moves continuously between {self.u(f.input_low)} and {self.u(f.input_high)}."
        if f.input_kind == "levels":
            times = f"{f.input_changes} times {self._levels()}"
            moves = f"The input switches {times} and holds for {self.t(f.shortest_hold)} or longer."
        period = f" It repeats itself every {self.t(f.input_period)}." if math.isfinite(f.input_period) else ""
        level: Level = "warning" if f.excitation_order < ENOUGH_ORDER else "ok"
        return Finding(level, "input", f"{moves} {text}; 95 % of its power lies from {band}.{period}")

    def _levels(self) -> str:
        f = self.facts
        if 0 < len(f.input_levels) <= 4:
            return f"between {listed(f'{level:.4g}' for level in f.input_levels)} {self.input}".rstrip()
        return f"between many levels from {self.u(f.input_low)} to {self.u(f.input_high)}"

    def _output(self) -> Iterator[Finding]:
        f = self.facts
        if not f.output_deviation > ROUNDING * abs(f.output_mean):
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
        if f.beside.outliers:
            where = ", ".join(self.t(t) for t in f.beside.outliers[:3]) + (
                ", ..." if len(f.beside.outliers) > 3 else ""
            )
            lies = count(len(f.beside.outliers), "output sample") + (" lies" if len(f.beside.outliers) == 1 else " lie")
            yield Finding("warning", "outliers", f"{lies} farther from the others than noise explains (t = {where}).")

    def _response(self) -> Finding:
        f = self.facts
        p = _probability(f.answer_p_value)
        if f.answer_p_value > NO_RESPONSE:
            text = (
                f"No response of the output to the input is seen: noise of its colour follows the input as much ({p})."
            )
            few = f.n_samples - f.n_masked < FEWEST_SAMPLES
            return Finding("warning" if few else "problem", "response", text)
        ratio, time, delay = f.beside.signal_to_noise, f.beside.response_time, f.beside.delay
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
        ends = f"{_digits(estimate.low, 3)} to {_digits(estimate.high, 3)}"
        return f"{_digits(estimate.value, 3)} {unit}".rstrip() + f" ({ends})"

    def _tests(self) -> Iterator[Finding]:
        """What stands beside the response, and what of it is not detected."""
        beside = self.facts.beside
        if beside.offset is None or beside.drift is None or beside.start is None:
            return
        rest = f"an input of {self.u(beside.input_at_rest)}"
        named = [
            ("offset", beside.offset, f"At {rest} the output rests at"),
            ("drift", beside.drift, "Beside the response the output drifts over the record by"),
            ("start", beside.start, "The record does not begin at rest: at first the output is off by"),
        ]
        missed = []
        for topic, term, words in named:
            size = self._interval(term, self.output)
            if term.detected:
                yield Finding("warning", topic, f"{words} {size}, {_probability(term.p_value)}.")
            else:
                missed.append(f"{topic} {size}")
        p = _probability(beside.feedback_p_value)
        if beside.feedback_p_value <= LEVEL:
            yield Finding("warning", "feedback", f"The input goes with the noise of the output, as in a loop ({p}).")
        else:
            missed.append(f"feedback ({p})")
        missed += ["outliers"] * (not beside.outliers) + ["saturation"] * (not self.facts.saturated)
        if missed:
            text = "; ".join(missed)
            yield Finding("ok", "not detected", f"{text}. This rules nothing out: the intervals hold 95 %.")
