"""Claims on the study's results: those of the paper, and further ones."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd

from ctid_cli.reporting.results import Results
from ctid_cli.reporting.study import last_part
from ctid_cli.studies.claims import Claim, near, within

from .measures import READINGS, efficiency, followed, larger_error, recovery, residuals, settling

#: Longest times to return to 1e-6 rad/s after a step without noise [s].
RECOVERY = {"window": 7.605, "restarting": 2.85, "restarting_prefiltered": 3.9}
#: Largest root-mean-square error over the Cramer-Rao bound.
EFFICIENT = {"restarting_prefiltered": 2.6, "restarting_total": 4.0, "esprit": 1.35, "nonlinear_least_squares": 1.35}
#: Interval [s] in which the finite-time estimate is exact, and its tolerance.
EXACT = {"two-tones": (0.66, np.inf, 1e-8), "step": (3.6, 30.0, 1e-10)}
#: Settling times of the gradient in some bands [s]: by experiment, reading of the step and piece of the record.
GRADIENT = (
    ("two-tones", "", "from 0 s", {0.05: 10.14, 0.01: 13.66, 1e-3: 19.57}),
    ("step", "jump", "from 0 s", {0.05: 6.34, 0.01: 8.26, 1e-3: 10.80}),
    ("step", "jump", "from 30 s", {0.05: 6.33, 0.01: 9.97, 1e-3: 15.55}),
    ("step", "continuous", "from 30 s", {1e-3: 14.06}),
)


def one(rows: pd.DataFrame, **wanted: Any) -> pd.Series:
    """Return the only row with these properties."""
    (place,) = np.flatnonzero(np.logical_and.reduce([rows[name] == value for name, value in wanted.items()]))
    return rows.iloc[place]


def finite_time_is_exact(results: Results) -> Iterator[Claim]:
    """Test finite time without noise: exact from n(2h + d) on, and not valid before."""
    begin, until, limit = EXACT[last_part(results.experiment)]
    source, track = next(rest for common, *rest in followed(results) if "finite_time" in common)
    error = larger_error(source, track)
    before, after = track.t < begin - 1e-9, (track.t > begin - 1e-9) & (track.t < until - 1e-9)
    yield within(f"finite time: error from {begin} s on", error[after].max(), high=limit)
    yield within("finite time: error just before", error[before][-1], low=0.01)
    yield within("finite time: valid estimates before", track.valid[before].sum(), high=0)


def gradient_settles(results: Results) -> Iterator[Claim]:
    """Test the settling times of the gradient estimate."""
    for name, reading, piece, targets in GRADIENT:
        if name == last_part(results.experiment):
            row = one(settling(results), estimator="gradient", reading=reading, piece=piece)
            for band, target in targets.items():
                claim = f"gradient within {band:g}, {piece}{f', {reading}' if reading else ''} [s]"
                yield near(claim, row[f"within_{band:g}"], target, 0.05)


def disturbance_leaves_a_bias(harmonic: Results) -> Iterator[Claim]:
    """Test the bias from a tone that is not modelled."""
    for tone, target, tolerance in ((1, 0.0039, 0.0005), (2, -0.0232, 0.001)):
        bias = one(residuals(harmonic), estimator="finite_time", tone=tone)["bias"]
        yield near(f"finite time: mean error of w{tone}", bias, target, tolerance)
    row = one(settling(harmonic), estimator="finite_time")
    yield near("finite time within 0.05 [s]", row["within_0.05"], 6.83, 0.1)


def prefilter_removes_the_noise(random: Results) -> Iterator[Claim]:
    """Test a tracker with a prefilter in noise."""
    rms = residuals(random).query("estimator == 'restarting_prefiltered'")["rms"]
    yield within("restarting_prefiltered: median rms error", rms.max(), high=2e-4)


def memory_ends(results: Results) -> Iterator[Claim]:
    """Test that estimators with finite memory are in finite time again after a step without noise."""
    for row in recovery(results).query("estimator in @RECOVERY").itertuples():
        yield within(
            f"{row.estimator}, within {row.band:g}, {row.reading} [s]", row.longest, high=RECOVERY[row.estimator]
        )


def steps_are_found_in_noise(results: Results) -> Iterator[Claim]:
    """Test steps in noise: time to detection, and no false alarm."""
    for reading in READINGS:
        row = one(recovery(results), estimator="restarting_prefiltered", reading=reading)
        name = f"false alarms in {row['data_sets']} data sets, {reading}"
        yield within(name, row["false_alarms"], high=0)
        yield within(f"median time to {row['band']:g}, {reading} [s]", row["median"], high=6.1)
        yield within(f"longest time to {row['band']:g}, {reading} [s]", row["longest"], high=7.5)


def errors_reach_the_bound(results: Results) -> Iterator[Claim]:
    """Test errors against the Cramer-Rao bound, and the bias of the finite-time estimate."""
    rows = efficiency(results)
    for estimator, ratio in rows.groupby("estimator")["ratio"].max()[[*EFFICIENT]].items():
        yield within(f"{estimator}: rms error / bound", ratio, high=EFFICIENT[estimator])
    bias = one(rows, estimator="finite_time", tone=2)["bias"]
    yield within("finite_time: bias of w2", bias, 0.029, 0.035)


def comparators_settle(two_tones: Results) -> Iterator[Claim]:
    """Test the derived comparators against their own baseline."""
    for estimator, limit in (("observer", 30.0), ("filter", 20.0)):
        time = one(settling(two_tones), estimator=estimator)["within_0.001"]
        yield within(f"{estimator} within 0.001 [s]", time, high=limit)
