"""False alarms, detections and coverage of the facts that ``ctid check`` states, on simulated records.

Usage: ``python benchmarks/bench_facts.py [RECORDS] [SEED]``. Clean records begin at rest, without offset, in open loop;
each is then given one fault at a time, in white noise and in AR(1) noise of .9.
"""

from dataclasses import dataclass

import numpy as np

from ctid_cli import HeldSignal, Record, TransferFunction, simulate

INPUTS = ("prbs", "step", "multisine")


@dataclass(frozen=True, eq=False)
class Case:
    """A simulated record without noise, and what is true of it."""

    t: np.ndarray
    u: np.ndarray
    x: np.ndarray
    hold: str
    kind: str
    system: TransferFunction
    integrators: int
    snr_db: float
    rng: np.random.Generator


def draw_case(rng, n=None, snr_db=None):
    n = int(np.exp(rng.uniform(np.log(500), np.log(1000)))) if n is None else n
    steps = rng.uniform(0.5, 1.5, n - 1) if rng.random() < 0.25 else np.ones(n - 1)
    t = np.append(0.0, np.cumsum(steps))
    order, integrators = int(rng.integers(1, 5)), int(rng.random() < 0.25)
    slowest = float(np.exp(rng.uniform(np.log(3), np.log(n / 15))))
    system = draw_system(rng, order, integrators, slowest)
    kind = INPUTS[int(rng.integers(3))]
    hold = "foh" if kind == "multisine" and rng.random() < 0.6 else "zoh"
    u = draw_input(rng, kind, t, slowest)
    x = simulate(system, HeldSignal(t, u, hold), t)
    scale = 1 / x.std()
    system = TransferFunction(np.asarray(system.numerator) * scale, system.denominator, delay=system.delay)
    snr = float(rng.uniform(10, 30)) if snr_db is None else snr_db
    return Case(t, u, x * scale, hold, kind, system, integrators, snr, rng)


def draw_system(rng, order, integrators, slowest):
    poles, left = [0.0] * integrators, order - integrators
    while left:
        w = 1 / slowest if not any(poles) else rng.uniform(1, 6) / slowest
        if left > 1 and rng.random() < 0.5:
            damping = rng.uniform(0.1, 0.9)
            pole = w * complex(-damping, np.sqrt(1 - damping**2))
            poles += [pole, pole.conjugate()]
            left -= 2
        else:
            poles.append(-w)
            left -= 1
    zeros = []
    for _ in range(int(rng.integers(0, order)) if order > 1 else 0):
        sign = 1 if rng.random() < 0.3 else -1
        zeros.append(sign * float(np.exp(rng.uniform(np.log(0.5), np.log(6)))) / slowest)
    numerator = np.real(np.poly(zeros)) if zeros else np.ones(1)
    denominator = np.real(np.poly(poles))
    constant = denominator[denominator != 0][-1] if integrators else denominator[-1]
    delay = 0.0 if rng.random() < 0.5 else float(rng.uniform(0.3, 10))
    return TransferFunction(numerator / numerator[-1] * constant, denominator, delay=delay)


def draw_input(rng, kind, t, slowest):
    n = t.size
    if kind == "step":
        return (np.arange(n) >= int(rng.uniform(0.05, 0.15) * n)).astype(float)
    if kind == "prbs":
        hold = max(1, round(slowest * rng.uniform(0.3, 1.5)))
        return np.repeat(rng.choice([-1.0, 1.0], n // hold + 1), hold)[:n]
    count = int(rng.integers(5, 20))
    highest = min(0.6 * np.pi, 5 / slowest)
    w = np.linspace(highest / count, highest, count)
    return np.sum(np.sin(np.outer(t, w) + rng.uniform(0, 2 * np.pi, count)), axis=1) / np.sqrt(count / 2)


def draw_noise(rng, n, pole):
    e = rng.standard_normal(n + 500)
    v = np.empty(n + 500)
    state = 0.0
    for k, value in enumerate(e):
        state = pole * state + np.sqrt(1 - pole**2) * value
        v[k] = state
    return v[500:]


def noise_deviation(case):
    return 10 ** (-case.snr_db / 20)


def record_of(case, noise, u=None, x=None):
    return Record.from_arrays(case.t, case.u if u is None else u, (case.x if x is None else x) + noise, case.hold)
