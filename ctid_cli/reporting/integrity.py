"""The output of ``ctid verify``."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

from ctid_cli.storage.verify import Verification


def verification_object(found: Verification, out: Path) -> dict[str, Any]:
    """What was found of an experiment, for ``ctid verify --json``."""
    about = {"experiment": found.folder.relative_to(out).as_posix(), "folder": str(found.folder)}
    return about | {"intact": found.is_intact, "findings": [asdict(finding) for finding in found.findings]}


def verification_text(found: Verification, out: Path) -> str:
    """The same, a line for each file."""
    name, verdict = found.folder.relative_to(out).as_posix(), "intact" if found.is_intact else "DAMAGED"
    width = max(len(finding.file) for finding in found.findings)
    lines = [f"{finding.file.ljust(width)}  {finding.state}: {finding.message}" for finding in found.findings]
    return "\n  ".join([f"{name}: {verdict}", *lines])
