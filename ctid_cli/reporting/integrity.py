"""What ``ctid verify`` and ``ctid repair`` answer."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

from ctid_cli.reporting.layout import count
from ctid_cli.reporting.results import out_option
from ctid_cli.storage.manifest import Slot
from ctid_cli.storage.repair import Repair
from ctid_cli.storage.verify import Verification

#: Estimates to compute again that the text lists.
LISTED = 10


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


def repair_object(found: Repair) -> dict[str, Any]:
    """What was saved, for ``ctid repair --json``."""
    counts = {"planned": found.planned, "saved": found.saved, "left_aside": found.left_aside}
    folders = {"folder": str(found.folder), "saved_in": str(found.saved_in)}
    return {"experiment": found.experiment, **folders, **counts, "missing": [_missing(slot) for slot in found.missing]}


def _missing(slot: Slot) -> dict[str, Any]:
    key, name = slot.key, slot.estimator["name"]
    return {"id": key.id, "estimator": name, "cell": key.data_hash, "replicate": key.replicate, "start": key.start} | (
        slot.swept
    )


def repair_text(found: Repair, results: Path) -> str:
    """What was saved, what is missing and how to go on."""
    text = f"{found.experiment}: {found.saved} of {found.planned} estimates saved in {found.saved_in}"
    text += f", and {found.left_aside} that the latest run did not ask for" if found.left_aside else ""
    lines = [f"{text}; {found.folder} is as it was"]
    if found.missing:
        lines.append(f"  to compute again: {count(len({slot.key for slot in found.missing}), 'estimate')}")
        for slot in found.missing[:LISTED]:
            swept = "".join(f", {name} {value}" for name, value in slot.swept.items())
            of = f"{slot.estimator['name']}{swept}, replicate {slot.key.replicate}, start {slot.key.start}"
            lines.append(f"    {slot.key.id}  {of}")
        if len(found.missing) > LISTED:
            lines.append(f"    and {len(found.missing) - LISTED} more")
        lines.append(f"  next: ctid run CONFIG{out_option(results)}, with the experiment file that made them")
    else:
        lines.append(f"  next: ctid table {found.experiment}{out_option(results)}")
    return "\n".join(lines)
