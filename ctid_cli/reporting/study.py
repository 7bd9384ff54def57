"""Published studies: their tables, and which experiments fill them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import yaml

from ctid_cli.errors import UsageError

InitialDelay = float | Literal["random"] | None

#: The study that a bare table number means.
DEFAULT_STUDY = "useful-redundancy"


@dataclass(frozen=True)
class StudyExperiment:
    """One experiment of a study.

    Parameters
    ----------
    name : str
        Name of the experiment, as in its specification.
    config : str
        Its specification, relative to the folder of specifications.
    sampling : str
        ``regular`` or ``irregular``.
    """

    name: str
    config: str
    sampling: str


@dataclass(frozen=True)
class StudyRow:
    """One row of a published table.

    Parameters
    ----------
    experiment : str
        Experiment that reproduces the row.
    settings : mapping of str to float
        Values of the study's fields in this row, for example ``{"snr_db": 5}``.
    published : mapping of str to tuple of float
        Published percentages of each method, one per initial delay of the table [%].
    """

    experiment: str
    settings: Mapping[str, float]
    published: Mapping[str, tuple[float, ...]]


@dataclass(frozen=True)
class StudyTable:
    """One published table.

    Parameters
    ----------
    number : int
        Number of the table in the paper.
    title : str
        What it shows.
    initial_delays : tuple
        Initial delays [s] of its columns, or ``("random",)``.
    rows : tuple of StudyRow
        Its rows.
    """

    number: int
    title: str
    initial_delays: tuple[InitialDelay, ...]
    rows: tuple[StudyRow, ...]


@dataclass(frozen=True)
class Study:
    """A published study.

    Parameters
    ----------
    name : str
        Name used on the command line.
    title : str
        What it is about.
    source : str
        Authors, title and identifier of the publication.
    success : str
        What its percentages count.
    published_data_sets : int
        Data sets behind each published percentage.
    methods : mapping of str to str
        Estimator names of the tables and what they are, published or not.
    must_reach : tuple of str
        Methods whose published percentages ours must not fall below.
    fields : mapping of str to str
        Table columns that are settings, with their key in the specification.
    experiments : mapping of str to StudyExperiment
        Its experiments by name.
    tables : mapping of int to StudyTable
        Its tables by number.
    """

    name: str
    title: str
    source: str
    success: str
    published_data_sets: int
    methods: Mapping[str, str]
    must_reach: tuple[str, ...]
    fields: Mapping[str, str]
    experiments: Mapping[str, StudyExperiment]
    tables: Mapping[int, StudyTable]


def data_folder(name: str) -> Path:
    """A folder that is shipped with the program: ``experiments`` or ``configs``.

    Parameters
    ----------
    name : str
        Name of the folder.

    Returns
    -------
    Path
        Inside an installed package ``ctid_cli/_<name>``; in a checkout ``<name>`` beside the package.
    """
    package = Path(__file__).resolve().parents[1]
    packaged = package / f"_{name}"
    return packaged if packaged.is_dir() else package.parent / name


def load_study(name: str = DEFAULT_STUDY) -> Study:
    """Read a study that is shipped with the program.

    Parameters
    ----------
    name : str, default "useful-redundancy"
        Name of the study.

    Returns
    -------
    Study
        The study.

    Raises
    ------
    UsageError
        If there is no such study.

    Examples
    --------
    >>> study = load_study()
    >>> study.tables[2].rows[0].published["existing"]
    (90.0,)
    """
    for file in sorted(data_folder("experiments").glob("*/study.yaml")):
        content = yaml.safe_load(file.read_text(encoding="utf-8"))
        if content["study"] == name:
            return _study(content)
    raise UsageError(f"there is no study named {name!r}")


def tables_of(experiment: str) -> list[int]:
    """Numbers of the default study's tables that an experiment fills.

    Parameters
    ----------
    experiment : str
        Name of the experiment.

    Returns
    -------
    list of int
        Empty for an experiment of no study.

    Examples
    --------
    >>> tables_of("useful-redundancy/case2-regular"), tables_of("quickstart")
    ([3, 4], [])
    """
    study = load_study()
    return [n for n, table in study.tables.items() if any(row.experiment == experiment for row in table.rows)]


def _study(content: dict[str, Any]) -> Study:
    source = content["source"]
    tables = {number: _table(number, table, content["fields"]) for number, table in content["tables"].items()}
    return Study(
        name=content["study"],
        title=content["title"],
        source=f"{source['authors']}: {source['title']} ({source['identifier']})",
        success=content["success"],
        published_data_sets=content["published_data_sets"],
        methods=content["methods"],
        must_reach=tuple(content["must_reach"]),
        fields=content["fields"],
        experiments={name: StudyExperiment(name, **item) for name, item in content["experiments"].items()},
        tables=tables,
    )


def _table(number: int, content: dict[str, Any], fields: Mapping[str, str]) -> StudyTable:
    delays = tuple(delay if delay == "random" else float(delay) for delay in content["initial_delays"])
    rows = []
    for row in content["rows"]:
        published = {method: tuple(float(v) for v in values) for method, values in row["published"].items()}
        if any(len(values) != len(delays) for values in published.values()):
            raise ValueError(f"table {number}: every published row needs {len(delays)} values")
        rows.append(StudyRow(row["experiment"], {field: float(row[field]) for field in fields}, published))
    return StudyTable(number, content["title"], delays, tuple(rows))
