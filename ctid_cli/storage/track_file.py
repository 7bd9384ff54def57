"""``track.json``: lossless storage of a track and the path of its record, and reading it again.

The file has the output of ``ctid track --json``, and ``record``, the source of the signal, and ``result``, the track
as in Python. The samples are read from the record when first used.
"""

import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from ctid_cli.signals.sampled_signal import SampledSignal, read_sampled_signal
from ctid_cli.storage.result_file import ResultKind, Source, decoded, encoded, path_and_sum, require, texts
from ctid_cli.tones.track import Track

TRACK = ResultKind("ctid track", 3, "track", "ctid track", "track again", oldest=3)


@dataclass(frozen=True)
class Reading:
    """Options for reading a signal from its file, as given to ``ctid track``, before unit conversion of times."""

    time: str | None = None
    signal: str | None = None
    #: Sampling interval that replaces the times of the file [s].
    interval: float | None = None
    start: float | None = None
    stop: float | None = None

    def read(self, path: str | os.PathLike[str]) -> SampledSignal:
        """Return the signal with times in seconds."""
        return read_sampled_signal(path, **asdict(self)).in_seconds()


def track_file_text(
    track: Track, content: Mapping[str, Any], record: Path, reading: Reading, folder: Path, command: str | None
) -> str:
    """Return the text of the file: description of a track, its record relative to the file's folder, and its rows."""
    source = {
        **path_and_sum(record, folder),
        "columns": {"time": reading.time, "signal": reading.signal},
        "interval": reading.interval,
        "from": reading.start,
        "to": reading.stop,
    }
    return TRACK.text({**content, "record": source, "result": encoded(track)}, command)


class SignalSource(Source):
    """A record as ``track.json`` names it."""

    def read(self) -> SampledSignal:
        """Return the record as it was read for the track."""
        self.require_same()
        content = self.content
        columns = content["columns"]
        reading = Reading(
            *(columns["time"], columns["signal"]),
            interval=content["interval"],
            start=content["from"],
            stop=content["to"],
        )
        return replace(reading.read(self.place), file=self.name)


@dataclass(frozen=True, eq=False)
class StoredTrack:
    """A ``track.json``, with the record that it names."""

    path: Path
    #: Content of the file, as in the documentation of machine-readable output.
    content: Mapping[str, Any]
    track: Track
    source: SignalSource


def read_track(path: str | os.PathLike[str], record: str | os.PathLike[str] | None = None) -> StoredTrack:
    """Return the file with all its content; its record may have moved."""
    file = os.fspath(path)
    content = TRACK.content(file)
    with TRACK.refusing(file):
        track = decoded(content["result"], Track)
        _require_said(content)
    said = {"file": content["file"], **content["record"]}
    source = SignalSource(TRACK, file, said, None if record is None else os.fspath(record))
    return StoredTrack(Path(file), content, track, source)


def _require_said(content: Mapping[str, Any]) -> None:
    """Refuse a file without the information needed to show it."""
    record = content["record"]
    require("path", texts([record["path"], record["sha256"], content["file"], content["method"]]))
    require("columns", all(each is None or isinstance(each, str) for each in record["columns"].values()))
    require("unit", content["unit"] is None or isinstance(content["unit"], str))
    require("command", content["command"] is None or isinstance(content["command"], str))
    numbers = [record["interval"], record["from"], record["to"], content["accuracy_hz"]]
    require("clock", all(each is None or isinstance(each, int | float) for each in numbers))
    require("start", isinstance(content["start"], int | float))
    for key in ("warnings", "notes", "chosen"):
        require(key, isinstance(content[key], list) and texts(content[key]))
