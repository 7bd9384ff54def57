"""What ``ctid track`` answers: the tones of a recorded signal as text and as an object for JSON."""

import math
from typing import Any

import numpy as np

from ctid_cli.canonical import plain
from ctid_cli.reporting.layout import Report, Table, count, number
from ctid_cli.reporting.track_summary import summarise, track_warnings
from ctid_cli.signals.sampled_signal import SampledSignal
from ctid_cli.text import warning_lines, wrapped
from ctid_cli.tones.constants import METHOD, USUAL_ACCURACY
from ctid_cli.tones.track import Track


def track_object(signal: SampledSignal, track: Track, accuracy: float | None = None) -> dict[str, Any]:
    """A track for ``ctid track --json``."""
    content = {
        "file": signal.file,
        "signal": signal.column,
        "unit": signal.unit,
        "samples": int(signal.samples.size),
        **{name: getattr(signal, name) for name in ("missing", "interval", "start")},
        "method": METHOD,
        "tones": summarise(track),
        "accuracy_hz": accuracy,
        "rows": int(track.t.size),
        "every": track.every,
        "missing_lines": [
            {"frequency_hz": line.omega / (2.0 * math.pi), "share": line.share, "amplitude": line.amplitude}
            for line in track.missing
        ],
        "warnings": track_warnings(track),
        "notes": list(signal.notes),
        "chosen": [*track.reasons, *accuracy_words(track, accuracy)],
        "settings": track.settings,
    }
    return dict(plain(content))


def track_text(signal: SampledSignal, track: Track, accuracy: float | None = None) -> str:
    """A track for people, within 100 columns."""
    lines = [wrapped(signal_line(signal)), *(wrapped(note, "  ") for note in signal.notes)]
    reasons = [*track.reasons, *accuracy_words(track, accuracy)]
    lines += [wrapped(f"- {reason}", hanging="  ") for reason in reasons]
    if tones := tones_block(track, signal.start, signal.unit):
        lines += ["", Report([tones]).draw()]
    return "\n".join([*lines, *warning_lines(track_warnings(track))])


def signal_line(signal: SampledSignal) -> str:
    """What was read."""
    end = signal.start + (signal.samples.size - 1) * signal.interval
    gaps = f", {count(signal.missing, 'sample')} missing" if signal.missing else ""
    head = f"{signal.file}: {count(signal.samples.size, 'sample')} of {signal.column!r} from {signal.start:.6g} to "
    return head + f"{end:.6g} s, every {signal.interval:.6g} s ({1.0 / signal.interval:.6g} Hz){gaps}"


def accuracy_words(track: Track, accuracy: float | None) -> list[str]:
    """What a standard error must not exceed; nothing where none is known."""
    if not np.isfinite(track.error).any():
        return []
    limit = f"{USUAL_ACCURACY:g} of the tone's frequency" if accuracy is None else f"{accuracy:g} Hz"
    return [f"Accuracy: a row is valid only if the standard error of its frequency is at most {limit} (--accuracy HZ)."]


def tones_block(track: Track, start: float = 0.0, unit: str | None = None) -> list[str | Table]:
    """A table of the tones, and what its numbers are; columns of which nothing is known are left out."""
    tones = summarise(track)
    if not tones:
        return []
    columns: list[tuple[str, list[str]]] = [
        ("tone", [str(tone["tone"]) for tone in tones]),
        (
            "frequency [Hz]",
            [_to_error(tone["frequency_hz"], tone["standard_error_hz"] or tone["spread_hz"]) for tone in tones],
        ),
        ("std. error", [number(tone["standard_error_hz"], 2) for tone in tones]),
        ("spread [Hz]", [number(tone["spread_hz"], 2) for tone in tones]),
        (f"amplitude [{unit}]" if unit else "amplitude", [number(tone["amplitude"], 4) for tone in tones]),
        ("from [s]", [number(_after(start, tone["begins"]), 5) for tone in tones]),
        ("to [s]", [number(_after(start, tone["ends"]), 5) for tone in tones]),
        ("valid", [f"{tone['valid_percent']:.4g} %" for tone in tones]),
    ]
    partly = not track.there.all()
    unknown = {name for name, cells in columns[2:5:2] if set(cells) == {"-"}}
    shown = [each for each in columns if each[0] not in unknown and (partly or each[0] not in ("from [s]", "to [s]"))]
    rows = f"{count(track.t.size, 'row')}, one every {track.every:.4g} s"
    foot = f"Medians over the valid ones of {rows}; the spread is half the width of the central 68 %"
    foot += (
        "." if "std. error" in unknown else ": how far a tone moves; the standard error is that of its mean frequency."
    )
    foot += " Valid is a share of the rows where the tone is there." if partly else ""
    table = Table([name for name, _ in shown], list(zip(*(cells for _, cells in shown), strict=True)), "r" * len(shown))
    return [table, foot]


def _after(start: float, instant: Any) -> float | None:
    return None if instant is None else start + float(instant)


def _to_error(value: float | None, error: float | None) -> str:
    """A frequency with two digits of its error, at least six in all and no more than rounding allows."""
    if value is None or error is None:
        return "-"
    known = 2 + math.floor(math.log10(value)) - math.floor(math.log10(error)) if 0.0 < error < value else 0
    return f"{value:#.{min(max(6, known), 10)}g}"
