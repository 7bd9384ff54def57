"""What ``ctid table --check`` answers: do fresh percentages agree with committed tables and with the paper?"""

import json
from bisect import bisect_left
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

from ctid_cli.errors import UsageError
from ctid_cli.inference.paired import holm
from ctid_cli.reporting.committed import committed_tables, made_by, plain_row, read_tables
from ctid_cli.reporting.layout import Report, Table, count, csv_text, delay_label, number, percent
from ctid_cli.reporting.percentages import Row, settings_of
from ctid_cli.reporting.results import out_option, shown_path
from ctid_cli.reporting.study import Study, load_study
from ctid_cli.reporting.table_blocks import setting_text, setting_title
from ctid_cli.reporting.tables import build_tables
from ctid_cli.text import listed

#: Chance that a check reports any difference although nothing has changed.
LEVEL = 0.01
#: Chance that a difference as large as the one that is called detectable is reported.
POWER = 0.8

Cell = dict[str, Any]

#: Keys of a compared cell besides those that identify the cell of a table.
_COMPARED = (
    *("against", "n", "converged", "percent", "reference_n", "reference_converged", "reference_percent"),
    *("p_value", "adjusted_p_value", "detectable", "differs", "decisive", "mismatch"),
)


@dataclass(frozen=True)
class Comparison:
    """A finished comparison; its cells have the keys of ``ctid table --check --format json``."""

    cells: list[Cell]
    reference: str | None
    not_run: int
    not_in_reference: int
    notes: Sequence[str] = ()

    @property
    def decisive(self) -> list[Cell]:
        """Comparisons that decide the exit code."""
        return [cell for cell in self.cells if cell["decisive"]]

    @property
    def mismatches(self) -> list[Cell]:
        """Those of them that differ."""
        return [cell for cell in self.cells if cell["mismatch"]]

    @property
    def differences(self) -> list[Cell]:
        """Differences from the paper that are no mismatch."""
        return [cell for cell in self.cells if cell["differs"] and not cell["mismatch"]]

    @property
    def identical(self) -> int:
        """Cells with the same counts as in the committed tables."""
        return sum(
            (cell["n"], cell["converged"]) == (cell["reference_n"], cell["reference_converged"])
            for cell in self.cells
            if cell["against"] == "committed"
        )

    def as_dict(self) -> dict[str, Any]:
        """The object of ``ctid table --check --format json``."""
        return {
            "agrees": not self.mismatches,
            "level": LEVEL,
            "reference": self.reference,
            "compared": len(self.decisive),
            "identical": self.identical,
            "mismatches": len(self.mismatches),
            **{name: getattr(self, name) for name in ("not_run", "not_in_reference", "cells")},
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
    if file is not None and reference is None and (maker := made_by(file.parent)):
        notes.append(f"the percentages in {shown} were {maker}")
    comparison = compare(rows, committed, study, shown, notes)
    if comparison.decisive:
        return comparison
    if not any(row["n"] for row in rows):
        raise UsageError("\n".join(["nothing can be compared, because none of these cells was run.", *notes]))
    command = " ".join(["ctid table", *names])
    where = "there are no committed tables" if file is None else f"{comparison.reference} has none of their cells"
    paper = f"of the paper's only those of {', '.join(study.must_reach)} decide"
    later = f"{command}{out_option(out)} --format csv > FILE, then {command} --check --reference FILE"
    wrong = f"the results in {out} have nothing to be compared with: {where}, and {paper}"
    raise UsageError(f"{wrong}. To keep these results as a reference for later: {later}")


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

    cells = list(_compared(fresh, known, study))
    for family in (True, False):
        members = [cell for cell in cells if cell["decisive"] is family]
        for cell, adjusted in zip(members, holm([cell["p_value"] for cell in members]), strict=True):
            _judge(cell, adjusted, LEVEL / len(members))
    lacking = sum(_is_counted(row) and key not in known for key, row in fresh.items()) if committed is not None else 0
    return Comparison(cells, reference, _not_run(fresh, known), lacking, notes)


def _compared(fresh: Mapping[Any, Row], known: Mapping[Any, Row], study: Study) -> Iterator[Cell]:
    """Fresh cells beside those of the committed tables and of the paper, not yet judged."""
    trials = study.published_data_sets
    for identity, row in fresh.items():
        if _is_counted(row) and identity in known:
            yield _cell(row, "committed", True, known[identity]["converged"], known[identity]["n"])
        if _is_counted(row) and (published := row.get("published_percent")) is not None:
            yield _cell(row, "paper", row["method"] in study.must_reach, round(published * trials / 100), trials)


def _cell(row: Row, against: str, decisive: bool, converged: int, n: int) -> Cell:
    keys = ("table", "experiment", "sampling", *settings_of([row]), "initial_delay", "method", "n", "converged")
    return {
        "against": against,
        **{key: row.get(key) for key in keys},
        "percent": 100 * row["converged"] / row["n"],
        "reference_n": n,
        "reference_converged": converged,
        "reference_percent": 100 * converged / n,
        "p_value": fisher(row["converged"], row["n"], converged, n),
        **dict.fromkeys(("adjusted_p_value", "detectable", "differs")),
        "decisive": decisive,
    }


def _judge(cell: Cell, adjusted: float, level: float) -> None:
    """Any difference from committed tables is a mismatch, from the paper only a lower percentage."""
    committed, differs = cell["against"] == "committed", adjusted < LEVEL
    reference = cell["reference_converged"], cell["reference_n"]
    cell["adjusted_p_value"], cell["differs"] = adjusted, differs
    cell["detectable"] = smallest_detectable(cell["n"], *reference, level, rise=committed)
    lower = cell["percent"] < cell["reference_percent"]
    cell["mismatch"] = cell["decisive"] and differs and (committed or lower)


def _not_run(fresh: Mapping[Any, Row], known: Mapping[Any, Row]) -> int:
    """How many cells of the tables that were asked for have no estimates."""
    tables = {str(row["table"]) for row in fresh.values()}
    asked = {key for key, row in known.items() if not tables.isdisjoint((str(row["table"]), row["experiment"]))}
    asked |= {key for key, row in fresh.items() if row.get("published_percent") is not None}
    return sum(not (key in fresh and fresh[key]["n"]) for key in asked)


@cache
def fisher(converged: int, n: int, reference_converged: int, reference_n: int) -> float:
    """Two-sided p-value of Fisher's exact test that two percentages are equal [-]."""
    from scipy.stats import fisher_exact

    reference = [reference_converged, reference_n - reference_converged]
    return float(fisher_exact([reference, [converged, n - converged]]).pvalue)


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
        insignificant = partial(_agrees, n, expected, reference_n, level)
        low = bisect_left(range(n * expected // reference_n + 1), True, key=insignificant) - 1
        if 0 <= low < n:
            drops.append(100 * (expected / reference_n - float(beta.ppf(1 - POWER, low + 1, n - low))))
    return min(drops, default=None)


def _agrees(n: int, expected: int, reference_n: int, level: float, converged: int) -> bool:
    return fisher(converged, n, expected, reference_n) >= level


def write_comparison(comparison: Comparison, style: str = "text") -> str:
    """A comparison in one of the forms of a table."""
    if style == "json":
        return json.dumps(comparison.as_dict(), indent=1, allow_nan=False)
    if style == "csv":
        return csv_text(comparison.cells).rstrip("\n")
    wrong = comparison.mismatches
    information = "For information, differences from the paper that are no mismatch (reasons: the study's README):"
    parts = {
        f"Other than in {comparison.reference}:": [cell for cell in wrong if cell["against"] == "committed"],
        "Lower than in the paper:": [cell for cell in wrong if cell["against"] == "paper"],
        information: comparison.differences,
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
    paper = [cell for cell in cells if cell["against"] == "paper"]
    parts = []
    if len(paper) < len(cells):
        same = f"{comparison.identical} of them with the same counts"
        parts.append(f"{count(len(cells) - len(paper), 'cell')} with {comparison.reference} ({same})")
    if paper:
        methods = ", ".join(dict.fromkeys(cell["method"] for cell in paper))
        parts.append(f"{count(len(paper), 'cell')} of {methods} with the paper")
    least, most = (extreme(cell["n"] for cell in cells) for extreme in (min, max))
    sizes = count(most, "data set") if least == most else f"{least} to {count(most, 'data set')}"
    agrees = f"No difference beyond sampling error in {count(len(cells), 'comparison')}"
    result = mismatch_sentence(comparison) if comparison.mismatches else agrees
    rule = f"Fisher's exact test, Holm's correction: a chance of at most {100 * LEVEL:g} % of any false alarm."
    text = f"{result}: {listed(parts)}, from {sizes} a cell. {rule} {_power(cells)}"
    if comparison.not_run:
        text += f" Not run, so not compared: {count(comparison.not_run, 'cell')}."
    if comparison.not_in_reference:
        text += f" Not in {comparison.reference}, but run: {count(comparison.not_in_reference, 'cell')}."
    elif comparison.reference is None:
        text += " There are no committed tables here to compare with (--reference names some)."
    return text


def _power(cells: Sequence[Cell]) -> str:
    """What the comparisons could have found."""
    found = [cell["detectable"] for cell in cells if cell["detectable"] is not None]
    if not found:
        return "With so few data sets no difference could have been detected, however large."
    ends = " to ".join(dict.fromkeys(f"{end:.0f}" for end in (min(found), max(found))))
    text = f"A single cell that differs by {ends} percentage points is detected with {100 * POWER:g} % probability"
    text += ", the reference taken as exact"
    blind = len(cells) - len(found)
    return f"{text}; in {count(blind, 'cell')} no difference could have been detected." if blind else f"{text}."


def _listing(cells: Sequence[Cell]) -> Table:
    keys = [key for key in settings_of(cells) if key not in _COMPARED]
    titles = ["table", "sampling", *map(setting_title, keys), "initial delay", "method"]
    body = [
        [
            *(str(cell["table"]), cell["sampling"] or "-", *(setting_text(key, cell.get(key)) for key in keys)),
            *(delay_label(cell["initial_delay"]), cell["method"], percent(cell["percent"], cell["n"]), str(cell["n"])),
            *(percent(cell["reference_percent"], cell["reference_n"]), str(cell["reference_n"])),
            number(cell["p_value"], 2),
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
