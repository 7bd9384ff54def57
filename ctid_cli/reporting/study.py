"""Studies that are shipped with the program: one folder each, with its ``study.yaml``."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, Literal

import yaml

from ctid_cli.custom_code import DATA
from ctid_cli.errors import UsageError
from ctid_cli.running.plan import Plan, build_plan
from ctid_cli.specification.load import load_spec

if TYPE_CHECKING:
    import pandas as pd

InitialDelay = float | Literal["random"] | None

#: The study of table numbers without a name.
DEFAULT_STUDY = "useful-redundancy"
#: Package name of the modules of studies, independent of the working directory.
_PACKAGE = "ctid_experiments"


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
        """Names of its experiments."""
        return list(self.published["experiment"].unique())


@dataclass(frozen=True, eq=False)
class Study:
    """One study; its fields are the keys of ``study.yaml``."""

    study: str
    title: str
    #: For every experiment ``config``, its specification relative to ``configs``, and ``sampling`` if tables show it.
    experiments: Mapping[str, Mapping[str, str]]
    #: Experiments of each figure, by the last parts of their names; none if it is computed.
    figures: Mapping[str, Sequence[str]]
    #: Function in ``tables.py`` that writes each published text.
    texts: Mapping[str, str]
    #: Published numbers by file: a function in ``tables.py`` that makes ``rows`` of the results of one experiment, its
    #: ``columns`` if not all keys, and its ``experiments`` if not all.
    numbers: Mapping[str, Mapping[str, Any]]
    #: Experiments of each function in ``claims.py``, one call for each list.
    claims: Mapping[str, Sequence[Sequence[str]]]
    #: Settings with which a small reproduction computes the first data set of an experiment.
    first: Mapping[str, Sequence[str]]
    #: ``authors``, ``title`` and ``identifier`` of the reproduced article.
    source: Mapping[str, str] = field(default_factory=dict)
    #: What the percentages of its tables count, and the number of data sets of the published ones.
    success: str = ""
    published_data_sets: int = 0
    #: Description of each method.
    methods: Mapping[str, str] = field(default_factory=dict)
    #: Key path in a specification of every setting that is a column of the tables.
    fields: Mapping[str, str] = field(default_factory=dict)
    printed_tables: Mapping[int, Mapping[str, Any]] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Name in commands."""
        return self.study

    @property
    def citation(self) -> str:
        """Reproduced article; empty if there is none."""
        return "{authors}: {title} ({identifier})".format(**self.source) if self.source else ""

    @property
    def folder(self) -> Path:
        """Folder of its files."""
        return data_folder("experiments") / self.name.replace("-", "_")

    @property
    def published(self) -> Path:
        """Folder in which it is published, also in an installed package."""
        return data_folder("results/published") / self.folder.name

    @property
    def configs(self) -> dict[str, str]:
        """Specification of every experiment, relative to ``configs``."""
        return {name: item["config"] for name, item in self.experiments.items()}

    def experiment(self, short: str) -> str:
        """Return an experiment by the last part of its name."""
        return f"{self.name}/{short}"

    def config(self, short: str) -> Path:
        """Return the specification of one of its experiments."""
        return data_folder("configs") / self.configs[self.experiment(short)]

    def only(self, names: Collection[str]) -> Study:
        """Return the study with some of its experiments."""
        return replace(self, experiments={name: item for name, item in self.experiments.items() if name in names})

    def plan(self, short: str, overrides: Sequence[str] = ()) -> Plan:
        """Return the plan of one of its experiments."""
        return build_plan(load_spec(self.config(short), overrides))

    def module(self, name: str) -> Any:
        """Return one of its modules, always from the folder that is shipped with the program."""
        if _PACKAGE not in sys.modules:
            package = ModuleType(_PACKAGE)
            package.__path__ = [str(data_folder("experiments"))]
            sys.modules[_PACKAGE] = package
        return importlib.import_module(f"{_PACKAGE}.{self.folder.name}.{name}")

    @cached_property
    def tables(self) -> dict[int, StudyTable]:
        """Its published tables."""
        return {number: self._table(number, table) for number, table in self.printed_tables.items()}

    def _table(self, number: int, content: Mapping[str, Any]) -> StudyTable:
        import pandas as pd

        delays = tuple(delay if delay == "random" else float(delay) for delay in content["initial_delays"])
        published = [
            {
                "experiment": row["experiment"],
                **{field: float(row[field]) for field in self.fields},
                "method": method,
                "initial_delay": delay,
                "published_percent": float(value),
            }
            for row in content["rows"]
            for method, values in row["published"].items()
            for delay, value in zip(delays, values, strict=True)
        ]
        return StudyTable(number, content["title"], delays, pd.DataFrame(published, dtype=object))


def data_folder(name: str) -> Path:
    """Return a folder that is shipped with the program: ``experiments``, ``configs`` or ``results/published``."""
    return DATA / name


@cache
def all_studies() -> dict[str, Study]:
    """Return every study by its name."""
    files = sorted(data_folder("experiments").glob("*/study.yaml"))
    # The C loader of PyYAML if available: every run reads the studies for its tables.
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    studies = [Study(**yaml.load(file.read_text(encoding="utf-8"), loader)) for file in files]
    return {study.name: study for study in studies}


def find_study(name: str = DEFAULT_STUDY) -> Study:
    """Return a study by its name."""
    studies = all_studies()
    if name not in studies:
        raise UsageError(f"there is no study named {name!r}; there are {', '.join(studies)}")
    return studies[name]


def find_studies(names: Sequence[str]) -> list[Study]:
    """Return studies by their names, by default all; by names of experiments the studies with these only."""
    chosen: dict[str, list[str]] = {}
    for name in names or all_studies():
        study = find_study(name.partition("/")[0])
        if name not in (study.name, *study.experiments):
            has = ", ".join(study.experiments)
            raise UsageError(f"the study {study.name} has no experiment named {name!r}; it has {has}")
        chosen.setdefault(study.name, []).extend(study.experiments if name == study.name else [name])
    return [find_study(study).only(experiments) for study, experiments in chosen.items()]


def last_part(experiment: str) -> str:
    """Return an experiment's name without that of its study."""
    return experiment.rpartition("/")[2]


def tables_of(experiment: str) -> list[int]:
    """Return the numbers of the default study's tables that an experiment fills."""
    tables = find_study().printed_tables
    return [number for number, table in tables.items() if experiment in {row["experiment"] for row in table["rows"]}]
