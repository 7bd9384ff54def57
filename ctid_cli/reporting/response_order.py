"""Result of ``ctid order`` on a frequency response: the structures from which a model is chosen."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ctid_cli.identification.choose_response import ResponseChoice
from ctid_cli.identification.response_structures import Judged, spelled
from ctid_cli.reporting.document import Column, Result, Section, Table
from ctid_cli.reporting.figures.style import LOOKS, MARK, Drawing, name_axes, plain
from ctid_cli.reporting.layout import picked
from ctid_cli.reporting.pages.page import shown
from ctid_cli.text import count, probability

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Most rows of the printed table.
ROWS = 12
#: Marks of the chosen structure and of one that cannot be chosen.
TAKEN, EXCLUDED = "*", "no"
ABOUT_EXCLUDED = (
    "- Structures marked no are excluded: the data do not determine their parameters, or a pair of poles stopped at "
    "the least damping or the highest frequency that is allowed, and follows single lines."
)
ABOUT_HELD_BACK = (
    "- held back: mean squared error of lines that are held back, over that of the best fit; difference: mean "
    "logarithm of its ratio to that of the structure of least criterion over blocks of lines, with its standard error. "
    "The smallest structure with a difference of at most its standard error is chosen."
)
STRUCTURE = ("poles", "zeros", "integrators")


@dataclass(frozen=True, eq=False)
class ResponseOrder(Result):
    """Structures of a choice for a frequency response."""

    schema = "ctid-order-response-1"

    choice: ResponseChoice

    @property
    def rows(self) -> list[Judged]:
        """Structures, those with errors of held-back lines among the first."""
        judged = self.choice.judged
        return [*judged[:ROWS], *(each for each in judged[ROWS:] if each.held_back == each.held_back)]

    @property
    def _no_model(self) -> str:
        p_value = probability(self.choice.answer.p_value)
        return "" if self.choice.answer.seen else f"No model: the values do not differ from noise ({p_value})."

    def sections(self) -> list[Section]:
        """Return the choice, the best structures, and the other choices."""
        choice, data = self.choice, self.choice.data
        low, high = data.frequencies[[0, -1]]
        name, lines = shown(data.name) or "frequency response", count(data.frequencies.size, "line")
        about = f"{name}: {lines} from {low:.6g} to {high:.6g} rad/{data.units[0]}"
        verdict = self._no_model or f"Chosen: {spelled(choice.options)}."
        notes = [f"- {note}" for note in (*choice.sentences, *(f"{text}." for text in choice.missed), *data.notes)]
        rows = self.rows
        notes += [ABOUT_HELD_BACK] * any(each.held_back == each.held_back for each in rows)
        notes += [ABOUT_EXCLUDED] * any(not each.admissible for each in rows)
        left = f"- The best {ROWS} of {len(choice.judged)} structures, and those compared on held-back lines"
        notes += [f"{left}; all are in order.json."] * (len(choice.judged) > ROWS)
        table = Section(table=self._table(rows), drawing=self.drawing())
        return [Section("", [about, verdict]), table, Section("", notes)]

    def main_table(self) -> Table:
        """Return one row for each structure, that of least criterion first."""
        return replace(self._table(list(self.choice.judged)), is_named=True)

    def _table(self, rows: list[Judged]) -> Table:
        columns = (
            Column("chosen"),
            *(Column(name) for name in STRUCTURE),
            Column("criterion_above_least", "criterion", "+.1f"),
            Column("fit_percent", "fit %", ".2f"),
            Column("held_back_ratio", "held back", ".3g"),
            Column("difference", form="+.3f"),
            Column("difference_standard_error", "std. error", ".3f"),
            Column("delay", form=".4g", unit=self.choice.data.units[0]),
        )
        # A dash for structures without a delay.
        delays = [each.fit.model.delay if each.options.delay_bounds[1] else None for each in rows]
        marks = [{"chosen": self._mark(each), "delay": tau} for each, tau in zip(rows, delays, strict=True)]
        return Table.of([self._content(each) | own for each, own in zip(rows, marks, strict=True)], columns)

    def _mark(self, each: Judged) -> str:
        if each.taken and not self._no_model:
            return TAKEN
        return "" if each.admissible else EXCLUDED

    def drawing(self) -> Drawing:
        """Return the figure of error and criterion of each structure."""
        return Drawing(7.5, 3.7, self._draw)

    def _draw(self, figure: Figure) -> None:
        """Draw error and criterion over all poles: a line for each number of zeros, dotted with an integrator."""
        error, criterion = figure.subplots(1, 2)
        judged, least = self.choice.judged, self.choice.judged[0].criterion
        lines: dict[tuple[int, int], dict[int, Judged]] = {}
        # Of those with and without a delay the better one.
        for each in reversed(judged):
            lines.setdefault((each.options.zeros, each.options.integrators), {})[each.order] = each
        for (zeros, integrators), found in sorted(lines.items()):
            own = [found[order] for order in sorted(found)]
            look = dict(LOOKS[zeros % len(LOOKS)], markersize=5, linewidth=1.0)
            look |= {"fillstyle": "none", "linestyle": ":"} if integrators else {}
            label = count(zeros, "zero") + ", integrator" * bool(integrators)
            poles = [each.order for each in own]
            error.plot(poles, np.sqrt([each.fit.cost for each in own]), label=label, **look)
            criterion.plot(poles, [each.criterion - least for each in own], label=label, **look)
        if not self._no_model:
            taken, mark = self.choice.taken, {"color": MARK, "markersize": 13, "fillstyle": "none", "label": "chosen"}
            criterion.plot(taken.order, taken.criterion - least, "o", **mark)
        error.set_yscale("log")
        # Linear for small differences, logarithmic beyond.
        criterion.set_yscale("symlog", linthresh=10.0)
        for axes, name in ((error, "root mean square weighted error"), (criterion, "criterion above the least")):
            name_axes(axes, "poles, integrators included", name)
            axes.set_xticks(sorted({each.order for each in judged}))
        handles, labels = criterion.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 6), frameon=False)
        error.set_title(plain(shown(self.choice.data.name)), loc="left")

    def content(self) -> dict[str, Any]:
        """Return the structures for ``order.json``."""
        choice, data = self.choice, self.choice.data
        reason = self._no_model
        return {
            "file": data.name,
            "lines": data.frequencies.size,
            "units": dict(zip(("time", "output", "input"), data.units, strict=True)),
            "recommended": None if reason else picked(choice.options, STRUCTURE),
            "reason": reason or " ".join(choice.sentences),
            "choices": choice.sentences,
            "missed_peaks": choice.missed,
            "command": choice.words(),
            "noise_order": choice.noise_order,
            "answer_p_value": choice.answer.p_value,
            "orders": [self._content(each) for each in choice.judged],
        }

    def _content(self, each: Judged) -> dict[str, Any]:
        fit = each.fit
        return {
            **picked(each.options, STRUCTURE),
            "delay_bounds": list(each.options.delay_bounds),
            "poles_at_infinity": fit.poles_at_infinity,
            "status": fit.status.name,
            **picked(fit.model, ("numerator", "denominator", "delay")),
            **picked(fit, ("cost", "fit_percent")),
            "criterion": each.criterion,
            "criterion_above_least": each.criterion - self.choice.judged[0].criterion,
            "admissible": each.admissible,
            "held_back_ratio": each.held_back,
            "difference": each.difference,
            "difference_standard_error": each.standard_error,
            "taken": each.taken,
            "condition_number": fit.condition_number,
        }
