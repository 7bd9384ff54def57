"""``track.json``: it is read as written, and other files are refused."""

import json

import numpy as np
import pytest

from ctid_cli.canonical import content_hash, plain
from ctid_cli.errors import DataError
from ctid_cli.frequency.flags import Flag
from ctid_cli.reporting.track_result import TrackResult
from ctid_cli.storage.track_file import Reading, read_track, track_file_text
from ctid_cli.tones.track import MissingLine, Track

ROWS = 5
SAID = {"reasons": ("A reason.",), "warnings": ("A warning.",)}


def track():
    omega = np.array([[60.0, np.nan]] * 2 + [[60.1, 85.0]] * 3)
    flags = np.zeros((ROWS, 2), np.uint16)
    flags[:2, 1] = int(Flag.ABSENT)
    lines = (MissingLine(120.0, 0.9, 0.1),)
    return Track.of(0.1 * np.arange(ROWS), omega, flags, 0.1, error=0.01 * omega, missing=lines, **SAID)


@pytest.fixture
def written(tmp_path):
    """Return the file of a track and its record."""
    record = tmp_path / "data" / "hum.csv"
    record.parent.mkdir()
    lines = ["t [ms],y,z", *(f"{k},{np.sin(k):.6f},1" for k in range(100))]
    record.write_text("\n".join(lines) + "\n", encoding="utf-8")
    reading = Reading(None, "y", None, 10.0, 80.0)
    content = plain(TrackResult(track(), reading.read(record), 0.5).content())
    file = tmp_path / "track.json"
    file.write_text(track_file_text(track(), content, record, reading, tmp_path, "ctid track"), encoding="utf-8")
    return file, record


def rewritten(file, change):
    """Return the file with other content and a matching checksum."""
    content = json.loads(file.read_text(encoding="utf-8"))
    content.pop("checksum")
    change(content)
    file.write_text(json.dumps(content | {"checksum": content_hash(content)}), encoding="utf-8")


def test_what_is_read_is_what_was_written(written):
    file, record = written
    stored = read_track(file)
    for name in ("t", "omega", "error", "amplitudes", "phase", "growth", "rate", "window", "flags"):
        np.testing.assert_array_equal(getattr(stored.track, name), getattr(track(), name))
    assert stored.track.flags.dtype == np.uint16
    assert (stored.track.every, stored.track.missing) == (0.1, track().missing)
    assert stored.content["record"]["path"] == "data/hum.csv"
    assert stored.content["accuracy_hz"] == 0.5
    signal = stored.source.read()
    assert (signal.samples.size, signal.interval, signal.start) == (71, pytest.approx(1e-3), pytest.approx(0.01))
    assert (signal.file, signal.column) == (str(record), "y")


def test_a_record_that_moved_is_named_and_another_is_refused(written, tmp_path):
    file, record = written
    moved = record.rename(tmp_path / "moved.csv")
    with pytest.raises(DataError, match=r"its record .*hum.csv does not exist; say where it is now: --record FILE"):
        read_track(file).source.read()
    assert read_track(file, moved).source.read().file == str(record)  # as it was called then
    moved.write_text(moved.read_text(encoding="utf-8") + "100,0,1\n", encoding="utf-8")
    with pytest.raises(DataError, match=r"not the file that the track is of .* --record FILE, or track again"):
        read_track(file, moved).source.read()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda content: content.update(kind="ctid fit"), "is no track but of kind 'ctid fit'"),
        (lambda content: content["result"]["t"].pop(), "is damaged"),
        (lambda content: content["result"]["flags"].update(shape=[2, ROWS]), "is damaged"),
        (lambda content: content["result"]["phase"].update(values=["x"] * 10), "is damaged"),
        (lambda content: content.pop("record"), "is damaged"),
        (lambda content: content["record"].update(columns={"time": 3, "signal": None}), "its columns"),
        (lambda content: content.update(warnings="none"), "its warnings"),
    ],
)
def test_what_is_no_track_is_refused_in_one_sentence(written, change, message):
    file, _ = written
    rewritten(file, change)
    with pytest.raises(DataError, match=message) as caught:
        read_track(file)
    assert "\n" not in str(caught.value)
    assert "ctid track writes such a file" in str(caught.value)
