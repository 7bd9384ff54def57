"""What ``ctid order`` answers: structures side by side as text and as an object for JSON, and the one to take."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ctid_cli.canonical import plain
from ctid_cli.estimators.order_search import FittedOrder, OrderSearch
from ctid_cli.reporting.estimate import Units
from ctid_cli.reporting.layout import Report, Table, count, number, picked
from ctid_cli.reporting.records import Records
from ctid_cli.signals.measurement import Measurement
from ctid_cli.text import wrapped

#: Rows of the printed table.
ROWS = 12


def order_object(
    found: OrderSearch, measurements: Sequence[Measurement], units: Units, files: Sequence[Path] = ()
) -> dict[str, Any]:
    """An order search for ``order.json``."""
    best = found.recommended
    content = {
        **Records(measurements).content(),
        "recommended": None if best is None else {"poles": best.options.poles, "zeros": best.options.zeros},
        "reason": found.reason,
        "noise_order": found.noise.order,
        "bic_of_none": found.bic_of_none,
        "answer_p_value": found.answer.p_value,
        "orders": [_of_order(each, found.best) for each in found.orders],
        "written": [str(file) for file in files],
    }
    return dict(plain(content))


def _of_order(each: FittedOrder, best: FittedOrder) -> dict[str, Any]:
    fit = each.fit
    return {
        **picked(each.options, ("poles", "zeros")),
        "poles_at_infinity": fit.poles_at_infinity,
        "status": fit.status.name,
        **picked(fit.model, ("numerator", "denominator", "delay")),
        **picked(fit, ("cost", "fit_percent")),
        **picked(each, ("cross_validated_percent", "validation_percent")),
        **picked(each.criteria, ("aicc", "bic")),
        "bic_above_least": each.criteria.bic - best.criteria.bic,
        "fpe": each.criteria.fpe,
        "yic": each.yic,
        "white": each.white if each.tests else None,
        "independent": each.independent if each.tests else None,
        "condition_number": fit.condition_number,
        "starts_tried": fit.starts.tried if fit.starts else None,
        "starts_agree": fit.starts.agree if fit.starts else None,
    }


def order_text(found: OrderSearch, measurements: Sequence[Measurement], units: Units) -> str:
    """An order search for people."""
    best = found.recommended
    verdict = found.reason
    if best is not None:
        verdict = f"Recommended: {spelled(best)}. {found.reason}"
    notes = Records(measurements).notes
    if found.noise.order:
        notes.append(
            f"The residuals are not white: the criteria are of the innovations, with one autoregressive noise model of "
            f"order {found.noise.order} for all."
        )
    lost = [each.name for each in found.orders[:ROWS] if each.fit.poles_at_infinity]
    if lost:
        notes.append(f"* A pole runs to infinity, so that the model is one with fewer poles: {', '.join(lost)}.")
    if len(found.orders) > ROWS:
        notes.append(f"The {ROWS} structures of least BIC of {len(found.orders)}; all are in order.json.")
    head = f"{Records(measurements).line}, {count(len(found.orders), 'structure')}"
    lines = [wrapped(head), wrapped(verdict), "", Report([[_table(found, units)]]).draw()]
    return "\n".join([*lines, *([""] if notes else []), *(wrapped(f"- {note}", hanging="  ") for note in notes)])


def spelled(each: FittedOrder) -> str:
    """A structure in words."""
    zeros = each.options.zeros
    integrators = each.options.integrators
    besides = f" and {count(integrators, 'integrator')}" * (integrators > 0)
    return f"{count(each.options.poles, 'pole')}, {count(zeros, 'zero') if zeros else 'no zero'}{besides}"


def _table(found: OrderSearch, units: Units) -> Table:
    validated = found.best.validation_percent is not None
    header = ["poles/zeros", "fit %", "by blocks %", *(["validation %"] * validated), "BIC", "AICc", "FPE", "YIC"]
    header += ["white?", "input?", "condition", "starts", f"delay [{units.time}]"]
    best = found.best.criteria
    rows = []
    for each in found.orders[:ROWS]:
        fit = each.fit
        starts = f"{fit.starts.agree}/{fit.starts.tried}" if fit.starts else ""
        tested = bool(each.tests)
        rows.append(
            [
                each.name + "*" * bool(fit.poles_at_infinity),
                f"{fit.fit_percent:.2f}",
                _percent(each.cross_validated_percent),
                *([_percent(each.validation_percent)] * validated),
                f"{each.criteria.bic - best.bic:+.1f}",
                f"{each.criteria.aicc - best.aicc:+.1f}",
                number(each.criteria.fpe / best.fpe, 5) if best.fpe > 0 else "",
                number(each.yic, 4) if math.isfinite(each.yic) else "none",
                ("yes" if each.white else "no") * tested,
                ("free of it" if each.independent else "follows") * tested,
                f"{fit.condition_number:.1e}",
                starts,
                number(fit.model.delay, 4),
            ]
        )
    return Table(header, rows, "l" + "r" * (len(header) - 1))


def _percent(value: float | None) -> str:
    return "none" if value is None or not math.isfinite(value) else f"{value:.2f}"
