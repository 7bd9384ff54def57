"""Warnings about the reliability of a track."""

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ctid_cli.frequency.flags import MEANINGS, Flag
from ctid_cli.text import count, listed
from ctid_cli.tones.constants import MOST_TONES
from ctid_cli.tones.track import MissingLine, Track

#: A smaller share of valid rows gives a warning.
MOSTLY_VALID = 0.9
#: Largest numbers of reasons for invalid rows, of such warnings, and of missing lines in the messages.
MOST_REASONS = 3
MOST_WARNINGS = 4
MOST_LINES = 5
TURN = 2.0 * math.pi


def track_warnings(track: Track) -> list[str]:
    """Return warnings, each with a remedy."""
    if not track.omega.shape[1]:
        none = "No tone was asked for (--tones 0): there are no frequencies to report."
        return [*track.warnings, *_missing_lines(track), none]
    return [*track.warnings, *_missing_lines(track), *_invalid_rows(track)]


def _missing_lines(track: Track) -> Iterator[str]:
    """Yield messages about residual lines, with the command to use."""
    lines = track.missing
    if lines:
        named = listed([_line_words(line) for line in lines[:MOST_LINES]])
        more = f", and {count(len(lines) - MOST_LINES, 'more line')}" if len(lines) > MOST_LINES else ""
        wanted = min(track.omega.shape[1] + len(lines), MOST_TONES)
        what, it = ("a line", "it") if len(lines) == 1 else ("lines", "them")
        yield f"The tones leave {what} at {named}{more}; ask for {wanted} tones to follow {it} too: --tones {wanted}"


def _line_words(line: MissingLine) -> str:
    rows = f", in {100 * line.share:.3g} % of the rows"
    return f"{line.omega / TURN:.6g} Hz (amplitude {line.amplitude:.3g}{rows})"


def _invalid_rows(track: Track) -> list[str]:
    """Return messages on the share of invalid rows and the reasons, merged for tones with equal reasons."""
    found: dict[str, list[str]] = {}
    for k, (flags, there) in enumerate(zip(track.flags.T, track.there.T, strict=True)):
        if reasons := _reasons(flags[there]):
            found.setdefault(reasons, []).append(f"tone {k + 1}")
    said = [f"{listed(tones).capitalize()}: {reasons}" for reasons, tones in found.items()]
    more = [f"{count(len(said) - MOST_WARNINGS, 'more tone')} with rows that are not valid."]
    return said if len(said) <= MOST_WARNINGS else said[:MOST_WARNINGS] + more


def _reasons(flags: NDArray[np.uint16]) -> str:
    """Return the share of invalid rows with the most frequent reasons; empty if nearly all are valid."""
    share = float(np.mean(flags == 0)) if flags.size else 0.0
    if share >= MOSTLY_VALID:
        return ""
    shares = {flag: float(np.mean((flags & int(flag)) != 0)) if flags.size else 0.0 for flag in Flag}
    reasons = sorted((flag for flag in shares if shares[flag] > 0), key=lambda flag: -shares[flag])
    what = f"{100 * (1 - share):.3g} % of the rows are not valid." if share > 0 else "no row is valid."
    return " ".join([what, *(f"{100 * shares[flag]:.3g} %: {MEANINGS[flag]}" for flag in reasons[:MOST_REASONS])])
