"""Time of one SRIVC iteration against the length of the record: linear up to a million samples."""

from _timing import least

import numpy as np

from ctid_cli.filtering.bank import second_moments
from ctid_cli.filtering.filter_data import filter_data
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.record import Record

LENGTHS = (1_000, 10_000, 100_000, 1_000_000)
SYSTEM = TransferFunction([2], [0.25, 0.7, 1], 8.0123)


def main():
    rng = np.random.default_rng(0)
    print(f"{'samples':>9}{'regular CPU ms':>16}{'ns/sample':>11}{'irregular CPU ms':>18}{'ns/sample':>11}")
    per_sample = {True: [], False: []}
    for n in LENGTHS:
        line = f"{n:9d}"
        for regular in (True, False):
            t = 0.05 * np.arange(n) if regular else np.cumsum(rng.uniform(0.01, 0.09, n))
            data = filter_data(Record.from_arrays(t, rng.standard_normal(n), rng.standard_normal(n)))
            model = SYSTEM.denominator, SYSTEM.numerator, SYSTEM.delay
            [seconds] = least(max(5, 1_000_000 // n), lambda data=data, model=model: second_moments(data, *model))
            per_sample[regular].append(1e9 * seconds / n)
            line += f"{1e3 * seconds:{16 if regular else 18}.3f}{per_sample[regular][-1]:11.1f}"
        print(line)
    for regular, values in per_sample.items():
        clock = "regular" if regular else "irregular"
        print(f"{clock}: a sample of the longest record costs {values[-1] / values[1]:.2f} times one of 10,000")


if __name__ == "__main__":
    main()
