"""Which figures there are, by name: ``useful-redundancy/2``, or ``2`` for short."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from ctid_cli.errors import UsageError
from ctid_cli.reporting.results import experiments_in, out_option, read_results
from ctid_cli.reporting.study import DEFAULT_STUDY
from ctid_cli.studies.catalogue import StudyFolder, all_studies
from ctid_cli.text import did_you_mean


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

    def svg(self, out: Path) -> bytes:
        """Draw it."""
        require_results([self], out)
        draw = getattr(self.study.module("figures"), f"figure_{self.number}")
        return bytes(draw(*(read_results(out, name) for name in self.experiments)))


def find_figures(names: Sequence[str]) -> list[StudyFigure]:
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
            known = [*studies[DEFAULT_STUDY].figures]
            known += [entry for s in studies.values() for entry in (s.name, *(f"{s.name}/{k}" for k in s.figures))]
            hint = did_you_mean(name, known) or "."
            raise UsageError(f"{name!r} is neither a figure nor a study with figures{hint} Known: {', '.join(known)}")
    return list(dict.fromkeys(found))


def require_results(figures: Iterable[StudyFigure], out: Path) -> None:
    """Refuse figures whose results are missing, before any is drawn."""
    known = experiments_in(out)
    missing = [item.study.configs[name] for item in figures for name in item.experiments if name not in known]
    if missing:
        command = " ".join(["ctid run", *(f"configs/{config}" for config in dict.fromkeys(missing))])
        raise UsageError(f"there are no results in {out} to draw this from; run first: {command}{out_option(out)}")
