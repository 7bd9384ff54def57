"""Processor time of one SRIVC iteration: second moments of all filtered signals in one pass, then a small solve."""

from _timing import cpu

import numpy as np

from ctid_cli.estimation.iteration import Steps, iterate
from ctid_cli.estimation.sampled_problem import at_known_delay
from ctid_cli.filtering.filter_data import filter_data
from ctid_cli.filtering.simulate import simulate
from ctid_cli.inference.sensitivities import Structure
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.excitation import Prbs
from ctid_cli.signals.noise import WhiteNoise
from ctid_cli.signals.record import Record

ITERATIONS = 20
REPEATS = 100
# name, system, number of samples, interval [s], target [us]
CASES = (
    ("n = 2", TransferFunction([2], [0.25, 0.7, 1], 8.0), 4000, 0.05, 100),
    ("n = 4", TransferFunction([-6400, 1600], [1, 5, 408, 416, 1600], 8.0), 8000, 0.01, 450),
)


def noisy_record(system, n_samples, interval, regular):
    rng = np.random.default_rng(0)
    steps = np.full(n_samples - 1, interval) if regular else rng.uniform(0.2, 1.8, n_samples - 1) * interval
    t = interval * np.arange(n_samples) if regular else np.concatenate(([0.0], np.cumsum(steps)))
    u = Prbs(stages=10, clock_period=interval).generate(t, rng).at(t)
    record = Record.from_arrays(t, u, np.ones(n_samples))
    x = simulate(system, record.input, t)
    return Record(t, x + WhiteNoise(snr_db=15).generate(x, rng), record.input)


def iteration_times(problem, theta, variant):
    """Return the seconds per iteration of each repeat; the first one, which may compile, is left out."""
    times = []
    for _ in range(REPEATS + 1):
        seconds, result = cpu(iterate, problem, theta, Steps(ITERATIONS, 1e-300, variant))
        times.append(seconds / ITERATIONS)
        assert result.iterations == ITERATIONS
    return np.array(times[1:])


def main():
    print(f"{'system':8}{'samples':>8}  {'clock':10}{'median us':>10}{'min us':>8}{'ns/sample':>11}{'target us':>11}")
    for name, system, n_samples, interval, target in CASES:
        for regular in (True, False):
            data = filter_data(noisy_record(system, n_samples, interval, regular))
            structure = Structure(system.order, system.numerator.size - 1)
            problem = at_known_delay(data, structure)
            theta = np.concatenate((system.denominator[1:], system.numerator, [system.delay]))
            times = 1e6 * iteration_times(problem, theta, "plain")
            clock = "regular" if regular else "irregular"
            goal = f"{target:11d}" if regular else f"{'-':>11}"
            print(
                f"{name:8}{n_samples:8d}  {clock:10}{np.median(times):10.1f}{times.min():8.1f}"
                f"{1e3 * times.min() / n_samples:11.1f}{goal}"
            )


if __name__ == "__main__":
    main()
