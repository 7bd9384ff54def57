"""What trials brought about, counted by kind of fault; the table that says so."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

#: What must never happen, in the order of the table.
BAD = {
    "lost": "acknowledged estimates lost",
    "wrong": "readings silently wrong",
    "differing": "differing bytes",
    "hang": "hangs > 60 s",
    "traceback": "tracebacks",
    "left": "left behind",
}


@dataclass(frozen=True)
class Trial:
    """A trial, and what it brought about: keys of BAD, and sentences."""

    kind: str
    number: int
    name: str
    found: Sequence[tuple[str, str]] = ()
    #: Of a run that gets several.
    faults: int = 1

    def __str__(self) -> str:
        texts = "\n".join(f"{what}: {text[-1500:]}" for what, text in self.found)
        return f"{self.kind}, number {self.number} ({self.name}): {texts or 'nothing'}"


@dataclass
class Count:
    """Trials of one kind of fault, and what came of them."""

    kind: str
    trials: int = 0
    bad: dict[str, int] = field(default_factory=lambda: dict.fromkeys(BAD, 0))

    def add(self, trial: Trial) -> None:
        """Count a trial."""
        self.trials += trial.faults
        for name, _ in trial.found:
            self.bad[name] += 1

    @property
    def is_good(self) -> bool:
        """Whether nothing happened that must not."""
        return not any(self.bad.values())


def counted(trials: Iterable[Trial]) -> list[Count]:
    """Counts of all kinds, in the order in which these come."""
    counts: dict[str, Count] = {}
    for trial in trials:
        counts.setdefault(trial.kind, Count(trial.kind)).add(trial)
    return list(counts.values())


def table(counts: Iterable[Count]) -> str:
    """Counts as a table in Markdown, with a line of sums."""
    rows = [[count.kind, count.trials, *(count.bad[name] for name in BAD)] for count in counts]
    rows.append(["**all**", *(sum(int(row[k]) for row in rows) for k in range(1, len(BAD) + 2))])
    lines = [["fault", "trials", *BAD.values()], [":--", *["--:"] * (len(BAD) + 1)], *rows]
    return "".join(
        "| " + " | ".join(f"{cell:,}" if isinstance(cell, int) else cell for cell in row) + " |\n" for row in lines
    )
