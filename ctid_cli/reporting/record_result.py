"""The result of ``ctid check``: findings about a record, the numbers they rest on, and a structure to begin with."""

from __future__ import annotations

import shlex
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ctid_cli.identification.choice import Choice
from ctid_cli.inference.record_check import RecordReport
from ctid_cli.reporting.document import Result, Section
from ctid_cli.signals.measurement import Measurement
from ctid_cli.signals.table import ROLES, USUAL_NAMES, split_header
from ctid_cli.text import count

#: A mean below this fraction of the standard deviation is what rounding leaves where a mean was subtracted.
ROUNDING = 1e-9
#: Columns of numbers; the value of a signal is its mean.
NUMBERS = ("value", "standard deviation", "low", "high")


@dataclass(frozen=True, eq=False)
class RecordCheckResult(Result):
    """Findings about a measured record, with the structure that is proposed for it, if any."""

    measurement: Measurement
    report: RecordReport
    proposal: Choice | None

    def sections(self) -> list[Section]:
        """Return findings, numbers, and how to go on."""
        measurement, report = self.measurement, self.report
        columns = ", ".join(f"{role} {getattr(measurement, role)!r}" for role in ROLES)
        duration = f"{report.duration:.6g} {measurement.time_unit or 's'}"
        head = f"{report.name}: {count(report.n_samples, 'sample')} in {duration} ({columns})"
        found = [f"- {_label(each.level)}, {each.topic}: {each.sentence}" for each in report.findings]
        further = [] if report.worst == "problem" else [f"next:\n    {self.next_command()}"]
        return [
            Section("", [head, self.verdict, *measurement.notes]),
            Section("", found),
            Section(frame=self.to_frame(), formats=dict.fromkeys(NUMBERS, ".4g")),
            Section("", [] if self.proposal is None else self.proposal.sentences),
            Section("", further),
        ]

    @property
    def verdict(self) -> str:
        """Return the worst of the findings in one sentence."""
        worst = self.report.worst
        n = sum(finding.level == worst for finding in self.report.findings)
        if worst == "problem":
            return f"No model can be identified from this record as it is: {count(n, 'problem')}."
        return f"Usable, with {count(n, 'warning')}." if worst == "warning" else "Nothing is wrong with this record."

    def to_frame(self) -> pd.DataFrame:
        """Return the numbers of the record that it shows, with their units."""
        r, time = self.report, self.measurement.time_unit or "s"
        none, frequency = np.nan, f"rad/{time}"
        bandwidth = r.output_bandwidth if r.input_kind == "steps" or r.explained > 0 else none
        jitter = 0.0 if r.regular else r.interval_deviation
        rows = [
            ("sampling interval", r.interval, jitter, r.interval_min, r.interval_max, time),
            ("Nyquist frequency", r.nyquist, none, none, none, frequency),
            ("input", *_level(r, "input"), self.measurement.input_unit),
            ("output", *_level(r, "output"), self.measurement.output_unit),
            ("signal-to-noise ratio, at least", r.snr_db, none, none, none, "dB"),
            ("bandwidth of the response", bandwidth, none, none, none, frequency),
            ("delay", none, none, r.delay_early, r.delay_late, time),
        ]
        frame = pd.DataFrame(rows, columns=["quantity", *NUMBERS, "unit"]).set_index("quantity")
        return frame.fillna({"unit": ""}).dropna(how="all", subset=list(NUMBERS))

    def next_command(self) -> str:
        """Return the fit that findings and proposal suggest."""
        measurement, report, proposal = self.measurement, self.report, self.proposal
        words = ["ctid", "fit", report.name]
        for role in ROLES:
            name = split_header(getattr(measurement, role))[0]
            if name.lower() not in USUAL_NAMES[role][:2] and Path(report.name).suffix.lower() != ".mat":
                words += [f"--{role}", name]
        words += [] if proposal is None else proposal.words()
        for option, value in (("--from", _instant(measurement.start)), ("--to", _instant(measurement.stop))):
            words += [] if value is None else [option, str(value)]
        return shlex.join(words)

    def content(self) -> dict[str, Any]:
        """Return numbers, findings and proposal for JSON."""
        content = asdict(self.report)
        proposal = self.proposal
        proposed = proposal and {
            **{name: getattr(proposal.options, name) for name in ("poles", "zeros", "integrators")},
            "reason": " ".join(proposal.sentences),
        }
        columns = {
            role: {"column": getattr(self.measurement, role), "unit": getattr(self.measurement, f"{role}_unit")}
            for role in ROLES
        }
        head = {"file": content.pop("name"), "columns": columns, "notes": self.measurement.notes}
        return {**head, "worst": self.report.worst, **content, "proposed": proposed}


def _level(report: RecordReport, signal: str) -> tuple[float, float, float, float]:
    """Return mean, standard deviation, least and greatest value of a signal."""
    mean, deviation, low, high = (getattr(report, f"{signal}_{name}") for name in ("mean", "deviation", "low", "high"))
    return 0.0 if abs(mean) < ROUNDING * deviation else mean, deviation, low, high


def _label(level: str) -> str:
    return level.upper() if level == "problem" else level


def _instant(value: float | None) -> str | None:
    return None if value is None else f"{value:.12g}"
