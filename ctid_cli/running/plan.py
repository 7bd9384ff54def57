"""Plans: the data sets of a specification, and the estimates requested of each."""

from __future__ import annotations

import dataclasses
import itertools
import math
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ctid_cli.arrays import BoolArray
from ctid_cli.canonical import content_hash
from ctid_cli.errors import UsageError
from ctid_cli.frequency.base import FrequencyEstimator
from ctid_cli.models.additive import AdditiveModel, Term
from ctid_cli.models.several_inputs import MultiInputModel
from ctid_cli.running.job import DataCell, EstimatorCell, Job, Wanted
from ctid_cli.simulation.components import CustomEstimation, is_custom
from ctid_cli.simulation.dataset import DataSet, SimulatedSource, Source, joined, located
from ctid_cli.simulation.frequency_measures import FrequencyEstimation, Measuring, SignalDataSet, SignalSource
from ctid_cli.simulation.start_points import NO_START, StartPoint
from ctid_cli.specification.load import load_spec
from ctid_cli.specification.spec import MonteCarloSection, Spec
from ctid_cli.specification.sweeps import MAX_COMBINATIONS, Variant, replaced, variants
from ctid_cli.specification.system_sections import start_points, truth_of
from ctid_cli.specification.yaml_source import KeyPath
from ctid_cli.storage.columns import reserved_names
from ctid_cli.storage.identity import Origin, origin_of
from ctid_cli.storage.manifest import Key, Manifest, Shard

#: Maximum number of data sets of one experiment; the plan of more would fill the memory.
MAX_DATA_SETS = 1_000_000


@dataclass(frozen=True, eq=False)
class Plan:
    """All data sets and estimates of an experiment."""

    spec: Spec
    data_cells: tuple[DataCell, ...]
    estimators: tuple[EstimatorCell, ...]
    starts: tuple[StartPoint, ...]
    #: Number of data sets of each data cell.
    replicates: tuple[int, ...]
    spec_hash: str
    #: Shard that is computed; None for all data sets.
    shard: Shard | None = None

    @property
    def experiment(self) -> str:
        """Name of the experiment."""
        return self.spec.experiment

    @cached_property
    def monte_carlo(self) -> Mapping[str, Any]:
        """The section on number and seed of data sets; empty if nothing is random."""
        return self.spec.canonical().get("monte_carlo") or {}

    @property
    def runs(self) -> int:
        """Largest number of data sets of any data cell."""
        return max(self.replicates)

    def requested(self, cell: int) -> BoolArray:
        """Return which replicates of a data cell are requested: all, or those of the shard."""
        own, shard, cells = self.replicates[cell], self.shard, len(self.data_cells)
        if shard is None:
            return np.ones(own, dtype=bool)
        return np.array([shard.has(cell, replicate, cells) for replicate in range(own)], dtype=bool)

    @property
    def data_sets(self) -> int:
        """Number of data sets."""
        return int(sum(self.requested(cell).sum() for cell in range(len(self.data_cells))))

    @property
    def estimates_each(self) -> int:
        """Number of estimates per data set."""
        return len(self.keys(0, 0))

    def part(self, shard: Shard) -> Plan:
        """Return the part of the plan for one shard."""
        section = self.spec.monte_carlo
        if section is not None and section.until is not None:
            raise UsageError(
                f"{self.experiment}: monte_carlo.until decides on all data sets together, and a shard has only some "
                f"of them; give their number, for example --runs {section.most}. After the merge, ctid run without "
                "--shard and --runs takes as many of them as the precision needs"
            )
        return dataclasses.replace(self, shard=shard)

    @property
    def files(self) -> list[tuple[str, str]]:
        """Path and SHA-256 of each file used for data sets."""
        sections: list[Any] = [self.spec.data, self.spec.sampling, *self.spec.generators.values()]
        read = [one for one in sections if getattr(one, "sha256", None) is not None and not one.custom]
        return [(joined(self.spec.folder.resolve(), section.file), section.sha256) for section in read]

    def keys(self, cell: int, replicate: int) -> list[Wanted]:
        """Return the requested estimates of a data set."""
        data_hash = self.data_cells[cell].hash
        return [
            (Key(data_hash, replicate, part.hash, start.label), part, start)
            for part in self.estimators
            for start in starts_of(part.estimator.start_from, self.starts)
        ]

    def job(self, cell: int, replicate: int, wanted: BoolArray | None = None) -> Job:
        """Return the job of a data set with the requested estimates; by default all."""
        keys = self.keys(cell, replicate)
        wanted_keys = tuple(keys if wanted is None else itertools.compress(keys, wanted))
        return Job(self.data_cells[cell], replicate, self.monte_carlo.get("seed"), wanted_keys, self.terms)

    @cached_property
    def terms(self) -> tuple[Term, ...] | None:
        """Structure of the submodels into which estimates of one fraction are also decomposed; None for none."""
        return structure(self.data_cells[0].source, [cell.estimator for cell in self.estimators])

    def manifest(self) -> Manifest:
        """Return the plan as plain data."""
        canonical, wanted = dict(self.spec.canonical()), self.keys(0, 0)
        # Limits end estimates; they do not affect other results.
        canonical.pop("limits", None)
        return {
            "experiment": self.experiment,
            "runs": self.runs,
            "seed": self.monte_carlo.get("seed"),
            "spec_hash": self.spec_hash,
            "spec": canonical,
            "success": canonical.get("success"),
            "data_cells": [
                {"hash": cell.hash, "replicates": own, "swept": dict(cell.swept), "content": cell.content}
                for cell, own in zip(self.data_cells, self.replicates, strict=True)
            ],
            "estimators": [
                {
                    "name": cell.name,
                    "kind": cell.kind,
                    "hash": cell.hash,
                    "swept": dict(cell.swept),
                    "content": cell.content,
                    "starts": [start.label for _, other, start in wanted if other is cell],
                }
                for cell in self.estimators
            ],
            "starts": {start.label: start.initial_delay for start in self.starts},
            **({} if self.shard is None else {"shard": [self.shard.number, self.shard.of]}),
        }


def starts_of(kind: str | None, starts: tuple[StartPoint, ...]) -> tuple[StartPoint, ...]:
    """Return the starts used by an estimator that takes starts of a kind."""
    return tuple(start for start in starts if start.of == kind) or (NO_START,)


def structure(source: Source | SignalSource, estimators: Iterable[Any]) -> tuple[Term, ...] | None:
    """Return the submodels of the simulated system by ascending frequency, or those of the first estimator."""
    if isinstance(source, SimulatedSource) and isinstance(source.system, AdditiveModel):
        return source.system.sorted().terms
    found = (getattr(estimator, "terms", None) for estimator in estimators)
    return next((tuple(terms) for terms in found if terms is not None), None)


def build_plan(spec: Spec, runs: int | None = None) -> Plan:
    """Build the plan of an experiment."""
    if runs is not None and runs < 1:
        raise UsageError(f"the number of data sets must be 1 or more, not {runs}")
    count = first = 1
    if spec.data is None and (section := spec.monte_carlo) is not None:
        section = section if runs is None else MonteCarloSection(runs=runs, seed=section.seed)
        spec = replaced(spec, ("monte_carlo",), section)
        count, first = section.most, section.first
    parts = data_parts(spec)
    cells = math.prod(map(len, parts.values()))
    for number, most, what in ((cells, MAX_COMBINATIONS, "data cells"), (cells * count, MAX_DATA_SETS, "data sets")):
        if number > most:
            raise UsageError(f"{spec.experiment}: {number} {what} are too many; at most {most} are allowed")
    cases = [(name, variant) for name, section in spec.estimators.items() for variant in variants(section)]
    names = _column_names({**parts, ("estimator",): [variant for _, variant in cases]})
    estimators = tuple(_estimator_cell(name, variant, names) for name, variant in cases)
    starts = start_points(spec.starts)
    if any(NO_START in starts_of(cell.estimator.start_from, starts) for cell in estimators):
        starts = (*starts, NO_START)
    spec_hash = content_hash(_without_circumstances(spec.canonical()))
    return Plan(spec, tuple(data_cells(spec, parts, names)), estimators, starts, (first,) * cells, spec_hash)


def simulate_dataset(
    experiment: str | os.PathLike[str] | Mapping[str, Any] | Spec,
    key: tuple[int, int],
    *,
    overrides: Sequence[str] = (),
    allow_code: bool = False,
) -> DataSet | SignalDataSet:
    """Simulate one data set of an experiment, identical to that given to its estimators.

    Parameters
    ----------
    experiment : path or mapping
        A specification: the path of a YAML file, or its content.
    key : tuple of int
        Case and replicate, both from 0. The swept values of the data combine to cases, the last of them changing
        fastest, in the order of the sections system, excitation, loop, sampling, noise, signal, disturbance, inputs.
    overrides : sequence of str, default ()
        Values that replace those of the specification, such as ``"noise.snr_db=15"``: another way to choose a case.
    allow_code : bool, default False
        Run the code named by kinds in the specification.

    Returns
    -------
    DataSet or SignalDataSet
        Its ``record`` is given to estimators; its ``true_model`` is the simulated system, if that is one of ctid's.

    Raises
    ------
    SpecError
        If the specification has errors; all of them are listed.
    RefusedError
        If it names code that must not be run.
    UsageError
        If the case or replicate does not exist.
    DataError
        If the data set cannot be simulated.

    Notes
    -----
    A data set is a function of its case, the seed and the replicate. Sampling, input and noise have separate streams of
    random numbers, so that cases which differ in the noise have the same input.

    Examples
    --------
    >>> from ctid_cli import DelayProfile, simulate_dataset
    >>> experiment = {
    ...     "experiment": "first-order",
    ...     "system": {"numerator": [2.0], "denominator": [1.0, 1.0], "delay": 0.3},
    ...     "excitation": {"kind": "prbs", "stages": 7, "clock_period": 0.5},
    ...     "sampling": {"kind": "regular", "interval": 0.1, "samples": 400},
    ...     "noise": {"kind": "white", "snr_db": [10, 30]},
    ...     "estimators": {"search": {"kind": "delay_profile", "poles": 1, "zeros": 0, "delay_bounds": [0, 1]}},
    ...     "monte_carlo": {"runs": 100, "seed": 1},
    ... }
    >>> data = simulate_dataset(experiment, (1, 0))  # the second noise level, the first replicate
    >>> fit = DelayProfile(poles=1, zeros=0, delay_bounds=(0, 1)).fit(data.record)
    >>> abs(fit.model.delay - data.true_model.delay) < 0.02
    True
    """
    if isinstance(experiment, Spec):
        spec = experiment
    else:
        given = experiment if isinstance(experiment, Mapping) else Path(experiment)
        spec = load_spec(given, overrides, allow_code=allow_code)
    cells, (case, replicate) = build_plan(spec).data_cells, key
    most = 1 if spec.data is not None else MAX_DATA_SETS
    for name, number, count in (("case", case, len(cells)), ("replicate", replicate, most)):
        if not 0 <= number < count:
            raise UsageError(f"{spec.experiment}: there is no {name} {number}; they are numbered from 0 to {count - 1}")
    source = cells[case].source
    if isinstance(source, SimulatedSource):
        source.require_stable()
    return source.dataset(replicate)


def data_parts(spec: Spec) -> dict[KeyPath, list[Variant]]:
    """Return the variants of the sections of the data; only those of the loop for a measured record."""
    return {path: variants(section) for path, section in spec.of_data.items()}


def data_cells(
    spec: Spec, parts: Mapping[KeyPath, list[Variant]], names: Mapping[KeyPath, str] | None = None
) -> Iterator[DataCell]:
    """Yield every combination of the variants of the sections; swept fields are named by their columns."""
    names = _column_names(parts) if names is None else names
    seed = None if spec.monte_carlo is None else spec.monte_carlo.seed
    measures = {name: variants(section)[0] for name, section in spec.custom_measures.items()}
    custom = tuple((name, variant.options) for name, variant in measures.items())
    for point in itertools.product(*parts.values()):
        chosen = dict(zip(parts, point, strict=True))
        content = _nested({path: _without_place(variant.values) for path, variant in chosen.items()})
        if spec.signal is not None:
            content |= {"disturbance": content.get("disturbance"), "seed": seed}
            # Measures of an estimate are stored with it, and therefore part of its identity.
            content["measuring"] = dataclasses.asdict(_measuring(spec))
        elif spec.data is not None:
            # The seed affects random starts; the content hash of the record is included.
            content = {"data": _without_place(spec.data.model_dump(mode="json")), **content, "seed": seed}
        else:
            content |= {"noise": content.get("noise"), "seed": seed}
            system = chosen.get(("system",))
            if system is not None and is_custom(system.options):
                content["system"]["truth"] = truth_of(system)
            # Measures of an estimate are stored with it, and therefore part of its identity.
            content |= {"fresh_fit": True} if "fresh_fit" in (spec.measures or ()) else {}
        if measures:
            content["custom_measures"] = {
                name: {**variant.values, "unit": variant.options.unit} for name, variant in measures.items()
            }
        swept = {names[*place, *path]: value for place, v in chosen.items() for path, value in v.swept.items()}
        source = source_of(spec, _nested({path: variant.options for path, variant in chosen.items()}))
        yield DataCell(content, content_hash(content), swept, source, custom)


def _nested(values: Mapping[KeyPath, Any]) -> dict[str, Any]:
    """Return values by key path as nested mappings."""
    found: dict[str, Any] = {}
    for path, value in values.items():
        inner = found
        for key in path[:-1]:
            inner = inner.setdefault(str(key), {})
        inner[str(path[-1])] = value
    return found


def source_of(spec: Spec, options: Mapping[str, Any]) -> Source | SignalSource:
    """Return the source of the data sets for one combination of section options."""
    # Absolute, because workers may have another working directory.
    folder = spec.folder.resolve()
    # The seed has no effect if nothing is random.
    seed = 0 if spec.monte_carlo is None else spec.monte_carlo.seed
    if spec.signal is not None:
        given = options["signal"], options.get("disturbance"), options["sampling"]
        return SignalSource(*given, seed, _measuring(spec))
    if spec.data is not None:
        source: Source = dataclasses.replace(located(spec.data.options(), folder), loop=options.get("loop"))
        return source
    sampling, loop = located(options["sampling"], folder), options.get("loop")
    if loop is not None:
        loop = dataclasses.replace(loop, reference=located(loop.reference, folder))
        loop = loop.at(sampling.interval) if hasattr(sampling, "interval") else loop
    fresh = "fresh_fit" in (spec.measures or ())
    system: Any = options.get("system")
    excitation: Any = located(options.get("excitation"), folder)
    if inputs := options.get("inputs"):
        system = MultiInputModel.of({name: one["system"] for name, one in inputs.items()})
        excitation = {name: located(one["excitation"], folder) for name, one in inputs.items()}
    return SimulatedSource(system, excitation, sampling, options.get("noise"), seed, loop, fresh)


def _measuring(spec: Spec) -> Measuring:
    """Return what is measured of the frequencies of a signal."""
    if spec.success is None:
        return Measuring()
    window = spec.success.window
    return Measuring(spec.success.band, None if window is None else (window[0], window[1]))


def _estimator_cell(name: str, variant: Variant, names: Mapping[KeyPath, str]) -> EstimatorCell:
    swept = {names["estimator", *path]: value for path, value in variant.swept.items()}
    content = variant.values
    return EstimatorCell(name, content["kind"], estimation(variant), content, content_hash(content), swept)


def estimation(variant: Variant) -> Any:
    """Return the estimator of a variant, including its preprocessing of the record."""
    if isinstance(variant.options, FrequencyEstimator):
        return FrequencyEstimation(variant.options)
    return CustomEstimation(variant.options) if is_custom(variant.options) else variant.options


def _column_names(parts: Mapping[KeyPath, Iterable[Variant]]) -> dict[KeyPath, str]:
    """Return the column name of every swept field: its last key, or more of its path if that name is taken."""
    distinct = list(dict.fromkeys((*place, *path) for place, cases in parts.items() for v in cases for path in v.swept))
    last, reserved = [path[-1] for path in distinct], reserved_names()
    return {
        path: ".".join(map(str, path)) if path[-1] in reserved or last.count(path[-1]) > 1 else str(path[-1])
        for path in distinct
    }


def _without_place(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return a section without its file name; the content hash identifies the file."""
    return {
        key: _without_place(value) if isinstance(value, dict) else value
        for key, value in content.items()
        if not (key == "file" and "sha256" in content)
    }


def _without_circumstances(canonical: Mapping[str, Any]) -> dict[str, Any]:
    content = {key: _without_place(value) if isinstance(value, dict) else value for key, value in canonical.items()}
    for name in ("measures", "limits"):  # these do not affect what is computed
        content.pop(name, None)
    if content.get("inputs") is None:  # keeps hashes of specifications from before several inputs existed
        content.pop("inputs", None)
    if content.get("monte_carlo") is not None:
        content["monte_carlo"] = {"seed": content["monte_carlo"]["seed"]}
    return content


def current_origin(plan: Plan) -> Origin:
    """Return the origin that estimates of the plan would have now."""
    return origin_of(*computing_parts(plan))


def current_version(plan: Plan) -> str:
    """Return the code version of the estimates, independent of the processor."""
    return current_origin(plan).code_version


def computing_parts(plan: Plan) -> list[Any]:
    """Return the computing parts of a plan: the source of its data sets, its estimators and custom measures."""
    # All data cells have the same classes; only field values differ.
    first = plan.data_cells[0]
    return [first.source, first.measures, *(cell.estimator for cell in plan.estimators)]
