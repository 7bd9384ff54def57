"""Fits from Python with and without OPENBLAS_NUM_THREADS=1, on busy cores; cost of the limit for a small fit.

The library holds linear algebra to one thread itself, so that both take the same processor time.
"""

import os
import statistics
import subprocess
import sys
import time

CHILD = """
import time, numpy as np
from ctid_cli import DelayProfile, HeldSignal, Record, TransferFunction, simulate
rng = np.random.default_rng(5)
t = np.arange(1800.0)
u = HeldSignal(t, np.repeat(rng.choice([-1.0, 1.0], 90), 20))
y = simulate(TransferFunction([2.0], [300.0, 40.0, 1.0], 17.0), u, t) + 5.0 + 0.2 * rng.standard_normal(1800)
record, estimator = Record(t, y, u), DelayProfile(2, 0, (0, 60), initial_state="estimate", offset="estimate")
fit = estimator.fit(record)
begun = time.process_time()
for _ in range(3):
    fit = estimator.fit(record)
print((time.process_time() - begun) / 3, fit.parameters["delay"].hex())
"""
OVERHEAD = """
import contextlib, sys, time, numpy as np
from ctid_cli import HeldSignal, Record, Start, TdSrivc, TransferFunction, simulate
from ctid_cli.estimation import common
rng = np.random.default_rng(5)
t = 0.1 * np.arange(200)
u = HeldSignal(t, np.repeat(rng.choice([-1.0, 1.0], 20), 10))
record = Record(t, simulate(TransferFunction([2.0], [1.0, 1.0], 0.53), u, t) + 0.1 * rng.standard_normal(200), u)
estimator, start = TdSrivc(1, 0, delay_bounds=(0, 2)), Start(delay=0.4)
limited, unlimited = common.Prepared.fit, common.Prepared.fit.__wrapped__
ratios, times = [], {limited: [], unlimited: []}
prepared = estimator.prepare(record)
for _ in range(400):
    for fit in (limited, unlimited):
        begun = time.process_time_ns()
        fit(prepared, start)
        times[fit].append(time.process_time_ns() - begun)
print(np.median(times[limited]) / 1e9, np.median(times[limited]) / np.median(times[unlimited]))
"""


def at_once(codes_and_threads):
    """Run programs at the same time and return the words that each prints."""
    environment = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    children = [
        subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, env=environment | more)
        for code, more in codes_and_threads
    ]
    return [child.communicate()[0].split() for child in children]


def main():
    """Print the table."""
    one = {"OPENBLAS_NUM_THREADS": "1"}
    begun = time.process_time()
    [i * i for i in range(5_000_000)]
    print(f"CPU time of [i*i for i in range(5_000_000)]: {time.process_time() - begun:.3f} s")
    free, held, equal = [], [], set()
    for _ in range(3):
        # Two of each keep two processors busy; the kinds run side by side, so that both share the machine's speed.
        found = at_once([(CHILD, {}), (CHILD, one), (CHILD, {}), (CHILD, one)])
        free += [float(found[k][0]) for k in (0, 2)]
        held += [float(found[k][0]) for k in (1, 3)]
        equal |= {word for _, word in found}
    without, with_it = statistics.median(free), statistics.median(held)
    print(f"1,800 samples, CPU s a fit: {without:.3f} without the variable, {with_it:.3f} with it,", end=" ")
    print(f"ratio {without / with_it:.3f}; {'equal' if len(equal) == 1 else 'DIFFERENT'} estimates")
    ((seconds, ratio),) = at_once([(OVERHEAD, {})])
    print(f"a fit of 200 samples in {1e3 * float(seconds):.2f} ms: {100 * (float(ratio) - 1):+.1f} % by the limit")


if __name__ == "__main__":
    main()
