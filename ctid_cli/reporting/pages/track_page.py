"""The page of one track: the signal, its tones, what they leave, and whether to believe them."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import ctid_cli
from ctid_cli.reporting.citations import track_bibtex
from ctid_cli.reporting.layout import Report, Table, count, number
from ctid_cli.reporting.pages.page import Chapter, figure, shown, shown_command, written
from ctid_cli.reporting.track_drawings import signal_drawing, spectra_drawing
from ctid_cli.reporting.track_plot import track_drawing
from ctid_cli.reporting.track_report import signal_line, tones_block
from ctid_cli.reporting.track_residual import Spectra, spectra_of
from ctid_cli.signals.sampled_signal import SampledSignal
from ctid_cli.tones.track import Track


def track_page(track: Track, signal: SampledSignal, content: Mapping[str, Any]) -> str:
    """The page as HTML, of a track, its record and what its file says."""
    signal = replace(signal, file=shown(signal.file))
    spectra = spectra_of(signal, track)
    signals = [figure(signal_drawing(signal, track), "signal", "The signal, and its spectrogram")]
    chapters = [Chapter("signal", "Signal", signals), _left(track, signal, spectra)]
    tones = figure(track_drawing(track, signal.start, signal.unit, ""), "track", _caption(track))
    return written(
        "track.html",
        title=f"Tones of {signal.file}",
        version=ctid_cli.__version__,
        lead=_lead(track, content),
        warnings=content["warnings"],
        data=Report([[signal_line(signal), *signal.notes], [Table(["", ""], _chosen(content), "ll")]]),
        tones=Report([tones_block(track, signal.start, signal.unit)]),
        figures=[tones],
        chapters=chapters,
        titles=[("tones", "Tones"), *((chapter.name, chapter.title) for chapter in chapters)],
        provenance=_provenance(content),
        command=shown_command(content["command"]),
        bibtex=track_bibtex(),
    )


def _lead(track: Track, content: Mapping[str, Any]) -> str:
    tones = count(track.omega.shape[1], "tone")
    share = 100.0 * float(track.valid.sum() / max(track.there.sum(), 1))
    valid = f", {number(share, 4)} % of whose rows are valid" if track.omega.shape[1] else ""
    lines = f" {count(len(track.missing), 'line')} left over." if track.missing else ""
    return f"{tones}{valid} (method: {content['method']}).{lines}"


def _chosen(content: Mapping[str, Any]) -> list[list[str]]:
    return [["chosen" if k == 0 else "", sentence] for k, sentence in enumerate(content["chosen"])]


def _caption(track: Track) -> str:
    bands = ", with bands of one standard error" if track.states_errors and track.omega.size else ""
    return f"Frequencies and amplitudes over time{bands}; grey where no tone that is drawn is valid"


def _left(track: Track, signal: SampledSignal, spectra: Spectra | None) -> Chapter:
    """What the tones leave of the signal."""
    title = "What the tones leave"
    if spectra is None:
        return Chapter("left", title, [], ["Nowhere are all tones known, so that nothing can be compared."])
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
    caption += "; triangles mark the lines that are missing" if track.missing else ""
    return Chapter("left", title, [figure(drawing, "spectra", caption)], notes)


def _provenance(content: Mapping[str, Any]) -> Report:
    record = content["record"]
    how = [f"{word} {record[word]}" for word in ("from", "to") if record[word] is not None]
    how += [f"{role} {name!r}" for role, name in record["columns"].items() if name is not None]
    how += [f"interval {record['interval']:.9g} s"] if record["interval"] is not None else []
    rows = [
        ["ctid", str(content["ctid"])],
        ["record", ", ".join([shown(record["path"]), *how])],
        ["its SHA-256", record["sha256"]],
        ["checksum of the track", str(content.get("checksum", ""))],
    ]
    return Report([[Table(["", ""], rows, "ll")]])
