"""Standard errors in coloured noise on irregular clocks, against the covariance of the noise that made the data.

For systems of order one to three, two inputs, and three clocks: the median over records of the standard error over the
true deviation of the linearised estimate, the least and greatest of all parameters, and the coverage of 1.96 of them.
Usage: python benchmarks/bench_irregular_noise.py [--realisations 8] [--draws 15] [--seed 77]
"""

import argparse
from itertools import product

import numpy as np

from ctid_cli import HeldSignal, TransferFunction, simulate
from ctid_cli.inference.covariance import robust_dispersion

SAMPLES, INTERVAL = 800, 0.1
SYSTEMS = {
    "first": TransferFunction([1], [1, 1], delay=0.9),
    "second": TransferFunction([4], [1, 0.8, 4], delay=0.53),
    "third": TransferFunction([6], [1, 4.2, 7.4, 6], delay=0.9),
}
#: Correlation of the noise over one mean interval.
COLOURS = (0.5, 0.9, 0.98)


def intervals(clock, rng):
    """Return sampling intervals: uniform within 50 %, exponential, or bursts of 100 samples ten times as dense."""
    if clock == "bursts":
        return INTERVAL * np.repeat(np.tile([0.2, 2.0], SAMPLES // 200), 100)
    relative = rng.uniform(0.5, 1.5, SAMPLES) if clock == "uniform" else rng.exponential(1.0, SAMPLES)
    return INTERVAL * relative


def drive(kind, end, rng):
    """Return a binary random signal that may switch every 0.5 s, or two steps."""
    if kind == "steps":
        return HeldSignal(np.array([0.0, end / 4, 0.7 * end]), np.array([0.0, 1.0, -0.5]))
    switches = np.arange(0.0, end, 0.5)
    return HeldSignal(switches, rng.choice([-1.0, 1.0], switches.size))


def sensitivities(system, signal, t):
    """Return the derivatives of the output with respect to coefficients and delay, by central differences."""
    order = len(system.denominator) - 1
    theta = np.concatenate([system.denominator[1:], system.numerator, [system.delay]])

    def output(values):
        denominator = np.append(1.0, values[:order])
        return simulate(TransferFunction(values[order:-1], denominator, delay=values[-1]), signal, t)

    steps = 1e-4 * np.maximum(1.0, np.abs(theta))
    columns = [output(theta + step) - output(theta - step) for step in np.diag(steps)]
    return np.column_stack(columns) / (2.0 * steps)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--realisations", type=int, default=8)
    parser.add_argument("--draws", type=int, default=15)
    parser.add_argument("--seed", type=int, default=77)
    args = parser.parse_args()
    print("system input  clock   correlation  error over deviation  coverage %")
    for (name, system), kind, clock, colour in product(
        SYSTEMS.items(), ("binary", "steps"), ("uniform", "poisson", "bursts"), COLOURS
    ):
        ratios, scores = [], []
        for realisation in range(args.realisations):
            rng = np.random.default_rng([args.seed, realisation])
            t = np.append(0.0, np.cumsum(intervals(clock, rng))[:-1])
            psi = sensitivities(system, drive(kind, t[-1], rng), t)
            solve = np.linalg.pinv(psi)
            noise = colour ** (np.abs(np.subtract.outer(t, t)) / INTERVAL)
            deviation = np.sqrt(np.diag(solve @ noise @ solve.T))
            root = np.linalg.cholesky(noise)
            for _ in range(args.draws):
                v = root @ rng.standard_normal(SAMPLES)
                error = solve @ v
                covariance = robust_dispersion([psi], [v - psi @ error]).covariance
                ratios.append(np.sqrt(np.diag(covariance)) / deviation)
                scores.append(error / deviation)
        middle = np.median(ratios, axis=0)
        covered = 100 * np.mean(np.abs(scores) < 1.96 * np.array(ratios), axis=0)
        print(
            f"{name:6} {kind:6} {clock:8} {colour:10.2f}  {middle.min():8.2f} to {middle.max():.2f}"
            f"  {covered.min():8.0f} to {covered.max():.0f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
