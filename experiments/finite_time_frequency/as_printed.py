"""Results of the four experiments, A to D, with the formulas of the paper as printed."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from ctid_cli.arrays import Array
from ctid_cli.frequency.delay_regression import theta_of
from ctid_cli.reporting.layout import number
from ctid_cli.reporting.study import find_study

from .measures import settle

INTERVAL = 0.001
#: Standard deviation of noise between -0.2 and 0.2.
SIGMA = 0.4 / np.sqrt(12.0)
#: Experiments of the paper, with the frequencies [rad/s] and phases of their two tones before any step.
EXPERIMENTS = {
    "A": ("two-tones", (2.0, 3.0), (0.0, 0.5 * np.pi)),
    "B": ("harmonic", (2.0, 3.0), (0.0, 0.0)),
    "C": ("random", (2.0, 3.0), (0.0, 0.0)),
    "D": ("step", (1.8, 3.2), (0.0, 0.5 * np.pi)),
}
HEADER = ["what is printed", "measured", "as printed", "as corrected"]


def table() -> pd.DataFrame:
    """Return all lines."""
    return pd.DataFrame(rows(), columns=HEADER)


def rows() -> Iterator[list[str]]:
    """Yield the lines of the table."""
    for part in (epsilon, start, sign, excitation, delay):
        yield from part()


def options(name: str, estimator: str = "finite_time", **changes: Any) -> Any:
    """Return an estimator with the tuning of one experiment, changed."""
    plan = find_study("finite-time-frequency").plan(EXPERIMENTS[name][0])
    own = next(cell.estimator.options for cell in plan.estimators if cell.name == estimator)
    return replace(own, **changes)


def tones(name: str, duration: float = 60.0) -> Array:
    """Return the two sinusoids of a signal, shape (N, 2)."""
    _, omega, phases = EXPERIMENTS[name]
    t = INTERVAL * np.arange(round(duration / INTERVAL))
    return np.sin(np.outer(t, omega) + phases)


def settled(estimator: Any, name: str, samples: Array) -> str:
    """Return the time from which both errors stay below 0.05 rad/s [s]."""
    track = estimator.track(samples, INTERVAL)
    time = settle(track.t, np.abs(track.frequencies - EXPERIMENTS[name][1]).max(axis=1), 0.05)
    return f"{time:.3g}" if np.isfinite(time) else "never"


def determinant_from_tones(parts: Array, omega: Array, lag: int, spacing: int) -> Array:
    """Return the determinant of the stacked regressors in closed form.

    ``phi(t) = 2^n sum_i [c_i^(n-1) ... c_i 1] y_i(t - n h)``, hence
    ``det = 2^(n n) det[y_i(t - n h - j d)] prod_(i<j) (c_i - c_j)``.
    """
    count, n = parts.shape
    c = np.cos(omega * lag * INTERVAL)
    vandermonde = np.prod([c[i] - c[j] for i in range(n) for j in range(i + 1, n)])
    instants = np.arange(2 * n * lag + (n - 1) * spacing, count)
    stacked = parts[instants[:, None] - n * lag - spacing * np.arange(n)]
    return np.asarray(2.0 ** (n * n) * vandermonde * np.linalg.det(stacked))


def rms_determinant(name: str, h: float, d: float) -> float:
    """Return the root mean square of the determinant of the mixed regression."""
    delays = (round(h / INTERVAL), round(d / INTERVAL))
    determinant = determinant_from_tones(tones(name), np.array(EXPERIMENTS[name][1]), *delays)
    return float(np.sqrt(np.mean(determinant**2)))


def epsilon() -> Iterator[list[str]]:
    """Show that the normalisation enters the determinant of n rows once, not in each row."""
    for name in EXPERIMENTS:
        tuning = options(name)
        square = rms_determinant(name, tuning.h, tuning.d) ** 2
        rates = [number(tuning.gamma * tuning.epsilon ** (2 * power) * square, 2) for power in (2, 1)]
        what = f"epsilon in every row, undisturbed signal of experiment {name}"
        yield [what, "rate of the gradient [1/s]", *rates]
        samples = tones(name).sum(axis=1)
        times = [settled(options(name, "gradient", power=power), name, samples) for power in ("literal", 1)]
        yield [what, "gradient within 0.05 [s]", *times]


def start() -> Iterator[list[str]]:
    """Show that delays filled with zeros cause a transient of the estimate, which never decays."""
    for name in ("A", "B", "D"):
        samples = tones(name, 30.0 if name == "D" else 60.0).sum(axis=1)
        if name == "B":
            samples += 0.25 * np.sin(15.0 * INTERVAL * np.arange(samples.size))
        times = [settled(options(name, gated=gated), name, samples) for gated in (False, True)]
        yield [f"delays begin with zeros, experiment {name}", "finite time within 0.05 [s]", *times]


def sign() -> Iterator[list[str]]:
    """Show that the regressand of n tones has the sign of that of one tone."""
    h = options("A").h
    theta = theta_of(np.array(EXPERIMENTS["A"][1]), h)
    found = []
    for sign_of in (-1.0, 1.0):
        roots = np.roots(np.concatenate(([1.0], sign_of * theta)))
        omega = np.sort(np.arccos(np.clip(roots.real, -1.0, 1.0)) / h)
        found.append(" and ".join(f"{w:.4g}" for w in omega))
    yield ["sign of the regressand, experiment A", "frequencies that the exact parameters give [rad/s]", *found]


def excitation() -> Iterator[list[str]]:
    """Show that the mixed regression can vanish although the tones are different."""
    sizes = [number(rms_determinant("A", 0.1, d), 2) for d in (2.0 * np.pi, options("A").d)]
    what = "the mixed regression is always excited (proposition 3), experiment A"
    yield [what, "rms determinant with d = 2 pi s and d = 0.13 s", *sizes]


def delay() -> Iterator[list[str]]:
    """Show that a delay within the printed condition is useless in noise; the paper's own delays violate it."""
    samples = tones("A", 20.0).sum(axis=1)
    samples = samples + SIGMA * np.random.default_rng(0).standard_normal(samples.size)
    tracks = [options(tuning).track(samples, INTERVAL) for tuning in ("A", "C")]
    errors = [number(float(np.abs(track.frequencies[-1] - EXPERIMENTS["A"][1]).max()), 2) for track in tracks]
    what = "h < pi/(2 w_max) = 0.52 s (remark 1), experiment A with noise"
    yield [what, "larger error at 20 s, h = 0.1 s and h = 0.6 s [rad/s]", *errors]
