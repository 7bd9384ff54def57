"""False alarms, detections and coverage of the facts that ``ctid check`` states, on simulated records.

Usage: ``python benchmarks/bench_facts.py [RECORDS] [SEED] [EVERY]``. Clean records begin at rest, without offset, in
open loop; one in EVERY is then given one fault at a time, in white noise and in AR(1) noise of .9.
"""

import sys
import time
from collections import Counter
from dataclasses import dataclass, replace

import _timing  # noqa: F401  (one thread for linear algebra)

import numpy as np
from scipy.signal import lfilter

from ctid_cli import HeldSignal, Record, TransferFunction, simulate
from ctid_cli.inference.record_facts import decompose, record_facts
from ctid_cli.inference.record_tests import LEVEL
from ctid_cli.inference.signal_features import saturated
from ctid_cli.signals.held import regular_interval

#: Number of clean records, seed, and number of them for each record that gets faults.
DEFAULTS = ["400", "2026", "4"]
INPUTS = ("prbs", "step", "multisine")


@dataclass(frozen=True, eq=False)
class Case:
    """A simulated record without noise, and its true properties."""

    t: np.ndarray
    u: np.ndarray
    x: np.ndarray
    hold: str
    kind: str
    system: TransferFunction
    integrators: int
    snr_db: float


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
    return Case(t, u, x * scale, hold, kind, system, integrators, snr)


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
    """Return AR(1) noise of deviation 1, after its transient."""
    e = np.sqrt(1 - pole**2) * rng.standard_normal(n + 500)
    return lfilter([1.0], [1.0, -pole], e)[500:]


def in_loop(case, noise):
    """Close a loop u = r - K y with loop gain .5 about a system on a regular clock; None if it has no gain."""
    if case.integrators or regular_interval(case.t) is None:
        return None
    gain = 0.5 / abs(case.system.numerator[-1] / case.system.denominator[-1])
    once = (np.arange(case.t.size) == 0).astype(float)
    sampled = simulate(case.system, HeldSignal(case.t, once), case.t)
    u, y = case.u.copy(), np.zeros(case.t.size)
    for k in range(u.size):
        y[k] = u[:k] @ sampled[k:0:-1] + noise[k]
        u[k] -= gain * y[k]
    return Record.from_arrays(case.t, u, y)


def faulty(case, noise, rng):
    """Return the record of a case with each fault."""
    n, deviation = case.t.size, noise_deviation(case)
    clean = record_of(case, noise)
    where = rng.choice(np.arange(5, n - 5), 5, replace=False)
    errors = np.zeros(n)
    errors[where] = 6 * deviation * rng.choice([-1, 1], 5)
    limited = np.minimum(clean.y, np.quantile(clean.y, 0.98))
    return {
        "drift": with_output(clean, clean.y + np.linspace(0, 1, n)),
        "offset": with_output(clean, clean.y + 0.5),
        "saturation": with_output(clean, limited),
        "outliers": with_output(clean, clean.y + errors),
        "feedback": in_loop(case, noise),
    }


def record_of(case, noise):
    return Record.from_arrays(case.t, case.u, case.x + noise, case.hold)


def with_output(record, y):
    return replace(record, y=y)


def noise_deviation(case):
    """Return the deviation of the noise; that of the response is 1."""
    return 10 ** (-case.snr_db / 20)


def alarms(record, parts):
    """Return the names of the reported faults."""
    terms = {name for name in ("offset", "drift", "start") if getattr(parts, name).detected}
    others = {
        "outliers": bool(parts.outliers),
        "feedback": parts.feedback_p_value <= LEVEL,
        "saturation": saturated(record.y) > 0,
    }
    return terms | {name for name, found in others.items() if found}


def true_response_time(case):
    """Return the time until 63 % of the final value of the step response."""
    t = np.linspace(0, 5 * case.t[-1], 400_001)
    x = simulate(case.system, HeldSignal([0.0], [1.0]), t)
    return float(t[np.argmax(x / x[-1] >= 1 - np.exp(-1))])


def held(estimate, truth):
    """Return whether an interval contains a value; None if there is no interval."""
    return None if np.isnan(estimate.value) else bool(estimate.low - 1e-9 <= truth <= estimate.high + 1e-9)


def main(records, seed, every):
    rng = np.random.default_rng(seed)
    false, found, covered = Counter(), Counter(), {"signal to noise": [], "response time": [], "delay": []}
    tried, seconds = Counter(), 0.0
    for number in range(records):
        case = draw_case(rng)
        pole = 0.0 if rng.random() < 0.5 else rng.uniform(0.5, 0.95)
        record = record_of(case, noise_deviation(case) * draw_noise(rng, case.t.size, pole))
        begin = time.process_time()
        parts = decompose(record)
        seconds += time.process_time() - begin
        stated = alarms(record, parts)
        false.update(stated | ({"any"} if stated else set()))
        covered["signal to noise"].append(held(parts.signal_to_noise, case.snr_db))
        covered["delay"].append(held(parts.delay, case.system.delay))
        if not case.integrators:
            covered["response time"].append(held(parts.response_time, true_response_time(case)))
        if number % every:
            continue
        for name, of in (("white", 0.0), ("AR(1) .9", 0.9)):
            noise = noise_deviation(case) * draw_noise(rng, case.t.size, of)
            for fault, spoilt in faulty(case, noise, rng).items():
                if spoilt is not None:
                    stated = alarms(spoilt, decompose(spoilt))
                    tried[fault, name] += 1
                    found[fault, name] += fault in stated
                    found[fault, name, "others"] += bool(stated - {fault})
    print(f"{records} clean records, false alarms [%]:")
    print({name: round(100 * value / records, 1) for name, value in sorted(false.items())})
    print("faults, found [%], with another fact that is false [%], records:")
    for key, value in tried.items():
        print(*key, round(100 * found[key] / value, 1), round(100 * found[(*key, "others")] / value, 1), value)
    print("95 % intervals that hold the truth [%], where given [%]:")
    for name, holds in covered.items():
        given = [each for each in holds if each is not None]
        print(name, round(100 * np.mean(given), 1), round(100 * len(given) / len(holds), 1))
    print(f"{seconds / records:.2f} CPU s a record")
    case = draw_case(rng, n=5000, snr_db=20)
    record = record_of(case, noise_deviation(case) * draw_noise(rng, case.t.size, 0.9))
    begin = time.process_time()
    record_facts(record)
    print(f"{time.process_time() - begin:.2f} CPU s for all facts on 5,000 samples")


if __name__ == "__main__":
    main(*(int(value) for value in (sys.argv[1:] + DEFAULTS[len(sys.argv) - 1 :])))
