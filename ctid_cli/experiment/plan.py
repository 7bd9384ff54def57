"""From a specification to the data sets and estimates that it asks for."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, cast

from ctid_cli.errors import UsageError
from ctid_cli.estimators import Start
from ctid_cli.experiment.dataset import DataSet, SimulatedSource, Source
from ctid_cli.experiment.manifest import Key
from ctid_cli.experiment.sections import MAX_COMBINATIONS, Variant, variants
from ctid_cli.experiment.spec import Spec, UniformStart, content_hash, located
from ctid_cli.experiment.yaml_source import KeyPath
from ctid_cli.signals import stream

#: Data sets that one experiment may ask for; beyond this its plan alone would fill the memory.
MAX_DATA_SETS = 1_000_000

#: Columns that every row of results or tables has; a swept field of the same name is written with its section.
# fmt: off
RESERVED_COLUMNS = frozenset((
    "id", "experiment", "estimator", "kind", "cell", "replicate", "start", "initial_delay", "start_delay",
    "status", "message", "delay", "numerator", "denominator", "standard_errors", "cost", "fit_percent",
    "validation_fit_percent", "iterations", "condition_number", "seconds", "converged", "true_delay", "table",
    "sampling", "method", "n", "failed", "percent", "low", "high", "published_percent", "median_seconds",
))
# fmt: on


@dataclass(frozen=True, eq=False)
class DataCell:
    """One combination of system, excitation, sampling, noise and seed, or one measured record.

    Parameters
    ----------
    content : dict
        What the data depend on, as plain data; its hash is their identity.
    hash : str
        `content_hash` of ``content``.
    swept : dict
        Column and value of every swept field.
    source : SimulatedSource or MeasuredSource
        Makes the data sets.
    """

    content: dict[str, Any]
    hash: str
    swept: dict[str, Any]
    source: Source

    def dataset(self, replicate: int) -> DataSet:
        """One data set.

        Parameters
        ----------
        replicate : int
            Which one, from 0.

        Returns
        -------
        DataSet
            The same for the same replicate, whenever and wherever it is made.
        """
        return self.source.dataset(replicate)


@dataclass(frozen=True, eq=False)
class EstimatorCell:
    """One estimator with one combination of its swept options.

    Parameters
    ----------
    name : str
        Its name in the specification; not part of its identity.
    kind : str
        Which algorithm.
    estimator : Any
        The option dataclass, ready to ``prepare`` a record.
    content : dict
        Kind and options as plain data.
    hash : str
        `content_hash` of ``content``.
    swept : dict
        Column and value of every swept option.
    """

    name: str
    kind: str
    estimator: Any
    content: dict[str, Any]
    hash: str
    swept: dict[str, Any]


@dataclass(frozen=True)
class StartPoint:
    """Where an estimate starts.

    Parameters
    ----------
    label : str
        The start in the identity of an estimate: ``"3"``, ``"uniform(0, 9)"`` or ``"none"``.
    initial_delay : float, "random" or None
        Initial delay [s]; None leaves it to the estimator.
    bounds : (float, float), optional
        Range of a random one [s].
    """

    label: str
    initial_delay: float | str | None
    bounds: tuple[float, float] | None = None

    def draw(self, seed: int | None, replicate: int) -> Start | None:
        """The start on one data set.

        Parameters
        ----------
        seed : int or None
            Seed of the experiment; needed for a random start only.
        replicate : int
            Which data set.

        Returns
        -------
        Start or None
            None leaves it to the estimator.

        Notes
        -----
        Every random start stretches the first number of the replicate's stream over its own range, so that no start
        depends on which others there are.
        """
        if self.bounds is not None:
            if seed is None:
                raise ValueError("a random start needs the seed of the experiment")
            low, high = self.bounds
            return Start(delay=low + (high - low) * float(stream(seed, "start", replicate).random()))
        return None if self.initial_delay is None else Start(delay=cast(float, self.initial_delay))


#: The start of estimators that need none, and of every estimator where the specification names none.
NO_START = StartPoint("none", None)


@dataclass(frozen=True)
class Task:
    """One data set.

    Parameters
    ----------
    cell : int
        Index of its data cell in the plan.
    replicate : int
        Which data set of the cell.
    """

    cell: int
    replicate: int


@dataclass(frozen=True, eq=False)
class Plan:
    """All data sets and estimates of an experiment.

    Parameters
    ----------
    spec : Spec
        The specification, with the number of data sets that is planned.
    data_cells : tuple of DataCell
        In the order of the specification, the last swept field changing fastest.
    estimators : tuple of EstimatorCell
        In the order of the specification.
    starts : tuple of StartPoint
        Starts of the specification, and the one of estimators that use none where there are such.
    runs : int
        Data sets of every data cell.
    spec_hash : str
        Hash of the specification without what is in no identity: number of data sets, places of files.
    """

    spec: Spec
    data_cells: tuple[DataCell, ...]
    estimators: tuple[EstimatorCell, ...]
    starts: tuple[StartPoint, ...]
    runs: int
    spec_hash: str

    @property
    def experiment(self) -> str:
        """Name of the experiment."""
        return self.spec.experiment

    def tasks(self) -> list[Task]:
        """The data sets.

        Returns
        -------
        list of Task
            All cells of replicate 0 first, so that an interrupted run has something of every cell.
        """
        return [Task(cell, replicate) for replicate in range(self.runs) for cell in range(len(self.data_cells))]

    def keys(self, task: Task) -> list[tuple[Key, EstimatorCell, StartPoint]]:
        """The estimates wanted of a data set.

        Parameters
        ----------
        task : Task
            The data set.

        Returns
        -------
        list of (Key, EstimatorCell, StartPoint)
            Those of one estimator next to each other.
        """
        data_hash = self.data_cells[task.cell].hash
        return [
            (Key(data_hash, task.replicate, cell.hash, start.label), cell, start)
            for cell in self.estimators
            for start in (self._given_starts if cell.estimator.uses_start else (NO_START,))
        ]

    @property
    def _given_starts(self) -> tuple[StartPoint, ...]:
        return tuple(start for start in self.starts if start is not NO_START) or (NO_START,)


def build_plan(spec: Spec, runs: int | None = None) -> Plan:
    """Plan an experiment.

    Parameters
    ----------
    spec : Spec
        The specification.
    runs : int, optional
        Data sets of every data cell, in place of the specification's. A measured record is one data set always.

    Returns
    -------
    Plan
        Nothing is simulated or read yet.

    Raises
    ------
    UsageError
        If the specification asks for no or too many data sets.
    """
    if runs is not None and runs < 1:
        raise UsageError(f"the number of data sets must be 1 or more, not {runs}")
    count = 1
    if spec.data is None:
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
    starts = _start_points(spec)
    if NO_START not in starts and not all(cell.estimator.uses_start for cell in estimator_cells):
        starts = (*starts, NO_START)
    return Plan(
        spec=spec,
        data_cells=_data_cells(spec, parts, names),
        estimators=estimator_cells,
        starts=starts,
        runs=count,
        spec_hash=content_hash(_without_circumstances(spec.canonical())),
    )


def _data_variants(spec: Spec) -> dict[str, list[Variant]]:
    """Variants of every section that data are simulated from; none for a measured record."""
    if spec.data is not None:
        return {}
    sections = {"system": spec.system, "excitation": spec.excitation, "sampling": spec.sampling, "noise": spec.noise}
    return {name: variants(section) for name, section in sections.items() if section is not None}


def _data_cells(spec: Spec, parts: Mapping[str, list[Variant]], names: Mapping[KeyPath, str]) -> tuple[DataCell, ...]:
    seed = None if spec.monte_carlo is None else spec.monte_carlo.seed
    if spec.data is not None:
        # The seed decides where random starts lie; the record itself is in the content as a hash.
        content = {"data": _without_place(spec.data.model_dump(mode="json")), "seed": seed}
        return (DataCell(content, content_hash(content), {}, spec.data.source(spec.folder.resolve())),)
    assert seed is not None
    # Absolute, because worker processes may have been started in another working directory.
    folder = spec.folder.resolve()
    cells = []
    for point in itertools.product(*parts.values()):
        chosen = dict(zip(parts, point, strict=True))
        content = {name: _without_place(variant.values) for name, variant in chosen.items()}
        content |= {"noise": content.get("noise"), "seed": seed}
        source = SimulatedSource(
            system=chosen["system"].options,
            excitation=located(chosen["excitation"].options, folder),
            sampling=chosen["sampling"].options,
            noise=chosen["noise"].options if "noise" in chosen else None,
            seed=seed,
            input_sha256=chosen["excitation"].values.get("sha256"),
        )
        swept = {names[name, *path]: value for name, v in chosen.items() for path, value in v.swept.items()}
        cells.append(DataCell(content, content_hash(content), swept, source))
    return tuple(cells)


def _estimator_cell(name: str, variant: Variant, names: Mapping[KeyPath, str]) -> EstimatorCell:
    swept = {names["estimator", *path]: value for path, value in variant.swept.items()}
    content = variant.values
    return EstimatorCell(name, content["kind"], variant.options, content, content_hash(content), swept)


def _start_points(spec: Spec) -> tuple[StartPoint, ...]:
    if spec.starts is None:
        return (NO_START,)
    points = []
    for point in spec.starts.points:
        if isinstance(point, UniformStart):
            low, high = point.uniform
            points.append(StartPoint(f"uniform({_short(low)}, {_short(high)})", "random", (low, high)))
        else:
            points.append(StartPoint(_short(point), point))
    return tuple(points)


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
    return {key: value for key, value in content.items() if not (key == "file" and "sha256" in content)}


def _without_circumstances(canonical: Mapping[str, Any]) -> dict[str, Any]:
    content = {key: _without_place(value) if isinstance(value, dict) else value for key, value in canonical.items()}
    if content.get("monte_carlo") is not None:
        content["monte_carlo"] = {"seed": content["monte_carlo"]["seed"]}
    return content


def _short(value: float) -> str:
    """The shortest text that is the number again, without a trailing ``.0``."""
    return repr(value).removesuffix(".0")
