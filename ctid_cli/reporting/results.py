"""Results of experiments, read back from the folder that ``ctid run`` wrote them to."""

from __future__ import annotations

import difflib
import json
import shlex
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from ctid_cli.errors import UsageError
from ctid_cli.storage.folder import experiment_folders
from ctid_cli.storage.manifest import FAILURES, Manifest
from ctid_cli.storage.store import Stored, read_stored
from ctid_cli.storage.summary import summarise


@dataclass(frozen=True)
class Results:
    """One experiment's results."""

    folder: Path
    stored: Stored

    @property
    def manifest(self) -> Manifest:
        """Plan of the latest run as plain data."""
        return self.stored.manifest

    @property
    def experiment(self) -> str:
        """Name of the experiment."""
        return str(self.manifest["experiment"])

    @property
    def settings(self) -> Mapping[str, Any]:
        """Canonical specification of the latest run."""
        spec: Mapping[str, Any] = self.manifest["spec"]
        return spec

    @cached_property
    def rows(self) -> list[dict[str, Any]]:
        """Stored estimates of the plan."""
        return self.stored.rows()

    @property
    def failed(self) -> int:
        """How many estimates ended in an error."""
        return sum(row["status"] in FAILURES for row in self.rows)

    @property
    def mixed(self) -> bool:
        """Whether other code or another processor computed some of the estimates."""
        return len(self.stored.origins) > 1

    @property
    def measured(self) -> bool:
        """Whether the data are a measured record rather than simulated."""
        return self.settings.get("data") is not None

    @property
    def sampling(self) -> str | None:
        """``regular`` or ``irregular``; None for a measured record."""
        kind = lookup(self.settings, "sampling.kind")
        if kind is None:
            return None
        return "regular" if kind == "regular" else "irregular"

    def summaries(self, by: Sequence[str]) -> list[dict[str, Any]]:
        """Counts and percentages in groups, as plain Python."""
        import pandas as pd

        frame = pd.DataFrame(self.rows, columns=[*by, "status", "converged", "seconds"])
        frame = frame.astype({"converged": "boolean", "seconds": "float64"})
        counted = summarise(frame, by)
        return [
            {str(key): value for key, value in row.items()}
            for row in counted.astype(object).where(counted.notna(), None).to_dict("records")
        ]


def out_option(out: Path) -> str:
    """What a suggested command needs to find a results folder again."""
    return "" if out == Path("results") else f" --out {shlex.quote(str(out))}"


def shown_path(file: Path) -> str:
    """A file as a message names it."""
    try:
        return str(file.relative_to(Path.cwd()))
    except ValueError:
        return str(file)


def lookup(settings: Mapping[str, Any], path: str) -> Any:
    """Value at a key path such as ``noise.snr_db``."""
    value: Any = settings
    for key in path.split("."):
        if not isinstance(value, Mapping) or key not in value:
            return None
        value = value[key]
    return value


def experiments_in(out: Path) -> list[str]:
    """Names of the experiments that have results under a folder."""
    return [folder.relative_to(out).as_posix() for folder in experiment_folders(out) if folder != out]


def find_results(out: Path, experiment: str) -> Results | None:
    """Results of one experiment, or None if it was never run into this folder."""
    return read_results(out, experiment) if experiment in experiments_in(out) else None


def read_results(out: Path, experiment: str) -> Results:
    """Results of one experiment."""
    known = experiments_in(out)
    if experiment not in known:
        close = difflib.get_close_matches(experiment, known, n=1)
        hint = f"; did you mean {close[0]!r}?" if close else "."
        there = ", ".join(known) or "none"
        raise UsageError(f"there are no results of {experiment!r} in {out}{hint} Experiments there: {there}")
    folder = out / experiment
    return Results(folder, read_stored(folder))


def differences(settings: Mapping[str, Any], reference: Mapping[str, Any], shown: Collection[str]) -> list[str]:
    """Settings in which results differ from a reference specification."""
    left, right = _leaves(settings), _leaves(reference)
    common = tuple(f"estimators.{name}." for name in set(settings["estimators"]) & set(reference["estimators"]))
    found = []
    for path in dict.fromkeys([*right, *left]):
        if path in shown or path == "monte_carlo.runs":
            continue
        if path.startswith("estimators.") and not path.startswith(common):
            continue
        ours, theirs = left.get(path), right.get(path)
        if path == "starts.initial_delay":
            # Fixed delays are columns of their own; only another random range would go unnoticed.
            ours, theirs = (_random_only(side) for side in (ours, theirs))
            if not ours:
                continue
        if ours != theirs:
            found.append(f"{path} = {json.dumps(ours)} (not {json.dumps(theirs)})")
    return found


def _random_only(delays: Any) -> list[Any]:
    return [delay for delay in delays if isinstance(delay, Mapping)] if isinstance(delays, list) else []


def _leaves(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    leaves: dict[str, Any] = {}
    for key, value in settings.items():
        if isinstance(value, Mapping):
            leaves |= _leaves(value, f"{prefix}{key}.")
        else:
            leaves[f"{prefix}{key}"] = value
    return leaves
