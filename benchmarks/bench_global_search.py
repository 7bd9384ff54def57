"""Global searches for a delay compared with each other and with multi-start least squares, on the study's data sets.

Case 1 and case 2 of the useful-redundancy study, 15 dB, every data set a new record: times include checks, filtering,
search and refinement. `useful_redundancy` starts from 0 s. The baseline, for a regular clock, is
``scipy.optimize.least_squares`` from equally spaced delays, with an exact difference equation as its simulation and the
coefficients of the SVF estimate as start (see bench_measured.py).

The baseline has the least number of starts that find the delay (within 1 %) in 99 % of data sets. On each data set the
interval of starts around the true delay from which one run finds it is bracketed; starts ``spacing`` apart, at random
positions relative to the true delay, then hit it with the probability ``min(1, width / spacing)``.

    python benchmarks/bench_global_search.py [DATA_SETS]
"""

import sys
from pathlib import Path

from _timing import cpu

import numpy as np
from bench_measured import exact_zoh, multi_start

from ctid_cli.estimation.common import Start
from ctid_cli.running.plan import build_plan
from ctid_cli.specification.load import load_spec

CONFIGS = Path(__file__).resolve().parents[1] / "configs" / "useful_redundancy"
METHODS = ("delay_profile", "redundancy")
TRUTH, BOUNDS = 8.0, (0.0, 15.0)
WANTED = 0.99
#: Largest widths of an interval of starts that are searched [s], and their tolerance relative to the width.
REACH = {"case1": 7.0, "case2": 1.0}
PRECISION = 0.02


def found(record, estimator, delays):
    """Return whether least squares from these delays find the true one."""
    theta = multi_start(record, estimator.poles, BOUNDS, delays, exact_zoh, estimator.zeros)
    return abs(theta[-1] - TRUTH) < 0.01 * TRUTH


def width(record, estimator, reach):
    """Return the width of the interval of starts around the true delay from which one run finds it [s]."""
    total = 0.0
    for side in (-1.0, 1.0):
        low, high = 0.0, reach
        while high - low > PRECISION * high:
            middle = 0.5 * (low + high)
            low, high = (middle, high) if found(record, estimator, [TRUTH + side * middle]) else (low, middle)
        total += low
    return total


def fewest(widths):
    """Return the number of starts on the range of delays that hit the interval in the required share of data sets."""
    count = 1
    while np.mean(np.minimum(1.0, widths * count / (BOUNDS[1] - BOUNDS[0]))) < WANTED:
        count += 1
    return count


def line(data_set, method, milliseconds, ratio, right, count):
    share = f"{right} of {count}"
    print(f"{data_set:18}{method:28}{milliseconds:10.0f}{ratio:9.1f}{share:>12}", flush=True)


def main():
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 20
    print(f"{'data set':18}{'method':28}{'CPU ms':>10}{'ratio':>9}{'within 1 %':>12}")
    for case in ("case1", "case2"):
        for sampling in ("regular", "irregular"):
            plan = build_plan(load_spec(CONFIGS / f"{case}_{sampling}.yaml"))
            cell = next(cell for cell in plan.data_cells if cell.swept["snr_db"] == 15)
            records = [cell.dataset(k).record for k in range(count)]
            estimators = {cell.name: cell.estimator for cell in plan.estimators}
            ours = None
            for name in METHODS:
                fit = estimators[name].fit
                fit(records[0], Start(delay=0.0))  # compiles, or loads what was compiled
                runs = [cpu(fit, record, Start(delay=0.0)) for record in records]
                mean = 1e3 * np.mean([seconds for seconds, _ in runs])
                ours = ours or mean
                right = sum(abs(run.model.delay - TRUTH) < 0.01 * TRUTH for _, run in runs)
                line(f"{case} {sampling}", name, mean, mean / ours, right, count)
            if sampling == "irregular":
                continue
            estimator = estimators["redundancy"]
            widths = np.array([width(record, estimator, REACH[case]) for record in records])
            starts = fewest(widths)
            # The positions of the starts are drawn anew for every data set; those of the longest runs are few.
            rng, spacing = np.random.default_rng(0), (BOUNDS[1] - BOUNDS[0]) / starts
            some = records[: max(2, min(count, 400 // starts))]
            runs = [cpu(found, r, estimator, BOUNDS[0] + spacing * (rng.random() + np.arange(starts))) for r in some]
            mean = 1e3 * np.mean([seconds for seconds, _ in runs])
            right = sum(right for _, right in runs)
            line(f"{case} {sampling}", f"least squares, {starts} starts", mean, mean / ours, right, len(some))
            low, middle, high = np.quantile(widths, (0.0, 0.5, 1.0))
            print(f"{'':18}the starts that find it cover {low:.3f} to {high:.3f} s, in the median {middle:.3f} s")


if __name__ == "__main__":
    main()
