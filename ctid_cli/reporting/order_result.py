"""Result of ``ctid order``: the structures from which a model is chosen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ctid_cli.estimators.additive_output_error import AdditiveOutputError
from ctid_cli.identification.choice import Candidate, Choice, Given, Searched
from ctid_cli.identification.sentences import spelled
from ctid_cli.identification.validation import CandidateDiagnostics, diagnosed
from ctid_cli.reporting.document import Column, Result, Section, Table
from ctid_cli.reporting.figures.style import LOOKS, MARK, Drawing, name_axes, plain
from ctid_cli.reporting.layout import picked
from ctid_cli.reporting.records import Records
from ctid_cli.text import count

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Most rows of the printed table.
ROWS = 12
STRUCTURE = ("poles", "zeros", "integrators")
#: Mark of a structure that cannot be chosen, and its meaning.
NO_CANDIDATE = "no"
ABOUT_NO_CANDIDATE = (
    "- Structures marked no are not chosen: a pole ran to infinity, so that they are smaller ones; a pair of poles "
    "without damping may follow an oscillation of the noise; or a zero nearly cancels the integrator."
)
ABOUT_HELD_BACK = (
    "- Held-back fit: ten blocks of the record, each predicted by a fit without its outputs. Difference: mean "
    "logarithm of the ratio of their mean squared errors to those of the structure of least criterion. The smallest "
    "structure whose difference is at most its error, a standard error, is chosen; after a few changes of the "
    "input blocks decide on the integrator only."
)
#: Fit of held-back blocks, and difference of their errors from those of the structure that they are compared with.
HELD_BACK = ("held_back_percent", "held_back_difference", "held_back_error")
#: Columns that identify a sum of second-order submodels.
OF_A_SUM = ("modes", "integrators")


@dataclass(frozen=True, eq=False)
class OrderSearchResult(Result):
    """Structures of a choice with the records to which they were fitted."""

    schema = "ctid-order-1"

    choice: Choice
    candidates: Sequence[CandidateDiagnostics]
    records: Records

    @classmethod
    def of(cls, choice: Choice, given: Given, records: Records) -> OrderSearchResult:
        """Return the structures of a choice with their diagnostics."""
        return cls(choice, diagnosed(choice, given, records.validation_record), records)

    def sections(self) -> list[Section]:
        """Return the choice, the best structures, and the other choices."""
        choice = self.choice
        verdict = f"Chosen: {spelled(choice.taken.options)}." if choice.has_model else choice.why_no_model
        notes = [f"- {note}" for note in (*choice.sentences, *self.records.notes)]
        if any(each.held_back is not None for each in choice.ranking.candidates):
            notes.append(ABOUT_HELD_BACK)
        if any(not each.candidate.is_proper for each in self.candidates[:ROWS]):
            notes.append(ABOUT_NO_CANDIDATE)
        if len(self.candidates) > ROWS:
            notes.append(f"- The best {ROWS} of {len(self.candidates)} structures; all are in order.json.")
        return [
            Section("", [self.records.line, verdict]),
            Section(table=self._table(ROWS), drawing=self.drawing()),
            Section("", notes),
        ]

    def drawing(self) -> Drawing:
        """Return the figure of error and criterion of each structure."""
        return Drawing(10.0, 3.7, self._draw)

    def _draw(self, figure: Figure) -> None:
        """Draw error, criterion and held-back errors over all poles; open marks with an integrator."""
        error, criterion, held = figure.subplots(1, 3)
        best, taken = self.choice.ranking.best, self.choice.taken
        is_sum = isinstance(best.options, AdditiveOutputError)
        by_size = sorted(self.choice.ranking.candidates, key=lambda each: each.options.order)
        lines: dict[tuple[int, int], list[Candidate]] = {}
        for each in by_size:
            # All sums share one line.
            lines.setdefault((0 if is_sum else each.options.zeros, each.options.integrators), []).append(each)
        for (zeros, integrators), own in sorted(lines.items()):
            poles = [each.options.order for each in own]
            look = dict(LOOKS[zeros % len(LOOKS)], markersize=5, linewidth=1.0)
            look |= {"fillstyle": "none", "linestyle": ":"} if integrators else {}
            label = "second-order submodels" if is_sum else count(zeros, "zero")
            label += ", integrator" * bool(integrators)
            error.plot(poles, np.sqrt([each.fit.cost for each in own]), label=label, **look)
            criterion.plot(poles, [each.criterion - best.criterion for each in own], label=label, **look)
        chosen: dict[str, Any] = {"color": MARK, "markersize": 13, "fillstyle": "none", "label": "chosen"}
        if self.choice.has_model:
            criterion.plot(taken.options.order, taken.criterion - best.criterion, "o", **chosen)
        error.set_yscale("log")
        # Linear for small differences, logarithmic beyond.
        criterion.set_yscale("symlog", linthresh=10.0)
        for each in by_size:
            if each.held_back is not None:
                judged = each.held_back
                look = dict(LOOKS[0 if is_sum else each.options.zeros % len(LOOKS)], markersize=5, linestyle="none")
                look |= {"fillstyle": "none"} if each.options.integrators else {}
                # Beside each other with and without an integrator.
                at = each.options.order + 0.15 * each.options.integrators
                held.errorbar(at, judged.difference, judged.standard_error, capsize=2, **look)
                if self.choice.has_model and each.fit is taken.fit:
                    held.plot(at, judged.difference, "o", **(chosen | {"label": None}))
        held.axhline(0.0, color="0.7", linewidth=0.8, zorder=0)
        named = (
            (error, "root mean square output error"),
            (criterion, "criterion above the least"),
            (held, "held-back errors, log ratio"),
        )
        for axes, name in named:
            name_axes(axes, "poles, integrators included", name)
            axes.set_xticks(sorted({each.options.order for each in by_size}))
        handles, labels = criterion.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 6), frameon=False)
        names = ", ".join(Path(each.record.name).name for each in self.records.measurements)
        error.set_title(plain(names), loc="left")

    def main_table(self) -> Table:
        """Return one row for each structure, the best first; the criterion is relative to that of the first row."""
        return replace(self._table(), is_named=True)

    def _table(self, most: int | None = None) -> Table:
        """Return the best structures."""
        names = OF_A_SUM if isinstance(self.choice.options, AdditiveOutputError) else STRUCTURE
        columns = (
            Column("chosen"),
            *(Column(name) for name in names),
            Column("criterion_above_least", "criterion", "+.1f"),
            Column("fit_percent", "fit %", ".2f"),
            Column("held_back_percent", "held-back fit %", ".2f"),
            Column("held_back_difference", "difference", "+.2f"),
            Column("held_back_error", "its error", ".2f"),
            Column("validation_percent", "validation %", ".2f"),
            Column("delay", form=".4g", unit=self.records.units.time),
        )
        rows = [self._content(each) for each in self.candidates[:most]]
        taken = self.choice.taken.fit if self.choice.has_model else None
        marks = [
            "*" if each.candidate.fit is taken else NO_CANDIDATE * (not each.candidate.is_proper)
            for each in self.candidates[:most]
        ]
        marked = [row | {"chosen": mark} for row, mark in zip(rows, marks, strict=True)]
        return Table.of(marked, columns)

    def content(self) -> dict[str, Any]:
        """Return the structures for ``order.json``."""
        choice = self.choice
        return {
            **self.records.content(),
            "recommended": _structure(choice.taken.options) if choice.has_model else None,
            "reason": " ".join(choice.sentences) if choice.has_model else choice.why_no_model,
            "choices": choice.sentences,
            "command": choice.words(),
            "noise_order": choice.ranking.noise.order,
            "answer_p_value": choice.answer.p_value,
            "orders": [self._content(each) for each in self.candidates],
        }

    def _content(self, each: CandidateDiagnostics) -> dict[str, Any]:
        fit, criteria, least = each.candidate.fit, each.candidate.criteria, self.choice.ranking.best
        tested = bool(each.tests)
        return {
            **_structure(each.candidate.options),
            "poles_at_infinity": fit.poles_at_infinity,
            "status": fit.status.name,
            **picked(fit.model, ("numerator", "denominator", "delay")),
            **picked(fit, ("cost", "fit_percent")),
            **picked(each, ("cross_validated_percent", "validation_percent")),
            "criterion": each.candidate.criterion,
            "criterion_above_least": each.candidate.criterion - least.criterion,
            **picked(criteria, ("aicc", "bic", "fpe")),
            "bic_above_least": criteria.bic - least.criteria.bic if criteria and least.criteria else None,
            **dict(zip(HELD_BACK, (each.candidate.held_back or (None,) * 4)[:3], strict=True)),
            "yic": each.yic,
            "white": all(test.white for test in each.tests) if tested else None,
            "independent": all(test.uncorrelated for test in each.tests) if tested else None,
            "condition_number": fit.condition_number,
            "starts_tried": fit.starts and fit.starts.tried,
            "starts_agree": fit.starts and fit.starts.agree,
        }


def _structure(options: Searched) -> dict[str, Any]:
    """Return the numbers that identify a structure, and the terms of a sum."""
    if isinstance(options, AdditiveOutputError):
        terms = [asdict(term) for term in options.terms]
        return {"modes": len(terms), "integrators": options.integrators, "terms": terms}
    return picked(options, STRUCTURE)
