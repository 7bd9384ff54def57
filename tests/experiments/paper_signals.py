"""Four signals of the finite-time paper, by direct simulation.

They are A: two tones without noise, B: with a third, unmodelled one, C: with uniform noise, D: with a step of
both frequencies, in two interpretations: the phase jumps with the frequency, or is continuous.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ctid_cli.arrays import Array

#: Standard deviation of noise between -0.2 and 0.2.
SIGMA = 0.4 / np.sqrt(12.0)
TRUTH = np.array([2.0, 3.0])
INITIAL = (2.0, 5.0)
STEP = 30.0
#: h, d, epsilon, gamma of the delay estimators for each signal, as printed.
TUNING: dict[str, dict[str, Any]] = {
    "A": {"h": 0.1, "d": 0.13, "epsilon": 100.0, "gamma": 0.005},
    "B": {"h": 1.0, "d": 0.37, "epsilon": 0.1, "gamma": 1.0},
    "C": {"h": 0.6, "d": 0.4, "epsilon": 0.1, "gamma": 1.0},
    "D": {"h": 0.7, "d": 0.4, "epsilon": 0.1, "gamma": 1.0},
}


# Signals -----------------------------------------------------------------------------------------------


def clock(interval: float, duration: float) -> Array:
    return np.asarray(interval * np.arange(round(duration / interval)), dtype=float)


def stepped(interval: float, duration: float = 90.0) -> tuple[Array, Array]:
    """Return frequencies of signal D, shape (N, 2), and the clock."""
    t = clock(interval, duration)
    after = (t >= STEP - 1e-9)[:, None]
    return np.where(after, [2.0, 3.0], [1.8, 3.2]), t


def from_frequencies(omega: Array, interval: float, *, jump: bool) -> Array:
    """Return ``sin + cos`` of two changing frequencies: ``w(t) t``, or the integral of w, as phase."""
    t = interval * np.arange(len(omega))
    if jump:
        phase = omega * t[:, None]
    else:
        phase = np.vstack([np.zeros(2), np.cumsum(omega[:-1], axis=0)]) * interval
    return np.asarray(np.sin(phase[:, 0]) + np.cos(phase[:, 1]))


def signal(name: str, interval: float, duration: float, seed: int | None = None, *, jump: bool = True) -> Array:
    """Return one of the signals A to D; C with the noise of a seed."""
    t = clock(interval, duration)
    if name == "A":
        return np.asarray(np.sin(2 * t) + np.cos(3 * t))
    if name == "B":
        return np.asarray(np.sin(2 * t) + np.sin(3 * t) + 0.25 * np.sin(15 * t))
    if name == "C":
        noise = np.random.default_rng(seed).uniform(-0.2, 0.2, t.size)
        return np.asarray(np.sin(2 * t) + np.sin(3 * t) + noise)
    return from_frequencies(stepped(interval, duration)[0], interval, jump=jump)


def drem(kind: type[Any], name: str, **options: Any) -> Any:
    return kind(tones=2, initial_frequencies=INITIAL, **{**TUNING[name], **options})
