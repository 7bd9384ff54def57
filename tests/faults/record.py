"""What was tried so far, kept from one sitting to the next, and what is written of it in the end."""

from __future__ import annotations

import csv
import io
import json
import os
import platform
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any
from uuid import uuid4

from ctid_cli.storage.identity import numeric_platform, package_versions
from ctid_cli.storage.provenance import git_commit, now
from tests.faults.campaigns import CAMPAIGNS, ROOT, Campaign
from tests.faults.counts import BAD, Count, Trial, counted, table


class Record:
    """Trials of a folder; of one that was repeated the last counts."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.folder = folder
        self._path = folder / "trials.jsonl"
        #: By campaign and number; at first, and at last with the sitting.
        self.first: dict[tuple[str, int], Trial] = {}
        self.last: dict[tuple[str, int], tuple[Trial, str]] = {}
        #: Several may go on at once, each with campaigns of its own.
        self.sittings: dict[str, dict[str, Any]] = {}
        text = self._path.read_text(encoding="utf-8") if self._path.exists() else ""
        # A line that was cut off with its sitting is no trial.
        for line in text.splitlines():
            with suppress(json.JSONDecodeError):
                self._take(json.loads(line))
        self._file = self._path.open("a", encoding="utf-8")
        if text and not text.endswith("\n"):
            self._file.write("\n")

    def _take(self, entry: dict[str, Any]) -> None:
        if "commit" in entry:
            self.sittings[entry["sitting"]] = entry | {"trials": 0}
            return
        trial = Trial(**entry["trial"])
        key = (entry["campaign"], trial.number)
        self.first.setdefault(key, trial)
        sitting = entry["sitting"]
        self.last[key] = trial, sitting
        self.sittings[sitting]["trials"] += 1
        self.sittings[sitting]["stopped"] = entry["at"]

    def _write(self, entry: dict[str, Any]) -> None:
        self._file.write(json.dumps(entry) + "\n")
        self._file.flush()
        self._take(entry)

    def begin(self) -> None:
        """Note who tries from now on."""
        entry = {
            "sitting": uuid4().hex[:12],
            "commit": present_commit(),
            "started": now(),
            "system": f"{platform.system()} {platform.release()}",
            "processors": os.cpu_count(),
            "numeric_platform": numeric_platform(),
            "packages": {"python": platform.python_version(), **package_versions()},
        }
        self._write(entry)
        self._own = entry["sitting"]

    def add(self, campaign: Campaign, trial: Trial) -> None:
        """Keep a trial."""
        self._write({"campaign": campaign.name, "sitting": self._own, "at": now(), "trial": asdict(trial)})

    def missing(self, campaign: Campaign, at_most: int) -> Iterator[int]:
        """Numbers of a campaign that were not tried, below a limit."""
        return (number for number in range(at_most) if (campaign.name, number) not in self.last)

    def failed(self, campaign: Campaign) -> Iterator[int]:
        """Numbers of a campaign that brought about at last what must not be."""
        return iter(
            [number for (name, number), (trial, _) in self.last.items() if name == campaign.name and trial.found]
        )

    def counts(self, *, first: bool = False) -> list[Count]:
        """Counts of all kinds."""
        order = {campaign.name: k for k, campaign in enumerate(CAMPAIGNS)}
        found = self.first if first else {key: trial for key, (trial, _) in self.last.items()}
        return counted(found[key] for key in sorted(found, key=lambda key: (order[key[0]], found[key].kind, key[1])))

    def is_complete(self) -> bool:
        """Whether all trials of the full form were made."""
        return not any(True for campaign in CAMPAIGNS for _ in self.missing(campaign, campaign.trials))

    def repeated(self) -> list[tuple[Trial, Trial, str]]:
        """Trial at first and at last, and commit of the last, of those that were repeated."""
        return [
            (self.first[key], trial, self.sittings[sitting]["commit"])
            for key, (trial, sitting) in self.last.items()
            if trial is not self.first[key]
        ]

    def texts(self) -> dict[str, str]:
        """What is written of all this, by file name."""
        return {"faults.md": self._page(), "faults.csv": self._rows(), "environment.json": self._environment()}

    def _page(self) -> str:
        lines = [
            "# Faults that were tried",
            "",
            "Made by `make faults`; [what this means](../../../docs/faults.md).",
            "",
        ]
        lines += [
            table(self.counts()),
            "| commit | trials | begun | ended | machine |",
            "| :-- | --: | :-- | :-- | :-- |",
        ]
        for one in self.sittings.values():
            if one["trials"]:
                commit = one["commit"][:12] + ("" if one["commit"].isalnum() else " with changes")
                machine = f"{one['system']}, {one['processors']} processors, {one['numeric_platform']}"
                lines.append(f"| {commit} | {one['trials']:,} | {one['started']} | {one['stopped']} | {machine} |")
        if again := self.repeated():
            lines += ["", "Trials that found something at first, and were repeated when it was mended:", ""]
            lines += ["| fault | trial | at first | again, at commit |", "| :-- | :-- | :-- | :-- |"]
            for before, after, commit in again:
                name = f"{before.number} ({_cell(before.name)})"
                lines.append(f"| {before.kind} | {name} | {_said(before)} | {_said(after)}, {commit[:12]} |")
        if not self.is_complete():
            lines += ["", "Not all trials of the full form were made."]
        return "\n".join(lines) + "\n"

    def _rows(self) -> str:
        stream = io.StringIO()
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(["fault", "trials", *BAD, *(f"{name}_at_first" for name in BAD)])
        at_first = {count.kind: count.bad for count in self.counts(first=True)}
        for count in self.counts():
            before = at_first.get(count.kind, dict.fromkeys(BAD, 0))
            writer.writerow([count.kind, count.trials, *count.bad.values(), *before.values()])
        return stream.getvalue()

    def _environment(self) -> str:
        return json.dumps({"sittings": [one for one in self.sittings.values() if one["trials"]]}, indent=2) + "\n"


def _said(trial: Trial) -> str:
    return "; ".join(f"{what}: {_cell(text.strip().splitlines()[-1][:160])}" for what, text in trial.found) or "nothing"


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def present_commit() -> str:
    """The commit that is checked out, with a sign if files were changed since."""
    command = ["git", "-C", str(ROOT), "status", "--porcelain", "--", ".", ":(exclude)results/published"]
    changed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    return f"{git_commit(ROOT)}{'+' if changed else ''}"


def refusal(record: Record) -> str:
    """Why this cannot be published; empty if it can."""
    if not record.is_complete():
        return "not all trials of the full form were made"
    if any(not sitting["commit"].isalnum() for sitting in record.sittings.values() if sitting["trials"]):
        return "some trials were made of files that were not committed"
    return ""


def published(folder: Path, texts: dict[str, str]) -> Sequence[Path]:
    """Write texts into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, text in texts.items():
        paths.append(folder / name)
        paths[-1].write_text(text, encoding="utf-8")
    return paths
