"""From a specification to the data sets and estimates that it asks for."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ctid_cli.canonical import content_hash
from ctid_cli.errors import UsageError
from ctid_cli.kinds import KINDS
from ctid_cli.models.additive import AdditiveModel, Term
from ctid_cli.simulation.dataset import LoopOptions, SimulatedSource, Source, located
from ctid_cli.simulation.frequency_measures import Measuring
from ctid_cli.simulation.frequency_runs import FrequencyEstimation, SignalSource
from ctid_cli.specification.sections import MAX_COMBINATIONS, Variant, variants
from ctid_cli.specification.spec import Spec
from ctid_cli.specification.start_points import NO_START, AnyStart, ParameterStart, StartPoint, start_points
from ctid_cli.specification.yaml_source import KeyPath
from ctid_cli.storage.manifest import Key, Manifest

#: Data sets that one experiment may ask for; beyond this its plan alone would fill the memory.
MAX_DATA_SETS = 1_000_000

#: Columns that every row of results or tables has; a swept field of the same name is written with its section.
# fmt: off
RESERVED_COLUMNS = frozenset((
    "id", "experiment", "estimator", "kind", "cell", "replicate", "start", "initial_delay", "start_delay",
    "status", "message", "delay", "numerator", "denominator", "parameters", "standard_errors", "cost", "fit_percent",
    "validation_fit_percent", "iterations", "condition_number", "seconds", "converged", "true_delay", "table",
    "sampling", "method", "n", "failed", "percent", "low", "high", "published_percent", "median_seconds",
))
# fmt: on


@dataclass(frozen=True, eq=False)
class DataCell:
    """One combination of system, excitation or loop, sampling, noise and seed, or one measured record."""

    content: dict[str, Any]
    hash: str
    swept: dict[str, Any]
    source: Source | SignalSource

    def dataset(self, replicate: int) -> Any:
        """One data set."""
        return self.source.dataset(replicate)


@dataclass(frozen=True, eq=False)
class EstimatorCell:
    """One estimator with one combination of its swept options."""

    name: str
    kind: str
    estimator: Any
    content: dict[str, Any]
    hash: str
    swept: dict[str, Any]


@dataclass(frozen=True)
class Task:
    """One data set."""

    cell: int
    replicate: int


@dataclass(frozen=True, eq=False)
class Plan:
    """All data sets and estimates of an experiment."""

    spec: Spec
    data_cells: tuple[DataCell, ...]
    estimators: tuple[EstimatorCell, ...]
    starts: tuple[AnyStart, ...]
    runs: int
    spec_hash: str

    @property
    def experiment(self) -> str:
        """Name of the experiment."""
        return self.spec.experiment

    def tasks(self) -> list[Task]:
        """The data sets."""
        return [Task(cell, replicate) for replicate in range(self.runs) for cell in range(len(self.data_cells))]

    def keys(self, task: Task) -> list[tuple[Key, EstimatorCell, AnyStart]]:
        """The estimates wanted of a data set."""
        data_hash = self.data_cells[task.cell].hash
        return [
            (Key(data_hash, task.replicate, cell.hash, start.label), cell, start)
            for cell in self.estimators
            for start in _starts_of(cell.estimator.start_from, self.starts)
        ]

    @property
    def terms(self) -> tuple[Term, ...] | None:
        """Structure of the submodels that estimates of one fraction are also given as; None for none.

        That of the simulated system, by rising natural frequency, or else of the first estimator of submodels.
        """
        cell = self.data_cells[0].source
        if isinstance(cell, SimulatedSource) and isinstance(cell.system, AdditiveModel):
            return cell.system.sorted().terms
        found = (getattr(cell.estimator, "terms", None) for cell in self.estimators)
        return next((tuple(terms) for terms in found if terms is not None), None)

    def manifest(self) -> Manifest:
        """The plan as plain data."""
        replicates = [0] * len(self.data_cells)
        starts: dict[str, list[str]] = {}
        for task in self.tasks():
            replicates[task.cell] += 1
            if not starts:
                for _, cell, start in self.keys(task):
                    starts.setdefault(f"{cell.name}/{cell.hash}", []).append(start.label)
        canonical = self.spec.canonical()
        return {
            "experiment": self.experiment,
            "runs": self.runs,
            "seed": (canonical.get("monte_carlo") or {}).get("seed"),
            "spec_hash": self.spec_hash,
            "spec": canonical,
            "success": canonical.get("success"),
            "data_cells": [
                {"hash": cell.hash, "replicates": count, "swept": dict(cell.swept), "content": cell.content}
                for cell, count in zip(self.data_cells, replicates, strict=True)
            ],
            "estimators": [
                {
                    "name": cell.name,
                    "kind": cell.kind,
                    "hash": cell.hash,
                    "swept": dict(cell.swept),
                    "content": cell.content,
                    "starts": starts.get(f"{cell.name}/{cell.hash}", []),
                }
                for cell in self.estimators
            ],
            "starts": {start.label: start.initial_delay for start in self.starts},
        }


def build_plan(spec: Spec, runs: int | None = None) -> Plan:
    """Plan an experiment."""
    if runs is not None and runs < 1:
        raise UsageError(f"the number of data sets must be 1 or more, not {runs}")
    count = 1
    if spec.data is None and spec.monte_carlo is not None:
        spec = spec if runs is None else spec.with_runs(runs)
        assert spec.monte_carlo is not None
        count = spec.monte_carlo.runs
    parts = _data_variants(spec)
    cells = math.prod(len(cases) for cases in parts.values())
    if cells > MAX_COMBINATIONS:
        raise UsageError(
            f"{spec.experiment}: the swept fields combine to {cells} data cells; at most {MAX_COMBINATIONS} are allowed"
        )
    if cells * count > MAX_DATA_SETS:
        raise UsageError(
            f"{spec.experiment}: {cells} data cells of {count} data sets each are too many; "
            f"at most {MAX_DATA_SETS} data sets are allowed"
        )
    estimators = {name: variants(section) for name, section in spec.estimators.items()}
    names = _column_names(
        [(name, *path) for name, cases in parts.items() for path in cases[0].swept]
        + [("estimator", *path) for cases in estimators.values() for path in cases[0].swept]
    )
    estimator_cells = tuple(
        _estimator_cell(name, variant, names) for name, cases in estimators.items() for variant in cases
    )
    starts = start_points(spec.starts)
    if any(NO_START in _starts_of(cell.estimator.start_from, starts) for cell in estimator_cells):
        starts = (*starts, NO_START)
    return Plan(
        spec=spec,
        data_cells=_data_cells(spec, parts, names),
        estimators=estimator_cells,
        starts=starts,
        runs=count,
        spec_hash=content_hash(_without_circumstances(spec.canonical())),
    )


def _starts_of(kind: str | None, starts: tuple[AnyStart, ...]) -> tuple[AnyStart, ...]:
    """The starts that an estimator which takes one of a kind begins from."""
    wanted = {None: (), "delay": (StartPoint,), "parameters": (ParameterStart,)}[kind]
    return tuple(start for start in starts if isinstance(start, wanted) and start != NO_START) or (NO_START,)


def _data_variants(spec: Spec) -> dict[str, list[Variant]]:
    """Variants of every section that data are simulated from; of a measured record only those of its loop."""
    sections = {
        "system": spec.system,
        "excitation": spec.excitation,
        "loop": spec.loop,
        "sampling": spec.sampling,
        "noise": spec.noise,
        "signal": spec.signal,
        "disturbance": spec.disturbance,
    }
    return {name: variants(section) for name, section in sections.items() if section is not None}


def _data_cells(spec: Spec, parts: Mapping[str, list[Variant]], names: Mapping[KeyPath, str]) -> tuple[DataCell, ...]:
    seed = None if spec.monte_carlo is None else spec.monte_carlo.seed
    # Absolute, because worker processes may have been started in another working directory.
    folder = spec.folder.resolve()
    cells = []
    for point in itertools.product(*parts.values()):
        chosen = dict(zip(parts, point, strict=True))
        loop = chosen["loop"].options if "loop" in chosen else None
        content: dict[str, Any] = {name: _without_place(variant.values) for name, variant in chosen.items()}
        source: Source | SignalSource
        if spec.signal is not None:
            # What is measured of an estimate is stored with it, so that it belongs to its identity.
            measuring = _measuring(spec)
            content |= {"disturbance": content.get("disturbance"), "seed": seed}
            content["measuring"] = dataclasses.asdict(measuring)
            source = _of_signal(chosen, spec, measuring)
        elif spec.data is not None:
            # The seed decides where random starts lie; the record itself is in the content as a hash.
            content = {"data": _without_place(spec.data.model_dump(mode="json")), **content, "seed": seed}
            source = dataclasses.replace(located(spec.data.options(), folder), loop=loop)
        else:
            content |= {"noise": content.get("noise"), "seed": seed}
            source = _simulated(chosen, loop, folder, spec)
        swept = {names[name, *path]: value for name, v in chosen.items() for path, value in v.swept.items()}
        cells.append(DataCell(content, content_hash(content), swept, source))
    return tuple(cells)


def _simulated(chosen: Mapping[str, Variant], loop: LoopOptions | None, folder: Path, spec: Spec) -> SimulatedSource:
    """Source of the data sets of one combination of the sections' variants."""
    return SimulatedSource(
        system=chosen["system"].options,
        excitation=located(chosen["excitation"].options, folder) if loop is None else None,
        sampling=chosen["sampling"].options,
        noise=chosen["noise"].options if "noise" in chosen else None,
        seed=_seed(spec),
        loop=None if loop is None else dataclasses.replace(loop, reference=located(loop.reference, folder)),
    )


def _seed(spec: Spec) -> int:
    """The seed; any one will do where nothing is random."""
    return 0 if spec.monte_carlo is None else spec.monte_carlo.seed


def _measuring(spec: Spec) -> Measuring:
    """What is measured of the frequencies of a signal."""
    band = None if spec.success is None else spec.success.band
    if spec.tracks is None:
        return Measuring(band)
    low_high = spec.tracks.window
    window = None if low_high is None else (low_high[0], low_high[1])
    return Measuring(band, window, spec.tracks.interval, spec.tracks.runs)


def _of_signal(chosen: Mapping[str, Variant], spec: Spec, measuring: Measuring) -> SignalSource:
    """Source of the data sets of one combination of the sections' variants."""
    disturbance = chosen["disturbance"].options if "disturbance" in chosen else None
    return SignalSource(chosen["signal"].options, disturbance, chosen["sampling"].options, _seed(spec), measuring)


def _estimator_cell(name: str, variant: Variant, names: Mapping[KeyPath, str]) -> EstimatorCell:
    swept = {names["estimator", *path]: value for path, value in variant.swept.items()}
    content = variant.values
    of_frequencies = content["kind"] in KINDS["frequency_estimator"]
    estimator = FrequencyEstimation(variant.options) if of_frequencies else variant.options
    return EstimatorCell(name, content["kind"], estimator, content, content_hash(content), swept)


def _column_names(paths: Iterable[KeyPath]) -> dict[KeyPath, str]:
    """Name of the column of every swept field: its last word, or more of its path where that is taken."""
    distinct = list(dict.fromkeys(paths))
    last = [path[-1] for path in distinct]
    return {
        path: ".".join(map(str, path)) if path[-1] in RESERVED_COLUMNS or last.count(path[-1]) > 1 else str(path[-1])
        for path in distinct
    }


def _without_place(content: Mapping[str, Any]) -> dict[str, Any]:
    """A section without the name of its file, whose content hash says what matters."""
    return {
        key: _without_place(value) if isinstance(value, dict) else value
        for key, value in content.items()
        if not (key == "file" and "sha256" in content)
    }


def _without_circumstances(canonical: Mapping[str, Any]) -> dict[str, Any]:
    content = {key: _without_place(value) if isinstance(value, dict) else value for key, value in canonical.items()}
    if content.get("monte_carlo") is not None:
        content["monte_carlo"] = {"seed": content["monte_carlo"]["seed"]}
    return content
