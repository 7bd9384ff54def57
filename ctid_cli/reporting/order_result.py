"""The result of ``ctid order``: the structures that were fitted to a record, and the one to take."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from ctid_cli.estimators.order_search import FittedOrder, OrderSearch
from ctid_cli.reporting.document import Result, Section
from ctid_cli.reporting.figures.style import Drawing
from ctid_cli.reporting.layout import picked
from ctid_cli.reporting.order_plot import order_drawing
from ctid_cli.reporting.records import Records
from ctid_cli.text import count, listed

#: Rows of the printed table.
ROWS = 12
FORMATS = {
    **dict.fromkeys(("fit %", "by blocks %", "validation %"), ".2f"),
    **dict.fromkeys(("BIC", "AICc"), "+.1f"),
    "FPE": ".5g",
    "YIC": ".4g",
    "condition": ".1e",
}


@dataclass(frozen=True, eq=False)
class OrderSearchResult(Result):
    """An order search with the records that it was made on."""

    found: OrderSearch
    records: Records
    #: How the range of the delay was chosen; empty where it was given.
    delay_choice: str = ""

    def sections(self) -> list[Section]:
        """Return the recommendation, the best structures, and notes."""
        found, best = self.found, self.found.recommended
        head = f"{self.records.line}, {count(len(found.orders), 'structure')}"
        verdict = found.reason if best is None else f"Recommended: {spelled(best)}. {found.reason}"
        formats = FORMATS | {f"delay [{self.records.units.time}]": ".4g"}
        notes = [f"- {note}" for note in self._notes()]
        table = Section(frame=self.to_frame().head(ROWS), formats=formats, drawing=self.drawing())
        return [Section("", [head, verdict]), table, Section("", notes)]

    def drawing(self) -> Drawing:
        """Return the figure of what each structure gains."""
        title = ", ".join(Path(each.record.name).name for each in self.records.measurements)
        return order_drawing(self.found, title)

    def _notes(self) -> list[str]:
        found, notes = self.found, self.records.notes
        if found.noise.order:
            notes.append(
                "The residuals are not white: the criteria are of the innovations, with one autoregressive noise model "
                f"of order {found.noise.order} for all."
            )
        lost = [each.name for each in found.orders[:ROWS] if each.fit.poles_at_infinity]
        if lost:
            notes.append(f"A pole of {listed(lost)} runs to infinity: the model is one with fewer poles.")
        if len(found.orders) > ROWS:
            notes.append(f"The {ROWS} structures of least BIC of {len(found.orders)}; all are in order.json.")
        return [*notes, self.delay_choice] if self.delay_choice else notes

    def to_frame(self) -> pd.DataFrame:
        """Return one row for each structure, the least BIC first; criteria relative to those of the first row."""
        frame = pd.DataFrame([self._row(each) for each in self.found.orders]).set_index("poles/zeros")
        return frame if self.records.validation else frame.drop(columns="validation %")

    def _row(self, each: FittedOrder) -> dict[str, Any]:
        fit, criteria, least = each.fit, each.criteria, self.found.best.criteria
        tested = bool(each.tests)
        return {
            "poles/zeros": each.name,
            "fit %": fit.fit_percent,
            "by blocks %": each.cross_validated_percent,
            "validation %": each.validation_percent,
            "BIC": criteria.bic - least.bic,
            "AICc": criteria.aicc - least.aicc,
            "FPE": criteria.fpe / least.fpe if least.fpe > 0 else None,
            "YIC": each.yic,
            "white": each.white if tested else None,
            "independent": each.independent if tested else None,
            "condition": fit.condition_number,
            "starts": f"{fit.starts.agree}/{fit.starts.tried}" if fit.starts else None,
            f"delay [{self.records.units.time}]": fit.model.delay,
        }

    def content(self) -> dict[str, Any]:
        """Return the order search for ``order.json``."""
        found, best = self.found, self.found.recommended
        return {
            **self.records.content(),
            "recommended": best and picked(best.options, ("poles", "zeros")),
            "reason": found.reason,
            "noise_order": found.noise.order,
            "bic_of_none": found.bic_of_none,
            "answer_p_value": found.answer.p_value,
            "orders": [self._content(each) for each in found.orders],
        }

    def _content(self, each: FittedOrder) -> dict[str, Any]:
        fit, criteria = each.fit, each.criteria
        return {
            **picked(each.options, ("poles", "zeros")),
            "poles_at_infinity": fit.poles_at_infinity,
            "status": fit.status.name,
            **picked(fit.model, ("numerator", "denominator", "delay")),
            **picked(fit, ("cost", "fit_percent")),
            **picked(each, ("cross_validated_percent", "validation_percent")),
            **picked(criteria, ("aicc", "bic")),
            "bic_above_least": criteria.bic - self.found.best.criteria.bic,
            "fpe": criteria.fpe,
            "yic": each.yic,
            "white": each.white if each.tests else None,
            "independent": each.independent if each.tests else None,
            "condition_number": fit.condition_number,
            "starts_tried": fit.starts and fit.starts.tried,
            "starts_agree": fit.starts and fit.starts.agree,
        }


def spelled(each: FittedOrder) -> str:
    """Return a structure in words."""
    zeros = each.options.zeros
    integrators = each.options.integrators
    besides = f" and {count(integrators, 'integrator')}" * (integrators > 0)
    return f"{count(each.options.poles, 'pole')}, {count(zeros, 'zero') if zeros else 'no zero'}{besides}"
