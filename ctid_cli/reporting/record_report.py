"""What ``ctid check`` says of a record: findings in words, then the numbers they rest on."""

from __future__ import annotations

import math
import shlex
import textwrap
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ctid_cli.inference.record_check import RecordReport
from ctid_cli.reporting.layout import count, number
from ctid_cli.signals.measurement import ROLES, USUAL_NAMES, Measurement
from ctid_cli.signals.table import split_header

#: Lines of text are no longer than this.
WIDTH = 100
#: How the levels of findings are printed, the worst in capitals.
LABELS = {"problem": "PROBLEM", "warning": "warning", "note": "note", "ok": "ok"}


def record_object(measurement: Measurement, report: RecordReport) -> dict[str, Any]:
    """A report as JSON-able content."""
    content = asdict(report)
    columns = {
        role: {"column": column, "unit": unit}
        for role, column, unit in (
            ("time", measurement.time, measurement.time_unit),
            ("input", measurement.input, measurement.input_unit),
            ("output", measurement.output, measurement.output_unit),
        )
    }
    found: dict[str, Any] = _finite(
        {"file": content.pop("name"), "columns": columns, "notes": measurement.notes, "worst": report.worst, **content}
    )
    return found


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def record_text(measurement: Measurement, report: RecordReport) -> str:
    """A report for people."""
    columns = ", ".join(
        f"{role} {column!r}"
        for role, column in (
            ("time", measurement.time),
            ("input", measurement.input),
            ("output", measurement.output),
        )
    )
    head = f"{report.name}: {count(report.n_samples, 'sample')} in {number(report.duration)} {_time(measurement)}"
    parts = [f"{head} ({columns})", _verdict(report), *measurement.notes, ""]
    labels = max(len(LABELS[finding.level]) for finding in report.findings)
    topics = max(len(finding.topic) for finding in report.findings)
    for finding in report.findings:
        first = f"{LABELS[finding.level].ljust(labels)}  {finding.topic.ljust(topics)}  "
        parts.append(
            textwrap.fill(
                finding.sentence,
                WIDTH,
                initial_indent=first,
                subsequent_indent=" " * len(first),
                break_long_words=False,
                break_on_hyphens=False,
            )
        )
    parts += ["", *_numbers(measurement, report)]
    if report.worst != "problem":
        parts += ["", "next: " + _next_command(measurement, report)]
    return "\n".join(parts)


def _time(measurement: Measurement) -> str:
    return measurement.time_unit or "s"


def _verdict(report: RecordReport) -> str:
    problems = sum(finding.level == "problem" for finding in report.findings)
    warnings = sum(finding.level == "warning" for finding in report.findings)
    if problems:
        return f"No model can be identified from this record as it is: {count(problems, 'problem')}."
    if warnings:
        return f"Usable, with {count(warnings, 'warning')}."
    return "Nothing is wrong with this record."


def _numbers(measurement: Measurement, report: RecordReport) -> list[str]:
    """Aligned rows: what, value and unit, remark."""
    time, u, y = _time(measurement), measurement.input_unit or "", measurement.output_unit or ""
    w = f"rad/{time}"
    r = report

    def spread(low: float, high: float, unit: str) -> str:
        return f"from {number(low, 4)} to {number(high, 4)} {unit}".rstrip()

    def mean(value: float, deviation: float) -> str:
        # What subtracting a mean leaves is rounding.
        return number(0.0 if abs(value) < 1e-9 * deviation else value, 4)

    clock = "regular" if r.regular else spread(r.interval_min, r.interval_max, time)
    rows = [
        ("sampling interval", number(r.interval, 4), time, clock),
        (
            "input, mean",
            mean(r.input_mean, r.input_deviation),
            u,
            f"standard deviation {number(r.input_deviation, 4)} {u}".rstrip(),
        ),
        ("input, range", "", "", spread(r.input_low, r.input_high, u)),
        (
            "output, mean",
            mean(r.output_mean, r.output_deviation),
            y,
            f"standard deviation {number(r.output_deviation, 4)} {y}".rstrip(),
        ),
        ("output, range", "", "", spread(r.output_low, r.output_high, y)),
        ("signal-to-noise ratio", number(r.snr_db, 3), "dB", "of the part that follows the input linearly, at least"),
        (
            "bandwidth of the answer",
            f"{float(f'{r.output_bandwidth:.3g}'):.12g}",
            w,
            f"Nyquist frequency {float(f'{r.nyquist:.3g}'):.12g} {w}",
        ),
        ("delay", "", "", spread(r.delay_early, r.delay_late, time)),
    ]
    shown = [
        row
        for row, known in zip(
            rows,
            (True, True, True, True, True, r.snr_db, r.explained if r.input_kind != "steps" else 1.0, r.delay_late),
            strict=True,
        )
        if known is True or (isinstance(known, float) and math.isfinite(known))
    ]
    width = max(len(row[0]) for row in shown)
    values = [f"{value} {unit}".strip() for _, value, unit, _ in shown]
    wide = max(map(len, values))
    lines = []
    for (what, _, _, remark), value in zip(shown, values, strict=True):
        lines.append(
            f"{what.ljust(width)}  {remark}" if not value else f"{what.ljust(width)}  {value.ljust(wide)}  {remark}"
        )
    return [line.rstrip() for line in lines]


def _next_command(measurement: Measurement, report: RecordReport) -> str:
    """The fit that the findings suggest."""
    words = ["ctid", "fit", report.name]
    for role, column in zip(ROLES, (measurement.time, measurement.input, measurement.output), strict=True):
        name = split_header(column)[0]
        if name.lower() not in USUAL_NAMES[role][:2] and Path(report.name).suffix.lower() != ".mat":
            words += [f"--{role}", name]
    words += ["--poles", "1", "--zeros", "0"]
    if report.suggested_delay is not None:
        words += ["--delay", "{:g}:{:g}".format(*report.suggested_delay)]
    if measurement.record.input.hold != "zoh":
        words += ["--hold", measurement.record.input.hold]
    for option, instant in (("--from", measurement.start), ("--to", measurement.stop)):
        if instant is not None:
            words += [option, f"{instant:.12g}"]
    if report.suggested_offset != "none":
        words += ["--offset", report.suggested_offset]
    if report.suggested_initial_state != "rest":
        words += ["--initial-state", report.suggested_initial_state]
    return shlex.join(words)
