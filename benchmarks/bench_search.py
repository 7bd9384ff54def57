"""Search for the least output error: random systems against an independent multi-start, and its CPU time.

    python benchmarks/bench_search.py [--systems 300] [--seed 1] [--fixed] [--peer FILE]

Systems of 1 to 4 poles and 0 to n - 1 zeros with a delay up to 15 s, searched from 0 to 20 s; 200 to 500 samples, two
fifths of them on irregular clocks, 5 to 25 dB, inputs PRBS, Gaussian or multisine. ``DelayProfile`` with its defaults
is compared with the peer of ``bench_known.py`` in the same box of admissible models: the best 40 of 200 random draws
are refined, and so are the truth and the fit itself. The measure is ``N (S/S_min - 1)``: the excess of the squared
error in units of the noise variance, of which 3.84 is the 95 % quantile for one parameter. Nothing excuses an excess,
neither a status at a bound nor a refusal. ``--fixed``: one true coefficient is known. ``--peer`` keeps the least
squared errors of the peer in a file, since they take most of the time.
"""

import argparse
import json
import warnings
from collections import defaultdict
from pathlib import Path

from _timing import cpu

import numpy as np
from bench_known import Peer, random_system, reached
from bench_optimum import modal_responses

from ctid_cli import DataError, DelayProfile, Fixed, HeldSignal, Prbs, Record, TransferFunction

#: Excesses that are counted: the 95 % quantile of one parameter, and hardly noticeable.
MUCH, LITTLE = 3.84, 0.5
BOUNDS = (0.0, 20.0)
DRAWS, REFINED = 200, 40


def random_case(rng):
    """Return a record and its true model."""
    n, samples = int(rng.integers(1, 5)), int(rng.integers(200, 501))
    length = float(np.exp(rng.uniform(np.log(50.0), np.log(150.0))))
    h = length / samples
    poles, b, a = random_system(rng, n, 6.0 / length, 0.8 / h)
    delay = float(rng.uniform(0.0, 15.0))
    t = h * np.arange(samples)
    if rng.random() < 0.4:
        t = np.concatenate(([0.0], np.cumsum(h * rng.uniform(0.3, 1.7, samples - 1))))
    kind = str(rng.choice(["prbs", "gaussian", "multisine"]))
    if kind == "prbs":
        u = Prbs(9, h * int(rng.integers(1, 12))).generate(t, rng).at(t)
    elif kind == "gaussian":
        u = rng.standard_normal(samples)
    else:
        w = 2 * np.pi / length * np.arange(1, int(rng.integers(8, samples // 4)))
        u = np.cos(np.outer(t, w) + rng.uniform(0, 2 * np.pi, w.size)).sum(axis=1) / np.sqrt(w.size / 2)
    weights = np.array([1 / np.prod(np.delete(p - poles, k)) for k, p in enumerate(poles)])
    x = (modal_responses(poles, t, u, t, delay, 0.0) @ (np.polyval(b, poles) * weights)).real
    y = x + rng.standard_normal(samples) * x.std() * 10 ** (-rng.uniform(5, 25) / 20)
    return Record(t, y, HeldSignal(t, u)), TransferFunction(b, a, delay)


def estimator_of(model, fixed, rng):
    """Return the estimator of a system, optionally with one true coefficient."""
    n, m = model.order, model.numerator.size - 1
    if not fixed:
        return DelayProfile(n, m, BOUNDS), {}
    known = {f"a{k}": float(model.denominator[k]) for k in range(1, n + 1)}
    known |= {f"b{k}": float(value) for k, value in enumerate(model.numerator)}
    name = str(rng.choice(sorted(known)))
    return DelayProfile(n, m, BOUNDS, fixed=(Fixed(name, known[name]),)), {name: known[name]}


def least_of(record, model, estimator, known, fit, rng):
    """Return the least squared error that the peer reaches by its start."""
    peer = Peer(record, estimator, fit.box, known)
    own = {"the truth": (model.poles, model.delay), "the fit itself": (fit.model.poles, fit.model.delay)}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return reached(peer, rng, DRAWS, REFINED, own)


def compared(seed, number, fixed, kept):
    """Return a system's number of poles, the CPU time of its fit, its excess, and a line about it."""
    rng = np.random.default_rng([seed, number])
    record, model = random_case(rng)
    estimator, known = estimator_of(model, fixed, rng)
    about = (
        f"{number}: {model.order}/{model.numerator.size - 1}, {record.n_samples} samples, "
        f"{'regular' if record.interval else 'irregular'}, known {', '.join(known) or 'nothing'}"
    )
    try:
        spent, fit = cpu(estimator.fit, record)
    except DataError as error:
        return model.order, 0.0, np.inf, f"{about}: refused: {error}"
    ours = fit.cost * fit.count
    if str(number) not in kept:
        kept[str(number)] = min(least_of(record, model, estimator, known, fit, rng).values())
    least = kept[str(number)] = min(kept[str(number)], ours)
    excess = fit.count * (ours / least - 1)
    return model.order, spent, excess, f"{about}: {fit.status.name}, {spent:.2f} CPU s, excess {excess:.3g}"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--systems", type=int, default=300)
    parser.add_argument("--first", type=int, default=0, help="number of the first system")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--fixed", action="store_true", help="one coefficient is known, at its true value")
    parser.add_argument("--peer", type=Path, help="file with the least squared errors of the peer; new ones are added")
    parser.add_argument("--verbose", action="store_true", help="a line for each system")
    asked = parser.parse_args()
    kept = json.loads(asked.peer.read_text()) if asked.peer and asked.peer.exists() else {}
    seconds, excesses = defaultdict(list), []
    for number in range(asked.first, asked.first + asked.systems):
        order, spent, excess, about = compared(asked.seed, number, asked.fixed, kept)
        seconds[order].append(spent)
        excesses.append(excess)
        if excess > LITTLE or asked.verbose:
            print(about, flush=True)
        if asked.peer:
            asked.peer.write_text(json.dumps(kept))
    for order, each in sorted(seconds.items()):
        print(f"{order} poles: {len(each)} systems, {sum(each):.1f} CPU s, greatest {max(each):.2f}")
    many = ", ".join(f"above {limit:g} in {sum(e > limit for e in excesses)}" for limit in (LITTLE, MUCH))
    whole = sum(map(sum, seconds.values()))
    print(f"{asked.systems} systems: excess {many}, in units of the noise variance; {whole:.0f} CPU s")


if __name__ == "__main__":
    main()
