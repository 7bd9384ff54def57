"""Benefit of the remedies that ``ctid fit`` prints, on the last quarter of a record, which no fit uses.

    python benchmarks/bench_remedies.py [--seed SEED] [--records N] [RECORD.csv ...]

Simulated records have one planted fault each: a pole too few, a range of delays too short, an integrator left out, or
outliers. Each is fitted on its first three quarters; every printed remedy is applied, and both fits are compared on the
last quarter, through which input and state are simulated. A planted fault counts if it costs more than three points of
fit there. Measured records, named on the command line, are fitted with one, two and three poles.
"""

import argparse
import time
from dataclasses import dataclass, replace

import numpy as np

from ctid_cli import DelayProfile, HeldSignal, Record, TransferFunction, read_record, simulate
from ctid_cli.errors import CtidError
from ctid_cli.identification.remedies import tried_remedies
from ctid_cli.signals.record import with_hold

FAULTS = ("poles", "delay", "integrator", "outliers")
#: Options that remove a fault.
CURES = {"poles": "--poles", "delay": "--delay", "integrator": "--integrators", "outliers": "--loss"}
#: Part of a record that is fitted, and points of fit from which a fault counts.
FITTED, COSTLY = 0.75, 3.0


@dataclass
class Case:
    """A record, the given options, and those without the fault."""

    record: Record
    typed: DelayProfile
    right: DelayProfile
    fault: str


def system(rng, samples, integrating):
    """Return numerator, denominator, delay [samples] of a random system of known structure; the interval is 1."""
    poles = int(rng.integers(1, 5))
    slowest = 1.0 / np.exp(rng.uniform(np.log(3.0), np.log(samples / 15.0)))
    free, roots, speed = poles - integrating, [], slowest
    while len(roots) < free:
        if free - len(roots) > 1 and rng.random() < 0.5:
            damping = rng.uniform(0.1, 0.9)
            pole = speed * complex(-damping, np.sqrt(1.0 - damping**2))
            roots += [pole, pole.conjugate()]
        else:
            roots.append(-speed)
        speed = slowest * rng.uniform(1.0, 6.0)
    zeros = -slowest * rng.uniform(0.3, 6.0, rng.integers(0, poles)) * rng.choice([1, 1, 1, 1, 1, 1, 1, -1, -1, -1])
    b, a = np.atleast_1d(np.poly(zeros)), np.atleast_1d(np.poly(roots).real)
    b = b * a[-1] / b[-1] * rng.choice([-1.0, 1.0]) * rng.uniform(0.5, 3.0)
    delay = 0.0 if rng.random() < 0.5 else float(rng.uniform(0.3, 10.0))
    return b, np.append(a, np.zeros(integrating)), delay


def drive(rng, t, hold, before):
    """Return a pseudo-random binary signal, a step after some samples that are not recorded, or a multisine."""
    kind = rng.choice(["binary", "step", "multisine"]) if hold == "zoh" else "multisine"
    samples = t.size
    if kind == "step":
        return (np.arange(samples) >= before + rng.uniform(0.05, 0.15) * (samples - before)).astype(float)
    if kind == "binary":
        each = int(rng.integers(2, 12))
        return np.repeat(rng.choice([-1.0, 1.0], samples // each + 1), each)[:samples]
    waves = rng.integers(1, max(samples // 8, 12), 20)
    return np.cos(2 * np.pi * np.outer(t, waves) / samples + rng.uniform(0, 2 * np.pi, waves.size)).sum(axis=1) / 4


def noise(rng, samples):
    """Return white noise, or first-order autoregressive noise, of variance 1."""
    white = rng.standard_normal(samples)
    if rng.random() < 0.5:
        return white
    root, found = rng.uniform(0.5, 0.95), np.zeros(samples)
    for k in range(samples):
        found[k] = root * (found[k - 1] if k else 0.0) + np.sqrt(1 - root**2) * white[k]
    return found


def planted(rng, fault):
    """Return a simulated record with a planted fault; None if the system has nothing to leave out."""
    samples = int(np.exp(rng.uniform(np.log(300), np.log(1000))))
    integrating = int(fault == "integrator" or (fault != "integrator" and rng.random() < 0.25))
    numerator, denominator, delay = system(rng, samples, integrating)
    order, zeros = denominator.size - 1, numerator.size - 1
    hold = "foh" if rng.random() < 0.2 else "zoh"
    before = int(rng.integers(20, 100)) if rng.random() < 0.5 else 0
    t = np.arange(samples + before, dtype=float)
    if rng.random() < 0.25:
        t = t + rng.uniform(-0.4, 0.4, t.size)
    u = drive(rng, t, hold, before)
    if integrating:
        u = u - (u.mean() if np.unique(u).size > 2 else 0.0)
    x = simulate(TransferFunction(numerator, denominator, delay), HeldSignal(t, u, hold), t)[before:]
    t, u, x = t[before:], u[before:], x - x[0]
    scale = x.std() / np.sqrt(10 ** (rng.uniform(5, 30) / 10))
    y = x + scale * noise(rng, samples) + rng.choice([0.0, rng.uniform(-1, 1) * x.std()])
    right = DelayProfile(
        order - integrating,
        zeros,
        (0.0, 12.0),
        integrators=integrating,
        initial_state="estimate" if before else "rest",
        offset="estimate",
    )
    typed = right
    if fault == "poles":
        if right.poles < 2:
            return None
        typed = replace(right, poles=right.poles - 1, zeros=min(zeros, right.poles - 2 + integrating))
    elif fault == "delay":
        if delay < 2.0:
            return None
        typed = replace(right, delay_bounds=(0.0, float(f"{rng.uniform(0.2, 0.7) * delay:.2g}")))
    elif fault == "integrator":
        if right.poles < 1:
            return None
        typed = replace(right, integrators=0, zeros=min(zeros, right.poles - 1))
    else:
        outlying = np.flatnonzero(rng.random(int(FITTED * samples)) < 0.03)
        y[outlying] += rng.choice([-1.0, 1.0]) * rng.uniform(10, 30, outlying.size) * max(scale, 0.1 * x.std())
    return Case(Record(t, y, HeldSignal(t, u, hold)), typed, right, fault)


def first_part(record):
    """Return the fitted part of a record."""
    n = int(FITTED * record.n_samples)
    t = record.t[:n]
    return Record(t, record.y[:n], HeldSignal(t, record.input.values[:n], record.input.hold), name=record.name)


def fitted_and_tested(options, record):
    """Return the fit [%] of the last quarter by the fit to the rest, as in ``ctid fit``."""
    n = int(FITTED * record.n_samples)
    fit = options.fit(first_part(record))
    whole = options.prepare(record).laid_out
    offset = fit.offsets[0] if options.offset == "remove" else 0.0
    simulated = np.full(record.n_samples, np.nan)
    simulated[whole.used()[0]] = options._simulated(fit, whole)[0] + offset
    # Relative to the variation in the whole record: after a step the output is constant at the end.
    error = record.y[n:] - simulated[n:]
    return fit, 100 * (1 - np.sqrt(np.mean(error**2)) / record.y.std())


def remedies_of(record, options):
    """Yield each remedy of a fit with its last quarter before and after."""
    fit, before = fitted_and_tested(options, record)
    part = first_part(record)
    began = time.process_time()
    found = tried_remedies([part], options, fit).remedies
    seconds = time.process_time() - began
    fits = [before, *(fitted_and_tested(one.options, with_hold(record, one.hold))[1] for one in found)]
    # Each remedy is added to those before it.
    return before, list(zip(found, fits[:-1], fits[1:], strict=True)), seconds


def print_remedies(found):
    """Print remedies and their effect."""
    for one, worse, better in found:
        print(f"    {'ok ' if better > worse else 'BAD'} {better:.1f} {one}")


def report(rows):
    """Print the share of helpful remedies."""
    helped = [after > before for before, after in rows]
    share = 100 * np.mean(helped) if helped else np.nan
    print(f"remedies printed: {len(rows)}; obeyed, {sum(helped)} ({share:.0f} %) improve the last quarter")


def summary(rows, costly, spent):
    """Print helpful remedies, reported faults, and the time of the trials."""
    report(rows)
    for fault in FAULTS:
        of_fault = [case for case in costly if case[0] == fault]
        count = len(of_fault)
        print(f"{fault}: {count} cost more than {COSTLY:g} points, named {sum(n for _, n, _ in of_fault)},", end=" ")
        print(f"half of the loss mended {sum(m for _, _, m in of_fault)}")
    if costly:
        print(f"named of all: {100 * np.mean([n for _, n, _ in costly]):.0f} % of {len(costly)}")
    print(f"CPU seconds of the trials: median {np.median(spent):.2f}, most {max(spent):.2f}")


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--records", type=int, default=100)
    parser.add_argument("--verbose", action="store_true")
    parser.add_argument("measured", nargs="*")
    given = parser.parse_args()
    rng, rows, costly, spent = np.random.default_rng(given.seed), [], [], []
    made_of = dict.fromkeys(FAULTS, 0)
    while sum(made_of.values()) < given.records:
        fault = FAULTS[sum(made_of.values()) % len(FAULTS)]
        case = planted(rng, fault)
        if case is None:
            continue
        try:
            before, found, seconds = remedies_of(case.record, case.typed)
            _, right = (
                fitted_and_tested(case.right, case.record)
                if fault != "outliers"
                else fitted_and_tested(replace(case.right, loss="tukey"), case.record)
            )
        except CtidError as error:
            print("refused:", error)
            continue
        made_of[fault] += 1
        spent.append(seconds)
        rows += [(worse, better) for _, worse, better in found]
        named = any(CURES[fault] in one.option for one, _, _ in found)
        mended = any(better > before + 0.5 * (right - before) for _, _, better in found)
        if right - before > COSTLY:
            costly.append((fault, named, mended))
        if given.verbose:
            print(
                f"{fault} {case.record.n_samples} {before:.1f} -> {right:.1f}",
                "costly" if right - before > COSTLY else "",
            )
            print_remedies(found)
    if given.records:
        summary(rows, costly, spent)
    rows = []
    for file in given.measured:
        for poles in (1, 2, 3):
            record = read_record(file)
            typed = DelayProfile(poles, poles - 1, (0.0, 0.0))
            try:
                before, found, seconds = remedies_of(record, typed)
            except CtidError as error:
                print(f"{file}, {poles}: {error}")
                continue
            rows += [(worse, better) for _, worse, better in found]
            print(f"{record.name}, {poles} poles: {before:.1f} % ({seconds:.1f} s)")
            print_remedies(found)
    if rows:
        report(rows)


if __name__ == "__main__":
    main()
