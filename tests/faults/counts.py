"""What trials brought about, counted by kind of fault; the table that says so."""

from __future__ import annotations

import sys
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


@dataclass
class Count:
    """Trials of one kind of fault, and what came of them."""

    kind: str
    trials: int = 0
    bad: dict[str, int] = field(default_factory=lambda: dict.fromkeys(BAD, 0))
    #: Of each kind of misfortune the first few, in words.
    examples: list[str] = field(default_factory=list)

    def add(self, found: Sequence[tuple[str, str]], trial: object) -> None:
        """Count a trial, and what it brought about: a key of BAD, and a sentence."""
        self.trials += 1
        for name, text in found:
            self.bad[name] += 1
            if self.bad[name] <= 5:
                self.examples.append(f"{name} ({trial}): {text[-1500:]}")
                print(f"{self.kind}: {self.examples[-1]}", file=sys.stderr, flush=True)

    @property
    def is_good(self) -> bool:
        """Whether nothing happened that must not."""
        return not any(self.bad.values())


def table(counts: Iterable[Count]) -> str:
    """Counts as a table in Markdown, with a line of sums."""
    counts = list(counts)
    rows = [[count.kind, count.trials, *(count.bad[name] for name in BAD)] for count in counts]
    rows.append(["**all**", *(sum(int(row[k]) for row in rows) for k in range(1, len(BAD) + 2))])
    lines = [["fault", "trials", *BAD.values()], [":--", *["--:"] * (len(BAD) + 1)], *rows]
    return "".join(
        "| " + " | ".join(f"{cell:,}" if isinstance(cell, int) else cell for cell in row) + " |\n" for row in lines
    )
