"""Time of one SRIVC iteration against the length of the record: linear up to a million samples."""

import time

import numpy as np

from ctid_cli.filtering.bank import second_moments
from ctid_cli.filtering.filter_data import filter_data
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.record import Record

LENGTHS = (1_000, 10_000, 100_000, 1_000_000)
SYSTEM = TransferFunction([2], [0.25, 0.7, 1], 8.0123)


def fastest(function, seconds=1.0):
    """Shortest of the calls that fit into some time."""
    function()
    times = []
    end = time.perf_counter() + seconds
    while time.perf_counter() < end or len(times) < 3:
        begin = time.perf_counter()
        function()
        times.append(time.perf_counter() - begin)
    return min(times)


def main():
    rng = np.random.default_rng(0)
    print(f"{'samples':>9}{'regular ms':>12}{'ns/sample':>11}{'irregular ms':>14}{'ns/sample':>11}")
    per_sample = {True: [], False: []}
    for n in LENGTHS:
        line = f"{n:9d}"
        for regular in (True, False):
            t = 0.05 * np.arange(n) if regular else np.cumsum(rng.uniform(0.01, 0.09, n))
            data = filter_data(Record.from_arrays(t, rng.standard_normal(n), rng.standard_normal(n)))
            seconds = fastest(
                lambda data=data: second_moments(data, SYSTEM.denominator, SYSTEM.numerator, SYSTEM.delay)
            )
            per_sample[regular].append(1e9 * seconds / n)
            line += f"{1e3 * seconds:{12 if regular else 14}.3f}{per_sample[regular][-1]:11.1f}"
        print(line)
    for regular, values in per_sample.items():
        clock = "regular" if regular else "irregular"
        print(f"{clock}: a sample of the longest record costs {values[-1] / values[1]:.2f} times one of 10,000")


if __name__ == "__main__":
    main()
