"""The page of one track: the signal, its tones, what they leave, and whether to believe them."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from ctid_cli.reporting.citations import track_bibtex
from ctid_cli.reporting.document import Section
from ctid_cli.reporting.layout import count, number
from ctid_cli.reporting.pages.page import Chapter, citation, provenance, shown, write_page
from ctid_cli.reporting.track_plot import signal_drawing, spectra_drawing, track_drawing
from ctid_cli.reporting.track_result import TrackResult, signal_line
from ctid_cli.signals.sampled_signal import SampledSignal
from ctid_cli.tones.residual import LeftOver, left_over
from ctid_cli.tones.track import Track


def track_page(track: Track, signal: SampledSignal, content: Mapping[str, Any]) -> str:
    """Return the page as HTML, of a track, its record and what its file says."""
    signal = replace(signal, file=shown(signal.file))
    fine = "Nothing that was tested speaks against these tones: nearly all rows are valid, and no line is left over."
    drawn = Section(drawing=signal_drawing(signal, track), caption="The signal, and its spectrogram.")
    tones = TrackResult(track, signal).tones()
    tones.append(Section(drawing=track_drawing(track, signal.start, signal.unit, ""), caption=_caption(track)))
    chapters = [
        Chapter("Before using it", [Section(sentences=[f"- {text}" for text in content["warnings"]] or [fine])]),
        Chapter("Data", [Section(sentences=[signal_line(signal), *signal.notes, *content["chosen"]])]),
        Chapter("Tones", tones),
        Chapter("Signal", [drawn]),
        Chapter("What the tones leave", [_left(track, signal, left_over(signal.samples, signal.interval, track))]),
        Chapter("Provenance", provenance(_origin(content), content["command"])),
        Chapter("How to cite", citation(track_bibtex())),
    ]
    return write_page(f"Tones of {signal.file}", _lead(track, content), chapters)


def _lead(track: Track, content: Mapping[str, Any]) -> str:
    tones = count(track.omega.shape[1], "tone")
    share = 100.0 * float(track.valid.sum() / max(track.there.sum(), 1))
    valid = f", {number(share, 4)} % of whose rows are valid" if track.omega.shape[1] else ""
    lines = f" {count(len(track.missing), 'line')} left over." if track.missing else ""
    return f"{tones}{valid} (method: {content['method']}).{lines}"


def _caption(track: Track) -> str:
    bands = ", with bands of one standard error" if track.states_errors and track.omega.size else ""
    return f"Frequencies and amplitudes over time{bands}; grey where no tone that is drawn is valid."


def _left(track: Track, signal: SampledSignal, left: LeftOver | None) -> Section:
    """What the tones leave of the signal."""
    if left is None:
        return Section(notes=["Nowhere are all tones known, so that nothing can be compared."])
    unit = f" {signal.unit}" if signal.unit else ""
    whole, rest = left.root_mean_squares
    share = 100.0 * (rest / whole) ** 2 if whole else 0.0
    notes = [
        f"The tones leave {number(share, 3)} % of the power of the signal: {number(rest, 3)}{unit} of "
        f"{number(whole, 3)}{unit} (root mean squares about the mean), compared over "
        f"{number(100.0 * float(1.0 - left.unknown.mean()), 3)} % of the record, where all tones are known.",
        f"Spectra are medians over segments of {number(left.segment, 3)} s; a steady tone stands as high as its "
        "amplitude. A line that is left beside a tone may be the tone itself, where it moves faster than its rows.",
    ]
    drawing = spectra_drawing(left, track, signal.unit)
    caption = "Amplitude spectra of the signal and of what the tones leave"
    caption += "; triangles mark the lines that are missing." if track.missing else "."
    return Section(notes=notes, drawing=drawing, caption=caption)


def _origin(content: Mapping[str, Any]) -> list[tuple[str, str]]:
    record = content["record"]
    how = [f"{word} {record[word]}" for word in ("from", "to") if record[word] is not None]
    how += [f"{role} {name!r}" for role, name in record["columns"].items() if name is not None]
    how += [f"interval {record['interval']:.9g} s"] if record["interval"] is not None else []
    return [
        ("ctid", str(content["ctid"])),
        ("record", ", ".join([shown(record["path"]), *how])),
        ("its SHA-256", record["sha256"]),
        ("checksum of the track", str(content.get("checksum", ""))),
    ]
