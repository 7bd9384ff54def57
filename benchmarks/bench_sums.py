"""Sums of submodels with unknown delay, on simulated records, compared with the Cramér-Rao bound.

    python benchmarks/bench_sums.py [--records 300] [--samples 600] [--snr-db 15] [--seed 1] [--estimate] [--chosen]

Two modes, ``1/(1 + .3 p + .25 p^2)`` and ``.5/(1 + .025 p + .015625 p^2)``, with a delay of .237 s, which is searched
from 0 to 1 s, sampled every .1 s under a random binary input; white noise. Errors count in standard deviations by the
bound of each record, with its input. With ``--estimate`` state and offset are estimated too; with ``--chosen`` only the
number of modes is chosen, and counted. Each record is printed to stderr when it is done.
"""

import argparse
import sys
from collections import Counter

from _timing import cpu

import numpy as np
from _table import print_errors

from ctid_cli import AdditiveModel, HeldSignal, Record
from ctid_cli.estimators.additive_output_error import AdditiveOutputError
from ctid_cli.filtering.simulate import simulate_additive
from ctid_cli.identification.choice import Given
from ctid_cli.identification.choose import choose
from ctid_cli.inference.sensitivities import sensitivities
from ctid_cli.models.additive import Term
from ctid_cli.signals.noise import stream

MODES = (Term(2, 0), Term(2, 0))
TRUE = np.array([0.3, 0.25, 1.0, 0.025, 0.015625, 0.5, 0.237])
PLANT, INTERVAL, DELAYS = AdditiveModel.from_theta(TRUE[:-1], MODES, TRUE[-1]), 0.1, (0.0, 1.0)


def simulated(samples, snr_db, seed, replicate):
    """Return a record, and the standard deviations of the bound, from rest and without an offset."""
    t = INTERVAL * np.arange(samples)
    signal = HeldSignal(t, stream(seed, "input", replicate).choice([-1.0, 1.0], samples))
    x = simulate_additive(PLANT, signal, t)
    deviation = np.std(x) * 10 ** (-snr_db / 20)
    record = Record(t, x + deviation * stream(seed, "noise", replicate).standard_normal(samples), signal)
    psi = sensitivities(PLANT, signal, t, estimate_delay=True)
    return record, deviation * np.sqrt(np.diag(np.linalg.inv(psi.T @ psi)))


def main():
    """Print the table of one setting."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--records", type=int, default=300)
    parser.add_argument("--samples", type=int, default=600)
    parser.add_argument("--snr-db", type=float, default=15.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--estimate", action="store_true")
    parser.add_argument("--chosen", action="store_true")
    options = parser.parse_args()
    own = {"initial_state": "estimate", "offset": "estimate"} if options.estimate else {}
    estimator = AdditiveOutputError(MODES, DELAYS, covariance="white", **own)
    errors, covered, numbers, statuses, seconds = [], [], Counter(), Counter(), 0.0
    for replicate in range(options.records):
        record, bound = simulated(options.samples, options.snr_db, options.seed, replicate)
        if options.chosen:
            spent, choice = cpu(choose, record, Given(modes=(1, 4), delay_bounds=DELAYS))
            numbers[len(choice.options.terms)] += 1
        else:
            spent, fit = cpu(estimator.fit, record)
            found = fit.theta[: TRUE.size] - TRUE
            errors.append(found / bound)
            quantiles, variances = fit.law.quantiles(), np.diag(fit.covariance)
            covered.append(np.abs(found) <= (quantiles * np.sqrt(variances))[: TRUE.size])
            statuses[fit.status.name] += 1
        seconds += spent
        print(replicate, f"{spent:.2f}", *errors[-1:], file=sys.stderr, flush=True)
    print(" ".join(f"{name}={value}" for name, value in vars(options).items()))
    if options.chosen:
        print(f"numbers of modes {dict(sorted(numbers.items()))}")
    else:
        print_errors((*PLANT.names, "delay"), errors, covered)
        print(f"ends {dict(statuses.most_common())}")
    print(f"{seconds / options.records:.2f} s of a processor each")


if __name__ == "__main__":
    main()
