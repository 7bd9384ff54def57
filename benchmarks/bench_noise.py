"""Plant and noise by maximum likelihood, on simulated records, compared with the Cramér-Rao bound.

    python benchmarks/bench_noise.py [--records 500] [--samples 600] [--snr-db 15] [--noise slow] [--orders true|auto]
        [--held 5] [--seed 1]

The plant is ``4 exp(-.537 s)/(s^2 + 2.8 s + 4)``, sampled every .1 s, under steps of random sign of some samples; its
delay is searched from 0 to 2 s and lies between samples. The noise is ``C(q)/D(q) e`` of one of the pairs in NOISES.
Errors are in standard deviations by the bound of each record, with its input and the true noise. For each parameter:

bias           mean error, and its Monte Carlo error
scatter        standard deviation of the errors
rmse           root mean square error, and that of the output-error fit
coverage       of 95 % intervals [%]
hausman        rejections at 1 % [%]; orders: how often each pair was estimated

Each record is printed to stderr when it is done.
"""

import argparse
import sys
from collections import Counter

from _timing import cpu

import numpy as np
from _table import print_errors

from ctid_cli import HeldSignal, Record, Rivc, TransferFunction, simulate
from ctid_cli.inference.innovations import SampledNoise, steps_of
from ctid_cli.inference.sensitivities import sensitivities
from ctid_cli.signals.noise import ArmaNoise, stream

PLANT, INTERVAL, DELAYS = TransferFunction([4.0], [1.0, 2.8, 4.0], 0.537), 0.1, (0.0, 2.0)
TRUE = np.array([2.8, 4.0, 4.0, 0.537])
#: C and D in rising powers of q^-1.
NOISES = {"slow": ((1.0, 0.2679), (1.0, -1.98, 0.9802)), "fast": ((1.0, 0.9), (1.0, -1.0, 0.2))}


def simulated(pair, samples, held, snr_db, seed, replicate):
    """Return a record, and the standard deviations of the bound."""
    t = INTERVAL * np.arange(samples)
    levels = stream(seed, "input", replicate).choice([-1.0, 1.0], samples // held + 1)
    signal = HeldSignal(t, np.repeat(levels, held)[:samples])
    x = simulate(PLANT, signal, t)
    law = ArmaNoise(*pair, snr_db=snr_db)
    record = Record(t, x + law.generate(x, stream(seed, "noise", replicate)), signal)
    white = SampledNoise(ArmaNoise(*pair, innovation_variance=1.0), steps_of(np.ones(samples, dtype=bool)))
    psi = white.whitened(sensitivities(PLANT, signal, t, estimate_delay=True))
    return record, np.sqrt(law.innovation_variance_of(x) * np.diag(np.linalg.inv(psi.T @ psi)))


def main():
    """Print the table of one setting."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--records", type=int, default=500)
    parser.add_argument("--samples", type=int, default=600)
    parser.add_argument("--snr-db", type=float, default=15.0)
    parser.add_argument("--noise", choices=NOISES, default="slow")
    parser.add_argument("--orders", choices=("true", "auto"), default="true")
    parser.add_argument("--held", type=int, default=5, help="samples of a step of the input")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    pair = NOISES[options.noise]
    given = "auto" if options.orders == "auto" else f"arma:{len(pair[1]) - 1},{len(pair[0]) - 1}"
    estimator = Rivc(2, 0, DELAYS, noise_model=given, covariance="white")
    errors, of_output_error, covered, rejected, orders, seconds = [], [], [], 0, Counter(), 0.0
    for replicate in range(options.records):
        record, bound = simulated(pair, options.samples, options.held, options.snr_db, options.seed, replicate)
        spent, fit = cpu(estimator.fit, record)
        seconds += spent
        errors.append((fit.theta - TRUE) / bound)
        of_output_error.append((fit.noise.output_error - TRUE) / bound)
        covered.append(np.abs(fit.theta - TRUE) <= fit.law.quantiles() * np.sqrt(np.diag(fit.covariance)))
        rejected += fit.noise.differs
        orders[fit.noise.orders] += 1
        print(replicate, f"{spent:.2f}", *errors[-1], file=sys.stderr, flush=True)
    print(" ".join(f"{name}={value}" for name, value in vars(options).items()))
    squares = {"rmse": errors, "output error": of_output_error}
    more = {title: np.sqrt(np.mean(np.square(own), axis=0)) for title, own in squares.items()}
    print_errors(fit.parameter_names, errors, covered, **more)
    print(f"hausman {100 * rejected / options.records:.1f} %, orders {dict(orders.most_common(5))}")
    print(f"{seconds / options.records:.2f} s of a processor each")


if __name__ == "__main__":
    main()
