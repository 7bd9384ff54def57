"""What ``ctid table --check`` answers: do fresh percentages agree with committed tables and with the paper?"""

from __future__ import annotations

import csv
import json
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from ctid_cli.errors import UsageError
from ctid_cli.reporting.layout import count, delay_label, markdown_table, number, percent, text_table
from ctid_cli.reporting.report import build_tables
from ctid_cli.reporting.results import out_option, shown_path
from ctid_cli.reporting.study import Study, load_study
from ctid_cli.reporting.tables import csv_text, setting_text, setting_title
from ctid_cli.running.plan import RESERVED_COLUMNS

#: Chance that a check reports any difference although nothing has changed.
LEVEL = 0.01

Against = Literal["committed", "paper"]

#: Columns that tables must have to be compared with.
_NEEDED = ("table", "experiment", "initial_delay", "method", "n", "converged")
_Identity = tuple[str, str, Any, frozenset[tuple[str, Any]]]


@dataclass(frozen=True)
class ComparedCell:
    """One table cell, and what it was compared with."""

    against: Against
    decisive: bool
    table: int | str
    experiment: str
    sampling: str | None
    settings: Mapping[str, Any]
    #: Where the search started [s]; None for an estimator that needs no start.
    initial_delay: float | str | None
    method: str
    n: int
    converged: int
    reference_n: int
    reference_converged: int
    #: Two-sided p-value of Fisher's exact test that both percentages are equal [-].
    p_value: float
    #: The same after Holm's correction for the number of cells: a difference where it is below the level [-].
    adjusted_p_value: float

    @property
    def percent(self) -> float:
        """Fresh percentage [%]."""
        return 100 * self.converged / self.n

    @property
    def reference_percent(self) -> float:
        """Percentage of the reference [%]."""
        return 100 * self.reference_converged / self.reference_n

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
        return {
            "against": self.against,
            "table": self.table,
            "experiment": self.experiment,
            "sampling": self.sampling,
            **self.settings,
            "initial_delay": self.initial_delay,
            "method": self.method,
            "n": self.n,
            "converged": self.converged,
            "percent": self.percent,
            "reference_n": self.reference_n,
            "reference_converged": self.reference_converged,
            "reference_percent": self.reference_percent,
            "p_value": self.p_value,
            "adjusted_p_value": self.adjusted_p_value,
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
        return sum(
            (cell.n, cell.converged) == (cell.reference_n, cell.reference_converged)
            for cell in self.cells
            if cell.against == "committed"
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
    rows = [row for table in tables for row in table.rows]
    notes = tuple(dict.fromkeys(note for table in tables for note in table.notes))
    comparison = compare(rows, committed, study, None if file is None else shown_path(file), notes)
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
    from scipy.stats import fisher_exact

    fresh: dict[_Identity, dict[str, Any]] = {}
    for row in rows:
        fresh.setdefault(_identity(row), _plain_row(row))
    tables = {str(row["table"]) for row in fresh.values()}
    known: dict[_Identity, dict[str, Any]] = {}
    for row in map(_plain_row, committed or ()):
        if row["n"] and row["converged"] is not None:
            known.setdefault(_identity(row), row)

    pairs: list[tuple[Against, bool, dict[str, Any], int, int]] = []
    lacking = 0
    for identity, row in fresh.items():
        if not row["n"] or row["converged"] is None:
            continue
        if identity in known:
            pairs.append(("committed", True, row, known[identity]["n"], known[identity]["converged"]))
        elif committed is not None:
            lacking += 1
        published = row.get("published_percent")
        if published is not None:
            trials = study.published_data_sets
            pairs.append(("paper", row["method"] in study.must_reach, row, trials, round(published * trials / 100)))
    asked = {key for key, row in known.items() if not tables.isdisjoint((str(row["table"]), row["experiment"]))}
    asked |= {key for key, row in fresh.items() if row.get("published_percent") is not None}
    not_run = sum(not (key in fresh and fresh[key]["n"]) for key in asked)

    p_values = [
        float(fisher_exact([[k, n - k], [row["converged"], row["n"] - row["converged"]]]).pvalue)
        for _, _, row, n, k in pairs
    ]
    adjusted = [0.0] * len(pairs)
    for family in (True, False):
        members = [k for k, pair in enumerate(pairs) if pair[1] is family]
        for k, value in zip(members, holm([p_values[k] for k in members]), strict=True):
            adjusted[k] = value
    cells = [
        ComparedCell(
            against=against,
            decisive=decisive,
            table=row["table"],
            experiment=row["experiment"],
            sampling=row.get("sampling"),
            settings=_settings(row),
            initial_delay=row["initial_delay"],
            method=row["method"],
            n=row["n"],
            converged=row["converged"],
            reference_n=n,
            reference_converged=converged,
            p_value=p_values[k],
            adjusted_p_value=adjusted[k],
        )
        for k, (against, decisive, row, n, converged) in enumerate(pairs)
    ]
    return Comparison(tuple(cells), reference, not_run, lacking, tuple(notes))


def holm(p_values: Sequence[float]) -> list[float]:
    """Holm's correction for several tests.

    With ``p_(1) <= ... <= p_(m)``, the adjusted p-value of ``p_(i)`` is the largest ``(m + 1 - j) p_(j)``, j <= i,
    and at most 1.
    """
    adjusted = [0.0] * len(p_values)
    largest = 0.0
    for rank, k in enumerate(sorted(range(len(p_values)), key=p_values.__getitem__)):
        largest = max(largest, min(1.0, (len(p_values) - rank) * p_values[k]))
        adjusted[k] = largest
    return adjusted


def committed_tables() -> Path | None:
    """File of the default study's committed tables."""
    file = Path(__file__).resolve().parents[2] / "results" / "published" / "useful_redundancy" / "tables.csv"
    return file if file.is_file() else None


def read_tables(file: Path) -> list[dict[str, Any]]:
    """Read tables that ``ctid table --format csv`` wrote."""
    try:
        with file.open(encoding="utf-8-sig", newline="") as stream:
            reader = csv.DictReader(stream)
            missing = [name for name in _NEEDED if name not in (reader.fieldnames or ())]
            if missing:
                advice = "write such a file with: ctid table --format csv"
                raise UsageError(f"{file} has no column {', '.join(missing)}; {advice}")
            rows = []
            for line in reader:
                line.pop(None, None)
                row = _plain_row(line)
                n, converged = row["n"], row["converged"]
                # An empty field is a cell without a success rule.
                judged = line["converged"] not in (None, "")
                if n is None or (judged and not (converged is not None and 0 <= converged <= n)):
                    raise UsageError(
                        f"{file}:{reader.line_num}: n and converged must be counts with 0 <= converged <= n, "
                        f"not {line['n']!r} and {line['converged']!r}"
                    )
                rows.append(row)
    except OSError as error:
        raise UsageError(f"{file} cannot be read: {error.strerror or error}") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise UsageError(f"{file} is not a comma-separated text file: {error}") from None
    return rows


def write_comparison(comparison: Comparison, style: str = "text") -> str:
    """A comparison in one of the forms of a table."""
    if style == "json":
        return json.dumps(comparison.as_dict(), indent=1, allow_nan=False)
    if style == "csv":
        return csv_text([cell.as_dict() for cell in comparison.cells]).rstrip("\n")
    parts = [_fill(_verdict(comparison), style)]
    wrong = comparison.mismatches
    for title, cells in (
        (f"Other than in {comparison.reference}:", [cell for cell in wrong if cell.against == "committed"]),
        ("Lower than in the paper:", [cell for cell in wrong if cell.against == "paper"]),
        (
            "For information, differences from the paper that are no mismatch (reasons: the study's README):",
            comparison.differences,
        ),
    ):
        if cells:
            parts.append(("\n\n" if style == "md" else "\n").join([_fill(title, style), _listing(cells, style)]))
    # Notes hold commands, which must stay on one line.
    notes = ("\n\n" if style == "md" else "\n").join(f"Note: {note}" for note in comparison.notes)
    return "\n\n".join([*parts, notes] if notes else parts)


def mismatch_sentence(comparison: Comparison) -> str:
    """What is wrong, in one sentence."""
    wrong, compared = len(comparison.mismatches), len(comparison.decisive)
    verb = "differs" if wrong == 1 else "differ"
    return f"{wrong} of {count(compared, 'comparison')} {verb} by more than sampling error explains"


def _verdict(comparison: Comparison) -> str:
    cells = comparison.decisive
    committed = sum(cell.against == "committed" for cell in cells)
    paper = len(cells) - committed
    parts = []
    if committed:
        same = f"{comparison.identical} of them with the same counts"
        parts.append(f"{count(committed, 'cell')} with {comparison.reference} ({same})")
    if paper:
        methods = ", ".join(dict.fromkeys(cell.method for cell in cells if cell.against == "paper"))
        parts.append(f"{count(paper, 'cell')} of {methods} with the paper")
    least, most = min(cell.n for cell in cells), max(cell.n for cell in cells)
    sizes = count(most, "data set") if least == most else f"{least} to {count(most, 'data set')}"
    if comparison.mismatches:
        text = mismatch_sentence(comparison)
    else:
        text = f"No difference beyond sampling error in {count(len(cells), 'comparison')}"
    text += f": {' and '.join(parts)}, from {sizes} a cell."
    text += f" Fisher's exact test, Holm's correction: a chance of at most {100 * LEVEL:g} % of any false alarm."
    if comparison.not_run:
        text += f" Not run, so not compared: {count(comparison.not_run, 'cell')}."
    if comparison.not_in_reference:
        text += f" Not in {comparison.reference}, but run: {count(comparison.not_in_reference, 'cell')}."
    elif comparison.reference is None:
        text += " There are no committed tables here to compare with (--reference names some)."
    return text


def _listing(cells: Sequence[ComparedCell], style: str) -> str:
    keys = list(dict.fromkeys(key for cell in cells for key in cell.settings))
    header = [
        "table",
        "sampling",
        *map(setting_title, keys),
        "initial delay",
        "method",
        "ours %",
        "n",
        "reference %",
        "n",
        "p",
    ]
    body = [
        [
            str(cell.table),
            cell.sampling or "-",
            *(setting_text(key, cell.settings.get(key)) for key in keys),
            delay_label(cell.initial_delay),
            cell.method,
            percent(cell.percent, cell.n),
            str(cell.n),
            percent(cell.reference_percent, cell.reference_n),
            str(cell.reference_n),
            number(cell.p_value, 2),
        ]
        for cell in cells
    ]
    return (text_table if style == "text" else markdown_table)(header, body, "l" * (len(keys) + 4) + "rrrrr")


def _fill(text: str, style: str) -> str:
    return text if style == "md" else textwrap.fill(text, 98, break_long_words=False, break_on_hyphens=False)


def _identity(row: Mapping[str, Any]) -> _Identity:
    """What makes two cells the same one, whichever table shows it."""
    plain = _plain_row(row)
    return plain["experiment"], plain["method"], plain["initial_delay"], frozenset(_settings(plain).items())


def _settings(row: Mapping[str, Any]) -> dict[str, Any]:
    # No swept field has a reserved name.
    return {key: value for key, value in row.items() if key not in RESERVED_COLUMNS and value is not None}


def _plain_row(row: Mapping[str, Any]) -> dict[str, Any]:
    """A row in which values are the same whether they come from a CSV file or from results."""
    plain = {key: _plain(value) for key, value in row.items()}
    # Names stay what they are, also where they look like numbers.
    plain |= {key: row[key] for key in ("table", "experiment", "method")}
    for key in ("n", "converged"):
        value = plain[key]
        plain[key] = int(value) if isinstance(value, float) and value.is_integer() else None
    return plain


def _plain(value: Any) -> Any:
    if value is None or value == "":
        return None
    if isinstance(value, bool):
        return str(value)
    if isinstance(value, list | dict):
        return json.dumps(value)
    try:
        return float(value)
    except ValueError:
        return str(value)
