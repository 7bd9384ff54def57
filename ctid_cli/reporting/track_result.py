"""Result of ``ctid track``: the tones of a recorded signal."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctid_cli.frequency.flags import flag_names
from ctid_cli.reporting.document import Column, Section, Table
from ctid_cli.reporting.figures.style import Drawing
from ctid_cli.reporting.layout import number, with_error
from ctid_cli.reporting.pages.page import Chapter, PagedResult, shown
from ctid_cli.reporting.track_plot import signal_drawing, spectra_drawing, track_drawing
from ctid_cli.signals.sampled_signal import SampledSignal
from ctid_cli.text import count
from ctid_cli.tones.constants import METHOD, USUAL_ACCURACY
from ctid_cli.tones.residual import LeftOver, left_over
from ctid_cli.tones.summary import ToneSummary, summarise
from ctid_cli.tones.track import Track
from ctid_cli.tones.track_warnings import track_warnings

TURN = 2.0 * math.pi
#: Factor from which a change of an amplitude is reported [-].
MUCH = 2.0


@dataclass(frozen=True, eq=False)
class TrackResult(PagedResult):
    """Tones over time, with their signal if it is known."""

    schema = "ctid-track-1"

    track: Track
    signal: SampledSignal | None = None
    #: Requested largest standard error of a valid row [Hz].
    accuracy: float | None = None

    @property
    def fine(self) -> str:
        """Sentence if there are no warnings."""
        return (
            "Nothing that was tested speaks against these tones: nearly all rows are valid, and no line is left over."
        )

    def sections(self) -> list[Section]:
        """Return signal, choices, tones, and warnings."""
        head = [] if self.signal is None else [signal_line(self.signal), *self.signal.notes]
        warnings = [f"- {warning}" for warning in track_warnings(self.track)]
        return [
            Section("", [*head, *(f"- {reason}" for reason in self.chosen())], drawing=self.drawing()),
            *self.tones(),
            Section("Warnings:" if warnings else "", warnings),
        ]

    def tones(self) -> list[Section]:
        """Return a table of the tones and the meaning of its numbers; columns without values are left out."""
        track, signal = self.track, self.signal
        if not track.omega.shape[1]:
            return []
        partly, start = not track.there.all(), signal.start if signal else 0.0
        rows = [
            asdict(tone)
            | {"frequency": _with_error(tone)}
            | ({"from": start + tone.begins, "to": start + tone.ends} if partly else {})
            for tone in summarise(track)
        ]
        columns = (
            Column("tone"),
            Column("frequency", unit="Hz"),
            Column("spread_hz", "spread [Hz]", ".2g"),
            Column("amplitude", "", ".4g", (signal and signal.unit) or ""),
            Column("from", "", ".5g", "s"),
            Column("to", "", ".5g", "s"),
            Column("valid_percent", "valid %", ".4g"),
        )
        counted = f"{count(track.t.size, 'row')}, one every {track.every:.4g} s"
        note = (
            f"Medians over the valid rows; there are {counted}. The spread, half the width of the central 68 %, shows "
        )
        note += "how far a tone moves."
        note += " ± is the standard error of the mean frequency." if np.isfinite(track.error).any() else ""
        note += " Valid is a share of the rows where the tone is there." if partly else ""
        return [Section(table=Table.of(rows, columns), notes=[note, *self._changes()])]

    def _changes(self) -> Iterator[str]:
        """Yield amplitudes that grow or decay much, from the first to the last tenth of the valid rows of the tone."""
        unit = f" {self.signal.unit}" if self.signal and self.signal.unit else ""
        for k in range(self.track.omega.shape[1]):
            amplitudes = self.track.amplitudes[self.track.valid[:, k] & np.isfinite(self.track.amplitudes[:, k]), k]
            if not amplitudes.size:
                continue
            tenth = max(amplitudes.size // 10, 1)
            first, last = float(np.median(amplitudes[:tenth])), float(np.median(amplitudes[-tenth:]))
            if max(first, last) > MUCH * min(first, last):
                way = "grows" if last > first else "falls"
                yield f"The amplitude of tone {k + 1} {way} from {first:.3g} to {last:.3g}{unit}."

    def drawing(self) -> Drawing:
        """Return the figure of frequencies and amplitudes over time."""
        signal = self.signal
        if signal is None:
            return track_drawing(self.track, 0.0, None, "")
        return track_drawing(self.track, signal.start, signal.unit, Path(signal.file).name)

    def page_head(self) -> tuple[str, str]:
        """Return the title of the page, and the number of tones."""
        track, signal = self.track, self.shown_signal
        tones = count(track.omega.shape[1], "tone")
        share = 100.0 * float(track.valid.sum() / max(track.there.sum(), 1))
        valid = f", {number(share, 4)} % of whose rows are valid" if track.omega.shape[1] else ""
        lines = f" {count(len(track.missing), 'line')} left over." if track.missing else ""
        return f"Tones of {signal.file}", f"{tones}{valid} (method: {METHOD}).{lines}"

    def chapters(self) -> Iterator[Chapter]:
        """Yield the signal, its tones, and the residual."""
        track, signal = self.track, self.shown_signal
        bands = ", with bands of one standard error" if np.isfinite(track.error).any() else ""
        caption = f"Frequencies and amplitudes over time{bands}; grey where no tone that is drawn is valid."
        drawn = track_drawing(track, signal.start, signal.unit, "")
        yield Chapter("Data", [Section(sentences=[signal_line(signal), *signal.notes, *self.chosen()])])
        yield Chapter("Tones", [*self.tones(), Section(drawing=drawn, caption=caption)])
        drawn = signal_drawing(signal, track)
        yield Chapter("Signal", [Section(drawing=drawn, caption="The signal, and its spectrogram.")])
        left = left_over(signal.samples, signal.interval, track)
        yield Chapter("Residual", [_left(track, signal, left)])

    @property
    def shown_signal(self) -> SampledSignal:
        """Signal without its folder."""
        assert self.signal is not None
        return replace(self.signal, file=shown(self.signal.file))

    def cited(self) -> list[str]:
        """Return the article on the method."""
        return ["rife1976"]

    def chosen(self) -> list[str]:
        """Return the choices with their reasons, and the largest admitted standard error if it is known."""
        if not np.isfinite(self.track.error).any():
            return list(self.track.reasons)
        limit = f"{USUAL_ACCURACY:g} of the tone's frequency" if self.accuracy is None else f"{self.accuracy:g} Hz"
        rule = f"a row is valid only if the standard error of its frequency is at most {limit} (--accuracy HZ)."
        return [*self.track.reasons, f"Accuracy: {rule}"]

    def main_table(self) -> Table:
        """Return the tones over time, those of one after those of another."""
        track, unit = self.track, None if self.signal is None else self.signal.unit
        columns: dict[str, NDArray[Any]] = {"t": (self.signal.start if self.signal else 0.0) + track.t}
        units: dict[str, str | None] = {"t": "s"}
        quantities: dict[str, tuple[NDArray[Any], str | None]] = {
            "frequency_{}_hz": (track.omega / TURN, "Hz"),
            "frequency_error_{}_hz": (track.error / TURN, "Hz"),
            "omega_{}": (track.omega, "rad/s"),
            "amplitude_{}": (track.amplitudes, unit),
            "amplitude_error_{}": (track.amplitude_error, unit),
            "phase_{}": (track.phase, "rad"),
            "growth_{}": (track.growth, "1/s"),
            "rate_{}": (track.rate / TURN, "Hz/s"),
            "valid_{}": (track.valid, None),
            "flags_{}": (flag_names(track.flags), None),
        }
        for k in range(track.omega.shape[1]):
            columns |= {name.format(k + 1): values[:, k] for name, (values, _) in quantities.items()}
            units |= {name.format(k + 1): unit for name, (_, unit) in quantities.items()}
        return Table.of_columns(columns, units=units)

    def content(self) -> dict[str, Any]:
        """Return the track for JSON, without its rows."""
        track, signal = self.track, self.signal
        assert signal is not None
        return {
            "file": signal.file,
            "signal": signal.column,
            "unit": signal.unit,
            "samples": int(signal.samples.size),
            **{name: getattr(signal, name) for name in ("missing", "interval", "start")},
            "method": METHOD,
            "tones": [asdict(tone) for tone in summarise(track)],
            "accuracy_hz": self.accuracy,
            "rows": int(track.t.size),
            "every": track.every,
            "missing_lines": [
                {"frequency_hz": line.omega / TURN, "share": line.share, "amplitude": line.amplitude}
                for line in track.missing
            ],
            "warnings": track_warnings(track),
            "notes": signal.notes,
            "chosen": self.chosen(),
            "settings": track.settings,
        }


def _left(track: Track, signal: SampledSignal, left: LeftOver | None) -> Section:
    """Return the residual of the signal without the tones."""
    if left is None:
        return Section(notes=["Nowhere are all tones known, so that nothing can be compared."])
    unit = f" {signal.unit}" if signal.unit else ""
    whole, rest = left.root_mean_squares
    notes = [
        f"The tones leave {number(left.percent_of_power, 3)} % of the power of the signal: {number(rest, 3)}{unit} of "
        f"{number(whole, 3)}{unit} (root mean squares about the mean), compared over "
        f"{number(left.percent_known, 3)} % of the record, where all tones are known.",
        f"Spectra are medians over segments of {number(left.segment, 3)} s; a steady tone stands as high as its "
        "amplitude. A line that is left beside a tone may be the tone itself, where it moves faster than its rows.",
    ]
    caption = "Amplitude spectra of the signal and of the residual"
    caption += "; triangles mark the lines that are missing." if track.missing else "."
    return Section(notes=notes, drawing=spectra_drawing(left, track, signal.unit), caption=caption)


def signal_line(signal: SampledSignal) -> str:
    """Describe the signal that was read."""
    end = signal.start + (signal.samples.size - 1) * signal.interval
    gaps = f", {count(signal.missing, 'sample')} missing" if signal.missing else ""
    head = f"{signal.file}: {count(signal.samples.size, 'sample')} of {signal.column!r} from {signal.start:.6g} to "
    return head + f"{end:.6g} s, every {signal.interval:.6g} s ({1.0 / signal.interval:.6g} Hz){gaps}"


def _with_error(tone: ToneSummary) -> str:
    known = math.isfinite(tone.standard_error_hz)
    return with_error(tone.frequency_hz, tone.standard_error_hz) if known else number(tone.frequency_hz)
