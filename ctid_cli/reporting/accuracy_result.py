"""Result of ``ctid accuracy``: standard errors that the estimators of an experiment can reach."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import pandas as pd

from ctid_cli.inference.monte_carlo_tests import FEWEST
from ctid_cli.reporting.document import Column, Result, Section, Table, aligned_lines
from ctid_cli.reporting.layout import setting_text, setting_title
from ctid_cli.reporting.results import Results
from ctid_cli.reporting.surprises import surprises
from ctid_cli.running.plan import Plan
from ctid_cli.running.theory import expectations
from ctid_cli.text import count, listed

#: Assumptions of all standard errors.
REMARK = (
    "Valid to first order in the noise, if the estimator converges to the right solution. The noise is taken as "
    "specified, and the system as initially at rest; estimated initial states and offsets are not included."
)
#: Columns of the tables.
COLUMNS = (
    Column("samples", "N"),
    Column("name", "parameter"),
    Column("value", "true value"),
    Column("standard_error", "std error", ".3g"),
    Column("relative_percent", "rel. %", ".3g"),
    Column("half_width_95", "half width", ".3g"),
)


@dataclass(frozen=True, eq=False)
class AccuracyResult(Result):
    """Expected accuracy of all estimators of an experiment, compared with its stored results."""

    schema = "ctid-accuracy-1"

    experiment: str
    #: For each estimator, setting and number of samples: the standard errors by theory and their formula, or the reason
    #: why there are none.
    estimates: Sequence[Mapping[str, Any]]
    #: Number of combinations of swept settings that are not shown.
    left_out: int
    #: None if no setting has enough stored data sets for a comparison.
    surprises: Sequence[str] | None
    #: Greatest number of stored data sets of a setting; 0 without results.
    data_sets: int = 0

    @classmethod
    def of(cls, plan: Plan, results: Results | None = None) -> AccuracyResult:
        """Return the expected accuracy of every estimator of an experiment, compared with its results."""
        estimates, left_out = expectations(plan)
        most = 0 if results is None else max(cell["replicates"] for cell in results.manifest["data_cells"])
        found = surprises(results) if results is not None and most >= FEWEST else None
        return cls(plan.experiment, estimates, left_out, found, most)

    def sections(self) -> list[Section]:
        """Return tables of standard errors, their formulas, and unexpected results."""
        frame = pd.DataFrame(self.estimates).assign(title=[_title(each) for each in self.estimates])
        frame = frame.reindex(columns=list(dict.fromkeys([*frame, "formula", "reason"])))
        unknown = frame.groupby("reason", sort=False)["title"]
        paragraphs = [f"{listed(titles)}: no standard errors: {reason}." for reason, titles in unknown]
        paragraphs += [_formula(str(formula), own) for formula, own in frame.groupby("formula", sort=False)]
        if self.left_out:
            more = count(self.left_out, "further combination")
            paragraphs.append(
                f"Not shown: {more} of swept settings and numbers of samples; --set gives a key one value."
            )
        head = f"{self.experiment}: standard errors by theory. Half width of a 95 % interval: 1.96 standard errors."
        return [
            Section("", [head]),
            *_tables(self.estimates),
            *(Section("", [paragraph]) for paragraph in paragraphs),
            self._surprises(),
            Section("", [REMARK]),
        ]

    def _surprises(self) -> Section:
        if self.surprises is None:
            few = f"Stored estimates are compared with theory only from {FEWEST} data sets of a setting on."
            return Section("", [few] if self.data_sets else [])
        if not self.surprises:
            agree = f"The stored estimates are as expected; those of fewer than {FEWEST} data sets are not compared."
            return Section("", [agree])
        return Section("Unexpected in the stored estimates:", [f"- {text}" for text in self.surprises])

    def main_table(self) -> Table:
        """Return one row for each parameter of each estimator, setting and number of samples."""
        rows = [
            {**e["settings"], "samples": e["samples"], "estimator": e["estimator"], **e["options"], **parameter}
            for e in self.estimates
            for parameter in e["parameters"]
        ]
        return Table.of_rows(rows)

    def content(self) -> dict[str, Any]:
        """Return all numbers for JSON."""
        head = {"experiment": self.experiment, "left_out": self.left_out}
        return {**head, "estimates": self.estimates, "surprises": self.surprises}


def _tables(estimates: Sequence[Mapping[str, Any]]) -> Iterator[Section]:
    """Yield a table for each setting, one for all estimators with the same standard errors."""
    tables: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for each in estimates:
        rows = [{"samples": each["samples"], **parameter} for parameter in each["parameters"]]
        if rows:
            tables.setdefault((_words(each["settings"]), _title(each)), []).extend(rows)
    same: dict[tuple[str, str], tuple[Table, list[str]]] = {}
    for (where, title), rows in tables.items():
        table = Table.of(rows, COLUMNS)
        same.setdefault((where, repr(aligned_lines(table))), (table, []))[1].append(title)
    for (where, _), (table, titles) in same.items():
        yield Section(f"{listed(titles)}: standard errors{where and f' at {where}'}", table=table)


def _formula(formula: str, entries: pd.DataFrame) -> str:
    """Return a formula with the numbers of samples and the estimators for which it holds."""
    sizes = ", ".join(map(str, sorted(set(entries["samples"]))))
    scaling = " Standard errors fall with the square root of N." if entries["scales"].iloc[0] else ""
    return f"{listed(entries['estimator'])}, N = {sizes}: {formula}.{scaling}"


def _title(estimate: Mapping[str, Any]) -> str:
    """Return the name of an estimator with its swept options and its kind."""
    name, options, kind = (estimate[key] for key in ("estimator", "options", "kind"))
    name = f"{name} with {_words(options)}" if options else name
    return name if name == kind else f"{name} ({kind})"


def _words(settings: Mapping[str, Any]) -> str:
    return ", ".join(f"{setting_title(key)} {setting_text(key, value)}" for key, value in settings.items())
