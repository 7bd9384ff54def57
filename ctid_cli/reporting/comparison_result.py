"""Significance tests of percentages against the committed tables and the article."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from ctid_cli.errors import UsageError
from ctid_cli.inference.paired import fisher, holm, smallest_detectable
from ctid_cli.reporting.document import Result, Section
from ctid_cli.reporting.layout import number, percent
from ctid_cli.reporting.measures import records_of, settings_of
from ctid_cli.reporting.results import shown_path
from ctid_cli.reporting.study import Study, find_study
from ctid_cli.reporting.study_table import build_tables, committed_tables, made_by, read_tables
from ctid_cli.reporting.table_result import labels_of
from ctid_cli.text import count, listed

#: Probability that a check reports any difference although nothing has changed.
LEVEL = 0.01
#: Probability that a difference reported as detectable is found.
POWER = 0.8
#: Columns that a comparison adds to the keys of a cell.
COMPARED = (
    *("against", "n", "converged", "percent", "reference_n", "reference_converged", "reference_percent"),
    *("p_value", "adjusted_p_value", "detectable", "differs", "decisive", "mismatch"),
)


@dataclass(frozen=True, eq=False)
class ComparisonResult(Result):
    """Comparisons of cells of tables, a row for each, with the columns ``COMPARED`` and the keys of the cell."""

    schema = "ctid-tables-check-1"

    cells: pd.DataFrame
    reference: str | None
    not_run: int
    not_in_reference: int
    notes: Sequence[str] = ()

    @property
    def decisive(self) -> pd.DataFrame:
        """Comparisons that decide the exit code."""
        return self.cells[self.cells["decisive"]]

    @property
    def mismatches(self) -> pd.DataFrame:
        """Decisive comparisons that differ."""
        return self.cells[self.cells["mismatch"]]

    @property
    def identical(self) -> int:
        """Number of cells with the same counts as in the committed tables."""
        cells = self.cells[self.cells["against"] == "committed"]
        same = (cells["n"] == cells["reference_n"]) & (cells["converged"] == cells["reference_converged"])
        return int(same.sum())

    @property
    def verdict(self) -> str:
        """Sentence with the number of comparisons that differ."""
        wrong, compared = len(self.mismatches), count(len(self.decisive), "comparison")
        if not wrong:
            return f"No difference beyond sampling error in {compared}"
        return f"{wrong} of {compared} {'differs' if wrong == 1 else 'differ'} by more than sampling error explains"

    def content(self) -> dict[str, Any]:
        """Return the comparison for JSON."""
        return {
            "agrees": self.mismatches.empty,
            "level": LEVEL,
            "reference": self.reference,
            "compared": len(self.decisive),
            "identical": self.identical,
            "mismatches": len(self.mismatches),
            "not_run": self.not_run,
            "not_in_reference": self.not_in_reference,
            "cells": records_of(self.cells),
            "notes": list(self.notes),
        }

    def to_frame(self) -> pd.DataFrame:
        """Return one row for each comparison."""
        return self.cells

    def sections(self) -> list[Section]:
        """Return a summary, and the cells that differ."""
        wrong = self.mismatches
        information = "For information, differences from the paper that are no mismatch (reasons: the study's README):"
        parts = {
            f"Other than in {self.reference}:": wrong[wrong["against"] == "committed"],
            "Lower than in the paper:": wrong[wrong["against"] == "paper"],
            information: self.cells[self.cells["differs"] & ~self.cells["mismatch"]],
        }
        shown = [Section(sentences=[title], frame=_listing(cells)) for title, cells in parts.items() if len(cells)]
        notes = [Section(notes=[f"Note: {note}" for note in self.notes])] if self.notes else []
        return [Section(sentences=[self._summary()]), *shown, *notes]

    def _summary(self) -> str:
        """Return what was compared, by which test, and which differences it could detect."""
        cells, parts = self.decisive, []
        paper = cells[cells["against"] == "paper"]
        if len(paper) < len(cells):
            same = f"{self.identical} of them with the same counts"
            parts.append(f"{count(len(cells) - len(paper), 'cell')} with {self.reference} ({same})")
        if len(paper):
            parts.append(f"{count(len(paper), 'cell')} of {', '.join(paper['method'].unique())} with the paper")
        least, most = cells["n"].min(), cells["n"].max()
        sizes = count(most, "data set") if least == most else f"{least} to {count(most, 'data set')}"
        rule = f"Fisher's exact test, Holm's correction: a chance of at most {100 * LEVEL:g} % of any false alarm."
        text = f"{self.verdict}: {listed(parts)}, from {sizes} a cell. {rule} {_power(cells)}"
        if self.not_run:
            text += f" Not run, so not compared: {count(self.not_run, 'cell')}."
        if self.not_in_reference:
            text += f" Not in {self.reference}, but run: {count(self.not_in_reference, 'cell')}."
        return text if self.reference is not None else f"{text} There are no committed tables here to compare with."


def check_tables(names: Sequence[str], out: Path) -> ComparisonResult:
    """Compare tables of a results folder with the committed ones and with the article."""
    study, file, tables = find_study(), committed_tables(), build_tables(names, out)
    notes = list(tables.remarks)
    if file is not None and (maker := made_by(file.parent)):
        notes.append(f"the percentages in {shown_path(file)} were {maker}")
    rows = pd.DataFrame(tables.rows, dtype=object)
    committed = None if file is None else read_tables(file)
    found = compare(rows, committed, study, None if file is None else shown_path(file), notes)
    if len(found.decisive):
        return found
    if not rows["n"].any():
        raise UsageError("\n".join(["nothing can be compared, because none of these cells was run.", *notes]))
    where = "there are no committed tables" if file is None else f"{found.reference} has none of their cells"
    paper = f"of the paper's only those of {', '.join(study.must_reach)} decide"
    raise UsageError(f"the results in {out} have nothing to be compared with: {where}, and {paper}")


def compare(
    rows: pd.DataFrame,
    committed: pd.DataFrame | None,
    study: Study,
    reference: str | None = None,
    notes: Sequence[str] = (),
) -> ComparisonResult:
    """Compare cells of tables with committed ones and with the article.

    Cells are the same if experiment, method, initial delay and swept fields are. Each pair of counts is tested with
    Fisher's exact test, conditional on the sum of successes, which holds its level for any number of data sets. Holm's
    correction limits the probability of any false difference among all decisive cells to 1 %, however they depend on
    each other. With the same seed both sides share their data, and agree even better than assumed. The comparisons for
    information are corrected separately.
    """
    known = rows.iloc[:0] if committed is None else committed
    settings = list(dict.fromkeys([*settings_of(rows), *settings_of(known)]))
    fresh, known = (_keyed(side, settings) for side in (rows, known))
    known = known[(known["n"] > 0) & known["converged"].notna()]
    tables = fresh["table"].astype(str).unique()
    asked = set(known["key"][known["table"].astype(str).isin(tables) | known["experiment"].isin(tables)])
    asked |= set(fresh["key"][fresh["published_percent"].notna()])
    not_run = len(asked - set(fresh["key"][fresh["n"] > 0]))
    fresh = fresh[(fresh["n"] > 0) & fresh["converged"].notna()]
    lacking = 0 if committed is None else int((~fresh["key"].isin(known["key"])).sum())
    counts = known.set_index("key")[["n", "converged"]].add_prefix("reference_")
    beside = fresh.assign(against="committed", decisive=True).join(counts, on="key", how="inner")
    trials, paper = study.published_data_sets, fresh[fresh["published_percent"].notna()]
    published = (paper["published_percent"].astype(float) * trials / 100).round()
    decisive = paper["method"].isin(study.must_reach)
    paper = paper.assign(against="paper", decisive=decisive, reference_n=trials, reference_converged=published)
    cells = _tested(pd.concat([beside, paper]).sort_index(kind="stable").reset_index(drop=True))
    columns = ["against", "table", "experiment", "sampling", *settings, "initial_delay", "method", *COMPARED[1:]]
    return ComparisonResult(cells[columns], reference, not_run, lacking, notes)


def _keyed(frame: pd.DataFrame, settings: Sequence[str]) -> pd.DataFrame:
    """Return each cell once, with an identifier ``key`` that does not depend on the table."""
    names = ["experiment", "method", "initial_delay", *settings]
    frame = frame.reindex(columns=list(dict.fromkeys([*frame.columns, *names, "published_percent"])))
    keys = [json.dumps([_same(value) for value in row.values()]) for row in records_of(frame[names])]
    return frame.assign(key=keys).drop_duplicates("key")


def _same(value: Any) -> Any:
    """Return a number in one form for files and results."""
    return float(value) if isinstance(value, int) and not isinstance(value, bool) else value


def _tested(cells: pd.DataFrame) -> pd.DataFrame:
    """Return cells with their tests; any difference from committed tables decides, from the article a lower value."""
    counts = ["converged", "n", "reference_converged", "reference_n"]
    cells = cells.astype(dict.fromkeys(counts, "int64") | {"decisive": bool})
    cells["percent"] = 100 * cells["converged"] / cells["n"]
    cells["reference_percent"] = 100 * cells["reference_converged"] / cells["reference_n"]
    cells["p_value"] = [fisher(*four) for four in cells[counts].itertuples(index=False)]
    families = cells.groupby("decisive")["p_value"]
    cells["adjusted_p_value"] = families.transform(lambda values: holm(values.tolist()))
    cells["differs"] = cells["adjusted_p_value"] < LEVEL
    sizes, committed = families.transform("size"), cells["against"] == "committed"
    cells["detectable"] = [
        smallest_detectable(n, known, trials, LEVEL / size, rise=rise, power=POWER)
        for _, n, known, trials, size, rise in zip(*(cells[name] for name in counts), sizes, committed, strict=True)
    ]
    lower = cells["percent"] < cells["reference_percent"]
    return cells.assign(mismatch=cells["decisive"] & cells["differs"] & (committed | lower))


def _power(cells: pd.DataFrame) -> str:
    """Return which differences the comparisons could detect."""
    found = cells["detectable"].dropna()
    if found.empty:
        return "With so few data sets no difference could have been detected, however large."
    ends = " to ".join(dict.fromkeys(f"{end:.0f}" for end in (found.min(), found.max())))
    text = f"A single cell that differs by {ends} percentage points is detected with {100 * POWER:g} % probability"
    text += ", the reference taken as exact"
    blind = len(cells) - len(found)
    return f"{text}; in {count(blind, 'cell')} no difference could have been detected." if blind else f"{text}."


def _listing(cells: pd.DataFrame) -> pd.DataFrame:
    """Return the cells that differ with both percentages."""
    rows = records_of(cells)
    labels = cells[["table", "sampling"]].astype(str).join(labels_of(cells, "method", options=COMPARED))
    texts: dict[str, Any] = {
        "ours %": [percent(row["percent"], row["n"]) for row in rows],
        "n": cells["n"],
        "reference %": [percent(row["reference_percent"], row["reference_n"]) for row in rows],
        "reference n": cells["reference_n"],
        "p": [number(row["p_value"], 2) for row in rows],
    }
    return labels.assign(**texts)
