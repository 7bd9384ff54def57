"""What ``ctid track --pmu`` answers: synchrophasors of a record as text, as an object for JSON, and as columns."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctid_cli.arrays import Array
from ctid_cli.canonical import plain
from ctid_cli.frequency.flags import Flag
from ctid_cli.frequency.synchrophasor import POSITIVE_SEQUENCE, SYNCHROPHASOR_REASONS, SynchrophasorTrack
from ctid_cli.reporting.column_file import columns_bytes
from ctid_cli.reporting.layout import Report, Table, count, number
from ctid_cli.reporting.track_columns import flag_words
from ctid_cli.signals.sampled_signal import SampledSignal
from ctid_cli.text import listed, warning_lines, wrapped

_UNITS = {"t": "s", "angle": "rad", "frequency_hz": "Hz", "rocof_hz_per_s": "Hz/s", "error_percent": "%"}
#: A smaller share of valid rows is worth a warning.
MOSTLY_VALID = 0.999


def synchrophasor_table(track: SynchrophasorTrack) -> dict[str, NDArray[Any]]:
    """Columns of the file."""
    phases = range(track.phases.shape[1]) if track.phases.shape[1] > 1 else ()
    return {
        "t": track.t,
        "magnitude": np.abs(track.phasor),
        "angle": np.angle(track.phasor),
        "frequency_hz": track.frequency,
        "rocof_hz_per_s": track.rocof,
        **{f"magnitude_{k + 1}": np.abs(track.phases[:, k]) for k in phases},
        **{f"angle_{k + 1}": np.angle(track.phases[:, k]) for k in phases},
        "error_percent": track.error,
        "valid": track.valid,
        "flags": np.array([flag_words(int(flags)) for flags in track.flags], dtype=object),
    }


def synchrophasor_bytes(track: SynchrophasorTrack, style: str, unit: str | None) -> bytes:
    """The file of synchrophasors of a signal of this unit."""
    table = synchrophasor_table(track)
    kinds = {name: name.rstrip("_123") for name in table}
    return columns_bytes(table, style, {name: {**_UNITS, "magnitude": unit}.get(kinds[name]) for name in table})


def _summary(track: SynchrophasorTrack) -> dict[str, dict[str, float | None]]:
    """Median and range of what is measured, over the valid rows."""
    courses = {
        "frequency_hz": track.frequency,
        "rocof_hz_per_s": track.rocof,
        "magnitude": np.abs(track.phasor),
        "error_percent": track.error,
    }
    return {name: _spread(course[track.valid]) for name, course in courses.items()}


def _spread(values: Array) -> dict[str, float | None]:
    if not values.size:
        return dict.fromkeys(("median", "lowest", "highest"))
    return {"median": float(np.median(values)), "lowest": float(values.min()), "highest": float(values.max())}


def synchrophasor_object(signals: list[SampledSignal], track: SynchrophasorTrack) -> dict[str, Any]:
    """Synchrophasors for ``ctid track --pmu --json``."""
    first = signals[0]
    content = {
        "file": first.file,
        "signals": [signal.column for signal in signals],
        "unit": first.unit,
        "samples": int(first.samples.size),
        "missing": max(signal.missing for signal in signals),
        "interval": first.interval,
        "start": first.start,
        "nominal": track.nominal,
        "performance_class": track.performance_class,
        "reporting_rate": track.reporting_rate,
        "latency": track.latency,
        "rows": int(track.t.size),
        "valid_percent": 100.0 * float(track.valid.mean()),
        **_summary(track),
        "warnings": synchrophasor_warnings(track),
        "notes": list(first.notes) if len(signals) == 1 else [],
        "chosen": _choices(signals, track),
    }
    return dict(plain(content))


def synchrophasor_text(signals: list[SampledSignal], track: SynchrophasorTrack) -> str:
    """Synchrophasors for people, within 100 columns."""
    first = signals[0]
    end = first.start + (first.samples.size - 1) * first.interval
    what = listed(repr(signal.column) for signal in signals)
    head = f"{first.file}: {count(first.samples.size, 'sample')} of {what} from {first.start:.6g} to {end:.6g} s, "
    gaps = [f"{count(each.missing, 'sample')} of {each.column!r}" for each in signals if each.missing]
    missing = f"; missing: {listed(gaps)}" if gaps else ""
    lines = [wrapped(f"{head}every {first.interval:.6g} s ({1.0 / first.interval:.6g} Hz){missing}")]
    if len(signals) == 1:
        lines += [wrapped(note, "  ") for note in first.notes]
    lines += [wrapped(f"- {choice}", hanging="  ") for choice in _choices(signals, track)]
    blocks = Report([synchrophasor_block(track, first.unit)]).draw()
    return "\n".join([*lines, "", blocks, *warning_lines(synchrophasor_warnings(track))])


def synchrophasor_block(track: SynchrophasorTrack, unit: str | None = None) -> list[str | Table]:
    """A table of what was measured, and what its numbers are."""
    names = {
        "frequency_hz": "frequency [Hz]",
        "rocof_hz_per_s": "ROCOF [Hz/s]",
        "magnitude": f"magnitude, rms [{unit}]" if unit else "magnitude, rms",
        "error_percent": "left by the model [%]",
    }
    cells = [[names[name], *(number(value, 7) for value in row.values())] for name, row in _summary(track).items()]
    rows = f"{count(int(track.valid.sum()), 'valid row')} of {track.t.size}"
    every = f"one every {1.0 / track.reporting_rate:.4g} s"
    return [Table(["", "median", "lowest", "highest"], cells, "lrrr"), f"Over {rows}, {every}."]


def _choices(signals: list[SampledSignal], track: SynchrophasorTrack) -> list[str]:
    """What the numbers are, in sentences."""
    rate = 1.0 / signals[0].interval
    order = int(np.ceil(0.5 * rate / track.nominal)) - 1
    which = f"Class {track.performance_class} at {track.nominal} Hz, {track.reporting_rate} reports a second"
    window = (
        f"a report looks {1000.0 * track.latency:.3g} ms to both sides at most, and is known so long after its instant"
    )
    folded = f"{rate / track.nominal:.4g} samples to a cycle: harmonics above the {order}th are folded"
    if order >= 50:
        folded = f"{rate / track.nominal:.4g} samples to a cycle: no harmonic up to the 50th is folded"
    angle = f"Angles are those against a cosine of {track.nominal} Hz with its maximum at t = 0"
    first = signals[0].column
    three = [f"Magnitude, angle, frequency and ROCOF are those of the positive sequence, {first!r} leading"]
    sentences = [f"{which}: {window}", folded, angle, *(three if len(signals) == 3 else [])]
    return [f"{sentence}." for sentence in sentences]


def synchrophasor_warnings(track: SynchrophasorTrack) -> list[str]:
    """What a reader must know before believing the numbers."""
    share = float(track.valid.mean())
    found = _order_of_phases(track)
    if share < MOSTLY_VALID:
        found.append(f"{100.0 * (1.0 - share):.3g} % of the rows are not valid." if share else "No row is valid.")
    shares = {flag: float(np.mean((track.flags & int(flag)) != 0)) for flag in SYNCHROPHASOR_REASONS}
    reasons = sorted((flag for flag in shares if shares[flag] > 0.0), key=lambda flag: -shares[flag])
    return [*found, *(f"{100.0 * shares[flag]:.3g} %: {SYNCHROPHASOR_REASONS[Flag(flag)]}" for flag in reasons)]


def _order_of_phases(track: SynchrophasorTrack) -> list[str]:
    """A warning where two of three phases were probably exchanged."""
    known = track.phases[np.isfinite(track.phases).all(axis=1)]
    if known.shape[1] != 3 or not known.size:
        return []
    positive, negative = (float(np.median(np.abs(known @ w))) for w in (POSITIVE_SEQUENCE, POSITIVE_SEQUENCE.conj()))
    if negative <= positive:
        return []
    return ["The negative sequence is the larger one: exchange two of the names of --signal if their order is wrong."]
