"""Search for a simulated flexible beam with unknown delay, from its printed initial values.

The modes, the clock and the start are those of ``configs/additive/flexible_beam.yaml``; the delay of four samples is
searched between 0 and 2 ms. The beam is found if the squared output error is below 1.2 times that of the noise.

    python benchmarks/bench_beam.py SEED RUNS SNR_DB

Each record is printed to stderr when it is done.
"""

import sys

import numpy as np

from ctid_cli.estimation.common import Start
from ctid_cli.estimators.additive_output_error import AdditiveOutputError
from ctid_cli.filtering.simulate import simulate_additive
from ctid_cli.models.additive import AdditiveModel, Term
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record

MODE = Term(2, 0)
DELAY, SAMPLES, RATE, TONES = 9.765625e-4, 8192, 4096.0, 1000
#: a1, a2 and b0 of each mode, and the start of the search.
SYSTEM = [0.0024, 0.023, 11.81, 2.33e-5, 1.65e-4, 0.159, 8.59e-7, 1.03e-5, 3.19e-4, 7.55e-7, 3.55e-6, 1.27e-4]
START = [0.001, 0.025, 10.0, 5e-5, 1.5e-4, 0.2, 8.5e-7, 2e-5, 0.001, 7.5e-7, 5e-6, 0.01]
ESTIMATOR = AdditiveOutputError((MODE,) * 4, (0.0, 2e-3), covariance="white")
#: Squared output error over that of the noise, and error of the delay [s], up to which beam and delay count as found.
FOUND, CLOSE = 1.2, 1e-6


def one(rng: np.random.Generator, snr_db: float) -> tuple[float, float]:
    """Return the squared output error over that of the noise, and the error of the delay, for one record."""
    system = AdditiveModel.from_theta(SYSTEM, (MODE,) * 4, DELAY)
    t, w = np.arange(SAMPLES) / RATE, np.pi * np.arange(1, TONES + 1)
    phases = rng.uniform(0, 2 * np.pi, TONES)
    u = HeldSignal(t, np.sqrt(2 / TONES) * np.cos(np.outer(t, w) + phases).sum(1))
    x = simulate_additive(system, u, t)
    noise = rng.standard_normal(SAMPLES) * np.std(x) * 10 ** (-snr_db / 20)
    fit = ESTIMATOR.fit(Record(t, x + noise, u), Start(model=AdditiveModel.from_theta(START, (MODE,) * 4)))
    return fit.cost * SAMPLES / float(noise @ noise), fit.model.delay - DELAY


def main(seed: int = 20261126, runs: int = 20, snr_db: float = 100.0) -> None:
    """Print how often the beam, and its delay, are found."""
    rng = np.random.default_rng(seed)
    records = []
    for k in range(runs):
        records.append(one(rng, snr_db))
        print(k, *records[-1], file=sys.stderr, flush=True)
    ratios, errors = np.array(records).T
    found, close = int((ratios < FOUND).sum()), int((np.abs(errors) < CLOSE).sum())
    print(f"seed {seed}, {snr_db:g} dB: found {found} of {runs}, delay within {CLOSE:g} s {close} of {runs}; ", end="")
    print(f"largest error of the delay {np.abs(errors).max():.2g} s")


if __name__ == "__main__":
    given = sys.argv[1:]
    main(*map(int, given[:2]), *map(float, given[2:3]))
