"""Measures of the stored runs: settling times, recovery after a step, errors against the Cramer-Rao bound."""

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
import pandas as pd

from ctid_cli.arrays import Array
from ctid_cli.frequency.base import FrequencyTrack
from ctid_cli.reporting.results import Results
from ctid_cli.simulation.frequency_measures import SignalSource

from .figures import DERIVED, GROUPS, plan_of, track_of

#: Errors below which settling is measured [rad/s].
BANDS = (0.05, 0.01, 1e-3)
#: Interval between the rows of the tracks on which settling is measured [s].
TRACK_INTERVAL = 0.01
#: Number of data sets of each data cell whose tracks are measured, by experiment.
TRACKED = {"two-tones": 1, "harmonic": 1, "random": 20, "step": 1}
#: Readings of the step.
READINGS = ("jump", "continuous")
#: Columns that identify the estimates of one estimator and reading of the step (empty if there is none).
COMMON = ["experiment", "reading", "estimator", "derived"]


def is_derived(estimator: str) -> bool:
    """Return whether an estimator replaces a published one whose equations are not in print."""
    return estimator in GROUPS[DERIVED]


def estimates_of(results: Results) -> pd.DataFrame:
    """Return common columns and measures of each estimate that did not fail."""
    readings = [str(cell["swept"].get("phase_at_steps", "")) for cell in results.manifest["data_cells"]]
    frame, stored = results.estimates[["experiment", "estimator", "replicate"]], results.stored
    frame["cell"] = results.groups["cell"][results.numbers].to_numpy()
    frame["reading"] = frame["cell"].map(dict(enumerate(readings)))
    frame["derived"] = frame["estimator"].map(is_derived).map({True: "yes", False: "no"})
    frame = frame.join(pd.DataFrame(stored.column("measures"), columns=stored.export.parts("measures")))
    return frame[~stored.failures]


def by_tone(found: pd.DataFrame, *names: str) -> pd.DataFrame:
    """Return a row for each tone of each estimate, with some of its measures."""
    tones = [int(name.removeprefix("rms_")) for name in found if name.startswith("rms_")]
    others = [name for name in (*COMMON, "valid_share") if name in found]
    parts = [
        found[others].assign(tone=tone, **{name: found[f"{name}_{tone}"] for name in names}) for tone in sorted(tones)
    ]
    return pd.concat(parts).sort_index(kind="stable")


def larger_error(source: SignalSource, track: FrequencyTrack) -> Array:
    """Return the largest error of all tones [rad/s]."""
    return np.asarray(np.abs(track.frequencies - source.signal.frequencies_at(track.t)).max(axis=1))


def settle(t: Array, error: Array, band: float, since: float = 0.0, until: float = np.inf) -> float:
    """Return the time after `since` from which on the error stays below a band; infinite if it does not."""
    chosen = (t >= since - 1e-9) & (t < until - 1e-9)
    outside = np.flatnonzero(~(error[chosen] < band))
    if not outside.size:
        return 0.0
    return np.inf if outside[-1] == chosen.sum() - 1 else float(t[chosen][outside[-1] + 1] - since)


def settling(results: Results) -> pd.DataFrame:
    """Return settling times of the tracks, with the resolution of their rows, before and after a step."""
    within = [f"within_{band:g}" for band in BANDS]
    times = pd.DataFrame(_settled(results), columns=[*COMMON, "piece", *within, "off"])
    pieces = times.groupby([*COMMON, "piece"], sort=False)
    longest = pieces[within].max().rename(columns=lambda name: name.replace("within", "longest"))
    frame = pieces.size().to_frame("data_sets").join(pieces[within].median()).join(longest)
    return frame.assign(**{"valid_but_off_by_0.05": pieces["off"].median()}).reset_index().replace(np.inf, np.nan)


def _settled(results: Results) -> Iterator[tuple[object, ...]]:
    """Yield the settling times of each piece of the first tracks, for estimators with one estimate per sample."""
    for common, source, track in followed(results):
        error = larger_error(source, track)
        off = float((track.valid & (error > BANDS[0])).sum()) * float(track.t[1] - track.t[0])
        ends = [0.0, *(float(step) for step in source.signal.frequency_steps), np.inf]
        for since, until in pairwise(ends):
            times = (settle(track.t, error, band, since, until) for band in BANDS)
            yield (*common, f"from {since:g} s", *times, off)


def followed(results: Results) -> Iterator[tuple[tuple[str, ...], SignalSource, FrequencyTrack]]:
    """Yield the common columns, the signal and the track of the first data sets."""
    plan, runs = plan_of(results), TRACKED.get(results.experiment.rpartition("/")[2], 0)
    parts = {part.name: part for part in plan.estimators if not part.estimator.options.whole_record}
    rows = estimates_of(results)
    rows = rows[(rows["replicate"] < runs) & rows["estimator"].isin([*parts])]
    for *common, k, replicate in rows[[*COMMON, "cell", "replicate"]].itertuples(index=False, name=None):
        cell, part = plan.data_cells[k], parts[common[COMMON.index("estimator")]]
        yield (*common,), cell.source, track_of(cell, replicate, part, TRACK_INTERVAL)


def residuals(results: Results) -> pd.DataFrame:
    """Return root-mean-square errors and mean errors over the window of each specification."""
    tones = by_tone(estimates_of(results), "rms", "bias").groupby([*COMMON, "tone"], sort=False)
    middle, means = tones["rms"].median(), tones[["bias", "valid_share"]].mean()
    return tones.size().to_frame("data_sets").assign(rms=middle).join(means).reset_index()


def recovery(results: Results) -> pd.DataFrame:
    """Return times from the step until the errors of both tones stay in the band."""
    found = estimates_of(results)
    late = found.filter(like="settling_after_step").fillna(np.inf).max(axis=1)
    groups = found.assign(late=late, never=np.isinf(late)).groupby(COMMON, sort=False)
    frame = groups["late"].agg(["size", "median", "max"]).set_axis(["data_sets", "median", "longest"], axis=1)
    frame.insert(0, "band", float(results.settings["success"]["band"]))
    frame = frame.assign(never=groups["never"].sum(), false_alarms=groups["false_alarms"].sum(min_count=1))
    rms = groups[[name for name in found if name.startswith("rms_")]].median().max(axis=1)
    return frame.assign(rms=rms).reset_index().replace(np.inf, np.nan)


def efficiency(results: Results) -> pd.DataFrame:
    """Return errors of the last estimates against the Cramer-Rao bound for Gaussian noise of the same variance."""
    (cell,) = plan_of(results).data_cells
    source = cell.source
    truth = source.signal.frequencies_at(np.zeros(1))[0]
    sigma = float(source.disturbance.half_width / np.sqrt(3.0))
    bound = cramer_rao(truth, source.sampling.samples, source.sampling.interval, sigma)
    common = [name for name in COMMON if name != "reading"]
    rows = []
    for (*place, tone), own in by_tone(estimates_of(results), "omega").groupby([*common, "tone"], sort=False):
        errors = own["omega"].to_numpy() - truth[tone - 1]
        least, deviation = float(bound[tone - 1]), float(np.std(errors, ddof=1))
        rmse = float(np.sqrt(np.mean(errors**2)))
        ratios = rmse / least, monte_carlo_error(errors) / least
        biases = float(np.mean(errors)), deviation / np.sqrt(errors.size)
        rows.append((*place, tone, errors.size, least, rmse, *ratios, *biases, deviation, own["valid_share"].mean()))
    names = ["tone", "data_sets", "bound", "rmse", "ratio", "ratio_error", "bias", "bias_error", "deviation"]
    return pd.DataFrame(rows, columns=[*common, *names, "valid_share"])


def cramer_rao(omega: Array, samples: int, interval: float, sigma: float) -> Array:
    """Return the least standard deviations [rad/s] of the frequencies of ``sum sin(w t)`` in white Gaussian noise."""
    t = interval * (np.arange(samples) - 0.5 * (samples - 1))[:, None]
    angle = t * omega
    J = np.hstack([t * np.cos(angle), np.cos(angle), np.sin(angle)])
    return np.asarray(sigma * np.sqrt(np.diag(np.linalg.inv(J.T @ J))[: len(omega)]))


def monte_carlo_error(errors: Array) -> float:
    """Return the standard deviation of a root mean square of independent errors."""
    squares = errors**2
    return float(np.std(squares, ddof=1) / np.sqrt(squares.size) / (2.0 * np.sqrt(np.mean(squares))))
