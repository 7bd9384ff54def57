"""What must hold of the study's results: the claims of the paper, and what is claimed beyond it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from ctid_cli.reporting.results import Results
from ctid_cli.studies.catalogue import last_part
from ctid_cli.studies.claim import Claim, near, within

from .measures import BANDS, READINGS, Row, efficiency, followed, larger_error, recovery, residuals, settling

#: Longest times to come back to 1e-6 rad/s after a step without noise [s].
RECOVERY = {"window": 7.605, "restarting": 2.85, "restarting_prefiltered": 3.9}
#: Largest root-mean-square error over the Cramer-Rao bound.
EFFICIENT = {
    "restarting_prefiltered": 2.6,
    "restarting_total": 4.0,
    "esprit": 1.35,
    "nonlinear_least_squares": 1.35,
}
#: When the gradient has settled within each band [s]: without a step, before one, and after one that jumps.
GRADIENT = ((10.14, 13.66, 19.57), (6.34, 8.26, 10.80), (6.33, 9.97, 15.55))


def one(rows: Iterator[Row], **wanted: Any) -> Row:
    """The one row of these properties."""
    (row,) = (row for row in rows if row.items() >= wanted.items())
    return row


def finite_time_is_exact(two_tones: Results, step: Results) -> Iterator[Claim]:
    """Finite time without noise: right from n(2h + d) on, and not valid before."""
    for results, begin, until, limit in ((two_tones, 0.66, np.inf, 1e-8), (step, 3.6, 30.0, 1e-10)):
        _, stored = next(pair for pair in followed(results) if pair[0]["estimator"] == "finite_time")
        source, track = stored[0]
        error = larger_error(source, track)
        before, after = track.t < begin - 1e-9, (track.t > begin - 1e-9) & (track.t < until - 1e-9)
        name = last_part(results.experiment)
        yield within(name, f"finite time: error from {begin} s on", error[after].max(), high=limit)
        yield within(name, "finite time: error just before", error[before][-1], low=0.01)
        yield within(name, "finite time: valid estimates before", track.valid[before].sum(), high=0)


def gradient_settles(two_tones: Results, step: Results) -> Iterator[Claim]:
    """Settling times of the gradient estimate."""
    pieces = ((two_tones, "", "from 0 s"), (step, "jump", "from 0 s"), (step, "jump", "from 30 s"))
    for (results, reading, piece), targets in zip(pieces, GRADIENT, strict=True):
        row = one(settling(results), estimator="gradient", reading=reading, piece=piece)
        for band, target in zip(BANDS, targets, strict=True):
            name = f"gradient within {band:g}, {piece} [s]"
            yield near(last_part(results.experiment), name, row[f"within_{band:g}"], target, 0.05)
    row = one(settling(step), estimator="gradient", reading="continuous", piece="from 30 s")
    yield near("step", "gradient within 0.001, from 30 s, phase goes on [s]", row["within_0.001"], 14.1, 0.1)


def disturbance_leaves_a_bias(harmonic: Results) -> Iterator[Claim]:
    """A tone that the model does not have."""
    for tone, target, tolerance in ((1, 0.0039, 0.0005), (2, -0.0232, 0.001)):
        bias = one(residuals(harmonic), estimator="finite_time", tone=tone)["bias"]
        yield near("harmonic", f"finite time: mean error of w{tone}", bias, target, tolerance)
    row = one(settling(harmonic), estimator="finite_time")
    yield near("harmonic", "finite time within 0.05 [s]", row["within_0.05"], 6.83, 0.1)


def prefilter_removes_the_noise(random: Results) -> Iterator[Claim]:
    """A tracker with a prefilter in noise."""
    rms = [row["rms"] for row in residuals(random) if row["estimator"] == "restarting_prefiltered"]
    yield within("random", "restarting_prefiltered: median rms error", max(rms), high=2e-4)


def memory_ends(results: Results) -> Iterator[Claim]:
    """After a step without noise, estimators whose memory ends are in finite time again."""
    for row in recovery(results):
        if row["estimator"] in RECOVERY:
            name = f"{row['estimator']}, within {row['band']:g}, {row['reading']} [s]"
            yield within("recovery", name, row["longest"], high=RECOVERY[row["estimator"]])


def steps_are_found_in_noise(results: Results) -> Iterator[Claim]:
    """Steps in noise: how long, and no false alarm."""
    for reading in READINGS:
        row = one(recovery(results), estimator="restarting_prefiltered", reading=reading)
        name = f"false alarms in {row['data_sets']} data sets, {reading}"
        yield within("recovery-in-noise", name, row["false_alarms"], high=0)
        yield within("recovery-in-noise", f"median time to {row['band']:g}, {reading} [s]", row["median"], high=6.1)
        yield within("recovery-in-noise", f"longest time to {row['band']:g}, {reading} [s]", row["longest"], high=7.5)


def errors_reach_the_bound(results: Results) -> Iterator[Claim]:
    """Errors against the Cramer-Rao bound, and the bias of the finite-time estimate."""
    rows = list(efficiency(results))
    for estimator, limit in EFFICIENT.items():
        ratio = max(row["ratio"] for row in rows if row["estimator"] == estimator)
        yield within("efficiency", f"{estimator}: rms error / bound", ratio, high=limit)
    bias = one(iter(rows), estimator="finite_time", tone=2)["bias"]
    yield within("efficiency", "finite_time: bias of w2", bias, 0.029, 0.035)


def comparators_settle(two_tones: Results) -> Iterator[Claim]:
    """The derived comparators against their own baseline."""
    for estimator, limit in (("observer", 30.0), ("filter", 20.0)):
        time = one(settling(two_tones), estimator=estimator)["within_0.001"]
        yield within("two-tones", f"{estimator} within 0.001 [s]", time, high=limit)
