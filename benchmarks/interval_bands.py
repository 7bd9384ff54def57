"""Coverage of the true responses by pointwise bands: ``python -m benchmarks.interval_bands [RUNS]``.

Uses the data sets of rows a, c, d and f of the study, fitted as there, and for each fit the linearised bands of gain
and phase, of the step response, and of the output for an input other than the experiment's. Writes ``bands.csv`` and
``bands.md`` to ``results/published/intervals``.
"""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ctid_cli.arrays import Array
from ctid_cli.filtering.simulate import simulate
from ctid_cli.inference.fit import Status
from ctid_cli.inference.fitted_model import STEP, FittedModel
from ctid_cli.inference.monte_carlo import wilson_interval
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.reporting.layout import markdown_table
from ctid_cli.running.plan import build_plan
from ctid_cli.signals.held import HeldSignal
from ctid_cli.specification.load import load_spec

ROOT = Path(__file__).resolve().parents[1]
PUBLISHED = ROOT / "results" / "published" / "intervals"
#: Row of the study, specification, assumed noise, and a time constant of the system [s].
ROWS = (
    ("a", "case1_regular", "white", 0.5),
    ("c", "first_order", "white", 3.0),
    ("d", "first_order_coloured", "robust", 3.0),
    ("f", "short_prbs", "robust", 0.5),
)
#: Places, in time constants after the delay and over them.
AFTER, OVER = np.array([0.5, 1.0, 2.0, 4.0]), np.array([0.3, 1.0, 3.0])
RESPONSES = ("gain", "phase", "step response", "simulated output")


def other_input(unit: float) -> HeldSignal:
    """Return an input unlike that of any experiment: random levels, held for fractional numbers of time constants."""
    rng = np.random.default_rng(7)
    return HeldSignal(np.cumsum(rng.uniform(0.3, 2.0, 20)) * unit, rng.standard_normal(20))


def hits_of(fit: FittedModel, truth: TransferFunction, unit: float) -> dict[str, Array]:
    """Return which true values the bands of one fit contain, by response."""
    w, t, signal = OVER / unit, truth.delay + AFTER * unit, other_input(unit)
    late = truth.delay + unit * np.array([3.0, 8.0, 12.0, 17.0])
    frequency = fit.frequency_response(w)
    step = fit.step_response(t)
    output = fit.simulate(signal, late)
    true = truth.frequency_response(w)
    turned = np.angle(true * np.exp(-1j * frequency.phase))
    x, y = simulate(truth, STEP, t), simulate(truth, signal, late)
    return {
        "gain": (frequency.gain_lower <= np.abs(true)) & (np.abs(true) <= frequency.gain_upper),
        "phase": np.abs(turned) <= frequency.phase_upper - frequency.phase,
        "step response": (step.lower <= x) & (x <= step.upper),
        "simulated output": (output.lower <= y) & (y <= output.upper),
    }


def coverage(letter: str, config: str, kind: Any, unit: float, runs: int) -> list[dict[str, Any]]:
    """Return a line for each response and place of one row."""
    plan = build_plan(load_spec(ROOT / "configs" / "coverage" / f"{config}.yaml"))
    (cell,), (estimator,) = plan.data_cells, plan.estimators
    truth, held = cell.source.system, []
    for replicate in range(runs):
        fit = estimator.estimator.prepare(cell.dataset(replicate).record).fit(None)
        if fit.status is Status.CONVERGED:
            held.append(hits_of(replace(fit, law=fit.uncertainty(kind)), truth, unit))
    lines = []
    for name in RESPONSES:
        places = OVER if name in ("gain", "phase") else AFTER if name == "step response" else [3.0, 8.0, 12.0, 17.0]
        for k, place in enumerate(places):
            covered = sum(bool(one[name][k]) for one in held)
            low, high = wilson_interval(covered, len(held))
            lines.append(
                {
                    "row": letter,
                    "covariance": kind,
                    "response": name,
                    "place": float(place),
                    "runs": runs,
                    "converged": len(held),
                    "covered": covered,
                    "percent": 100 * covered / len(held),
                    "low": low * 100,
                    "high": high * 100,
                }
            )
    return lines


def markdown(lines: list[dict[str, Any]]) -> str:
    """Return all lines for readers."""
    header = ["row", "covariance", "response", "place", "coverage %", "95 % interval"]
    rows = [
        [
            *(line["row"], line["covariance"], line["response"], f"{line['place']:g}"),
            *(f"{line['percent']:.1f}", f"{line['low']:.1f} to {line['high']:.1f}"),
        ]
        for line in lines
    ]
    return markdown_table(header, rows, "lllrrl") + "\n"


def main(runs: int = 1000) -> None:
    """Compute all rows and write them."""
    lines = [line for row in ROWS for line in coverage(*row, runs)]
    PUBLISHED.mkdir(parents=True, exist_ok=True)
    (PUBLISHED / "bands.csv").write_text(pd.DataFrame(lines).to_csv(index=False, lineterminator="\n"), encoding="utf-8")
    (PUBLISHED / "bands.md").write_text(markdown(lines), encoding="utf-8")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
