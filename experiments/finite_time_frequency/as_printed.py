"""What becomes of the four experiments if the formulas of the paper are taken as they are printed.

A to D are the experiments of figures 1 to 4.

python -m experiments.finite_time_frequency.as_printed
"""

from __future__ import annotations

import sys
from collections.abc import Iterator

import numpy as np

from ctid_cli.frequency.drem_finite_time import DremFiniteTime
from ctid_cli.frequency.drem_gradient import DremGradient
from ctid_cli.frequency.regression import determinant_from_tones, theta_of
from ctid_cli.reporting.layout import markdown_table, number
from experiments.finite_time_frequency.acceptance import SIGMA, TRUTH, TUNING, clock, drem, settle, signal, stepped

INTERVAL = 0.001
#: Length of the records; D is judged before its step [s].
DURATION = {"A": 60.0, "B": 60.0, "C": 60.0, "D": 30.0}
HEADER = ["what is printed", "measured", "as printed", "as corrected"]


def rows() -> Iterator[list[str]]:
    """Lines of the table."""
    yield from epsilon()
    yield from start()
    yield from sign()
    yield from excitation()
    yield from delay()


def components(name: str) -> tuple[np.ndarray, np.ndarray]:
    """The two sinusoids of a signal one by one, and their frequencies."""
    t = clock(INTERVAL, 60.0)
    omega = np.array([1.8, 3.2]) if name == "D" else TRUTH
    phases = np.array([0.0, 0.5 * np.pi if name in "AD" else 0.0])
    return np.sin(np.outer(t, omega) + phases), omega


def epsilon() -> Iterator[list[str]]:
    """The normalisation enters the determinant of n rows once, not in each row."""
    for name, tuning in TUNING.items():
        parts, omega = components(name)
        determinant = determinant_from_tones(
            parts, omega, round(tuning["h"] / INTERVAL), round(tuning["d"] / INTERVAL), INTERVAL
        )
        square = float(np.nanmean(determinant**2))
        rates = [tuning["gamma"] * tuning["epsilon"] ** (2 * power) * square for power in (2, 1)]
        what = f"epsilon in every row, undisturbed signal of experiment {name}"
        yield [what, "rate of the gradient [1/s]", *(number(rate, 2) for rate in rates)]
        times = []
        for power in ("literal", 1):
            track = drem(DremGradient, name, power=power).start(INTERVAL).run(parts.sum(axis=1))
            times.append(settle(track, omega, 0.05))
        yield [what, "gradient within 0.05 [s]", *(never_or(time) for time in times)]


def start() -> Iterator[list[str]]:
    """Delays that are filled with zeros put a transient into the estimate, which never leaves it."""
    for name in ("A", "B", "D"):
        samples = signal(name, INTERVAL, DURATION[name])
        truth = stepped(INTERVAL, DURATION["D"])[0] if name == "D" else TRUTH
        times = []
        for gated in (False, True):
            track = drem(DremFiniteTime, name, gated=gated).start(INTERVAL).run(samples)
            times.append(settle(track, truth, 0.05))
        what = f"delays begin with zeros, experiment {name}"
        yield [what, "finite time within 0.05 [s]", *(never_or(time) for time in times)]


def sign() -> Iterator[list[str]]:
    """The regressand of n tones has the sign of that of one tone."""
    h = TUNING["A"]["h"]
    theta = theta_of(TRUTH, h)
    found = []
    for sign_of in (-1.0, 1.0):
        roots = np.roots(np.concatenate(([1.0], sign_of * theta)))
        omega = np.sort(np.arccos(np.clip(roots.real, -1.0, 1.0)) / h)
        found.append(" and ".join(f"{w:.4g}" for w in omega))
    yield ["sign of the regressand, experiment A", "frequencies that the exact parameters give [rad/s]", *found]


def excitation() -> Iterator[list[str]]:
    """The mixed regression can vanish although the tones are different."""
    parts, omega = components("A")
    sizes = []
    for d in (2.0 * np.pi, TUNING["A"]["d"]):
        determinant = determinant_from_tones(parts, omega, 100, round(d / INTERVAL), INTERVAL)
        sizes.append(number(float(np.sqrt(np.nanmean(determinant**2))), 2))
    what = "the mixed regression is always excited (proposition 3), experiment A"
    yield [what, "rms determinant with d = 2 pi s and d = 0.13 s", *sizes]


def delay() -> Iterator[list[str]]:
    """A delay that satisfies the printed condition is useless in noise; the paper's own delays do not satisfy it."""
    samples = signal("A", INTERVAL, 20.0)
    samples = samples + SIGMA * np.random.default_rng(0).standard_normal(samples.size)
    errors = []
    for tuning in ("A", "C"):
        track = drem(DremFiniteTime, tuning).start(INTERVAL).run(samples)
        errors.append(number(float(np.abs(track.omega[-1] - TRUTH).max()), 2))
    what = "h < pi/(2 w_max) = 0.52 s (remark 1), experiment A with noise"
    yield [what, "larger error at 20 s, h = 0.1 s and h = 0.6 s [rad/s]", *errors]


def never_or(time: float) -> str:
    """A time, or that it never came."""
    return f"{time:.3g}" if np.isfinite(time) else "never"


def table() -> str:
    """All lines as Markdown."""
    return markdown_table(HEADER, list(rows()), "llrr")


if __name__ == "__main__":
    sys.stdout.write(table() + "\n")
