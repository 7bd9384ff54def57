"""Monte Carlo study: how often do 95 % intervals contain the parameters that made the data?

python experiments/coverage/coverage.py --runs 1000 --jobs 2 --out results/published/coverage
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import joblib
import numpy as np
import pandas as pd
from scipy.signal import lfilter

from ctid_cli.arrays import Array
from ctid_cli.estimators.delay_profile import DelayProfile, MeasuredFit
from ctid_cli.inference.robust import sandwich_covariance
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.excitation import Prbs
from ctid_cli.signals.noise import WhiteNoise
from ctid_cli.signals.sampling import RegularSampling, UniformIntervals
from ctid_cli.simulation.dataset import SimulatedSource
from ctid_cli.storage.provenance import now
from ctid_cli.storage.summary import wilson_interval
from ctid_cli.storage.version import code_version, numeric_platform, package_versions

SEED = 2024
#: Standard errors on either side of an estimate that make a 95 % interval.
QUANTILE = 1.959963984540054
#: The search looks for the delay this far on either side of the truth [s].
HALF_RANGE = 0.5
#: Coverage [%] that counts as right.
BAND = (93.0, 97.0)
#: Samples of coloured noise that are thrown away, so that the rest is stationary.
BURN_IN = 500
#: Data sets that one job simulates.
BLOCK = 10


@dataclass(frozen=True)
class ArmaNoise:
    """``e(t) C(q)/D(q)`` scaled to a signal-to-noise ratio [dB]; both polynomials in q^-1, beginning with 1."""

    snr_db: float
    numerator: tuple[float, ...] = (1.0, 0.5)
    denominator: tuple[float, ...] = (1.0, -0.85)

    def generate(self, noise_free: Array, rng: np.random.Generator) -> Array:
        impulse = lfilter(self.numerator, self.denominator, np.eye(1, BURN_IN)[0])
        coloured = lfilter(self.numerator, self.denominator, rng.standard_normal(BURN_IN + noise_free.size))[BURN_IN:]
        power = float(np.mean(noise_free**2)) / 10 ** (self.snr_db / 10)
        return np.asarray(coloured * np.sqrt(power / np.sum(impulse**2)))


@dataclass(frozen=True)
class Row:
    """One kind of data, and the formulas whose standard errors are judged on it."""

    title: str
    system: TransferFunction
    sampling: RegularSampling | UniformIntervals
    excitation: Prbs
    noise: WhiteNoise | ArmaNoise
    formulas: tuple[str, ...] = ("white",)
    required: bool = True

    @property
    def truth(self) -> dict[str, float]:
        a, b = self.system.denominator[1:], self.system.numerator
        named = {f"a{i}": float(value) for i, value in enumerate(a, 1)}
        named |= {f"b{i}": float(value) for i, value in enumerate(b)}
        return named | {"delay": self.system.delay}


SECOND_ORDER = TransferFunction([2.0], [0.25, 0.7, 1.0], 8.0)
FIRST_ORDER = TransferFunction([2.0], [3.0, 1.0], 1.3)

ROWS = {
    "a": Row(
        "case 1, regular",
        SECOND_ORDER,
        RegularSampling(0.05, 4000),
        Prbs(stages=10, clock_period=0.05),
        WhiteNoise(snr_db=15.0),
    ),
    "b": Row(
        "case 1, irregular, exact input record",
        SECOND_ORDER,
        UniformIntervals(0.01, 0.09, 4000, input_record="exact"),
        Prbs(stages=10, clock_period=0.5),
        WhiteNoise(snr_db=15.0),
    ),
    "c": Row(
        "first order and delay",
        FIRST_ORDER,
        RegularSampling(0.2, 2000),
        Prbs(stages=9, clock_period=1.0),
        WhiteNoise(snr_db=10.0),
    ),
    "d": Row(
        "first order and delay, ARMA noise",
        FIRST_ORDER,
        RegularSampling(0.2, 2000),
        Prbs(stages=9, clock_period=1.0),
        ArmaNoise(snr_db=10.0),
        ("sandwich", "white"),
    ),
    "e": Row(
        "case 1, irregular, sampled input record",
        SECOND_ORDER,
        UniformIntervals(0.01, 0.09, 4000, input_record="sampled"),
        Prbs(stages=10, clock_period=0.5),
        WhiteNoise(snr_db=15.0),
        required=False,
    ),
}


def covariance(fit: MeasuredFit, formula: str, regular: bool) -> Array:
    """Covariance of the estimate by one formula."""
    if formula == "white":
        return fit.covariance
    return sandwich_covariance(fit.sensitivities, fit.residuals, regular=regular)


def estimate(key: str, replicates: range) -> list[dict[str, object]]:
    """Estimates and standard errors of some data sets, one line per parameter and formula."""
    row = ROWS[key]
    source = SimulatedSource(row.system, row.excitation, row.sampling, row.noise, SEED)
    delay = row.system.delay
    estimator = DelayProfile(row.system.order, 0, (delay - HALF_RANGE, delay + HALF_RANGE))
    lines: list[dict[str, object]] = []
    for replicate in replicates:
        fit = estimator.fit(source.dataset(replicate).record)
        for formula in row.formulas:
            errors = np.sqrt(np.diag(covariance(fit, formula, isinstance(row.sampling, RegularSampling))))
            for (name, value), error in zip(fit.parameters.items(), errors, strict=True):
                lines.append(
                    {
                        "row": key,
                        "formula": formula,
                        "parameter": name,
                        "replicate": replicate,
                        "estimate": value,
                        "standard_error": float(error),
                        "converged": fit.status.name == "CONVERGED",
                    }
                )
    return lines


def study(keys: list[str], runs: int, jobs: int = 1) -> pd.DataFrame:
    """Estimates of all data sets of some rows."""
    blocks = [range(first, min(first + BLOCK, runs)) for first in range(0, runs, BLOCK)]
    tasks = [(key, block) for key in keys for block in blocks]
    with joblib.parallel_config(inner_max_num_threads=1, backend="loky"):
        results = joblib.Parallel(n_jobs=jobs)(joblib.delayed(estimate)(*task) for task in tasks)
    return pd.DataFrame([line for lines in results for line in lines])


def summarise(estimates: pd.DataFrame) -> pd.DataFrame:
    """Coverage, ratio of standard errors and bias, one line per row, formula and parameter."""
    lines = []
    for (key, formula, name), group in estimates.groupby(["row", "formula", "parameter"], sort=False):
        true = ROWS[str(key)].truth[str(name)]
        error = group["estimate"] - true
        # A standard error that could not be computed covers nothing.
        covered = int((error.abs() <= QUANTILE * group["standard_error"]).sum())
        runs = len(group)
        low, high = wilson_interval(covered, runs)
        deviation = float(group["estimate"].std(ddof=1))
        lines.append(
            {
                "row": key,
                "formula": formula,
                "parameter": name,
                "true": true,
                "runs": runs,
                "not_converged": int((~group["converged"]).sum()),
                "covered": covered,
                "percent": 100.0 * covered / runs,
                "low": 100.0 * low,
                "high": 100.0 * high,
                "standard_deviation": deviation,
                "mean_standard_error": float(group["standard_error"].mean()),
                "standard_error_ratio": float(group["standard_error"].mean()) / deviation,
                "bias": float(error.mean()),
                "bias_in_monte_carlo_errors": float(error.mean()) / (deviation / np.sqrt(runs)),
            }
        )
    return pd.DataFrame(lines)


def markdown(summary: pd.DataFrame) -> str:
    """The summary as a table."""
    text = [
        "| row | data | formula | parameter | true | coverage % | 95 % interval | standard error / deviation "
        "| bias / Monte Carlo error |",
        "|:--|:--|:--|:--|--:|--:|:--|--:|--:|",
    ]
    for line in summary.to_dict("records"):
        row = ROWS[line["row"]]
        misused = len(row.formulas) > 1 and line["formula"] != row.formulas[0]
        text.append(
            f"| {line['row']} | {row.title} | {line['formula']}{' (misused)' if misused else ''} | {line['parameter']} "
            f"| {line['true']:.5g} | {line['percent']:.1f} | {line['low']:.1f} to {line['high']:.1f} "
            f"| {line['standard_error_ratio']:.3f} | {line['bias_in_monte_carlo_errors']:+.1f} |"
        )
    return "\n".join(text) + "\n"


def outside(summary: pd.DataFrame) -> pd.DataFrame:
    """Lines of the required rows, with the formula meant for them, whose coverage lies outside the band."""
    judged = summary.apply(
        lambda line: ROWS[line["row"]].required and line["formula"] == ROWS[line["row"]].formulas[0], axis=1
    )
    return summary[judged & ~summary["percent"].between(*BAND)]


def main() -> None:
    parser = argparse.ArgumentParser(description="Coverage of 95 % intervals, by simulation")
    parser.add_argument("--runs", type=int, default=1000, help="data sets per row (default 1000)")
    parser.add_argument("--jobs", type=int, default=1, help="worker processes (default 1)")
    parser.add_argument("--rows", nargs="+", choices=list(ROWS), default=list(ROWS), help="rows (default all)")
    parser.add_argument("--out", type=Path, default=Path("results/coverage"), help="folder of the results")
    arguments = parser.parse_args()

    begin, code = time.perf_counter(), code_version()
    summary = summarise(study(arguments.rows, arguments.runs, arguments.jobs))
    environment = {
        "finished": now(),
        "runs": arguments.runs,
        "rows": arguments.rows,
        "seed": SEED,
        "jobs": arguments.jobs,
        "seconds": round(time.perf_counter() - begin, 1),
        "code_version": code,
        "numeric_platform": numeric_platform(),
        "packages": {"python": platform.python_version(), **package_versions()},
    }
    arguments.out.mkdir(parents=True, exist_ok=True)
    summary.to_csv(arguments.out / "coverage.csv", index=False, float_format="%.6g")
    (arguments.out / "coverage.md").write_text(markdown(summary), encoding="utf-8")
    (arguments.out / "environment.json").write_text(json.dumps(environment, indent=2) + "\n", encoding="utf-8")
    missed = outside(summary)
    sys.stdout.write(
        f"{markdown(summary)}\n{len(missed)} intervals of the rows that must cover lie outside "
        f"{BAND[0]:g} to {BAND[1]:g} %\n"
    )
    if len(missed):
        raise SystemExit(1)


if __name__ == "__main__":
    main()
