"""The studies that are shipped with the program, one folder each with its ``study.yaml``, and their figures by name."""

import importlib
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

from ctid_cli.errors import UsageError
from ctid_cli.reporting.document import Result, Section
from ctid_cli.reporting.results import Results, experiments_in, find_results, out_option, read_results
from ctid_cli.reporting.study import DEFAULT_STUDY, data_folder, study_contents
from ctid_cli.running.plan import Plan, build_plan
from ctid_cli.specification.load import load_spec
from ctid_cli.text import did_you_mean

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
        return data_folder("configs") / self.configs[self.experiment(short)]


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


def published_folder(study: StudyFolder) -> Path:
    """Return the folder that a study is published in, also in an installed package."""
    return data_folder("results/published") / study.folder.name


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


@dataclass(frozen=True, eq=False)
class StudyList(Result):
    """The studies with their experiments."""

    studies: Sequence[StudyFolder]

    def content(self) -> list[dict[str, Any]]:
        """Return the studies for JSON."""
        return [{"study": each.name, "title": each.title, "experiments": dict(each.configs)} for each in self.studies]

    def sections(self) -> list[Section]:
        """Return a list of experiments for each study."""
        import pandas as pd

        return [
            Section(
                each.name,
                [f"{each.title}. Specifications are in configs."],
                frame=pd.DataFrame(each.configs.items(), columns=["experiment", "specification"]),
            )
            for each in self.studies
        ]


@dataclass(frozen=True)
class StudyFigure:
    """A figure that can be drawn: a function ``figure_<number>`` of its study."""

    study: StudyFolder
    number: str

    @property
    def place(self) -> Path:
        """Its file, relative to the results folder."""
        return Path(f"{self.study.folder.name}_figures") / f"figure_{self.number}.svg"

    @property
    def experiments(self) -> list[str]:
        """Names of the experiments whose results it shows."""
        return [self.study.experiment(short) for short in self.study.figures[self.number]]

    @property
    def caption(self) -> str:
        """What it shows."""
        return (self._draw.__doc__ or "").partition("\n")[0].rstrip(".")

    @property
    def _draw(self) -> Callable[..., bytes]:
        found: Callable[..., bytes] = getattr(self.study.module("figures"), f"figure_{self.number}")
        return found

    def svg(self, out: Path) -> bytes:
        """Draw it."""
        require_results([self], out)
        return bytes(self._draw(*(read_results(out, name) for name in self.experiments)))


def sorted_names(names: Sequence[str], out: Path) -> tuple[list[str], list[str]]:
    """Names of experiments with results, and all others: those of figures come first where both have a name."""
    taken, known = set(_figure_names()), experiments_in(out)
    own = [name for name in names if name in known and name not in taken]
    return list(dict.fromkeys(own)), [name for name in names if name not in own]


def _figure_names() -> list[str]:
    """Everything that names published figures."""
    studies = [study for study in all_studies().values() if study.figures]
    names = [*find_study(DEFAULT_STUDY).figures]
    return names + [entry for s in studies for entry in (s.name, *(f"{s.name}/{k}" for k in s.figures))]


def find_figures(names: Sequence[str], out: Path | None = None) -> list[StudyFigure]:
    """The figures that were asked for."""
    studies = {name: study for name, study in all_studies().items() if study.figures}
    found: list[StudyFigure] = []
    for name in names or [DEFAULT_STUDY]:
        place, _, number = name.rpartition("/")
        place = place or DEFAULT_STUDY
        if name in studies:
            found += [StudyFigure(studies[name], number) for number in studies[name].figures]
        elif place in studies and number in studies[place].figures:
            found.append(StudyFigure(studies[place], number))
        elif place in studies and number.isdigit():
            raise UsageError(f"{place} has no figure {number}; it has {', '.join(studies[place].figures)}")
        else:
            own = [] if out is None else experiments_in(out)
            known = [*_figure_names(), *own]
            hint = did_you_mean(name, known) or "."
            wrong = f"{name!r} is neither a figure nor a study with figures"
            wrong += f", nor an experiment with results in the folder {out}" if out else ""
            raise UsageError(f"{wrong}{hint} Known: {', '.join(known)}")
    return list(dict.fromkeys(found))


def require_results(figures: Iterable[StudyFigure], out: Path) -> None:
    """Refuse figures whose results are missing, before any is drawn."""
    known = experiments_in(out)
    missing = [item.study.configs[name] for item in figures for name in item.experiments if name not in known]
    if missing:
        command = " ".join(["ctid run", *(f"configs/{config}" for config in dict.fromkeys(missing))])
        raise UsageError(f"there are no results in {out} to draw this from; run first: {command}{out_option(out)}")
