"""Scatter of estimates from disjoint thirds of measured records against their printed intervals.

Usage: ``python benchmarks/bench_thirds.py POLES/ZEROS FILE [POLES/ZEROS FILE ...]``. The columns of a CSV file with a
header are time, input and output. Structure is given, all else is chosen. A row has the estimate of the whole record
with the half-width of its 95 % interval, those of the thirds, and

- scatter: deviation of the three estimates, times 1.96;
- ratio: scatter relative to the mean square of their half-widths, within .16 and 1.92 in 95 % of independent, correct
  cases; it is above 1 if intervals are too short, and below if they are too long;
- apart: pairs of thirds whose difference exceeds the interval of a difference.
"""

import itertools
import sys

import _timing  # noqa: F401  (one thread for linear algebra)

import numpy as np

from ctid_cli import Given, Record, identify


def estimates(t, u, y, poles, zeros):
    """Return estimates and half-widths of intervals of the model by name; NaN where there is no interval."""
    found = identify(Record.from_arrays(t, u, y), Given(poles=poles, zeros=zeros))
    items = [item for item in (*found.estimates, *found.derived) if item.status != "fixed"]
    own = [
        item for item in items if item.name[0] not in "xop" and not item.name.endswith("hz") and item.name != "drift"
    ]
    options = found.options
    law = found.uncertainty
    print(
        f"    {len(t)} samples: state {options.initial_state}, offset {options.offset}, {law.kind} covariance, "
        f"t with {law.degrees_of_freedom:.3g} degrees of freedom"
    )
    return {item.name: (item.estimate, (item.high - item.low) / 2) for item in own}


def compare(file, poles, zeros):
    t, u, y = np.genfromtxt(file, delimiter=",", skip_header=1, usecols=(0, 1, 2)).T
    print(f"{file.rpartition('/')[2]}, {poles}/{zeros}")
    whole = estimates(t, u, y, poles, zeros)
    thirds = [estimates(t[own], u[own], y[own], poles, zeros) for own in np.array_split(np.arange(t.size), 3)]
    print(f"    {'':20}{'whole record':>22}" + f"{'third':>22}" * 3 + "   scatter  ratio  apart")
    for name in whole:
        each = [found.get(name, (np.nan, np.nan)) for found in thirds]
        values, halves = np.array(each).T
        scatter, size = 1.96 * values.std(ddof=1), np.sqrt(np.mean(halves**2))
        pairs = list(itertools.combinations(range(3), 2))
        apart = sum(abs(values[i] - values[j]) > np.hypot(halves[i], halves[j]) for i, j in pairs)
        shown = "".join(f"{value:11.4g} +-{half:8.3g}" for value, half in [whole[name], *each])
        print(f"    {name:20}{shown} {scatter:9.3g} {scatter / size:6.2f} {apart:6d}")


if __name__ == "__main__":
    for structure, file in zip(sys.argv[1::2], sys.argv[2::2], strict=True):
        compare(file, *(int(each) for each in structure.split("/")))
