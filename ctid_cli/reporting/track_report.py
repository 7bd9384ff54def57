"""What ``ctid track`` answers: frequencies of a recorded signal as text, as an object for JSON, and as a file."""

import io
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctid_cli.canonical import plain
from ctid_cli.frequency.automatic import Settings
from ctid_cli.frequency.flags import MEANINGS, Flag
from ctid_cli.frequency.record_track import RecordTrack
from ctid_cli.frequency.tracking import FrequencyTrack
from ctid_cli.reporting.layout import Report, Table, count, number
from ctid_cli.signals.sampled_signal import SampledSignal
from ctid_cli.text import warning_lines, wrapped

_UNITS = {"t": "s", "omega": "rad/s", "frequency": "Hz"}
#: A smaller share of valid time is worth a warning.
MOSTLY_VALID = 0.9
_NONE_VALID = "No row is valid: there are no frequencies to report."
#: Most frequent reasons for invalid rows that are named.
MOST_REASONS = 3


def summarise(track: FrequencyTrack) -> list[dict[str, Any]]:
    """Each tone over the valid rows of a track; None where there are none.

    ``frequency_hz`` [Hz] and ``omega`` [rad/s] are medians, ``spread_hz`` is half the width of the central 68 %,
    ``amplitude`` a median [signal unit], ``valid_percent`` the share of the rows that are valid.
    """
    found = []
    heights = track.amplitudes if isinstance(track, RecordTrack) else np.full(track.omega.shape, np.nan)
    for k, (omega, amplitudes) in enumerate(zip(track.omega[track.valid].T, heights[track.valid].T, strict=True)):
        amplitudes = amplitudes[np.isfinite(amplitudes)]
        tone: dict[str, Any] = {"tone": k + 1, **dict.fromkeys(("frequency_hz", "omega", "spread_hz", "amplitude"))}
        if omega.size:
            middle = float(np.median(omega))
            low, high = np.percentile(omega, [16.0, 84.0]) / (2.0 * np.pi)
            tone |= {"frequency_hz": middle / (2.0 * np.pi), "omega": middle, "spread_hz": float(high - low) / 2.0}
        if omega.size and amplitudes.size:
            tone["amplitude"] = float(np.median(amplitudes))
        found.append(tone | {"valid_percent": 100.0 * _valid_share(track)})
    return found


def _valid_share(track: FrequencyTrack) -> float:
    return float(track.valid.mean()) if track.valid.size else 0.0


def track_warnings(track: RecordTrack, settings: Settings) -> list[str]:
    """What a reader must know before believing the numbers."""
    share, reasons = invalid_rows(track)
    if settings.estimator.online and not track.valid.any():
        share.append("A record is easier for the methods that take it window by window: try --method automatic.")
    return [*settings.warnings, *share, *reasons]


def invalid_rows(track: FrequencyTrack) -> tuple[list[str], list[str]]:
    """How many rows are not valid, and why; nothing where nearly all are."""
    share = _valid_share(track)
    if share >= MOSTLY_VALID:
        return [], []
    found = [f"{100 * (1 - share):.3g} % of the rows are not valid." if share > 0 else _NONE_VALID]
    shares = {flag: float(np.mean((track.flags & int(flag)) != 0)) for flag in Flag}
    reasons = sorted((flag for flag in Flag if shares[flag] > 0), key=lambda flag: -shares[flag])
    return found, [f"{100 * shares[flag]:.3g} %: {MEANINGS[flag]}" for flag in reasons[:MOST_REASONS]]


def track_object(signal: SampledSignal, settings: Settings, track: RecordTrack, files: list[Path]) -> dict[str, Any]:
    """A track for ``ctid track --json``."""
    content = {
        "file": signal.file,
        "signal": signal.column,
        "unit": signal.unit,
        "samples": int(signal.samples.size),
        **{name: getattr(signal, name) for name in ("missing", "interval", "start")},
        "method": settings.estimator.kind,
        "tones": summarise(track),
        "rows": int(track.t.size),
        "every": track.every,
        "warnings": track_warnings(track, settings),
        "notes": list(signal.notes),
        "chosen": list(settings.reasons),
        "settings": {
            "estimator": asdict(settings.estimator),
            "interval": settings.interval,
            "kept_one_of": settings.decimation.factor,
            "filter_seconds": (settings.decimation.weights.size - 1) * signal.interval,
            "window_seconds": settings.window_seconds,
            "offset": settings.offset,
            "expected_hz": (settings.expected / (2.0 * np.pi)).tolist(),
        },
        "written": [str(file) for file in files],
    }
    return dict(plain(content))


def track_text(signal: SampledSignal, settings: Settings, track: RecordTrack) -> str:
    """A track for people, within 100 columns."""
    end = signal.start + (signal.samples.size - 1) * signal.interval
    gaps = f", {count(signal.missing, 'sample')} missing" if signal.missing else ""
    head = f"{signal.file}: {count(signal.samples.size, 'sample')} of {signal.column!r} from {signal.start:.6g} to "
    head += f"{end:.6g} s, every {signal.interval:.6g} s ({1.0 / signal.interval:.6g} Hz){gaps}"
    lines = [wrapped(head), *(wrapped(note, "  ") for note in signal.notes)]
    lines += [wrapped(f"- {reason}", hanging="  ") for reason in settings.reasons]
    lines += ["", Report([tones_block(track, signal.unit)]).draw()]
    return "\n".join([*lines, *warning_lines(track_warnings(track, settings))])


def tones_block(track: FrequencyTrack, unit: str | None) -> list[str | Table]:
    """A table of the tones, and what its numbers are."""
    cells = [
        [
            *(str(tone["tone"]), _to_spread(tone["frequency_hz"], tone["spread_hz"])),
            *(number(tone["spread_hz"], 2), number(tone["omega"], 8), number(tone["amplitude"], 4)),
            f"{tone['valid_percent']:.4g} %",
        ]
        for tone in summarise(track)
    ]
    amplitude = f"amplitude [{unit}]" if unit else "amplitude"
    header = ["tone", "frequency [Hz]", "spread [Hz]", "[rad/s]", amplitude, "valid"]
    rows = count(track.t.size, "row")
    if isinstance(track, RecordTrack):
        rows += f", one every {track.every:.4g} s"
    else:
        header, cells = [*header[:4], *header[5:]], [[*row[:4], *row[5:]] for row in cells]
    foot = f"Medians over the valid ones of {rows}; the spread is half the width of the central 68 %."
    return [Table(header, cells, "r" * len(header)), foot]


def flag_words(flags: int) -> str:
    """Names of flags."""
    return " ".join(str(flag.name).lower() for flag in Flag if flags & flag)


def track_table(track: FrequencyTrack, start: float) -> dict[str, NDArray[Any]]:
    """Columns of the file of a track."""
    tones = range(track.omega.shape[1])
    return {
        "t": start + track.t,
        **{f"omega_{k + 1}": track.omega[:, k] for k in tones},
        **{f"frequency_{k + 1}_hz": track.omega[:, k] / (2.0 * np.pi) for k in tones},
        **({f"amplitude_{k + 1}": track.amplitudes[:, k] for k in tones} if isinstance(track, RecordTrack) else {}),
        "valid": track.valid,
        "flags": np.array([flag_words(int(flags)) for flags in track.flags], dtype=object),
    }


def track_bytes(table: dict[str, NDArray[Any]], style: str, unit: str | None = None) -> bytes:
    """The file of a track."""
    if style == "csv":
        import pandas as pd

        frame = pd.DataFrame(table).replace([np.inf, -np.inf], np.nan).astype({"valid": int})
        return frame.to_csv(index=False, float_format="%.12g", lineterminator="\n").encode()
    import h5py

    file = io.BytesIO()
    with h5py.File(file, "w", track_order=True) as store:
        for name, values in table.items():
            if values.dtype == object:
                store.create_dataset(name, data=[str(value) for value in values], dtype=h5py.string_dtype())
                continue
            column = store.create_dataset(name, data=values)
            column_unit = {**_UNITS, "amplitude": unit}.get(name.partition("_")[0])
            if column_unit is not None:
                column.attrs["unit"] = column_unit
    return file.getvalue()


def _to_spread(value: float | None, spread: float | None) -> str:
    """A frequency with two digits of its spread, at least six in all and no more than rounding allows."""
    if value is None or spread is None:
        return "-"
    known = 2 + math.floor(math.log10(value)) - math.floor(math.log10(spread)) if 0.0 < spread < value else 0
    return f"{value:#.{min(max(6, known), 10)}g}"
