"""The global searches for a delay against each other and against multi-start least squares, on the study's data sets.

Case 1 and case 2 of the useful-redundancy study, 15 dB, first data set. Every time is that of a fresh record: checking,
filtering, search and refinement. `useful_redundancy` starts from 0 s. The baseline, where the clock is regular, is
``scipy.optimize.least_squares`` from equally spaced delays, a quarter period of the bandwidth apart, with an exact
difference equation as its simulation (see bench_measured.py); its start coefficients are those of the SVF estimate.
"""

import time
from pathlib import Path

import numpy as np
from bench_measured import exact_zoh, multi_start

from ctid_cli.estimation.common import Start
from ctid_cli.running.plan import build_plan
from ctid_cli.specification.load import load_spec

CONFIGS = Path(__file__).resolve().parents[1] / "configs" / "useful_redundancy"
METHODS = ("delay_profile", "redundancy")
BANDWIDTHS = {"case1": 2.02, "case2": 26.85}
REPEATS = 5


def timed(function, *arguments):
    begin = time.perf_counter()
    result = function(*arguments)
    return time.perf_counter() - begin, result


def main():
    print(f"{'data set':18}{'method':20}{'ms':>9}{'ratio':>8}{'delay s':>10}{'cost':>12}")
    for case, bandwidth in BANDWIDTHS.items():
        for sampling in ("regular", "irregular"):
            plan = build_plan(load_spec(CONFIGS / f"{case}_{sampling}.yaml"))
            cell = next(cell for cell in plan.data_cells if cell.swept["snr_db"] == 15)
            record = cell.dataset(0).record
            estimators = {cell.name: cell.estimator for cell in plan.estimators}
            reference = None
            for name in METHODS:
                estimator = estimators[name]
                estimator.fit(record, Start(delay=0.0))  # compiles, or loads what was compiled
                runs = [timed(estimator.fit, record, Start(delay=0.0)) for _ in range(REPEATS)]
                seconds, fit = float(np.median([run[0] for run in runs])), runs[0][1]
                reference = reference or seconds
                print(
                    f"{case + ' ' + sampling:18}{name:20}{1e3 * seconds:9.0f}{seconds / reference:8.1f}"
                    f"{fit.model.delay:10.4f}{fit.cost:12.5g}"
                )
            if sampling == "regular":
                poles, zeros = estimators["redundancy"].poles, estimators["redundancy"].zeros
                starts = int(np.ceil(15.0 * bandwidth / (0.5 * np.pi)))
                seconds, theta = timed(multi_start, record, poles, (0.0, 15.0), starts, exact_zoh, zeros)
                print(
                    f"{case + ' ' + sampling:18}{f'{starts} starts':20}{1e3 * seconds:9.0f}{seconds / reference:8.1f}"
                    f"{theta[-1]:10.4f}"
                )


if __name__ == "__main__":
    main()
