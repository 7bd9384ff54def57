"""Hand-made tracks: of two tones, with invalid rows, and with a tone that begins later."""

import numpy as np

from ctid_cli.frequency.flags import Flag
from ctid_cli.tones.track import MissingLine, Track

ROWS = 40
HERTZ = np.column_stack((np.linspace(9.0, 11.0, ROWS), np.full(ROWS, 30.0)))


def make_track(flags=None, **known):
    flags = np.zeros(ROWS, np.uint16) if flags is None else flags
    omega = 2 * np.pi * HERTZ
    omega[(flags & int(Flag.GAP)) > 0] = np.nan
    amplitudes = np.full((ROWS, 2), [2.0, 0.5])
    return Track.of(0.1 * np.arange(ROWS), omega, flags, 0.1, amplitudes=amplitudes, **known)


def some_invalid():
    flags = np.zeros(ROWS, np.uint16)
    flags[:10] = int(Flag.GAP)
    flags[10:12] = int(Flag.UNCERTAIN | Flag.COMPLEX_ROOTS)
    return flags


def coming_later():
    """Return tones one of which is present for a part, with a remaining line."""
    flags = np.zeros((ROWS, 2), np.uint16)
    flags[:20, 1] = int(Flag.ABSENT)
    flags[20:25, 1] = int(Flag.UNRESOLVED)
    lines = (MissingLine(2 * np.pi * 85.0, 0.9, 0.1), MissingLine(2 * np.pi * 120.0, 0.25, 0.02))
    middle = np.repeat(0.1 * np.arange(ROWS)[:, None], 2, axis=1)
    track = make_track(error=np.full((ROWS, 2), 0.01), window=np.full((ROWS, 2), 0.2), middle=middle)
    omega = track.omega.copy()
    omega[:20, 1] = np.nan
    parts = {name: getattr(track, name) for name in ("error", "amplitudes", "window", "middle")}
    return Track.of(track.t, omega, flags, 0.1, **parts, missing=lines)
