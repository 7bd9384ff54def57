"""What ``ctid table --check`` answers: do fresh percentages agree with committed tables and with the paper?"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

from ctid_cli.errors import UsageError
from ctid_cli.reporting.committed import committed_tables, made_by, plain_row, read_tables
from ctid_cli.reporting.layout import Report, Table, count, csv_text, delay_label, number, percent
from ctid_cli.reporting.percentages import Row, settings_of
from ctid_cli.reporting.results import out_option, shown_path
from ctid_cli.reporting.study import Study, load_study
from ctid_cli.reporting.study_table import setting_text, setting_title
from ctid_cli.reporting.tables import build_tables
from ctid_cli.text import listed

#: Chance that a check reports any difference although nothing has changed.
LEVEL = 0.01
#: Chance that a difference as large as the one that is called detectable is reported.
POWER = 0.8

Against = Literal["committed", "paper"]


@dataclass(frozen=True)
class ComparedCell:
    """One table cell, and what it was compared with."""

    against: Against
    decisive: bool
    #: The fresh cell.
    row: Row
    reference_n: int
    reference_converged: int
    #: Two-sided p-value of Fisher's exact test that both percentages are equal [-].
    p_value: float
    #: The same after Holm's correction for the number of cells: a difference where it is below the level [-].
    adjusted_p_value: float
    #: Smallest difference that would have been reported with 80 % probability [percentage points].
    detectable: float | None

    @property
    def percent(self) -> float:
        """Fresh percentage [%]."""
        return float(100 * self.row["converged"] / self.row["n"])

    @property
    def reference_percent(self) -> float:
        """Percentage of the reference [%]."""
        return 100 * self.reference_converged / self.reference_n

    @property
    def identical(self) -> bool:
        """Whether the counts are those of the reference."""
        return (self.row["n"], self.row["converged"]) == (self.reference_n, self.reference_converged)

    @property
    def differs(self) -> bool:
        """Whether the percentages differ by more than sampling error explains."""
        return self.adjusted_p_value < LEVEL

    @property
    def mismatch(self) -> bool:
        """Whether the difference counts: any from committed tables, but only a lower percentage than the paper's."""
        return self.decisive and self.differs and (self.against == "committed" or self.percent < self.reference_percent)

    def as_dict(self) -> dict[str, Any]:
        """The cell of ``ctid table --check --format json``: swept fields are keys of their own."""
        keys = (
            "table",
            "experiment",
            "sampling",
            *settings_of([self.row]),
            "initial_delay",
            "method",
            "n",
            "converged",
        )
        return {
            "against": self.against,
            **{key: self.row.get(key) for key in keys},
            "percent": self.percent,
            "reference_n": self.reference_n,
            "reference_converged": self.reference_converged,
            "reference_percent": self.reference_percent,
            "p_value": self.p_value,
            "adjusted_p_value": self.adjusted_p_value,
            "detectable": self.detectable,
            "differs": self.differs,
            "decisive": self.decisive,
            "mismatch": self.mismatch,
        }


@dataclass(frozen=True)
class Comparison:
    """A finished comparison."""

    cells: tuple[ComparedCell, ...]
    reference: str | None
    not_run: int
    not_in_reference: int
    notes: tuple[str, ...] = ()

    @property
    def decisive(self) -> list[ComparedCell]:
        """Comparisons that decide the exit code."""
        return [cell for cell in self.cells if cell.decisive]

    @property
    def mismatches(self) -> list[ComparedCell]:
        """Those of them that differ."""
        return [cell for cell in self.cells if cell.mismatch]

    @property
    def differences(self) -> list[ComparedCell]:
        """Differences from the paper that are no mismatch."""
        return [cell for cell in self.cells if cell.differs and not cell.mismatch]

    @property
    def identical(self) -> int:
        """Cells with the same counts as in the committed tables."""
        return sum(cell.identical for cell in self.cells if cell.against == "committed")

    def as_dict(self) -> dict[str, Any]:
        """The object of ``ctid table --check --format json``."""
        return {
            "agrees": not self.mismatches,
            "level": LEVEL,
            "reference": self.reference,
            "compared": len(self.decisive),
            "identical": self.identical,
            "mismatches": len(self.mismatches),
            "not_run": self.not_run,
            "not_in_reference": self.not_in_reference,
            "cells": [cell.as_dict() for cell in self.cells],
            "notes": list(self.notes),
        }


def check_tables(names: Sequence[str], out: Path, reference: Path | None = None) -> Comparison:
    """Compare tables of a results folder with committed ones and with the paper."""
    study = load_study()
    file = committed_tables() if reference is None else reference
    committed = None if file is None else read_tables(file)
    tables = build_tables(names, out)
    rows = [row for table in tables for row in table.records]
    notes = list(dict.fromkeys(note for table in tables for note in table.notes))
    shown = None if file is None else shown_path(file)
    if file is not None and reference is None and (maker := made_by(file)):
        notes.append(f"the percentages in {shown} were computed{maker}")
    comparison = compare(rows, committed, study, shown, notes)
    if comparison.decisive:
        return comparison
    if not any(row["n"] for row in rows):
        raise UsageError("\n".join(["nothing can be compared, because none of these cells was run.", *notes]))
    asked = "".join(f" {name}" for name in names)
    where = "there are no committed tables" if file is None else f"{comparison.reference} has none of their cells"
    raise UsageError(
        f"the results in {out} have nothing to be compared with: {where}, and of the paper's only those of "
        f"{', '.join(study.must_reach)} decide. To keep these results as a reference for later: "
        f"ctid table{asked}{out_option(out)} --format csv > FILE, then ctid table{asked} --check --reference FILE"
    )


def compare(
    rows: Iterable[Mapping[str, Any]],
    committed: Iterable[Mapping[str, Any]] | None,
    study: Study,
    reference: str | None = None,
    notes: Sequence[str] = (),
) -> Comparison:
    """Compare table rows with committed ones and with the paper.

    Cells are the same if experiment, method, initial delay and swept fields are. Each pair of counts is tested with
    Fisher's exact test, conditional on the sum of successes: it holds its level for any number of data sets. Holm's
    correction keeps the chance of any false difference among all decisive cells at 1 %, however they depend on each
    other. Where both sides used the same seed they share their data sets, so they agree even better than the test
    assumes. The comparisons for information are a family of their own.
    """
    fresh: dict[Any, Row] = {}
    for row in map(plain_row, rows):
        fresh.setdefault(_identity(row), row)
    known: dict[Any, Row] = {}
    for row in map(plain_row, committed or ()):
        if _is_counted(row):
            known.setdefault(_identity(row), row)

    pairs: list[tuple[Against, bool, Row, int, int]] = []
    for identity, row in fresh.items():
        if not _is_counted(row):
            continue
        if identity in known:
            pairs.append(("committed", True, row, known[identity]["n"], known[identity]["converged"]))
        if (published := row.get("published_percent")) is not None:
            trials = study.published_data_sets
            pairs.append(("paper", row["method"] in study.must_reach, row, trials, round(published * trials / 100)))
    lacking = sum(_is_counted(row) and key not in known for key, row in fresh.items()) if committed is not None else 0
    tables = {str(row["table"]) for row in fresh.values()}
    asked = {key for key, row in known.items() if not tables.isdisjoint((str(row["table"]), row["experiment"]))}
    asked |= {key for key, row in fresh.items() if row.get("published_percent") is not None}
    not_run = sum(not (key in fresh and fresh[key]["n"]) for key in asked)

    cells: dict[int, ComparedCell] = {}
    for family in (True, False):
        members = [k for k, pair in enumerate(pairs) if pair[1] is family]
        p_values = [fisher(pairs[k][2]["converged"], pairs[k][2]["n"], *pairs[k][:2:-1]) for k in members]
        for k, p_value, adjusted in zip(members, p_values, holm(p_values), strict=True):
            against, decisive, row, n, converged = pairs[k]
            change = smallest_detectable(row["n"], converged, n, LEVEL / len(members), rise=against == "committed")
            cells[k] = ComparedCell(against, decisive, row, n, converged, p_value, adjusted, change)
    return Comparison(tuple(cells[k] for k in range(len(pairs))), reference, not_run, lacking, tuple(notes))


@cache
def fisher(converged: int, n: int, reference_converged: int, reference_n: int) -> float:
    """Two-sided p-value of Fisher's exact test that two percentages are equal [-]."""
    from scipy.stats import fisher_exact

    reference = [reference_converged, reference_n - reference_converged]
    return float(fisher_exact([reference, [converged, n - converged]]).pvalue)


def holm(p_values: Sequence[float]) -> list[float]:
    """Holm's correction for several tests.

    With ``p_(1) <= ... <= p_(m)``, the adjusted p-value of ``p_(i)`` is the largest ``(m + 1 - j) p_(j)``, j <= i,
    and at most 1.
    """
    import numpy as np

    order = np.argsort(p_values, kind="stable")
    adjusted = np.empty(len(order))
    scaled = np.arange(len(order), 0, -1) * np.asarray(p_values, dtype=float)[order]
    adjusted[order] = np.minimum(np.maximum.accumulate(scaled), 1.0) if len(order) else 0.0
    return adjusted.tolist()


def smallest_detectable(
    n: int, reference_converged: int, reference_n: int, level: float, *, rise: bool = True
) -> float | None:
    """Smallest difference from a reference that n data sets show with 80 % power [percentage points].

    The reference counts as given. Successes of the n data sets are binomial with probability q, and k of them or fewer
    are significant at the level, so that the drop is the one to the q with P(K <= k) = 0.8. A rise of successes is a
    drop of failures. None where not even 0 and n successes are significant.
    """
    from scipy.stats import beta

    drops = []
    for expected in (reference_converged, reference_n - reference_converged)[: 1 + rise]:
        low, high = -1, n * expected // reference_n
        while low < high:
            middle = (low + high + 1) // 2
            if fisher(middle, n, expected, reference_n) < level:
                low = middle
            else:
                high = middle - 1
        if 0 <= low < n:
            drops.append(100 * (expected / reference_n - float(beta.ppf(1 - POWER, low + 1, n - low))))
    return min(drops, default=None)


def write_comparison(comparison: Comparison, style: str = "text") -> str:
    """A comparison in one of the forms of a table."""
    if style == "json":
        return json.dumps(comparison.as_dict(), indent=1, allow_nan=False)
    if style == "csv":
        return csv_text([cell.as_dict() for cell in comparison.cells]).rstrip("\n")
    wrong = comparison.mismatches
    parts: dict[str, list[ComparedCell]] = {
        f"Other than in {comparison.reference}:": [cell for cell in wrong if cell.against == "committed"],
        "Lower than in the paper:": [cell for cell in wrong if cell.against == "paper"],
        "For information, differences from the paper that are no mismatch (reasons: the study's README):": (
            comparison.differences
        ),
    }
    listings: list[list[str | Table]] = [[title, _listing(cells)] for title, cells in parts.items() if cells]
    return Report([[_verdict(comparison)], *listings], notes=comparison.notes).draw(style)


def mismatch_sentence(comparison: Comparison) -> str:
    """What is wrong, in one sentence."""
    wrong, compared = len(comparison.mismatches), len(comparison.decisive)
    verb = "differs" if wrong == 1 else "differ"
    return f"{wrong} of {count(compared, 'comparison')} {verb} by more than sampling error explains"


def _verdict(comparison: Comparison) -> str:
    cells = comparison.decisive
    paper = [cell for cell in cells if cell.against == "paper"]
    parts = []
    if len(paper) < len(cells):
        same = f"{comparison.identical} of them with the same counts"
        parts.append(f"{count(len(cells) - len(paper), 'cell')} with {comparison.reference} ({same})")
    if paper:
        methods = ", ".join(dict.fromkeys(cell.row["method"] for cell in paper))
        parts.append(f"{count(len(paper), 'cell')} of {methods} with the paper")
    least, most = (extreme(cell.row["n"] for cell in cells) for extreme in (min, max))
    sizes = count(most, "data set") if least == most else f"{least} to {count(most, 'data set')}"
    text = f"No difference beyond sampling error in {count(len(cells), 'comparison')}"
    text = mismatch_sentence(comparison) if comparison.mismatches else text
    text += f": {listed(parts)}, from {sizes} a cell."
    text += f" Fisher's exact test, Holm's correction: a chance of at most {100 * LEVEL:g} % of any false alarm."
    text += f" {_power(cells)}"
    if comparison.not_run:
        text += f" Not run, so not compared: {count(comparison.not_run, 'cell')}."
    if comparison.not_in_reference:
        text += f" Not in {comparison.reference}, but run: {count(comparison.not_in_reference, 'cell')}."
    elif comparison.reference is None:
        text += " There are no committed tables here to compare with (--reference names some)."
    return text


def _power(cells: Sequence[ComparedCell]) -> str:
    """What the comparisons could have found."""
    found = [cell.detectable for cell in cells if cell.detectable is not None]
    if not found:
        return "With so few data sets no difference could have been detected, however large."
    ends = " to ".join(dict.fromkeys(f"{end:.0f}" for end in (min(found), max(found))))
    text = f"A single cell that differs by {ends} percentage points is detected with {100 * POWER:g} % probability"
    text += ", by the exact binomial distribution and with the reference as given"
    blind = len(cells) - len(found)
    return f"{text}; in {count(blind, 'cell')} no difference could have been detected." if blind else f"{text}."


def _listing(cells: Sequence[ComparedCell]) -> Table:
    keys = settings_of(cell.row for cell in cells)
    titles = ["table", "sampling", *map(setting_title, keys), "initial delay", "method"]
    body = [
        [
            *(str(cell.row["table"]), cell.row.get("sampling") or "-"),
            *(setting_text(key, cell.row.get(key)) for key in keys),
            *(delay_label(cell.row["initial_delay"]), cell.row["method"]),
            *(percent(cell.percent, cell.row["n"]), str(cell.row["n"])),
            *(percent(cell.reference_percent, cell.reference_n), str(cell.reference_n), number(cell.p_value, 2)),
        ]
        for cell in cells
    ]
    return Table([*titles, "ours %", "n", "reference %", "n", "p"], body, "l" * len(titles) + "rrrrr")


def _is_counted(row: Row) -> bool:
    return bool(row["n"]) and row["converged"] is not None


def _identity(row: Row) -> Any:
    """What makes two cells the same one, whichever table shows it."""
    settings = {(key, row[key]) for key in settings_of([row]) if row[key] is not None}
    return row["experiment"], row["method"], row["initial_delay"], frozenset(settings)
