"""Coverage of 95 % intervals with default settings: ``python -m benchmarks.interval_defaults [RUNS [SEED]]``.

Three systems with a delay, after a PRBS and after a step, in white and in coloured noise. ``delay_profile`` gets no
information on the noise. Writes ``defaults.csv`` and ``defaults.md`` to ``results/published/intervals``.
"""

import itertools
import sys
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.interval_bands import PUBLISHED
from ctid_cli.arrays import Array
from ctid_cli.canonical import plain
from ctid_cli.estimators.delay_profile import DelayProfile
from ctid_cli.inference.bounds import finite_record_covariance
from ctid_cli.inference.monte_carlo import QUANTILE, Sample, covered, wilson_interval
from ctid_cli.inference.sensitivities import Parametric, sensitivities
from ctid_cli.inference.uncertainty import UNSAFE, shifts_of_ends
from ctid_cli.models.additive import AdditiveModel, Submodel
from ctid_cli.models.factoring import unfactored
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.reporting.layout import markdown_table
from ctid_cli.signals.excitation import Excitation, Prbs, Step
from ctid_cli.signals.noise import ArmaNoise, Noise, WhiteNoise
from ctid_cli.signals.sampling import RegularSampling
from ctid_cli.simulation.dataset import SimulatedSource
from ctid_cli.storage.truth import found_of_rows

SAMPLING = RegularSampling(interval=0.05, samples=600)
DELAY = 0.63  # s, between samples
#: Each mode of the third system has at least a quarter of the variance of the output, after either input.
SYSTEMS = {
    "overdamped": TransferFunction([2], [0.4, 1.4, 1], DELAY),
    "resonant": TransferFunction([1], [0.25, 0.15, 1], DELAY),
    "two modes": unfactored(
        AdditiveModel(
            [Submodel([gain], [w**-2, 0.2 / w, 1.0]) for gain, w in ((1.0, 1.5), (1.1, 4.0))],
            DELAY,
        )
    ),
}
INPUTS: dict[str, Excitation] = {"prbs": Prbs(stages=10, clock_period=0.9), "step": Step(time=3.0)}
NOISES: dict[str, tuple[Sequence[float], Sequence[float]] | None] = {
    "white": None,
    "AR(1) .5": ((1.0,), (1.0, -0.5)),
    "AR(1) .9": ((1.0,), (1.0, -0.9)),
    "ARMA(2,1)": ((1.0, 0.5), (1.0, -1.3, 0.5)),
    "AR(1) .95": ((1.0,), (1.0, -0.95)),
}
BOUNDED = tuple(NOISES)[:4]
#: Input, signal-to-noise ratio [dB] and noise of each line; the first eight must cover 92 to 98 %.
LINES = [
    *((name, snr, noise) for (name, snr), noise in itertools.product((("prbs", 20.0), ("step", 30.0)), BOUNDED)),
    *(("step", snr, noise) for snr, noise in itertools.product((20.0, 15.0), BOUNDED)),
    *((name, snr, "AR(1) .95") for name, snr in (("prbs", 20.0), ("step", 30.0))),
]
#: Results of a line, for a single system or pooled.
Line = dict[str, Any]


def noise_of(name: str, snr_db: float) -> Noise:
    """Return noise of a colour and a level."""
    colour = NOISES[name]
    return WhiteNoise(snr_db=snr_db) if colour is None else ArmaNoise(*map(tuple, colour), snr_db=snr_db)


def line_of(system: str, signal: str, snr_db: float, noise: str, runs: int, seed: int) -> Line:
    """Return the results for one system, from the numbers that an experiment stores."""
    truth = SYSTEMS[system]
    source = SimulatedSource(truth, INPUTS[signal], SAMPLING, noise_of(noise, snr_db), seed)
    zeros, names = truth.numerator.size - 1, (*truth.parameters, "delay")
    options = DelayProfile(truth.order, zeros, delay_bounds=(0.0, 2.0))
    numbers, lengths, robust, unsafe, converged = [], [], 0, 0, 0
    for replicate in range(runs):
        data = source.dataset(replicate)
        fit = options.fit(data.record)
        stored = plain(data.result_of(fit, None, None))
        numbers.append(np.array(found_of_rows([stored], names))[:, 0])
        lengths.append(numbers[-1][1] * numbers[-1][2] / (QUANTILE * ideal_errors(source, data.record, names)))
        robust += stored["covariance"] == "robust"
        converged += stored["status"] == "CONVERGED"
        law = fit.law
        shifts = shifts_of_ends(
            Parametric(fit.model, fit.parameter_names), law, [data.record], fit.used, fit.sensitivities
        )
        unsafe += law.short or bool((shifts > UNSAFE).any())
    values, errors, quantiles = np.moveaxis(np.array(numbers), 1, 0)
    known = np.concatenate([*truth.parameters.values(), truth.delay], axis=None)
    hits = covered(Sample(values - known, errors, quantiles=quantiles))
    return {
        "input": signal,
        "snr_db": snr_db,
        "noise": noise,
        "system": system,
        "runs": runs,
        "converged": converged,
        "robust": robust,
        "called_unsafe": unsafe,
        "covered": int(hits.sum()),
        "intervals": hits.size,
        "length_over_ideal": float(np.nanmedian(lengths)),
    }


def ideal_errors(source: SimulatedSource, record: Any, names: Sequence[str]) -> Array:
    """Return standard errors of the same estimator with known system and covariance of the noise."""
    truth, noise = source.system, source.noise
    assert isinstance(truth, TransferFunction)
    assert isinstance(noise, Noise)
    psi = sensitivities(truth, record.input, record.t, truth.numerator.size - 1, estimate_delay=True)
    lags = np.arange(len(psi) if noise.coloured else 1)
    errors = np.sqrt(np.diag(finite_record_covariance(psi, noise.autocovariance(lags, record.noise_free))))
    order = [*(f"a{k}" for k in range(1, truth.order + 1)), *(f"b{k}" for k in range(truth.numerator.size)), "delay"]
    return np.asarray(errors[[order.index(name) for name in names]])


def pooled(lines: Sequence[Line]) -> Line:
    """Return all systems together; for lengths the median of their medians."""
    sums = {key: sum(line[key] for line in lines) for key in ("runs", "converged", "robust", "called_unsafe")}
    sums |= {key: sum(line[key] for line in lines) for key in ("covered", "intervals")}
    length = float(np.median([line["length_over_ideal"] for line in lines]))
    return lines[0] | {"system": "all"} | sums | {"length_over_ideal": length}


def with_percent(line: Line) -> Line:
    """Return a line with its coverage [%] and 95 % interval, as if intervals of one estimate were independent."""
    low, high = wilson_interval(line["covered"], line["intervals"])
    return line | {"percent": 100 * line["covered"] / line["intervals"], "low": 100 * low, "high": 100 * high}


def study(runs: int, seed: int, lines: Iterable[tuple[str, float, str]] = LINES) -> Iterator[Line]:
    """Yield a line for each system and all of them, for every input, level and noise."""
    for signal, snr_db, noise in lines:
        own = [line_of(system, signal, snr_db, noise, runs, seed) for system in SYSTEMS]
        yield from (with_percent(line) for line in (*own, pooled(own)))


def markdown(lines: Sequence[Line]) -> str:
    """Return all lines for readers."""
    header = ["input", "SNR [dB]", "noise", "system", "coverage %", "95 % interval", "length / ideal"]
    header += ["robust %", "called unsafe %", "converged %"]
    rows = [
        [
            *(line["input"], f"{line['snr_db']:g}", line["noise"], line["system"], f"{line['percent']:.1f}"),
            *(f"{line['low']:.1f} to {line['high']:.1f}", f"{line['length_over_ideal']:.2f}"),
            *(f"{100 * line[key] / line['runs']:.0f}" for key in ("robust", "called_unsafe", "converged")),
        ]
        for line in lines
    ]
    return markdown_table(header, rows, "lrllrlrrrr") + "\n"


def main(runs: int = 400, seed: int = 20261124) -> None:
    """Compute all lines and write them."""
    lines: list[Line] = []
    for line in study(runs, seed):
        lines.append(line)
        (PUBLISHED / "defaults.csv").write_text(
            pd.DataFrame(lines).to_csv(index=False, lineterminator="\n"), encoding="utf-8"
        )
        (PUBLISHED / "defaults.md").write_text(markdown(lines), encoding="utf-8")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
