"""What a fit says of a loss other than squares: its scale, and the samples that count for little."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.estimators.delay_profile import MeasuredFit
from ctid_cli.inference.criteria import percent_from_r_squared
from ctid_cli.inference.robust_loss import Weighting
from ctid_cli.reporting.estimate import Units
from ctid_cli.reporting.layout import count, number
from ctid_cli.signals.record import Record

#: Instants that the text names.
MOST_NAMED = 5
#: What the loss does to the samples that are listed.
LITTLE = {"huber": "less than half their weight", "tukey": "no weight"}
NAMES = {"huber": "Huber's", "tukey": "Tukey's biweight"}


def loss_object(fit: MeasuredFit, records: Sequence[Record]) -> dict[str, Any]:
    """The loss for JSON."""
    if fit.weighting is None:
        return {"kind": "squares", "scales": None, "outliers": [[] for _ in records], "fit_percent": None}
    return {
        "kind": fit.weighting.kind,
        "scales": [loss.scale for loss in fit.weighting.losses],
        "outliers": _outlier_times(fit, fit.weighting, records),
        "fit_percent": _fit_percent_without(fit, fit.weighting, records),
    }


def loss_text(fit: MeasuredFit, records: Sequence[Record], units: Units) -> str:
    """The loss for people: nothing where squares count."""
    if fit.weighting is None:
        return ""
    kind, times = fit.weighting.kind, _outlier_times(fit, fit.weighting, records)
    scales = ", ".join(number(loss.scale, 3) for loss in fit.weighting.losses)
    text = f"{NAMES[kind]} (--loss {kind}), standard deviation {scales} {units.output} from the median absolute error; "
    total = sum(each.size for each in times)
    samples = f"{total} of {count(fit.count, 'sample')} {'has' if total == 1 else 'have'} {LITTLE[kind]}"
    if not total:
        return f"{text}{samples}"
    listed = []
    for k, each in enumerate(times, start=1):
        where = f" of experiment {k}" if len(records) > 1 else ""
        some = ", ".join(f"{t:.6g}" for t in each[:MOST_NAMED]) + (", ..." if each.size > MOST_NAMED else "")
        listed += [f"{some} {units.time}{where}"] * (each.size > 0)
    without = number(_fit_percent_without(fit, fit.weighting, records), 5)
    return f"{text}{samples}, at {'; '.join(listed)}; fit {without} % without them"


def _outlier_times(fit: MeasuredFit, weighting: Weighting, records: Sequence[Record]) -> list[Array]:
    """Instants of the samples of each record that count for little."""
    return [record.t[use][out] for record, use, out in zip(records, fit.used, weighting.outliers, strict=True)]


def _fit_percent_without(fit: MeasuredFit, weighting: Weighting, records: Sequence[Record]) -> float:
    """Fit over the samples that do count, means by record [%]."""
    squares = spread = 0.0
    for record, use, out, r in zip(records, fit.used, weighting.outliers, fit.residuals, strict=True):
        y = record.y[use][~out]
        squares += float(np.sum(r[~out] ** 2))
        spread += float(np.sum((y - y.mean()) ** 2))
    return percent_from_r_squared(1.0 - squares / spread)
