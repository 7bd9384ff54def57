"""Fits of integrating systems: distance from the optimum, and coverage of intervals. Random systems, random starts.

    python benchmarks/bench_integrators.py [--systems 300] [--seed 1] [--starts 200] [--refined 10] [--first 0]

Systems of one integrator and up to three poles (300 to 500 samples, a third of them irregular) have a delay that is
searched, and an initial state and an offset that are estimated. The least output error of ``DelayProfile`` is compared
with the least that ``scipy.optimize.least_squares`` reaches in the same box from the best of many random starts; the
peer shares no code with ctid. The coverage of the true parameters by 95 % intervals is counted.
"""

import argparse
import warnings
from collections import Counter

from _timing import cpu

import numpy as np
from bench_optimum import TOLERANCE, Peer, modal_responses, random_poles

from ctid_cli import DataError, DelayProfile, HeldSignal, Record


def random_case(rng):
    """Return a record, the true parameters by name, and the options for it."""
    n, samples, h = int(rng.integers(0, 4)), int(rng.integers(300, 501)), 10.0 ** rng.uniform(-2, 0)
    poles = random_poles(rng, n, 15 / (samples * h), 0.6 / h, 0.1)
    m = int(rng.integers(0, n + 1))
    middle = np.exp(np.mean(np.log(np.abs(poles)))) if n else 1.0 / h
    b = np.atleast_1d(np.poly(-middle * np.exp(rng.uniform(-1.0, 1.0, m)) * rng.choice([1, -1], m)))
    a = np.atleast_1d(np.real(np.poly(poles)))
    b = b / b[-1] * a[-1] * rng.uniform(0.5, 3.0)
    delay = float(rng.uniform(h, 8 * h))
    t = h * np.arange(samples)
    if rng.random() < 1 / 3:
        t = np.concatenate(([0.0], np.cumsum(h * rng.uniform(0.3, 1.7, samples - 1))))
    hold = int(rng.integers(1, 16))
    u = np.repeat(rng.choice([-1.0, 1.0], samples // hold + 1), hold)[:samples]
    whole = np.append(poles, 0.0)
    weights = np.array([1 / np.prod(np.delete(p - whole, k)) for k, p in enumerate(whole)])
    x = (modal_responses(whole, t, u, t, delay, 0.0) @ (np.polyval(b, whole) * weights)).real
    free = (np.exp(np.outer(t, whole)) @ weights).real
    x = x + rng.standard_normal() * np.std(x) * free / np.abs(free).max() + rng.uniform(-2, 2) * np.std(x)
    y = x + rng.standard_normal(samples) * x.std() * 10 ** (-rng.uniform(20, 45) / 20)
    truth = {f"a{k}": value for k, value in enumerate(a[1:], 1)} | {f"b{k}": value for k, value in enumerate(b)}
    options = DelayProfile(*(n, m, (0.0, 12 * h)), initial_state="estimate", offset="estimate", integrators=1)
    return Record(t, y, HeldSignal(t, u)), truth | {"delay": delay}, poles, options


def compared(number, asked):
    """Return status, the peer's squared error over ctid's less one, intervals that cover, time, and remarks."""
    rng = np.random.default_rng([asked.seed, number])
    record, truth, poles, options = random_case(rng)
    spent, fit = cpu(options.fit, record)
    ours, peer = fit.cost * fit.count, Peer(record, options, fit.box)
    trials = []
    for _ in range(asked.starts):
        start = random_poles(rng, options.poles, fit.box.slowest, min(fit.box.fastest, fit.box.imaginary), 0.01)
        delay = float(rng.uniform(*options.delay_bounds))
        trials.append((float(np.sum(peer.residual(start, delay) ** 2)), start, delay))
    trials.sort(key=lambda trial: trial[0])
    own = [(poles, truth["delay"]), (np.roots(fit.model.denominator[:-1]).astype(complex), fit.model.delay)]
    starts = [trial[1:] for trial in trials[: asked.refined]] + own
    least = min(peer.polished(*start) for start in starts) / ours - 1
    reach = dict(zip(fit.parameter_names, fit.law.quantiles(), strict=True))
    held = []
    for name, value in truth.items():
        error = fit.standard_errors[name]
        # Parameters of poles at infinity, or at a bound, have no interval.
        if name in fit.parameters and error > 0 and fit.status.name == "CONVERGED":
            held.append(abs(fit.parameters[name] - value) <= reach[name] * error)
    clock = "regular" if record.interval else "irregular"
    said = (
        f"{number}: {options.poles}/{options.zeros}, {record.n_samples} samples, {clock}: {fit.status.name}, "
        f"{fit.starts.agree} of {fit.starts.tried} starts, {spent:.1f} s; peer {least:+.1e}"
    )
    return fit.status.name, least, held, spent, said


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--systems", type=int, default=300)
    parser.add_argument("--first", type=int, default=0, help="number of the first system")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--starts", type=int, default=200, help="random starts of the peer")
    parser.add_argument("--refined", type=int, default=10, help="how many of them, the best, are refined")
    parser.add_argument("--verbose", action="store_true", help="a line for each system")
    asked = parser.parse_args()
    statuses, above, held, seconds = Counter(), 0, [], 0.0
    warnings.simplefilter("ignore")
    for number in range(asked.first, asked.first + asked.systems):
        try:
            status, least, intervals, spent, said = compared(number, asked)
        except DataError as error:
            statuses["refused"] += 1
            print(f"{number}: refused: {error}", flush=True)
            continue
        statuses[status] += 1
        seconds += spent
        held += intervals
        above += least < -TOLERANCE
        if least < -TOLERANCE or asked.verbose:
            print(f"{'ABOVE ' if least < -TOLERANCE else ''}{said}", flush=True)
    print(
        f"{asked.systems} systems: above the peer in {above}; {100 * np.mean(held):.1f} % of {len(held)} intervals of "
        f"95 % hold; {dict(statuses)}; {seconds:.0f} CPU s"
    )


if __name__ == "__main__":
    main()
