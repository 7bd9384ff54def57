"""Page of a track: self-contained, and safe for any names of files and columns."""

from dataclasses import replace

import numpy as np

from ctid_cli.canonical import plain
from ctid_cli.frequency.flags import Flag
from ctid_cli.reporting.track_result import TrackResult
from ctid_cli.signals.sampled_signal import SampledSignal
from ctid_cli.tones.track import MissingLine, Track
from tests.reporting.parsed_page import alone

HOSTILE = "<script>alert(1)</script>&$x_{$\"'"
T = 0.002 * np.arange(3000)
ROWS = 0.1 + 0.05 * np.arange(116)
SOURCE = {"path": "/far/away/" + HOSTILE, "sha256": "0" * 64, "interval": None, "from": 1.0, "to": None}


def signal(name=HOSTILE):
    rng = np.random.default_rng(0)
    y = 2.0 * np.sin(2 * np.pi * 12.0 * T) + 0.1 * np.sin(2 * np.pi * 19.0 * T) + 0.01 * rng.standard_normal(T.size)
    return SampledSignal(y, 0.002, 5.0, name, name, "t", "s", name, (name,))


def track(**known):
    shape = (ROWS.size, 1)
    phase = (2 * np.pi * 12.0 * ROWS)[:, None]
    flags = np.zeros(ROWS.size, np.uint16)
    flags[:20] = int(Flag.UNRESOLVED)
    lines = (MissingLine(2 * np.pi * 19.0, 0.9, 0.1),)
    parts = {"error": np.full(shape, 0.01), "amplitudes": np.full(shape, 2.0), "window": np.full(shape, 0.2)}
    parts |= {"phase": phase, "missing": lines} | known
    return Track.of(ROWS, np.full(shape, 2 * np.pi * 12.0), flags, 0.05, **parts)


def page_of(followed, name=HOSTILE):
    content = plain(TrackResult(replace(followed, reasons=(f"A reason, {name}.",)), signal(name)).content())
    source = SOURCE | {"columns": {"time": None, "signal": name}}
    content |= {"ctid": "1", "command": "ctid track /far/away.csv", "checksum": "x", "record": source}
    return TrackResult(replace(followed, reasons=(f"A reason, {name}.",)), signal(name)).page(content)


def test_a_page_says_all_and_needs_nothing_but_itself():
    text = page_of(track())
    page = alone(text)
    titles = ("Warnings", "Data", "Tones", "Signal", "Residual", "Provenance", "How to cite")
    assert all(title in page.text for title in titles)
    assert page.tags["svg"] == 3
    assert page.text.count(HOSTILE) >= 4  # title, line of the record, note, reason
    assert "/far" not in text
    assert "ctid track away.csv" in page.text
    for words in ("19 Hz (amplitude 0.1", "--tones 2", "line that is missing", "@article{rife1976", "17.2 %"):
        assert words in text
    assert text == page_of(track())


def test_a_record_without_tones_and_one_of_unknown_phases_have_pages_too():
    nothing = Track.of(ROWS, np.empty((ROWS.size, 0)), np.zeros(ROWS.size, np.uint16), 0.05)
    assert "No tone was asked for" in page_of(nothing, "a.csv")
    unknown = page_of(track(phase=np.full((ROWS.size, 1), np.nan)), "a.csv")
    assert "Nowhere are all tones known" in unknown
