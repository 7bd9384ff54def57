"""What is published of the study: how often the intervals of each row cover, by parameter and formula."""

from functools import cache
from typing import Any

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.inference import monte_carlo
from ctid_cli.inference.monte_carlo import Sample
from ctid_cli.reporting.layout import markdown_table
from ctid_cli.reporting.parameter_errors import estimates_by_group
from ctid_cli.reporting.results import Results
from ctid_cli.running.plan import build_plan
from ctid_cli.specification.load import spec_from_canonical
from ctid_cli.studies.catalogue import StudyResults, last_part

#: Rows of the table by experiment: letter, and what the data are.
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
def coverage(results: Results) -> list[dict[str, Any]]:
    """Coverage, ratio of standard errors and bias: a line for each formula and parameter."""
    plan = build_plan(spec_from_canonical(dict(results.settings)))
    (found,) = estimates_by_group(results)
    with_value = np.flatnonzero(np.isfinite(found.values).all(axis=1))
    # Standard errors by formula, and how many of them intervals reach.
    formulas = {"white": (found.standard_errors[with_value], found.quantiles[with_value])}
    if plan.data_cells[0].source.noise.coloured:
        # Coloured noise is what the sandwich is meant for; the estimator stores the white formula, misused here.
        formulas = {"sandwich, t": _robust(plan, [found.replicates[k] for k in with_value]), **formulas}
    letter, _ = ROWS[last_part(results.experiment)]
    lines = []
    for formula, (widths, reaches) in formulas.items():
        columns = (found.values[with_value].T, widths.T, reaches.T)
        for name, true, values, width, reach in zip(found.names, found.truth, *columns, strict=True):
            sample, mean_error = Sample(values - true, width, quantiles=reach), float(np.nanmean(width))
            percent, bias, deviation = (
                measure(sample) for measure in (monte_carlo.coverage, monte_carlo.bias, monte_carlo.deviation)
            )
            lines.append(
                {
                    "row": letter,
                    "formula": formula,
                    "parameter": name,
                    "true": float(true),
                    "runs": values.size,
                    "not_converged": found.not_converged,
                    "covered": int(monte_carlo.covered(sample).sum()),
                    "low": percent.low,
                    "high": percent.high,
                    "bias": bias.value,
                    "percent": percent.value,
                    "standard_deviation": deviation.value,
                    "mean_standard_error": mean_error,
                    "standard_error_ratio": mean_error / deviation.value,
                    "bias_in_monte_carlo_errors": bias.value / bias.error,
                    "misused": formula != next(iter(formulas)),
                }
            )
    return lines


def _robust(plan: Any, replicates: list[int]) -> tuple[Array, Array]:
    """Standard errors for coloured noise, which are not stored, and their quantiles, from the same fits, made again."""
    (cell,), (estimator,) = plan.data_cells, plan.estimators
    errors, reach = [], []
    for replicate in replicates:
        uncertainty = estimator.estimator.prepare(cell.dataset(replicate).record).fit(None).uncertainty("robust")
        errors.append(np.sqrt(np.diag(uncertainty.covariance)))
        reach.append(uncertainty.quantiles())
    return np.array(errors), np.array(reach)


def markdown(found: StudyResults) -> str:
    """All lines for people."""
    titles = dict(ROWS.values())
    rows = [
        [
            *(line["row"], titles[line["row"]], line["formula"] + (" (misused)" if line["misused"] else "")),
            *(line["parameter"], f"{line['true']:.5g}"),
            *(f"{line['percent']:.1f}", f"{line['low']:.1f} to {line['high']:.1f}"),
            *(f"{line['standard_error_ratio']:.3f}", f"{line['bias_in_monte_carlo_errors']:+.1f}"),
        ]
        for name in ROWS
        if name in found
        for line in coverage(found[name])
    ]
    header = ["row", "data", "formula", "parameter", "true", "coverage %", "95 % interval"]
    header += ["standard error / deviation", "bias / Monte Carlo error"]
    return markdown_table(header, rows, "llllrrlrr") + "\n"
