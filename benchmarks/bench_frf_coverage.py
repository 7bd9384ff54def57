"""Coverage of the 95 % intervals of a frequency response without a model, on short records.

Each record is of a random system of one family (overdamped of second order; resonant with damping .1; both with and
without a delay; two modes with damping .05, the slower with five to ten periods in 500 samples), sampled every 0.1 s,
with one input, record length, signal-to-noise ratio, and colour of the noise. Half of the records begin at rest, the
others in the middle of an experiment. Coverage is given for two truths: the response between samples of a held input,
images included (to which the estimates converge), and the response of the system in continuous time ("system"). Counts
are over the frequencies with an interval: first those with a gain above a tenth of the greatest, then all, then that of
the greatest gain alone ("top").

    python benchmarks/bench_frf_coverage.py --records 24 --seed 1
"""

import argparse
import itertools
from typing import NamedTuple

import numpy as np

from ctid_cli.errors import DataError
from ctid_cli.filtering.simulate import simulate
from ctid_cli.inference.frequency_response import estimate_frequency_response
from ctid_cli.models.transfer_function import TransferFunction
from ctid_cli.signals.held import HeldSignal
from ctid_cli.signals.record import Record

INTERVAL = 0.1
INPUTS = ("prbs", "prbs periods", "multisine", "multisine periods", "gaussian", "binary")
SYSTEMS = ("overdamped", "overdamped, delay", "resonant", "resonant, delay", "slow modes")
LENGTHS, RATIOS, COLOURS = (400, 500, 1000), (10.0, 15.0, 20.0), (0.0, 0.8)
#: Least gain within the band of a response, as a share of its greatest.
IN_BAND = 0.1
#: Samples before a record that begins in the middle of an experiment.
BEFORE = 600
#: Stages and feedback taps of maximum-length shift registers.
TAPS = {7: (7, 6), 11: (11, 9)}


class Counts(NamedTuple):
    """Counts of one record."""

    #: Hits and trials inside the band of the response, then over all frequencies: intervals and phases drawn, gain,
    #: phase and complex value covered, complex value of the system covered; then interval drawn and complex value
    #: covered at the greatest gain, shape (14, 2).
    counts: np.ndarray
    #: Radii of the drawn intervals inside the band over the gain, and over the error.
    widths: np.ndarray
    ratios: np.ndarray
    method: str


def random_system(family, rng):
    delay = rng.uniform(0.2, 2.0) if "delay" in family else 0.0
    if family == "slow modes":
        slow, fast = rng.uniform(0.7, 1.3), rng.uniform(2.5, 4.0)
        modes = [1.0, 0.1 * slow, slow**2], [1.0, 0.1 * fast, fast**2]
        return TransferFunction(np.polyadd(slow**2 * np.array(modes[1]), modes[0]), np.polymul(*modes))
    if family.startswith("overdamped"):
        slow, fast = np.exp(rng.uniform(np.log(0.5), np.log(5.0))), np.exp(rng.uniform(np.log(0.15), np.log(0.5)))
        return TransferFunction([1.0], np.polymul([slow, 1.0], [fast, 1.0]), delay)
    w = np.exp(rng.uniform(np.log(0.7), np.log(5.0)))
    return TransferFunction([w**2], [1.0, 0.2 * w, w**2], delay)


def shift_register(stages, count, hold, rng):
    state = list(rng.integers(0, 2, stages))
    state[0] = 1
    bits = []
    while len(bits) * hold < count:
        bits.append(state[-1])
        new = state[TAPS[stages][0] - 1] ^ state[TAPS[stages][1] - 1]
        state = [new, *state[:-1]]
    return 2.0 * np.repeat(bits, hold)[:count] - 1.0


def multisine(period, count, rng):
    lines = np.arange(1, period // 3)
    phases = rng.uniform(0, 2 * np.pi, lines.size)
    once = np.cos(2 * np.pi * np.outer(np.arange(period), lines) / period + phases).sum(axis=1)
    return np.resize(once, count) / once.std()


def make_input(kind, n, count, rng):
    """Return the input of a record of n samples; count includes those before it."""
    if kind == "prbs":
        return shift_register(11, count, int(rng.integers(1, 4)), rng)
    if kind == "prbs periods":
        return shift_register(7, count, 1, rng)
    if kind == "multisine":
        return multisine(n, count, rng)
    if kind == "multisine periods":
        return multisine(n // int(rng.integers(2, 6)), count, rng)
    if kind == "gaussian":
        return rng.standard_normal(count)
    return np.repeat(rng.choice([-1.0, 1.0], count // 3 + 1), 3)[:count]


def make_record(kind, family, n, ratio, colour, rng):
    model = random_system(family, rng)
    before = int(rng.integers(0, 2)) * BEFORE
    u = make_input(kind, n, n + before, rng)
    t = INTERVAL * np.arange(u.size)
    x = simulate(model, HeldSignal(t, u), t)
    noise = rng.standard_normal(u.size + 200)
    for k in range(1, noise.size):
        noise[k] += colour * noise[k - 1]
    noise, x, u, t = noise[200 + before :], x[before:], u[before:], t[before:]
    y = x + noise * (x.std() / noise.std() * 10 ** (-ratio / 20))
    return model, Record(t, y, HeldSignal(t, u))


def sampled_response(model, w):
    """Return the spectrum of the response to one held sample, over that of the hold."""
    count = round(120.0 / INTERVAL)
    t = INTERVAL * np.arange(count)
    pulse = np.zeros(count)
    pulse[0] = 1.0
    answer = simulate(model, HeldSignal(t, pulse), t)
    hold = np.sinc(w * INTERVAL / (2 * np.pi)) * np.exp(-0.5j * w * INTERVAL)
    return np.exp(-1j * np.outer(w, t)) @ answer / hold


def exact_response(model, w):
    s = 1j * w
    return np.polyval(model.numerator, s) / np.polyval(model.denominator, s) * np.exp(-s * model.delay)


def count_record(model, record, method="auto"):
    try:
        found = estimate_frequency_response(record, method=method)
    except DataError:
        return None
    w, g = found.frequencies, found.response
    low, high = found.gain_band()
    half, radius = found.phase_band(), found.radius()
    drawn = np.isfinite(high)
    phased = drawn & (half <= np.pi / 2)
    sampled, system = sampled_response(model, w), exact_response(model, w)
    band = np.abs(system) > IN_BAND * np.abs(system).max()
    gain_in, phase_in, joint_in = zip(
        *(
            (
                (low <= np.abs(true)) & (np.abs(true) <= high),
                np.abs(np.angle(g / true)) <= half,
                np.abs(g - true) <= radius,
            )
            for true in (sampled, system)
        ),
        strict=True,
    )
    counts = []
    for where in (band, np.ones(w.size, dtype=bool)):
        d, p = where & drawn, where & phased
        pairs = [(d, where), (p, where), (gain_in[0], d), (phase_in[0], p), (joint_in[0], d), (joint_in[1], d)]
        counts += [((a & b).sum(), b.sum()) for a, b in pairs]
    top = np.arange(w.size) == np.argmax(np.abs(system))
    counts += [((top & drawn).sum(), 1), ((joint_in[0] & drawn & top).sum(), (drawn & top).sum())]
    error = np.abs(g - sampled)
    return Counts(
        np.array(counts),
        (radius / np.abs(sampled))[drawn & band],
        (radius / np.maximum(error, 1e-12))[drawn & band],
        found.method,
    )


HEAD = (
    f"{'':34}"
    + f"{'drawn':>6}{'phase':>6} |{'gain':>5}{'phase':>6}{'joint':>6}{'system':>7} |" * 2
    + f"{'top':>6}{'joint':>6} | width /error"
)


def row(name, counts):
    counts = [c for c in counts if c is not None]
    if not counts:
        return
    sums = np.sum([c.counts for c in counts], axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        shares = 100 * sums[:, 0] / sums[:, 1]
    widths, ratios = (np.concatenate([c[k] for c in counts]) for k in (1, 2))
    methods = " ".join(f"{m} {sum(c.method == m for c in counts)}" for m in sorted({c.method for c in counts}))
    line = "{:6.1f}{:6.1f} |{:5.1f}{:6.1f}{:6.1f}{:7.1f} |" * 2 + "{:6.1f}{:6.1f} |"
    medians = [np.median(x) if x.size else np.nan for x in (widths, ratios)]
    print(f"{name:34}" + line.format(*shares) + "{:6.2f}{:7.2f}  ".format(*medians) + methods, flush=True)


def main():
    options = argparse.ArgumentParser()
    options.add_argument("--records", type=int, default=24, help="records of each input, system and length")
    options.add_argument("--seed", type=int, default=1)
    options.add_argument("--lengths", type=int, nargs="+", default=LENGTHS)
    options.add_argument("--method", default="auto")
    chosen = options.parse_args()
    results = {}
    for kind, family, n in itertools.product(INPUTS, SYSTEMS, chosen.lengths):
        for k in range(chosen.records):
            ratio, colour = RATIOS[k % 3], COLOURS[k % 2]
            rng = np.random.default_rng([chosen.seed, INPUTS.index(kind), SYSTEMS.index(family), n, k])
            key = (kind, family, n, ratio, colour)
            results.setdefault(key, []).append(
                count_record(*make_record(kind, family, n, ratio, colour, rng), chosen.method)
            )
    print(HEAD)
    for place, values in enumerate((INPUTS, SYSTEMS, chosen.lengths, RATIOS, COLOURS)):
        for value in values:
            row(str(value), [c for key, cs in results.items() if key[place] == value for c in cs])
    for kind, family in itertools.product(INPUTS, SYSTEMS):
        row(f"{kind}, {family}", [c for key, cs in results.items() if key[:2] == (kind, family) for c in cs])


if __name__ == "__main__":
    main()
