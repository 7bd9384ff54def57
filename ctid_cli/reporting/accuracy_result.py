"""Result of ``ctid accuracy``: standard errors that the estimators of an experiment can reach."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import pandas as pd

from ctid_cli.inference.monte_carlo_tests import FEWEST
from ctid_cli.reporting.document import Result, Section, aligned_lines
from ctid_cli.reporting.layout import setting_text, setting_title
from ctid_cli.reporting.results import Results
from ctid_cli.reporting.surprises import surprises
from ctid_cli.running.plan import Plan
from ctid_cli.running.theory import expectations
from ctid_cli.text import count, listed

#: Assumptions of all standard errors.
REMARK = (
    "This is to first order in the noise, where the estimator converges to the right solution; it takes the noise to "
    "be as specified and the system to be at rest, and does not count initial states and offsets."
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
        frame = pd.DataFrame(self.estimates).assign(
            where=[_words(each["settings"]) for each in self.estimates], title=[_title(each) for each in self.estimates]
        )
        frame = frame.reindex(columns=list(dict.fromkeys([*frame, "formula", "reason"])))
        unknown = frame.groupby("reason", sort=False)["title"]
        paragraphs = [f"{listed(titles)}: no theory: {reason}." for reason, titles in unknown]
        paragraphs += [_formula(str(formula), own) for formula, own in frame.groupby("formula", sort=False)]
        if self.left_out:
            more = count(self.left_out, "further combination")
            paragraphs.append(
                f"Not shown: {more} of swept settings and numbers of samples; --set gives a key one value."
            )
        head = f"{self.experiment}: standard errors to expect by theory. The half width is 1.96 of them, for 95 %."
        return [
            Section("", [head]),
            *_tables(frame.dropna(subset="formula")),
            *(Section("", [paragraph]) for paragraph in paragraphs),
            self._surprises(),
            Section("", [REMARK]),
        ]

    def _surprises(self) -> Section:
        if self.surprises is None:
            few = f"The stored estimates are not compared with theory: that takes {FEWEST} data sets of a setting."
            return Section("", [few] if self.data_sets else [])
        if not self.surprises:
            agree = f"The stored estimates are as expected; those of fewer than {FEWEST} data sets are not compared."
            return Section("", [agree])
        return Section("Unexpected in the stored estimates:", [f"- {text}" for text in self.surprises])

    def to_frame(self) -> pd.DataFrame:
        """Return one row for each parameter of each estimator, setting and number of samples."""
        rows = [
            {**e["settings"], "samples": e["samples"], "estimator": e["estimator"], **e["options"], **parameter}
            for e in self.estimates
            for parameter in e["parameters"]
        ]
        return pd.DataFrame(rows)

    def content(self) -> dict[str, Any]:
        """Return all numbers for JSON."""
        head = {"experiment": self.experiment, "left_out": self.left_out}
        return {**head, "estimates": self.estimates, "surprises": self.surprises}


def _tables(known: pd.DataFrame) -> Iterator[Section]:
    """Yield one table for each estimator and setting, and one for estimators of the same accuracy."""
    same: dict[tuple[str, str], tuple[Section, list[str]]] = {}
    for (where, title), members in known.groupby(["where", "title"], sort=False):
        table = _table(members.sort_values("samples", kind="stable").to_dict("records"))
        same.setdefault((str(where), repr(aligned_lines(table))), (table, []))[1].append(str(title))
    for (where, _), (table, titles) in same.items():
        yield replace(table, title=f"{listed(titles)}: standard errors{where and f' at {where}'}")


def _table(entries: Sequence[Mapping[Any, Any]]) -> Section:
    """Return parameters down and numbers of samples across; the last columns are for the greatest number."""
    last = pd.DataFrame(entries[-1]["parameters"])
    columns: dict[str, Any] = {"parameter": last["name"], "true value": last["value"]}
    columns |= {f"N = {e['samples']}": [row["standard_error"] for row in e["parameters"]] for e in entries}
    columns |= {"relative [%]": last["relative_percent"].astype(float), "half width": last["half_width_95"]}
    formats = {name: ".3g" for name in columns if name != "true value"}
    note = [f"relative, half width: of {entries[-1]['samples']} samples."] if len(entries) > 1 else []
    return Section(frame=pd.DataFrame(columns), formats=formats, notes=note)


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
