"""What the stored runs of the study say: settling times, recovery after a step, errors against the Cramer-Rao bound."""

from collections.abc import Iterator, Mapping
from itertools import pairwise
from typing import Any

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.frequency.base import FrequencyTrack
from ctid_cli.reporting.results import Results
from ctid_cli.simulation.frequency_measures import SignalSource

from .figures import DERIVED, GROUPS, plan_of, track_of

Row = dict[str, Any]

#: Errors below which settling is measured [rad/s].
BANDS = (0.05, 0.01, 1e-3)
#: Rows of the tracks that settling is measured on are so far apart [s].
TRACK_INTERVAL = 0.01
#: Number of data sets of each data cell whose tracks are measured, by the experiments that have any.
TRACKED = {"two-tones": 1, "harmonic": 1, "random": 20, "step": 1}
#: Readings of the step.
READINGS = ("jump", "continuous")


def is_derived(estimator: str) -> bool:
    """Whether an estimator stands in for a published one whose equations are not in print."""
    return estimator in GROUPS[DERIVED]


def sources(results: Results) -> dict[str, tuple[str, SignalSource]]:
    """Reading of the step (empty if there is none) and signal of every data cell, by its hash."""
    cells = plan_of(results).data_cells
    return {cell.hash: (str(cell.swept.get("phase_at_steps", "")), cell.source) for cell in cells}


def grouped(results: Results) -> Iterator[tuple[Row, list[Row]]]:
    """What all rows of one reading and estimator have in common, and its estimates."""
    cells = sources(results)
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in results.rows:
        groups.setdefault((cells[row["cell"]][0], row["estimator"]), []).append(row)
    for (reading, estimator), rows in groups.items():
        derived = "yes" if is_derived(estimator) else "no"
        common = {"experiment": results.experiment, "reading": reading, "estimator": estimator, "derived": derived}
        yield common, rows


def followed(results: Results) -> Iterator[tuple[Row, list[tuple[SignalSource, FrequencyTrack]]]]:
    """The same with the signals and tracks of the first data sets, of estimators that give one estimate per sample."""
    plan = plan_of(results)
    cells, parts = {cell.hash: cell for cell in plan.data_cells}, {part.name: part for part in plan.estimators}
    runs = TRACKED.get(results.experiment.rpartition("/")[2], 0)
    for common, rows in grouped(results):
        part = parts[common["estimator"]]
        if runs and not part.estimator.options.whole_record:
            tracked = [(cells[row["cell"]], row["replicate"]) for row in rows if row["replicate"] < runs]
            yield common, [(cell.source, track_of(cell, k, part, TRACK_INTERVAL)) for cell, k in tracked]


def measured(results: Results) -> Iterator[tuple[Row, list[Row]]]:
    """The same with the measures of the estimates that did not fail."""
    for common, rows in grouped(results):
        yield common, [row["measures"] for row in rows if row["measures"]]


def valid_share(found: list[Row]) -> float:
    """Mean share of valid estimates [%]."""
    return float(np.mean([measures["valid_share"] for measures in found]))


def by_tone(found: list[Row], name: str) -> Array:
    """One measure of all data sets and tones, shape (R, n)."""
    tones = sum(key.startswith("rms_") for key in found[0])
    return np.array([[measures[f"{name}_{k + 1}"] for k in range(tones)] for measures in found], dtype=float)


def larger_error(source: SignalSource, track: FrequencyTrack) -> Array:
    """Larger one of the errors of all tones [rad/s]."""
    return np.asarray(np.abs(track.frequencies - source.signal.frequencies_at(track.t)).max(axis=1))


def settle(t: Array, error: Array, band: float, since: float = 0.0, until: float = np.inf) -> float:
    """Time after `since` from which on the error stays below a band; infinite if it does not."""
    chosen = (t >= since - 1e-9) & (t < until - 1e-9)
    outside = np.flatnonzero(~(error[chosen] < band))
    if not outside.size:
        return 0.0
    return np.inf if outside[-1] == chosen.sum() - 1 else float(t[chosen][outside[-1] + 1] - since)


def settling(results: Results) -> Iterator[Row]:
    """Settling times of the tracks, to the interval of their rows, before and after a step."""
    for common, stored in followed(results):
        pieces: dict[str, list[list[float]]] = {}
        wrong = []
        for source, track in stored:
            error = larger_error(source, track)
            ends = [0.0, *(float(step) for step in source.signal.frequency_steps), np.inf]
            for since, until in pairwise(ends):
                times = [settle(track.t, error, band, since, until) for band in BANDS]
                pieces.setdefault(f"from {since:g} s", []).append(times)
            wrong.append(float((track.valid & (error > BANDS[0])).sum()) * float(track.t[1] - track.t[0]))
        for piece, times in pieces.items():
            middle, longest = np.median(times, axis=0), np.max(times, axis=0)
            yield {
                **common,
                "piece": piece,
                "data_sets": len(times),
                **{f"within_{band:g}": none_if_never(value) for band, value in zip(BANDS, middle, strict=True)},
                **{f"longest_{band:g}": none_if_never(value) for band, value in zip(BANDS, longest, strict=True)},
                "valid_but_off_by_0.05": float(np.median(wrong)),
            }


def residuals(results: Results) -> Iterator[Row]:
    """Root-mean-square errors and mean errors over the window of each specification."""
    for common, found in measured(results):
        rms, bias = np.median(by_tone(found, "rms"), axis=0), np.mean(by_tone(found, "bias"), axis=0)
        for k in range(rms.size):
            own = {"tone": k + 1, "data_sets": len(found), "rms": float(rms[k]), "bias": float(bias[k])}
            yield {**common, **own, "valid_share": valid_share(found)}


def recovery(results: Results) -> Iterator[Row]:
    """Times from the step until the errors of both tones are in the band to stay."""
    for common, found in measured(results):
        late = by_tone(found, "settling_after_step")
        times = np.where(np.isnan(late), np.inf, late).max(axis=1)
        alarms = [measures["false_alarms"] for measures in found if measures.get("false_alarms") is not None]
        yield {
            **common,
            "band": float(results.settings["success"]["band"]),
            "data_sets": len(found),
            "median": none_if_never(float(np.median(times))),
            "longest": none_if_never(float(times.max())),
            "never": int(np.isinf(times).sum()),
            "false_alarms": sum(alarms) if alarms else None,
            "rms": float(np.median(by_tone(found, "rms"), axis=0).max()),
        }


def efficiency(results: Results) -> Iterator[Row]:
    """Errors of the last estimates against the Cramer-Rao bound of Gaussian noise of the same variance."""
    ((_, source),) = sources(results).values()
    truth = source.signal.frequencies_at(np.zeros(1))[0]
    sigma = float(source.disturbance.half_width / np.sqrt(3.0))
    bound = cramer_rao(truth, source.sampling.samples, source.sampling.interval, sigma)
    for common, found in measured(results):
        del common["reading"]
        for k, e in enumerate((by_tone(found, "omega") - truth).T):
            rmse, deviation = float(np.sqrt(np.mean(e**2))), float(np.std(e, ddof=1))
            yield {
                **common,
                "tone": k + 1,
                "data_sets": e.size,
                "bound": float(bound[k]),
                "rmse": rmse,
                "ratio": rmse / bound[k],
                "ratio_error": monte_carlo_error(e) / bound[k],
                "bias": float(np.mean(e)),
                "bias_error": deviation / np.sqrt(e.size),
                "deviation": deviation,
                "valid_share": valid_share(found),
            }


def cramer_rao(omega: Array, samples: int, interval: float, sigma: float) -> Array:
    """Smallest standard deviations [rad/s] of the frequencies of ``sum sin(w t)`` in white Gaussian noise."""
    t = interval * (np.arange(samples) - 0.5 * (samples - 1))[:, None]
    angle = t * omega
    J = np.hstack([t * np.cos(angle), np.cos(angle), np.sin(angle)])
    return np.asarray(sigma * np.sqrt(np.diag(np.linalg.inv(J.T @ J))[: len(omega)]))


def monte_carlo_error(errors: Array) -> float:
    """Standard deviation of a root mean square of independent errors."""
    squares = errors**2
    return float(np.std(squares, ddof=1) / np.sqrt(squares.size) / (2.0 * np.sqrt(np.mean(squares))))


def none_if_never(value: float) -> float | None:
    """None in place of infinity."""
    return float(value) if np.isfinite(value) else None


def by_estimator(rows: list[Row], **wanted: Any) -> Mapping[str, list[Row]]:
    """Rows of each estimator, those that are derived behind the others."""
    found: dict[str, list[Row]] = {}
    for row in sorted(rows, key=lambda row: row["derived"]):
        if row.items() >= wanted.items():
            found.setdefault(row["estimator"], []).append(row)
    return found
