"""What ``ctid check`` says of a record: findings in words, then the numbers they rest on."""

import math
import shlex
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ctid_cli.canonical import plain
from ctid_cli.inference.record_check import RecordReport
from ctid_cli.reporting.layout import count, number
from ctid_cli.reporting.order_proposal import Proposal
from ctid_cli.signals.measurement import Measurement
from ctid_cli.signals.table import ROLES, USUAL_NAMES, split_header
from ctid_cli.text import wrapped

#: How the levels of findings are printed, the worst in capitals.
LABELS = {"problem": "PROBLEM", "warning": "warning", "note": "note", "ok": "ok"}


def record_object(measurement: Measurement, report: RecordReport, proposal: Proposal | None) -> dict[str, Any]:
    """A report as JSON-able content."""
    content = asdict(report)
    columns = {
        role: {"column": getattr(measurement, role), "unit": getattr(measurement, f"{role}_unit")} for role in ROLES
    }
    head = {"file": content.pop("name"), "columns": columns, "notes": measurement.notes, "worst": report.worst}
    proposed = None
    if proposal is not None:
        proposed = {"poles": proposal.poles, "zeros": proposal.zeros, "reason": proposal.sentence}
    return dict(plain({**head, **content, "proposed": proposed}))


def record_text(measurement: Measurement, report: RecordReport, proposal: Proposal | None) -> str:
    """A report for people."""
    columns = ", ".join(f"{role} {getattr(measurement, role)!r}" for role in ROLES)
    duration = f"{number(report.duration)} {measurement.time_unit or 's'}"
    head = f"{report.name}: {count(report.n_samples, 'sample')} in {duration}"
    parts = [f"{head} ({columns})", _verdict(report), *measurement.notes, ""]
    labels = max(len(LABELS[finding.level]) for finding in report.findings)
    topics = max(len(finding.topic) for finding in report.findings)
    for finding in report.findings:
        first = f"{LABELS[finding.level].ljust(labels)}  {finding.topic.ljust(topics)}  "
        parts.append(wrapped(finding.sentence, first, " " * len(first)))
    parts += ["", *_numbers(measurement, report)]
    if proposal is not None:
        parts += ["", wrapped(proposal.sentence)]
    if report.worst != "problem":
        parts += ["", "next: " + _next_command(measurement, report, proposal)]
    return "\n".join(parts)


def _verdict(report: RecordReport) -> str:
    n = sum(finding.level == report.worst for finding in report.findings)
    if report.worst == "problem":
        return f"No model can be identified from this record as it is: {count(n, 'problem')}."
    return f"Usable, with {count(n, 'warning')}." if report.worst == "warning" else "Nothing is wrong with this record."


def _numbers(measurement: Measurement, r: RecordReport) -> list[str]:
    """Aligned rows: what, value and unit, remark; those whose numbers the record does not show are left out."""
    time = measurement.time_unit or "s"
    rows: list[tuple[str, str, str]] = []

    def row(what: str, value: str, remark: str, known: float = 0.0) -> None:
        if math.isfinite(known):
            rows.append((what, value.strip(), remark.rstrip()))

    def span(low: float, high: float, unit: str) -> str:
        return f"from {number(low, 4)} to {number(high, 4)} {unit}"

    clock = "regular" if r.regular else span(r.interval_min, r.interval_max, time)
    row("sampling interval", f"{number(r.interval, 4)} {time}", clock)
    for signal, unit in (("input", measurement.input_unit or ""), ("output", measurement.output_unit or "")):
        mean, deviation, low, high = (getattr(r, f"{signal}_{name}") for name in ("mean", "deviation", "low", "high"))
        # What subtracting a mean leaves is rounding.
        shown = number(0.0 if abs(mean) < 1e-9 * deviation else mean, 4)
        row(f"{signal}, mean", f"{shown} {unit}", f"standard deviation {number(deviation, 4)} {unit}")
        row(f"{signal}, range", "", span(low, high, unit))
    remark = "of the part that follows the input linearly, at least"
    row("signal-to-noise ratio", f"{number(r.snr_db, 3)} dB", remark, r.snr_db)
    bandwidth, nyquist = (f"{float(f'{x:.3g}'):.12g} rad/{time}" for x in (r.output_bandwidth, r.nyquist))
    known = r.explained if r.input_kind != "steps" else 1.0
    row("bandwidth of the answer", bandwidth, f"Nyquist frequency {nyquist}", known)
    row("delay", "", span(r.delay_early, r.delay_late, time), r.delay_late)
    width, wide = (max(len(cells[k]) for cells in rows) for k in (0, 1))
    return [
        f"{what.ljust(width)}  {value.ljust(wide)}  {remark}" if value else f"{what.ljust(width)}  {remark}"
        for what, value, remark in rows
    ]


def _next_command(measurement: Measurement, report: RecordReport, proposal: Proposal | None) -> str:
    """The fit that findings and proposal suggest."""
    words = ["ctid", "fit", report.name]
    for role in ROLES:
        name = split_header(getattr(measurement, role))[0]
        if name.lower() not in USUAL_NAMES[role][:2] and Path(report.name).suffix.lower() != ".mat":
            words += [f"--{role}", name]
    poles, zeros = (1, 0) if proposal is None else (proposal.poles, proposal.zeros)
    words += ["--poles", str(poles), "--zeros", str(zeros)]
    bounds = report.suggested_delay if proposal is None else proposal.delay_bounds
    if bounds is not None:
        words += ["--delay", "{:g}:{:g}".format(*bounds)]
    if measurement.record.input.hold != "zoh":
        words += ["--hold", measurement.record.input.hold]
    for option, instant in (("--from", measurement.start), ("--to", measurement.stop)):
        words += [] if instant is None else [option, f"{instant:.12g}"]
    words += [] if report.suggested_offset == "none" else ["--offset", report.suggested_offset]
    words += [] if report.suggested_initial_state == "rest" else ["--initial-state", report.suggested_initial_state]
    return shlex.join(words)
