"""Significance tests of the percentages of tables against the committed ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ctid_cli.errors import UsageError
from ctid_cli.inference.paired import fisher, holm
from ctid_cli.progress import reported
from ctid_cli.reporting.document import Result, Section, Table
from ctid_cli.reporting.layout import number, percent
from ctid_cli.reporting.measures import records_of, settings_of
from ctid_cli.reporting.results import shown_path
from ctid_cli.reporting.study_table import build_tables, committed_tables, made_by, read_tables
from ctid_cli.reporting.table_result import labels_of
from ctid_cli.text import count

#: Probability that a check reports any difference although nothing has changed.
LEVEL = 0.01
#: Counts of a cell and of its reference, in the order of Fisher's test, and further columns of a comparison.
COUNTS = ("converged", "n", "reference_converged", "reference_n")
COMPARED = (*COUNTS, "percent", "reference_percent", "p_value", "adjusted_p_value", "differs")


@dataclass(frozen=True, eq=False)
class ComparisonResult(Result):
    """Comparisons of cells of tables, a row for each, with the keys of the cell and the columns ``COMPARED``."""

    schema = "ctid-tables-check-2"

    cells: pd.DataFrame
    reference: str
    not_run: int
    not_in_reference: int
    notes: Sequence[str] = ()

    @property
    def mismatches(self) -> pd.DataFrame:
        """Comparisons that differ."""
        return self.cells[self.cells["differs"]]

    @property
    def identical(self) -> int:
        """Number of cells with the same counts."""
        cells = self.cells
        return int(((cells["n"] == cells["reference_n"]) & (cells["converged"] == cells["reference_converged"])).sum())

    @property
    def verdict(self) -> str:
        """Sentence with the number of comparisons that differ."""
        wrong, compared = len(self.mismatches), count(len(self.cells), "comparison")
        if not wrong:
            return f"No difference beyond sampling error in {compared}"
        return f"{wrong} of {compared} {'differs' if wrong == 1 else 'differ'} by more than sampling error explains"

    def content(self) -> dict[str, Any]:
        """Return the comparison for JSON."""
        return {
            "agrees": self.mismatches.empty,
            "level": LEVEL,
            "reference": self.reference,
            "compared": len(self.cells),
            "identical": self.identical,
            "mismatches": len(self.mismatches),
            "not_run": self.not_run,
            "not_in_reference": self.not_in_reference,
            "cells": records_of(self.cells),
            "notes": list(self.notes),
        }

    def main_table(self) -> Table:
        """Return one row for each comparison."""
        return Table.of_frame(self.cells)

    def to_frame(self) -> pd.DataFrame:
        """Return one row for each comparison."""
        return self.cells

    def sections(self) -> list[Section]:
        """Return a summary, and the cells that differ."""
        listed = [Section(table=Table.of_frame(_listing(self.mismatches)))] if len(self.mismatches) else []
        notes = [Section(notes=[f"Note: {note}" for note in self.notes])] if self.notes else []
        return [Section(sentences=[self._summary()]), *listed, *notes]

    def _summary(self) -> str:
        """Return what was compared, and by which test."""
        least, most = self.cells["n"].min(), self.cells["n"].max()
        sizes = count(most, "data set") if least == most else f"{least} to {count(most, 'data set')}"
        text = f"{self.verdict} with {self.reference}, {self.identical} with the same counts, from {sizes} a cell."
        text += f" Fisher's exact test, Holm's correction: a chance of at most {100 * LEVEL:g} % of any false alarm."
        text += f" Not run, so not compared: {count(self.not_run, 'cell')}." if self.not_run else ""
        if self.not_in_reference:
            text += f" Not in {self.reference}, but run: {count(self.not_in_reference, 'cell')}."
        return text


@reported("comparing the tables")
def check_tables(names: Sequence[str], out: Path) -> ComparisonResult:
    """Compare tables of a results folder with the committed ones."""
    file, tables = committed_tables(), build_tables(names, out)
    if file is None:
        raise UsageError("there are no committed tables here to compare with")
    notes = list(tables.remarks)
    if maker := made_by(file.parent):
        notes.append(f"the percentages in {shown_path(file)} were {maker}")
    found = compare(pd.DataFrame(tables.rows, dtype=object), read_tables(file), shown_path(file), notes)
    if found.cells.empty:
        raise UsageError("\n".join(["nothing can be compared, because none of these cells was run.", *notes]))
    return found


def compare(rows: pd.DataFrame, committed: pd.DataFrame, reference: str, notes: Sequence[str] = ()) -> ComparisonResult:
    """Compare cells of tables with committed ones: those of the same experiment, method, start and swept fields.

    Fisher's exact test, conditional on the sum of successes, holds its level for any number of data sets. Holm's
    correction limits the probability of any false difference among all cells to 1 %, however they depend on each other.
    With the same seed both sides share their data, and agree even better than assumed.
    """
    settings = list(dict.fromkeys([*settings_of(rows), *settings_of(committed)]))
    keys = ["experiment", "method", "initial_delay", *settings]
    fresh, known = (_cells_run(side, keys) for side in (rows, committed))
    tables = rows["table"].astype(str).unique()
    expected = known[known["table"].astype(str).isin(tables) | known["experiment"].isin(tables)]
    counts = known[[*keys, "n", "converged"]].rename(columns={name: f"reference_{name}" for name in ("n", "converged")})
    cells = tested(fresh.merge(counts, on=keys))
    not_run = len(expected) - len(expected.merge(fresh[keys], on=keys))
    columns = ["table", "experiment", "sampling", *settings, "initial_delay", "method", *COMPARED]
    return ComparisonResult(cells[columns], reference, not_run, len(fresh) - len(cells), notes)


def _cells_run(frame: pd.DataFrame, keys: Sequence[str]) -> pd.DataFrame:
    """Return every cell with estimates once: one without a start is in several tables."""
    frame = frame.reindex(columns=list(dict.fromkeys([*frame.columns, *keys]))).astype(dict.fromkeys(keys, object))
    return frame[(frame["n"] > 0) & frame["converged"].notna()].drop_duplicates(keys)


def tested(cells: pd.DataFrame) -> pd.DataFrame:
    """Return cells with Fisher's exact test of their counts against those of the reference."""
    cells = cells.astype(dict.fromkeys(COUNTS, "int64"))
    p_values = [fisher(*counts) for counts in cells[[*COUNTS]].itertuples(index=False)]
    adjusted = np.array(holm(p_values))
    return cells.assign(
        percent=100 * cells["converged"] / cells["n"],
        reference_percent=100 * cells["reference_converged"] / cells["reference_n"],
        p_value=p_values,
        adjusted_p_value=adjusted,
        differs=adjusted < LEVEL,
    )


def _listing(cells: pd.DataFrame) -> pd.DataFrame:
    """Return the cells that differ with both percentages."""
    rows = records_of(cells)
    texts: dict[str, Any] = {
        "ours %": [percent(row["percent"], row["n"]) for row in rows],
        "n": cells["n"],
        "reference %": [percent(row["reference_percent"], row["reference_n"]) for row in rows],
        "reference n": cells["reference_n"],
        "p": [number(row["p_value"], 2) for row in rows],
    }
    labels = cells[["table", "sampling"]].astype(str).join(labels_of(cells, "method", options=COMPARED))
    return labels.assign(**texts)
