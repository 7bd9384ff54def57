"""What to cite for a fit or a track, as BibTeX: ctid, and the methods of others that it used."""

import re
from pathlib import Path

import ctid_cli
from ctid_cli.estimators.identification import Identification


def track_bibtex() -> str:
    """Entries for a track of a recorded signal."""
    return _entries("ctid", "rife1976")


def bibtex(result: Identification) -> str:
    """Entries for a fit and for the frequency response that stands beside it."""
    keys = ["ctid", "gonzalez2025" if result.options.kind == "additive_srivc" else "kaufman1975"]
    if result.fit.weighting is not None:
        keys.append("huber2009")
    if result.uncertainty.kind in ("robust", "bootstrap"):
        keys.append("patterson1971")
    return _entries(*keys, "pintelon2012")


def _entries(*keys: str) -> str:
    """Return entries of ``citations.bib``."""
    text = Path(__file__).with_suffix(".bib").read_text(encoding="utf-8")
    found = {key: entry for entry, key in re.findall(r"(?ms)^(@\w+\{(\w+),.*?^\})", text)}
    return "\n\n".join(found[key] for key in keys).replace("VERSION", ctid_cli.__version__)
