"""Results of experiments, read from the folder that ``ctid run`` wrote."""

from __future__ import annotations

import json
import shlex
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cached_property, reduce
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ctid_cli.arrays import IndexArray
from ctid_cli.errors import UsageError
from ctid_cli.running.theory import readable_plan
from ctid_cli.storage.estimates import Estimates, read_stored
from ctid_cli.storage.estimation_errors import error_frame, group_numbers, places_of, planned_groups
from ctid_cli.storage.folder import experiment_folders
from ctid_cli.storage.manifest import Manifest, true_values
from ctid_cli.text import did_you_mean

if TYPE_CHECKING:
    import pandas as pd

    from ctid_cli.running.plan import Plan


@dataclass(frozen=True, eq=False)
class Results:
    """One experiment's results."""

    folder: Path
    stored: Estimates

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

    @property
    def failed(self) -> int:
        """Number of estimates that ended in an error."""
        return int(self.stored.failures.sum())

    @property
    def sampling(self) -> str | None:
        """``regular`` or ``irregular``; None for a measured record."""
        kind = lookup(self.settings, "sampling.kind")
        return kind if kind in (None, "regular") else "irregular"

    def swept(self, part: str) -> list[str]:
        """Return the names of the fields swept over ``data_cells`` or ``estimators``."""
        return list(dict.fromkeys(name for item in self.manifest[part] for name in item["swept"]))

    # --- tables of estimates and errors -----------------------------------------------------------------------------

    @property
    def estimates(self) -> pd.DataFrame:
        """One row for each estimate, as ``ctid export`` writes it; the units of columns are in ``attrs["units"]``."""
        return self.stored.frame()

    @cached_property
    def groups(self) -> pd.DataFrame:
        """Places of data cell and estimator in the plan, and start, of each planned group."""
        return planned_groups(self.manifest)

    @cached_property
    def numbers(self) -> IndexArray:
        """Group number of each estimate."""
        return group_numbers(self.stored)

    @cached_property
    def errors(self) -> pd.DataFrame:
        """Errors of the parameters of simulated systems: a row for each parameter of each estimate."""
        return error_frame(self.stored, self.numbers)

    @cached_property
    def tracks(self) -> pd.DataFrame:
        """Measures of the frequencies of each estimate, a column for each measure; empty for other estimates."""
        import pandas as pd

        if not self.stored.has("measures"):
            return pd.DataFrame()
        return pd.DataFrame(self.stored.column("measures"), columns=self.stored.export.parts("measures"))

    def place(self, group: int) -> tuple[int, int, str]:
        """Return the places of data cell and estimator of a group, and its start."""
        cell, estimator, start = self.groups.iloc[group]
        return cell, estimator, start

    @cached_property
    def _places(self) -> dict[int, IndexArray]:
        return places_of(self.numbers)

    def members(self, group: int) -> Estimates:
        """Return the estimates of one group."""
        return self.stored.chosen(self._places[group])

    @property
    def is_simulated(self) -> bool:
        """Whether true values of parameters are known."""
        return any(map(true_values, self.manifest["data_cells"]))

    @cached_property
    def plan(self) -> Plan | None:
        """Plan of the latest run, unless it names code or is of another version."""
        return readable_plan(self.settings)


def out_option(out: Path) -> str:
    """Return the option with which a suggested command finds a results folder."""
    return "" if out == Path("results") else f" --out {shlex.quote(str(out))}"


def shown_path(file: Path) -> str:
    """Return a file as shown in messages."""
    return str(file.relative_to(Path.cwd()) if file.is_relative_to(Path.cwd()) else file)


def lookup(settings: Any, path: str) -> Any:
    """Return the value at a key path such as ``noise.snr_db``; None if there is none."""
    return reduce(lambda value, key: value.get(key) if isinstance(value, Mapping) else None, path.split("."), settings)


def experiments_in(out: Path) -> list[str]:
    """Return the names of the experiments with results under a folder."""
    return [folder.relative_to(out).as_posix() for folder in experiment_folders(out) if folder != out]


def find_results(out: Path, experiment: str) -> Results | None:
    """Return the results of one experiment, or None if it was never run into this folder."""
    return Results(out / experiment, read_stored(out / experiment)) if experiment in experiments_in(out) else None


def read_results(out: Path, experiment: str) -> Results:
    """Return the results of one experiment."""
    folder = stored_folder(out, experiment)
    return Results(folder, read_stored(folder))


def stored_folder(out: Path, experiment: str) -> Path:
    """Return the folder with the results of one experiment."""
    known = experiments_in(out)
    if experiment not in known:
        hint, there = did_you_mean(experiment, known) or ".", ", ".join(known) or "none"
        raise UsageError(f"there are no results of {experiment!r} in {out}{hint} Experiments there: {there}")
    return out / experiment


def differences(settings: Mapping[str, Any], reference: Mapping[str, Any], shown: Collection[str]) -> list[str]:
    """Return the settings in which results differ from a reference specification."""
    left, right = _leaves(settings), _leaves(reference)
    common = tuple(f"estimators.{name}." for name in set(settings["estimators"]) & set(reference["estimators"]))
    found = []
    for path in dict.fromkeys([*right, *left]):
        if path in shown or (path.startswith("monte_carlo.") and path != "monte_carlo.seed"):
            continue
        if path.startswith("estimators.") and not path.startswith(common):
            continue
        ours, theirs = left.get(path), right.get(path)
        if path == "starts.initial_delay":
            # Fixed delays have their own columns; only another random range would go unnoticed.
            ours, theirs = ([item for item in side or () if isinstance(item, Mapping)] for side in (ours, theirs))
            if not ours:
                continue
        if ours != theirs:
            found.append(f"{path} = {json.dumps(ours)} (not {json.dumps(theirs)})")
    return found


def _leaves(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    leaves: dict[str, Any] = {}
    for key, value in settings.items():
        leaves |= _leaves(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {f"{prefix}{key}": value}
    return leaves
