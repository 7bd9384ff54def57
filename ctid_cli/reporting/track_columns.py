"""The file of a track: its columns, and their bytes."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctid_cli.frequency.flags import Flag
from ctid_cli.reporting.column_file import columns_bytes
from ctid_cli.tones.track import Track

#: Units of the columns of a tone, but for those of the signal's own unit.
UNITS = {
    "frequency_hz": "Hz",
    "frequency_error_hz": "Hz",
    "omega": "rad/s",
    "phase": "rad",
    "growth": "1/s",
    "rate": "Hz/s",
}
_OF_THE_SIGNAL = ("amplitude", "amplitude_error")


def flag_words(flags: int) -> str:
    """Names of flags."""
    return " ".join(str(flag.name).lower() for flag in Flag if flags & flag)


def track_table(track: Track, start: float) -> dict[str, NDArray[Any]]:
    """Columns of the file of a track, those of one tone after those of another."""
    table: dict[str, NDArray[Any]] = {"t": start + track.t}
    turn = 2.0 * np.pi
    for k in range(track.omega.shape[1]):
        of_tone: dict[str, NDArray[Any]] = {
            f"frequency_{k + 1}_hz": track.omega[:, k] / turn,
            f"frequency_error_{k + 1}_hz": track.error[:, k] / turn,
            f"omega_{k + 1}": track.omega[:, k],
            f"amplitude_{k + 1}": track.amplitudes[:, k],
            f"amplitude_error_{k + 1}": track.amplitude_error[:, k],
            f"phase_{k + 1}": track.phase[:, k],
            f"growth_{k + 1}": track.growth[:, k],
            f"rate_{k + 1}": track.rate[:, k] / turn,
            f"valid_{k + 1}": track.valid[:, k],
            f"flags_{k + 1}": np.array([flag_words(int(flags)) for flags in track.flags[:, k]], dtype=object),
        }
        table |= of_tone
    return table


def track_bytes(table: dict[str, NDArray[Any]], style: str, unit: str | None = None) -> bytes:
    """The file of a track."""
    return columns_bytes(table, style, {name: _unit_of(name, unit) for name in table})


def _unit_of(name: str, unit: str | None) -> str | None:
    """Unit of a column; the number of its tone does not matter."""
    if name == "t":
        return "s"
    kind = "_".join(word for word in name.split("_") if not word.isdecimal())
    return unit if kind in _OF_THE_SIGNAL else UNITS.get(kind)
