"""From a specification to the data sets and estimates that it asks for."""

import dataclasses
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ctid_cli.canonical import content_hash
from ctid_cli.errors import UsageError
from ctid_cli.kinds import KINDS
from ctid_cli.running.cells import DataCell, DataCells, EstimatorCell, Plan, starts_of
from ctid_cli.simulation.components import CustomEstimation, is_custom
from ctid_cli.simulation.dataset import NO_START, DataSet, Source, located
from ctid_cli.simulation.frequency_measures import FrequencyEstimation, Measuring, SignalDataSet, SignalSource
from ctid_cli.specification.load import load_spec
from ctid_cli.specification.sections import MAX_COMBINATIONS, Variant, replaced, variants
from ctid_cli.specification.spec import OF_DATA, MonteCarloSection, Spec
from ctid_cli.specification.system_sections import start_points
from ctid_cli.specification.yaml_source import KeyPath
from ctid_cli.storage.columns import reserved_names

#: Data sets that one experiment may ask for; beyond this its plan alone would fill the memory.
MAX_DATA_SETS = 1_000_000


def build_plan(spec: Spec, runs: int | None = None) -> Plan:
    """Plan an experiment."""
    if runs is not None and runs < 1:
        raise UsageError(f"the number of data sets must be 1 or more, not {runs}")
    count = first = 1
    if spec.data is None and (section := spec.monte_carlo) is not None:
        section = section if runs is None else MonteCarloSection(runs=runs, seed=section.seed)
        spec = replaced(spec, ("monte_carlo",), section)
        count, first = section.most, section.first
    # Of a measured record only those of its loop.
    parts = {name: found for name in OF_DATA if (found := variants(getattr(spec, name)))}
    cells = math.prod(map(len, parts.values()))
    for number, most, what in ((cells, MAX_COMBINATIONS, "data cells"), (cells * count, MAX_DATA_SETS, "data sets")):
        if number > most:
            raise UsageError(f"{spec.experiment}: {number} {what} are too many; at most {most} are allowed")
    cases = [(name, variant) for name, section in spec.estimators.items() for variant in variants(section)]
    names = _column_names(parts | {"estimator": [variant for _, variant in cases]})
    estimators = tuple(_estimator_cell(name, variant, names) for name, variant in cases)
    starts = start_points(spec.starts)
    if any(NO_START in starts_of(cell.estimator.start_from, starts) for cell in estimators):
        starts = (*starts, NO_START)
    spec_hash = content_hash(_without_circumstances(spec.canonical()))
    return Plan(spec, _data_cells(spec, parts, names), estimators, starts, (first,) * cells, spec_hash)


def simulate_dataset(
    experiment: str | os.PathLike[str] | Mapping[str, Any] | Spec,
    key: tuple[int, int],
    *,
    overrides: Sequence[str] = (),
    allow_code: bool = False,
) -> DataSet | SignalDataSet:
    """Make one data set of an experiment: the very one that its estimators are given.

    Parameters
    ----------
    experiment : path or mapping
        A specification: the path of a YAML file, or its content.
    key : tuple of int
        Case and replicate, both from 0. The swept values of the data combine to cases, the last of them changing
        fastest, in the order of the sections system, excitation, loop, sampling, noise, recorder, signal, disturbance.
    overrides : sequence of str, default ()
        Values in the place of the specification's own, such as ``"noise.snr_db=15"``: another way to choose a case.
    allow_code : bool, default False
        Run the code that the specification names as a kind.

    Returns
    -------
    DataSet or SignalDataSet
        Its ``record`` is what estimators are given, its ``true_model`` the simulated system, if that is one of ctid's.

    Raises
    ------
    SpecError
        If the specification has mistakes; all of them are named.
    RefusedError
        If it names code that may not be run.
    UsageError
        If there is no such case or replicate.
    DataError
        If the data set cannot be made.

    Notes
    -----
    A data set is a function of its case, the seed and the replicate. Random numbers of the sampling, the input, the
    noise and the recorder come from streams of their own, so that cases which differ in the noise have the same input.

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
    found: DataSet | SignalDataSet = cells[case].dataset(replicate)
    return found


def _data_cells(spec: Spec, parts: Mapping[str, list[Variant]], names: Mapping[KeyPath, str]) -> DataCells:
    seed = None if spec.monte_carlo is None else spec.monte_carlo.seed
    # Absolute, because worker processes may have been started in another working directory.
    folder = spec.folder.resolve()
    ways = [list(found) for found in parts.values()]

    def make(number: int) -> DataCell:
        point: list[Variant] = []
        for found in reversed(ways):
            number, k = divmod(number, len(found))
            point.insert(0, found[k])
        chosen = dict(zip(parts, point, strict=True))
        options = {name: variant.options for name, variant in chosen.items()}
        content: dict[str, Any] = {name: _without_place(variant.values) for name, variant in chosen.items()}
        loop = options.get("loop")
        source: Source | SignalSource
        if spec.signal is not None:
            # What is measured of an estimate is stored with it, so that it belongs to its identity.
            measuring = _measuring(spec)
            content |= {"disturbance": content.get("disturbance"), "seed": seed}
            content["measuring"] = dataclasses.asdict(measuring)
            disturbance = options.get("disturbance")
            source = SignalSource(options["signal"], disturbance, options["sampling"], seed or 0, measuring)
        elif spec.data is not None:
            # The seed decides where random starts lie; the record itself is in the content as a hash.
            content = {"data": _without_place(spec.data.model_dump(mode="json")), **content, "seed": seed}
            source = dataclasses.replace(located(spec.data.options(), folder), loop=loop)
        else:
            content |= {"noise": content.get("noise"), "seed": seed}
            if is_custom(options["system"]):
                truth, system = content["system"]["truth"], content["system"]
                # The name of an option stands for its value.
                system["truth"] = {
                    name: system[value] if isinstance(value, str) else value for name, value in truth.items()
                }
            # What is measured of an estimate is stored with it, so that it belongs to its identity.
            content |= {"fresh_fit": True} if "fresh_fit" in (spec.measures or ()) else {}
            source = spec.simulated_source(options, folder)
        swept = {names[name, *path]: value for name, v in chosen.items() for path, value in v.swept.items()}
        return DataCell(content, content_hash(content), swept, source)

    return DataCells(math.prod(map(len, ways)), make)


def _measuring(spec: Spec) -> Measuring:
    """What is measured of the frequencies of a signal."""
    if spec.success is None:
        return Measuring()
    window = spec.success.window
    return Measuring(spec.success.band, None if window is None else (window[0], window[1]))


def _estimator_cell(name: str, variant: Variant, names: Mapping[KeyPath, str]) -> EstimatorCell:
    swept = {names["estimator", *path]: value for path, value in variant.swept.items()}
    content = variant.values
    estimator = variant.options
    if is_custom(estimator):
        estimator = CustomEstimation(estimator)
    elif content["kind"] in KINDS["frequency_estimator"]:
        estimator = FrequencyEstimation(estimator)
    return EstimatorCell(name, content["kind"], estimator, content, content_hash(content), swept)


def _column_names(parts: Mapping[str, Iterable[Variant]]) -> dict[KeyPath, str]:
    """Name of the column of every swept field: its last word, or more of its path where that is taken."""
    distinct = list(dict.fromkeys((name, *path) for name, cases in parts.items() for v in cases for path in v.swept))
    last, reserved = [path[-1] for path in distinct], reserved_names()
    return {
        path: ".".join(map(str, path)) if path[-1] in reserved or last.count(path[-1]) > 1 else str(path[-1])
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
    for name in ("measures", "limits"):  # say what is shown, and what may not be exceeded, not what is computed
        content.pop(name, None)
    if content.get("monte_carlo") is not None:
        content["monte_carlo"] = {"seed": content["monte_carlo"]["seed"]}
    return content
