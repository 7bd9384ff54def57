"""The result of ``ctid accuracy``: standard errors that the estimators of an experiment can reach."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
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


@dataclass(frozen=True)
class Expectation:
    """Standard errors of one estimator on one kind of data by theory, with its formula, or the reason for none."""

    #: Swept settings besides the number of samples.
    settings: Mapping[str, Any]
    samples: int
    estimator: str
    #: Swept options of the estimator.
    options: Mapping[str, Any]
    kind: str
    #: Whether standard errors fall with the square root of the number of samples.
    scales: bool = False
    formula: str = ""
    reason: str = ""
    #: ``name``, ``value``, ``standard_error``, ``relative_percent``, ``half_width_95`` of each parameter.
    parameters: Sequence[Mapping[str, Any]] = ()

    @property
    def where(self) -> str:
        """Swept settings in words."""
        return _words(self.settings)

    @property
    def title(self) -> str:
        """Name of the estimator with its swept options and its kind."""
        name = f"{self.estimator} with {_words(self.options)}" if self.options else self.estimator
        return name if name == self.kind else f"{name} ({self.kind})"


@dataclass(frozen=True, eq=False)
class AccuracyResult(Result):
    """Expected accuracy of all estimators of an experiment, and what its stored results show beside it."""

    experiment: str
    estimates: Sequence[Expectation]
    #: Number of combinations of swept settings that are not shown.
    left_out: int
    #: None where the experiment has no stored results.
    surprises: Sequence[str] | None

    def sections(self) -> list[Section]:
        """Return tables of standard errors, the formulas that they come from, and what is unexpected."""
        known = [each for each in self.estimates if each.parameters]
        unknown = _together((each.reason, each.title) for each in self.estimates if not each.parameters)
        reasons = [f"{listed(titles)}: no theory: {reason}." for reason, titles in unknown.items()]
        formulas = _together((each.formula, each) for each in known)
        head = f"{self.experiment}: standard errors to expect by theory. The half width is 1.96 of them, for 95 %."
        paragraphs = [*reasons, *(_formula(formula, members) for formula, members in formulas.items())]
        if self.left_out:
            more = count(self.left_out, "further combination")
            paragraphs.append(
                f"Not shown: {more} of swept settings and numbers of samples; --set gives a key one value."
            )
        return [
            Section("", [head]),
            *_tables(known),
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
            {**each.settings, "samples": each.samples, "estimator": each.estimator, **each.options, **parameter}
            for each in self.estimates
            for parameter in each.parameters
        ]
        return pd.DataFrame(rows)

    def content(self) -> dict[str, Any]:
        """Return all numbers for JSON."""
        estimates = []
        for each in self.estimates:
            empty = "reason" if each.parameters else "formula"
            estimates.append({name: value for name, value in asdict(each).items() if name != empty})
        head = {"experiment": self.experiment, "left_out": self.left_out}
        return {**head, "estimates": estimates, "surprises": self.surprises}


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


def _expectation(cell: DataCell, source: SimulatedSource, estimator: EstimatorCell, plan: Plan) -> Expectation:
    own, samples = _own(cell), source.sampling.length
    found = Expectation(own, samples, estimator.name, dict(estimator.swept), estimator.kind)
    try:
        expected = expected_accuracy(source, estimator.estimator, plan.terms)
    except BiasedError as error:
        return replace(found, reason=f"the estimate is biased, as {error}")
    except DataError as error:
        return replace(found, reason=str(error))
    of = expected.parameters
    rows = [
        {
            "name": name,
            "value": float(value),
            "standard_error": float(error),
            "relative_percent": float(100 * error / abs(value)) if value else None,
            "half_width_95": float(normal_quantile() * error),
        }
        for name, value, error in zip(of.names, of.values, of.standard_errors, strict=True)
    ]
    return replace(found, scales=expected.limit, formula=expected.formula, parameters=rows)


def _tables(known: Sequence[Expectation]) -> Iterator[Section]:
    """Return one table for each estimator and setting, and one for estimators that can do the same."""
    same: dict[tuple[str, str], tuple[Section, list[str]]] = {}
    for (where, title), members in _together(((each.where, each.title), each) for each in known).items():
        table = _table(sorted(members, key=lambda each: each.samples))
        same.setdefault((where, repr(aligned_lines(table))), (table, []))[1].append(title)
    for (where, _), (table, titles) in same.items():
        yield replace(table, title=f"{listed(titles)}: standard errors{where and f' at {where}'}")


def _table(entries: Sequence[Expectation]) -> Section:
    """Return parameters down and numbers of samples across; the last columns are about the greatest number."""
    last = pd.DataFrame(entries[-1].parameters)
    columns: dict[str, Any] = {"parameter": last["name"], "true value": last["value"]}
    columns |= {f"N = {each.samples}": [row["standard_error"] for row in each.parameters] for each in entries}
    columns |= {"relative [%]": last["relative_percent"].astype(float), "half width": last["half_width_95"]}
    formats = {name: ".3g" for name in columns if name != "true value"}
    note = [f"relative, half width: of {entries[-1].samples} samples."] if len(entries) > 1 else []
    return Section(frame=pd.DataFrame(columns), formats=formats, notes=note)


def _formula(formula: str, entries: Sequence[Expectation]) -> str:
    """Return a formula with the numbers of samples and the estimators that it is for."""
    sizes = ", ".join(map(str, sorted({entry.samples for entry in entries})))
    scaling = " Standard errors fall with the square root of N." if entries[0].scales else ""
    return f"{listed(entry.estimator for entry in entries)}, N = {sizes}: {formula}.{scaling}"


def _together(pairs: Any) -> dict[Any, list[Any]]:
    """Return the second members of pairs by the first."""
    found: dict[Any, list[Any]] = {}
    for key, value in pairs:
        found.setdefault(key, []).append(value)
    return found


def _words(settings: Mapping[str, Any]) -> str:
    return ", ".join(f"{setting_title(key)} {setting_text(key, value)}" for key, value in settings.items())
