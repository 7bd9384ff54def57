"""What the stored runs of the study say: settling times, recovery after a step, errors against the Cramer-Rao bound."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.frequency.tracking import FrequencyTrack
from ctid_cli.reporting.figures.finite_time_frequency import CONFIGS, DERIVED, GROUPS
from ctid_cli.reporting.results import Results, find_results
from ctid_cli.running.plan import Plan, build_plan
from ctid_cli.simulation.frequency_runs import SignalSource
from ctid_cli.specification.load import spec_from_canonical
from ctid_cli.storage.store import read_tracks
from experiments.finite_time_frequency.acceptance import Check, at_most, cramer_rao, settle

Row = dict[str, Any]

#: Errors below which settling is measured [rad/s].
BANDS = (0.05, 0.01, 1e-3)
#: Experiments of the paper, and its figures of them.
FIGURES = {"two-tones": "figure 1", "harmonic": "figure 2", "random": "figure 3", "step": "figure 4"}
#: Readings of the step.
READINGS = ("jump", "continuous")


def read_study(out: Path) -> dict[str, Results]:
    """Results of the experiments that were run, by the last part of their names."""
    found = {name.rpartition("/")[2]: find_results(out, name) for name in CONFIGS}
    return {name: results for name, results in found.items() if results is not None}


def is_derived(estimator: str) -> bool:
    """Whether an estimator stands in for a published one whose equations are not in print."""
    return estimator in GROUPS[DERIVED]


def plan_of(results: Results) -> Plan:
    """The plan of the latest run."""
    return build_plan(spec_from_canonical(dict(results.settings)))


def sources(results: Results) -> dict[str, tuple[str, SignalSource]]:
    """Reading of the step (empty if there is none) and signal of every data cell, by its hash."""
    found = {}
    for cell in plan_of(results).data_cells:
        assert isinstance(cell.source, SignalSource)
        found[cell.hash] = (str(cell.swept.get("phase_at_steps", "")), cell.source)
    return found


def grouped(results: Results) -> dict[tuple[str, str], list[Row]]:
    """Estimates by reading and estimator."""
    cells = sources(results)
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in results.rows:
        groups.setdefault((cells[row["cell"]][0], row["estimator"]), []).append(row)
    return groups


def settling(results: Results) -> Iterator[Row]:
    """Settling times of the stored tracks, to the interval of their rows, before and after a step."""
    cells, tracks = sources(results), read_tracks(results.folder)
    for (reading, estimator), rows in grouped(results).items():
        followed = [(cells[row["cell"]][1], FrequencyTrack(**tracks[row["id"]])) for row in rows if row["id"] in tracks]
        pieces: dict[str, list[Array]] = {}
        wrong = []
        for source, track in followed:
            truth = source.signal.frequencies_at(track.t)
            ends = [0.0, *(float(step) for step in source.signal.frequency_steps), np.inf]
            for since, until in pairwise(ends):
                times = [settle(track, truth, band, since, until) for band in BANDS]
                pieces.setdefault(f"from {since:g} s", []).append(np.array(times))
            off = np.abs(track.omega - truth).max(axis=1) > BANDS[0]
            wrong.append(float((track.valid & off).sum()) * float(track.t[1] - track.t[0]))
        for piece, measured in pieces.items():
            middle, longest = np.median(measured, axis=0), np.max(measured, axis=0)
            yield {
                "experiment": results.experiment,
                "reading": reading,
                "estimator": estimator,
                "derived": "yes" if is_derived(estimator) else "no",
                "piece": piece,
                "data_sets": len(measured),
                **{f"within_{band:g}": none_if_never(value) for band, value in zip(BANDS, middle, strict=True)},
                **{f"longest_{band:g}": none_if_never(value) for band, value in zip(BANDS, longest, strict=True)},
                "valid_but_off_by_0.05": float(np.median(wrong)),
            }


def residuals(results: Results) -> Iterator[Row]:
    """Root-mean-square errors and mean errors over the window of each specification."""
    for (reading, estimator), rows in grouped(results).items():
        found = [row["measures"] for row in rows if row["measures"]]
        tones = sum(name.startswith("rms_") for name in found[0])
        for k in range(1, tones + 1):
            rms, bias = (np.array([measures[f"{name}_{k}"] for measures in found]) for name in ("rms", "bias"))
            yield {
                "experiment": results.experiment,
                "reading": reading,
                "estimator": estimator,
                "derived": "yes" if is_derived(estimator) else "no",
                "tone": k,
                "data_sets": len(found),
                "rms": float(np.median(rms)),
                "bias": float(np.mean(bias)),
                "valid_share": float(np.mean([measures["valid_share"] for measures in found])),
            }


def recovery(results: Results) -> Iterator[Row]:
    """Times from the step until the errors of both tones are in the band to stay."""
    band = float(results.settings["success"]["band"])
    for (reading, estimator), rows in grouped(results).items():
        found = [row["measures"] for row in rows if row["measures"]]
        times = np.array([last_of(measures, "settling_after_step_") for measures in found])
        alarms = [measures["false_alarms"] for measures in found if measures.get("false_alarms") is not None]
        tones = sum(name.startswith("rms_") for name in found[0])
        errors = np.array([[measures[f"rms_{k + 1}"] for k in range(tones)] for measures in found])
        yield {
            "experiment": results.experiment,
            "reading": reading,
            "estimator": estimator,
            "derived": "yes" if is_derived(estimator) else "no",
            "band": band,
            "data_sets": len(found),
            "median": none_if_never(float(np.median(times))),
            "longest": none_if_never(float(times.max())),
            "never": int(np.isinf(times).sum()),
            "false_alarms": sum(alarms) if alarms else None,
            "rms": float(np.median(errors, axis=0).max()),
        }


def efficiency(results: Results) -> Iterator[Row]:
    """Errors of the last estimates against the Cramer-Rao bound of Gaussian noise of the same variance."""
    ((_, source),) = sources(results).values()
    disturbance = source.disturbance
    sigma = float(disturbance.half_width / np.sqrt(3.0))  # type: ignore[union-attr]
    interval = source.sampling.interval
    bound = cramer_rao(source.sampling.samples * interval, interval, sigma)
    truth = source.signal.frequencies_at(np.zeros(1))[0]
    for (_, estimator), rows in grouped(results).items():
        found = [row["measures"] for row in rows if row["measures"]]
        errors = np.array([[measures[f"omega_{k + 1}"] for k in range(truth.size)] for measures in found]) - truth
        for k, e in enumerate(errors.T):
            rmse = float(np.sqrt(np.mean(e**2)))
            yield {
                "experiment": results.experiment,
                "estimator": estimator,
                "derived": "yes" if is_derived(estimator) else "no",
                "tone": k + 1,
                "data_sets": e.size,
                "bound": float(bound[k]),
                "rmse": rmse,
                "ratio": rmse / bound[k],
                "ratio_error": monte_carlo_error(e) / bound[k],
                "bias": float(np.mean(e)),
                "bias_error": float(np.std(e, ddof=1) / np.sqrt(e.size)),
                "deviation": float(np.std(e, ddof=1)),
                "valid_share": float(np.mean([measures["valid_share"] for measures in found])),
            }


def monte_carlo_error(errors: Array) -> float:
    """Standard deviation of a root mean square of independent errors."""
    squares = errors**2
    return float(np.std(squares, ddof=1) / np.sqrt(squares.size) / (2.0 * np.sqrt(np.mean(squares))))


def last_of(measures: Mapping[str, float | None], prefix: str) -> float:
    """The latest of the times of all tones [s]; infinite if one of them never came."""
    times = [value for name, value in measures.items() if name.startswith(prefix)]
    return float(max(np.inf if time is None else time for time in times))


def none_if_never(value: float) -> float | None:
    """None in place of infinity."""
    return float(value) if np.isfinite(value) else None


#: Largest root-mean-square error over the Cramer-Rao bound.
EFFICIENT = {
    "restarting_prefiltered": 2.6,
    "restarting_total": 4.0,
    "esprit": 1.35,
    "nonlinear_least_squares": 1.35,
}


def run_checks(study: Mapping[str, Results]) -> Iterator[Check]:
    """What the stored runs must show: the same as the checks that simulate on their own, by another way."""
    if "recovery" in study:
        limits = {"window": 7.605, "restarting": 2.85, "restarting_prefiltered": 3.9}
        for row in recovery(study["recovery"]):
            if row["estimator"] in limits:
                name = f"{row['estimator']}, within {row['band']:g}, {row['reading']} [s]"
                yield at_most("runs: recovery", name, or_never(row["longest"]), limits[row["estimator"]])
    if "recovery-in-noise" in study:
        for row in recovery(study["recovery-in-noise"]):
            if row["estimator"] == "restarting_prefiltered":
                reading, item = row["reading"], "runs: recovery in noise"
                yield at_most(item, f"false alarms in {row['data_sets']} data sets, {reading}", row["false_alarms"], 0)
                yield at_most(item, f"median time to {row['band']:g}, {reading} [s]", or_never(row["median"]), 6.1)
                yield at_most(item, f"longest time to {row['band']:g}, {reading} [s]", or_never(row["longest"]), 7.5)
    if "efficiency" in study:
        rows = list(efficiency(study["efficiency"]))
        for estimator, limit in EFFICIENT.items():
            ratio = max(row["ratio"] for row in rows if row["estimator"] == estimator)
            yield at_most("runs: efficiency", f"{estimator}: rms error / bound", ratio, limit)
        (bias,) = (row["bias"] for row in rows if (row["estimator"], row["tone"]) == ("finite_time", 2))
        yield Check("runs: efficiency", "finite_time: bias of the second", bias, 0.029, 0.035)


def or_never(value: float | None) -> float:
    """Infinity in place of None."""
    return np.inf if value is None else value


def by_estimator(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Rows of each estimator, those that are derived behind the others."""
    found: dict[str, list[Row]] = {}
    for row in sorted(rows, key=lambda row: row["derived"]):
        found.setdefault(row["estimator"], []).append(row)
    return found
