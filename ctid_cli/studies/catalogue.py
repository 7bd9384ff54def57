"""Results of studies, and their figures by name."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

from ctid_cli.errors import UsageError
from ctid_cli.reporting.results import Results, experiments_in, find_results, out_option, read_results
from ctid_cli.reporting.study import DEFAULT_STUDY, Study, all_studies, find_study, last_part
from ctid_cli.text import did_you_mean


@dataclass(frozen=True, eq=False)
class StudyResults:
    """Results of the experiments of a study that were run."""

    study: Study
    out: Path
    experiments: Mapping[str, Results] = field(default_factory=dict)

    def __contains__(self, short: str) -> bool:
        return short in self.experiments

    def __getitem__(self, short: str) -> Results:
        return self.experiments[short]


def read_study(study: Study, out: Path) -> StudyResults:
    """Return the results of a study, by the last parts of its experiments' names."""
    found = {last_part(name): find_results(out, name) for name in study.configs}
    return StudyResults(study, out, {name: results for name, results in found.items() if results is not None})


@dataclass(frozen=True)
class StudyFigure:
    """A figure that can be drawn: a function ``figure_<number>`` of its study."""

    study: Study
    number: str

    @property
    def place(self) -> Path:
        """Path of its file, relative to the results folder."""
        return Path(f"{self.study.folder.name}_figures") / f"figure_{self.number}.svg"

    @property
    def experiments(self) -> list[str]:
        """Names of the experiments whose results it shows."""
        return [self.study.experiment(short) for short in self.study.figures[self.number]]

    @property
    def caption(self) -> str:
        """Caption, the first line of its function's docstring."""
        return (self._draw.__doc__ or "").partition("\n")[0].rstrip(".")

    @property
    def _draw(self) -> Callable[..., bytes]:
        found: Callable[..., bytes] = getattr(self.study.module("figures"), f"figure_{self.number}")
        return found

    def svg(self, out: Path) -> bytes:
        """Draw the figure."""
        require_results([self], out)
        return bytes(self._draw(*(read_results(out, name) for name in self.experiments)))


def sorted_names(names: Sequence[str], out: Path) -> tuple[list[str], list[str]]:
    """Return names of experiments with results, and all others; a figure takes precedence over an experiment."""
    known = set(experiments_in(out)) - _named_figures().keys()
    own = [name for name in dict.fromkeys(names) if name in known]
    return own, [name for name in names if name not in known]


@cache
def _named_figures() -> dict[str, list[StudyFigure]]:
    """Return the figures by all their names: one or all of a study, and by number of the default study."""
    of_studies = {name: [StudyFigure(study, k) for k in study.figures] for name, study in all_studies().items()}
    named = {figure.number: [figure] for figure in of_studies[DEFAULT_STUDY]}
    for name, figures in of_studies.items():
        named |= {name: figures, **{f"{name}/{each.number}": [each] for each in figures}} if figures else {}
    return named


def find_figures(names: Sequence[str], out: Path | None = None) -> list[StudyFigure]:
    """Return the requested figures."""
    named = _named_figures()
    for name in names:
        place, _, number = name.rpartition("/")
        place = place or DEFAULT_STUDY
        if name not in named and place in named and number.isdigit():
            raise UsageError(f"{place} has no figure {number}; it has {', '.join(find_study(place).figures)}")
        if name not in named:
            known = [*named, *([] if out is None else experiments_in(out))]
            hint = did_you_mean(name, known) or "."
            wrong = f"{name!r} is neither a figure nor a study with figures"
            wrong += f", nor an experiment with results in the folder {out}" if out else ""
            raise UsageError(f"{wrong}{hint} Known: {', '.join(known)}")
    return list(dict.fromkeys(figure for name in names or [DEFAULT_STUDY] for figure in named[name]))


def require_results(figures: Iterable[StudyFigure], out: Path) -> None:
    """Refuse figures whose results are missing, before any is drawn."""
    known = experiments_in(out)
    missing = [item.study.configs[name] for item in figures for name in item.experiments if name not in known]
    if missing:
        command = " ".join(["ctid run", *(f"configs/{config}" for config in dict.fromkeys(missing))])
        raise UsageError(f"there are no results in {out} to draw this from; run first: {command}{out_option(out)}")
