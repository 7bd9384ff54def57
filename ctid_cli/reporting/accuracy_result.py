"""The result of ``ctid accuracy``: standard errors that the estimators of an experiment can reach."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from ctid_cli.errors import BiasedError, DataError, UsageError
from ctid_cli.inference.intervals import normal_quantile
from ctid_cli.reporting.document import Result, Section, aligned_lines
from ctid_cli.reporting.layout import setting_text, setting_title
from ctid_cli.reporting.results import Results
from ctid_cli.reporting.surprises import FEWEST, surprises
from ctid_cli.running.job import DataCell, EstimatorCell
from ctid_cli.running.plan import Plan
from ctid_cli.simulation.dataset import SimulatedSource
from ctid_cli.simulation.expected_accuracy import expected_accuracy
from ctid_cli.text import count, listed

#: On what all of it rests.
REMARK = (
    "This is to first order in the noise, where the estimator converges to the right solution; it takes the noise to "
    "be as specified and the system to be at rest, and does not count initial states and offsets."
)
#: Different numbers of samples that are shown, of all that are swept.
SIZES = 4
#: Combinations of the other swept settings that are shown.
SETTINGS = 6


@dataclass(frozen=True, eq=False)
class AccuracyResult(Result):
    """Expected accuracy of all estimators of an experiment, and what its stored results show beside it."""

    schema = "ctid-accuracy-1"

    experiment: str
    #: Of each estimator, setting and number of samples: the standard errors by theory and their formula, or the reason
    #: why there are none.
    estimates: Sequence[Mapping[str, Any]]
    #: Number of combinations of swept settings that are not shown.
    left_out: int
    #: None where the experiment has no stored results.
    surprises: Sequence[str] | None

    def sections(self) -> list[Section]:
        """Return tables of standard errors, the formulas that they come from, and what is unexpected."""
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
        if not self.surprises:
            agree = f"The stored estimates are as expected; those of fewer than {FEWEST} data sets are not compared."
            return Section("", [] if self.surprises is None else [agree])
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


def accuracy_of(plan: Plan, results: Results | None = None) -> AccuracyResult:
    """Return the expected accuracy of every estimator of an experiment, and what its results show beside it."""
    cells = [(cell, cell.source) for cell in plan.data_cells if isinstance(cell.source, SimulatedSource)]
    if not cells:
        text = f"{plan.experiment} is about a measured record, whose true system is not known; "
        raise UsageError(f"{text}its estimates carry their standard errors: ctid fit, or ctid run and ctid table")
    shown = _shown(cells)
    estimates = [_expectation(cell, source, each, plan) for cell, source in shown for each in plan.estimators]
    unexpected = None if results is None else surprises(results)
    return AccuracyResult(plan.experiment, estimates, len(cells) - len(shown), unexpected)


def _own(cell: DataCell) -> dict[str, Any]:
    """Return swept settings besides the number of samples."""
    return {name: value for name, value in cell.swept.items() if name.split(".")[-1] != "samples"}


def _shown(cells: list[tuple[DataCell, SimulatedSource]]) -> list[tuple[DataCell, SimulatedSource]]:
    """Return data cells of the first settings, each at a few numbers of samples from the least to the greatest."""
    by_settings: dict[str, dict[int, int]] = {}
    for k, (cell, source) in enumerate(cells):
        by_settings.setdefault(repr(_own(cell)), {})[source.sampling.length] = k
    shown: list[int] = []
    for places in list(by_settings.values())[:SETTINGS]:
        some = np.unique(np.linspace(0, len(places) - 1, SIZES).round().astype(int))
        shown += (places[sorted(places)[k]] for k in some)
    return [cells[k] for k in sorted(shown)]


def _expectation(cell: DataCell, source: SimulatedSource, estimator: EstimatorCell, plan: Plan) -> dict[str, Any]:
    """Return the standard errors of one estimator on one kind of data, or the reason for none."""
    about = {"settings": _own(cell), "samples": source.sampling.length, "estimator": estimator.name}
    about |= {"options": dict(estimator.swept), "kind": estimator.kind}
    try:
        expected = expected_accuracy(source, estimator.estimator, plan.terms)
    except BiasedError as error:
        return about | {"scales": False, "reason": f"the estimate is biased, as {error}", "parameters": []}
    except DataError as error:
        return about | {"scales": False, "reason": str(error), "parameters": []}
    of = expected.parameters
    rows = [
        {
            "name": name,
            "value": value,
            "standard_error": error,
            "relative_percent": 100 * error / abs(value) if value else None,
            "half_width_95": normal_quantile() * error,
        }
        for name, value, error in zip(of.names, of.values.tolist(), of.standard_errors.tolist(), strict=True)
    ]
    return about | {"scales": expected.limit, "formula": expected.formula, "parameters": rows}


def _tables(known: pd.DataFrame) -> Iterator[Section]:
    """Return one table for each estimator and setting, and one for estimators that can do the same."""
    same: dict[tuple[str, str], tuple[Section, list[str]]] = {}
    for (where, title), members in known.groupby(["where", "title"], sort=False):
        table = _table(members.sort_values("samples", kind="stable").to_dict("records"))
        same.setdefault((str(where), repr(aligned_lines(table))), (table, []))[1].append(str(title))
    for (where, _), (table, titles) in same.items():
        yield replace(table, title=f"{listed(titles)}: standard errors{where and f' at {where}'}")


def _table(entries: Sequence[Mapping[Any, Any]]) -> Section:
    """Return parameters down and numbers of samples across; the last columns are about the greatest number."""
    last = pd.DataFrame(entries[-1]["parameters"])
    columns: dict[str, Any] = {"parameter": last["name"], "true value": last["value"]}
    columns |= {f"N = {e['samples']}": [row["standard_error"] for row in e["parameters"]] for e in entries}
    columns |= {"relative [%]": last["relative_percent"].astype(float), "half width": last["half_width_95"]}
    formats = {name: ".3g" for name in columns if name != "true value"}
    note = [f"relative, half width: of {entries[-1]['samples']} samples."] if len(entries) > 1 else []
    return Section(frame=pd.DataFrame(columns), formats=formats, notes=note)


def _formula(formula: str, entries: pd.DataFrame) -> str:
    """Return a formula with the numbers of samples and the estimators that it is for."""
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
