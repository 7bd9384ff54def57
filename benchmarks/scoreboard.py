"""ctid compared with published numbers and with exact bounds: the page docs/scoreboard.md.

python -m benchmarks.scoreboard                    # prints the page
python -m benchmarks.scoreboard --write FILE.md

Records that may not be redistributed are read from the folder in the environment variable CTID_DATA; each must have the
SHA-256 given here. Rows of missing records say "not run".
"""

import argparse
import hashlib
import os
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from ctid_cli import (
    DelayProfile,
    Given,
    HeldSignal,
    Prbs,
    Record,
    TransferFunction,
    WhiteNoise,
    choose,
    compare,
    cramer_rao_bound,
    identify,
    read_record,
    simulate,
)

ROOT = Path(__file__).resolve().parents[1]
PUBLISHED = ROOT / "results" / "published"

#: SHA-256 of each record in the folder CTID_DATA.
RECORDS = {
    "daisy_dryer.csv": "8c196d7025c15c89a8a34c74abbe49887e38785cb35ce5e3cf36a94992d53e03",
    "gas_furnace.csv": "50b563a60c063ad22b482398b402b2d1412fbe83ad9b2e6d6eb18a0249e83076",
    "pt326_est.csv": "67bb6e67ae4e46f3b312990bfcd09d24e3881352e00a40f30476ccaaa3ab5e75",
    "pt326_val.csv": "205d8d7b1f94cf097a3e2006f6d5b698431c5cf3cd907f4bd933688d0f502a54",
    "silverbox_est.csv": "a00450689de9b6c9daa4c5d28beb4be39bb60606d43ceeaf753d9a6e82b32309",
    "silverbox_test_multisine.csv": "6456036816fbfb3f3a93d93b1dc0223237789fd194c793876f8f6c6439eb73ca",
    "silverbox_test_arrow_full.csv": "a26ed3e199957d5b6f3211a8a097bef6dba38ec9307839132b57707d60ebfe05",
    "silverbox_test_arrow_no_extrapolation.csv": "ac75408628f1597b61cf7cb370094a25d2b782f7432b7242ab34910286184731",
}

#: Systems of first to fourth order [s]: overdamped, resonant, with a zero, two modes; each with a delay.
SYSTEMS = {
    "1 pole": TransferFunction([2.0], [1.0, 2.0], delay=0.537),
    "2 poles": TransferFunction([4.0], [1.0, 1.2, 4.0], delay=0.537),
    "3 poles, 1 zero": TransferFunction([8.0, 8.0], [1.0, 4.0, 8.0, 8.0], delay=0.537),
    "4 poles, 2 zeros": TransferFunction([3.0, 6.0, 40.0], [1.0, 2.2, 30.0, 28.0, 100.0], delay=0.537),
}
SAMPLES, INTERVAL, SNR_DB, DELAYS = 1000, 0.05, 15.0, (0.0, 1.5)


class Row(NamedTuple):
    """One comparison: subject, settings, our number, the reference by others or by theory, and its source."""

    subject: str
    settings: str
    ctid: str
    other: str
    source: str


class NotRunError(Exception):
    """A record is missing, or has another content."""


def record_of(name: str) -> Record:
    """Read a record of the folder CTID_DATA."""
    folder = os.environ.get("CTID_DATA")
    path = Path(folder or "", name)
    if not folder or not path.is_file():
        raise NotRunError(f"not run: no {name} in CTID_DATA")
    if hashlib.sha256(path.read_bytes()).hexdigest() != RECORDS[name]:
        raise NotRunError(f"not run: {name} has another SHA-256")
    return read_record(path)


def useful_redundancy() -> list[Row]:
    """Return mean percentages of the four printed tables, from the committed results."""
    table = pd.read_csv(PUBLISHED / "useful_redundancy" / "tables.csv")
    methods = {"existing": "`td_srivc`, one filter", "redundancy": "`useful_redundancy`"}
    rows = []
    for number, cells in table.groupby("table"):
        for method, name in methods.items():
            ours = cells[cells["method"] == method]
            rows.append(
                Row(
                    f"Delay within 1 %, table {number}, {name}",
                    f"{len(ours)} cells of {ours['n'].min()} data sets, 5 and 15 dB, both clocks",
                    f"{ours['percent'].mean():.1f} %",
                    f"{ours['published_percent'].mean():.1f} %",
                    "Ha, Welsh, Alamir 2017, arXiv:1703.09344",
                )
            )
        searched = cells[cells["method"] == "delay_profile"]
        rows.append(
            Row(
                f"Delay within 1 %, table {number}, `delay_profile`",
                "no initial delay",
                f"{100 * searched['converged'].sum() / searched['n'].sum():.1f} %",
                "no such method",
                "the same",
            )
        )
    return rows


def claim(study: str, experiment: str, start: str) -> str:
    """Return a study's measured value for a claim, from the committed results."""
    claims = pd.read_csv(PUBLISHED / study / "claims.csv")
    found = claims[(claims["experiment"] == experiment) & claims["claim"].str.startswith(start)]
    return str(found["measured"].item())


def studies() -> list[Row]:
    """Return rows of the other studies, from the committed results."""
    additive = "González et al. 2025, arXiv:2401.01263; theory: limit for long records"
    rows = []
    for experiment, estimator, parameter in (("open-loop", "srivc", "g2_b0"), ("closed-loop", "clsrivc", "g1_a2")):
        measured, theory = claim("additive", experiment, f"MSE of {estimator} / MSE of additive, {parameter},").split(
            "; theory "
        )
        rows.append(
            Row(
                f"Mean square error of `{estimator}` over that of a sum of modes, {parameter}",
                f"{experiment}, 300 data sets per length, at least 20,000 samples",
                measured,
                theory,
                additive,
            )
        )
    bound = "Cramér-Rao bound of the samples"
    for estimator in ("restarting_prefiltered", "nonlinear_least_squares"):
        rows.append(
            Row(
                f"Error of two frequencies over the bound, `{estimator}`",
                "study finite-time-frequency, 300 data sets",
                claim("finite_time_frequency", "efficiency", f"{estimator}: rms error / bound"),
                "1",
                bound,
            )
        )
    nominal = "nominal"
    for experiment, formula in (("case1-regular", "white"), ("first-order-coloured", "sandwich, t")):
        rows.append(
            Row(
                f"Coverage of 95 % intervals of the delay, formula {formula}",
                f"study coverage, {experiment}, 1000 data sets",
                claim("coverage", experiment, f"coverage of delay [%], {formula}") + " %",
                "95 %",
                nominal,
            )
        )
    return rows


def bounds(runs: int) -> list[Row]:
    """Return RMSE over the Cramér-Rao bound of systems of first to fourth order, with unknown delay."""
    t = INTERVAL * np.arange(SAMPLES)
    rows = []
    for name, system in SYSTEMS.items():
        poles, zeros = system.order, system.numerator.size - 1
        estimator = DelayProfile(poles, zeros, DELAYS)
        truth = np.concatenate([system.denominator[1:], system.numerator, [system.delay]])
        ratios = []
        for seed in range(runs):
            rng = np.random.default_rng(seed)
            u = HeldSignal(t, Prbs(10, 4 * INTERVAL).generate(t, rng).at(t))
            x = simulate(system, u, t)
            noise = WhiteNoise(snr_db=SNR_DB).generate(x, rng)
            record = Record(t, x + noise, u)
            fit = estimator.fit(record, None)
            sigma = float(np.sqrt(np.mean(x**2) / 10 ** (SNR_DB / 10)))
            bound = cramer_rao_bound(system, record, sigma, start=DELAYS[1])
            ratios.append((fit.theta - truth) ** 2 / np.diag(bound))
        rmse = np.sqrt(np.mean(ratios, axis=0))
        rows.append(
            Row(
                f"RMSE over the bound, {name} and a delay",
                f"`delay_profile`, {runs} records of {SAMPLES} samples, PRBS, white noise, {SNR_DB:.0f} dB",
                " ".join(f"{ratio:.2f}" for ratio in rmse),
                f"1; chance ± {1 / np.sqrt(2 * runs):.2f}",
                "Cramér-Rao bound of each record; order a, b, delay",
            )
        )
    return rows


def dryer() -> list[Row]:
    """Return delay and order of the DaISy dryer."""
    record = record_of("daisy_dryer.csv")
    two = identify([record], DelayProfile(2, 0, (0.0, 1.0), initial_state="estimate", offset="estimate"))
    chosen = choose([record])
    return [
        Row(
            "DaISy dryer, delay",
            "2 poles, no zero, state and offset estimated, zero-order hold",
            f"{two.fit.parameters['delay']:.3f} ± {two.fit.standard_errors['delay']:.3f} s",
            "3 samples of 0.08 s: between 0.16 and 0.24 s of delay, if the input is held",
            "ControlSystemIdentification.jl, example *hair dryer*, read off an impulse response",
        ),
        Row(
            "DaISy dryer, order",
            "`ctid fit` without options",
            " ".join(chosen.words()),
            "discrete models of 2 to 4 poles",
            "MathWorks, example of the record `dryer2`; no order is known to be true",
        ),
    ]


def pt326() -> list[Row]:
    """Return the structure of CONTSID's record of the PT326."""
    record, other = record_of("pt326_est.csv"), record_of("pt326_val.csv")
    rows = []
    for poles in (1, 2):
        options = DelayProfile(poles, 0, (0.0, 2.0), initial_state="estimate", offset="estimate")
        found = identify([record], options, validation=other)
        rows.append(
            Row(
                f"PT326, delay with {poles} pole{'s' if poles > 1 else ''}",
                "state and offset estimated; validation on the second half",
                f"{found.fit.parameters['delay']:.3f} ± {found.fit.standard_errors['delay']:.3f} s, "
                f"validation fit {found.validation.fit_percent:.1f} %",
                "0.5 s with 1 pole",
                "CONTSID 7.3, demonstration of the aero-thermal channel, structure [1 1 5] by YIC",
            )
        )
    return rows


def _variance_in_discrete_time(u: np.ndarray, y: np.ndarray, coefficients: int) -> float:
    """Return the variance of the innovations of a discrete model of the gas furnace: 3 samples delay, 1 pole, AR(2).

    The sum of the squares over the number of samples, as it is for exact likelihood.
    """
    from scipy.optimize import least_squares
    from scipy.signal import lfilter

    def innovations(values: np.ndarray) -> np.ndarray:
        pole, first, second, level = values[coefficients:]
        noise = y - level - lfilter([0.0, 0.0, 0.0, *values[:coefficients]], [1.0, -pole], u - u.mean())
        return lfilter([1.0, -first, -second], [1.0], noise)[2:]

    found = least_squares(innovations, [*[-0.5] * coefficients, 0.5, 1.5, -0.6, y.mean()])
    return float(np.sum(found.fun**2)) / y.size


def gas_furnace() -> list[Row]:
    """Return the structure of Box and Jenkins' series J."""
    record = record_of("gas_furnace.csv")
    found = identify([record], Given(poles=1, noise_model="arma:2,0"))
    noise = found.fit.noise.noise
    gain = found.fit.parameters["b0"] / found.fit.parameters["a1"]
    two = identify([record], Given(poles=2, zeros=0, noise_model="arma:2,0")).fit.noise.noise
    three, equal = (_variance_in_discrete_time(record.input.values, record.y, count) for count in (3, 2))
    return [
        Row(
            "Gas furnace, delay",
            "1 pole, AR(2) noise, the rest chosen",
            f"{found.fit.parameters['delay']:.1f} ± {found.fit.standard_errors['delay']:.1f} s",
            "3 samples of 9 s: between 18 and 27 s of delay, if the input is held",
            "Box, Jenkins, *Time Series Analysis*, series J",
        ),
        Row(
            "Gas furnace, noise and static gain",
            "the same fit",
            f"D = 1 {noise.denominator[1]:+.2f} q^-1 {noise.denominator[2]:+.2f} q^-2; gain {gain:.2f}",
            "AR(2)",
            "the same",
        ),
        Row(
            "Gas furnace, variance of the innovations",
            "the same fit; beside it 2 poles and no zero",
            f"{noise.innovation_variance:.4f}; {two.innovation_variance:.4f}",
            f"0.0561 (printed); {three:.4f} and {equal:.4f}: delay 3 samples, 1 pole, AR(2), with three and with two "
            "numerator coefficients; a held input and 1 continuous-time pole give two",
            "Box, Jenkins, *Time Series Analysis*, series J; conditional least squares with `scipy.optimize`, by this "
            "script, sums of squares over all 296 samples",
        ),
    ]


def silverbox() -> list[Row]:
    """Return linear models of second order of the Silverbox."""
    record = record_of("silverbox_est.csv")
    tests = {
        name: record_of(f"silverbox_test_{name}.csv") for name in ("multisine", "arrow_full", "arrow_no_extrapolation")
    }
    known = DelayProfile(2, 1, (0.0, 0.0), initial_state="estimate", offset="estimate")
    found = identify([record], known)
    errors = {name: compare([found], test)[0].rms for name, test in tests.items()}
    return [
        Row(
            "Silverbox, linear, 2 poles",
            "`silverbox_est.csv`, 1 zero, no delay; simulated, state and offset estimated on each test record",
            "RMS " + ", ".join(f"{1e3 * error:.2f} mV ({name})" for name, error in errors.items()),
            "training error .1836 (subspace), .1317 (optimised), in that package's measure",
            "freq-statespace 0.1.2, two states, 8,192 x 6 samples of the multisine: other data and another measure",
        )
    ]


def rows_of(section, *arguments) -> list[Row]:
    """Return a section's rows, or one that names the missing record."""
    try:
        return section(*arguments)
    except NotRunError as missing:
        return [Row(section.__doc__.rstrip("."), "", str(missing), "", "")]


def page(runs: int) -> str:
    """Return the scoreboard in Markdown."""
    sections = {
        "Published studies": useful_redundancy() + studies(),
        "Exact bounds": bounds(runs),
        "Measured records": [row for section in (dryer, pt326, gas_furnace, silverbox) for row in rows_of(section)],
    }
    lines = [
        "# Scoreboard",
        "",
        "`ctid` beside numbers that others printed and beside exact bounds. `make scoreboard` writes this page; rows",
        "in which `ctid` is worse stay. Published studies are read from `results/published`, the rest is computed.",
        "Records that may not be redistributed are read from the folder that `CTID_DATA` names;",
        "`benchmarks/scoreboard.py` holds their SHA-256.",
    ]
    for title, rows in sections.items():
        lines += [
            "",
            f"## {title}",
            "",
            "| compared | settings | `ctid` | others, theory | source |",
            "|:--|:--|:--|:--|:--|",
        ]
        lines += ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Print the page, or write it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--write", type=Path, metavar="FILE", help="write the page into a file")
    parser.add_argument("--runs", type=int, default=100, help="simulated records of each system")
    options = parser.parse_args()
    text = page(options.runs)
    if options.write:
        options.write.write_text(text, encoding="utf-8")
        print(f"{options.write}: {time.process_time():.0f} s of processor time")
    else:
        print(text)


if __name__ == "__main__":
    main()
