"""What a track says of each tone, and what a reader must know before believing it."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctid_cli.arrays import Array
from ctid_cli.frequency.flags import MEANINGS, Flag
from ctid_cli.reporting.layout import count
from ctid_cli.text import listed
from ctid_cli.tones.constants import MOST_ASKED
from ctid_cli.tones.track import MissingLine, Track

#: A smaller share of valid rows is worth a warning.
MOSTLY_VALID = 0.9
NONE_VALID = "No row is valid: there are no frequencies to report."
NO_TONE = "No tone was asked for (--tones 0): there are no frequencies to report."
#: Most frequent reasons for invalid rows that are named, and tones that have reasons of their own.
MOST_REASONS = 3
MOST_TONES_NAMED = 4
#: Missing lines that a sentence names.
MOST_LINES = 5


def summarise(track: Track) -> list[dict[str, Any]]:
    """Each tone over its valid rows; None where nothing is known.

    ``frequency_hz`` [Hz], ``omega`` [rad/s] and ``amplitude`` [signal unit] are medians, ``spread_hz`` is half the
    width of the central 68 %: how far the tone moves. ``standard_error_hz`` is that of the mean frequency: how well it
    is known. ``begins`` and ``ends`` are the first and the last instant [s since the first sample] of a row in which
    the tone has a frequency; ``valid_percent`` is the share of the rows where it is there.
    """
    return [_tone(track, k) for k in range(track.omega.shape[1])]


def _tone(track: Track, k: int) -> dict[str, Any]:
    valid, there = track.valid[:, k], track.there[:, k]
    omega, seen = track.omega[valid, k], track.t[there & np.isfinite(track.omega[:, k])]
    unknown = ("frequency_hz", "standard_error_hz", "spread_hz", "omega", "amplitude", "amplitude_error")
    tone: dict[str, Any] = {"tone": k + 1, **dict.fromkeys(unknown)}
    if omega.size:
        middle = float(np.median(omega))
        low, high = np.percentile(omega, [16.0, 84.0]) / (2.0 * np.pi)
        tone |= {"frequency_hz": middle / (2.0 * np.pi), "omega": middle, "spread_hz": float(high - low) / 2.0}
        tone["standard_error_hz"] = _error_of_mean(track, track.error, k, 2.0 * np.pi)
        tone["amplitude_error"] = _error_of_mean(track, track.amplitude_error, k)
        amplitudes = track.amplitudes[valid, k]
        amplitudes = amplitudes[np.isfinite(amplitudes)]
        tone["amplitude"] = float(np.median(amplitudes)) if amplitudes.size else None
    tone["begins"], tone["ends"] = (float(seen[0]), float(seen[-1])) if seen.size else (None, None)
    return tone | {"valid_percent": 100.0 * float(valid.sum() / there.sum()) if there.any() else 0.0}


def _error_of_mean(track: Track, errors: Array, k: int, unit: float = 1.0) -> float | None:
    """Standard error of the mean of a tone's valid rows, of which those with common samples share their errors.

    Rows that are read from stretches of length L, every D seconds, have the errors of D/L as many rows without common
    samples: the mean of N rows has the variance ``sum_i s_i^2 min(L_i/D, N)/N^2``.
    """
    known = track.valid[:, k] & np.isfinite(errors[:, k]) & np.isfinite(track.window[:, k])
    n = int(known.sum())
    if n == 0:
        return None
    common = np.clip(track.window[known, k] / track.every, 1.0, n)
    return float(np.sqrt(np.sum(errors[known, k] ** 2 * common))) / n / unit


def track_warnings(track: Track) -> list[str]:
    """What a reader must know before believing the numbers."""
    rows = invalid_rows(track) if track.omega.shape[1] else [NO_TONE]
    return [*track.warnings, *missing_lines(track), *rows]


def missing_lines(track: Track) -> list[str]:
    """One sentence on the lines that are left over, and what to type."""
    lines = track.missing
    if not lines:
        return []
    named = listed([_line_words(line) for line in lines[:MOST_LINES]])
    more = f", and {count(len(lines) - MOST_LINES, 'more line')}" if len(lines) > MOST_LINES else ""
    wanted = min(track.omega.shape[1] + len(lines), MOST_ASKED)
    what, it = ("a line", "it") if len(lines) == 1 else ("lines", "them")
    return [f"The tones leave {what} at {named}{more}; ask for {wanted} tones to follow {it} too: --tones {wanted}"]


def _line_words(line: MissingLine) -> str:
    rows = f", in {100 * line.share:.3g} % of the rows" if np.isfinite(line.share) else ""
    return f"{line.omega / (2.0 * np.pi):.6g} Hz (amplitude {line.amplitude:.3g}{rows})"


def invalid_rows(track: Track) -> list[str]:
    """How many rows are not valid, and why; nothing where nearly all are."""
    if (track.flags == track.flags[:, :1]).all():
        return list(_of_rows(track.flags[:, 0][track.there[:, 0]], "of the rows are", NONE_VALID))
    found = []
    for k in range(track.omega.shape[1]):
        flags, which = track.flags[:, k][track.there[:, k]], f"of the rows of tone {k + 1} are"
        found.append(" ".join(_of_rows(flags, which, f"No row of tone {k + 1} is valid.")))
    found = [each for each in found if each]
    more = len(found) - MOST_TONES_NAMED
    return found[:MOST_TONES_NAMED] + (
        [f"{count(more, 'more tone')} have as many rows that are not."] if more > 0 else []
    )


def _of_rows(flags: NDArray[np.uint16], which: str, none: str) -> Iterator[str]:
    share = float(np.mean(flags == 0)) if flags.size else 0.0
    if share >= MOSTLY_VALID:
        return
    yield f"{100 * (1 - share):.3g} % {which} not valid." if share > 0 else none
    shares = {flag: float(np.mean((flags & int(flag)) != 0)) for flag in Flag} if flags.size else {}
    reasons = sorted((flag for flag in shares if shares[flag] > 0), key=lambda flag: -shares[flag])
    yield from (f"{100 * shares[flag]:.3g} %: {MEANINGS[flag]}" for flag in reasons[:MOST_REASONS])
