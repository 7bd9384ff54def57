"""The studies that are shipped with the program: one folder each, with what belongs to it in ``study.yaml``."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

from ctid_cli.errors import UsageError
from ctid_cli.reporting.results import Results, find_results
from ctid_cli.reporting.study import data_folder, study_contents
from ctid_cli.running.cells import Plan
from ctid_cli.running.plan import build_plan
from ctid_cli.specification.load import load_spec

#: Name under which modules of studies are imported, whatever the working directory holds.
_PACKAGE = "ctid_experiments"


@dataclass(frozen=True, eq=False)
class StudyFolder:
    """One study, as its ``study.yaml`` describes it."""

    name: str
    title: str
    #: Specification of every experiment, relative to ``configs``.
    configs: Mapping[str, str]
    #: Experiments that each figure is drawn from, by the last parts of their names; none where it is computed.
    figures: Mapping[str, Sequence[str]]
    #: Function in ``tables.py`` that writes each published text.
    texts: Mapping[str, str]
    #: Published numbers by file: a function in ``tables.py`` that makes ``rows`` of the results of one experiment, its
    #: ``columns`` if not all keys, and its ``experiments`` if not all.
    numbers: Mapping[str, Mapping[str, Any]]
    #: Experiments that each function in ``claims.py`` is asked about, one call for each list.
    claims: Mapping[str, Sequence[Sequence[str]]]
    #: Settings with which the first data set of an experiment is computed again by a small reproduction.
    first: Mapping[str, Sequence[str]]

    @property
    def folder(self) -> Path:
        """Where its files lie."""
        return data_folder("experiments") / self.name.replace("-", "_")

    def experiment(self, short: str) -> str:
        """An experiment by the last part of its name."""
        return f"{self.name}/{short}"

    def module(self, name: str) -> Any:
        """One of its modules, always from the folder that is shipped with the program."""
        if _PACKAGE not in sys.modules:
            package = ModuleType(_PACKAGE)
            package.__path__ = [str(data_folder("experiments"))]
            sys.modules[_PACKAGE] = package
        return importlib.import_module(f"{_PACKAGE}.{self.folder.name}.{name}")

    def plan(self, short: str, overrides: Sequence[str] = ()) -> Plan:
        """Plan of one of its experiments."""
        return build_plan(load_spec(self.config(short), overrides))

    def config(self, short: str) -> Path:
        """Specification of one of its experiments."""
        file = data_folder("configs") / self.configs[self.experiment(short)]
        if not file.is_file():
            missing = f"the specification {file.parent.name}/{file.name} is not in an installed package"
            raise UsageError(f"{missing}; run the command in a checkout of the repository")
        return file


@dataclass(frozen=True, eq=False)
class StudyResults:
    """What was found in the experiments of a study that were run."""

    study: StudyFolder
    out: Path
    experiments: Mapping[str, Results] = field(default_factory=dict)

    def __contains__(self, short: str) -> bool:
        return short in self.experiments

    def __getitem__(self, short: str) -> Results:
        return self.experiments[short]


def last_part(experiment: str) -> str:
    """An experiment's name without that of its study."""
    return experiment.rpartition("/")[2]


def read_study(study: StudyFolder, out: Path) -> StudyResults:
    """Results of a study, by the last parts of its experiments' names."""
    found = {last_part(name): find_results(out, name) for name in study.configs}
    return StudyResults(study, out, {name: results for name, results in found.items() if results is not None})


@cache
def all_studies() -> dict[str, StudyFolder]:
    """Every study by its name."""
    return {name: _study(content) for name, content in study_contents().items()}


def find_study(name: str) -> StudyFolder:
    """A study by its name."""
    studies = all_studies()
    if name not in studies:
        raise UsageError(f"there is no study named {name!r}; there are {', '.join(studies)}")
    return studies[name]


def _study(content: Mapping[str, Any]) -> StudyFolder:
    return StudyFolder(
        name=content["study"],
        title=content["title"],
        configs={name: item["config"] for name, item in content["experiments"].items()},
        figures={str(name): parts for name, parts in content["figures"].items()},
        **{name: content[name] for name in ("texts", "numbers", "claims", "first")},
    )
