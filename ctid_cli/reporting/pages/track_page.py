"""The page of one track: the signal, its tones, what they leave, and whether to believe them."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from ctid_cli.reporting.citations import track_bibtex
from ctid_cli.reporting.document import Section
from ctid_cli.reporting.layout import Report, count, number
from ctid_cli.reporting.pages.page import Chapter, citation, provenance, sections_of, shown, write_page
from ctid_cli.reporting.track_drawings import signal_drawing, spectra_drawing
from ctid_cli.reporting.track_plot import track_drawing
from ctid_cli.reporting.track_report import signal_line, tones_block
from ctid_cli.reporting.track_residual import Spectra, spectra_of
from ctid_cli.signals.sampled_signal import SampledSignal
from ctid_cli.tones.track import Track


def track_page(track: Track, signal: SampledSignal, content: Mapping[str, Any]) -> str:
    """Return the page as HTML, of a track, its record and what its file says."""
    signal = replace(signal, file=shown(signal.file))
    fine = "Nothing that was tested speaks against these tones: nearly all rows are valid, and no line is left over."
    drawn = Section(drawing=signal_drawing(signal, track), caption="The signal, and its spectrogram.")
    tones = sections_of(Report([tones_block(track, signal.start, signal.unit)]).draw("md"))
    tones.append(Section(drawing=track_drawing(track, signal.start, signal.unit, ""), caption=_caption(track)))
    chapters = [
        Chapter("Before using it", [Section(sentences=[f"- {text}" for text in content["warnings"]] or [fine])]),
        Chapter("Data", [Section(sentences=[signal_line(signal), *signal.notes, *content["chosen"]])]),
        Chapter("Tones", tones),
        Chapter("Signal", [drawn]),
        Chapter("What the tones leave", [_left(track, signal, spectra_of(signal, track))]),
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


def _left(track: Track, signal: SampledSignal, spectra: Spectra | None) -> Section:
    """What the tones leave of the signal."""
    if spectra is None:
        return Section(notes=["Nowhere are all tones known, so that nothing can be compared."])
    unit = f" {signal.unit}" if signal.unit else ""
    share = 100.0 * (spectra.residual_rms / spectra.signal_rms) ** 2 if spectra.signal_rms else 0.0
    notes = [
        f"The tones leave {number(share, 3)} % of the power of the signal: {number(spectra.residual_rms, 3)}{unit} of "
        f"{number(spectra.signal_rms, 3)}{unit} (root mean squares about the mean), compared over "
        f"{number(100.0 * spectra.known, 3)} % of the record, where all tones are known.",
        f"Spectra are medians over segments of {number(spectra.segment, 3)} s; a steady tone stands as high as its "
        "amplitude. A line that is left beside a tone may be the tone itself, where it moves faster than its rows.",
    ]
    drawing = spectra_drawing(spectra, track, signal.unit, signal.interval)
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
