"""Published studies: their tables, and which experiments fill them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import yaml

from ctid_cli.custom_code import DATA

if TYPE_CHECKING:
    import pandas as pd

InitialDelay = float | Literal["random"] | None

#: The study that a bare table number means.
DEFAULT_STUDY = "useful-redundancy"


@dataclass(frozen=True, eq=False)
class StudyTable:
    """One published table."""

    number: int
    title: str
    #: Initial delays [s] of its columns, or ``("random",)``.
    initial_delays: tuple[InitialDelay, ...]
    #: Published cells: ``experiment``, the fields of the study, ``method``, ``initial_delay``, ``published_percent``.
    published: pd.DataFrame

    @property
    def experiments(self) -> list[str]:
        """Names of the experiments that fill it."""
        return list(self.published["experiment"].unique())


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
    #: ``config`` and ``sampling`` of every experiment.
    experiments: Mapping[str, Mapping[str, str]]
    tables: Mapping[int, StudyTable]


def data_folder(name: str) -> Path:
    """Return a folder that is shipped with the program: ``experiments``, ``configs`` or ``results/published``."""
    return DATA / name


@cache
def study_contents() -> dict[str, dict[str, Any]]:
    """What ``study.yaml`` says of every study that is shipped with the program, by its name."""
    files = sorted(data_folder("experiments").glob("*/study.yaml"))
    # Written in C where PyYAML was built with it: every run looks here for its tables.
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    contents = [yaml.load(file.read_text(encoding="utf-8"), loader) for file in files]
    return {content["study"]: content for content in contents}


def load_study() -> Study:
    """The study whose tables are published."""
    content = study_contents()[DEFAULT_STUDY]
    source = content["source"]
    return Study(
        name=DEFAULT_STUDY,
        source=f"{source['authors']}: {source['title']} ({source['identifier']})",
        must_reach=tuple(content["must_reach"]),
        tables={number: _table(number, table, content["fields"]) for number, table in content["tables"].items()},
        **{name: content[name] for name in ("success", "published_data_sets", "methods", "fields", "experiments")},
    )


def tables_of(experiment: str) -> list[int]:
    """Numbers of the default study's tables that an experiment fills."""
    tables = study_contents()[DEFAULT_STUDY]["tables"]
    return [number for number, table in tables.items() if experiment in {row["experiment"] for row in table["rows"]}]


def _table(number: int, content: dict[str, Any], fields: Mapping[str, str]) -> StudyTable:
    import pandas as pd

    delays = tuple(delay if delay == "random" else float(delay) for delay in content["initial_delays"])
    published = [
        {
            "experiment": row["experiment"],
            **{field: float(row[field]) for field in fields},
            "method": method,
            "initial_delay": delay,
            "published_percent": float(value),
        }
        for row in content["rows"]
        for method, values in row["published"].items()
        for delay, value in zip(delays, values, strict=True)
    ]
    return StudyTable(number, content["title"], delays, pd.DataFrame(published, dtype=object))
