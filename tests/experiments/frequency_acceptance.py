"""Numbers that the frequency estimators must reach on the four signals of the finite-time paper, by direct simulation.

The signals are A: two tones without noise, B: with a third, unmodelled one, C: with uniform noise, D: with a step of
both frequencies, read in two ways: the phase jumps with the frequency, or goes on.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from ctid_cli.arrays import Array
from ctid_cli.frequency.base import FrequencyTrack
from ctid_cli.frequency.drem import DremFiniteTime
from ctid_cli.frequency.flags import Flag
from ctid_cli.frequency.restarting_least_squares import RestartingLeastSquares
from ctid_cli.studies.claims import Claim, near, within

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


def at_most(name: str, value: float, limit: float) -> Claim:
    return within(name, value, high=limit)


# Signals -----------------------------------------------------------------------------------------------


def clock(interval: float, duration: float) -> Array:
    return np.asarray(interval * np.arange(round(duration / interval)), dtype=float)


def stepped(interval: float, duration: float = 90.0) -> tuple[Array, Array]:
    """Frequencies of signal D, shape (N, 2), and the clock."""
    t = clock(interval, duration)
    after = (t >= STEP - 1e-9)[:, None]
    return np.where(after, [2.0, 3.0], [1.8, 3.2]), t


def from_frequencies(omega: Array, interval: float, *, jump: bool) -> Array:
    """``sin + cos`` of two changing frequencies: ``w(t) t``, or the integral of w, as phase."""
    t = interval * np.arange(len(omega))
    if jump:
        phase = omega * t[:, None]
    else:
        phase = np.vstack([np.zeros(2), np.cumsum(omega[:-1], axis=0)]) * interval
    return np.asarray(np.sin(phase[:, 0]) + np.cos(phase[:, 1]))


def signal(name: str, interval: float, duration: float, seed: int | None = None, *, jump: bool = True) -> Array:
    """One of the signals A to D; C with the noise of a seed."""
    t = clock(interval, duration)
    if name == "A":
        return np.asarray(np.sin(2 * t) + np.cos(3 * t))
    if name == "B":
        return np.asarray(np.sin(2 * t) + np.sin(3 * t) + 0.25 * np.sin(15 * t))
    if name == "C":
        noise = np.random.default_rng(seed).uniform(-0.2, 0.2, t.size)
        return np.asarray(np.sin(2 * t) + np.sin(3 * t) + noise)
    return from_frequencies(stepped(interval, duration)[0], interval, jump=jump)


# Measures ----------------------------------------------------------------------------------------------


def settle(track: FrequencyTrack, truth: Array, band: float, since: float = 0.0, until: float = np.inf) -> float:
    """Time after `since` from which on both errors stay below a band; infinite if they do not."""
    chosen = (track.t >= since - 1e-9) & (track.t < until - 1e-9)
    error = np.abs(track.frequencies - truth).max(axis=1)[chosen]
    outside = np.flatnonzero(~(error < band))
    if not outside.size:
        return 0.0
    return np.inf if outside[-1] == error.size - 1 else float(track.t[chosen][outside[-1] + 1] - since)


def cramer_rao(duration: float, interval: float, sigma: float, phases: tuple[float, float] = (0.0, 0.0)) -> Array:
    """Smallest standard deviations of the frequencies of ``sin(2 t + p1) + sin(3 t + p2)`` in white Gaussian noise."""
    t = clock(interval, duration)
    t = t - t.mean()
    columns = []
    for omega, phase in zip(TRUTH, phases, strict=True):
        angle = omega * t + phase
        columns += [t * np.cos(angle), np.cos(angle), np.sin(angle)]
    J = np.column_stack(columns)
    return np.asarray(sigma * np.sqrt(np.diag(np.linalg.inv(J.T @ J))[::3]), dtype=float)


def drem(kind: type[Any], name: str, **options: Any) -> Any:
    return kind(tones=2, initial_frequencies=INITIAL, **{**TUNING[name], **options})


def tracker(prefilter: float = 1.0, h: float = 0.7, **options: Any) -> RestartingLeastSquares:
    return RestartingLeastSquares(tones=2, h=h, prefilter=prefilter, **options)


# Items -------------------------------------------------------------------------------------------------


def disturbed(interval: float = 0.001) -> Iterator[Claim]:
    """A tone that the model does not have."""
    track = drem(DremFiniteTime, "B").track(signal("B", interval, 60.0), interval)
    mean = (track.frequencies[round(50.0 / interval) :] - TRUTH).mean(axis=0)
    yield near("B: finite time, mean error, first", mean[0], 0.0039, 0.0005)
    yield near("B: finite time, mean error, second", mean[1], -0.0232, 0.001)
    yield near("B: finite time within 0.05 [s]", settle(track, TRUTH, 0.05), 6.83, 0.1)
    # A moving average over one period removes the third tone.
    length = round(2 * np.pi / 15 / interval)
    averaged = np.convolve(signal("B", interval, 60.0), np.full(length, 1.0 / length), mode="valid")
    track = drem(DremFiniteTime, "B").track(averaged, interval)
    final = np.abs(track.frequencies[round(50.0 / interval) :] - TRUTH).max()
    yield at_most("B: finite time after a moving average", final, 1e-5)


def noisy(seeds: int = 60, tracked: int = 10, interval: float = 0.001) -> Iterator[Claim]:
    """Bias of the finite-time estimate in noise, and a tracker with a prefilter that has none."""
    errors = np.array(
        [
            drem(DremFiniteTime, "C").track(signal("C", interval, 20.0, seed), interval).frequencies[-1] - TRUTH
            for seed in range(seeds)
        ]
    )
    yield near("C: finite time, bias of the second", errors[:, 1].mean(), 0.032, 0.003)
    rms = []
    for seed in range(tracked):
        track = tracker().track(signal("C", interval, 60.0, seed), interval)
        rms.append(np.sqrt(np.mean((track.frequencies[round(50.0 / interval) :] - TRUTH) ** 2, axis=0)))
    yield at_most("C: tracker with prefilter, median rms error", np.median(rms, axis=0).max(), 2e-4)


def tracked_step(seed: int, *, jump: bool, interval: float = 0.001) -> tuple[float, int, int]:
    """Settling time after the step in noise, alarms before the step, and alarms from 10 s after it on."""
    truth = stepped(interval)[0]
    y = signal("D", interval, 90.0, jump=jump)
    y = y + SIGMA * np.random.default_rng(seed).standard_normal(y.size)
    track = tracker().track(y, interval)
    changed = (track.flags & Flag.CHANGED) > 0
    begins = track.t[1:][changed[1:] & ~changed[:-1]]
    return settle(track, truth, 0.02, STEP), int((begins < STEP).sum()), int((begins > STEP + 10.0).sum())


def robust(seeds: int = 20, first: int = 1000) -> Iterator[Claim]:
    """Steps in noise: how long, and no false alarm; a second step while the delays are flushed."""
    for jump in (True, False):
        results = np.array([tracked_step(seed, jump=jump) for seed in range(first, first + seeds)])
        reading = "jump" if jump else "continuous"
        yield at_most(f"false alarms, {reading}", results[:, 1:].sum(), 0)
        yield at_most(f"median time to 0.02, {reading} [s]", np.median(results[:, 0]), 6.1)
        yield at_most(f"longest time to 0.02, {reading} [s]", results[:, 0].max(), 7.5)
    interval = 0.001
    t = clock(interval, 60.0)
    omega = np.column_stack([np.select([t < 30 - 1e-9, t < 31 - 1e-9], [1.8, 2.2], 2.0), np.where(t < 30, 3.2, 3.0)])
    track = tracker(0.0).track(from_frequencies(omega, interval, jump=False), interval)
    yield at_most("second step within 1e-6, no noise [s]", settle(track, omega, 1e-6, 31.0), 3.9)
    # The same behind a prefilter: the restart mixes the last two steps, which only a comparison of halves can show.
    omega = np.column_stack([np.where(t < 33 - 1e-9, 1.8, 1.2), np.select([t < 30 - 1e-9], [3.0], 4.0)])
    track = tracker(1.0).track(from_frequencies(omega, interval, jump=False), interval)
    name = "second step within 1e-6, prefilter 1 s, no noise [s]"
    yield at_most(name, settle(track, omega, 1e-6, 33.0), 9.0)


def quiet(seeds: int = 10, duration: float = 600.0, interval: float = 0.001) -> Iterator[Claim]:
    """No alarm on a long stationary signal."""
    alarms = 0
    for seed in range(seeds):
        track = tracker().track(signal("C", interval, duration, 5000 + seed), interval)
        alarms += int(((track.flags & Flag.CHANGED) > 0).any())
    yield at_most(f"records of {duration:g} s with a false alarm, of {seeds}", alarms, 0)


def efficient(seeds: int = 100, first: int = 2000, interval: float = 0.001, duration: float = 20.0) -> Iterator[Claim]:
    """Root mean square errors against the Cramer-Rao bound."""
    bound = cramer_rao(duration, interval, SIGMA)
    t = clock(interval, duration)
    clean = np.sin(2 * t) + np.sin(3 * t)
    errors: dict[str, list[Array]] = {}
    for seed in range(first, first + seeds):
        y = clean + np.random.default_rng(seed).uniform(-0.2, 0.2, t.size)
        estimates = {
            "least squares with prefilter": tracker().track(y, interval).frequencies[-1],
            "total least squares without": tracker(0.0, solution="total_least_squares")
            .track(y, interval)
            .frequencies[-1],
        }
        for name, omega in estimates.items():
            errors.setdefault(name, []).append(omega - TRUTH)
    limits = {
        "least squares with prefilter": 2.6,
        "total least squares without": 4.0,
    }
    for name, limit in limits.items():
        ratio = np.sqrt(np.mean(np.square(errors[name]), axis=0)) / bound
        yield at_most(f"{name}: rms error / bound", ratio.max(), limit)


ITEMS: dict[str, Callable[[], Iterator[Claim]]] = {
    "disturbed": disturbed,
    "noisy": noisy,
    "robust": robust,
    "quiet": quiet,
    "efficient": efficient,
}
