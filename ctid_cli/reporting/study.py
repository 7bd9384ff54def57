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
    """One experiment of a study."""

    config: str
    sampling: str


@dataclass(frozen=True)
class StudyRow:
    """One row of a published table."""

    experiment: str
    settings: Mapping[str, float]
    #: Published percentages of each method, one per initial delay of the table [%].
    published: Mapping[str, tuple[float, ...]]


@dataclass(frozen=True)
class StudyTable:
    """One published table."""

    number: int
    title: str
    #: Initial delays [s] of its columns, or ``("random",)``.
    initial_delays: tuple[InitialDelay, ...]
    rows: tuple[StudyRow, ...]


@dataclass(frozen=True)
class Study:
    """A published study."""

    name: str
    source: str
    success: str
    published_data_sets: int
    methods: Mapping[str, str]
    must_reach: tuple[str, ...]
    fields: Mapping[str, str]
    experiments: Mapping[str, StudyExperiment]
    tables: Mapping[int, StudyTable]


def data_folder(name: str) -> Path:
    """A folder that is shipped with the program: ``experiments`` or ``configs``."""
    package = Path(__file__).resolve().parents[1]
    packaged = package / f"_{name}"
    return packaged if packaged.is_dir() else package.parent / name


def load_study(name: str = DEFAULT_STUDY) -> Study:
    """Read a study that is shipped with the program."""
    for file in sorted(data_folder("experiments").glob("*/study.yaml")):
        content = yaml.safe_load(file.read_text(encoding="utf-8"))
        if content["study"] == name:
            source, fields = content["source"], content["fields"]
            return Study(
                name=name,
                source=f"{source['authors']}: {source['title']} ({source['identifier']})",
                success=content["success"],
                published_data_sets=content["published_data_sets"],
                methods=content["methods"],
                must_reach=tuple(content["must_reach"]),
                fields=fields,
                experiments={key: StudyExperiment(**item) for key, item in content["experiments"].items()},
                tables={number: _table(number, table, fields) for number, table in content["tables"].items()},
            )
    raise UsageError(f"there is no study named {name!r}")


def tables_of(experiment: str) -> list[int]:
    """Numbers of the default study's tables that an experiment fills."""
    return [n for n, table in load_study().tables.items() if experiment in (row.experiment for row in table.rows)]


def _table(number: int, content: dict[str, Any], fields: Mapping[str, str]) -> StudyTable:
    delays = tuple(delay if delay == "random" else float(delay) for delay in content["initial_delays"])
    rows = []
    for row in content["rows"]:
        published = {method: tuple(map(float, values)) for method, values in row["published"].items()}
        if any(len(values) != len(delays) for values in published.values()):
            raise ValueError(f"table {number}: every published row needs {len(delays)} values")
        rows.append(StudyRow(row["experiment"], {field: float(row[field]) for field in fields}, published))
    return StudyTable(number, content["title"], delays, tuple(rows))
