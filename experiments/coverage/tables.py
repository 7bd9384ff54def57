"""Published table of the study: coverage of the intervals of each row, by parameter and formula."""

from functools import cache
from typing import Any

import numpy as np
import pandas as pd

from ctid_cli.inference import monte_carlo
from ctid_cli.inference.monte_carlo import Sample
from ctid_cli.reporting.document import Section, Table
from ctid_cli.reporting.results import Results
from ctid_cli.reporting.study import last_part
from ctid_cli.running.plan import build_plan
from ctid_cli.specification.load import spec_from_canonical
from ctid_cli.studies.catalogue import StudyResults

#: Rows of the table by experiment: letter, and description of the data.
ROWS = {
    "case1-regular": ("a", "case 1, regular"),
    "case1-irregular-exact": ("b", "case 1, irregular, exact input record"),
    "first-order": ("c", "first order and delay"),
    "first-order-coloured": ("d", "first order and delay, ARMA noise"),
    "case1-irregular-sampled": ("e", "case 1, irregular, sampled input record"),
    "short-prbs": ("f", "second order, PRBS, 600 samples, slow noise"),
    "short-step": ("g", "second order, step, 600 samples, slow noise"),
}


@cache
def coverage(results: Results) -> pd.DataFrame:
    """Return coverage, ratio of standard errors and bias: one line for each formula and parameter."""
    plan = build_plan(spec_from_canonical(dict(results.settings)))
    errors = results.errors.dropna(subset="value")
    formulas = {"white": errors}
    if plan.data_cells[0].source.noise.coloured:
        # The sandwich formula is for coloured noise; the estimator stores the formula for white noise, misused here.
        formulas = {"sandwich, t": _robust(plan, errors), **formulas}
    status = results.stored.column("status")
    lines = [
        {"formula": formula, "parameter": name, "true": own["true"].iloc[0], **_measured(own)}
        for formula, found in formulas.items()
        for name, own in found.groupby("parameter", sort=False)
    ]
    letter, _ = ROWS[last_part(results.experiment)]
    not_converged = int(((status != b"CONVERGED") & ~results.stored.failures).sum())
    frame = pd.DataFrame(lines).assign(row=letter, not_converged=not_converged)
    return frame.assign(misused=frame["formula"] != next(iter(formulas)))


def _measured(errors: pd.DataFrame) -> dict[str, Any]:
    """Return the measures of the errors of one parameter with one formula."""
    values, widths, reach = errors[["value", "standard_error", "quantile"]].to_numpy().T.copy()
    sample, mean_error = Sample(values, widths, quantiles=reach), float(np.nanmean(widths))
    percent, bias, deviation = (
        measure(sample) for measure in (monte_carlo.coverage, monte_carlo.bias, monte_carlo.deviation)
    )
    return {
        "runs": values.size,
        "covered": int(monte_carlo.covered(sample).sum()),
        "percent": percent.value,
        "low": percent.low,
        "high": percent.high,
        "bias": bias.value,
        "standard_deviation": deviation.value,
        "mean_standard_error": mean_error,
        "standard_error_ratio": mean_error / deviation.value,
        "bias_in_monte_carlo_errors": bias.value / bias.error,
    }


def _robust(plan: Any, errors: pd.DataFrame) -> pd.DataFrame:
    """Return the errors with standard errors for coloured noise, which are not stored, from repeated fits."""
    (cell,), (estimator,) = plan.data_cells, plan.estimators
    parts = []
    for replicate, own in errors.groupby("replicate", sort=False):
        uncertainty = estimator.estimator.prepare(cell.dataset(replicate).record).fit(None).uncertainty("robust")
        widths = np.sqrt(np.diag(uncertainty.covariance))
        parts.append(own.assign(standard_error=widths, quantile=uncertainty.quantiles()))
    return pd.concat(parts)


def tables(found: StudyResults) -> list[Section]:
    """Return all lines for readers."""
    lines = pd.concat([coverage(found[name]) for name in ROWS if name in found])
    shown = pd.DataFrame({"row": lines["row"], "data": lines["row"].map(dict(ROWS.values()))})
    shown["formula"] = lines["formula"] + lines["misused"].map({True: " (misused)", False: ""})
    shown["parameter"], shown["true"] = lines["parameter"], lines["true"].map("{:.5g}".format)
    shown["coverage %"] = lines["percent"].map("{:.1f}".format)
    shown["95 % interval"] = lines["low"].map("{:.1f} to ".format) + lines["high"].map("{:.1f}".format)
    shown["standard error / deviation"] = lines["standard_error_ratio"].map("{:.3f}".format)
    shown["bias / Monte Carlo error"] = lines["bias_in_monte_carlo_errors"].map("{:+.1f}".format)
    return [Section(table=Table.of_frame(shown))]
