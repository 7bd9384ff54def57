"""Which figures there are, by name: ``useful-redundancy/2``, or ``2`` for short."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from ctid_cli.errors import UsageError
from ctid_cli.reporting.figures import additive, finite_time_frequency, useful_redundancy
from ctid_cli.reporting.figures.from_results import FromResults, not_run
from ctid_cli.reporting.study import DEFAULT_STUDY
from ctid_cli.text import did_you_mean

#: Figures of every study: number or name, and what draws it as an SVG file.
STUDIES: Mapping[str, Mapping[str, Callable[[], bytes] | FromResults]] = {
    "useful-redundancy": useful_redundancy.FIGURES,
    "additive": additive.FIGURES,
    "finite-time-frequency": finite_time_frequency.FIGURES,
}


@dataclass(frozen=True)
class StudyFigure:
    """A figure that can be drawn."""

    study: str
    number: str

    @property
    def place(self) -> Path:
        """Its file, relative to the results folder."""
        return Path(f"{self.study.replace('-', '_')}_figures") / f"figure_{self.number}.svg"

    def svg(self, out: Path) -> bytes:
        """Draw it."""
        drawn = STUDIES[self.study][self.number]
        return drawn.svg(out) if isinstance(drawn, FromResults) else drawn()


def find_figures(names: Sequence[str]) -> list[StudyFigure]:
    """The figures that were asked for."""
    found: list[StudyFigure] = []
    for name in names or [DEFAULT_STUDY]:
        study, _, number = name.rpartition("/")
        study = study or DEFAULT_STUDY
        if name in STUDIES:
            found += [StudyFigure(name, number) for number in STUDIES[name]]
        elif number in STUDIES.get(study, {}):
            found.append(StudyFigure(study, number))
        elif study in STUDIES and number.isdigit():
            raise UsageError(f"{study} has no figure {number}; it has {', '.join(STUDIES[study])}")
        else:
            raise UsageError(_unknown(name))
    return list(dict.fromkeys(found))


def require_results(figures: Iterable[StudyFigure], out: Path) -> None:
    """Refuse figures whose results are missing, before any is drawn."""
    drawn = [STUDIES[figure.study][figure.number] for figure in figures]
    missing = [config for item in drawn if isinstance(item, FromResults) for config in item.missing(out)]
    if missing:
        raise not_run(list(dict.fromkeys(missing)), out)


def _unknown(name: str) -> str:
    known = [*STUDIES[DEFAULT_STUDY], *(entry for study in STUDIES for entry in _names(study))]
    hint = did_you_mean(name, known) or "."
    return f"{name!r} is neither a figure nor a study with figures{hint} Known: {', '.join(known)}"


def _names(study: str) -> list[str]:
    return [study, *(f"{study}/{number}" for number in STUDIES[study])]
