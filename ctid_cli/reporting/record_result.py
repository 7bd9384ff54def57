"""Result of ``ctid check``: facts on a record with their numbers, and the suggested command."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

from ctid_cli.identification.record_findings import Finding, Level, findings
from ctid_cli.inference.record_facts import RecordFacts
from ctid_cli.inference.response_estimates import Estimate
from ctid_cli.reporting.document import Result, Section, Table
from ctid_cli.signals.measurement import Measurement
from ctid_cli.signals.table import ROLES
from ctid_cli.text import count

#: Keys of the estimates in JSON: value, and ends of the 95 % interval.
KEYS = {
    "signal_to_noise": ("snr_db", "snr_db_low", "snr_db_high"),
    "response_time": ("response_time", "response_time_low", "response_time_high"),
    "delay": ("delay", "delay_early", "delay_late"),
}
#: A mean below this fraction of the standard deviation is the rounding of a subtracted mean.
ROUNDING = 1e-9
#: Columns of numbers; the value of a signal is its mean.
NUMBERS = ("value", "standard deviation", "low", "high")


@dataclass(frozen=True, eq=False)
class RecordCheckResult(Result):
    """Facts on a measured record, and the command that identifies a model of it."""

    schema = "ctid-check-1"

    measurement: Measurement
    facts: RecordFacts
    #: None if no model can be identified.
    command: str | None = None

    def sections(self) -> list[Section]:
        """Return facts, numbers, and the suggested command."""
        measurement, facts = self.measurement, self.facts
        columns = ", ".join(f"{role} {getattr(measurement, role)!r}" for role in ROLES)
        duration = f"{facts.duration:.6g} {measurement.time_unit or 's'}"
        head = f"{facts.name}: {count(facts.n_samples, 'sample')} in {duration} ({columns})"
        found = [f"- {_label(each.level)}, {each.topic}: {each.sentence}" for each in self.findings]
        return [
            Section("", [head, *measurement.notes]),
            Section("", found),
            Section(table=self.main_table()),
            Section("", [] if self.command is None else [f"next:\n    {self.command}"]),
        ]

    @property
    def findings(self) -> list[Finding]:
        """Facts in sentences, the worst first."""
        measured = self.measurement
        units = measured.time_unit or "s", measured.input_unit or "", measured.output_unit or ""
        return findings(self.facts, *units)

    @property
    def worst(self) -> Level:
        """Level of the worst fact."""
        return self.findings[0].level

    def main_table(self) -> Table:
        """Return the numbers of the record with their units; low and high of estimates are 95 % intervals."""
        facts, time = self.facts, self.measurement.time_unit or "s"
        none, frequency, output = math.nan, f"rad/{time}", self.measurement.output_unit
        jitter = 0.0 if facts.regular else facts.interval_deviation
        parts = facts.parts
        terms = [
            (name, term) for name, term in (("offset", parts.offset), ("drift over the record", parts.drift)) if term
        ]
        rows = [
            ("sampling interval", facts.interval, jitter, facts.interval_min, facts.interval_max, time),
            ("Nyquist frequency", facts.nyquist, none, none, none, frequency),
            ("input", *_level(facts, "input"), self.measurement.input_unit),
            ("output", *_level(facts, "output"), output),
            ("signal-to-noise ratio", *_row(parts.signal_to_noise), "dB"),
            ("response time (63 %)", *_row(parts.response_time), time),
            ("delay", *_row(parts.delay), time),
            *((name, term.value, none, term.low, term.high, output) for name, term in terms),
        ]
        known = [(*row[:-1], row[-1] or "") for row in rows if not all(map(math.isnan, row[1:-1]))]
        titles, formats = ["quantity", *NUMBERS, "unit"], dict.fromkeys(NUMBERS, ".4g")
        return Table.of_lines(titles, known, formats=formats, is_named=True)

    def content(self) -> dict[str, Any]:
        """Return facts and command for JSON."""
        content = asdict(self.facts)
        parts = content.pop("parts")
        for name, keys in KEYS.items():
            parts.update(zip(keys, parts.pop(name), strict=True))
        columns = {
            role: {"column": getattr(self.measurement, role), "unit": getattr(self.measurement, f"{role}_unit")}
            for role in ROLES
        }
        head = {"file": content.pop("name"), "columns": columns, "notes": self.measurement.notes}
        found = {"findings": [finding._asdict() for finding in self.findings], "command": self.command}
        return {**head, "worst": self.worst, **content, **parts, **found}


def _row(estimate: Estimate) -> tuple[float, float, float, float]:
    """Return value and ends of the interval of an estimate, without a standard deviation."""
    return estimate.value, math.nan, estimate.low, estimate.high


def _level(facts: RecordFacts, signal: str) -> tuple[float, float, float, float]:
    """Return mean, standard deviation, least and greatest value of a signal."""
    mean, deviation, low, high = (getattr(facts, f"{signal}_{name}") for name in ("mean", "deviation", "low", "high"))
    return 0.0 if abs(mean) < ROUNDING * deviation else mean, deviation, low, high


def _label(level: str) -> str:
    return level.upper() if level == "problem" else level
